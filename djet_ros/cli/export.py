"""``djet export``: write the pose graph of a replay for a SLAM back end."""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import replace
from pathlib import Path

from djet_ros.cli.options import add_output
from djet_ros.cli.terminal import warn
from djet_ros.posegraph.graph_files import FORMATS, write_graph
from djet_ros.recordings.outputs import check_file
from djet_ros.replay.graph_of_results import read_results
from djet_ros.replay.results import NAMES

DESCRIPTION = """\
Write the pose graph of a replay: a vertex for each tracked frame, and an edge for each pair with
its relative pose and information matrix (inverse covariance). If the scale is unknown, the
information along the translation direction is weak. g2o files are read by GTSAM and g2o; csv has
the covariances; tum and kitti have the poses only. Errors of neighbouring pairs are correlated,
which a pose graph cannot express: see --chained.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('results', type=Path, metavar='RESULTS',
                        help="folder that 'djet replay' wrote")
    parser.add_argument('--format', choices=tuple(FORMATS), default='g2o',
                        help='default: %(default)s')
    parser.add_argument('--chained', action='store_true',
                        help='inflate the covariances of odometry edges for the correlation of '
                        'their errors, so that long chains of them have a realistic covariance, '
                        'as djet slam does (default: the covariance of each pair by itself)')
    add_output(parser, 'file of the pose graph', metavar='FILE')


def run(args: argparse.Namespace) -> int:
    """Write the file, and print the number of poses and edges."""
    check_file(args.output, args.overwrite, inputs=(args.results / name for name in NAMES))
    graph = read_results(args.results, warn)
    if args.chained:
        graph = replace(graph, edges=tuple(edge.inflated() for edge in graph.edges))
    write_graph(graph, args.output, args.format, args.overwrite)
    kinds = Counter(edge.kind for edge in graph.edges)
    unscaled = sum(not edge.scale_known for edge in graph.edges)
    print(f'{args.output}: {len(graph.poses)} poses, {len(graph.edges)} edges ('
          + ', '.join(f'{count} {kind}' for kind, count in kinds.items())
          + (f'; {unscaled} of unknown scale' if unscaled else '') + ')')
    return 0
