"""Entry point of the live SLAM: ``ros2 run djet_ros pose_graph_node``."""

from __future__ import annotations

import sys

from djet_ros.ros.entry import run_node


def main() -> int:
    """Run the node until SIGINT or SIGTERM; 2 where it can't be run, with the reason."""
    return run_node('pose_graph_node', 'djet_ros.ros.graph_node',
                    "Closes the loops of vo_node's odometry, as a ROS 2 node.",
                    without_ros="without ROS, 'djet slam' works on recorded bags",
                    extra=('gtsam', 'slam'))


if __name__ == '__main__':
    sys.exit(main())
