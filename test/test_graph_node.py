"""The pose graph on a real ROS graph: camera, odometry, pose graph and listener are processes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
import signal
import subprocess
from time import monotonic, sleep
from typing import Any

from cards import Cards, K, pose, SIZE
from djet_ros.odometry.messages import pose_of, stamp_ns
from djet_ros.recordings.decoding import MAKE
import numpy as np
import pytest
from ros_graph import command, ENVIRONMENT, NodeProcess, nodes as processes, Peer, peer
from ros_messages import camera_info, image

pytestmark = [
    pytest.mark.ros,
    pytest.mark.skipif(find_spec('rclpy') is None,
                       reason='rclpy is missing: no ROS 2 is sourced here'),
    pytest.mark.skipif(find_spec('gtsam') is None,
                       reason='GTSAM is not installed: the extra slam')]

IMAGE, INFO = '/camera/image_rect', '/camera/camera_info'
PATH, ODOMETRY = '/pose_graph_node/path', '/vo_node/odometry'
TYPES = {
    PATH: 'nav_msgs/msg/Path',
    ODOMETRY: 'nav_msgs/msg/Odometry',
    '/tf': 'tf2_msgs/msg/TFMessage',
    '/diagnostics': 'diagnostic_msgs/msg/DiagnosticArray',
}
STEP, PERIOD, START = 0.25, 100_000_000, 50 * 10**9
WAYS = [STEP * i for i in (*range(9), *range(7, -1, -1))]
ODOMETRY_PARAMETERS = {'estimator.max_features': 800, 'ros.queue_policy': 'every',
                       'ros.publish_tf': True, 'odometry.scale': 'constant',
                       'odometry.scale_value': STEP}
SLAM_PARAMETERS = {'estimator.max_features': 800, 'ros.queue_policy': 'every',
                   'slam.keyframe_distance': 0.4, 'slam.loop_gap': 0.5,
                   'slam.path_period': 0.0, 'slam.optimise_period': 0.0}
# The camera on its vehicle: ahead of the base and above it, looking to the left.
TO_THE_LEFT = np.array([[1.0, 0, 0, 0.3], [0, 0, 1, 0], [0, -1, 0, 1.0], [0, 0, 0, 1]])

Heard = dict[str, list[Any]]


@pytest.fixture(scope='module')
def listener() -> Iterator[Peer]:
    with peer('listener', TYPES) as one:
        yield one


@pytest.fixture
def camera() -> Iterator[Peer]:
    with peer('camera_driver') as one:
        yield one


@pytest.fixture
def nodes(tmp_path: Path, listener: Peer) -> Iterator[Callable[..., NodeProcess]]:
    """Return a function that starts a node by name; all have ended cleanly after the test."""
    listener.received.clear()
    with processes(tmp_path, IMAGE) as start:
        yield lambda name, **parameters: start(name=name, **parameters)


def see(camera: Peer, positions: list[float], first: int = 0) -> None:
    """Publish what the camera sees on its way."""
    cards = Cards()
    for i, metres in enumerate(positions, first):
        camera.send(IMAGE, image(cards.gray(pose(x=metres), noise=i), stamp_ns=START + i * PERIOD))
        sleep(0.05)


def advertise(camera: Peer, listeners: int) -> None:
    camera.advertise(INFO, 'sensor_msgs/msg/CameraInfo', listeners)
    camera.advertise(IMAGE, 'sensor_msgs/msg/Image', listeners)
    for _ in range(3):
        camera.send(INFO, camera_info(K, SIZE))
        sleep(0.1)


def diagnostics(text: str) -> Callable[[Heard], Any]:
    """Make the condition that the pose graph says something; its value is what it has."""
    return lambda received: next((
        {pair.key: pair.value for pair in message.status[0].values}
        for message in reversed(received['/diagnostics'])
        if message.status[0].name == 'pose_graph_node: pose graph'
        and message.status[0].message == text), None)


def transforms(received: Heard, parent: str) -> dict[int, Any]:
    return dict(pose_of(one) for message in received['/tf'] for one in message.transforms
                if one.header.frame_id == parent)


def worst(poses: dict[int, Any], to_the_right: list[int]) -> float:
    """Return the largest lateral error of poses by stamp on a path to the right."""
    return max(float(np.linalg.norm(
        here[:3, 3] - WAYS[(stamp - START) // PERIOD] * np.array(to_the_right)))
        for stamp, here in poses.items())


def drive(listener: Peer, camera: Peer, nodes: Callable[..., NodeProcess],
          **parameters: Any) -> NodeProcess:
    """Go to the right and back, and give the pose graph's process."""
    if parameters:
        # Published before the nodes start, as on a robot: its reception cannot be observed.
        camera.advertise('/tf_static', TYPES['/tf'], 0, durability='transient_local', depth=1)
        camera.send('/tf_static', MAKE.frame(0, 'base_link', 'camera', TO_THE_LEFT))
    nodes('vo_node', **ODOMETRY_PARAMETERS, **parameters)
    graph = nodes('pose_graph_node', **SLAM_PARAMETERS, **parameters)
    listener.wait('both nodes', diagnostics(
        'waiting for the mounting of the camera on tf' if parameters
        else 'waiting for odometry'), 60)
    advertise(camera, 2)
    see(camera, WAYS)
    last = START + (len(WAYS) - 1) * PERIOD
    listener.wait('the whole path', lambda received: received[PATH] and pose_of(
        received[PATH][-1].poses[-1])[0] == last, 60)
    return graph


@pytest.fixture
def driven(listener: Peer, camera: Peer, nodes: Callable[..., NodeProcess]) -> NodeProcess:
    """Return the process of the pose graph, after a path to the right and back."""
    return drive(listener, camera, nodes)


def check_the_map(listener: Peer, to_the_right: list[int]) -> None:
    """Wait until the loops are closed, and check the path and the frames."""
    values = listener.wait('loops', lambda received: (found := diagnostics('mapping')(received))
                           and int(found['keyframes waiting']) == 0
                           and int(found['loops']) >= 3 and found, 60)
    assert values['relative poses missing'] == values['messages dropped'] == '0'
    path = listener.received[PATH][-1]
    assert path.header.frame_id == 'map'
    by_odometry = dict(pose_of(one) for one in listener.received[ODOMETRY])
    # Loops cannot improve what is accurate to 3 cm already.
    assert worst(dict(pose_of(one) for one in path.poses), to_the_right) < max(
        worst(by_odometry, to_the_right), 0.03)
    # REP 105: odom -> camera is the odometry's alone, and map -> odom carries the correction
    map_to_odom, odom_to_child = (transforms(listener.received, frame)
                                  for frame in ('map', 'odom'))
    assert map_to_odom.keys() == odom_to_child.keys() == by_odometry.keys()
    for stamp in by_odometry:
        assert np.allclose(by_odometry[stamp], odom_to_child[stamp], atol=1e-12)
    # the first path of a frame is published with the correction of that frame
    first: dict[int, Any] = {}
    for message in listener.received[PATH]:
        stamp, here = pose_of(message.poses[-1])
        first.setdefault(stamp, here)
    assert len(first) == len(WAYS)
    for stamp, here in first.items():
        assert np.allclose(map_to_odom[stamp] @ odom_to_child[stamp], here, atol=1e-9)


def test_odometry_with_incompatible_qos_is_logged_with_the_remedy(nodes, camera):
    one = nodes('pose_graph_node', **SLAM_PARAMETERS)
    camera.advertise(ODOMETRY, TYPES[ODOMETRY], listeners=0, reliability='best_effort')
    end = monotonic() + 30
    while 'incompatible QoS' not in one.log and monotonic() < end:
        sleep(0.1)
    assert ('no messages are received from it; configure the publisher to offer reliable, '
            f'volatile, or set qos_overrides.{ODOMETRY}.subscription.*') in one.log


def test_loops_are_closed_with_consistent_frames(listener: Peer, driven: NodeProcess) -> None:
    check_the_map(listener, to_the_right=[0, -1, 0])


def test_map_is_of_the_base_frame_with_the_mounting_from_tf(
        listener: Peer, camera: Peer, nodes: Callable[..., NodeProcess]) -> None:
    pytest.importorskip('tf2_ros', reason='tf2_ros_py is not installed')
    drive(listener, camera, nodes, **{'odometry.base_frame': 'base_link'})
    # What the camera that looks to the left has on its right is ahead of the vehicle.
    check_the_map(listener, to_the_right=[1, 0, 0])
    pairs = {(one.header.frame_id, one.child_frame_id) for message in listener.received['/tf']
             for one in message.transforms}
    assert pairs == {('map', 'odom'), ('odom', 'base_link')}


def test_reset_discards_the_map(
        listener: Peer, camera: Peer, driven: NodeProcess) -> None:
    listener.received.clear()
    assert camera.call('reset', '/pose_graph_node')['success']
    listener.wait('the reset', diagnostics('waiting for odometry'))
    listener.received.clear()
    see(camera, WAYS[1:6], len(WAYS))
    path = listener.wait('a path', lambda received: received[PATH] and received[PATH][-1])
    assert min(stamp_ns(one.header) for one in path.poses) >= START + len(WAYS) * PERIOD


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signal_ends_the_node_cleanly(
        driven: NodeProcess, number: signal.Signals) -> None:
    code, seconds = driven.end(number)
    assert code == 0
    assert seconds < 5


def test_missing_inputs_are_logged_with_their_resolved_names(
        listener: Peer, nodes: Callable[..., NodeProcess]) -> None:
    nodes('vo_node')
    listener.ask('published', topic=ODOMETRY)
    graph = nodes('pose_graph_node')
    listener.wait('diagnostics', diagnostics('waiting for odometry'), 60)
    for _ in range(100):
        if 'waiting for camera_info' in graph.log:
            break
        sleep(0.1)
    for line in (f'waiting for odometry on {ODOMETRY}: no messages arrive from /vo_node',
                 f'waiting for image on {IMAGE}: it has no publisher',
                 f'waiting for camera_info on {INFO}: it has no publisher'):
        assert line in graph.log
    # The odometry's debug_image is an image, too, and not meant.
    assert 'did you mean' not in graph.log


def node(*arguments: str, before: str = '') -> subprocess.CompletedProcess[str]:
    return subprocess.run([*command('pose_graph_node', before), *arguments], env=ENVIRONMENT,
                          timeout=60, capture_output=True, text=True, check=False)


def test_missing_gtsam_is_reported_with_the_install_command() -> None:
    done = node(before='import sys; sys.modules["gtsam"] = None; ')
    assert (done.returncode, done.stderr) == (
        2, "pose_graph_node: error: gtsam is missing: pip install './djet_ros[slam]' (the "
        'folder with the README)\n')


def test_user_error_ends_the_node_with_one_line() -> None:
    done = node('--ros-args', '-p', 'slam.links:=0')
    assert done.returncode == 2
    assert 'slam.links is 0' in done.stderr.splitlines()[-1]
    done = node('--ros-args', '-p', 'slam.loop_gaps:=1.0', '-p', 'slam.links:=0')
    assert "did you mean 'slam.loop_gap'?" in done.stderr
