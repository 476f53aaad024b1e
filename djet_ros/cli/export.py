"""``djet export``: the pose graph of a replay, for a SLAM backend."""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import replace
from pathlib import Path

from djet_ros.cli.options import add_output
from djet_ros.cli.terminal import warn
from djet_ros.posegraph.graph_files import FORMATS, write_graph
from djet_ros.replay.graph_of_results import read_results

DESCRIPTION = """\
Write the pose graph of a replay: a vertex for each tracked frame, and an edge for each pair with
its relative pose and information matrix (inverse covariance). Where the scale is unknown, the
information along the translation is weak. g2o files are read by GTSAM and g2o; csv has the
covariances; tum and kitti have the poses alone. Neighbouring pairs err alike, which a graph does
not know: see --chained.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('results', type=Path, metavar='RESULTS',
                        help="folder that 'djet replay' wrote")
    parser.add_argument('--format', choices=tuple(FORMATS), default='g2o',
                        help='default: %(default)s')
    parser.add_argument('--chained', action='store_true',
                        help='make edges of the odometry as unsure as they have to be where long '
                        'chains of them meet, as djet slam does, in place of what each pair is by '
                        'itself')
    add_output(parser, 'where the graph goes', metavar='FILE')


def run(args: argparse.Namespace) -> int:
    """Write the file, and say what is in it."""
    graph = read_results(args.results, warn)
    if args.chained:
        graph = replace(graph, edges=tuple(edge.in_graph() for edge in graph.edges))
    write_graph(graph, args.output, args.format, args.overwrite)
    kinds = Counter(edge.kind for edge in graph.edges)
    unscaled = sum(not edge.scale_known for edge in graph.edges)
    print(f'{args.output}: {len(graph.poses)} poses, {len(graph.edges)} edges ('
          + ', '.join(f'{count} {kind}' for kind, count in kinds.items())
          + (f'; {unscaled} of unknown length' if unscaled else '') + ')')
    return 0
