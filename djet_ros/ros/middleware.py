"""The middleware of a live node on ROS 2 (rclpy)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
import sys
from time import monotonic
from typing import Any

from djet_ros.core.types import Array
from djet_ros.errors import DjetError, one_line
from djet_ros.live.middleware import DEFAULT_PROFILE, Profile, PublisherInfo
from djet_ros.odometry.messages import pose_of
from djet_ros.ros.command_line import topic_remappings
from rclpy.callback_groups import CallbackGroup, MutuallyExclusiveCallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import InvalidHandle
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher as RclpyPublisher
from rclpy.qos import (
    QoSDurabilityPolicy,
    QoSHistoryPolicy,
    QoSPolicyKind,
    QoSProfile,
    QoSReliabilityPolicy,
)
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.time import Time
from rclpy.topic_endpoint_info import TopicEndpointInfo
from std_srvs.srv import Trigger

# Seconds between two checks for QoS events. Each publisher and subscription has two handlers of
# them, and waiting for all took longer than for everything else in the wait set.
_EVENTS_PERIOD = 1.0

# Seconds between two looks at topics of many messages. The executor waits twice for each message,
# which for an IMU of 200 Hz cost as much as the odometry at 10 Hz.
_POLL_PERIOD = 0.01

# History depth for queue_policy 'every'. ROS cannot bound KEEP_ALL: Cyclone DDS takes gigabytes,
# and no publisher waits. It is enough until Python gets to run and takes the messages.
_EVERY_DEPTH = 50

# What the middleware calls the node of a publisher without one.
_NO_NODE = ('_NODE_NAME_UNKNOWN_', '_CREATED_BY_BARE_DDS_APP_')

_OVERRIDES = QoSOverridingOptions((QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH,
                                   QoSPolicyKind.RELIABILITY, QoSPolicyKind.DURABILITY))


@cache
def message_type(name: str) -> Any:
    """Return the class of a message type such as 'sensor_msgs/msg/Image'."""
    package, kind, message = name.split('/')
    return getattr(import_module(f'{package}.{kind}'), message)


class RosPublisher:
    """Publishes messages of one topic."""

    def __init__(self, publisher: RclpyPublisher) -> None:
        self._publisher = publisher

    def publish(self, message: Any) -> bool:
        """Publish a message; return True, as rclpy accepts all."""
        self._publisher.publish(message)
        return True

    @property
    def listeners(self) -> int:
        """Return the number of subscriptions; 0 once the node is destroyed."""
        try:
            return int(self._publisher.get_subscription_count())
        except InvalidHandle:
            return 0


class _Gate(MutuallyExclusiveCallbackGroup):  # type: ignore[misc]
    """
    A callback group that the executor waits for only while it is open.

    passed: whether it has begun a callback; it calls one for each spin, and more may be ready.
    """

    def __init__(self) -> None:
        super().__init__()
        self.open = self.passed = False

    def can_execute(self, entity: Any) -> bool:
        """Return whether the executor may wait for an entity and call it."""
        return self.open and bool(super().can_execute(entity))

    def beginning_execution(self, entity: Any) -> bool:
        """Note that a callback begins."""
        self.passed = True
        return bool(super().beginning_execution(entity))


class RosSubscription:
    """
    Subscribes to one topic, and counts its QoS events.

    group: callback group of the messages; events: that of the events.
    """

    def __init__(self, node: Node, topic: str, kind: str, callback: Callable[[Any], None],
                 profile: Profile, group: CallbackGroup, events: CallbackGroup) -> None:
        self.topic = topic
        self._lost = self._refused = 0
        self._callback = callback
        with _report_bad_overrides(node, topic):
            self._subscription = node.create_subscription(
                message_type(kind), topic, callback, _qos(profile), callback_group=group,
                event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
                # Overrides are by topic, and a latched subscription must match its publisher.
                qos_overriding_options=None if profile.latched else _OVERRIDES)
        # rclpy itself would have them in the group of the messages.
        for handler in SubscriptionEventCallbacks(
                incompatible_qos=self._note_refusal, message_lost=self._note_loss,
                ).create_event_handlers(events, self._subscription.handle, topic):
            self._subscription.event_handlers.append(handler)
            node.add_waitable(handler)

    def poll(self) -> None:
        """Call the callback for all messages that have arrived."""
        one = self._subscription
        with one.handle:
            while (taken := one.handle.take_message(one.msg_type, one.raw)) is not None:
                self._callback(taken[0])

    @property
    def profile(self) -> Profile:
        """Return the requested QoS, after overrides."""
        return _profile(self._subscription.qos_profile)

    def new_losses(self) -> int:
        """Return the number of messages lost in transport since the last call."""
        number, self._lost = self._lost, 0
        return number

    def new_incompatible(self) -> int:
        """Return the number of publishers with incompatible QoS since the last call."""
        number, self._refused = self._refused, 0
        return number

    def _note_loss(self, event: Any) -> None:
        self._lost += event.total_count_change

    def _note_refusal(self, event: Any) -> None:
        self._refused += event.total_count_change


class RosMiddleware:
    """The ROS graph as seen by a node; see ``Middleware``."""

    qos_override_names = 'qos_overrides.{topic}.subscription.*'
    publishers_block = False
    message_type = staticmethod(message_type)

    def __init__(self, node: Node) -> None:
        self._node = node
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(node)
        self._frames: Any = None
        self._listener: Any = None
        self._last_look = -float('inf')
        self._events = _Gate()
        self._many: list[RosSubscription] = []

    @property
    def node(self) -> str:
        """Return the fully qualified node name."""
        return str(self._node.get_fully_qualified_name())

    def resolve(self, name: str) -> str:
        """Return the fully qualified name of a topic or service, with remappings."""
        return str(self._node.resolve_topic_name(name))

    def is_remapped(self, name: str) -> bool:
        """Return whether the command line remaps a topic, even to its default name."""
        full = self._expand(name)
        return any(old != new and self._expand(old) == full
                   for old, new in topic_remappings(sys.argv, self._node.get_name()))

    def _expand(self, name: str) -> str:
        return str(self._node.resolve_topic_name(name, only_expand=True))

    def now_ns(self) -> int:
        """Return the time of the node's clock in nanoseconds, which may be simulated."""
        return int(self._node.get_clock().now().nanoseconds)

    def log(self, level: str, text: str) -> None:
        """Log a line with the node's logger."""
        logger = self._node.get_logger()
        # rclpy requires one severity for each call site.
        if level == 'info':
            logger.info(text)
        elif level == 'warning':
            logger.warning(text)
        else:
            logger.error(text)

    def advertise(self, topic: str, kind: str) -> RosPublisher:
        """Create a publisher; parameters can override its QoS."""
        with _report_bad_overrides(self._node, topic):
            return RosPublisher(self._node.create_publisher(
                message_type(kind), topic, _qos(DEFAULT_PROFILE), callback_group=self._events,
                qos_overriding_options=_OVERRIDES))

    def listen(self, topic: str, kind: str, callback: Callable[[Any], None],
               profile: Profile, ready: Callable[[], bool] | None = None, *,
               many: bool = False) -> RosSubscription:
        """Subscribe to a topic; ready is not used; overrides as for ``advertise``."""
        subscription = RosSubscription(
            self._node, topic, kind, callback, profile,
            # Closed for good: the executor never waits for these messages.
            _Gate() if many else self._node.default_callback_group, self._events)
        if many:
            self._many.append(subscription)
        return subscription

    def publishers_of(self, topic: str) -> list[PublisherInfo]:
        """Return the publishers of a topic."""
        return [PublisherInfo(_name(one), one.topic_type, _profile(one.qos_profile))
                for one in self._node.get_publishers_info_by_topic(topic)]

    def published(self, kind: str) -> list[str]:
        """Return the topics of a ROS type that have a publisher."""
        return [name for name, kinds in self._node.get_topic_names_and_types()
                if kind in kinds and self._node.count_publishers(name)]

    def subscribe_tf(self) -> None:
        """Subscribe to tf; the parameters were checked to require tf2_ros."""
        tf2 = import_module('tf2_ros')
        self._frames = tf2.Buffer()
        self._listener = tf2.TransformListener(self._frames, self._node)

    def unsubscribe_tf(self) -> None:
        """Unsubscribe from tf."""
        self._listener.unregister()
        self._listener = self._frames = None

    def transform(self, parent: str, child: str) -> Array | None:
        """Return the newest pose (4, 4) of frame child in parent, or None."""
        # Called from another thread than unsubscribe_tf.
        frames = self._frames
        if frames is None or not frames.can_transform(parent, child, Time()):
            return None
        return pose_of(frames.lookup_transform(parent, child, Time()))[1]

    def serve(self, name: str, action: Callable[[], str]) -> None:
        """Create a std_srvs/srv/Trigger service; action returns the message of the response."""
        def answer(_: Any, response: Any) -> Any:
            response.message = action()
            response.success = True
            return response

        self._node.create_service(Trigger, name, answer)

    def spin(self, seconds: float) -> None:
        """Wait for messages and services for at most some seconds, and handle them."""
        events, now = self._events, monotonic()
        events.open = events.passed or now - self._last_look >= _EVENTS_PERIOD
        if events.open:
            events.passed, self._last_look = False, now
        self._executor.spin_once(timeout_sec=min(seconds, _POLL_PERIOD) if self._many else seconds)
        for subscription in self._many:
            subscription.poll()


@contextmanager
def _report_bad_overrides(node: Node, topic: str) -> Iterator[None]:
    """Raise DjetError with the QoS overrides of a topic if rclpy rejects them."""
    try:
        yield
    except (AssertionError, RuntimeError, TypeError, ValueError) as error:
        overrides = {name: one.value for name, one
                     in node.get_parameters_by_prefix(f'qos_overrides.{topic}').items()}
        # That of an assertion is empty.
        why = one_line(error) if str(error) else 'a value has the wrong type'
        raise DjetError(f'{topic} does not accept qos_overrides.{topic}.* = {overrides}: '
                        f'{why}') from error


def _name(publisher: TopicEndpointInfo) -> str:
    """Return the name of the node of a publisher, which has none if it is not a ROS node."""
    if publisher.node_name in _NO_NODE:
        return 'a publisher without a ROS node'
    return f'{publisher.node_namespace.rstrip("/")}/{publisher.node_name}'


def _qos(profile: Profile) -> QoSProfile:
    return QoSProfile(
        history=QoSHistoryPolicy.KEEP_LAST, depth=profile.depth or _EVERY_DEPTH,
        reliability=(QoSReliabilityPolicy.RELIABLE if profile.reliable
                     else QoSReliabilityPolicy.BEST_EFFORT),
        durability=(QoSDurabilityPolicy.TRANSIENT_LOCAL if profile.latched
                    else QoSDurabilityPolicy.VOLATILE))


def _profile(qos: QoSProfile) -> Profile:
    return Profile(reliable=qos.reliability is QoSReliabilityPolicy.RELIABLE,
                   depth=None if qos.history is QoSHistoryPolicy.KEEP_ALL else qos.depth,
                   latched=qos.durability is QoSDurabilityPolicy.TRANSIENT_LOCAL)
