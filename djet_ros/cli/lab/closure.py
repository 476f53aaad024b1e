"""``djet lab closure``: rotation closure error of frame triplets, without ground truth."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from djet_ros.cli.options import (
    add_json_output,
    check_json_output,
    check_least,
    RECORDINGS,
    split,
    write_json,
)
from djet_ros.cli.terminal import console, new_table, progress_bar, warn
from djet_ros.core.estimator_config import METHODS
from djet_ros.lab.closure import closures, summary, Triangle
from djet_ros.lab.methods import check_names, TITLES
from djet_ros.lab.sequences import plain_name, readable_frames
import numpy as np
from rich.table import Table

# The 5-point method has no meaningful covariance.
CHOICES = tuple(name for name in METHODS if name != 'five_point')

DESCRIPTION = """\
The rotation from frame i to i + 2 must equal the product of those from i to i + 1 and i + 1 to
i + 2. Print the closure error by method: a lower bound of the rotation error on any recording,
without ground truth, and a consistency check of the covariances. Writes all triplets as JSON and a
plot next to it.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('source', type=Path, metavar='SOURCE', help=RECORDINGS)
    parser.add_argument('--methods', default=','.join(CHOICES), metavar='LIST',
                        help='methods to compare (default: %(default)s)')
    parser.add_argument('--frames', type=int, default=150, metavar='N',
                        help='number of frames to use, from the first (default: %(default)s)')
    add_json_output(parser)


def run(args: argparse.Namespace) -> int:
    """Estimate the triplets, write and print their closure errors."""
    check_json_output(args)
    check_least(args, frames=3)
    methods, name = split(args.methods), plain_name(args.source)
    check_names('method', methods, CHOICES)
    with TemporaryDirectory() as workspace:
        sequence = readable_frames(args.source, Path(workspace), warn)
        with progress_bar('triplets', max(min(args.frames, len(sequence)) - 2, 1)) as progress:
            found = closures(sequence, methods, args.frames, progress)
    summaries = {method: summary(triangles) for method, triangles in found.items()}
    console().print(_table(name, summaries))
    print('sigma: median standard deviation of the closure error by the covariances; NEES: mean '
          'normalised\nsquared closure error, expectation 3; error: median error of single '
          'rotations against ground truth,\nif there is any')
    write_json(args.output, {
        'source': name, 'summary': summaries,
        'triangles': {method: [triangle and asdict(triangle) for triangle in triangles]
                      for method, triangles in found.items()}},
               lambda plot: draw(found, name, plot))
    return 0


def _table(title: str, summaries: dict[str, dict[str, Any]]) -> Table:
    table = new_table(f'{title}: rotation closure error, deg', '', 'median', '95 %',
                      'sigma', 'NEES (3)', 'triplets', 'error')
    for method, one in summaries.items():
        table.add_row(
            TITLES[method], f"{one['median_deg']:.4f}", f"{one['p95_deg']:.4f}",
            f"{one['claimed_median_deg']:.4f}", f"{one['normalised_square_mean']:.1f}",
            f"{one['triangles']} of {one['triangles'] + one['without']}",
            '' if np.isnan(one['error_median_deg']) else f"{one['error_median_deg']:.4f}")
    return table


def draw(found: dict[str, list[Triangle | None]], title: str, path: Path) -> None:
    """Plot the cumulative distribution of closure errors, and their ratio to sigma."""
    from djet_ros.lab.style import COLOURS, DASHES, figure
    with figure(path, 8.0, 3.2) as empty:
        left, right = empty.subplots(1, 2)
        for method, triangles in found.items():
            look = {'label': TITLES[method], 'color': COLOURS[method], 'ls': DASHES[method]}
            closed = [triangle for triangle in triangles if triangle is not None]
            shares = 100 * np.arange(1, len(closed) + 1) / len(triangles)
            left.step(np.sort([t.angle for t in closed]), shares, where='post', **look)
            right.plot([t.first for t in closed],
                       [t.angle / t.claimed for t in closed], lw=0.8, **look)
        left.set(xscale='log', xlabel='rotation closure error [deg]', ylim=(0, 100),
                 ylabel='share of triplets [%]', title=title)
        left.legend()
        right.set(xlabel='first frame', ylabel='closure error / sigma', ylim=(0, None),
                  title='against the covariances')
