"""Entry point of the live odometry: ``ros2 run djet_ros vo_node``."""

from __future__ import annotations

import sys

from djet_ros.ros.entry import run_node


def main() -> int:
    """Run the node until SIGINT or SIGTERM; 2 where it can't be run, with the reason."""
    return run_node('vo_node', 'djet_ros.ros.node', 'Visual odometry by D-JET as a ROS 2 node.',
                    without_ros="without ROS, 'djet replay' works on recorded bags")


if __name__ == '__main__':
    sys.exit(main())
