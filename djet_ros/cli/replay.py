"""``djet replay``: the trajectory of a camera from a recording."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

from djet_ros.config.flags import add_flags, flag_values
from djet_ros.config.flat import with_values
from djet_ros.config.sections import Config
from djet_ros.config.yaml_files import load_yaml
from djet_ros.errors import DjetError
from djet_ros.recordings.recording import open_recording
from djet_ros.replay.replay import Outcome, Replay
from djet_ros.replay.results import PLOT, ResultsFolder
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text

DESCRIPTION = """\
Run a recording through the odometry and write, into one folder, the trajectory (TUM and KITTI
formats, camera in the first camera along optical axes), an output bag, a row per image, a summary
and a plot. Errors against ground truth are angles between true and estimated rotation, and
between true and estimated direction of translation where the camera went at least 5 cm.
"""


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add the subcommand to the subparsers of ``djet``."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        'replay', help='get the trajectory of a camera from a recording', description=DESCRIPTION)
    parser.add_argument('source', type=Path, metavar='SOURCE',
                        help='rosbag2, ROS 1 bag, or folder in KITTI, TUM RGB-D or EuRoC layout')
    parser.add_argument('--output', type=Path, required=True, metavar='DIR',
                        help='folder of the results')
    parser.add_argument('--overwrite', action='store_true',
                        help='replace the results that the folder holds')
    parser.add_argument('--config', type=Path, metavar='FILE',
                        help='parameters as YAML, plain or in the layout of ROS; flags come on '
                        'top, and --preset replaces all its values of the estimator')
    add_flags(parser, ['estimator.method', 'preset', 'odometry.scale', 'odometry.scale_value',
                       'odometry.camera_height', 'odometry.camera_pitch', 'odometry.rectified',
                       'odometry.frame_convention'])
    parser.add_argument('--poses', type=Path, metavar='FILE',
                        help="ground truth instead of the recording's own: a TUM file, or a KITTI "
                        'file with a row for each image')
    for what in ('image', 'info', 'speed'):
        parser.add_argument(f'--{what}-topic', metavar='TOPIC',
                            help='needed where the bag has several')
    return parser


def run(args: argparse.Namespace) -> int:
    """Replay with a progress bar on stderr, and show what came of it on stdout."""
    config = load_yaml(args.config) if args.config else Config()
    config = with_values(config, flag_values(args))
    source = open_recording(args.source, args.image_topic, args.info_topic, args.poses,
                            speed=config.odometry.scale == 'speed',
                            speed_topic=args.speed_topic)
    try:
        with ResultsFolder(args.output, config, args.overwrite) as folder:
            outcome = _with_progress(Replay(source, config, folder, str(args.source)),
                                     len(source))
    finally:
        source.close()
    if outcome.summary['frames']:
        Console().print(_table(outcome.summary))
        print(f'results: {args.output}')
        if (args.output / PLOT).exists():
            print(f'plot: {args.output / PLOT}')
    if outcome.problem:
        raise DjetError(outcome.problem)
    return 0


class _Rate(ProgressColumn):
    """Frames per second so far."""

    def render(self, task: Task) -> Text:
        return Text(f'{task.speed or 0:.1f} frames/s')


def _with_progress(replay: Replay, images: int) -> Outcome:
    console = Console(stderr=True)
    if not console.is_terminal:
        return replay.run()
    with Progress(TextColumn('{task.description}'), BarColumn(), MofNCompleteColumn(), _Rate(),
                  TimeRemainingColumn(), console=console) as bar:
        task = bar.add_task('replay', total=images)
        return replay.run(lambda: bar.advance(task))


def _table(summary: dict[str, Any]) -> Table:
    source = Path(summary['source']).name
    table = Table(title=f"{source}: {summary['method']}, {summary['preset']}", show_header=False)
    table.add_column(justify='left')
    table.add_column(justify='right')
    seconds = summary['seconds']
    rate = summary['frames'] / seconds if seconds else math.nan
    table.add_row('frames', f"{summary['frames']} in {seconds:.1f} s ({rate:.1f}/s)")
    for status, count in sorted(summary['status'].items()):
        table.add_row(f'  {status}', str(count))
    for what in ('dropped', 'rejected'):
        for reason, count in sorted(summary[what].items()):
            table.add_row(f'{what}: {reason}', str(count))
    if 'compared_pairs' in summary:
        table.add_row('pairs with ground truth', str(summary['compared_pairs']))
        table.add_row('  failures (rotation / direction)',
                      f"{summary['failures']} / {summary['translation_failures']}")
        table.add_row('error in degrees', 'mean / median / p95 / max')
        table.add_row('  rotation', _errors(summary['rotation_error_deg']))
        table.add_row('  direction of translation', _errors(summary['translation_error_deg']))
    return table


def _errors(statistics: dict[str, float] | None) -> str:
    if statistics is None:
        return 'none'
    return ' / '.join(f'{statistics[name]:.3f}' for name in ('mean', 'median', 'p95', 'max'))
