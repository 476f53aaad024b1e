"""``djet lab bench``: speed, as ratios to an OpenCV pipeline in the same run."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from djet_ros.cli.options import (
    add_json_output,
    check_json_output,
    check_least,
    RECORDINGS,
    write_json,
)
from djet_ros.cli.terminal import console, new_table, warn
from djet_ros.lab.bench import bench, QUOTED_POINTS
from rich.console import Console
from rich.table import Table

DESCRIPTION = """\
Measure the time per pair against a plain OpenCV pipeline (ORB, brute-force matching with
cross-check, findEssentialMat, recoverPose), alternating in one run, and how the D-JET stage scales
with the number of matches and the window size. With all cores our next frame is prepared in
parallel to the pair, as in a replay; the OpenCV pipeline is sequential. Writes the results as JSON
and a plot next to it.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('source', type=Path, metavar='SOURCE', help=RECORDINGS)
    parser.add_argument('--pairs', type=int, default=40, metavar='N',
                        help='number of pairs to measure (default: %(default)s)')
    add_json_output(parser)


def run(args: argparse.Namespace) -> int:
    """Measure, write and print the results."""
    check_json_output(args)
    check_least(args, pairs=1)
    with Console(stderr=True).status('measuring ...') as status:
        figures = bench(args.source, args.pairs,
                        lambda stage: status.update(f'measuring with {stage} ...'), warn)
    console().print(_table(figures))
    write_json(args.output, figures, lambda plot: draw(figures, plot))
    return 0


def _table(figures: dict[str, Any]) -> Table:
    both = (figures, figures['all_cores'])
    title = f"{figures['pairs']} pairs: ratios of median times, and mean times"
    table = new_table(title, '', 'one thread', 'all cores')
    table.add_row('time / OpenCV pipeline, preset best',
                  *(f"{run['pipeline_over_opencv']:.2f}" for run in both))
    table.add_row('time / OpenCV pipeline, preset fast',
                  *(f"{run['fast_over_opencv']:.2f}" for run in both))
    table.add_row('pairs per second, preset best',
                  *(f"{run['pairs_per_second']:.1f}" for run in both))
    table.add_row('pairs per second, preset fast',
                  *(f"{run['fast_pairs_per_second']:.1f}" for run in both))
    for stage in figures['stages_ms']:
        table.add_row(f'{stage} [ms]', *(f"{run['stages_ms'][stage]:.1f}" for run in both))
    table.add_row(f'D-JET stage, {QUOTED_POINTS} matches [ms]', f"{figures['djet_stage_ms']:.1f}",
                  '')
    table.add_row(f"speed-up of surfaces ({figures['kernel_tests']} tests per pixel) over "
                  'cv2.ORB.compute (256)', f"{figures['kernel_speedup_over_cv2']:.0f} x", '')
    table.add_row('memory per frame [MB]', f"{figures['bytes_per_frame'] / 1e6:.1f}", '')
    return table


def draw(figures: dict[str, Any], path: Path) -> None:
    """Plot the time of the D-JET stage against the number of points and the window."""
    from djet_ros.lab.style import figure
    with figure(path, 9.0, 3.6) as empty:
        for axes, key, label in zip(empty.subplots(1, 2), ('djet_ms_by_points',
                                                           'djet_ms_by_window'),
                                    ('matches', f'side of the window [px], {QUOTED_POINTS} '
                                     'matches')):
            at, ms = zip(*figures[key].items())
            axes.plot(at, ms, 'o-')
            axes.set(xlabel=label, ylabel='surfaces + optimisation [ms]', ylim=(0, None))
