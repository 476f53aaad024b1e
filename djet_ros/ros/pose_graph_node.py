"""The pose graph as a ROS 2 node."""

from __future__ import annotations

from djet_ros.live.face import Face
from djet_ros.live.graph_face import GraphFace
from djet_ros.ros.middleware import RosMiddleware
from djet_ros.ros.parameters import graph_parameters
from rclpy.node import Node


def make(node: Node) -> Face:
    """Create the pose graph from the parameters of a node, which are read-only."""
    return GraphFace(RosMiddleware(node), graph_parameters(node))
