"""``djet lab beside``: what a gyro and masks are good for."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
import json

from djet_ros.cli.lab.pair_runs import recorded
from djet_ros.cli.options import add_output, add_seeds, add_workers, check_workers, split
from djet_ros.cli.terminal import compact_table, console
from djet_ros.config.flags import add_flags, flag_values
from djet_ros.config.flat import from_flat
from djet_ros.errors import DjetError
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
from djet_ros.lab.pairs import FAILURE
from djet_ros.recordings.outputs import make_folder, write_whole
import numpy as np
from rich.table import Table

# Pairs that are listed one by one at most.
_LISTED = 20

DESCRIPTION = """\
Render ways through scenes that are hard for a camera alone (fast turns, two seconds of black
images, a lorry that fills half of the picture, traffic before a camera that stands), and two that
are not, and run the odometry through each with and without a gyro of a telephone's errors, or with
an exact mask of what moves. Writes all of it as JSON. A run that was broken off is taken up where
it ended.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('--trials', default=','.join(TRIALS), metavar='LIST',
                        help='(default: %(default)s)')
    add_seeds(parser)
    parser.add_argument('--frames', type=int, default=1000, metavar='N',
                        help='of each trial at most (default: all, up to 301)')
    add_output(parser, 'folder of the results')
    add_workers(parser)
    add_flags(parser, ('estimator.max_features',))


def run(args: argparse.Namespace) -> int:
    """Run all trials, and show what became of them."""
    trials = split(args.trials)
    if unknown := [name for name in trials if name not in TRIALS]:
        raise DjetError(f"--trials has '{unknown[0]}'; choose of {', '.join(TRIALS)}")
    check_workers(args)
    if args.frames < 3:
        raise DjetError(f'--frames is {args.frames}; at least three are needed')
    make_folder(args.output)
    moments = _moments(args, [TrialChunk(name, seed, args.frames)
                              for name in trials for seed in args.seeds])
    rows = trial_rows(moments)
    _show(rows, moments)
    path = args.output / 'beside.json'
    write_whole(path, json.dumps({'seeds': args.seeds, 'rows': [asdict(row) for row in rows]},
                                 indent=1) + '\n')
    print(f'figures: {path}')
    return 0


def _moments(args: argparse.Namespace, chunks: Sequence[TrialChunk]) -> list[Moment]:
    config = from_flat(flag_values(args)).estimator
    settings = {'frames': args.frames, 'estimator': asdict(config)}
    return recorded(args, Moment, settings, chunks, partial(run_trial, config=config))


def _show(rows: Sequence[Row], moments: Sequence[Moment]) -> None:
    out = console()
    out.print(_pairs(rows))
    print(f'failed: {FAILURE},\n  or a way where there was none; wrong: of those, the ones told '
          'as if they were right; stood: told\n  as no motion; turn and way: errors of rotation '
          'and direction in degrees, mean and worst of what\n  was told; ratio: of the mean, over '
          'that with nothing; black images are not among these pairs')
    if any(np.isfinite(row.dark_off_deg) or row.bias_off for row in rows):
        out.print(_beyond(rows))
        print('dark: worst turn since it was light, and its squared error over its covariance, 3 '
              'on average if\n  that is true; bias: how far off at the end, as a share of the '
              'true one')
    if wrong := [moment for moment in moments if is_wrong(moment)]:
        out.print(_list_of(wrong))


def _pairs(rows: Sequence[Row]) -> Table:
    table = compact_table('', 'with', 'pairs', 'failed', 'wrong', 'stood', 'turn', 'worst',
                          'ratio', 'way', 'worst', names=2)
    alone = {row.trial: row.rotation_deg[0] for row in rows if row.aid == NOTHING}
    for row in rows:
        ratio = row.rotation_deg[0] / max(alone.get(row.trial, float('nan')), 1e-9)
        table.add_row(row.trial, row.aid, *map(str, (
            row.pairs, row.failed, row.wrong, row.stood)),
            *(_figure(value, 4) for value in row.rotation_deg), _figure(ratio, 2),
            *(_figure(value, 3) for value in row.direction_deg))
    return table


def _beyond(rows: Sequence[Row]) -> Table:
    table = compact_table('', 'with', 'dark: off deg', 'square', 'bias: off %, by seed', names=2)
    for row in rows:
        if np.isfinite(row.dark_off_deg) or row.bias_off:
            table.add_row(row.trial, row.aid, _figure(row.dark_off_deg, 3),
                          _figure(row.dark_surprise, 1),
                          ' '.join(_figure(100 * one, 1) for one in row.bias_off))
    return table


def _list_of(wrong: Sequence[Moment]) -> Table:
    table = compact_table('wrong', 'seed', 'with', 'frame', 'status', 'rotation deg',
                          'direction deg', names=2)
    for one in wrong[:_LISTED]:
        table.add_row(one.trial, str(one.seed), one.aid, str(one.frame), one.status,
                      _figure(one.rotation_error_deg, 2), _figure(one.direction_error_deg, 1))
    if len(wrong) > _LISTED:
        table.add_row(f'and {len(wrong) - _LISTED} more')
    return table


def _figure(value: float, digits: int) -> str:
    return f'{value:.{digits}f}' if np.isfinite(value) else '-'
