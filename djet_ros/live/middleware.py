"""The interface of a live node to its middleware, implemented for ROS 2 and for plain DDS."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

from djet_ros.core.types import Array
from djet_ros.odometry.messages import MessageType


@dataclass(frozen=True)
class Profile:
    """
    A QoS profile; depth None is history keep-all.

    If messages are not taken, keep-all blocks reliable keep-all publishers, or loses the oldest:
    see ``Middleware.publishers_block``.
    """

    reliable: bool = True
    depth: int | None = 10
    latched: bool = False

    def __str__(self) -> str:
        """Return the profile in ROS's terms."""
        return (f'{"reliable" if self.reliable else "best_effort"}, '
                f'{"transient_local" if self.latched else "volatile"}')

    def incompatible_with(self, offered: Profile) -> bool:
        """Return whether a subscription with this profile is incompatible with a publisher."""
        return self.reliable > offered.reliable or self.latched > offered.latched


DEFAULT_PROFILE = Profile()

# Of /tf_static: latched, with a message for each robot_state_publisher.
FRAMES_PROFILE = Profile(depth=100, latched=True)


class PublisherInfo(NamedTuple):
    """A publisher of a topic: its name for log messages, its ROS type and its QoS."""

    who: str
    kind: str
    profile: Profile


class Publisher(Protocol):
    """Publishes on one topic; may be used from any thread."""

    def publish(self, message: Any) -> bool:
        """Publish a message; return False if a subscription has no room for it."""

    @property
    def listeners(self) -> int:
        """Return the number of subscriptions."""


class Subscription(Protocol):
    """A subscription to one topic."""

    topic: str

    @property
    def profile(self) -> Profile:
        """Return the requested QoS, after overrides by the user."""

    def new_losses(self) -> int:
        """Return the number of messages lost in transport since the last call."""

    def new_incompatible(self) -> int:
        """Return the number of publishers with incompatible QoS since the last call."""


class Middleware(Protocol):
    """The ROS graph as seen by one node. Callbacks run in the thread that calls ``spin``."""

    # Parameters, with {topic}, that override the QoS of a topic; '' if there are none.
    qos_override_names: str

    # Whether reliable publishers block while a subscription does not take messages.
    publishers_block: bool

    @property
    def node(self) -> str:
        """Return the fully qualified node name, such as '/left/vo_node'."""

    @property
    def message_type(self) -> MessageType:
        """Return the function from a type name to the message class."""

    def resolve(self, name: str) -> str:
        """Return the fully qualified name of a topic or service, with remappings."""

    def is_remapped(self, name: str) -> bool:
        """Return whether a remapping for a topic is given, even one to its default name."""

    def now_ns(self) -> int:
        """Return the time for stamps in nanoseconds; simulated with use_sim_time."""

    def log(self, level: str, text: str) -> None:
        """Log a line; level is 'info', 'warning' or 'error'."""

    def advertise(self, topic: str, kind: str) -> Publisher:
        """Create a publisher of a ROS type on a topic, by its resolved name."""

    def listen(self, topic: str, kind: str, callback: Callable[[Any], None],
               profile: Profile, ready: Callable[[], bool] | None = None, *,
               many: bool = False) -> Subscription:
        """
        Subscribe to a topic, by its resolved name.

        ready: called before each message; while it returns False, messages of this topic stay in
        the middleware, and other topics continue. Used only if ``publishers_block``. many: whether
        messages are so frequent that they are better taken together, some ms late.
        """

    def publishers_of(self, topic: str) -> Sequence[PublisherInfo]:
        """Return the publishers of a topic, by its resolved name."""

    def published(self, kind: str) -> Sequence[str]:
        """Return the topics of a ROS type that have a publisher."""

    def subscribe_tf(self) -> None:
        """Subscribe to tf."""

    def unsubscribe_tf(self) -> None:
        """Unsubscribe from tf."""

    def transform(self, parent: str, child: str) -> Array | None:
        """Return the pose (4, 4) of frame child in parent, or None if tf does not have it."""

    def serve(self, name: str, action: Callable[[], str]) -> None:
        """Create a std_srvs/srv/Trigger service; action returns the message of the response."""

    def spin(self, seconds: float) -> None:
        """Wait for messages for at most some seconds, and call the callbacks."""
