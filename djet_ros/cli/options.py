"""Options that several commands share."""

from __future__ import annotations

import argparse
from collections.abc import Callable
import json
from pathlib import Path
from typing import Any

from djet_ros.errors import DjetError
from djet_ros.recordings.outputs import check_file, make_folder, write_whole


# What a recording may be, for the help of who opens one.
RECORDINGS = ('rosbag2, ROS 1 bag, or folder of KITTI (odometry, raw), TUM RGB-D, 7-Scenes, '
              'EuRoC, TUM-VI or VAROS')


def place(text: str) -> Path:
    """Give the place that an --output names; '' is more likely a variable that is not set."""
    if not text.strip():
        raise argparse.ArgumentTypeError('it is empty; name a place')
    return Path(text)


def add_output(parser: argparse.ArgumentParser, what: str, default: str | None = None,
               metavar: str = 'DIR') -> None:
    """Add --output, required unless there is a default, and --overwrite."""
    parser.add_argument('--output', type=place, metavar=metavar, required=default is None,
                        default=default and Path(default),
                        help=what + (' (default: %(default)s)' if default else ''))
    add_overwrite(parser)


def add_overwrite(parser: argparse.ArgumentParser) -> None:
    """Add the flag without which nothing is replaced."""
    parser.add_argument('--overwrite', action='store_true',
                        help='replace what an earlier run has written there')


def add_json_output(parser: argparse.ArgumentParser) -> None:
    """Add --output for a JSON file of figures, which a plot lies beside, and --overwrite."""
    add_output(parser, 'where the figures go; the plot goes to FILE.png', metavar='FILE.json')


def check_output(args: argparse.Namespace, *suffixes: str) -> None:
    """Raise DjetError where --output can't be the file that is wanted; make its folder."""
    check_file(args.output, args.overwrite, *suffixes)
    make_folder(args.output.parent)


def check_json_output(args: argparse.Namespace) -> None:
    """Raise DjetError as ``check_output`` does, also where the plot can't be beside --output."""
    check_output(args, '.json')
    check_file(args.output.with_suffix('.png'), args.overwrite)


def write_json(path: Path, figures: dict[str, Any], draw: Callable[[Path], None]) -> None:
    """Write figures as JSON, draw the plot beside them, and say where both are."""
    write_whole(path, json.dumps(figures, indent=2) + '\n')
    plot = path.with_suffix('.png')
    draw(plot)
    print(f'figures: {path}\nplot: {plot}')


def add_frames(parser: argparse.ArgumentParser) -> None:
    """Add --start and --end."""
    parser.add_argument('--start', type=int, default=0, metavar='N',
                        help='first frame (default: %(default)s)')
    parser.add_argument('--end', type=int, metavar='N',
                        help='frame after the last one (default: all)')


def add_workers(parser: argparse._ActionsContainer) -> None:
    """Add --workers."""
    parser.add_argument('--workers', type=int, metavar='N',
                        help='processes on this machine (default: one for each core)')


def check_workers(args: argparse.Namespace) -> None:
    """Raise DjetError where --workers is none."""
    if args.workers is not None and args.workers < 1:
        raise DjetError(f'workers is {args.workers}; at least one is needed')


def add_topics(parser: argparse.ArgumentParser, *names: str) -> None:
    """Add --image-topic and the like."""
    for name in names:
        parser.add_argument(f'--{name}-topic', metavar='TOPIC',
                            help='needed where the bag has several')


def split(text: str) -> list[str]:
    """Give the words of a comma-separated list."""
    return [word.strip() for word in text.split(',') if word.strip()]


def numbers(text: str, option: str, form: str) -> list[float]:
    """Give the numbers of a list in a form such as X,Y; DjetError if it has another."""
    try:
        values = [float(word) for word in split(text)]
    except ValueError:
        values = []
    if len(values) != len(split(form)):
        raise DjetError(f"{option} is '{text}'; give {form}")
    return values


def add_seeds(parser: argparse.ArgumentParser) -> None:
    """Add --seeds, of rendered scenes."""
    parser.add_argument('--seeds', type=_seeds, default='0-4', metavar='LIST',
                        help='seeds of the scenes, such as 0,3 or 0-9 (default: %(default)s)')


def _seeds(text: str) -> list[int]:
    """Give the numbers of a text such as 0,3-5."""
    try:
        ends = [[int(end) for end in part.split('-')] for part in split(text)]
    except ValueError:
        ends = []
    if not ends or any(end[0] > end[-1] for end in ends):
        raise argparse.ArgumentTypeError(f"'{text}' is no list of seeds such as 0,3 or 0-9")
    return [seed for end in ends for seed in range(end[0], end[-1] + 1)]
