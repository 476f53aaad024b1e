"""The live session: a real tracker, real threads, and a fake graph that records messages."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from sys import getrefcount
from threading import Condition, Event, Thread
from time import monotonic, sleep, time_ns
from typing import Any

from cards import Cards, K, pose, SIZE
from djet_ros.config.flat import from_flat, with_values
from djet_ros.live import session as sessions
from djet_ros.live.rate_limit import RateLimit
from djet_ros.live.session import MAX_QUEUE_BYTES, Session
from djet_ros.odometry.messages import pose_of, stamp_ns
from djet_ros.odometry.tracker import Outgoing, Tracker
import numpy as np
import pytest
from ros_messages import camera_info, header, image, message_type, serialised

PERIOD = 100_000_000
POSES = ('relative_pose', 'relative_pose_cov', 'relative_pose_status', 'odometry')
TOPICS = {'image': '/left/image_raw', 'camera_info': '/left/camera_info'}


class Graph:
    """Records what a session publishes and logs; publishing can be made slow, or fail."""

    def __init__(self) -> None:
        self.batches: list[list[Outgoing]] = []
        self.lines: list[str] = []
        # Transforms on tf: the second frame in the first, by their names.
        self.frames: dict[tuple[str, str], Any] = {}
        self.wanted: set[str] = set()
        self.delay = 0.0
        self.broken = False
        # Publishing stops in the middle of a batch until this is set.
        self.open = Event()
        self.open.set()
        self._changed = Condition()

    def publish(self, outgoing: Any) -> None:
        sleep(self.delay)
        if self.broken:
            raise RuntimeError('the graph is gone')
        batch: list[Outgoing] = []
        self.batches.append(batch)
        for one in outgoing:
            batch.append(one)
            self.open.wait()
        with self._changed:
            self._changed.notify_all()

    def log(self, level: str, text: str) -> None:
        self.lines.append(f'{level}: {text}')

    def why_silent(self, topic: str) -> str:
        return f'nothing is seen of {topic}'

    def now_ns(self) -> int:
        return time_ns()

    def transform(self, parent: str, child: str) -> Any:
        return self.frames.get((parent, child))

    def wants(self, topic: str) -> bool:
        return topic in self.wanted

    def published(self, *topics: str) -> list[Any]:
        """Messages of some topics, in the order of publication."""
        return [one.message for batch in list(self.batches) for one in batch
                if one.topic in topics]

    def wait(self, condition: Callable[[], Any]) -> None:
        with self._changed:
            assert self._changed.wait_for(condition, 20)

    def diagnostics(self) -> dict[str, str]:
        """Return the values of the last diagnostics."""
        return {pair.key: pair.value
                for pair in self.published('/diagnostics')[-1].status[0].values}


class Live:
    """A running session, with its tracker and its graph."""

    def __init__(self, **parameters: Any) -> None:
        config = from_flat({'estimator.max_features': 500, 'ros.queue_policy': 'every',
                            **parameters})
        self.graph = Graph()
        self.tracker = Tracker(config, message_type, image_topic=TOPICS['image'])
        self.session = Session(self.tracker, self.graph, TOPICS)
        self.session.camera_info(camera_info(K, SIZE))

    def send(self, images: list[Any], first: int = 0) -> None:
        for i, gray in enumerate(images, first):
            self.session.image(image(gray, stamp_ns=i * PERIOD))

    def wait_for_images(self, received: int) -> None:
        """Wait until a number of images have been received and processed."""
        end = monotonic() + 20
        while self.tracker.counts.received < received and monotonic() < end:
            sleep(0.005)
        # Other calls get the lock after the image being processed.
        self.session.configure(self.tracker.config)
        assert self.tracker.counts.received == received


@pytest.fixture
def live() -> Iterator[Callable[..., Live]]:
    """Return a function that starts a session; all are stopped in the end."""
    started: list[Live] = []

    def start(**parameters: Any) -> Live:
        one = Live(**parameters)
        one.session.start()
        started.append(one)
        return one

    yield start
    for one in started:
        one.graph.open.set()
        one.session.stop(10)


@pytest.fixture(scope='module')
def drive() -> list[Any]:
    cards, here, images = Cards(), np.eye(4), []
    for _ in range(12):
        images.append(cards.gray(here))
        here = here @ pose(x=0.25, z=0.15, yaw=0.01)
    return images


def offline(images: list[Any], **parameters: Any) -> list[bytes]:
    """Poses of the same images without thread and queue, as on the wire."""
    tracker = Tracker(from_flat({'estimator.max_features': 500, **parameters}), message_type,
                      image_topic=TOPICS['image'])
    tracker.camera_info(camera_info(K, SIZE))
    return [serialised(one.message) for i, gray in enumerate(images)
            for one in tracker.image(image(gray, stamp_ns=i * PERIOD)) if one.topic in POSES]


def test_every_gives_the_poses_of_the_tracker_bit_for_bit(live, drive):
    one = live()
    one.send(drive)
    one.wait_for_images(len(drive))
    assert [serialised(message) for message in one.graph.published(*POSES)] == offline(drive)
    assert not one.tracker.counts.dropped


@pytest.mark.slow
@pytest.mark.parametrize('policy', ['latest', 'every'])
def test_an_image_stamped_ahead_is_dropped_once_the_next_one_has_come(live, drive, policy):
    one = live(**{'ros.queue_policy': policy})
    for i, gray in enumerate(drive):
        one.session.image(image(gray, stamp_ns=(i + 50 * (i == 6)) * PERIOD))
        # a camera's time, also for an image that waits for the next one
        sleep(0.02 if i == 6 else 0.2)
    one.wait_for_images(len(drive))
    assert one.tracker.counts.dropped == {'ahead': 1}
    assert one.tracker.counts.status == {'FIRST_FRAME': 1, 'OK': 10}


def test_image_after_a_gap_is_processed_without_a_next_one(live, drive, monkeypatch):
    monkeypatch.setattr(sessions, '_NEXT_IMAGE_TIMEOUT', 0.05)
    one = live()
    one.send(drive[:2])
    one.send(drive[2:3], first=100)
    one.wait_for_images(3)
    assert one.tracker.counts.status == {'FIRST_FRAME': 1, 'OK': 1, 'TIME_JUMP': 1}


def test_latest_drops_under_load_and_accounts_for_every_image(live, drive):
    one = live(**{'ros.queue_policy': 'latest'})
    one.graph.delay = 0.05
    one.send(drive)
    one.wait_for_images(len(drive))
    counts = one.tracker.counts
    assert counts.dropped['queue_full'] >= len(drive) // 2
    assert counts.processed + counts.dropped.total() == counts.received
    # The newest is never the one that is dropped.
    assert one.tracker.last.stamp_ns == (len(drive) - 1) * PERIOD
    assert 'images dropped: they arrive faster than they are processed' in one.graph.lines[0]


def test_max_rate_skips_images_without_a_complaint(live, drive):
    limit, slow, fast = RateLimit(4.0), live(), live(**{'ros.max_rate': 4.0})
    for i, gray in enumerate(drive):
        if limit.takes(i * PERIOD):
            slow.send([gray], first=i)
    # after a reset the same images are taken
    fast.send(drive[:8])
    fast.session.reset()
    fast.graph.batches.clear()
    fast.send(drive)
    for one in (slow, fast):
        one.wait_for_images(5)
    assert [serialised(message) for message in fast.graph.published(*POSES)] == [
        serialised(message) for message in slow.graph.published(*POSES)]
    fast.session.pause()
    diagnostics = fast.graph.diagnostics()
    assert diagnostics['frames beyond ros.max_rate'] == '7'
    assert diagnostics['frames received'] == diagnostics['frames processed'] == '5'
    assert not any(key.startswith('to mend') for key in diagnostics)
    assert not any('arrive faster' in line for line in fast.graph.lines)
    fast.session.configure(with_values(fast.tracker.config, {'ros.max_rate': 0.0}))
    fast.session.resume()
    fast.send(drive[:3], first=12)
    fast.wait_for_images(8)


@pytest.mark.parametrize('policy', ['latest', 'every'])
def test_endless_publisher_is_limited_in_memory_and_reported(live, drive, policy):
    one = live(**{'ros.queue_policy': policy, 'ros.queue_size': 1000})
    one.graph.open.clear()
    # Each message is another reference to the same one.
    message = image(np.zeros((2000, 3000), np.uint8))
    for _ in range(sent := 300):
        one.session.image(message)
        one.session.mask(message)
    held = getrefcount(message) * len(message.data)
    assert MAX_QUEUE_BYTES < held < 2.2 * MAX_QUEUE_BYTES
    one.graph.open.set()
    one.wait_for_images(sent)
    counts = one.tracker.counts
    assert counts.dropped['queue_full'] == pytest.approx(
        sent - MAX_QUEUE_BYTES / len(message.data), abs=3)
    one.session.pause()
    assert 'images dropped under load' in one.graph.published('/diagnostics')[-1].status[0].message
    assert 'lower the rate (that of a bag player, too)' in one.graph.diagnostics()[
        'to mend: images dropped under load']
    assert any('MB of images are queued' in line for line in one.graph.lines)
    assert 'to mend: images pile up' not in one.graph.diagnostics()


def test_images_lost_in_transport_are_reported(live, drive):
    one = live()
    one.session.count_lost(30)
    one.send(drive)
    one.wait_for_images(len(drive))
    one.session.pause()
    diagnostics = one.graph.diagnostics()
    assert diagnostics['frames lost on the way'] == '30'
    assert '71% of the newest 42 images' in diagnostics['to mend: images lost on the way']
    one.session.reset()
    assert 'to mend: images lost on the way' not in one.graph.diagnostics()


def test_camera_info_applies_to_the_images_after_it(live, drive):
    one = live(**{'ros.queue_size': 12})
    one.graph.open.clear()
    one.send(drive[:4])
    one.session.camera_info(camera_info(K * [[1.05], [1.05], [1]], SIZE))
    one.send(drive[4:8], first=4)
    one.graph.open.set()
    one.wait_for_images(8)
    assert one.tracker.counts.status == {'FIRST_FRAME': 1, 'SIZE_CHANGED': 1, 'OK': 6}
    stamps = [stamp_ns(message.header) for message in one.graph.published('relative_pose')]
    assert 4 * PERIOD not in stamps


# Reset, pause, stop

def test_nothing_from_before_a_reset_is_published_after_it(live, drive):
    one = live(**{'ros.queue_size': 12})
    one.send(drive[:4])
    one.graph.wait(lambda: one.graph.published('relative_pose'))
    one.session.reset()
    before = len(one.graph.batches)
    one.send(drive, first=20)
    one.wait_for_images(len(drive))
    after = [serialised(now.message) for batch in one.graph.batches[before:] for now in batch
             if now.topic == 'odometry']
    assert len(after) == len(drive)
    fresh = live()
    fresh.send(drive, first=20)
    fresh.wait_for_images(len(drive))
    assert after == [serialised(message) for message in fresh.graph.published('odometry')]
    assert one.tracker.counts == fresh.tracker.counts


def test_reset_waits_only_for_the_image_being_processed(live, drive):
    one = live(**{'ros.queue_size': 1000})
    one.graph.delay = 0.05
    for _ in range(40):
        one.send(drive)
    start = monotonic()
    for _ in range(5):
        one.session.configure(one.tracker.config)
    assert monotonic() - start < 5 * 0.4
    assert one.tracker.counts.received < 40


def test_pause_drops_and_counts_until_resume(live, drive):
    one = live()
    one.send(drive[:3])
    one.wait_for_images(3)
    one.session.pause()
    assert one.graph.published('/diagnostics')[-1].status[0].message == 'paused'
    one.send(drive[3:6], first=3)
    one.wait_for_images(6)
    assert one.tracker.counts.dropped == {'paused': 3}
    one.session.resume()
    one.send(drive[6:8], first=6)
    one.wait_for_images(8)
    assert one.tracker.counts.status == {'FIRST_FRAME': 1, 'OK': 4}
    assert stamp_ns(one.graph.published('relative_pose')[-1].header) == 7 * PERIOD


def test_latencies_are_those_of_processed_images(live, drive):
    """One that is dropped, as during a pause, takes no time."""
    one = live()
    one.session.pause()
    one.send(drive[:3])
    one.wait_for_images(3)
    one.session.resume()
    said = one.graph.published('/diagnostics')[-1].status[0].values
    assert not [value.key for value in said if 'latency' in value.key]


def test_service_calls_are_answered_and_logged(live, drive):
    one = live()
    one.send(drive[:3])
    one.wait_for_images(3)
    answers = [one.session.pause(), one.session.pause(), one.session.resume(),
               one.session.resume(), one.session.reset()]
    assert answers == [
        'paused: images are dropped and counted until ~/resume', 'already paused',
        'resumed: images are processed again', 'not paused',
        'reset: 3 images and their poses discarded; odom starts at the next image']
    one.session.configure(with_values(one.tracker.config, {
        'odometry.odom_frame': 'world', 'odometry.max_gap': 2.0}))
    assert one.graph.lines == [f'info: {answer}' for answer in answers] + [
        'info: parameters from the next image on: odometry.max_gap = 2.0, '
        'odometry.odom_frame = world']


def test_stop_publishes_all_or_no_messages_of_an_image(live, drive):
    one = live()
    one.send(drive[:2])
    one.graph.wait(lambda: one.graph.published('relative_pose'))
    one.graph.open.clear()
    before = len(one.graph.batches)
    one.send(drive[2:4], first=2)
    while len(one.graph.batches) == before:
        sleep(0.001)
    assert [now.topic for now in one.graph.batches[before]] == ['relative_pose']
    Thread(target=lambda: (sleep(0.1), one.graph.open.set())).start()
    one.session.stop(5)
    assert [now.topic for now in one.graph.batches[before]] == list(POSES)
    assert len(one.graph.batches) == before + 1
    one.send(drive[4:6], first=4)
    one.session.pause()
    assert len(one.graph.batches) == before + 1


def test_stop_times_out(live, drive):
    one = live()
    one.graph.open.clear()
    one.send(drive[:1])
    start = monotonic()
    one.session.stop(0.2)
    assert monotonic() - start < 5


def test_endless_images_do_not_delay_a_stop(live, drive):
    one, ended = live(**{'ros.queue_size': 1}), Event()

    def send() -> None:
        while not ended.is_set():
            one.send(drive)

    sender = Thread(target=send)
    sender.start()
    one.graph.wait(lambda: one.graph.published('relative_pose'))
    start = monotonic()
    one.session.stop()
    assert monotonic() - start < 1
    ended.set()
    sender.join(5)
    assert not sender.is_alive()


@pytest.mark.filterwarnings('ignore::pytest.PytestUnhandledThreadExceptionWarning')
def test_error_in_the_worker_thread_is_reported(live, drive):
    one = live()
    assert not one.session.failed
    one.graph.broken = True
    one.send(drive[:3])
    end = monotonic() + 20
    while not one.session.failed and monotonic() < end:
        sleep(0.01)
    assert one.session.failed


# Log messages

def test_bad_images_are_logged_throttled_and_tracking_continues(live, drive):
    one = live()
    one.send(drive[:2])
    for i in range(10):
        one.session.image(image(drive[2], 'sepia', stamp_ns=(2 + i) * PERIOD))
    one.wait_for_images(12)
    line, = one.graph.lines
    assert line.startswith("warning: message rejected: unknown_encoding: image encoding 'sepia'")
    assert one.graph.published('/diagnostics')[-1].status[0].level == 2
    one.send(drive[3:4], first=3)
    one.wait_for_images(13)
    assert one.graph.published('/diagnostics')[-1].status[0].message == 'tracking'
    assert one.graph.lines == [line]


def test_complaints_are_logged_once_with_the_remedy(live, drive):
    one = live()
    for gray in [*drive, *drive]:
        one.session.camera_info(camera_info(K, SIZE, header=header(0, 'odom')))
        one.session.image(image(gray, stamp_ns=0, frame_id='odom'))
    one.wait_for_images(24)
    found = [line for line in one.graph.lines if 'rejected' not in line]
    assert len(found) == 2
    assert found[0].startswith("warning: frame_id is odom_frame: the camera's frame is called")
    assert found[1].startswith('warning: stamps stand still: 5 images in a row have the stamp 0.0')


def test_restart_is_explained_in_the_log(live, drive):
    one = live()
    one.send(drive[:3], first=100)
    one.send(drive[:3])
    one.wait_for_images(6)
    line, = one.graph.lines
    assert line.startswith('warning: restarted: TIME_JUMP: the stamps went back by 10.200 s')


def test_step_back_is_logged_right_after_a_gap(live, drive):
    one = live()
    one.send(drive[:3])
    one.send(drive[3:5], first=100)
    one.send(drive[5:7], first=4)
    one.wait_for_images(7)
    gap, back = one.graph.lines
    assert 'it continues at the last pose' in gap
    assert 'odom jumps to the origin' in back


def test_missing_inputs_are_logged_throttled(live, monkeypatch):
    one = live()
    one.session.camera_info(None)
    one.session.tick()
    assert one.graph.lines == []
    monkeypatch.setattr(sessions, 'SILENCE_TIMEOUT', 0.0)
    for _ in range(3):
        one.session.tick()
    assert one.graph.lines == [
        'warning: waiting for image on /left/image_raw: nothing is seen of /left/image_raw',
        'warning: waiting for camera_info on /left/camera_info: nothing is seen of '
        '/left/camera_info']


def test_silent_camera_is_in_the_diagnostics(live, drive, monkeypatch):
    monkeypatch.setattr(sessions, 'SILENCE_TIMEOUT', 0.2)
    one = live()
    one.send(drive[:3])
    one.wait_for_images(3)
    assert one.graph.published('/diagnostics')[-1].status[0].message == 'tracking'
    assert 'rate (Hz)' in one.graph.diagnostics()
    sleep(1.2)
    one.session.tick()
    status = one.graph.published('/diagnostics')[-1].status[0]
    assert (status.level, status.message) == (1, 'waiting for an image')
    assert 'rate (Hz)' not in one.graph.diagnostics()


def test_diagnostics_are_published_once_per_period(live, drive, monkeypatch):
    monkeypatch.setattr(sessions, '_DIAGNOSTICS_PERIOD', 60.0)
    one = live()
    one.send(drive[:3])
    one.wait_for_images(3)
    count = len(one.graph.published('/diagnostics'))
    for _ in range(5):
        one.session.tick()
    assert len(one.graph.published('/diagnostics')) == count


def test_uncalibrated_camera_is_reported_before_any_image(live, monkeypatch):
    monkeypatch.setattr(sessions, 'SILENCE_TIMEOUT', 0.0)
    one = live()
    one.session.camera_info(camera_info(np.zeros((3, 3)), SIZE, p=np.zeros(12)))
    one.session.tick()
    status = one.graph.published('/diagnostics')[-1].status[0]
    assert (status.level, status.message) == (2, 'message rejected: uncalibrated')
    assert any('calibrate it' in line for line in one.graph.lines)


def test_diagnostics_contain_latency_and_transport_losses(live, drive):
    one = live()
    one.graph.delay = 0.03
    one.session.count_lost(2)
    one.send([*drive, *drive[::-1]])
    one.wait_for_images(24)
    diagnostics = one.graph.diagnostics()
    assert diagnostics['frames lost on the way'] == '2'
    median, high = (float(diagnostics[f'latency, {what} (ms)']) for what in ('median', '95 %'))
    assert 30 < median <= high < 5000


def test_debug_image_is_drawn_only_with_a_subscriber(live, drive):
    one = live()
    one.send(drive[:3])
    one.wait_for_images(3)
    assert not one.graph.published('debug_image')
    one.graph.wanted = {'debug_image'}
    one.send(drive[3:5], first=3)
    one.wait_for_images(5)
    stamps = [stamp_ns(message.header) for message in one.graph.published('debug_image')]
    assert stamps == [3 * PERIOD, 4 * PERIOD]
    assert not one.graph.published('landmarks')


def test_odometry_is_of_the_base_frame_once_tf_has_the_mounting(live, drive):
    one = live(**{'odometry.base_frame': 'base_link', 'ros.publish_tf': True})
    one.send(drive[:3])
    one.wait_for_images(3)
    assert not one.graph.published('odometry', '/tf')
    assert len(one.graph.published('relative_pose')) == 2
    assert any('static_transform_publisher --frame-id base_link --child-frame-id camera' in line
               for line in one.graph.lines)
    mounting = np.array([[0.0, 0, 1, 0.3], [-1, 0, 0, 0], [0, -1, 0, 1.0], [0, 0, 0, 1]])
    one.graph.frames['base_link', 'camera'] = mounting
    one.send(drive[3:6], first=3)
    one.wait_for_images(6)
    odometry, transform = (one.graph.published(topic)[-1] for topic in ('odometry', '/tf'))
    expected = mounting @ one.tracker.last.pose @ np.linalg.inv(mounting)
    assert np.allclose(pose_of(odometry)[1], expected)
    assert np.allclose(pose_of(transform.transforms[0])[1], expected)
    assert (odometry.header.frame_id, odometry.child_frame_id) == ('odom', 'base_link')
    assert transform.transforms[0].child_frame_id == 'base_link'
    # the camera moves ahead, and so does the vehicle
    assert odometry.twist.twist.linear.x > 0
    assert one.graph.published('relative_pose')[-1].header.frame_id == 'camera_body'


def test_parameters_change_at_the_next_image(live, drive):
    one = live()
    one.send(drive[:3])
    one.wait_for_images(3)
    one.session.configure(with_values(one.tracker.config, {'odometry.odom_frame': 'world'}))
    one.send(drive[3:4], first=3)
    one.wait_for_images(4)
    frames = [message.header.frame_id for message in one.graph.published('odometry')]
    assert frames == ['odom', 'odom', 'odom', 'world']


def test_speeds_give_the_length(live, drive):
    one = live(**{'odometry.scale': 'speed'})
    vector = message_type('geometry_msgs/msg/Vector3')
    for i, gray in enumerate(drive[:3]):
        header = image(gray, stamp_ns=i * PERIOD).header
        one.session.speed(message_type('geometry_msgs/msg/TwistStamped')(
            header=header, twist=message_type('geometry_msgs/msg/Twist')(
                linear=vector(x=3.0, y=0.0, z=4.0), angular=vector(x=0.0, y=0.0, z=0.0))))
        one.send([gray], first=i)
    one.wait_for_images(3)
    assert one.tracker.last.scale_kind == 'metric'
    assert np.linalg.norm(one.tracker.last.motion[:3, 3]) == pytest.approx(0.5, rel=0.02)
