"""Options that several commands share."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
import json
import math
from pathlib import Path
from typing import Any

from djet_ros.errors import DjetError
from djet_ros.recordings.outputs import check_file, check_writable, write_whole


# Formats of recordings, for help texts.
RECORDINGS = ('rosbag2, ROS 1 bag, or folder of KITTI (odometry, raw), TUM RGB-D, 7-Scenes, '
              'EuRoC, TUM-VI, VAROS, or of images with calibration.yaml or calibration.txt')


def output_path(text: str) -> Path:
    """Return an --output as a path; refuse '', which is most likely an unset shell variable."""
    if not text.strip():
        raise argparse.ArgumentTypeError('the path is empty; name a file or folder')
    return Path(text)


def add_output(parser: argparse.ArgumentParser, what: str, default: str | None = None,
               metavar: str = 'DIR') -> None:
    """Add --output, required unless there is a default, and --overwrite."""
    parser.add_argument('--output', type=output_path, metavar=metavar, required=default is None,
                        default=default and Path(default),
                        help=what + (' (default: %(default)s)' if default else ''))
    add_overwrite(parser)


def add_overwrite(parser: argparse.ArgumentParser) -> None:
    """Add --overwrite."""
    parser.add_argument('--overwrite', action='store_true',
                        help='replace the output of an earlier run (default: refuse)')


def add_json_output(parser: argparse.ArgumentParser) -> None:
    """Add --output for a JSON file of results with a plot next to it, and --overwrite."""
    add_output(parser, 'JSON file of the results; the plot is written to FILE.png',
               metavar='FILE.json')


def check_output(args: argparse.Namespace, *suffixes: str, inputs: Iterable[Path] = ()) -> None:
    """Make the folder of --output; raise DjetError if the file can't be written there."""
    check_file(args.output, args.overwrite, *suffixes, inputs=inputs)
    check_writable(args.output)


def check_json_output(args: argparse.Namespace) -> None:
    """Do the same as ``check_output``, for a JSON file and the plot next to it."""
    check_output(args, '.json')
    check_file(args.output.with_suffix('.png'), args.overwrite)


def write_json(path: Path, figures: Any, draw: Callable[[Path], None] | None = None) -> None:
    """Write the results as JSON, and perhaps a plot next to it, and print the paths."""
    write_whole(path, json.dumps(_finite(figures), indent=2, allow_nan=False) + '\n')
    plot = path.with_suffix('.png')
    if draw is not None:
        draw(plot)
    print(f'figures: {path}' + f'\nplot: {plot}' * (draw is not None))


def _finite(value: Any) -> Any:
    """Return a value with None for NaN and infinities, which JSON does not have."""
    if isinstance(value, dict):
        return {name: _finite(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def add_frames(parser: argparse.ArgumentParser) -> None:
    """Add --start and --end."""
    parser.add_argument('--start', type=int, default=0, metavar='N',
                        help='first frame (default: %(default)s)')
    parser.add_argument('--end', type=int, metavar='N',
                        help='end before this frame (default: all frames)')


def add_workers(parser: argparse._ActionsContainer) -> None:
    """Add --workers."""
    parser.add_argument('--workers', type=int, metavar='N',
                        help='worker processes on this machine (default: one per core)')


def check_least(args: argparse.Namespace, **least: int) -> None:
    """Raise DjetError if an option that is given is below its least value, by its name."""
    for name, bound in least.items():
        value = getattr(args, name)
        if value is not None and value < bound:
            raise DjetError(f'--{name} is {value}; it must be at least {bound}')


# What the --*-topic options select.
_TOPICS = {'image': 'images', 'info': 'CameraInfo', 'speed': 'speeds', 'imu': 'IMU',
           'mask': 'masks', 'guess': 'odometry that predicts the motion'}


def add_topics(parser: argparse.ArgumentParser, *names: str) -> None:
    """Add --image-topic and the like, by the keys of ``_TOPICS``."""
    for name in names:
        parser.add_argument(f'--{name}-topic', metavar='TOPIC',
                            help=f'{_TOPICS[name]}; required only if the bag has several '
                            'candidates')


def split(text: str) -> list[str]:
    """Return the items of a comma-separated list."""
    return [word.strip() for word in text.split(',') if word.strip()]


def numbers(text: str, option: str, form: str) -> list[float]:
    """Return the finite numbers of a list in a form such as X,Y; raise DjetError otherwise."""
    try:
        values = [float(word) for word in split(text)]
    except ValueError:
        values = []
    if len(values) != len(split(form)) or not all(map(math.isfinite, values)):
        raise DjetError(f"{option} is '{text}'; write it as {form}")
    return values


# Of rendered scenes; a typing error must not fill the memory.
_MOST_SEEDS = 10_000


def add_seeds(parser: argparse.ArgumentParser) -> None:
    """Add --seeds for rendered scenes."""
    parser.add_argument('--seeds', type=_seeds, default='0-4', metavar='LIST',
                        help='seeds of the scenes, such as 0,3 or 0-9 (default: %(default)s)')


def _seeds(text: str) -> list[int]:
    """Return the numbers of a text such as 0,3-5, each of which may be named once."""
    try:
        ends = [[int(end) for end in part.split('-', 1)] for part in split(text)]
    except ValueError:
        ends = []
    if sum(max(end[-1] - end[0] + 1, 0) for end in ends) > _MOST_SEEDS:
        raise argparse.ArgumentTypeError(f"'{text}' has more than {_MOST_SEEDS} seeds")
    seeds = [seed for end in ends for seed in range(end[0], end[-1] + 1)]
    if not seeds or any(end[0] > end[-1] for end in ends) or len(set(seeds)) < len(seeds):
        raise argparse.ArgumentTypeError(
            f"'{text}' is not a list of different seeds such as 0,3 or 0-9")
    return seeds
