"""The pose graph as a ROS 2 node."""

from __future__ import annotations

from djet_ros.live.base_node import LiveNode
from djet_ros.live.graph_node import PoseGraphNode
from djet_ros.ros.middleware import RosMiddleware
from djet_ros.ros.parameters import graph_parameters
from rclpy.node import Node


def make(node: Node) -> LiveNode:
    """Create the pose graph from the parameters of a node, which are read-only."""
    return PoseGraphNode(RosMiddleware(node), graph_parameters(node))
