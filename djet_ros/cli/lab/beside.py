"""``djet lab beside``: benefit of a gyro and of masks, on rendered scenes."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial

from djet_ros.cli.lab.pair_runs import run_and_record
from djet_ros.cli.options import add_output, add_seeds, add_workers, check_least, split, write_json
from djet_ros.cli.terminal import compact_table, console
from djet_ros.config.flags import add_flags, flag_values
from djet_ros.config.flat import from_flat
from djet_ros.lab.beside import (
    is_wrong,
    Moment,
    NOTHING,
    Row,
    run_trial,
    trial_rows,
    TrialChunk,
    TRIALS,
)
from djet_ros.lab.methods import check_names
from djet_ros.lab.pairs import FAILURE
import numpy as np
from rich.table import Table

# Maximum number of wrong pairs that are listed.
_LISTED = 20

DESCRIPTION = """\
Render sequences that are hard for a camera alone (fast rotations, two seconds of black images, a
lorry that fills half of the image, traffic in front of a stationary camera), and two that are not,
and run the odometry on each without aids, with a gyro (errors of a MEMS in a telephone), or with
an exact mask of moving objects. Writes the results as JSON. An interrupted run is resumed.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('--trials', default=','.join(TRIALS), metavar='LIST',
                        help='sequences to run (default: %(default)s)')
    add_seeds(parser)
    parser.add_argument('--frames', type=int, default=1000, metavar='N',
                        help='maximum number of frames per sequence (default: all, up to 301)')
    add_output(parser, 'folder for the results')
    add_workers(parser)
    add_flags(parser, ('estimator.max_features',))


def run(args: argparse.Namespace) -> int:
    """Run all trials, and print the errors."""
    trials = split(args.trials)
    check_names('trial', trials, TRIALS)
    check_least(args, workers=1, frames=3)
    moments = _moments(args, [TrialChunk(name, seed, args.frames)
                              for name in trials for seed in args.seeds])
    rows = trial_rows(moments)
    _show(rows, moments)
    write_json(args.output / 'beside.json',
               {'seeds': args.seeds, 'rows': [asdict(row) for row in rows]})
    return 0


def _moments(args: argparse.Namespace, chunks: Sequence[TrialChunk]) -> list[Moment]:
    config = from_flat(flag_values(args)).estimator
    settings = {'frames': args.frames, 'estimator': asdict(config)}
    return run_and_record(args, Moment, settings, ('beside.json',), chunks,
                          partial(run_trial, config=config))


def _show(rows: Sequence[Row], moments: Sequence[Moment]) -> None:
    out = console()
    out.print(_pairs(rows))
    print(f'failed: {FAILURE},\n  or a translation of a stationary camera; undetected: failed '
          'pairs that were reported as tracked;\n  stationary: pairs estimated as no motion; rot. '
          'and dir.: errors of rotation and translation\n  direction in degrees, mean and '
          'maximum; ratio: mean rotation error / that without aids.\n  Pairs with a black image '
          'are excluded')
    if any(np.isfinite(row.dark_off_deg) or row.bias_off for row in rows):
        out.print(_dark_and_bias(rows))
        print('dark: largest rotation error in deg since the last image that was not black, and '
              'largest NEES\n  (normalised squared error, expectation 3); bias: final error of '
              'the gyro bias in % of the true bias')
    if wrong := [moment for moment in moments if is_wrong(moment)]:
        out.print(_wrong_pairs(wrong))


def _pairs(rows: Sequence[Row]) -> Table:
    table = compact_table('', 'aid', 'pairs', 'failed', 'undetected', 'stationary', 'rot. mean',
                          'max', 'ratio', 'dir. mean', 'max', names=2)
    alone = {row.trial: row.rotation_deg[0] for row in rows if row.aid == NOTHING}
    for row in rows:
        ratio = row.rotation_deg[0] / max(alone.get(row.trial, float('nan')), 1e-9)
        table.add_row(row.trial, row.aid, *map(str, (
            row.pairs, row.failed, row.wrong, row.stood)),
            *(_figure(value, 4) for value in row.rotation_deg), _figure(ratio, 2),
            *(_figure(value, 3) for value in row.direction_deg))
    return table


def _dark_and_bias(rows: Sequence[Row]) -> Table:
    table = compact_table('', 'aid', 'dark: error', 'NEES', 'bias: error, by seed', names=2)
    for row in rows:
        if np.isfinite(row.dark_off_deg) or row.bias_off:
            table.add_row(row.trial, row.aid, _figure(row.dark_off_deg, 3),
                          _figure(row.dark_surprise, 1),
                          ' '.join(_figure(100 * one, 1) for one in row.bias_off))
    return table


def _wrong_pairs(wrong: Sequence[Moment]) -> Table:
    table = compact_table('undetected failures', 'seed', 'aid', 'frame', 'status', 'rot. deg',
                          'dir. deg', names=2)
    for one in wrong[:_LISTED]:
        table.add_row(one.trial, str(one.seed), one.aid, str(one.frame), one.status,
                      _figure(one.rotation_error_deg, 2), _figure(one.direction_error_deg, 1))
    if len(wrong) > _LISTED:
        table.add_row(f'and {len(wrong) - _LISTED} more')
    return table


def _figure(value: float, digits: int) -> str:
    return f'{value:.{digits}f}' if np.isfinite(value) else '-'
