"""``djet lab evaluate``: the paper's Table 1 on any sequences with ground truth."""

from __future__ import annotations

import argparse

from djet_ros.cli.lab.pair_runs import add_run_arguments, evaluated, shared_values, show
from djet_ros.cli.options import split
from djet_ros.lab.evo import find_tool
from djet_ros.lab.methods import default_methods, make_methods, TITLES
from djet_ros.lab.report import FILES, write_report

DESCRIPTION = """\
Estimate the relative pose of all consecutive frames by several methods on the same matches, and
by complete pipelines of other libraries (sift_poselib, klt_poselib) on the same images, compare
with ground truth, and write tables, plots, trajectories and index.html; also the drift per 100 m
of paths that are long enough. An interrupted run is resumed.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    add_run_arguments(parser)
    parser.add_argument('--methods', metavar='LIST',
                        help=f'methods to compare, of {", ".join(TITLES)} (default: all that are '
                        'installed)')
    parser.add_argument('--evo', action='store_true',
                        help='add APE and RPE of the trajectories, computed by evo')


def run(args: argparse.Namespace) -> int:
    """Evaluate, and print the tables."""
    methods = default_methods() if args.methods is None else split(args.methods)
    competing = make_methods(methods, split(args.presets), shared_values(args))
    if args.evo:
        find_tool('evo_ape')
    with evaluated(args, competing, FILES) as (datasets, records):
        tables = write_report(args.output, datasets, competing, records, with_evo=args.evo)
    show(tables, args.output)
    return 0
