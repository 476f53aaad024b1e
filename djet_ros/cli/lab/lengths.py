"""``djet lab lengths``: scale drift and its covariance, on rendered streets."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial

from djet_ros.cli.lab.pair_runs import run_and_record
from djet_ros.cli.options import add_output, add_seeds, add_workers, check_least, write_json
from djet_ros.cli.terminal import compact_table, console
from djet_ros.config.flags import add_flags, flag_values
from djet_ros.config.flat import from_flat
from djet_ros.lab.lengths import Drive, DriveChunk, run_drive, SEGMENTS_M
import numpy as np

DESCRIPTION = """\
Render streets and run the odometry twice: from images alone, and with the scale of the camera's
height while the ground is masked for some time, as when a wall or lorry hides it. Prints the scale
drift, the consistency of the covariances of steps and poses, and the scale error while no ground
is visible. Writes the results as JSON. An interrupted run is resumed.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    add_seeds(parser)
    parser.add_argument('--frames', type=int, default=501, metavar='N',
                        help='frames of each street, 1 m apart (default: %(default)s)')
    parser.add_argument('--hidden', type=int, default=200, metavar='N',
                        help='frames without visible ground, at 10 Hz (default: %(default)s)')
    parser.add_argument('--half', action='store_true', help='images of half the size')
    add_output(parser, 'folder for the results')
    add_workers(parser)
    add_flags(parser, ('estimator.max_features',))


def run(args: argparse.Namespace) -> int:
    """Run all streets, and print drift and consistency."""
    check_least(args, workers=1, frames=3, hidden=0)
    size = (620, 188) if args.half else None
    drives = _drives(args, [DriveChunk('road', seed, size, args.frames, args.hidden)
                            for seed in args.seeds])
    _show(drives)
    write_json(args.output / 'lengths.json', [asdict(drive) for drive in drives])
    return 0


def _drives(args: argparse.Namespace, chunks: Sequence[DriveChunk]) -> list[Drive]:
    config = from_flat(flag_values(args)).estimator
    settings = {'frames': args.frames, 'hidden': args.hidden, 'half': args.half,
                'estimator': asdict(config)}
    return run_and_record(args, Drive, settings, ('lengths.json',), chunks,
                          partial(run_drive, config=config))


def _show(drives: Sequence[Drive]) -> None:
    table = compact_table('', 'tracked', 'scale', 't_rel', 'r_rel', 'step', 'rot.',
                          *(f'pose {metres}' for metres in SEGMENTS_M), 'no ground', names=1)
    for drive in drives:
        table.add_row(f'{drive.scene} {drive.seed}', f'{drive.tracked}/{drive.frames - 1}', *(
            f'{value:.3f}' if np.isfinite(value) else '-' for value in (
                drive.scale_change, drive.translation_percent, drive.rotation_deg_per_100m,
                drive.step_square, drive.turn_square_100, drive.pose_square_25,
                drive.pose_square_50, drive.pose_square_100, drive.hidden_length)))
    console().print(table)
    print('scale: scale of the last tenth / that of the first; t_rel (%) and r_rel (deg per 100 '
          'm): drift;\n  step, rot., pose: median NEES over the median of its distribution, 1 if '
          'the covariances are correct:\n  step: length relative to its neighbours; rot.: '
          'rotation over 100 m; pose: pose over 25, 50 and 100 m,\n  in the local scale at the '
          'start of the segment; no ground: estimated / true path length by the camera\n  height '
          'while no ground is visible')
