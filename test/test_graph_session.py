"""The pose graph's session: a real map, real threads, and a graph that writes down what comes."""

from time import monotonic, sleep

from cards import Cards, K, pose, SIZE
from djet_ros.config.flat import from_flat
from djet_ros.odometry.messages import stamp_ns
import numpy as np
import pytest
from ros_messages import camera_info, image, message_type
from test_live_slam import MOUNTING, Odometry, START
from test_session import Graph

pytestmark = pytest.mark.slow

TOPICS = {'odometry': '/vo_node/odometry', 'relative_pose_cov': '/vo_node/relative_pose_cov',
          'relative_pose_status': '/vo_node/relative_pose_status',
          'image': '/left/image_raw', 'camera_info': '/left/camera_info'}
WAYS = [0.25 * i for i in (*range(7), *range(5, -1, -1))]


class Live:
    """A session at work on a way to the right and back."""

    def __init__(self, base_frame='', **parameters):
        pytest.importorskip('gtsam', reason='GTSAM is not installed: the extra slam')
        from djet_ros.live.graph_session import GraphSession
        from djet_ros.posegraph.live_slam import LiveSlam
        self.graph = Graph()
        self.slam = LiveSlam(
            from_flat({'estimator.max_features': 500, 'slam.keyframe_distance': 0.4,
                       'slam.loop_gap': 0.5, 'odometry.base_frame': base_frame,
                       **{f'slam.{name}': value for name, value in parameters.items()}}),
            message_type, 'image_rect')
        self.session = GraphSession(self.slam, self.graph, TOPICS)
        self.session.start()
        self._cards, self._odometry, self._was = Cards(), Odometry(
            'body', base_frame, MOUNTING if base_frame else None), None

    def restart(self, stamp):
        """Have the odometry start again, at a stamp."""
        self._odometry.stamp, self._was = stamp, None
        self._odometry.reset()

    def drive(self, positions):
        self.session.camera_info(camera_info(K, SIZE))
        for metres in positions:
            stamp, here = self._odometry.stamp, pose(x=metres)
            self.session.image(image(self._cards.gray(here, noise=stamp % 97), stamp_ns=stamp))
            if self._was is None:
                status, odometry = self._odometry.start()
            else:
                relative, status, odometry = self._odometry.move(
                    np.linalg.inv(self._was) @ here)
                self.session.relative_pose(relative)
            self.session.relative_pose_status(status)
            self.session.odometry(odometry)
            self._was = here


@pytest.fixture
def live():
    """Return a function that begins a session, which is stopped after the test."""
    started = []

    def start(**parameters):
        started.append(Live(**parameters))
        return started[-1]

    yield start
    for one in started:
        one.session.stop(5)


def until(condition):
    end = monotonic() + 30
    while not condition():
        assert monotonic() < end, 'nothing happened'
        sleep(0.01)


def test_odometry_does_not_wait_for_the_loop_search(live):
    one = live(optimise_period=0.0)
    one.drive(WAYS)
    until(lambda: len(one.graph.published('/tf')) == len(WAYS))
    stamps = [stamp_ns(message.transforms[0].header) for message in one.graph.published('/tf')]
    assert stamps == [START + i * 100_000_000 for i in range(len(WAYS))]
    until(lambda: one.slam.idle and one.slam.map.count('loop') >= 2)
    assert one.slam.map.without_image == 0


def test_odometry_of_a_base_frame_waits_for_the_mounting_on_tf(live):
    one = live(base_frame='base_link')
    one.drive(WAYS[:3])
    until(lambda: any("tf has no transform from 'base_link' (odometry.base_frame) to 'camera'; "
                      'publish it on /tf_static; until then the odometry is ignored' in line
                      for line in one.graph.lines))
    assert not one.graph.published('/tf')
    one.graph.frames['base_link', 'camera'] = MOUNTING
    one.drive(WAYS[3:6])
    last = [START + i * 100_000_000 for i in (3, 4, 5)]
    until(lambda: [stamp_ns(message.transforms[0].header)
                   for message in one.graph.published('/tf')][-3:] == last)


def test_graph_is_optimised_when_the_odometry_is_silent(live, monkeypatch):
    monkeypatch.setattr('djet_ros.live.graph_session.SILENCE_TIMEOUT', 0.0)
    one = live(optimise_period=1000.0)
    one.drive(WAYS)
    until(lambda: one.slam.idle and one.slam.map.count('loop') >= 2)
    before = one.slam.map.optimisations
    one.session.tick()
    until(lambda: one.slam.map.optimisations == before + 1)


def test_missing_inputs_are_logged_with_their_topics(live, monkeypatch):
    monkeypatch.setattr('djet_ros.live.graph_session.SILENCE_TIMEOUT', 0.0)
    one = live()
    one.session.camera_info(camera_info(K, SIZE))
    for _ in range(3):
        one.session.tick()
    until(lambda: one.graph.published('/diagnostics'))
    silent = [(what, topic) for what, topic in TOPICS.items() if what != 'camera_info']
    assert one.graph.lines == [
        f'warning: waiting for {what} on {topic}: nothing is seen of {topic}'
        for what, topic in silent]
    assert one.graph.diagnostics()['state'] == 'waiting for odometry'


def test_closed_loops_are_logged(live):
    one = live(optimise_period=0.0)
    one.drive(WAYS)
    until(lambda: one.slam.idle and one.slam.map.count('loop') >= 2)
    until(lambda: any(f"{one.slam.map.count('loop')} in total" in line
                      for line in one.graph.lines))


def test_reset_starts_a_new_map(live):
    one = live()
    one.drive(WAYS[:5])
    until(lambda: len(one.graph.published('/tf')) == 5)
    one.session.reset()
    until(lambda: one.graph.diagnostics()['keyframes'] == '0')
    one.drive(WAYS[5:])
    until(lambda: len(one.graph.published('/tf')) == len(WAYS))
    assert one.slam.map.keyframes[0].stamp_ns == START + 5 * 100_000_000


def test_discarding_the_map_at_a_step_back_in_time_is_logged(live):
    one = live()
    one.drive(WAYS[:5])
    one.restart(START - 10**9)
    one.drive(WAYS[:2])
    until(lambda: len(one.graph.published('/tf')) == 7)
    assert one.graph.lines == ['warning: the odometry went back in time by 1.400 s: map of 3 '
                               'keyframes discarded; a new map starts']


def test_nothing_is_published_after_a_stop(live):
    one = live()
    one.drive(WAYS[:3])
    until(lambda: one.graph.published('/tf'))
    one.session.stop(5)
    count = len(one.graph.batches)
    one.drive(WAYS[3:])
    sleep(0.2)
    assert len(one.graph.batches) == count
    assert not one.session.failed


def test_task_in_progress_at_a_stop_is_not_published(live):
    one = live()
    odometry = one.slam.odometry

    def slowly(message):
        sleep(0.5)
        return odometry(message)

    one.slam.odometry = slowly
    one.drive(WAYS[:1])
    sleep(0.1)
    one.session.stop(0.05)
    until(lambda: one.slam.map.keyframes)
    sleep(0.2)
    assert not one.graph.batches


@pytest.mark.filterwarnings('ignore::pytest.PytestUnhandledThreadExceptionWarning')
def test_error_in_the_worker_thread_is_reported(live):
    one = live()
    assert not one.session.failed
    one.graph.broken = True
    one.drive(WAYS[:2])
    until(lambda: one.session.failed)
