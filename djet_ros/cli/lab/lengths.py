"""``djet lab lengths``: how far lengths drift, and whether they are as sure as they say."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
import json

from djet_ros.cli.lab.pair_runs import recorded
from djet_ros.cli.options import add_output, add_seeds, add_workers, check_workers
from djet_ros.cli.terminal import compact_table, console
from djet_ros.config.flags import add_flags, flag_values
from djet_ros.config.flat import from_flat
from djet_ros.errors import DjetError
from djet_ros.lab.lengths import go, STRETCHES, Way, WayChunk
from djet_ros.recordings.outputs import make_folder, write_whole
import numpy as np

DESCRIPTION = """\
Render streets and go along them by images alone, and once more with the camera's height while the
ground is out of sight for a stretch, as before a wall. Tells by how much the scale drifts, whether
lengths and poses are as sure as they say, and how long the stretch without ground comes out.
Writes all of it as JSON. A run that was broken off is taken up where it ended.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    add_seeds(parser)
    parser.add_argument('--frames', type=int, default=501, metavar='N',
                        help='of each street, a metre apart (default: %(default)s)')
    parser.add_argument('--hidden', type=int, default=200, metavar='N',
                        help='frames without ground, ten a second (default: %(default)s)')
    parser.add_argument('--half', action='store_true', help='pictures of half the size')
    add_output(parser, 'folder of the results')
    add_workers(parser)
    add_flags(parser, ('estimator.max_features',))


def run(args: argparse.Namespace) -> int:
    """Go all ways, and show what became of them."""
    check_workers(args)
    if args.frames < 3:
        raise DjetError(f'--frames is {args.frames}; at least three are needed')
    if args.hidden < 0:
        raise DjetError(f'--hidden is {args.hidden}; it must not be negative')
    size = (620, 188) if args.half else None
    make_folder(args.output)
    ways = _ways(args, [WayChunk('road', seed, size, args.frames, args.hidden)
                        for seed in args.seeds])
    _show(ways)
    path = args.output / 'lengths.json'
    write_whole(path, json.dumps([asdict(way) for way in ways], indent=1) + '\n')
    print(f'figures: {path}')
    return 0


def _ways(args: argparse.Namespace, chunks: Sequence[WayChunk]) -> list[Way]:
    config = from_flat(flag_values(args)).estimator
    settings = {'frames': args.frames, 'hidden': args.hidden, 'half': args.half,
                'estimator': asdict(config)}
    return recorded(args, Way, settings, chunks, partial(go, config=config))


def _show(ways: Sequence[Way]) -> None:
    table = compact_table('', 'tracked', 'scale', 't_rel', 'r_rel', 'step', 'turn',
                          *(f'pose {metres}' for metres in STRETCHES), 'no ground', names=1)
    for way in ways:
        table.add_row(f'{way.scene} {way.seed}', f'{way.tracked}/{way.frames - 1}', *(
            f'{value:.3f}' if np.isfinite(value) else '-' for value in (
                way.scale_change, way.translation_percent, way.rotation_deg_per_100m,
                way.step_square, way.turn_square_100, way.pose_square_25, way.pose_square_50,
                way.pose_square_100, way.hidden_length)))
    console().print(table)
    print('scale: of the last tenth over that of the first; t_rel (%) and r_rel (deg per 100 m): '
          'drift;\n  step, turn, pose: squared errors over covariances, median over what it is if '
          'these are true, of a\n  step among its neighbours, of the turn after 100 m, and of '
          'poses after 25, 50 and 100 m in the unit\n  where they begin; no ground: length over '
          'the truth by the height of the camera, while there is none\n  in sight')
