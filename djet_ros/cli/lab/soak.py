"""``djet lab soak``: memory and latency in a long run."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from djet_ros.cli.options import add_json_output, check_json_output, write_json
from djet_ros.cli.terminal import progress_bar
from djet_ros.lab.soak import SIZE, soak

DESCRIPTION = f"""\
Run many rendered frames of {SIZE[0]}x{SIZE[1]} through the odometry, including black images, gaps
and stamps that jump back, and record memory and latency. Writes the results as JSON and a plot
next to it. The exit code is 1 if memory grows beyond the limit.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('--frames', type=int, default=20_000, metavar='N',
                        help='frames to process (default: %(default)s)')
    parser.add_argument('--max-growth', type=float, default=10.0, metavar='MB',
                        help='largest growth of resident memory after the first fifth of the '
                        'frames (default: %(default)s)')
    add_json_output(parser)


def run(args: argparse.Namespace) -> int:
    """Run, write and print the results."""
    check_json_output(args)
    with progress_bar('frames', args.frames) as progress:
        figures = soak(args.frames, args.max_growth, progress)
    latency = figures['latency_ms']
    print(f"{figures['frames']} frames in {figures['seconds']:.0f} s; latency p50 "
          f"{latency['p50_ms']:.1f}, p95 {latency['p95_ms']:.1f}, p99 {latency['p99_ms']:.1f}, "
          f"max {latency['max_ms']:.1f} ms\n"
          f"memory {figures['memory_mb']:.1f} MB, growth {figures['growth_mb']:.1f} MB "
          f"(limit {figures['most_growth_mb']:g} MB): "
          f"{'passed' if figures['held'] else 'FAILED'}")
    write_json(args.output, figures, lambda plot: draw(figures, plot))
    return 0 if figures['held'] else 1


def draw(figures: dict[str, Any], path: Path) -> None:
    """Plot memory and latency against the frames."""
    from djet_ros.lab.style import figure
    stretches = figures['stretches']
    frames = [stretch['frames'] for stretch in stretches]
    with figure(path, 8.0, 3.2) as empty:
        memory, latency = empty.subplots(1, 2)
        memory.plot(frames, [stretch['memory_mb'] for stretch in stretches], 'o-')
        memory.set(xlabel='frames', ylabel='resident memory [MB]', ylim=(0, None))
        for name, label in (('p50_ms', 'median'), ('p95_ms', '95 %'), ('p99_ms', '99 %')):
            latency.plot(frames, [stretch[name] for stretch in stretches], label=label)
        latency.set(xlabel='frames', ylabel='latency of a frame [ms]', ylim=(0, None))
        latency.legend()
