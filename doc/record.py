"""
Measures doc/recorded.yaml: figures that take minutes, a pose graph or separate processes.

Real frames are those of $DJET_DATA. Nodes are measured by processes on a ROS graph: one plays a
recording, one is the node, and this one subscribes; needs djet_ros[dds,slam]. The node may be any
command, for instance one that sources ROS first. A table that can't be measured is reported in one
line and left as it was; the exit status is 1 then.

    python doc/record.py links outvoted soak loops dds coverage
    python doc/record.py 'camera height' 'short ways' 'live loops'
    python doc/record.py node --node '. install/setup.sh; ros2 run djet_ros vo_node --ros-args'
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import replace
from itertools import product
import json
import os
from pathlib import Path
import shlex
import signal
import subprocess
import sys
from tempfile import TemporaryDirectory, TemporaryFile
from time import monotonic
from typing import Any, IO

import djet_ros
from djet_ros.cli.graph_options import stop_by_signal
from djet_ros.config.flat import from_flat
from djet_ros.config.sections import OdometryConfig
from djet_ros.config.yaml_files import load_yaml
from djet_ros.core.types import Array
from djet_ros.dds.graph import Graph
from djet_ros.dds.middleware import DdsMiddleware
from djet_ros.dds.names import Names
from djet_ros.lab.scenes import make_scene, render_sequence
from djet_ros.lab.scenes.sequence import FRAME_PERIOD, render_poses
from djet_ros.lab.sequences import open_datasets, opened, Selection
from djet_ros.live.graph_node import PoseGraphNode
from djet_ros.live.middleware import Profile
from djet_ros.odometry.messages import pose_of
from djet_ros.odometry.visual_odometry import VisualOdometry
from djet_ros.posegraph.backend import optimise
from djet_ros.posegraph.offline import run_slam
from djet_ros.posegraph.pose_graph import Edge
from djet_ros.recordings.outputs import write_whole
from djet_ros.recordings.recording import open_recording
from djet_ros.replay.alignment import aligned, position_rmse
from djet_ros.replay.graph_of_results import read_steps
from djet_ros.replay.ground_truth import GroundTruth
import numpy as np
from scipy.spatial.transform import Rotation
import yaml

OUTPUT = Path(__file__).with_name('recorded.yaml')
HEAD = """\
# Figures that `make results` does not measure: they need a ROS graph, a pose graph or hours. Each
# table has the version of the package and the method of measurement; see doc/record.py.

"""
DJET = (sys.executable, '-c', 'from djet_ros.cli.main import main; raise SystemExit(main())')
POSE_GRAPH = (sys.executable, '-c', f'import sys; sys.path.insert(0, {str(OUTPUT.parent)!r}); '
              'from record import run_pose_graph; raise SystemExit(run_pose_graph())')

# A domain of its own, on this machine only.
GRAPH = {**os.environ, 'ROS_DOMAIN_ID': str(1 + os.getpid() % 100), 'OMP_NUM_THREADS': '1',
         'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', 'RMW_IMPLEMENTATION': 'rmw_cyclonedds_cpp'}

# Seconds without progress after which a measurement is given up.
PATIENCE = 60.0

# Topic on which djet play publishes the images of a KITTI folder.
IMAGE = '/camera/image_rect'

HEIGHT = 1.65
LINKS = (1, 2, 3)
WRONG, PLACES = (360.0, 2000.0), 8
# Frames of each scene and seed in the table of coverage; and of those with lorries, which fill and
# leave the image in that time.
COVERED = 12
WITH_LORRIES, LORRIES_PASS_IN = ('moving_object', 'motorway', 'traffic'), 120
# Frames of a hand-held camera, and how much slower it also moves: as at eighty images a second.
SLOW_FRAMES, SLOWER = 100, 8
# Seeds of the drives through crossing traffic.
CROSSINGS = range(8)
# Second value of estimator.calibration_sigma for real cameras, in pixels: the standard deviation
# if it is unknown whether pixel centres are at integers or at halves.
CALIBRATED = '0.25'
# Numbers of images at which memory is read; the node's path is full before the first.
MARKS = (6_000, 10_000)

# Live loops: size of the images, and images per second.
LIVE = (('1241x376', 5), ('620x188', 10))
ODOMETRY, PATH, TF = '/vo_node/odometry', '/pose_graph_node/path', '/tf'
LIVE_TYPES = {ODOMETRY: 'nav_msgs/msg/Odometry', PATH: 'nav_msgs/msg/Path',
              TF: 'tf2_msgs/msg/TFMessage'}

# Seconds without a change after which a pose graph has settled; diagnostics that always change.
SETTLED = 5.0
LATENCIES = {'latency, median (ms)': '', 'latency, 95 % (ms)': ''}


class Unmeasured(Exception):
    """Reason why a table can't be measured, in one line."""


def main() -> int:
    args = arguments()
    tables = yaml.safe_load(OUTPUT.read_text('utf-8'))
    failed = False
    for name in args.tables:
        try:
            with TemporaryDirectory() as place:
                table = MEASURED[name](Path(place), args)
        except Unmeasured as error:
            print(f'record.py: error: {name}: {error}', file=sys.stderr, flush=True)
            failed = True
            continue
        tables[name] = {'version': djet_ros.__version__, **table}
        text = yaml.safe_dump(tables, sort_keys=False, allow_unicode=True, width=10**6,
                              default_flow_style=None)
        write_whole(OUTPUT, HEAD + text)
        print(name, flush=True)
    return int(failed)


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=str(__doc__).split('\n\n')[0])
    parser.add_argument('tables', nargs='+', choices=MEASURED, metavar='TABLE',
                        help=f'of {", ".join(MEASURED)}')
    parser.add_argument('--node', default='exec ros2 run djet_ros vo_node --ros-args',
                        metavar='COMMAND',
                        help='what a shell is to run as the node, parameters come after it '
                             '(default: %(default)s)')
    data = os.environ.get('DJET_DATA')
    parser.add_argument('--data', type=Path, default=data and Path(data), required=not data,
                        metavar='DIR', help='folder of real sequences (default: $DJET_DATA)')
    return parser.parse_args()


def djet(*words: Any) -> None:
    """Run a djet command; raises Unmeasured with the last line of its stderr if it fails."""
    done = subprocess.run([*DJET, *map(str, words)], capture_output=True, text=True)
    if done.returncode:
        raise Unmeasured(f'djet {" ".join(map(str, words))}: {last_line(done.stderr)}')


def last_line(said: str) -> str:
    return (said.strip().splitlines() or ['it said nothing'])[-1]


def kitti(args: argparse.Namespace, *names: str) -> dict[str, Path]:
    """Return the folders of KITTI's sequences by their names in tables."""
    found = {}
    for name in names:
        folder = args.data / 'kitti' / 'sequences' / name
        frames = len([*folder.glob('image_0/*')])
        found[f'KITTI {name} (frames 0–{frames - 1})'] = folder
    return found


# Pose graphs


def links(place: Path, args: argparse.Namespace) -> dict[str, Any]:
    """Measure pose graphs with more links between keyframes, on real frames."""
    sources = kitti(args, '00', '03', '06')
    rows = []
    for number in LINKS:
        errors = []
        for source in sources.values():
            result = slam(place, source, '--links', number, '--keyframes', 'distance',
                          '--keyframe-distance', 0.2, *exact_lengths(0.01))['errors']['after']
            errors.append(f"{result['evo_ape_m']:.3f} / {result['evo_rpe_deg']:.4f}")
        rows.append([str(number), *errors])
    return {'how': '`djet slam SEQUENCE --links N --keyframes distance --keyframe-distance 0.2 '
                   '--scale ground_truth --scale-uncertainty 0.01`: lengths known to 1 %. APE in '
                   'm / RPE in deg, by evo.', 'header': ['N', *sources], 'rows': rows}


def loops(place: Path, args: argparse.Namespace) -> dict[str, Any]:
    """Measure loop closure on a block driven twice, in several image sizes."""
    images = (('1241x376', 0), ('1241x376', 1), ('620x188', 0), ('620x188', 1), ('416x128', 0))
    runs: list[tuple[str, int, tuple[Any, ...]]] = [
        *((*one, ()) for one in images),
        ('1241x376', 0, ('--scale', 'camera_height', '--camera-height', HEIGHT)),
        *((*one, exact_lengths(0.01)) for one in images)]
    rows = []
    for size, seed, scale in runs:
        result = slam(place, block(place, size, seed), *scale)
        before, after = result['errors']['before'], result['errors']['after']
        rows.append([
            f"{size.replace('x', '×')}, seed {seed}",
            {'structure': 'structure', 'camera_height': 'camera height',
             'ground_truth': 'ground truth, 1 %'}[result['scale']],
            f"{result['edges'].get('loop', 0)} ({result['rejected'].get('loop', 0)})",
            f"{before['ape_m']:.3f} m", f"{after['ape_m']:.3f} m",
            f"{before['ape_m'] / after['ape_m']:.1f}",
            f"{1e3 * before['evo_rpe_m']:.1f} → {1e3 * after['evo_rpe_m']:.1f} mm, "
            f"{before['evo_rpe_deg']:.3f} → {after['evo_rpe_deg']:.3f}°"])
    return {'how': '`djet lab render loop DIR --frames 427 --seed S --size WxH` (362 m) and '
                   '`djet slam DIR/sequences/02 --scale SCALE`; ratio is APE before / APE after. '
                   'Scale `structure` is not metric: APE after alignment with scale.',
            'header': ['images', 'scale from', 'loops (rejected)', 'APE before', 'APE after',
                       'ratio', 'RPE before → after'], 'rows': rows}


def outvoted(place: Path, args: argparse.Namespace) -> dict[str, Any]:
    """Perturb one odometry edge, which has no robust kernel, and optimise."""
    source, results = block(place, '620x188', 0), place / 'slam' / 'replay'
    slam(place, source, *exact_lengths(0.01))
    recording = open_recording(source)
    try:
        found = run_slam(read_steps(results), recording, load_yaml(results / 'config.yaml'),
                         scratch=place)
        truth = GroundTruth.of(recording)
    finally:
        recording.close()
    graph = found.optimised.graph
    true = truth.at(graph.stamps_ns)[:, :3, 3]

    def error(edges: tuple[Edge, ...]) -> float:
        places = optimise(replace(graph, edges=edges)).graph.poses[:, :3, 3]
        return position_rmse(aligned(places, true, found.metric), true)

    chain = [number for number, edge in enumerate(graph.edges) if edge.kind == 'odometry']
    chosen = [chain[i] for i in np.linspace(0, len(chain) - 1, PLACES + 2).astype(int)[1:-1]]
    random, rows = np.random.default_rng(0), []
    for square in WRONG:
        after = [error((*graph.edges[:number], perturbed(graph.edges[number], square, random),
                        *graph.edges[number + 1:])) for number in chosen]
        rows.append([f'{square:.0f}', f'{min(after):.3f} to {max(after):.3f} m'])
    return {'how': f'One of {len(chain)} odometry edges of the loop (620×188, seed 0; ground '
                   'truth, 1 %) perturbed by a given χ² in a random direction, at eight places '
                   f'along the loop. APE of keyframes afterwards; {error(graph.edges):.3f} m '
                   'without a wrong edge.',
            'header': ['χ² of the wrong edge', 'APE after'], 'rows': rows}


def perturbed(edge: Edge, square: float, random: np.random.Generator) -> Edge:
    """Perturb an edge by a squared Mahalanobis distance, in a random direction."""
    direction = random.normal(size=6)
    direction *= np.sqrt(square / (direction @ direction))
    off = np.linalg.cholesky(edge.covariance_in_target()) @ direction
    moved = np.eye(4)
    moved[:3, :3], moved[:3, 3] = Rotation.from_rotvec(off[3:]).as_matrix(), off[:3]
    return replace(edge, motion=edge.motion @ moved)


def exact_lengths(share: float) -> tuple[str | float, ...]:
    return '--scale', 'ground_truth', '--scale-uncertainty', share


def block(place: Path, size: str, seed: int) -> Path:
    """Render the drive around a block, once."""
    folder = place / f'{size}-{seed}'
    if not folder.exists():
        djet('lab', 'render', 'loop', folder, '--frames', 427, '--seed', seed, '--size', size)
    return next((folder / 'sequences').iterdir())


def slam(place: Path, source: Path, *words: Any) -> dict[str, Any]:
    """Run ``djet slam``; returns its summary."""
    djet('slam', source, '--output', place / 'slam', '--overwrite', *words)
    summary: dict[str, Any] = json.loads((place / 'slam' / 'slam.json').read_text('utf-8'))
    return summary


# Odometry


def soak(place: Path, args: argparse.Namespace) -> dict[str, Any]:
    """Measure memory over many frames of the odometry."""
    djet('lab', 'soak', '--output', place / 'soak.json')
    found = json.loads((place / 'soak.json').read_text('utf-8'))
    statuses, stretches = found['status'], found['stretches']
    tracked = sum(statuses.get(name, 0) for name in ('OK', 'NO_PARALLAX'))
    jumps = statuses.get('TIME_JUMP', 0)
    other = found['frames'] - tracked - jumps - statuses.get('FIRST_FRAME', 0)
    return {'how': f"`djet lab soak`, {found['frames']:,} frames of 416×128, of which "
                   f'{other:,} could not be tracked; {jumps} time jumps.',
            'header': [f"resident memory at {stretches[0]['frames']:,} frames",
                       f"at {found['frames']:,} frames"],
            'rows': [[f"{stretches[0]['memory_mb']:.1f} MB", f"{found['memory_mb']:.1f} MB"]]}


def camera_height(place: Path, args: argparse.Namespace) -> dict[str, Any]:
    """Compare lengths from the camera's height with ground truth."""
    rows = []
    for name, folder in kitti(args, '00', '03', '06').items():
        found = lengths(folder, None)
        rows.append(row_of(name, found))
        if ' 00 ' in name:
            rows.append(row_of(name.replace('0–', '15–'), found[15:]))
    for scene, frames in (('road', 150), ('loop', 427)):
        folder = render_sequence(scene, place / scene, frames)
        rows.append(row_of(f'rendered `{scene}`, {frames} frames', lengths(folder, frames)))
    return {'how': 'Steps of `djet replay SEQUENCE --scale camera_height --camera-height 1.65`.',
            'header': ['sequence', 'pairs',
                       'length / ground truth per pair: median (1.48 MAD), range',
                       'whole path', 'normalised error, rms'], 'rows': rows}


def short_ways(place: Path, args: argparse.Namespace) -> dict[str, Any]:
    """Replay paths that are too short for KITTI's drift, by images alone."""
    sources = kitti(args, '06')
    for name, folder in kitti(args, '00').items():
        bag = place / 'later'
        djet('kitti-to-bag', folder, bag, '--start', 15)
        sources[name.replace('0–', '15–')] = bag
    sources |= {f'TUM {folder.name.removeprefix("rgbd_dataset_")}': folder
                for folder in sorted(args.data.glob('tum/*/'))}
    for seed, slower in product(range(3), (1, SLOWER)):
        name = f'rendered `handheld`, seed {seed}, {SLOW_FRAMES} frames'
        sources[name if slower == 1 else f'{name}, 1/{slower} of the speed'] = render_sequence(
            'handheld', place / f'seed{seed}-{slower}', SLOW_FRAMES, seed, slower=slower)
    rows = []
    for name, source in sources.items():
        djet('replay', source, '--output', place / 'replay', '--overwrite')
        found = json.loads((place / 'replay' / 'summary.json').read_text('utf-8'))['positions']
        rows.append([name, f"{found['way_m']:.3g} m", formatted(found['scale_change'], '.3f'),
                     f"{1e3 * found['rmse_m']:.3g} mm"])
    return {'how': '`djet replay SEQUENCE`, images alone.',
            'header': ['', 'path length', 'scale, end over start', 'ATE rmse'], 'rows': rows}


def lengths(folder: Path, frames: int | None) -> Array:
    """Return length, true length and standard deviation (N, 3) of the steps of known length."""
    dataset, = open_datasets([folder], Selection(end=frames), folder.parent)
    sequence, rows = opened(dataset), []
    assert sequence.poses is not None
    odometry = VisualOdometry(odometry=OdometryConfig(scale='camera_height', camera_height=HEIGHT))
    for index in dataset.frames:
        result = odometry.process(sequence.frame(index))
        way = result.motion[:3, 3]
        length = float(np.linalg.norm(way))
        if not length or not result.scale_known or result.previous_stamp_ns is None:
            continue
        previous = np.searchsorted(sequence.stamps_ns, result.previous_stamp_ns)
        true = np.linalg.norm((np.linalg.inv(sequence.poses[previous])
                               @ sequence.poses[index])[:3, 3])
        sigma = np.sqrt(way @ result.motion_covariance[:3, :3] @ way) / length
        rows.append((length, float(true), float(sigma)))
    return np.array(rows)


def row_of(name: str, found: Array) -> list[str]:
    length, true, sigma = found.T
    ratio = length / true
    middle = np.median(ratio)
    spread = 1.4826 * np.median(np.abs(ratio - middle))
    error = np.sqrt(np.mean(((length - true) / sigma)**2))
    return [name, str(len(found)), f'{middle:.3f} ({spread:.3f}), {ratio.min():.2f} to '
            f'{ratio.max():.2f}', f'{length.sum() / true.sum():.3f}', f'{error:.2f}']


# Covariances


def coverage(place: Path, args: argparse.Namespace) -> dict[str, Any]:
    """Measure the share of poses inside their own ellipsoids."""
    djet('lab', 'coverage', '--scenes', 'all', '--seeds', '0-9', '--frames', COVERED, '--output',
         place / 'rendered')
    rows = covered(place / 'rendered')
    for scene in WITH_LORRIES:
        djet('lab', 'coverage', '--scenes', scene, '--seeds', '0-9', '--frames', LORRIES_PASS_IN,
             '--output', place / scene)
        rows += covered(place / scene, f'{scene}, {LORRIES_PASS_IN} frames of 10 seeds')
    drives = crossing_drives(place / 'crossing')
    djet('lab', 'coverage', *drives, '--output', place / 'crossed')
    rows += covered(place / 'crossed', f'crossing `traffic`, {len(drives)} drives of '
                    f'{LORRIES_PASS_IN} frames')
    for real in args.data.glob('tartanair/sequences/*'):
        for sigma, told in (('0', ''), (CALIBRATED, f', calibration sigma {CALIBRATED} px')):
            djet('lab', 'coverage', real, '--calibration-sigma', sigma, '--output',
                 place / f'{real.name}-{sigma}')
            rows += covered(place / f'{real.name}-{sigma}', f'TartanAir {real.name}{told}')
    return {'how': f'`djet lab coverage --scenes all --seeds 0-9 --frames {COVERED}`, and on real '
                   'frames; independent pairs / in sequence, with the previous motion.',
            'header': ['', 'pairs', 'poses', 'overconfident failures', 'missed motion',
                       'rejected (correct)', 'NEES / expected, median', 'inside 95 %',
                       'beyond 99.9 %'],
            'rows': rows}


def starting(seconds: Array) -> Array:
    """Return the metres (N,) driven by a car that stands for two seconds, and accelerates."""
    return np.asarray(0.5 * np.maximum(seconds - 2, 0)**2)


def at_once(seconds: Array) -> Array:
    """Return those of one that has its speed at once."""
    return np.asarray(6 * np.maximum(seconds - 2, 0))


def stopping(seconds: Array) -> Array:
    """Return those of one that brakes after a second, stands for four, and starts again."""
    braking = np.clip(seconds - 1, 0, 8 / 3)
    return np.asarray(8 * np.minimum(seconds, 1) + 8 * braking - 1.5 * braking**2
                      + 0.75 * np.maximum(seconds - 8, 0)**2)


def crossing_drives(place: Path) -> list[Path]:
    """Render cars that drive straight ahead through the scene `traffic`, trembling a little."""
    folders: list[Path] = []
    seconds = np.linspace(0, FRAME_PERIOD * (LORRIES_PASS_IN - 1), LORRIES_PASS_IN)
    for metres, seed in product((starting, at_once, stopping), CROSSINGS):
        ahead = metres(seconds)
        moves = np.diff(ahead, prepend=ahead[0])[:, None] > 1e-6
        turns = np.cumsum(np.random.default_rng(seed).normal(0, np.radians(0.03), (
            LORRIES_PASS_IN, 3)) * moves, axis=0)
        poses = np.tile(np.eye(4), (LORRIES_PASS_IN, 1, 1))
        poses[:, :3, :3], poses[:, 2, 3] = Rotation.from_rotvec(turns).as_matrix(), ahead
        folders.append(render_poses(make_scene('traffic', seed), poses, place, len(folders),
                                    'djet render crossing_traffic:'))
    return folders


def covered(folder: Path, name: str = '') -> list[list[str]]:
    """
    Return the rows of a run of coverage, one per scene.

    Scenes in which the camera neither moves nor seems to are left out, unless they have a name.
    """
    found = json.loads((folder / 'coverage.json').read_text('utf-8'))
    at = [found['levels'].index(level) for level in (0.95, 0.999)]
    by_scene: dict[str, list[dict[str, Any]]] = {}
    for row in found['rows']:
        by_scene.setdefault(name or row['scene'], []).append(row)

    def cells(row: dict[str, Any]) -> list[str]:
        within, whole = (row['inside'][index][0] for index in at)
        beyond = None if whole is None else 1 - whole
        return [str(row['pairs']), str(row['told']), str(row['wrong_and_sure']),
                str(row.get('untold', '–')), f"{row['given_up']} ({row['needlessly']})",
                formatted(row['median'], '.2f'), formatted(within, '.1%'),
                formatted(beyond, '.1%')]

    return [[scene, *map(' / '.join, zip(*map(cells, rows)))] for scene, rows in by_scene.items()
            if name or any(row['told'] or row.get('untold') or row['wrong_and_sure']
                           for row in rows)]


def formatted(value: float | None, form: str) -> str:
    return f'{value:{form}}' if value is not None and np.isfinite(value) else '–'


# Processes on a graph


def node(place: Path, args: argparse.Namespace) -> dict[str, Any]:
    """Measure the ROS node."""
    with Graph(GRAPH) as graph:
        rows = at_pace(args, args.node, graph) + many_frames(place, args.node, graph)
    return {'how': 'ROS 2 Jazzy, Cyclone DDS on loopback, 2 cores; `djet play`, `vo_node` and a '
                   'subscriber as separate processes.', 'header': ['', ''], 'rows': rows}


def dds(place: Path, args: argparse.Namespace) -> dict[str, Any]:
    """Measure ``djet live``."""
    command = 'exec ' + shlex.join([*DJET, 'live'])
    with Graph(GRAPH) as graph:
        rows = at_pace(args, command, graph)
    return {'how': '`djet play` and `djet live` on the same two cores.', 'header': ['', ''],
            'rows': rows}


def at_pace(args: argparse.Namespace, command: str, graph: Graph) -> list[list[str]]:
    """Measure KITTI 06 at its recorded rate."""
    source = args.data / 'kitti' / 'sequences' / '06'
    sent = len([*source.glob('image_0/*')])
    with started(command, 'latest', graph) as node, playing(source):
        node.wait_for(sent, 'processed', 'dropped', 'lost on the way')
        said, spent = node.said, node.cpu_ms_per_image()
        memory, took = node.memory_mb(), node.end()
    return [
        ['KITTI 06 (1226×370) at its 10 Hz, `queue_policy: latest`',
         f"{said['frames processed']} of {sent} images processed, {said['frames dropped']} "
         'dropped'],
        ['latency from receipt to publication, from the diagnostics',
         f"median {said['latency, median (ms)']} ms, 95 % {said['latency, 95 % (ms)']} ms"],
        ['CPU time per image, publishing included', f'{spent:.0f} ms'],
        ['resident memory', f'{memory:.0f} MB'],
        ['from SIGINT to exit', f'{took:.1f} s']]


def many_frames(place: Path, command: str, graph: Graph) -> list[list[str]]:
    """Measure memory over many small images, at a rate that can just be processed."""
    source = render_sequence('road', place, 200, size=(320, 240))
    memory = []
    with started(command, 'latest', graph) as node, playing(source, '--loop', '--rate', 4):
        for mark in MARKS:
            node.wait_for(mark, 'processed')
            memory.append(f'{node.memory_mb():.1f} MB at {mark:,}')
        dropped = node.said['frames dropped']
    return [[f'{MARKS[-1]:,} images of 320×240 at 40 Hz, `queue_policy: latest`, with path and tf',
             f"{dropped} dropped; resident memory {', '.join(memory)}"]]


def live_loops(place: Path, args: argparse.Namespace) -> dict[str, Any]:
    """Measure live odometry and pose graph on a block driven twice."""
    rows, kept = [], []
    with Graph(GRAPH) as graph:
        heard: dict[str, list[Any]] = {topic: [] for topic in LIVE_TYPES}
        for topic, kind in LIVE_TYPES.items():
            graph.listen(topic, kind, heard[topic].append, Profile(depth=1000))
        for size, rate in LIVE:
            source = block(place, size, 0)
            found, memory = mapped_live(source, rate, graph, heard)
            row, share = live_row(source, heard, found)
            rows.append([f"{size.replace('x', '×')}, {rate} per second", *row, f'{memory:.0f} MB'])
            kept.append(f"{share}, {found['relative poses missing']} relative poses missing, "
                        f"{found['keyframes without image']} keyframes without image")
    return {'how': '`djet play`, `djet live`, the pose graph on Cyclone DDS and a subscriber as '
                   'processes on two cores, default parameters; the loop driven twice, 427 '
                   'images. Scale `structure`: APE after alignment with scale. Frames '
                   f"with `map` → `odom`: {'; '.join(kept)}.",
            'header': ['images', 'loops (rejected)', 'APE of keyframes before → after',
                       'APE of all frames as published', 'memory of the pose graph'],
            'rows': rows}


def mapped_live(source: Path, rate: float, graph: Graph, heard: dict[str, list[Any]]
                ) -> tuple[dict[str, str], float]:
    """Play to both nodes; returns the last diagnostics of the pose graph, and its memory in MB."""
    sent = len([*source.glob('image_0/*')])
    for messages in heard.values():
        messages.clear()
    odometry, slam = (shlex.join([*program, '-r', f'image:={IMAGE}']) for program in (
        (*DJET, 'live', '-p', 'ros.queue_policy:=every'), POSE_GRAPH))
    with running(f'exec {slam}', graph, 'pose_graph_node: pose graph') as mapping, \
            running(f'exec {odometry}', graph) as node:
        for one in (mapping, node):
            one.wait_for_diagnostics()
        with playing(source, '--rate', rate / 10):
            node.wait_for(sent, 'processed', 'dropped', 'lost on the way')
        mapping.wait_until_settled()
        return mapping.said, mapping.memory_mb()


def live_row(source: Path, heard: dict[str, list[Any]], said: dict[str, str]
             ) -> tuple[list[str], str]:
    """Compare published poses with ground truth; returns columns and the share of whole frames."""
    with open_recording(source) as recording:
        truth = GroundTruth.of(recording)
    told = dict(pose_of(message) for message in heard[ODOMETRY])
    corrections = dict(pose_of(one) for message in heard[TF] for one in message.transforms
                       if one.header.frame_id == 'map')
    after = dict(pose_of(one) for one in heard[PATH][-1].poses)

    def error(poses: dict[int, Array]) -> float:
        true = truth.at(np.array([*poses]))[:, :3, 3]
        return position_rmse(aligned(np.array([*poses.values()])[:, :3, 3], true, False), true)

    before = error({stamp: told[stamp] for stamp in after})
    published = {stamp: corrections[stamp] @ told[stamp] for stamp in told if stamp in corrections}
    return [f"{said['loops']} ({said['loops not trusted']})",
            f'{before:.3f} → {error(after):.3f} m, ratio {before / error(after):.1f}',
            f'{error(published):.3f} m'], f'{len(published)} of {len(told)}'


def run_pose_graph() -> int:
    """Run the pose graph on Cyclone DDS; arguments are remappings."""
    stop = stop_by_signal()
    names = Names('pose_graph_node', [word for word in sys.argv[1:] if word != '-r'])
    with Graph() as graph:
        return PoseGraphNode(DdsMiddleware(graph, names), from_flat(
            {'ros.queue_policy': 'every'})).run(stop)


class Node:
    """A node in separate processes, and the values of its diagnostics by key."""

    def __init__(self, command: str, graph: Graph, name: str, log: IO[str]) -> None:
        self._process = subprocess.Popen(
            command, shell=True, env=GRAPH, start_new_session=True,
            stdout=subprocess.DEVNULL, stderr=log)
        self._graph, self._name, self._log = graph, name, log
        self.said: dict[str, str] = {}
        self._spent: list[tuple[int, float]] = []
        graph.listen('/diagnostics', 'diagnostic_msgs/msg/DiagnosticArray', self._take,
                     Profile(depth=10))

    def _take(self, message: Any) -> None:
        if message.status[0].name != self._name:
            return
        self.said = {pair.key: pair.value for pair in message.status[0].values}
        processed = int(self.said.get('frames processed', 0))
        if processed:
            self._spent.append((processed, self._cpu_ms()))

    def wait_for(self, images: int, *fates: str) -> None:
        """Wait until so many images met one of the fates; Unmeasured if they stop coming."""
        def met() -> int:
            return sum(int(self.said.get(f'frames {fate}', 0)) for fate in fates)

        self._wait_while(lambda: met() < images, met,
                         lambda: f'{met()} of {images} images came to anything')

    def wait_for_diagnostics(self) -> None:
        """Wait for its first diagnostics."""
        self._wait_while(lambda: not self.said, lambda: 0, lambda: 'no diagnostics came')

    def wait_until_settled(self) -> None:
        """Wait until a pose graph has searched all loops, and is unchanged for SETTLED."""
        since, before = monotonic(), {**self.said, **LATENCIES}

        def unsettled() -> bool:
            nonlocal since, before
            if (now := {**self.said, **LATENCIES}) != before:
                since, before = monotonic(), now
            return monotonic() - since < SETTLED or self.said['keyframes waiting'] != '0'

        self._wait_while(unsettled, lambda: self.said['keyframes waiting'],
                         lambda: f"{self.said['keyframes waiting']} keyframes wait for loops")

    def _wait_while(self, condition: Callable[[], bool], progress: Callable[[], Any],
                    lacking: Callable[[], str]) -> None:
        """Wait while a condition holds; raises Unmeasured after PATIENCE without progress."""
        before, since = progress(), monotonic()
        while condition():
            self._graph.spin(0.2)
            if (now := progress()) != before:
                before, since = now, monotonic()
            if (status := self._process.poll()) is not None:
                self._log.seek(0)
                raise Unmeasured(f'{self._name} ended with status {status}: '
                                 f'{last_line(self._log.read())}')
            if monotonic() - since > PATIENCE:
                raise Unmeasured(f'{lacking()}, and nothing more for {PATIENCE:.0f} s; are '
                                 'messages lost on the way?')

    def cpu_ms_per_image(self) -> float:
        """Return the CPU time per image, from the first diagnostics with processed images on."""
        (first, before), *_, (last, after) = self._spent
        return (after - before) / (last - first)

    def memory_mb(self) -> float:
        """Return the resident memory of the largest of its processes."""
        pages = max(int((process / 'statm').read_text('utf-8').split()[1])
                    for process in self._processes())
        return pages * os.sysconf('SC_PAGE_SIZE') / 1e6

    def end(self) -> float:
        """Interrupt it; returns the seconds until it has ended."""
        began = monotonic()
        os.killpg(self._process.pid, signal.SIGINT)
        try:
            self._process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            os.killpg(self._process.pid, signal.SIGKILL)
            raise Unmeasured(f'{self._name} did not end within {PATIENCE:.0f} s') from None
        return monotonic() - began

    def close(self) -> None:
        """End it if it has not ended."""
        if self._process.poll() is None:
            self.end()

    def _cpu_ms(self) -> float:
        ticks = 0
        for process in self._processes():
            fields = (process / 'stat').read_text('utf-8').rsplit(')', 1)[1].split()
            ticks += int(fields[11]) + int(fields[12])
        return 1e3 * ticks / os.sysconf('SC_CLK_TCK')

    def _processes(self) -> Iterator[Path]:
        for process in Path('/proc').glob('[0-9]*'):
            with suppress(ProcessLookupError):  # the process has ended
                if os.getpgid(int(process.name)) == self._process.pid:
                    yield process


def started(command: str, policy: str, graph: Graph) -> AbstractContextManager[Node]:
    """Run an odometry with a queue policy as a context."""
    return running(f'{command} -r image:={IMAGE} -p ros.queue_policy:={policy}', graph)


@contextmanager
def running(command: str, graph: Graph, name: str = 'vo_node: visual odometry') -> Iterator[Node]:
    """Run a node as a context; name: of its diagnostics."""
    with TemporaryFile('w+') as log:
        node = Node(command, graph, name, log)
        try:
            yield node
        finally:
            node.close()


@contextmanager
def playing(source: Path, *words: Any) -> Iterator[None]:
    """Play a recording as a context."""
    process = subprocess.Popen([*DJET, 'play', str(source), *map(str, words)], env=GRAPH,
                               stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


MEASURED: dict[str, Callable[[Path, argparse.Namespace], dict[str, Any]]] = {
    'node': node, 'dds': dds, 'soak': soak, 'outvoted': outvoted, 'links': links, 'loops': loops,
    'live loops': live_loops, 'camera height': camera_height, 'short ways': short_ways,
    'coverage': coverage}


if __name__ == '__main__':
    sys.exit(main())
