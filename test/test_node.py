"""The node on a real ROS graph: publisher, node and subscriber are processes of their own."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
import signal
import subprocess
import sys
from threading import Thread
from time import monotonic, sleep
from typing import Any

from cards import Cards, K, pose, SIZE
from commands import limit
import cv2
from djet_ros.lab.scenes.imu import feel, Mems
from djet_ros.odometry.messages import pose_of, stamp_ns
from djet_ros.recordings.bag_writers import ResultBag, write_kitti_bag
from djet_ros.recordings.bags import Bag
from djet_ros.recordings.decoding import MAKE
from djet_ros.recordings.frame_sequence import FrameSequence, ImageFiles, Intrinsics
from djet_ros.recordings.imu import ImuTrack
from djet_ros.recordings.recording import BagRecording, IMU_TOPIC
import numpy as np
import pytest
from ros_graph import command, ENVIRONMENT, NODE, NodeProcess, nodes, PATIENCE, Peer, peer
from ros_messages import (
    camera_info,
    compressed,
    header,
    IMAGE,
    image,
    IMAGE_TYPE,
    INFO,
    INFO_TYPE,
    message_type,
    roi,
    SEEN,
    serialised,
)
from scipy.spatial.transform import Rotation

pytestmark = [pytest.mark.ros, pytest.mark.skipif(
    find_spec('rclpy') is None, reason='rclpy is missing: no ROS 2 is sourced here')]

RELATIVE = f'{NODE}/relative_pose'
TYPES = {
    RELATIVE: 'geometry_msgs/msg/PoseStamped',
    f'{NODE}/relative_pose_cov': 'geometry_msgs/msg/PoseWithCovarianceStamped',
    f'{NODE}/relative_pose_status': 'diagnostic_msgs/msg/DiagnosticArray',
    f'{NODE}/odometry': 'nav_msgs/msg/Odometry',
    '/diagnostics': 'diagnostic_msgs/msg/DiagnosticArray',
}
FAST = {'estimator.max_features': 600}
EVERY = {**FAST, 'ros.queue_policy': 'every'}
TF_TYPE = 'tf2_msgs/msg/TFMessage'
# The camera on its vehicle: 0.3 m ahead of the base and 1 m above it, looking ahead.
AHEAD = np.array([[0.0, 0, 1, 0.3], [-1, 0, 0, 0], [0, -1, 0, 1.0], [0, 0, 0, 1]])
PERIOD = 100_000_000
START = 50 * 10**9


WAY = [np.linalg.matrix_power(pose(x=0.25, z=0.15, yaw=0.01), i) for i in range(12)]


@pytest.fixture(scope='module')
def drive() -> list[Any]:
    cards = Cards()
    return [cards.gray(here) for here in WAY]


@pytest.fixture(scope='module')
def subscriber() -> Iterator[Peer]:
    with peer('subscriber', TYPES) as one:
        yield one


@pytest.fixture
def publisher() -> Iterator[Peer]:
    with peer('camera_driver') as one:
        yield one


@pytest.fixture
def node(tmp_path: Path, subscriber: Peer) -> Iterator[Callable[..., NodeProcess]]:
    """Return a function that starts the node; it has ended, with a clean log, after the test."""
    with nodes(tmp_path, IMAGE) as begin:
        def start(*arguments: str, **parameters: Any) -> NodeProcess:
            one = begin(*arguments, **parameters)
            for topic in TYPES:
                subscriber.ask('published', topic=topic)
            subscriber.received.clear()
            return one

        yield start
    for topic in TYPES:
        subscriber.ask('published', topic=topic, count=0)


def camera(publisher: Peer, **qos: Any) -> None:
    """Advertise a camera with its CameraInfo, and send the latter well before any image."""
    publisher.advertise(INFO, INFO_TYPE, **qos)
    publisher.advertise(IMAGE, IMAGE_TYPE, **qos)
    # Nothing orders the messages of different topics.
    for _ in range(3):
        publisher.send(INFO, camera_info(K, SIZE))
        sleep(0.1)


def stamp(index: int) -> int:
    return START + index * PERIOD


def play(publisher: Peer, images: list[Any], first: int = 0, pause: float = 0.0) -> None:
    for i, gray in enumerate(images, first):
        publisher.send(IMAGE, image(gray, stamp_ns=stamp(i)))
        sleep(pause)


def paired(index: int) -> Callable[[dict[str, list[Any]]], bool]:
    """Return the condition that a pair of an image was published."""
    return lambda received: any(stamp_ns(m.header) == stamp(index) for m in received[RELATIVE])


def reported(text: str) -> Callable[[dict[str, list[Any]]], Any]:
    """Return the condition that diagnostics contain a text; its value is their values."""
    return lambda received: next((values(m) for m in reversed(received['/diagnostics'])
                                  if m.status[0].message == text), None)


def values(diagnostics: Any) -> dict[str, str]:
    return {pair.key: pair.value for pair in diagnostics.status[0].values}


def wait_for_log(node: NodeProcess, text: str, seconds: float = 2 * PATIENCE) -> str:
    """Wait for a line in the node's log, and return it."""
    end = monotonic() + seconds
    while monotonic() < end:
        for line in node.log.splitlines():
            if text in line:
                return line
        sleep(0.05)
    raise AssertionError(f'{text!r} is not in the log:\n{node.log}')


def filmed(images: list[Any], folder: Path) -> FrameSequence:
    """Return the images as a sequence in files, with the measurements of an IMU."""
    folder.mkdir()
    paths = [folder / f'{i:06}.png' for i in range(len(images))]
    for path, pixels in zip(paths, images):
        assert cv2.imwrite(str(path), pixels)
    felt = feel(np.array(WAY), PERIOD * 1e-9, Mems(), 0)
    return FrameSequence(
        'cards', ImageFiles(paths), Intrinsics(K),
        np.array([stamp(i) for i in range(len(images))]), None,
        ImuTrack(START + felt.stamps_ns, felt.rates, felt.accelerations, felt.to_camera))


@pytest.mark.parametrize(('base_frame', 'imu'), [
    ('', ''), ('base_link', ''), ('', 'from tf'), ('', 'as given')],
    ids=['camera', 'base_frame', 'imu', 'imu_rotation'])
def test_live_poses_equal_those_of_djet_replay_bit_for_bit(
        node, publisher, subscriber, drive, tmp_path, base_frame, imu):
    if base_frame or imu == 'from tf':
        pytest.importorskip('tf2_ros', reason='tf2_ros_py is not installed')
    mounting = MAKE.frame(0, 'base_link', 'camera', AHEAD)
    sequence = filmed(drive, tmp_path / 'images')
    write_kitti_bag(sequence, tmp_path / 'plain')
    with Bag(tmp_path / 'plain') as plain, ResultBag(tmp_path / 'bag') as whole:
        whole.write('/tf_static', mounting, 0)
        for one in plain.messages():
            whole.write(one.topic, one.message, one.stamp_ns)
    parameters = tmp_path / 'fast.yaml'
    rotation = (Rotation.from_matrix(sequence.imu.to_camera).as_quat().tolist()
                if imu == 'as given' else '""')
    parameters.write_text('/**: {ros__parameters: {estimator: {max_features: 600}, odometry: '
                          f'{{base_frame: "{base_frame}", imu: {str(bool(imu)).lower()}, '
                          f'imu_rotation: {rotation}}}}}}}')
    replay = subprocess.run(
        [sys.executable, '-c', 'from djet_ros.cli.main import main; raise SystemExit(main())',
         'replay', tmp_path / 'bag', '--output', tmp_path / 'out', '--config', parameters],
        env=ENVIRONMENT, capture_output=True, text=True, check=False)
    assert replay.returncode == 0, replay.stderr
    poses = [topic for topic in TYPES if topic != '/diagnostics']
    with Bag(tmp_path / 'out' / 'bag') as bag:
        expected = {topic: [serialised(m.message) for m in bag.messages({topic})]
                    for topic in poses}

    with BagRecording(tmp_path / 'bag', auxiliary={'imu': None} if imu else {}) as source:
        # Published before the node starts, as on a robot: its reception cannot be observed.
        publisher.advertise('/tf_static', TF_TYPE, 0, durability='transient_local')
        for frames in source.static_frames():
            publisher.send('/tf_static', frames)
        node('-r', 'image:=/camera/image_rect', '-r', f'imu:={IMU_TOPIC}', '--params-file',
             str(parameters), **{'ros.queue_policy': 'every'})
        if imu:
            publisher.advertise(IMU_TOPIC, 'sensor_msgs/msg/Imu')
        publisher.advertise(source.info_topic, INFO_TYPE)
        publisher.advertise(source.image_topic, IMAGE_TYPE)
        # Until the node knows all publishers, as they know the node.
        publisher.send(source.info_topic, camera_info(K, SIZE))
        subscriber.wait('readiness', reported('waiting for an image'))
        sleep(0.5)
        for message in source.messages():
            if message.topic != '/tf_static':
                publisher.send(message.topic, message.message)
    subscriber.wait('the last pair', paired(len(drive) - 1))
    subscriber.wait('all odometry',
                    lambda received: len(received[f'{NODE}/odometry']) == len(drive))
    assert len(expected[RELATIVE]) == len(drive) - 1
    last = subscriber.wait('the last word', lambda received: (
        found := reported('waiting for an image')(received))['frames processed'] == '12' and found)
    assert last.get('gyro samples', '0') == str(len(sequence.imu.rates) if imu else 0)
    for topic in poses:
        assert [serialised(m) for m in subscriber.received[topic]] == expected[topic]


# The camera

def test_only_the_images_need_a_name(node, publisher, subscriber, drive):
    one = node('-r', 'image:=/robot/left/image_raw', **EVERY)
    wait_for_log(one, 'images from /robot/left/image_raw, camera_info from '
                      '/robot/left/camera_info')


def test_remapping_of_camera_info_to_its_default_name_is_respected(node):
    one = node('-r', 'image:=/front/image_raw', '-r', 'camera_info:=/camera_info', **FAST)
    wait_for_log(one, 'images from /front/image_raw, camera_info from /camera_info')


def test_missing_inputs_are_logged_with_their_resolved_names(node, publisher, drive):
    one = node('-r', 'camera_info:=/elsewhere/info', **FAST)
    # Its own debug_image is an image, too, and not meant.
    for what, topic in (('image', IMAGE), ('camera_info', '/elsewhere/info')):
        line = wait_for_log(one, f'waiting for {what} on {topic}: it has no publisher')
        assert 'did you mean' not in line
    publisher.advertise('/elsewhere/info', INFO_TYPE)
    wait_for_log(one, 'waiting for camera_info on /elsewhere/info: no messages arrive from '
                      '/camera_driver')


@pytest.mark.parametrize('case', SEEN)
def test_missing_input_is_logged_with_a_likely_topic_or_parameter(node, publisher, case):
    topic, kind, line = SEEN[case]
    one = node(**FAST)
    publisher.advertise(topic, kind, listeners=0)
    wait_for_log(one, line)


def test_latched_camera_info_from_before_the_start_is_received(
        node, publisher, subscriber, drive):
    publisher.advertise(INFO, INFO_TYPE, listeners=0, durability='transient_local', depth=1)
    publisher.send(INFO, camera_info(K, SIZE))
    node(**EVERY)
    publisher.advertise(IMAGE, IMAGE_TYPE)
    subscriber.wait('readiness', reported('waiting for an image'))
    play(publisher, drive[:3])
    subscriber.wait('a pair', paired(2))


def test_late_and_periodic_camera_info(node, publisher, subscriber, drive):
    node(**EVERY)
    publisher.advertise(INFO, INFO_TYPE)
    publisher.advertise(IMAGE, IMAGE_TYPE)
    play(publisher, drive[:3])
    # Topics are not in order with one another: all three images have to be there first.
    waiting = reported('waiting for camera_info')
    subscriber.wait('a complaint about each', lambda received: (waiting(received) or {}).get(
        'frames dropped: waiting_for_camera_info') == '3')
    for i in range(3, 8):
        publisher.send(INFO, camera_info(K, SIZE, stamp_ns=stamp(i)))
        play(publisher, drive[i:i + 1], first=i, pause=0.1)
    subscriber.wait('a pair', paired(7))
    last = subscriber.wait('tracking', reported('tracking'))
    assert last['frames dropped: waiting_for_camera_info'] == '3'
    assert 'status: SIZE_CHANGED' not in last


def test_camera_driver_may_be_restarted(
        node, publisher, subscriber, drive):
    one = node(**EVERY)
    for i, victim in enumerate((publisher, Peer('camera_driver'))):
        camera(victim)
        play(victim, drive[4 * i:4 * i + 4], first=4 * i)
        subscriber.wait('a pair', paired(4 * i + 3))
        subscriber.received.clear()
        victim.kill()
        subscriber.wait('silence', reported('waiting for an image'))
        wait_for_log(one, f'waiting for image on {IMAGE}: it has no publisher')
        subscriber.received.clear()
    again = Peer('camera_driver')
    camera(again)
    play(again, drive[8:10], first=8)
    subscriber.wait('a pair', paired(9))
    last = subscriber.wait('all images', lambda received: (found := reported('tracking')(received))
                           and found['frames processed'] == '10' and found)
    again.close()
    # The gaps were no longer than max_gap in the images' own time.
    assert (last['status: FIRST_FRAME'], last['status: OK']) == ('1', '9')


def test_compressed_images_are_tracked(node, publisher, subscriber, drive):
    node(**EVERY, **{'ros.image_transport': 'compressed'})
    publisher.advertise(f'{IMAGE}/compressed', 'sensor_msgs/msg/CompressedImage')
    publisher.advertise(INFO, INFO_TYPE)
    publisher.send(INFO, camera_info(K, SIZE))
    subscriber.wait('readiness', reported('waiting for an image'))
    for i, gray in enumerate(drive[:3]):
        jpeg = cv2.imencode('.jpg', gray)[1].tobytes()
        publisher.send(f'{IMAGE}/compressed', compressed(jpeg, 'jpeg', stamp(i)))
    subscriber.wait('a pair', paired(2))


def test_best_effort_camera_is_received(node, publisher, subscriber, drive):
    node(**FAST)
    camera(publisher, reliability='best_effort')
    play(publisher, drive[:4], pause=0.3)
    subscriber.wait('a pair', paired(3))


@pytest.mark.parametrize(('parameters', 'remedy'), [
    ({**FAST, f'qos_overrides.{IMAGE}.subscription.reliability': 'reliable'},
     'ros.qos_reliability to best_effort'),
    (EVERY, 'ros.queue_policy to latest')], ids=['override', 'every'])
def test_incompatible_qos_is_logged_with_both_profiles(
        node, publisher, subscriber, drive, parameters, remedy):
    one = node(**parameters)
    publisher.advertise(IMAGE, IMAGE_TYPE, listeners=0, reliability='best_effort')
    line = wait_for_log(one, f'incompatible QoS on {IMAGE}')
    assert '/camera_driver offers best_effort, volatile' in line
    assert '/vo_node requests reliable, volatile' in line
    assert f'set {remedy} or qos_overrides.{IMAGE}.subscription.*' in line
    publisher.advertise(INFO, INFO_TYPE)
    assert one.log.count('incompatible QoS') == 1


# Bad messages

BAD_IMAGES = {
    'unknown_encoding': lambda gray: image(gray, 'sepia', stamp_ns=stamp(3)),
    'short_data': lambda gray: image(gray, stamp_ns=stamp(3), data=np.zeros(9, np.uint8)),
    'short_step': lambda gray: image(gray, stamp_ns=stamp(3), step=3),
    'too_large': lambda gray: image(gray, stamp_ns=stamp(3), height=2**31),
    'too_small': lambda gray: image(gray[:8], stamp_ns=stamp(3)),
    'empty': lambda gray: image(gray, stamp_ns=stamp(3), width=0),
    'size_mismatch': lambda gray: image(gray[:100], stamp_ns=stamp(3)),
}


def test_bad_image_is_logged_once_and_tracking_continues(
        node, publisher, subscriber, drive):
    one = node(**EVERY)
    camera(publisher)
    for round_, (reason, make) in enumerate(BAD_IMAGES.items()):
        subscriber.received.clear()
        # The camera restarts each time.
        assert publisher.call('reset')['success'], round_
        play(publisher, drive[:3])
        for _ in range(3):
            publisher.send(IMAGE, make(drive[3]))
        play(publisher, drive[4:6], first=4)
        subscriber.wait(f'a pair after {reason}', paired(5))
        assert paired(4)(subscriber.received)
        bad, = (m for m in subscriber.received['/diagnostics']
                if m.status[0].message == f'message rejected: {reason}')
        assert bad.status[0].level == 2
        subscriber.wait('tracking', reported('tracking'))
        assert one.log.count(f'message rejected: {reason}: ') == 1


def test_black_images_lead_to_lost_and_good_ones_recover(
        node, publisher, subscriber, drive):
    node(**EVERY)
    camera(publisher)
    play(publisher, drive[:2])
    play(publisher, [np.zeros_like(drive[0])] * 4, first=2)
    subscriber.wait('lost', reported('lost: TOO_FEW_MATCHES'))
    play(publisher, drive[2:4], first=6)
    subscriber.wait('a pair', paired(7))


def test_bad_camera_info_is_reported_until_a_good_one_arrives(
        node, publisher, subscriber, drive):
    one = node(**EVERY)
    publisher.advertise(INFO, INFO_TYPE)
    publisher.advertise(IMAGE, IMAGE_TYPE)
    bad = {
        'uncalibrated': camera_info(np.zeros((3, 3)), SIZE, p=np.zeros(12)),
        'bad_calibration': camera_info(K * np.nan, SIZE),
        'unknown_distortion': camera_info(K, SIZE, d=np.ones(5), distortion_model='fancy'),
    }
    for i, (reason, info) in enumerate(bad.items()):
        publisher.send(INFO, info)
        publisher.send(INFO, info)
        sleep(0.1)
        play(publisher, drive[i:i + 1], first=i)
        subscriber.wait(reason, reported(f'message rejected: {reason}'))
        wait_for_log(one, f'message rejected: {reason}: ')
    publisher.send(INFO, camera_info(K, SIZE))
    sleep(0.1)
    play(publisher, drive[3:5], first=3)
    subscriber.wait('a pair', paired(4))
    publisher.send(INFO, camera_info(K, SIZE, roi=roi(0, 0, 160, 120)))
    sleep(0.1)
    play(publisher, drive[5:6], first=5)
    subscriber.wait('a complaint', reported('message rejected: size_mismatch'))


# Time

def test_looping_bag_resets_the_odometry(node, publisher, subscriber, drive):
    node(**EVERY)
    camera(publisher)
    play(publisher, drive[:8])
    play(publisher, drive[:8])
    subscriber.wait('two rounds', lambda received: len(received[f'{NODE}/odometry']) == 16)
    odometry = [serialised(m) for m in subscriber.received[f'{NODE}/odometry']]
    assert odometry[:8] == odometry[8:]
    assert reported('restarted: TIME_JUMP')(subscriber.received)


def test_late_image_does_not_reset_the_odometry(node, publisher, subscriber, drive):
    one = node(**EVERY)
    camera(publisher)
    play(publisher, drive[:6])
    publisher.send(IMAGE, image(drive[3], stamp_ns=stamp(5) - PERIOD // 2))
    play(publisher, drive[6:8], first=6)
    subscriber.wait('a pair', paired(7))
    last = subscriber.wait('tracking', lambda received: (reported('tracking')(received) or {}).get(
        'frames received') == '9' and reported('tracking')(received))
    assert last['frames dropped: late'] == '1'
    assert 'restarted' not in one.log


def test_camera_with_zero_stamps_is_reported(node, publisher, subscriber, drive):
    one = node(**EVERY)
    camera(publisher)
    for gray in drive:
        publisher.send(IMAGE, image(gray, stamp_ns=0))
    last = subscriber.wait('the complaint', reported('started; stamps stand still'))
    assert 'the camera driver has to stamp' in last['to mend: stamps stand still']
    wait_for_log(one, 'stamps stand still: ')


def test_messages_have_image_stamps_and_diagnostics_simulated_time(
        node, publisher, subscriber, drive):
    node(**EVERY, use_sim_time=True)
    publisher.advertise('/clock', 'rosgraph_msgs/msg/Clock')
    camera(publisher)
    time = header(777 * 10**9).stamp
    for _ in range(100):
        # The first may be sent before the node knows the sender.
        publisher.send('/clock', message_type('rosgraph_msgs/msg/Clock')(clock=time))
        sleep(0.1)
        if any(m.header.stamp.sec == 777 for m in list(subscriber.received['/diagnostics'])):
            break
    subscriber.received.clear()
    play(publisher, drive[:3])
    subscriber.wait('a pair', paired(2))
    subscriber.wait('diagnostics', reported('tracking'))
    assert {m.header.stamp.sec for m in subscriber.received['/diagnostics']} == {777}
    assert [stamp_ns(m.header) for m in subscriber.received[RELATIVE]] == [stamp(1), stamp(2)]


def test_a_bag_that_is_played_slowly_loses_no_masks(node, publisher, subscriber, drive):
    node(**EVERY, use_sim_time=True, **{'odometry.mask': True})
    camera(publisher)
    publisher.advertise('/clock', 'rosgraph_msgs/msg/Clock')
    publisher.advertise('/mask', IMAGE_TYPE)
    clock, odometry = message_type('rosgraph_msgs/msg/Clock'), f'{NODE}/odometry'
    now = START

    def run_slowly(seconds: float) -> None:
        nonlocal now
        end = monotonic() + seconds
        while monotonic() < end:
            now += 500_000
            publisher.send('/clock', clock(clock=header(now).stamp))
            sleep(0.025)

    run_slowly(0.5)
    for i, gray in enumerate(drive[:3]):
        play(publisher, [gray], first=i)
        run_slowly(0.8)
        assert len(subscriber.received[odometry]) == i
        publisher.send('/mask', image(np.full_like(gray, 255), stamp_ns=stamp(i)))
        subscriber.wait('odometry', lambda received, n=i + 1: len(received[odometry]) == n)


# Services

def test_pause_and_resume(node, publisher, subscriber, drive):
    node(**EVERY)
    camera(publisher)
    play(publisher, drive[:3])
    subscriber.wait('a pair', paired(2))
    assert publisher.call('pause') == {
        'success': True, 'message': 'paused: images are dropped and counted until ~/resume'}
    play(publisher, drive[3:6], first=3)
    sleep(0.5)
    assert publisher.call('resume')['success']
    play(publisher, drive[6:8], first=6)
    subscriber.wait('a pair', paired(7))
    last = subscriber.wait('tracking', reported('tracking'))
    assert not any(paired(i)(subscriber.received) for i in (3, 4, 5))
    assert reported('paused')(subscriber.received)
    assert last['frames dropped: paused'] == '3'


def test_reset_during_a_stream_discards_everything(node, publisher, subscriber, drive):
    node(**EVERY)
    camera(publisher)
    play(publisher, drive[:6])
    subscriber.wait('a pair', paired(3))
    assert publisher.call('reset')['success']
    subscriber.received.clear()
    play(publisher, drive[8:12], first=100)
    subscriber.wait('a pair', paired(103))
    first = next(m for m in subscriber.received[f'{NODE}/odometry']
                 if stamp_ns(m.header) >= stamp(100))
    assert first.pose.pose.position.x == first.pose.pose.position.z == 0
    assert first.pose.pose.orientation.w == 1
    last = subscriber.wait('tracking', reported('tracking'))
    assert int(last['frames received']) <= 6
    assert last['status: FIRST_FRAME'] == '1'


# Parameters

def test_parameters_from_file_and_command_line(
        node, publisher, tmp_path):
    path = tmp_path / 'own.yaml'
    path.write_text('vo_node: {ros__parameters: {preset: paper, odometry: {max_gap: 3, '
                    'rectified: true, gray_range: [0, 4095]}, estimator: {windw: 5}, '
                    'slam: {loop_gap: 5.0}, '
                    'name_of_robot: r2}}')
    one = node('--params-file', str(path), **{'estimator.loss': 'cauchy'})
    assert publisher.ask('configured', node=NODE, names=[
        'preset', 'estimator.starts', 'estimator.loss', 'odometry.max_gap',
        'odometry.rectified', 'odometry.gray_range']) == [
            'paper', 'five_point', 'cauchy', 3.0, 'true', '0 4095']
    assert "unknown parameter 'estimator.windw'; did you mean 'estimator.window'?" in one.log
    assert "unknown parameter 'name_of_robot'" in one.log
    # The file may serve the pose graph too.
    assert 'slam.loop_gap' not in one.log
    assert 'so it is ignored' not in one.log


def test_parameter_file_for_other_nodes_gives_a_warning(tmp_path):
    path = tmp_path / 'own.yaml'
    path.write_text('vo_node: {ros__parameters: {odometry: {max_gap: 3}}}')
    with nodes(tmp_path, IMAGE) as start:
        one = start('-r', '__ns:=/left', '--params-file', str(path))
        wait_for_log(one, f'{path}: it has parameters for /vo_node and none for /left/vo_node, '
                          "so it is ignored; name the node in the file, or use '/**' for all "
                          'nodes')


def test_parameter_change_is_applied_or_rejected_with_the_reason(
        node, publisher, subscriber, drive):
    node(**EVERY)
    camera(publisher)
    play(publisher, drive[:3])
    subscriber.wait('a pair', paired(2))
    answers = publisher.ask('configure', node=NODE, values={
        'odometry.odom_frame': 'world', 'odometry.max_gap': 2, 'estimator.window': 4,
        'estimator.max_features': 10**6, 'estimator.loss': 'hubber', 'ros.queue_size': 3,
        'odometry.scale': 'ground_truth', 'odometry.max_lost': 'many', 'ros.publish_tf': True,
        'ros.publish_path': True})
    assert [good for good, _ in answers] == [False, True] + [False] * 6 + [True, True]
    reasons = [reason for _, reason in answers]
    assert 'read-only' in reasons[0]
    assert 'Max: 20000' in reasons[3]
    assert reasons[4].startswith("estimator.loss is 'hubber'; choose from none, huber, cauchy")
    assert 'read-only' in reasons[5]
    assert 'which is available offline only; choose from structure, none, constant' in reasons[6]
    assert reasons[6].count('ground_truth') == 1
    assert publisher.ask('configure', node=NODE, values={'odometry.scale': 'none'})[0][0]
    play(publisher, drive[3:5], first=3)
    subscriber.wait('all odometry', lambda received: len(received[f'{NODE}/odometry']) == 5)
    # without a scale each translation has length one
    lengths = [np.linalg.norm(pose_of(m)[1][:3, 3])
               for m in subscriber.received[f'{NODE}/relative_pose']]
    assert [length == pytest.approx(1, abs=1e-9) for length in lengths[-3:]] == [False, True, True]
    assert publisher.ask('configured', node=NODE, names=[
        'odometry.max_gap', 'estimator.window']) == [2.0, 5]


@pytest.mark.parametrize(('values', 'topic'), [
    ({'ros.publish_path': True}, f'{NODE}/path.publisher'),
    ({'odometry.mask': True}, '/mask.subscription')])
def test_topic_that_cannot_be_created_is_rejected_and_the_node_continues(
        node, publisher, subscriber, drive, values, topic):
    node('-p', f'qos_overrides.{topic}.reliability:=perhaps', **EVERY)
    camera(publisher)
    for _ in range(2):
        (done, reason), = publisher.ask('configure', node=NODE, values=values)
        assert not done
        assert "'perhaps'" in reason
    assert publisher.ask('configured', node=NODE, names=[*values]) == [False]
    play(publisher, drive[:3])
    subscriber.wait('a pair', paired(2))


@pytest.mark.parametrize(('values', 'asks'), [
    ({'odometry.imu': True}, 'odometry.imu is true without an odometry.imu_rotation'),
    ({'odometry.guess': True}, 'odometry.guess is true'),
    ({'odometry.scale': 'guess'}, 'odometry.scale is guess')])
def test_parameter_that_needs_a_missing_module_is_rejected(
        node, publisher, subscriber, drive, values, asks):
    one = node(before='import sys; sys.modules["tf2_ros"] = None; ', **EVERY)
    camera(publisher)
    (done, reason), = publisher.ask('configure', node=NODE, values=values)
    assert not done
    assert reason.startswith(f'{asks}, which needs the Python module tf2_ros: '
                             'sudo apt install ros-$ROS_DISTRO-tf2-ros-py (')
    play(publisher, drive[:3])
    subscriber.wait('a pair', paired(2))
    assert one.process.poll() is None


def test_missing_module_prevents_the_start_with_one_line(tmp_path):
    done = subprocess.run(
        [*command('vo_node', 'import sys; sys.modules["tf2_ros"] = None; '), '--ros-args',
         '-p', 'odometry.base_frame:=base_link'], env=ENVIRONMENT, capture_output=True,
        text=True, timeout=60, check=False)
    assert done.returncode == 2
    line, = done.stderr.splitlines()
    assert line.startswith('vo_node: error: odometry.base_frame is base_link, which needs the '
                           'Python module tf2_ros: ')


def test_scale_change_at_run_time_requires_its_length(node, publisher):
    node()
    for given, taken in (({'odometry.scale': 'camera_height'}, False),
                         ({'odometry.camera_height': 1.65}, True),
                         ({'odometry.scale': 'camera_height'}, True),
                         ({'odometry.camera_height': 0.0}, False)):
        (done, reason), = publisher.ask('configure', node=NODE, values=given)
        assert done is taken
        assert ('odometry.camera_height is 0; give the metres' in reason) is not taken
    assert publisher.ask('configured', node=NODE, names=[
        'odometry.scale', 'odometry.camera_height']) == ['camera_height', 1.65]


def test_preset_change_at_run_time_sets_the_estimator(node, publisher):
    node()
    answers = publisher.ask('configure', node=NODE, values={'preset': 'paper'})
    assert answers == [[True, '']]
    assert publisher.ask('configured', node=NODE, names=['preset', 'estimator.starts']) == [
        'paper', 'five_point']


def test_param_dump_and_load_round_trip(node, publisher):
    node()
    features = 'estimator.max_features'
    # in the order of ros2 param load, which sets them one by one
    for values in ({features: 1000}, {features: 1000, 'preset': 'best'}):
        assert publisher.ask('configure', node=NODE, values=values) == [[True, '']] * len(values)
        assert publisher.ask('configured', node=NODE, names=[features, 'preset']) == [1000, 'best']


BROKEN_YAML = '/**: {ros__parameters: {estimator: '


@pytest.mark.parametrize(('arguments', 'reason'), [
    (['-p', 'estimator.window:=4'], 'estimator.window is 4; it must be odd'),
    (['-p', 'odometry.scale:=ground_truth'], 'available offline only'),
    (['-p', 'odometry.scale:=camera_height'], 'give the metres from the ground to the camera'),
    (['-p', 'nonsense'], "Couldn't parse parameter override rule: '-p nonsense'"),
    (['--params-file', '/no/such.yaml'], "Couldn't parse params file: '--params-file /no/such"),
    (['--params-file', 'broken.yaml'], "Couldn't parse params file: '--params-file broken.yaml"),
    (['-r', 'image=x'], "Couldn't parse remap rule: '-r image=x'"),
    (['-r', 'image:=/bad//name'], "Couldn't parse remap rule: '-r image:=/bad//name'"),
    (['-r', '__node:=bad-name'], "Couldn't parse remap rule: '-r __node:=bad-name'"),
    (['--log-level', 'shout'], "Couldn't parse log level: '--log-level shout'"),
    (['--no-such-flag'], '--no-such-flag'),
    (['--', '-x'], "unrecognized argument '-x'; ROS arguments, such as -r image:="),
    (['-p', 'qos_overrides./image.subscription.reliability:=maybe'],
     "/image does not accept qos_overrides./image.* = {'subscription.reliability': 'maybe'"),
    (['-p', 'qos_overrides./image.subscription.depth:=many'],
     '}: a value has the wrong type'),
])
def test_user_error_ends_the_node_with_one_line_and_exit_code_2(tmp_path, arguments, reason):
    (tmp_path / 'broken.yaml').write_text(BROKEN_YAML)
    done = subprocess.run([*command('vo_node'), '--ros-args', *arguments], env=ENVIRONMENT,
                          capture_output=True, text=True, timeout=60, check=False, cwd=tmp_path)
    assert done.returncode == 2
    line, = done.stderr.splitlines()
    assert line.startswith('vo_node: error: ')
    assert reason in line


@pytest.mark.parametrize(('variable', 'value', 'reason'), [
    ('ROS_DOMAIN_ID', 'abc', 'ROS_DOMAIN_ID is not an integral number'),
    ('CYCLONEDDS_URI', '<bad', 'error creating node; check'),
    ('ROS_LOG_DIR', '/proc/none', "log directory '/proc/none'")])
def test_environment_error_is_not_reported_as_command_line_error(variable, value, reason):
    if variable == 'CYCLONEDDS_URI' and 'cyclone' not in ENVIRONMENT.get('RMW_IMPLEMENTATION', ''):
        pytest.skip('another middleware')
    done = subprocess.run(command('vo_node'), env={**ENVIRONMENT, variable: value},
                          capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    last = done.stderr.splitlines()[-1]
    assert last.startswith('vo_node: error: the ROS node could not be created: ')
    assert reason in last
    assert 'check the log lines above, if any, and the environment: ROS_DOMAIN_ID' in last
    assert 'Traceback' not in done.stderr


# Outputs on demand

def test_path_tf_and_debug_image_are_published_on_demand(
        node, publisher, subscriber, drive):
    node(**EVERY, **{'ros.publish_path': True, 'ros.path_period': 0.0,
                     'ros.publish_tf': True})
    camera(publisher)
    extra = {'/tf': 'tf2_msgs/msg/TFMessage', f'{NODE}/path': 'nav_msgs/msg/Path',
             f'{NODE}/debug_image': IMAGE_TYPE}
    viewer = Peer('viewer')
    for topic, kind in extra.items():
        viewer.listen(topic, kind)
        viewer.ask('published', topic=topic)
    sleep(0.5)
    play(publisher, drive[:4])
    viewer.wait('pictures', lambda received: len(received[f'{NODE}/debug_image']) == 3)
    picture = viewer.received[f'{NODE}/debug_image'][-1]
    assert (picture.width, picture.height, picture.encoding) == (*SIZE, 'bgr8')
    assert [len(m.poses) for m in viewer.received[f'{NODE}/path']] == [1, 2, 3, 4]
    transform = viewer.received['/tf'][-1].transforms[0]
    assert (transform.header.frame_id, transform.child_frame_id) == ('odom', 'camera_body')
    viewer.ask('unsubscribe', topic=f'{NODE}/debug_image')
    sleep(0.5)
    play(publisher, drive[4:6], first=4)
    subscriber.wait('a pair', paired(5))
    assert len(viewer.received[f'{NODE}/debug_image']) == 3
    viewer.close()


def test_odometry_is_of_the_base_frame_and_the_camera_keeps_its_tf_parent(
        node, publisher, subscriber, drive):
    pytest.importorskip('tf2_ros', reason='tf2_ros_py is not installed')
    one = node(**EVERY, **{'odometry.base_frame': 'base_link', 'ros.publish_tf': True})
    camera(publisher)
    listener = Peer('listener')
    listener.listen('/tf', 'tf2_msgs/msg/TFMessage')
    listener.ask('published', topic='/tf')
    play(publisher, drive[:3])
    subscriber.wait('pairs', paired(2))
    wait_for_log(one, "tf has no transform from 'base_link' to 'camera'")
    assert not subscriber.received[f'{NODE}/odometry']
    publisher.advertise('/tf_static', TF_TYPE, durability='transient_local', depth=1)
    publisher.send('/tf_static', MAKE.frame(0, 'base_link', 'camera', AHEAD))
    for i in range(3, 12):
        # There is no event for the arrival of the mounting.
        play(publisher, drive[i:i + 1], first=i, pause=0.3)
    listener.wait('the vehicle', lambda received: received['/tf'] and stamp_ns(
        received['/tf'][-1].transforms[0].header) == stamp(11))
    frames = {(one.header.frame_id, one.child_frame_id) for message in listener.received['/tf']
              for one in message.transforms}
    assert frames == {('odom', 'base_link')}
    odometry = subscriber.received[f'{NODE}/odometry'][-1]
    assert odometry.child_frame_id == 'base_link'
    # it drives ahead, and keeps to the plane on which it drives
    position = odometry.pose.pose.position
    assert position.x > 0.5
    assert abs(position.z) < 0.2 * position.x
    assert odometry.twist.twist.linear.x > 0
    # A known mounting needs no subscription any more.
    publisher.ask('alone', topic='/tf_static')
    listener.close()


def test_speed_topic_gives_the_length(node, publisher, subscriber, drive):
    node('-r', 'speed_odometry:=/wheels/odom', **EVERY, **{'odometry.scale': 'speed'})
    camera(publisher)
    publisher.advertise('/wheels/odom', TYPES[f'{NODE}/odometry'])
    vector = message_type('geometry_msgs/msg/Vector3')
    twist = message_type('geometry_msgs/msg/Twist')(
        linear=vector(x=2.0, y=0.0, z=0.0), angular=vector(x=0.0, y=0.0, z=0.0))
    play(publisher, drive[:1])
    subscriber.wait('odometry', lambda received: received[f'{NODE}/odometry'])
    message = subscriber.received[f'{NODE}/odometry'][0]
    for i in range(3):
        message.header = header(stamp(i))
        message.twist.twist = twist
        publisher.send('/wheels/odom', message)
    sleep(0.3)
    play(publisher, drive[1:3], first=1)
    subscriber.wait('a pair', paired(2))
    translation = subscriber.received[RELATIVE][-1].pose.position
    # The steps are of one length, by the speeds and by what the images share.
    assert np.linalg.norm([translation.x, translation.y, translation.z]) == pytest.approx(
        0.2, rel=0.02)


# Load and end

def test_every_image_is_accounted_for_under_load(node, publisher, subscriber, drive):
    node(**{'estimator.max_features': 5000, 'estimator.fast_threshold': 2,
            'ros.qos_reliability': 'reliable', 'ros.qos_depth': 1000})
    camera(publisher)
    for round_ in range(4):
        play(publisher, drive, first=100 * round_)
    last = subscriber.wait('all', lambda received: next(
        (values(m) for m in received['/diagnostics'] if values(m)['frames received'] == '48'),
        None))
    assert int(last['frames dropped: queue_full']) > 0
    assert int(last['frames processed']) + int(last['frames dropped']) == 48


def test_images_beyond_the_queue_limit_are_dropped_and_reported(
        node, publisher, subscriber, drive):
    room, sent = 10 * drive[0].nbytes, 60
    node(before=f'from djet_ros.live import session; session.MAX_QUEUE_BYTES = {room}; ',
         **{'estimator.max_features': 5000, 'estimator.fast_threshold': 2,
            'ros.queue_policy': 'every'})
    camera(publisher)
    for round_ in range(sent // len(drive)):
        play(publisher, drive, first=100 * round_, pause=0.01)
    last = subscriber.wait('all', lambda received: next(
        (values(m) for m in received['/diagnostics'] if values(m)['frames received'] == str(sent)),
        None))
    assert int(last['frames dropped: queue_full']) > sent // 4
    assert int(last['frames processed']) + int(last['frames dropped']) == sent
    reported = [m.status[0].message for m in subscriber.received['/diagnostics']]
    for complaint in ('images pile up', 'images dropped under load'):
        assert any(complaint in message for message in reported)


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize('policy', ['latest', 'every'])
def test_signal_during_a_stream_ends_the_node_within_a_second(
        node, publisher, subscriber, drive, number, policy):
    one = node(**FAST, **{'ros.queue_policy': policy, 'ros.queue_size': 1})
    camera(publisher)
    stream = Thread(target=play, args=[publisher, drive * 3], kwargs={'pause': 0.03})
    stream.start()
    subscriber.wait('a pair', lambda received: received[RELATIVE])
    code, seconds = one.end(number)
    stream.join()
    assert code == 0
    assert seconds < limit(1)
    sleep(0.3)
    # Whole or not at all.
    assert len({len(subscriber.received[topic]) for topic in (
        RELATIVE, f'{NODE}/relative_pose_cov')}) == 1
    assert not [line for line in one.log.splitlines()
                if not line.startswith(('[INFO]', '[WARN]'))]


def test_a_publisher_has_no_listeners_once_its_node_is_destroyed(tmp_path):
    """An image may take longer than the node waits for it at its end."""
    script = ('import rclpy\n'
              'from djet_ros.ros.middleware import RosPublisher\n'
              'from std_msgs.msg import String\n'
              'rclpy.init()\n'
              'node = rclpy.create_node("ends")\n'
              'publisher = RosPublisher(node.create_publisher(String, "topic", 1))\n'
              'assert publisher.listeners == 0\n'
              'node.destroy_node()\n'
              'print(publisher.listeners)\n')
    run = subprocess.run([sys.executable, '-c', script], capture_output=True, text=True,
                         cwd=tmp_path, timeout=60)
    assert (run.stdout, run.returncode) == ('0\n', 0), run.stderr
