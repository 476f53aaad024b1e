"""The odometry as a ROS 2 node."""

from __future__ import annotations

from djet_ros.live.base_node import LiveNode
from djet_ros.live.odometry_node import OdometryNode
from djet_ros.ros.middleware import RosMiddleware
from djet_ros.ros.parameters import Parameters
from rclpy.node import Node


def make(node: Node) -> LiveNode:
    """Create the odometry from the parameters of a node, which may change at run time."""
    parameters = Parameters(node)
    odometry = OdometryNode(RosMiddleware(node), parameters.config)
    parameters.call_on_change(odometry.connect, odometry.configure)
    return odometry
