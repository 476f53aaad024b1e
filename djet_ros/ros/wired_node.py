"""What every live node of ours shares: its inputs, its outputs, and how it is run."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from importlib import import_module
from threading import Event
from typing import Any, Protocol

from djet_ros.config.sections import Config
from djet_ros.live.topics import full_name, image_topics, IMAGE_TYPES, INFO_TYPE
from djet_ros.odometry.tracker import Outgoing
import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import (
    qos_check_compatible,
    QoSCompatibility,
    QoSDurabilityPolicy,
    QoSHistoryPolicy,
    QoSPolicyKind,
    QoSProfile,
    QoSReliabilityPolicy,
)
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription

QOS_PARAMETERS = (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY,
                  QoSPolicyKind.DURABILITY)


class LiveSession(Protocol):
    """What a node has its work done by, in a thread of its own."""

    def start(self) -> None:
        """Begin to work."""

    def stop(self) -> None:
        """Publish nothing more."""

    @property
    def failed(self) -> bool:
        """Whether the work ended by an error."""

    def tick(self) -> None:
        """Say what no message makes it say; called once a second."""

    def image(self, message: Any) -> None:
        """Take an Image or a CompressedImage."""

    def camera_info(self, message: Any) -> None:
        """Take a CameraInfo."""


class WiredNode(Node):
    """A node around a session, to which it is the wiring: it publishes from its thread."""

    # To be made by a subclass, before it listens.
    session: LiveSession

    def __init__(self, name: str) -> None:
        super().__init__(name, automatically_declare_parameters_from_overrides=True)
        # Publishers that do not fit are reported by name, which becomes known a little later.
        self._mismatched: dict[str, Subscription] = {}
        self._outputs: dict[str, Publisher] = {}
        self._latched_input: Subscription | None = None
        # Also where simulated time stands still.
        self.create_timer(1.0, self._tick, clock=Clock(clock_type=ClockType.STEADY_TIME))

    # What a session asks for

    def publish(self, outgoing: Sequence[Outgoing]) -> None:
        """Publish messages; diagnostics are of now, all others of their image's time."""
        for topic, message in outgoing:
            if topic == '/diagnostics':
                message.header.stamp = self.get_clock().now().to_msg()
            self._outputs[topic].publish(message)

    def log(self, level: str, text: str) -> None:
        """Log a line."""
        getattr(self.get_logger(), level)(text)

    def wants_debug_image(self) -> bool:
        """Tell whether anybody subscribes to the debug image."""
        output = self._outputs.get('debug_image')
        return output is not None and bool(output.get_subscription_count())

    # Inputs and outputs

    def image_topics(self, config: Config) -> tuple[str, str]:
        """Resolve the names of the images and of their CameraInfo."""
        return image_topics(self.resolve_topic_name,
                            lambda name: self.resolve_topic_name(name, only_expand=True),
                            config.ros.image_transport)

    def advertise(self, outputs: Mapping[str, str]) -> None:
        """Make the publishers of topics with their types that are not there yet."""
        for topic in outputs.keys() - self._outputs.keys():
            self._outputs[topic] = self.create_publisher(
                message_type(outputs[topic]), full_name(topic), QoSProfile(depth=10),
                qos_overriding_options=QoSOverridingOptions(QOS_PARAMETERS))

    def listen_to_camera(self, image: str, info: str, config: Config, qos: QoSProfile,
                         count_lost: Callable[[int], None] = lambda number: None) -> None:
        """Subscribe to images and their CameraInfo, which may be latched."""
        self._info_topic = info
        # CameraInfo first: of two that wait, it is to be taken before its image.
        self.listen(INFO_TYPE, info, self.session.camera_info, qos)
        self.listen(IMAGE_TYPES[config.ros.image_transport], image, self.session.image, qos,
                    count_lost)

    def listen(self, kind: str, topic: str, callback: Callable[[Any], None], qos: QoSProfile,
               count_lost: Callable[[int], None] = lambda number: None) -> Subscription:
        """Subscribe; a publisher whose QoS does not fit is reported."""
        def note_mismatch(_: object) -> None:
            self._mismatched[subscription.topic_name] = subscription

        subscription = self.create_subscription(
            message_type(kind), topic, callback, qos, event_callbacks=SubscriptionEventCallbacks(
                incompatible_qos=note_mismatch,
                message_lost=lambda event: count_lost(event.total_count_change)),
            qos_overriding_options=QoSOverridingOptions(QOS_PARAMETERS))
        return subscription

    def _listen_for_latched(self) -> None:
        """Hear a CameraInfo that was sent before this node was there, where it was latched."""
        # To ask everybody for it would keep those away that do not latch.
        if self._latched_input is None:
            for publisher in self.get_publishers_info_by_topic(self._info_topic):
                latched = publisher.qos_profile
                if latched.durability is QoSDurabilityPolicy.TRANSIENT_LOCAL:
                    self._latched_input = self.create_subscription(
                        message_type(INFO_TYPE), self._info_topic, self.session.camera_info,
                        QoSProfile(depth=1, durability=latched.durability,
                                   reliability=latched.reliability))
                    return

    def _tick(self) -> None:
        while self._mismatched:
            self._report_mismatch(*self._mismatched.popitem())
        self._listen_for_latched()
        self.session.tick()

    def _report_mismatch(self, topic: str, subscription: Subscription) -> None:
        ours = subscription.qos_profile
        for publisher in self.get_publishers_info_by_topic(topic):
            compatibility, reason = qos_check_compatible(publisher.qos_profile, ours)
            if compatibility is not QoSCompatibility.OK:
                self.get_logger().error(
                    f'incompatible QoS on {topic}: {publisher.node_namespace.rstrip("/")}/'
                    f'{publisher.node_name} offers {_words(publisher.qos_profile)}, '
                    f'{self.get_fully_qualified_name()} asks for {_words(ours)}. {reason} Nothing '
                    'is received from it; set ros.qos_reliability or '
                    f'qos_overrides.{topic}.subscription.*')


@cache
def message_type(name: str) -> Any:
    """Give the class of a message type such as 'sensor_msgs/msg/Image'."""
    package, kind, message = name.split('/')
    return getattr(import_module(f'{package}.{kind}'), message)


def run(make_node: Callable[[], WiredNode], stop: Event) -> int:
    """Run a node until stop is set; gives the exit code, 1 where its work failed."""
    # The context must outlive what is being published, so rclpy does not get to see the signals.
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = make_node()
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        node.session.start()
        try:
            while not stop.is_set():
                executor.spin_once(timeout_sec=0.1)
                if node.session.failed:
                    return 1
            return 0
        finally:
            node.session.stop()
            node.destroy_node()
    finally:
        rclpy.try_shutdown()


def trigger(action: Callable[[], None], _: Any, response: Any) -> Any:
    """Serve a Trigger by an action that always succeeds."""
    action()
    response.success = True
    return response


def input_qos(config: Config) -> QoSProfile:
    """Profile of the inputs; to lose nothing takes a sender that repeats and room for it all."""
    every = config.ros.queue_policy == 'every'
    reliable = every or config.ros.qos_reliability == 'reliable'
    return QoSProfile(
        history=QoSHistoryPolicy.KEEP_ALL if every else QoSHistoryPolicy.KEEP_LAST,
        depth=config.ros.qos_depth,
        reliability=(QoSReliabilityPolicy.RELIABLE if reliable
                     else QoSReliabilityPolicy.BEST_EFFORT))


def _words(qos: QoSProfile) -> str:
    return f'{qos.reliability.name.lower()}, {qos.durability.name.lower()}'
