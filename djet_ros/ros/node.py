"""The ROS 2 node: subscriptions, publishers, services and parameters around a session."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, partial
from importlib import import_module
from threading import Event
from typing import Any

from djet_ros.config import Config, NODE_NAME
from djet_ros.odometry.tracker import Outgoing, Tracker
from djet_ros.ros.parameters import Parameters
from djet_ros.ros.session import Session
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
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
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_srvs.srv import Trigger

OUTPUTS = {
    'relative_pose': 'geometry_msgs/msg/PoseStamped',
    'relative_pose_cov': 'geometry_msgs/msg/PoseWithCovarianceStamped',
    'odometry': 'nav_msgs/msg/Odometry',
    'debug_image': 'sensor_msgs/msg/Image',
    '/diagnostics': 'diagnostic_msgs/msg/DiagnosticArray',
}
PATH_OUTPUT = {'path': 'nav_msgs/msg/Path'}
TF_OUTPUT = {'/tf': 'tf2_msgs/msg/TFMessage'}

QOS_PARAMETERS = (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY,
                  QoSPolicyKind.DURABILITY)


class VoNode(Node):
    """The odometry as a node; it publishes from the thread of its session."""

    def __init__(self) -> None:
        super().__init__(NODE_NAME, automatically_declare_parameters_from_overrides=True)
        self._parameters_of_odometry = Parameters(self, self._apply)
        config = self._parameters_of_odometry.config
        image, info = self._input_topics(config)
        self._session = Session(Tracker(config, message_type, image_topic=image), self,
                                {'image': image, 'camera_info': info})
        # Publishers that do not fit are reported by name, which becomes known a little later.
        self._mismatched: dict[str, Subscription] = {}
        self._outputs: dict[str, Publisher] = {}
        self._speed_inputs: list[Subscription] = []
        self._info_topic = info
        self._latched_input: Subscription | None = None
        self._connect(config)

        # CameraInfo first: of two that wait, it is to be taken before its image.
        self._listen(CameraInfo, info, self._session.camera_info, _qos(config))
        self._listen(CompressedImage if config.ros.image_transport == 'compressed' else Image,
                     image, self._session.image, _qos(config), self._session.count_lost)
        for name, action in (('reset', self._session.reset), ('pause', self._session.pause),
                             ('resume', self._session.resume)):
            self.create_service(Trigger, f'~/{name}', partial(_serve, action))
        # Also where simulated time stands still.
        self.create_timer(1.0, self._tick, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self.get_logger().info(f'images from {image}, camera_info from {info}, '
                               f'queue policy {config.ros.queue_policy}')

    def start(self) -> None:
        """Begin to work on images."""
        self._session.start()

    def stop(self) -> None:
        """Publish nothing more."""
        self._session.stop()

    @property
    def failed(self) -> bool:
        """Whether the odometry ended by an error."""
        return self._session.failed

    # What the session asks for

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
        return bool(self._outputs['debug_image'].get_subscription_count())

    # Inputs and outputs

    def _input_topics(self, config: Config) -> tuple[str, str]:
        """
        Resolve the names of the images and of their CameraInfo.

        As with image_transport, only the image's name needs to be remapped: camera_info is taken
        beside it, and the compressed images below it.
        """
        image = self.resolve_topic_name('image').removesuffix('/compressed')
        info = self.resolve_topic_name('camera_info')
        if info == self.resolve_topic_name('camera_info', only_expand=True):
            info = f'{image.rpartition("/")[0]}/camera_info'
        if config.ros.image_transport == 'compressed':
            image += '/compressed'
        return image, info

    def _connect(self, config: Config) -> None:
        """Make the publishers and the speed subscriptions that a configuration asks for."""
        wanted = {**OUTPUTS, **(PATH_OUTPUT if config.ros.publish_path else {}),
                  **(TF_OUTPUT if config.ros.publish_tf else {})}
        for topic in wanted.keys() - self._outputs.keys():
            name = topic if topic.startswith('/') else f'~/{topic}'
            self._outputs[topic] = self.create_publisher(
                message_type(wanted[topic]), name, QoSProfile(depth=10),
                qos_overriding_options=QoSOverridingOptions(QOS_PARAMETERS))
        if config.odometry.scale == 'speed' and not self._speed_inputs:
            self._speed_inputs = [
                self._listen(TwistStamped, 'speed', self._session.speed, _qos(config)),
                self._listen(Odometry, 'speed_odometry', self._session.speed, _qos(config))]

    def _listen(self, kind: type, topic: str, callback: Callable[[Any], None], qos: QoSProfile,
                count_lost: Callable[[int], None] = lambda number: None) -> Subscription:
        def note_mismatch(_: object) -> None:
            self._mismatched[subscription.topic_name] = subscription

        subscription = self.create_subscription(
            kind, topic, callback, qos, event_callbacks=SubscriptionEventCallbacks(
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
                        CameraInfo, self._info_topic, self._session.camera_info, QoSProfile(
                            depth=1, durability=latched.durability,
                            reliability=latched.reliability))
                    return

    def _apply(self, config: Config) -> None:
        self._connect(config)
        self._session.configure(config)

    def _tick(self) -> None:
        while self._mismatched:
            self._report_mismatch(*self._mismatched.popitem())
        self._listen_for_latched()
        self._session.tick()

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


def run(stop: Event) -> int:
    """Run the node until stop is set; gives the exit code, 1 where the odometry failed."""
    # The context must outlive what is being published, so rclpy does not get to see the signals.
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = VoNode()
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        node.start()
        try:
            while not stop.is_set():
                executor.spin_once(timeout_sec=0.1)
                if node.failed:
                    return 1
            return 0
        finally:
            node.stop()
            node.destroy_node()
    finally:
        rclpy.try_shutdown()


def _qos(config: Config) -> QoSProfile:
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


def _serve(action: Callable[[], None], _: Any, response: Any) -> Any:
    action()
    response.success = True
    return response
