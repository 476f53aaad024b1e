"""The middleware of a live node on plain DDS."""

from __future__ import annotations

from collections.abc import Callable
import sys
from time import monotonic, time_ns
from typing import Any

from djet_ros.core.types import Array
from djet_ros.dds.graph import Graph, Publisher, Subscription
from djet_ros.dds.names import Names
from djet_ros.dds.trigger import TriggerServer
from djet_ros.live.middleware import FRAMES_PROFILE, Profile, PublisherInfo
from djet_ros.odometry.messages import ns_of_time, seconds_and_rest
from djet_ros.odometry.static_frames import StaticFrames, TOPIC, TYPE
from djet_ros.recordings.decoding import message_type

_GARBAGE_LOG_PERIOD = 5.0

# Seconds between two checks for service clients that cannot be answered.
_CLIENT_CHECK_PERIOD = 1.0

_LEVELS = {'info': 'INFO', 'warning': 'WARN', 'error': 'ERROR'}


class DdsMiddleware:
    """
    The ROS graph as seen by a participant with topics and services, but no ROS node.

    use_sim_time: the current time is that of /clock.
    """

    qos_override_names = ''
    publishers_block = True
    message_type = staticmethod(message_type)

    def __init__(self, graph: Graph, names: Names, use_sim_time: bool = False) -> None:
        self._graph = graph
        self._names = names
        self._clock: int | None = None
        self._frames = StaticFrames()
        self._tf_subscribed = False
        self._last_garbage = self._last_client_check = -float('inf')
        self._services: list[TriggerServer] = []
        if use_sim_time:
            self._clock = 0
            graph.listen('/clock', 'rosgraph_msgs/msg/Clock', self._take_clock, Profile(False, 1))

    @property
    def node(self) -> str:
        """Return the fully qualified node name."""
        return self._names.full_node

    def resolve(self, name: str) -> str:
        """Return the fully qualified name of a topic or service, with remappings."""
        return self._names.resolve(name)

    def is_remapped(self, name: str) -> bool:
        """Return whether a remapping for a topic is given."""
        return self._names.is_remapped(name)

    def now_ns(self) -> int:
        """Return the time of the system, or of /clock, in nanoseconds."""
        return time_ns() if self._clock is None else self._clock

    def log(self, level: str, text: str) -> None:
        """Log a line in ROS's format."""
        seconds, rest = seconds_and_rest(time_ns())
        print(f'[{_LEVELS[level]}] [{seconds}.{rest:09d}] [{self._names.node}]: {text}',
              file=sys.stderr, flush=True)

    def advertise(self, topic: str, kind: str) -> Publisher:
        """Create a publisher on a topic."""
        return self._graph.advertise(topic, kind)

    def listen(self, topic: str, kind: str, callback: Callable[[Any], None],
               profile: Profile, ready: Callable[[], bool] | None = None, *,
               many: bool = False) -> Subscription:
        """Subscribe to a topic; many is not used, as all messages are taken together."""
        # One message at a time if the next one may have to wait.
        return self._graph.listen(topic, kind, callback, profile, garbage=self._note_garbage,
                                  batch=100 if ready is None else 1, ready=ready)

    def publishers_of(self, topic: str) -> list[PublisherInfo]:
        """Return the publishers of a topic."""
        return self._graph.publishers_of(topic)

    def published(self, kind: str) -> list[str]:
        """Return the topics of a ROS type that have a publisher."""
        return self._graph.published(kind)

    def subscribe_tf(self) -> None:
        """Subscribe to /tf_static; moving frames need tf2, which is part of ROS."""
        if not self._tf_subscribed:
            self._graph.listen(TOPIC, TYPE, self._frames.add, FRAMES_PROFILE,
                               garbage=self._note_garbage)
        self._tf_subscribed = True

    def unsubscribe_tf(self) -> None:
        """Do nothing: /tf_static has no traffic once its messages have been received."""

    def transform(self, parent: str, child: str) -> Array | None:
        """Return the pose (4, 4) of frame child in parent, or None if /tf_static lacks it."""
        return self._frames.transform(parent, child)

    def serve(self, name: str, action: Callable[[], str]) -> None:
        """Create a std_srvs/srv/Trigger service; action returns the message of the response."""
        self._services.append(TriggerServer(self._graph, self.resolve(name), action,
                                            self._note_garbage))

    def spin(self, seconds: float) -> None:
        """Wait for messages for at most some seconds, and call the callbacks."""
        self._graph.spin(seconds)
        if monotonic() - self._last_client_check >= _CLIENT_CHECK_PERIOD:
            self._last_client_check = monotonic()
            for service in self._services:
                service.report_unsupported_clients()

    def _take_clock(self, message: Any) -> None:
        self._clock = ns_of_time(message.clock)

    def _note_garbage(self, reason: str) -> None:
        if monotonic() - self._last_garbage >= _GARBAGE_LOG_PERIOD:
            self._last_garbage = monotonic()
            self.log('warning', reason)
