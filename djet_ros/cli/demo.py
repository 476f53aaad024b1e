"""``djet demo``: render, convert, replay and compare, by running the other commands."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
import shlex
from typing import Any

from djet_ros.cli import main
from djet_ros.cli.options import add_output
from djet_ros.cli.terminal import console, new_table, spread
from djet_ros.errors import DjetError
from djet_ros.replay.results import PLOT, SUMMARY
from rich.table import Table

DESCRIPTION = """\
Render a road with exact ground truth (or take a KITTI sequence), convert it to a bag, replay the
bag with D-JET and with re-projection error (RP-E), and compare their errors.
"""

METHODS = ('djet', 'rpe')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('sequence', nargs='?', type=Path, metavar='SEQUENCE_DIR',
                        help='KITTI sequence, such as sequences/00 (default: render a road)')
    add_output(parser, 'folder for everything that is written', 'demo')


def run(args: argparse.Namespace) -> int:
    """Run the commands in order, then print the errors of both methods side by side."""
    overwrite = ['--overwrite'] if args.overwrite else []
    sequence = args.sequence
    if sequence is None:
        _djet('lab', 'render', 'road', args.output / 'rendered', *overwrite)
        sequence, = (args.output / 'rendered' / 'sequences').iterdir()
    bag = args.output / 'bag'
    _djet('kitti-to-bag', sequence, bag, *overwrite)
    results = {method: args.output / method for method in METHODS}
    for method, folder in results.items():
        _djet('replay', bag, '--output', folder, '--method', method, *overwrite)

    console().print(_comparison({method: json.loads((folder / SUMMARY).read_text('utf-8'))
                                 for method, folder in results.items()}))
    for folder in results.values():
        print(f'plot: {folder / PLOT}')
    return 0


def _djet(*arguments: str | Path) -> None:
    words = [str(argument) for argument in arguments]
    print(f'\n$ djet {shlex.join(words)}', flush=True)
    code = main.run(words)
    if code:
        raise DjetError(f"the demo stopped: 'djet {arguments[0]}' failed with exit code {code}")


def _comparison(summaries: dict[str, dict[str, Any]]) -> Table:
    table = new_table('errors against ground truth, in degrees: mean / median / p95 / max',
                      'method', 'pairs', 'pairs/s', 'rotation', 'translation direction')
    for method, summary in summaries.items():
        rate = summary['pairs'] / summary['seconds']
        table.add_row(method, str(summary['pairs']), f'{rate:.1f}',
                      spread(summary.get('rotation_error_deg')),
                      spread(summary.get('translation_error_deg')))
    return table
