"""``djet replay``: estimate the trajectory of a camera from a recording."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
import math
from pathlib import Path
from typing import Any

from djet_ros.cli.options import add_output, add_topics, RECORDINGS
from djet_ros.cli.terminal import console, new_table, progress_bar, spread, warn
from djet_ros.config.flags import add_flags, flag_values
from djet_ros.config.flat import with_values
from djet_ros.config.sections import Config, NODE_NAME, OdometryConfig
from djet_ros.config.yaml_files import load_yaml
from djet_ros.core.types import Status
from djet_ros.errors import DjetError
from djet_ros.odometry.scale import Scale
from djet_ros.recordings.recording import AUXILIARY, open_recording
from djet_ros.replay.replay import Outcome, Replay
from djet_ros.replay.results import DEBUG, PLOT, ResultsFolder
import numpy as np
from rich.table import Table

DESCRIPTION = """\
Run a recording through the odometry and write, into one folder, the trajectory (TUM and KITTI
formats: pose of the camera in the optical frame of the first one), an output bag, a CSV row per
image, a summary and a plot. Errors against ground truth are angles between true and estimated
rotation, and between true and estimated translation direction of pairs with at least 1 cm of true
translation. If the path is at least 100 m long, drift is computed per 100 m as in the KITTI
benchmark.
"""

_FLAGS = ('estimator.method', 'preset', 'odometry.scale', 'odometry.scale_value',
          'odometry.camera_height', 'odometry.camera_pitch', 'odometry.scale_uncertainty',
          'odometry.rectified', 'odometry.residual_k1', 'odometry.gray_range',
          'odometry.frame_convention', 'odometry.base_frame', 'odometry.imu', 'odometry.guess',
          'odometry.guess_frame', 'odometry.mask', 'odometry.mask_file')


# Parameters that enable the use of a topic, by the option that names the topic.
_ENABLED_BY = {'speed': 'odometry.scale to speed', 'imu': 'odometry.imu to true',
               'guess': 'odometry.guess to true or odometry.scale to guess, without a '
               'guess_frame',
               'mask': 'odometry.mask to true'}

# The same for parameters that only some configurations use, and whether one does.
_USED_WITH: dict[str, tuple[str, Callable[[OdometryConfig], bool]]] = {
    'odometry.scale_value': ('odometry.scale to constant', lambda it: it.scale == 'constant'),
    **dict.fromkeys(('odometry.camera_height', 'odometry.camera_pitch'), (
        'odometry.scale to camera_height', lambda it: it.scale == 'camera_height')),
    'odometry.guess_frame': ('odometry.guess to true or odometry.scale to guess',
                             lambda it: it.guess_by_tf)}

# Scale of a trajectory, as printed.
_SCALES = {Scale.METRIC: 'metric', Scale.RELATIVE: 'relative, in units of the first step',
           Scale.UNKNOWN: 'unknown'}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('source', type=Path, metavar='SOURCE', help=RECORDINGS)
    add_output(parser, 'folder for the results')
    parser.add_argument('--debug-images', action='store_true',
                        help=f'also write {DEBUG}/NNNNNN.jpg for each pair: displacements of '
                        'inliers (green) and outliers (red), and 20 times the distances from the '
                        'epipolar lines (yellow)')
    add_replay_options(parser, _FLAGS)


def add_replay_options(parser: argparse.ArgumentParser, flags: Iterable[str]) -> None:
    """Add the options that decide how a recording is replayed."""
    parser.add_argument('--config', type=Path, metavar='FILE',
                        help='YAML file of parameters, plain or in the layout of ROS; flags '
                        'override it, --preset all its estimator.* values')
    add_flags(parser, flags)
    parser.add_argument('--poses', type=Path, metavar='FILE',
                        help="ground truth, in place of the recording's own: poses of the camera "
                        '(x right, y down, z ahead) as a TUM file, or a KITTI file with a row per '
                        'image')
    add_topics(parser, 'image', 'info', *(what for what in AUXILIARY if what != 'tf'))


def run(args: argparse.Namespace) -> int:
    """Replay with a progress bar on stderr, and print the summary on stdout."""
    with opened_replay(args, configuration(args), args.source, args.output,
                       args.debug_images) as replay:
        outcome = replay()
    if outcome.summary['frames']:
        console().print(_table(outcome.summary))
        print(f'results: {args.output}')
        if (args.output / PLOT).exists():
            print(f'plot: {args.output / PLOT}')
    for line in outcome.advice:
        warn(line)
    if outcome.problem:
        raise DjetError(outcome.problem)
    return 0


def configuration(args: argparse.Namespace, *nodes: str, base: Config | None = None) -> Config:
    """
    Return the parameters of --config for the named nodes, overridden by the flags.

    base: what they override in turn, by default the defaults.
    """
    config = base or Config()
    if args.config:
        config = load_yaml(args.config, partial(with_values, config), nodes or (NODE_NAME,))
    return with_values(config, flag_values(args))


@contextmanager
def opened_replay(args: argparse.Namespace, config: Config, recording: Path, folder: Path,
                  draw: bool = False, derived: Iterable[Path] = ()
                  ) -> Iterator[Callable[[], Outcome]]:
    """
    Open a recording with the topics and poses of the options; yield a function that replays it.

    The results folder is cleared only after the first image could be used: on an error before
    that the results of an earlier run are kept. draw: whether to write drawings of the pairs.
    """
    wanted = _auxiliary_inputs(config.odometry)
    check_topics(args, wanted)
    _check_flags(args, config.odometry)
    with open_recording(recording, args.image_topic, args.info_topic, args.poses,
                        auxiliary={what: getattr(args, f'{what}_topic', None)
                                   for what in wanted}, damaged=True) as source:
        replay = Replay(source, config, str(recording), draw)
        with ResultsFolder(folder, config, args.overwrite, derived) as results, \
                progress_bar('replay', len(source)) as advance:
            yield partial(replay.run, results, advance)


def check_topics(args: argparse.Namespace, wanted: Collection[str]) -> None:
    """Raise DjetError if an option names a topic that the configuration does not use."""
    for what, setting in _ENABLED_BY.items():
        topic = getattr(args, f'{what}_topic', None)
        if topic is not None and what not in wanted:
            raise _unused(f'--{what}-topic', topic, setting)


def _check_flags(args: argparse.Namespace, config: OdometryConfig) -> None:
    """Raise DjetError for a flag without effect; files are shared by several configurations."""
    given = flag_values(args)
    for name, (setting, uses) in _USED_WITH.items():
        # Zero and '' take back what a file says.
        if given.get(name) and not uses(config):
            raise _unused(f'--{name.rpartition(".")[2].replace("_", "-")}', given[name], setting)


def _unused(option: str, given: object, setting: str) -> DjetError:
    return DjetError(f"{option} is '{given}', but the configuration does not use it; set "
                     f'{setting}, or omit the option')


def _auxiliary_inputs(config: OdometryConfig) -> list[str]:
    """Return the names of the inputs that the odometry uses besides images and CameraInfo."""
    wanted = {'speed': config.scale == 'speed', 'imu': config.imu, 'mask': config.mask,
              'guess': config.guess_by_topic, 'tf': config.guess_by_tf}
    return [what for what, is_wanted in wanted.items() if is_wanted]


def _table(summary: dict[str, Any]) -> Table:
    source = Path(summary['source']).name
    table = new_table(f"{source}: {summary['method']}, {summary['preset']}")
    seconds = summary['seconds']
    rate = summary['frames'] / seconds if seconds else math.nan
    table.add_row('frames', f"{summary['frames']} in {seconds:.1f} s ({rate:.1f}/s)")
    for status, count in sorted(summary['status'].items()):
        table.add_row(f'  {status}', str(count))
    for what, name in (('dropped', 'dropped'), ('rejected', 'rejected'),
                       ('rejected_infos', 'rejected CameraInfo')):
        for reason, count in sorted(summary[what].items()):
            table.add_row(f'{name}: {reason}', str(count))
    if summary['status'].get(Status.OK.value):
        table.add_row('scale', _SCALES[summary['scale_kind']])
    if 'compared_pairs' in summary:
        table.add_row('pairs with ground truth', str(summary['compared_pairs']))
        table.add_row('  failures (rotation / direction)',
                      f"{summary['failures']} / {summary['translation_failures']}")
        table.add_row('error in degrees', 'mean / median / p95 / max')
        table.add_row('  rotation', spread(summary['rotation_error_deg']))
        table.add_row('  translation direction', spread(summary['translation_error_deg']))
    if positions := summary.get('positions'):
        table.add_row('position RMSE after alignment (APE)',
                      f"{_metres(positions['rmse_m'])} over a path of "
                      f"{_metres(positions['way_m'])}")
        if positions['scale_change'] is not None:
            table.add_row('  scale drift, end / start', f"{positions['scale_change']:.3f}")
    if drift := summary.get('drift'):
        table.add_row('drift (KITTI)', f"{drift['segments']} segments of 100 m "
                      f"to {drift['longest']} m")
        table.add_row('  rotation (r_rel)', f"{drift['rotation_deg_per_100m']:.3f} deg per 100 m")
        if drift['translation_percent'] is not None:
            table.add_row('  translation (t_rel)', f"{drift['translation_percent']:.2f} %")
    return table


def _metres(length: float) -> str:
    """Return a length with four significant digits, as a hand or a car may have moved."""
    return f"{np.format_float_positional(length, 4, fractional=False, trim='-')} m"
