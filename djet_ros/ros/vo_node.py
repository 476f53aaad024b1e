"""Entry point of the live node."""

from __future__ import annotations

from importlib.util import find_spec
import sys


def main() -> int:
    """Say in one line what is missing for the live node; the exit code is 2."""
    if find_spec('rclpy') is None:
        missing = "rclpy is missing: install ROS 2 and 'source /opt/ros/jazzy/setup.bash'"
    else:
        missing = "this version has no live node yet: 'djet replay' works on recorded bags"
    print(f'vo_node: error: {missing}', file=sys.stderr)
    return 2
