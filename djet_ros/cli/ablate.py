"""``djet ablate``: the paper's Table 2, and what each part of D-JET contributes."""

from __future__ import annotations

import argparse
from typing import Any

from djet_ros.cli.pair_runs import (
    add_run_arguments,
    evaluated,
    print_table,
    shared_values,
    split,
)
from djet_ros.errors import DjetError
from djet_ros.lab.ablation import ablation_methods, PARTS
from djet_ros.lab.ablation_report import write_ablation
from rich.console import Console

DESCRIPTION = """\
Estimate the relative pose of all neighbouring frames by D-JET as a preset has it, and with one
change at a time: sampling area, step strategy, robust loss, and whatever else tells the presets
apart. RP-E and the 5-point method stand beside it. A run that was broken off is taken up where it
ended.
"""


def add_parser(subparsers: Any) -> None:
    """Add the subcommand to the subparsers of ``djet``."""
    parser = subparsers.add_parser('ablate', description=DESCRIPTION)
    add_run_arguments(parser)
    parser.add_argument('--windows', default='3,5,7,15', metavar='LIST',
                        help='sides of the sampling area in pixels, odd (default: %(default)s)')
    parser.add_argument('--parts', default=','.join(PARTS), metavar='LIST',
                        help='what is changed (default: %(default)s)')
    parser.add_argument('--good-start', action='store_true',
                        help='give all variants the pose of RP-E, preset best, as a start, and '
                        'only the matches that agree with it: what is left is the effect of the '
                        'surfaces')


def run(args: argparse.Namespace) -> int:
    """Run all variants, and print the tables."""
    competing = ablation_methods(split(args.presets), split(args.parts), _windows(args.windows),
                                 shared_values(args), good_start=args.good_start)
    with evaluated(args, competing) as (datasets, records):
        tables = write_ablation(args.output, datasets, competing, records)
    console = Console()
    for table in tables:
        print_table(console, table)
    console.print(f'page: {args.output / "index.html"}', soft_wrap=True)
    return 0


def _windows(text: str) -> list[int]:
    try:
        return [int(word) for word in split(text)]
    except ValueError:
        raise DjetError(f"--windows is '{text}'; give odd numbers such as 3,5,7") from None
