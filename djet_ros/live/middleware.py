"""What a live node asks of its middleware; ROS 2 and plain DDS each answer in their own way."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

from djet_ros.core.types import Array
from djet_ros.odometry.messages import MessageType


@dataclass(frozen=True)
class Profile:
    """
    Quality of service; depth None keeps what comes until it is taken.

    Where it is not taken, that makes reliable publishers wait which keep all, too, or it loses
    the oldest: see ``Middleware.senders_wait``.
    """

    reliable: bool = True
    depth: int | None = 10
    latched: bool = False

    def __str__(self) -> str:
        """Say it in ROS's words."""
        return (f'{"reliable" if self.reliable else "best_effort"}, '
                f'{"transient_local" if self.latched else "volatile"}')

    def incompatible_with(self, offered: Profile) -> bool:
        """Tell whether a subscription of this profile refuses a publisher."""
        return self.reliable > offered.reliable or self.latched > offered.latched


DEFAULT_PROFILE = Profile()


class Offer(NamedTuple):
    """A publisher of a topic: who it is, for people, its ROS type and its quality of service."""

    who: str
    kind: str
    profile: Profile


class Publisher(Protocol):
    """Sends messages of one topic; may be used from any thread."""

    def publish(self, message: Any) -> bool:
        """Send a message; False where the subscriptions left no room for it."""

    @property
    def listeners(self) -> int:
        """Count the subscriptions."""


class Subscription(Protocol):
    """Hears one topic; profile is what it asks for, after overrides by the user."""

    topic: str

    @property
    def profile(self) -> Profile:
        """Give the quality of service that it asks for."""

    def new_losses(self) -> int:
        """Count the messages that were lost on the way since the last call."""

    def new_refusals(self) -> int:
        """Count the publishers that turned up since the last call and do not fit."""


class Middleware(Protocol):
    """The graph as one node sees it. Callbacks come from the thread that calls ``spin``."""

    # What else can be set where a publisher's quality of service does not fit; {topic} in it.
    qos_remedy: str

    # Whether publishers can be made to wait for a subscription that does not take messages.
    senders_wait: bool

    @property
    def node(self) -> str:
        """Give the name of the node with its namespace, as in '/left/vo_node'."""

    @property
    def message_type(self) -> MessageType:
        """Give the class of messages by the name of its type."""

    def resolve(self, name: str) -> str:
        """Give the full name of a topic or service, remapped."""

    def is_remapped(self, name: str) -> bool:
        """Tell whether a rule says what a topic is called, be it as it would be anyway."""

    def now_ns(self) -> int:
        """Time for stamps, in nanoseconds; simulated where the user asked for it."""

    def log(self, level: str, text: str) -> None:
        """Log a line; level is 'info', 'warning' or 'error'."""

    def advertise(self, topic: str, kind: str) -> Publisher:
        """Publish messages of a ROS type on a topic, by its resolved name."""

    def listen(self, topic: str, kind: str, callback: Callable[[Any], None],
               profile: Profile, ready: Callable[[], bool] | None = None) -> Subscription:
        """
        Hand the messages on a topic, by its resolved name, to a callback.

        ready: asked before each message; while it says no, messages wait in the middleware, and
        those of other topics go on. Only to be asked where senders wait.
        """

    def offers(self, topic: str) -> Sequence[Offer]:
        """Give who publishes a topic, by its resolved name."""

    def published(self, kind: str) -> Sequence[str]:
        """Give the topics over which somebody sends messages of a ROS type."""

    def follow_frames(self) -> None:
        """Hear what tf says from now on."""

    def forget_frames(self) -> None:
        """Hear no more of it, until it is asked for again."""

    def transform(self, parent: str, child: str) -> Array | None:
        """Give a frame in another (4, 4), or None where tf does not know it."""

    def serve(self, name: str, action: Callable[[], str]) -> None:
        """Serve std_srvs/srv/Trigger: an action that succeeds and says what it did."""

    def spin(self, seconds: float) -> None:
        """Wait for messages, at most for some time, and hand them out."""
