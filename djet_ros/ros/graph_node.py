"""The ROS 2 node of the pose graph: subscriptions, publishers, service and parameters."""

from __future__ import annotations

from functools import partial
from threading import Event

from djet_ros.config.sections import NODE_NAME
from djet_ros.live.graph_session import GraphSession
from djet_ros.live.topics import graph_input_type, GRAPH_INPUTS, graph_outputs
from djet_ros.posegraph.live_slam import LiveSlam
from djet_ros.ros.parameters import graph_parameters
from djet_ros.ros.wired_node import input_qos, message_type, run as run_node, trigger, WiredNode
from rclpy.qos import QoSProfile
from std_srvs.srv import Trigger

# Messages that the middleware keeps while Python is in a long optimisation.
_DEPTH = 1000


class PoseGraphNode(WiredNode):
    """The live SLAM as a node."""

    def __init__(self) -> None:
        super().__init__('pose_graph_node')
        config, slam = graph_parameters(self)
        image, info = self.image_topics(config)
        topics = {name: self.resolve_topic_name(f'{NODE_NAME}/{name}') for name in GRAPH_INPUTS}
        self.session: GraphSession = GraphSession(
            LiveSlam(config, slam, message_type, image), self,
            {**topics, 'image': image, 'camera_info': info})
        self.advertise(graph_outputs(tf=slam.publish_tf))
        for name, callback in zip(GRAPH_INPUTS, (self.session.odometry,
                                                 self.session.relative_pose)):
            self.listen(graph_input_type(name), f'{NODE_NAME}/{name}', callback,
                        QoSProfile(depth=_DEPTH))
        self.listen_to_camera(image, info, config, QoSProfile(
            depth=slam.image_buffer, reliability=input_qos(config).reliability))
        self.create_service(Trigger, '~/reset', partial(trigger, self.session.reset))
        self.get_logger().info(f'odometry from {topics["odometry"]}, images from {image}, '
                               f'camera_info from {info}')


def run(stop: Event) -> int:
    """Run the node until stop is set; gives the exit code, 1 where its work failed."""
    return run_node(PoseGraphNode, stop)
