"""``djet bench``: ratios of speed, from one run."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from djet_ros.cli.outputs import add_json_output, write_json
from djet_ros.errors import DjetError
from djet_ros.lab.bench import bench, QUOTED_POINTS
from djet_ros.recordings.outputs import check_file
from rich.console import Console
from rich.table import Table


def add_parser(subparsers: Any) -> None:
    """Add the subcommand to the subparsers of ``djet``."""
    parser = subparsers.add_parser(
        'bench', description='Measure the pipeline against the plain chain of OpenCV (ORB, '
        'brute-force cross-check, findEssentialMat, recoverPose), pair by pair in one run, and '
        'how the D-JET stage grows with points and window. Writes the figures as JSON and a plot '
        'beside them.')
    parser.add_argument('source', type=Path, metavar='SOURCE', help='folder such as sequences/00')
    parser.add_argument('--pairs', type=int, default=40, metavar='N',
                        help='pairs to measure (default: %(default)s)')
    add_json_output(parser, 'figures')


def run(args: argparse.Namespace) -> int:
    """Measure, write and show the figures."""
    check_file(args.output, args.overwrite)
    if args.pairs < 1:
        raise DjetError(f'--pairs is {args.pairs}; it must be at least 1')
    args.output.parent.mkdir(parents=True, exist_ok=True)
    console = Console()
    with console.status('measuring ...') as status:
        figures = bench(args.source, args.pairs,
                        lambda stage: status.update(f'measuring with {stage} ...'))
    plot = write_json(args.output, figures)
    draw(figures, plot)
    console.print(_table(figures))
    print(f'figures: {args.output}\nplot: {plot}')
    return 0


def _table(figures: dict[str, Any]) -> Table:
    both = (figures, figures['all_cores'])
    table = Table(title=f"{figures['pairs']} pairs, medians")
    for heading in ('', 'one thread', 'all cores'):
        table.add_column(heading, justify='right' if heading else 'left')
    table.add_row('pipeline over OpenCV chain',
                  *(f"{run['pipeline_over_opencv']:.2f}" for run in both))
    table.add_row('pairs per second', *(f"{run['pairs_per_second']:.1f}" for run in both))
    for stage in figures['stages_ms']:
        table.add_row(f'{stage} [ms]', *(f"{run['stages_ms'][stage]:.1f}" for run in both))
    table.add_row(f'D-JET stage, {QUOTED_POINTS} points [ms]', f"{figures['djet_stage_ms']:.1f}",
                  '')
    table.add_row('kernel over cv2.ORB.compute', f"{figures['kernel_speedup_over_cv2']:.0f} x", '')
    table.add_row('memory per frame [MB]', f"{figures['bytes_per_frame'] / 1e6:.1f}", '')
    return table


def draw(figures: dict[str, Any], path: Path) -> None:
    """Plot the time of the D-JET stage against the number of points and the window."""
    from matplotlib.figure import Figure
    figure = Figure(figsize=(9, 3.6), layout='constrained')
    left, right = figure.subplots(1, 2, sharey=False)
    for axes, key, label in ((left, 'djet_ms_by_points', 'matches'),
                             (right, 'djet_ms_by_window', 'side of the window [px]')):
        at, ms = zip(*figures[key].items())
        axes.plot([int(value) for value in at], ms, 'o-', color='tab:blue')
        axes.set(xlabel=label, ylabel='surfaces + optimisation [ms]', ylim=(0, None))
        axes.grid(alpha=0.3)
    left.set_title('against points')
    right.set_title(f'against window ({QUOTED_POINTS} points)')
    figure.savefig(path, dpi=120)
