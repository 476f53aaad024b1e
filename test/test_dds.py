"""The odometry on a graph without ROS: player, node and subscriber are processes over real DDS."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
import signal
import struct
import sys
from typing import Any

from cards import Cards, K, pose, SIZE
from commands import limit
from dds_graph import (
    Command,
    ENVIRONMENT,
    needs_dds,
    NODE,
    Peer,
    TYPES,
)
from djet_ros.cli.main import main
from djet_ros.dds.names import Names
from djet_ros.errors import DjetError
from djet_ros.lab.scenes import render_sequence
from djet_ros.live.middleware import Profile
from djet_ros.live.topics import image_topics
from djet_ros.odometry.messages import stamp_ns
from djet_ros.recordings.bag_writers import write_kitti_bag
from djet_ros.recordings.bags import Bag
from djet_ros.recordings.kitti import KittiSequence
from djet_ros.ros.command_line import topic_remappings
import numpy as np
import pytest
from ros_messages import camera_info, IMAGE, image, IMAGE_TYPE, INFO, INFO_TYPE, SEEN, serialised

pytestmark = [needs_dds, pytest.mark.slow]

RECTIFIED = '/camera/image_rect'
FRAMES = 12
ODOMETRY = f'{NODE}/odometry'
EVERY = ('-p', 'ros.queue_policy:=every')
FAST = ('-p', 'estimator.max_features:=500')


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record a rendered drive."""
    folder = tmp_path_factory.mktemp('drive')
    sequence = render_sequence('road', folder / 'kitti', FRAMES, 0, (320, 240))
    write_kitti_bag(KittiSequence(sequence), folder / 'bag')
    return folder / 'bag'


@pytest.fixture(scope='module')
def drive() -> list[Any]:
    cards, here, images = Cards(), np.eye(4), []
    for _ in range(6):
        images.append(cards.gray(here))
        here = here @ pose(x=0.25, z=0.15, yaw=0.01)
    return images


@pytest.fixture(scope='module')
def graph_peer() -> Peer:
    return Peer()


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Command]]:
    """Return a function that starts a djet command; it has ended, without a traceback, at last."""
    started: list[Command] = []

    def run(*arguments: str | Path, before: str = '') -> Command:
        started.append(Command(tmp_path / f'{arguments[0]}_{len(started)}.log', *arguments,
                               before=before))
        return started[-1]

    yield run
    for one in started:
        if one.process.poll() is None:
            one.end()
    for one in started:
        assert 'Traceback' not in one.log, one.log


@pytest.fixture
def live(start: Callable[..., Command], graph_peer: Peer) -> Iterator[Callable[..., Command]]:
    """Return a function that starts djet live, and waits until its topics are there."""
    def run(*arguments: str, topic: str = IMAGE, before: str = '') -> Command:
        one = start('live', '-r', f'image:={topic}', *arguments, before=before)
        for output in TYPES:
            graph_peer.wait(output, lambda output=output: graph_peer.graph.publishers_of(output))
        for messages in graph_peer.received.values():
            messages.clear()
        return one

    def gone() -> bool:
        return not any(map(graph_peer.graph.publishers_of, TYPES))

    graph_peer.wait('the end of the last node', gone)
    yield run


@pytest.fixture
def peer(graph_peer: Peer) -> Peer:
    return graph_peer


def stamp(index: int) -> int:
    return 50 * 10**9 + index * 100_000_000


def tracked(peer: Peer, stamps: list[int]) -> Callable[[], bool]:
    """Make the condition that these images came out with a pair."""
    return lambda: set(stamps) <= {stamp_ns(message.header)
                                   for message in peer.received[f'{NODE}/relative_pose']}


def test_live_poses_equal_those_of_djet_replay_bit_for_bit(
        live, start, peer, bag, tmp_path):
    assert main(['replay', str(bag), '--output', str(tmp_path / 'out')]) == 0
    poses = [topic for topic in TYPES if topic != '/diagnostics']
    with Bag(tmp_path / 'out' / 'bag') as replayed:
        expected = {topic: [serialised(m.message) for m in replayed.messages({topic})]
                    for topic in poses}
    live(*EVERY, topic=RECTIFIED)
    # Twenty times as fast: the player has to wait for the node.
    player = start('play', bag, '--rate', '20')
    peer.wait('all odometry', lambda: len(peer.received[ODOMETRY]) == FRAMES)
    assert f'{FRAMES} images published on {RECTIFIED}' in player.finish()
    assert len(expected[poses[0]]) == FRAMES - 1
    for topic in poses:
        assert [serialised(m) for m in peer.received[topic]] == expected[topic]


def test_live_poses_with_imu_equal_those_of_djet_replay_bit_for_bit(
        live, start, peer, bag, tmp_path):
    """Its mounting comes over /tf_static."""
    assert main(['replay', str(bag), '--output', str(tmp_path / 'out'), '--imu', 'true']) == 0
    poses = [topic for topic in TYPES if topic != '/diagnostics']
    with Bag(tmp_path / 'out' / 'bag') as replayed:
        expected = {topic: [serialised(m.message) for m in replayed.messages({topic})]
                    for topic in poses}
    live(*EVERY, '-p', 'odometry.imu:=true', '-r', 'imu:=/imu/data_raw', topic=RECTIFIED)
    # The samples have to come although images wait for room.
    player = start('play', bag, '--rate', '20')
    peer.wait('all odometry', lambda: len(peer.received[ODOMETRY]) == FRAMES)
    player.finish()
    for topic in poses:
        assert [serialised(m) for m in peer.received[topic]] == expected[topic]
    assert int((peer.diagnostics() or {})['gyro samples']) > 0


@pytest.mark.parametrize('reliability', ['best_effort', 'reliable'])
def test_every_image_at_the_recorded_rate_is_accounted_for(
        live, start, peer, bag, reliability):
    live('-p', f'ros.qos_reliability:={reliability}', topic=RECTIFIED)
    start('play', bag).finish()

    def all_there() -> bool:
        diagnostics = peer.diagnostics() or {}
        fates = ('processed', 'dropped', 'rejected', 'lost on the way')
        return sum(int(diagnostics.get(f'frames {fate}', 0)) for fate in fates) == FRAMES

    peer.wait('all images', all_there)
    assert int(peer.diagnostics()['frames processed']) > FRAMES // 2
    if reliability == 'reliable':
        assert peer.diagnostics()['frames lost on the way'] == '0'


def test_publisher_waits_while_the_queue_is_full(live, peer, drive):
    # Each end of the connection keeps 32 images, besides those in the queue.
    room = 10 * drive[0].nbytes
    live(*EVERY, *FAST,
         before=f'from djet_ros.live import session; session.MAX_QUEUE_BYTES = {room}; ')
    infos = peer.advertise(INFO, INFO_TYPE)
    images = peer.advertise(IMAGE, IMAGE_TYPE, Profile(depth=None))
    infos.publish(camera_info(K, SIZE))
    peer.spin(0.2)
    sent, waited = 120, 0
    for i in range(sent):
        while not images.publish(image(drive[i % len(drive)], stamp_ns=stamp(i))):
            waited += 1
    assert waited
    diagnostics = peer.wait('all images', lambda: peer.diagnostics(frames_received=str(sent)))
    assert diagnostics['frames processed'] == str(sent)
    assert any('images pile up' in message.status[0].message
               for message in peer.received['/diagnostics'])


def test_node_continues_with_the_next_player(live, start, peer, bag):
    live(*EVERY, *FAST, topic=RECTIFIED)
    for _ in range(2):
        player = start('play', bag, '--loop', '--rate', '5')
        peer.wait('a round', lambda: len(peer.received[ODOMETRY]) > FRAMES)
        player.process.kill()
        player.process.wait()
        # What had been sent until then is still worked on.
        peer.spin(0.5)
        for messages in peer.received.values():
            messages.clear()
    # The state alone: the first images of the second player may be late after the first one's, and
    # a complaint about their order is then in the message.
    diagnostics = peer.wait('silence', lambda: peer.diagnostics(state='waiting for an image'))
    assert int(diagnostics['status: TIME_JUMP']) >= 2


def test_images_of_two_players_are_counted(live, start, peer, bag):
    live(*EVERY, *FAST, topic=RECTIFIED)
    players = [start('play', bag, '--rate', '5') for _ in range(2)]
    for player in players:
        player.finish()
    diagnostics = peer.wait('both', lambda: peer.diagnostics(frames_received=str(2 * FRAMES)))
    assert int(diagnostics['frames processed']) + int(diagnostics['frames dropped']) == 2 * FRAMES


def test_node_waits_for_a_late_camera_info(live, peer, drive):
    live(*EVERY, *FAST)
    images = peer.advertise(IMAGE, IMAGE_TYPE)
    for i in range(3):
        images.publish(image(drive[i], stamp_ns=stamp(i)))
    peer.wait('a complaint', lambda: peer.diagnostics(message='waiting for camera_info',
                                                      frames_received='3'))
    infos = peer.advertise(INFO, INFO_TYPE)
    infos.publish(camera_info(K, SIZE))
    peer.spin(0.2)
    for i in range(3, 6):
        images.publish(image(drive[i], stamp_ns=stamp(i)))
    peer.wait('pairs', tracked(peer, [stamp(4), stamp(5)]))


def test_latched_camera_info_from_before_the_start_is_received(live, peer, drive):
    infos = peer.advertise(INFO, INFO_TYPE, Profile(depth=1, latched=True), listeners=0)
    infos.publish(camera_info(K, SIZE))
    live(*EVERY, *FAST)
    peer.wait('readiness', lambda: peer.diagnostics(message='waiting for an image'))
    images = peer.advertise(IMAGE, IMAGE_TYPE)
    for i in range(2):
        images.publish(image(drive[i], stamp_ns=stamp(i)))
    peer.wait('a pair', tracked(peer, [stamp(1)]))


def test_garbage_on_the_topics_is_reported_and_tracking_continues(
        live, peer, drive):
    from djet_ros.dds.wire import encode
    one = live(*EVERY, *FAST)
    infos, images = peer.advertise(INFO, INFO_TYPE), peer.advertise(IMAGE, IMAGE_TYPE)
    good = encode(image(drive[0], stamp_ns=stamp(9)))
    # The header of CDR alone is the middleware's to check, for it can't even pass that on.
    cdr, pixels = good[:4], good.index(drive[0].tobytes())
    garbage = [cdr + b'garbage', good[:1000], good[:12] + b'\xff' * 4 + good[16:],
               cdr + bytes(4), good[:pixels - 4] + b'\xff\xff\xff\x7f']
    infos.send(b'\0\1\0\0no camera')
    infos.publish(camera_info(K, SIZE))
    peer.spin(0.2)
    for i, rubbish in enumerate(garbage):
        images.publish(image(drive[i], stamp_ns=stamp(i)))
        images.send(rubbish)
    images.publish(image(drive[5], stamp_ns=stamp(5)))
    peer.wait('pairs', tracked(peer, [stamp(i) for i in range(1, 6)]))
    diagnostics = peer.wait('the count', lambda: peer.diagnostics(
        frames_lost_on_the_way=str(len(garbage))))
    assert diagnostics['frames processed'] == '6'
    assert 'could not be read' in one.log


def test_incompatible_qos_is_logged_with_both_profiles(live, peer):
    one = live('-p', 'ros.qos_reliability:=reliable')
    images = peer.advertise(IMAGE, IMAGE_TYPE, Profile(reliable=False), listeners=0)
    peer.wait('the log', lambda: f'incompatible QoS on {IMAGE}' in one.log)
    assert 'offers best_effort, volatile, /vo_node requests reliable, volatile' in one.log
    assert images.listeners == 0


@pytest.mark.parametrize('case', SEEN)
def test_missing_input_is_logged_with_a_likely_topic_or_parameter(live, peer, case):
    topic, kind, line = SEEN[case]
    one = live(*FAST)
    publisher = peer.advertise(topic, kind, listeners=0)
    peer.wait('the log', lambda: line in one.log)
    del publisher  # without references it leaves the graph


def test_services_respond_as_in_ros_on_cyclone_dds(live, peer, drive):
    live(*EVERY, *FAST)
    infos, images = peer.advertise(INFO, INFO_TYPE), peer.advertise(IMAGE, IMAGE_TYPE)
    infos.publish(camera_info(K, SIZE))
    peer.spin(0.2)
    for i in range(2):
        images.publish(image(drive[i], stamp_ns=stamp(i)))
    peer.wait('a pair', tracked(peer, [stamp(1)]))
    for number, (service, (diagnostics, state)) in enumerate({
            'pause': (b'paused: images', 'paused'),
            'resume': (b'resumed: images', 'waiting for an image'),
            'reset': (b'reset: 2 images and', 'waiting for an image')}.items()):
        peer.received['/diagnostics'].clear()
        answer = call(peer, service, number)
        # success, and a text with its length and its terminating zero
        success, length = struct.unpack('<B3xI', answer[:8])
        assert success
        assert answer[8:8 + length].startswith(diagnostics)
        assert answer[8:8 + length].endswith(b'\0')
        diagnostics = peer.wait(state, lambda state=state: peer.diagnostics(message=state))
    assert diagnostics['frames received'] == '0'


def test_request_from_another_middleware_is_logged_and_ignored(live, peer):
    one = live(*FAST)
    requests = peer.graph.advertise_raw(
        f'rq{NODE}/pauseRequest', 'std_srvs::srv::dds_::Trigger_Request_', Profile(), '')
    peer.wait('the service', lambda: requests.listeners)
    requests.send(b'\0\1\0\0\0')
    peer.wait('the log', lambda: 'a request for /vo_node/pause came from another middleware'
              in one.log)
    assert not peer.diagnostics(message='paused')


def test_services_are_absent_to_fast_dds_clients_and_the_log_explains_it(live, peer):
    one = live(*FAST)
    writers, readers = ends(peer, f'{NODE}/reset')
    # rmw_fastrtps waits until there are as many of either
    assert len(writers) != len(readers)
    assert [user_data for user_data in readers if user_data in writers]
    reply = 'std_srvs::srv::dds_::Trigger_Response_'
    peer.graph.listen_raw(f'rr{NODE}/resetReply', reply, lambda *_: None, Profile(), 'clientid=1;')
    peer.graph.listen_raw(f'rr{NODE}/pauseReply', reply, lambda *_: None, Profile(), '')
    peer.wait('the log', lambda: 'a client of /vo_node/pause uses another middleware, and only '
              'clients on Cyclone DDS can be answered; call it with '
              'RMW_IMPLEMENTATION=rmw_cyclonedds_cpp' in one.log)
    assert 'client of /vo_node/reset' not in one.log


def ends(peer: Peer, service: str) -> tuple[list[str], list[str]]:
    """Return the user data of the response writers and of the request readers."""
    from cyclonedds.builtin import (
        BuiltinDataReader, BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription)
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.qos import Policy
    found = []
    participant = DomainParticipant(int(ENVIRONMENT['ROS_DOMAIN_ID']))
    for kind, topic in ((BuiltinTopicDcpsPublication, f'rr{service}Reply'),
                        (BuiltinTopicDcpsSubscription, f'rq{service}Request')):
        reader = BuiltinDataReader(participant, kind)
        some = peer.wait(topic, lambda reader=reader, topic=topic: [
            bytes(one.qos[Policy.Userdata].data).decode() if Policy.Userdata in one.qos else ''
            for one in reader.read(1000) if one.topic_name == topic])
        found.append(some)
    return found[0], found[1]


def test_diagnostics_follow_simulated_time(live, start, peer, bag):
    live(*EVERY, *FAST, '-p', 'use_sim_time:=true', topic=RECTIFIED)
    start('play', bag, '--clock', '--rate', '10').finish()
    peer.wait('tracking', lambda: peer.diagnostics(message='tracking'))
    # The bag was recorded in the seconds 1000 and 1001.
    assert peer.received['/diagnostics'][-1].header.stamp.sec in (1000, 1001)


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signal_during_a_stream_ends_all_processes_within_a_second(live, start, peer, bag, number):
    one = live(*EVERY, topic=RECTIFIED)
    player = start('play', bag, '--loop', '--rate', '10')
    echo = start('echo', '--diagnostics')
    peer.wait('a pair', lambda: peer.received[f'{NODE}/relative_pose'])
    peer.wait('an echo', lambda: 'tracking; path: ' in echo.log)
    for command in (one, player, echo):
        code, seconds = command.end(number)
        assert code == 0, command.path
        assert seconds < limit(1), command.path
    peer.spin(0.3)
    # Whole or not at all.
    assert len({len(peer.received[topic]) for topic in TYPES
                if topic.endswith(('relative_pose', 'relative_pose_cov'))}) == 1


def test_echo_writes_a_line_for_each_pose(live, start, peer, bag):
    echo = start('echo')
    live(*EVERY, *FAST, topic=RECTIFIED)
    peer.spin(0.5)
    start('play', bag, '--rate', '10').finish()

    def lines():
        return [line for line in echo.log.splitlines() if not line.startswith('waiting for ')]

    peer.wait('the lines', lambda: len(lines()) == FRAMES)
    assert all(len(line.split()) == 8 for line in lines())


@pytest.mark.parametrize('arguments', [(), ('--diagnostics',)])
def test_echo_names_the_topic_without_messages(start, peer, arguments):
    echo = start('echo', *arguments)
    peer.wait('a line', lambda: echo.log)
    assert echo.log == 'waiting for /vo_node/odometry: nobody publishes it\n'
    front = peer.graph.advertise('/front/vo_node/odometry', 'nav_msgs/msg/Odometry')
    other = start('echo', *arguments)
    peer.wait('a line', lambda: other.log)
    assert other.log == ('waiting for /vo_node/odometry: nobody publishes it; did you mean '
                         '/front/vo_node/odometry?\n')
    assert front.listeners == 0
    assert echo.end()[0] == 0
    assert echo.log.count('\n') == 1


def call(peer: Peer, service: str, number: int) -> bytes:
    """Call a service of type Trigger as rmw_cyclonedds_cpp does; gives the answer's content."""
    client = f'clientid={number};'
    mine = struct.pack('<Qq', 4711, number)
    answers: list[bytes] = []
    peer.graph.listen_raw(f'rr{NODE}/{service}Reply', 'std_srvs::srv::dds_::Trigger_Response_',
                          lambda data, _: answers.append(data), Profile(), client)
    requests = peer.graph.advertise_raw(
        f'rq{NODE}/{service}Request', 'std_srvs::srv::dds_::Trigger_Request_', Profile(), client)
    peer.wait('the service', lambda: requests.listeners)
    requests.send(b'\0\1\0\0' + mine + b'\0')
    peer.wait('the answer', lambda: answers)
    assert answers[0][4:20] == mine
    return answers[0][20:]


def test_user_configuration_of_cyclone_dds_takes_precedence(tmp_path):
    from djet_ros.dds.graph import Graph
    file = tmp_path / 'cyclone.xml'
    file.write_text('<CycloneDDS><Domain><General><Interfaces><NetworkInterface name="lo"/>'
                    '</Interfaces></General></Domain></CycloneDDS>')
    for uri in (file.read_text(), f'file://{file}'):
        Graph({**ENVIRONMENT, 'ROS_DOMAIN_ID': '232', 'CYCLONEDDS_URI': uri}).close()


def test_ros_localhost_only_is_respected():
    from djet_ros.dds.graph import _configuration
    beyond = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET', 'ROS_STATIC_PEERS': '10.0.0.9'}
    inside = _configuration({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'})
    assert _configuration({'ROS_LOCALHOST_ONLY': '1'}) == inside
    assert _configuration({**beyond, 'ROS_LOCALHOST_ONLY': '1'}) == inside
    for off in ('', '0'):
        assert _configuration({**beyond, 'ROS_LOCALHOST_ONLY': off}) == _configuration(beyond)


def test_graph_can_be_joined_again_after_leaving():
    from djet_ros.dds.graph import Graph
    elsewhere = {**ENVIRONMENT, 'ROS_DOMAIN_ID': '231'}
    with Graph(elsewhere) as first:
        pass
    with Graph(elsewhere) as second:
        assert second is not first


def test_a_topic_is_seen_among_more_than_a_thousand_others():
    from djet_ros.dds.graph import Graph
    elsewhere = {**ENVIRONMENT, 'ROS_DOMAIN_ID': '230'}
    with Graph(elsewhere) as graph:
        writers = [graph.advertise(f'/topic_{number}', 'std_msgs/msg/String')
                   for number in range(1100)]
        writers.append(graph.advertise('/camera/camera_info', 'sensor_msgs/msg/CameraInfo'))
        assert graph.published('sensor_msgs/msg/CameraInfo') == ['/camera/camera_info']


# Without a graph

def test_names_are_resolved_and_remapped_as_in_ros():
    names = Names('vo_node', ['image:=/left/image_raw', '~/odometry:=odom', '__ns:=/robot'])
    assert names.resolve('image') == '/left/image_raw'
    assert names.resolve('camera_info') == '/robot/camera_info'
    assert names.resolve('~/odometry') == '/robot/odom'
    assert names.resolve('~/relative_pose') == '/robot/vo_node/relative_pose'
    assert names.resolve('/diagnostics') == '/diagnostics'
    assert Names('vo_node', ['__node:=front']).resolve('~/path') == '/front/path'
    assert Names('vo_node', ['__ns:=/']).full_node == '/vo_node'


@pytest.mark.parametrize(('rules', 'info'), [
    ([], '/front/camera_info'),
    (['camera_info:=/elsewhere/info'], '/elsewhere/info'),
    # The very name that it would have without images elsewhere.
    (['camera_info:=/camera_info'], '/camera_info'),
    # As launch files hand it on.
    (['camera_info:=camera_info'], '/front/camera_info'),
])
def test_camera_info_is_in_the_image_namespace_unless_remapped(rules, info):
    names = Names('vo_node', ['image:=/front/image_raw', *rules])
    assert image_topics(names.resolve, names.is_remapped, 'raw') == ('/front/image_raw', info)


@pytest.mark.parametrize('rule', [
    'image:=/cam/image_raw', 'image:=/cam/image_raw/compressed',
    'image/compressed:=/cam/image_raw/compressed'])
def test_compressed_topic_may_be_given_with_or_without_its_suffix(rule):
    names = Names('vo_node', [rule])
    assert image_topics(names.resolve, names.is_remapped, 'compressed') == (
        '/cam/image_raw/compressed', '/cam/camera_info')


@pytest.mark.parametrize('rules', [
    ['image/compressed:=/cam/jpeg'],
    ['image:=/cam/image_raw', '/cam/image_raw/compressed:=/cam/jpeg']])
def test_compressed_topic_may_have_any_name(rules):
    names = Names('vo_node', rules)
    assert image_topics(names.resolve, names.is_remapped, 'compressed') == (
        '/cam/jpeg', '/cam/camera_info')


def test_topic_remappings_are_found_in_the_ros_arguments():
    arguments = ['vo_node', '-r', 'no:=rule', '--ros-args', '-r', 'a:=b', '--remap',
                 'vo_node:c:=/c', '-r', 'other:d:=e', '-r', '__ns:=/left', '-r', 'rostopic://f:=g',
                 '--', '-r', 'h:=i']
    assert list(topic_remappings(arguments, 'vo_node')) == [('a', 'b'), ('c', '/c'), ('f', 'g')]


@pytest.mark.parametrize('rule', ['image:=//x', 'image:=/camera/', 'image:=a b', 'image:=/1a',
                                  '__node:=a/b', '__node:='])
def test_invalid_ros_names_are_refused(rule):
    with pytest.raises(DjetError, match='is not a remapping|is not a valid node name'):
        Names('vo_node', [rule])
    with pytest.raises(DjetError, match='is not a valid node name'):
        Names('vö')


@pytest.mark.parametrize(('arguments', 'environment', 'reason'), [
    (['-r', 'image=/x'], {}, "'image=/x' is not a remapping"),
    (['-p', 'ros.queue_size'], {}, 'write it as name:=value'),
    (['-p', 'ros.queue_sise:=2'], {}, "did you mean 'ros.queue_size'"),
    (['-p', 'ros.queue_size:=many'], {}, 'must be of type int'),
    (['-p', 'odometry.scale:=ground_truth'], {}, 'available offline only'),
    (['-p', 'odometry.scale:=constant'], {}, 'give the metres of each translation'),
    ([], {'ROS_DOMAIN_ID': 'home'}, "ROS_DOMAIN_ID is 'home'"),
    ([], {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'HOUSE'}, 'choose from LOCALHOST, SUBNET'),
    ([], {'CYCLONEDDS_URI': '<Cyclone'}, 'check CYCLONEDDS_URI'),
])
def test_user_errors_are_one_line(
        arguments, environment, reason, monkeypatch, capfd, tmp_path):
    for name, value in {'ROS_DOMAIN_ID': '231', 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
                        **environment}.items():
        monkeypatch.setenv(name, value)
    assert main(['live', *arguments]) == 2
    line = capfd.readouterr().err.splitlines()[-1]
    assert line.startswith('djet: error: ')
    assert reason in line


def test_missing_cyclone_dds_is_reported_with_the_install_command(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, 'djet_ros.dds.graph', None)
    for name in [name for name in sys.modules if name.startswith('cyclonedds')]:
        monkeypatch.setitem(sys.modules, name, None)
    for name in [name for name in sys.modules if name.startswith('djet_ros.dds.')]:
        monkeypatch.delitem(sys.modules, name)
    assert main(['echo']) == 2
    assert capsys.readouterr().err == (
        "djet: error: this command needs the Python module 'cyclonedds', which is not installed: "
        "pip install './djet_ros[dds]' (the folder with the README)\n")
