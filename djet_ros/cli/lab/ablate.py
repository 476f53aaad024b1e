"""``djet lab ablate``: ablation study of D-JET, with the paper's Table 2."""

from __future__ import annotations

import argparse

from djet_ros.cli.lab.pair_runs import add_run_arguments, evaluated, shared_values, show
from djet_ros.cli.options import split
from djet_ros.errors import DjetError
from djet_ros.lab.ablation import ablation_methods, PARTS
from djet_ros.lab.ablation_report import FILES, write_ablation

DESCRIPTION = """\
Estimate the relative pose of all consecutive frames by D-JET with the parameters of a preset, and
with one change at a time: sampling window, step strategy, robust loss, and all other parameters
in which presets differ. RP-E and the 5-point method are included for comparison. An interrupted
run is resumed.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    add_run_arguments(parser)
    parser.add_argument('--windows', default='3,5,7,15', metavar='LIST',
                        help='sides of the sampling window in pixels, odd (default: %(default)s)')
    parser.add_argument('--parts', default=','.join(PARTS), metavar='LIST',
                        help='parts of the method to vary (default: %(default)s)')
    parser.add_argument('--good-start', action='store_true',
                        help='start all variants from the pose of RP-E, preset best, with only '
                        'its inliers as matches, to isolate the effect of the surfaces')


def run(args: argparse.Namespace) -> int:
    """Run all variants, and print the tables."""
    competing = ablation_methods(split(args.presets), split(args.parts), _windows(args.windows),
                                 shared_values(args), good_start=args.good_start)
    with evaluated(args, competing, FILES) as (datasets, records):
        tables = write_ablation(args.output, datasets, competing, records)
    show(tables, args.output)
    return 0


def _windows(text: str) -> list[int]:
    try:
        return [int(word) for word in split(text)]
    except ValueError:
        raise DjetError(f"--windows is '{text}'; write odd integers such as 3,5,7") from None
