"""How a ROS 2 node is run."""

from __future__ import annotations

from collections.abc import Callable
from threading import Event

from djet_ros.live.face import Face
import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args


def own_words() -> list[str]:
    """Give the words of the command line that are not for ROS."""
    return list(remove_ros_args()[1:])


def run_node(name: str, make: Callable[[Node], Face], stop: Event) -> int:
    """Run a node's face until stop is set; gives the exit code, 1 where its work failed."""
    # The context must outlive what is being published, so rclpy does not get to see the signals.
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = Node(name, automatically_declare_parameters_from_overrides=True)
        try:
            return make(node).run(stop)
        finally:
            node.destroy_node()
    finally:
        rclpy.try_shutdown()
