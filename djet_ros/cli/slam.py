"""``djet slam``: close loops offline and optimise the pose graph with GTSAM."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from djet_ros.cli.options import add_output
from djet_ros.cli.replay import add_replay_options, check_topics, configuration, opened_replay
from djet_ros.cli.terminal import console, new_table, progress_bar, warn
from djet_ros.config.flags import add_flags
from djet_ros.config.flat import flat, shown
from djet_ros.config.safe_files import read_yaml
from djet_ros.config.sections import Config, GRAPH_NAME, NODE_NAME, SLAM_OFFLINE
from djet_ros.config.yaml_files import load_yaml
from djet_ros.errors import DjetError
from djet_ros.libraries import problem_of
from djet_ros.recordings.bags import is_bag
from djet_ros.recordings.outputs import check_room, make_folder, replaced_together
from djet_ros.recordings.recording import open_recording, Recording
from djet_ros.replay.graph_of_results import read_steps
from djet_ros.replay.ground_truth import GroundTruth
from djet_ros.replay.results import SUMMARY as REPLAY_SUMMARY
from rich.table import Table

DESCRIPTION = """\
Close loops offline: select keyframes of the odometry, propose loop candidates by the similarity
of ORB descriptors, verify them with the two-view estimator, and optimise the pose graph of
odometry and loop edges with GTSAM. Writes the trajectory before and after, the graph (g2o, csv), a
plot and slam.json. The scale of a loop edge comes from the depths of the landmarks that it shares
with the odometry; the uncertainty of the odometry's own scale (--scale, --scale-uncertainty)
decides how far loops may change it.
"""

_REPLAY_FLAGS = ('estimator.method', 'preset', 'odometry.scale', 'odometry.scale_value',
                 'odometry.camera_height', 'odometry.camera_pitch',
                 'odometry.scale_uncertainty', 'odometry.residual_k1', 'odometry.gray_range',
                 'odometry.mask', 'odometry.mask_file')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('input', type=Path, metavar='RESULTS_OR_RECORDING',
                        help="results folder of 'djet replay', or a recording to replay first")
    add_output(parser, 'folder for the results', 'slam')
    parser.add_argument('--source', type=Path, metavar='RECORDING',
                        help='path of the recording that RESULTS are of, if it was moved')
    add_replay_options(parser, _REPLAY_FLAGS)
    add_flags(parser.add_argument_group('keyframes and loops'), SLAM_OFFLINE)


def run(args: argparse.Namespace) -> int:
    """Close loops, with progress on stderr, and print a summary."""
    if problem := problem_of('gtsam'):
        raise DjetError(problem)
    # They import GTSAM, without which the help is shown and the check above is reached.
    from djet_ros.lab.slam_report import FILES, PLOT, write_report
    from djet_ros.posegraph.offline import run_slam
    check_room(args.output, FILES, args.overwrite)
    # Earlier results of slam would not belong to a new replay.
    results, config = _replayed(args, derived=[args.output / name for name in FILES])
    source, name = _source(results, args, config)
    with source:
        steps = read_steps(results, warn)
        make_folder(args.output)
        with progress_bar('frames') as progress:
            slam = run_slam(steps, source, config, progress, args.output)
        truth = GroundTruth.of(source, warn).at(slam.frames.stamps_ns)
    with replaced_together(args.output, FILES, args.overwrite) as new:
        summary = write_report(new, slam, truth, name, config)
    console().print(_table(summary))
    if summary['edges'].get('loop', 0) == summary['rejected'].get('loop', 0):
        print('no loop was closed: prefer before_tum.txt, the odometry, since the graph does '
              'not have its landmarks')
    print(f'results: {args.output}\nplot: {args.output / PLOT}')
    return 0


def _replayed(args: argparse.Namespace, derived: Iterable[Path]) -> tuple[Path, Config]:
    """Return the results to use and their parameters; replay the input if it is a recording."""
    if (args.input / 'frames.csv').is_file():
        return args.input, _with_loop_parameters(args, args.input)
    config, results = configuration(args, NODE_NAME, GRAPH_NAME), args.output / 'replay'
    with opened_replay(args, config, args.input, results, derived=derived) as replay:
        outcome = replay()
    for line in outcome.advice:
        warn(line)
    if outcome.problem and not outcome.summary['frames']:
        raise DjetError(outcome.problem)
    if outcome.problem:
        # As of results: what could be replayed is used.
        warn(outcome.problem)
    return results, config


def _with_loop_parameters(args: argparse.Namespace, results: Path) -> Config:
    """Return the parameters of a replay, of which --config and flags may change slam.* only."""
    replayed = load_yaml(results / 'config.yaml')
    config = configuration(args, NODE_NAME, GRAPH_NAME, base=replayed)
    wanted = flat(config)
    for name, item in flat(replayed).items():
        if wanted[name].value != item.value and not name.startswith('slam.'):
            raise DjetError(f'{results} holds the results of a replay, whose parameters cannot be '
                            f'changed, but those of slam: {name} was {shown(item.value)}, and is '
                            f'{shown(wanted[name].value)} now; name the recording, to replay it '
                            'so')
    return config


def _source(results: Path, args: argparse.Namespace, config: Config) -> tuple[Recording, str]:
    """Open the recording that the results are of; return it and its name."""
    summary = read_yaml(results / REPLAY_SUMMARY)
    replayed, topic = (summary.get(what) if isinstance(summary, dict) else None
                       for what in ('source', 'image_topic'))
    name = replayed if isinstance(replayed, str) else args.source and str(args.source)
    if name is None:
        raise DjetError(f'{results / REPLAY_SUMMARY} does not name the replayed recording; '
                        'name it with --source')
    auxiliary = {'mask': args.mask_topic} if config.odometry.mask else {}
    if results == args.input:
        check_topics(args, auxiliary)
    path = args.source or Path(name)
    if not path.exists():
        raise DjetError(f'{path}, the recording that {results} was replayed from, does not exist; '
                        'name its new path with --source')
    if not is_bag(path) or not isinstance(topic, str):
        topic = None
    return (open_recording(path, args.image_topic or topic, args.info_topic, args.poses, auxiliary,
                           damaged=True), name)


def _table(summary: dict[str, Any]) -> Table:
    table = new_table(f"{Path(summary['source']).name}: scale {summary['scale']}", '', 'before',
                      'after')
    table.add_row('keyframes', '', f"{summary['keyframes']} of {summary['frames']}")
    for kind, number in sorted(summary['edges'].items()):
        rejected = summary['rejected'].get(kind, 0)
        table.add_row(f'edges: {kind}', '',
                      f'{number}, {rejected} rejected as outliers' if rejected else str(number))
    if 'errors' in summary:
        before, after = summary['errors']['before'], summary['errors']['after']
        for name in before:
            table.add_row(_TITLES[name], f'{before[name]:.4f}', f'{after[name]:.4f}')
    return table


_TITLES = {'ape_m': 'APE, RMSE in m', 'evo_ape_m': 'evo: APE, RMSE in m',
           'evo_rpe_m': 'evo: RPE, RMSE in m', 'evo_rpe_deg': 'evo: RPE, RMSE in deg'}
