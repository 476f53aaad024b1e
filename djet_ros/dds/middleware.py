"""Plain DDS as a live node's middleware."""

from __future__ import annotations

from collections.abc import Callable
import sys
from time import monotonic, time_ns
from typing import Any

from djet_ros.core.types import Array
from djet_ros.dds.graph import Graph, Publisher, Subscription
from djet_ros.dds.names import Names
from djet_ros.dds.trigger import TriggerServer
from djet_ros.live.middleware import Offer, Profile
from djet_ros.odometry.messages import ns_of_time, seconds_and_rest
from djet_ros.odometry.static_frames import StaticFrames, TOPIC, TYPE
from djet_ros.recordings.decoding import message_type

_GARBAGE_LOG_PERIOD = 5.0

# Seconds between two looks for clients that can't be answered.
_LOOK_PERIOD = 1.0

# Messages of static frames that may wait; each robot_state_publisher has one.
_FRAMES_DEPTH = 100

_LEVELS = {'info': 'INFO', 'warning': 'WARN', 'error': 'ERROR'}


class DdsMiddleware:
    """
    The ROS graph as a node sees it that is none to ROS: topics and services alone.

    use_sim_time: stamps of now are those of /clock.
    """

    qos_remedy = ''
    senders_wait = True
    message_type = staticmethod(message_type)

    def __init__(self, graph: Graph, names: Names, use_sim_time: bool = False) -> None:
        self._graph = graph
        self._names = names
        self._clock: int | None = None
        self._frames = StaticFrames()
        self._follows_frames = False
        self._last_garbage = self._last_look = -float('inf')
        self._services: list[TriggerServer] = []
        if use_sim_time:
            self._clock = 0
            graph.listen('/clock', 'rosgraph_msgs/msg/Clock', self._take_clock, Profile(False, 1))

    @property
    def node(self) -> str:
        """Give the name of the node with its namespace."""
        return self._names.full_node

    def resolve(self, name: str) -> str:
        """Give the full name of a topic or service, remapped."""
        return self._names.resolve(name)

    def is_remapped(self, name: str) -> bool:
        """Tell whether a rule says what a topic is called."""
        return self._names.is_remapped(name)

    def now_ns(self) -> int:
        """Time of the system, or of /clock."""
        return time_ns() if self._clock is None else self._clock

    def log(self, level: str, text: str) -> None:
        """Log a line, in the form of ROS's log."""
        seconds, rest = seconds_and_rest(time_ns())
        print(f'[{_LEVELS[level]}] [{seconds}.{rest:09d}] [{self._names.node}]: {text}',
              file=sys.stderr, flush=True)

    def advertise(self, topic: str, kind: str) -> Publisher:
        """Publish on a topic."""
        return self._graph.advertise(topic, kind)

    def listen(self, topic: str, kind: str, callback: Callable[[Any], None],
               profile: Profile, ready: Callable[[], bool] | None = None) -> Subscription:
        """Hand the messages on a topic to a callback."""
        # One at a time, where another may have to wait.
        return self._graph.listen(topic, kind, callback, profile, garbage=self._note_garbage,
                                  batch=100 if ready is None else 1, ready=ready)

    def offers(self, topic: str) -> list[Offer]:
        """Give who publishes a topic."""
        return self._graph.offers(topic)

    def published(self, kind: str) -> list[str]:
        """Give the topics over which somebody sends messages of a ROS type."""
        return self._graph.published(kind)

    def follow_frames(self) -> None:
        """Hear what /tf_static says from now on; frames that move are for tf2, which ROS has."""
        if not self._follows_frames:
            # Whoever publishes there latches its newest message.
            self._graph.listen(TOPIC, TYPE, self._frames.add,
                               Profile(depth=_FRAMES_DEPTH, latched=True),
                               garbage=self._note_garbage)
        self._follows_frames = True

    def forget_frames(self) -> None:
        """Stay as it is: /tf_static costs nothing where nothing new is told."""

    def transform(self, parent: str, child: str) -> Array | None:
        """Give a frame in another (4, 4), or None where /tf_static has not told it."""
        return self._frames.transform(parent, child)

    def serve(self, name: str, action: Callable[[], str]) -> None:
        """Serve std_srvs/srv/Trigger by an action that succeeds and says what it did."""
        self._services.append(TriggerServer(self._graph, self.resolve(name), action,
                                            self._note_garbage))

    def spin(self, seconds: float) -> None:
        """Wait for messages, at most for some time, and hand them out."""
        self._graph.spin(seconds)
        if monotonic() - self._last_look >= _LOOK_PERIOD:
            self._last_look = monotonic()
            for service in self._services:
                service.look_for_strangers()

    def _take_clock(self, message: Any) -> None:
        self._clock = ns_of_time(message.clock)

    def _note_garbage(self, reason: str) -> None:
        if monotonic() - self._last_garbage >= _GARBAGE_LOG_PERIOD:
            self._last_garbage = monotonic()
            self.log('warning', reason)
