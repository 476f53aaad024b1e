"""``djet slam``: loops closed and the trajectory optimised, by GTSAM."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from djet_ros.cli.options import add_output
from djet_ros.cli.replay import add_replay_options, check_topics, configured, prepared
from djet_ros.cli.terminal import console, new_table, progress_bar, warn
from djet_ros.config.flags import add_flags, flag_values
from djet_ros.config.flat import with_values
from djet_ros.config.safe_files import read_yaml
from djet_ros.config.sections import Config, GRAPH_NAME, NODE_NAME
from djet_ros.config.yaml_files import load_yaml
from djet_ros.errors import DjetError
from djet_ros.lab.slam_report import FILES, PLOT, write_report
from djet_ros.posegraph.offline import PARAMETERS, run_slam
from djet_ros.recordings.bags import is_bag
from djet_ros.recordings.outputs import check_room, make_folder, make_room
from djet_ros.recordings.recording import open_recording, Recording
from djet_ros.replay.graph_of_results import read_steps
from djet_ros.replay.ground_truth import GroundTruth
from djet_ros.replay.results import SUMMARY as REPLAY_SUMMARY
from rich.table import Table

DESCRIPTION = """\
Close loops offline: take the odometry's keyframes, propose places seen before by their ORB
descriptors, verify them with the two-view estimator, and optimise the graph of odometry and loops
with GTSAM. Writes the trajectory before and after, the graph (g2o, csv), a plot and slam.json.
Loops get their length from the depths that the odometry gives to the points they share; how well
the odometry's own lengths are known (--scale, --scale-uncertainty) decides what loops may change.
"""

_REPLAY_FLAGS = ('estimator.method', 'preset', 'odometry.scale', 'odometry.scale_value',
                 'odometry.camera_height', 'odometry.camera_pitch',
                 'odometry.scale_uncertainty', 'odometry.residual_k1', 'odometry.gray_range',
                 'odometry.mask', 'odometry.mask_file')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('input', type=Path, metavar='RESULTS_OR_RECORDING',
                        help="folder that 'djet replay' wrote, or what it can replay")
    add_output(parser, 'folder of what is written', 'slam')
    parser.add_argument('--source', type=Path, metavar='RECORDING',
                        help='where the recording of RESULTS is now, if it was moved')
    add_replay_options(parser, _REPLAY_FLAGS)
    add_flags(parser.add_argument_group('keyframes and loops'), PARAMETERS)


def run(args: argparse.Namespace) -> int:
    """Run, with progress on stderr, and show what came of it."""
    given = flag_values(args)
    of_slam = {name: given.pop(name) for name in PARAMETERS if name in given}
    config = configured(args, NODE_NAME, GRAPH_NAME)
    check_room(args.output, FILES, args.overwrite)
    results = args.input
    if (results / 'frames.csv').is_file():
        if args.config or given:
            raise DjetError(f'{results} holds results, which have their parameters already; give '
                            'the recording itself, to replay it with others')
    else:
        results = args.output / 'replay'
        with prepared(args, config, args.input, results) as replay:
            # They would be of another replay than the one beside them.
            make_room(args.output, FILES, args.overwrite)
            outcome = replay()
        if outcome.problem:
            raise DjetError(outcome.problem)
    config = with_values(load_yaml(results / 'config.yaml'), of_slam)
    source, name = _source(results, args, config)
    try:
        steps = read_steps(results, warn)
        make_folder(args.output)
        with progress_bar('frames') as progress:
            slam = run_slam(steps, source, config, progress, args.output)
        truth = GroundTruth.of(source).at(slam.frames.stamps_ns)
    finally:
        source.close()
    make_room(args.output, FILES, args.overwrite)
    summary = write_report(args.output, slam, truth, name, config)
    console().print(_table(summary))
    print(f'results: {args.output}\nplot: {args.output / PLOT}')
    return 0


def _source(results: Path, args: argparse.Namespace, config: Config) -> tuple[Recording, str]:
    """Open the recording that results are of, and give its name too."""
    summary = read_yaml(results / REPLAY_SUMMARY)
    replayed, topic = (summary.get(what) if isinstance(summary, dict) else None
                       for what in ('source', 'image_topic'))
    name = replayed if isinstance(replayed, str) else args.source and str(args.source)
    if name is None:
        raise DjetError(f'{results / REPLAY_SUMMARY} does not say which recording was replayed; '
                        'say it with --source')
    beside = {'mask': args.mask_topic} if config.odometry.mask else {}
    if results == args.input:
        check_topics(args, beside)
    path = args.source or Path(name)
    if not path.exists():
        raise DjetError(f'{path}, of which {results} are the results, is not there; say with '
                        '--source where it is')
    if not is_bag(path) or not isinstance(topic, str):
        topic = None
    return (open_recording(path, args.image_topic or topic, args.info_topic, args.poses, beside,
                           damaged=True), name)


def _table(summary: dict[str, Any]) -> Table:
    table = new_table(f"{Path(summary['source']).name}: scale {summary['scale']}", '', 'before',
                      'after')
    table.add_row('keyframes', '', f"{summary['keyframes']} of {summary['frames']}")
    for kind, number in sorted(summary['edges'].items()):
        rejected = summary['rejected'].get(kind, 0)
        table.add_row(f'edges: {kind}', '',
                      f'{number}, {rejected} not trusted' if rejected else str(number))
    if 'errors' in summary:
        before, after = summary['errors']['before'], summary['errors']['after']
        for name in before:
            table.add_row(_TITLES[name], f'{before[name]:.4f}', f'{after[name]:.4f}')
    return table


_TITLES = {'ape_m': 'positions, rmse in m', 'evo_ape_m': 'evo: APE, rmse in m',
           'evo_rpe_m': 'evo: RPE, rmse in m', 'evo_rpe_deg': 'evo: RPE, rmse in deg'}
