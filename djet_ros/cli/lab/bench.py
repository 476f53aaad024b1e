"""``djet lab bench``: ratios of speed, from one run."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from djet_ros.cli.options import add_json_output, check_json_output, write_json
from djet_ros.cli.terminal import console, new_table
from djet_ros.errors import DjetError
from djet_ros.lab.bench import bench, QUOTED_POINTS
from rich.console import Console
from rich.table import Table

DESCRIPTION = """\
Measure the pipeline against the plain chain of OpenCV (ORB, brute-force cross-check,
findEssentialMat, recoverPose), pair by pair in one run, and how the D-JET stage grows with points
and window. With all cores our next frame is prepared beside the pair, as in a replay; OpenCV's
chain takes its frames in turn. Writes the figures as JSON and a plot beside them.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('source', type=Path, metavar='SOURCE', help='a sequence or a bag')
    parser.add_argument('--pairs', type=int, default=40, metavar='N',
                        help='pairs to measure (default: %(default)s)')
    add_json_output(parser)


def run(args: argparse.Namespace) -> int:
    """Measure, write and show the figures."""
    check_json_output(args)
    if args.pairs < 1:
        raise DjetError(f'--pairs is {args.pairs}; it must be at least 1')
    with Console(stderr=True).status('measuring ...') as status:
        figures = bench(args.source, args.pairs,
                        lambda stage: status.update(f'measuring with {stage} ...'))
    console().print(_table(figures))
    write_json(args.output, figures, lambda plot: draw(figures, plot))
    return 0


def _table(figures: dict[str, Any]) -> Table:
    both = (figures, figures['all_cores'])
    title = f"{figures['pairs']} pairs: ratios of medians, mean times"
    table = new_table(title, '', 'one thread', 'all cores')
    table.add_row('pipeline over OpenCV chain',
                  *(f"{run['pipeline_over_opencv']:.2f}" for run in both))
    table.add_row('the same, preset fast', *(f"{run['fast_over_opencv']:.2f}" for run in both))
    table.add_row('pairs per second', *(f"{run['pairs_per_second']:.1f}" for run in both))
    table.add_row('the same, preset fast', *(f"{run['fast_pairs_per_second']:.1f}"
                                             for run in both))
    for stage in figures['stages_ms']:
        table.add_row(f'{stage} [ms]', *(f"{run['stages_ms'][stage]:.1f}" for run in both))
    table.add_row(f'D-JET stage, {QUOTED_POINTS} points [ms]', f"{figures['djet_stage_ms']:.1f}",
                  '')
    table.add_row(f"{figures['kernel_tests']} tests of a pixel over cv2.ORB.compute's 256",
                  f"{figures['kernel_speedup_over_cv2']:.0f} x", '')
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
