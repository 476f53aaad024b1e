"""``djet render``: a rendered scene with exact ground truth, in the layout of KITTI."""

from __future__ import annotations

import argparse
from pathlib import Path
import re
from typing import Any

from djet_ros.lab.scenes import render_sequence, SCENES
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add the subcommand to the subparsers of ``djet``."""
    longest = max(map(len, SCENES))
    scenes = '\n'.join(f'  {name:{longest}}  {entry.text}' for name, entry in SCENES.items())
    parser: argparse.ArgumentParser = subparsers.add_parser(
        'render', help='render a scene with exact ground truth as a KITTI sequence',
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description='Render images, calibration, times and true camera poses into OUT, in the\n'
                    'layout of the KITTI odometry benchmark.', epilog=f'scenes:\n{scenes}')
    parser.add_argument('scene', metavar='SCENE', choices=tuple(SCENES), help='see below')
    parser.add_argument('out', type=Path, metavar='OUT',
                        help='folder that gets sequences/NN and poses/NN.txt')
    parser.add_argument('--frames', type=int, metavar='N',
                        help='how many (default: as suits the scene)')
    parser.add_argument('--seed', type=int, default=0, metavar='S',
                        help='another seed is another place (default: %(default)s)')
    parser.add_argument('--size', type=_size, metavar='WxH',
                        help='pixels of a picture (default: 1241x376, as KITTI has, and 960x540 '
                             'under water)')
    parser.add_argument('--overwrite', action='store_true', help='replace an earlier rendering')
    return parser


def run(args: argparse.Namespace) -> int:
    """Render, with a progress bar on stderr, and say what was written."""
    with Progress(TextColumn('{task.description}'), BarColumn(), MofNCompleteColumn(),
                  TimeRemainingColumn(), console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(args.scene, total=None)
        folder = render_sequence(
            args.scene, args.out, args.frames, args.seed, args.size, overwrite=args.overwrite,
            progress=lambda done, total: bar.update(task, completed=done, total=total))
        frames = int(bar.tasks[task].completed)
    width, height = args.size or SCENES[args.scene].size
    print(f'{folder}: {frames} frames of {width}x{height} with ground truth')
    return 0


def _size(text: str) -> tuple[int, int]:
    """Width and height of a text such as 620x188."""
    match = re.fullmatch(r'(\d{1,5})x(\d{1,5})', text)
    if match is None:
        raise argparse.ArgumentTypeError(f"'{text}' is not WIDTHxHEIGHT, such as 620x188")
    return int(match[1]), int(match[2])
