"""Entry point of the live node: ``ros2 run djet_ros vo_node``."""

from __future__ import annotations

import argparse
from importlib.util import find_spec
import signal
import sys
from threading import Event

from djet_ros.threads import one_blas_thread

EPILOG = """\
Topics, parameters and the rest are given as to every ROS node:
  vo_node --ros-args -r image:=/camera/image_raw --params-file vo.yaml
"""


def main() -> int:
    """Run the node until SIGINT or SIGTERM; 2 where it can't be run, with the reason."""
    one_blas_thread()
    stop = Event()
    # First of all: the imports take their time, and end no worse than anything later.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    if find_spec('rclpy') is None:
        return _fail("rclpy is missing: install ROS 2 and 'source /opt/ros/jazzy/setup.bash'; "
                     "without ROS, 'djet replay' works on recorded bags")

    from djet_ros.errors import DjetError, one_line
    try:
        from djet_ros.ros.node import run
        from rclpy.utilities import remove_ros_args
    except ImportError as error:
        # Such as an rclpy that was built for another Python.
        return _fail(f'this Python ({sys.executable}) lacks something: {one_line(error)}')
    parser = argparse.ArgumentParser(
        prog='vo_node', description='Visual odometry by D-JET as a ROS 2 node.', epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.parse_args(remove_ros_args()[1:])
    try:
        return 0 if stop.is_set() else run(stop)
    except DjetError as error:
        return _fail(str(error))


def _fail(reason: str) -> int:
    print(f'vo_node: error: {reason}', file=sys.stderr)
    return 2


if __name__ == '__main__':
    sys.exit(main())
