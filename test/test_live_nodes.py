"""A live node on a fake middleware, which records the calls."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from time import monotonic, sleep
from types import SimpleNamespace
from typing import Any

from cards import Cards, K, pose, SIZE
from djet_ros.config.flat import from_flat, with_values
from djet_ros.config.sections import Config
from djet_ros.live.middleware import Profile, PublisherInfo
from djet_ros.live.odometry_node import OdometryNode
import numpy as np
import pytest
from ros_messages import camera_info, image, message_type


class Graph:
    """A fake middleware; frames: transforms on tf, by parent and child."""

    qos_override_names, publishers_block, node = 'overrides of {topic}', False, '/vo_node'
    message_type = staticmethod(message_type)

    def __init__(self) -> None:
        self.lines: list[str] = []
        # What publishers offer, by topic.
        self.offered: dict[str, Profile] = {}
        self.callbacks: dict[str, Callable[[Any], None]] = {}
        self.kinds: dict[str, str] = {}
        self.taken: list[str] = []
        # Topics of other publishers, whatever the type.
        self.elsewhere: list[str] = []
        self.frames: dict[tuple[str, str], Any] = {}
        self.hears_tf = False

    def resolve(self, name: str) -> str:
        return f'/{name.lstrip("~/")}'

    def is_remapped(self, name: str) -> bool:
        return False

    def now_ns(self) -> int:
        return 0

    def log(self, level: str, text: str) -> None:
        self.lines.append(text)

    def serve(self, name: str, action: Callable[[], str]) -> None:
        pass

    def advertise(self, topic: str, kind: str) -> Any:
        return SimpleNamespace(publish=lambda message: True, listeners=0)

    def listen(self, topic: str, kind: str, callback: Callable[[Any], None], profile: Profile,
               ready: Callable[[], bool] | None = None, *, many: bool = False) -> Any:
        self.callbacks[topic], self.kinds[topic] = callback, kind
        self.taken.append(topic)
        return SimpleNamespace(topic=topic, profile=profile, new_losses=lambda: 0,
                               new_incompatible=lambda: int(topic in self.offered))

    def publishers_of(self, topic: str) -> list[Any]:
        return ([PublisherInfo('/sender', self.kinds[topic], self.offered[topic])]
                if topic in self.offered else [])

    def published(self, kind: str) -> list[str]:
        return self.elsewhere

    def subscribe_tf(self) -> None:
        assert not self.hears_tf
        self.hears_tf = True

    def unsubscribe_tf(self) -> None:
        assert self.hears_tf
        self.hears_tf = False

    def transform(self, parent: str, child: str) -> Any:
        return self.frames.get((parent, child)) if self.hears_tf else None


class Node:
    """The odometry node on such a middleware."""

    def __init__(self, **parameters: Any) -> None:
        self.graph = Graph()
        self.config: Config = from_flat({'estimator.max_features': 500, **parameters})
        self.node = OdometryNode(self.graph, self.config)
        self.node.session.start()
        self.graph.callbacks['/camera_info'](camera_info(K, SIZE))
        self._cards, self._sent = Cards(), 0

    def look(self) -> None:
        """Send an image, wait until it is worked on, and let a second pass."""
        here = np.linalg.matrix_power(pose(x=0.25, z=0.15), self._sent % 4)
        self.graph.callbacks['/image'](image(self._cards.gray(here),
                                             stamp_ns=self._sent * 10**8))
        self._sent += 1
        counts, end = self.node.session._tracker.counts, monotonic() + 20
        while counts.received < self._sent and monotonic() < end:
            sleep(0.01)
        self.node.session.configure(self.config)
        self.node._tick()

    def change(self, **values: Any) -> None:
        """Change parameters, as the middleware does it while the node runs."""
        self.config = with_values(self.config, values)
        self.node.connect(self.config)
        self.node.configure(self.config)
        self.node._tick()


@pytest.fixture
def node() -> Iterator[Callable[..., Node]]:
    started: list[Node] = []

    def start(**parameters: Any) -> Node:
        started.append(Node(**parameters))
        return started[-1]

    yield start
    for one in started:
        one.node.session.stop(10)


def test_tf_is_subscribed_only_while_a_mounting_is_unknown(node):
    one = node(**{'odometry.base_frame': 'base_link'})
    one.look()
    assert one.graph.hears_tf
    one.graph.frames['base_link', 'camera'] = np.eye(4)
    one.look()
    assert not one.graph.hears_tf
    one.change(**{'odometry.max_gap': 2.0})
    assert not one.graph.hears_tf
    one.change(**{'odometry.guess': True})
    one.look()
    assert one.graph.hears_tf
    one.change(**{'odometry.guess': False})
    assert not one.graph.hears_tf


@pytest.mark.parametrize('parameters', [
    {}, {'odometry.imu': True, 'odometry.imu_rotation': '0 0 0 1'}])
def test_tf_is_not_subscribed_without_need(node, parameters):
    assert not node(**parameters).graph.hears_tf


def test_inputs_enabled_at_run_time_are_subscribed_once(node):
    one = node(**{'odometry.imu': True})
    one.change(**{'odometry.scale': 'speed', 'odometry.mask': True, 'odometry.guess': True})
    one.change(**{'odometry.guess_frame': 'wheels'})
    one.change(**{'odometry.max_gap': 2.0})
    assert sorted(one.graph.taken) == ['/camera_info', '/guess', '/image', '/imu', '/mask',
                                       '/speed', '/speed_odometry', '/tf', '/tf_static']


@pytest.mark.parametrize(('topic', 'offered', 'remedy'), [
    ('/image', Profile(reliable=False), 'set ros.queue_policy to latest or overrides of /image'),
    ('/imu', Profile(reliable=False), 'set ros.queue_policy to latest or overrides of /imu'),
    ('/tf_static', Profile(latched=False),
     'configure the publisher to offer reliable, transient_local')])
def test_incompatible_qos_is_logged_with_the_remedy(node, topic, offered, remedy):
    one = node(**{'ros.queue_policy': 'every', 'odometry.imu': True, 'odometry.guess': True,
                  'odometry.guess_frame': 'wheels'})
    one.graph.offered[topic] = offered
    for _ in range(2):
        one.node._tick()
    line, = (line for line in one.graph.lines if line.startswith('incompatible QoS'))
    assert line.endswith(f'no messages are received from it; {remedy}')


@pytest.mark.parametrize(('asked', 'offered', 'remedy'), [
    ('best_effort', True, '; large images may be lost with best-effort QoS: set '
     'ros.qos_reliability to reliable, or increase the socket buffers of the middleware'),
    ('best_effort', False, '; large images may be lost with best-effort QoS: '
     'increase the socket buffers of the middleware'),
    ('reliable', True, '')])
def test_missing_images_are_logged_with_the_remedy_for_fragment_loss(
        node, asked, offered, remedy):
    one = node(**{'ros.qos_reliability': asked})
    one.graph.offered.update(dict.fromkeys(('/image', '/camera_info'), Profile(reliable=offered)))
    assert one.node.why_silent('/image') == f'no messages arrive from /sender{remedy}'
    assert one.node.why_silent('/camera_info') == 'no messages arrive from /sender'


@pytest.mark.parametrize(('transport', 'elsewhere', 'hint'), [
    ('raw', '/cam/picture', '; did you mean /cam/picture?'),
    ('compressed', '/cam/raw/compressed', '; did you mean /cam/raw/compressed?'),
    ('compressed', '/cam/jpeg',
     '; did you mean /cam/jpeg? remap /image/compressed:=/cam/jpeg')])
def test_suggested_topic_can_be_used(node, transport, elsewhere, hint):
    one = node(**{'ros.image_transport': transport})
    one.graph.elsewhere = [elsewhere]
    topic = '/image' if transport == 'raw' else '/image/compressed'
    assert one.node.why_silent(topic) == f'it has no publisher{hint}'
