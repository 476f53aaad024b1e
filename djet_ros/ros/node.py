"""The ROS 2 node of the odometry: subscriptions, publishers, services and parameters."""

from __future__ import annotations

from functools import partial
from threading import Event

from djet_ros.config.sections import Config, NODE_NAME
from djet_ros.live.session import Session
from djet_ros.live.topics import odometry_outputs, SPEED_TYPES
from djet_ros.odometry.tracker import Tracker
from djet_ros.ros.parameters import Parameters
from djet_ros.ros.wired_node import input_qos, message_type, run as run_node, trigger, WiredNode
from rclpy.subscription import Subscription
from std_srvs.srv import Trigger


class VoNode(WiredNode):
    """The odometry as a node."""

    def __init__(self) -> None:
        super().__init__(NODE_NAME)
        self._parameters_of_odometry = Parameters(self, self._apply)
        config = self._parameters_of_odometry.config
        image, info = self.image_topics(config)
        self.session: Session = Session(Tracker(config, message_type, image_topic=image), self,
                                        {'image': image, 'camera_info': info})
        self._speed_inputs: list[Subscription] = []
        self._connect(config)
        self.listen_to_camera(image, info, config, input_qos(config), self.session.count_lost)
        for name, action in (('reset', self.session.reset), ('pause', self.session.pause),
                             ('resume', self.session.resume)):
            self.create_service(Trigger, f'~/{name}', partial(trigger, action))
        self.get_logger().info(f'images from {image}, camera_info from {info}, '
                               f'queue policy {config.ros.queue_policy}')

    def _connect(self, config: Config) -> None:
        """Make the publishers and the speed subscriptions that a configuration asks for."""
        self.advertise(odometry_outputs(config.ros))
        if config.odometry.scale == 'speed' and not self._speed_inputs:
            self._speed_inputs = [self.listen(kind, topic, self.session.speed, input_qos(config))
                                  for topic, kind in SPEED_TYPES.items()]

    def _apply(self, config: Config) -> None:
        self._connect(config)
        self.session.configure(config)


def run(stop: Event) -> int:
    """Run the node until stop is set; gives the exit code, 1 where the odometry failed."""
    return run_node(VoNode, stop)
