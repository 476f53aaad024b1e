"""The commands of the ROS 2 nodes: ``ros2 run djet_ros vo_node`` and ``pose_graph_node``."""

from __future__ import annotations

import argparse
from importlib import import_module
from importlib.util import find_spec
import sys

from djet_ros.cli.graph_options import stop_by_signal
from djet_ros.libraries import problem_of
from djet_ros.threads import one_blas_thread, sleep_while_waiting

_EPILOG = """\
Remappings and parameters are given as for any ROS node:
  {name} --ros-args -r image:=/camera/image_raw --params-file vo.yaml
"""


def vo_node() -> int:
    """Run the odometry until a signal; return the exit code, 2 if it can't be run."""
    return _run('vo_node', 'Visual odometry by D-JET as a ROS 2 node.',
                without_ros="without ROS, 'djet replay' works on recorded bags")


def pose_graph_node() -> int:
    """Run the pose graph until a signal; return the exit code, 2 if it can't be run."""
    return _run('pose_graph_node', "Closes the loops of vo_node's odometry, as a ROS 2 node.",
                without_ros="without ROS, 'djet slam' works on recorded bags",
                library='gtsam')


def _run(name: str, description: str, *, without_ros: str,
         library: str = '') -> int:
    """
    Run a node until a signal and return the exit code.

    It is 2 for errors that the user can correct, reported in one line. without_ros: the
    alternative to suggest if ROS is missing; library: Python module needed besides ROS.
    """
    one_blas_thread()
    sleep_while_waiting()
    # Before the slow imports, so that a signal during them ends the node cleanly too.
    stop = stop_by_signal()
    if find_spec('rclpy') is None:
        return _fail(name, "rclpy is missing: install ROS 2 and 'source "
                           f"/opt/ros/jazzy/setup.bash'; {without_ros}")
    if library and (problem := problem_of(library)):
        return _fail(name, problem)

    from djet_ros.errors import DjetError, one_line
    try:
        running = import_module('djet_ros.ros.running')
        make = import_module(f'djet_ros.ros.{name}').make
    except ImportError as error:
        # For example an rclpy built for another Python version.
        return _fail(name, f'an import failed in this Python ({sys.executable}): '
                           f'{one_line(error)}')
    parser = argparse.ArgumentParser(
        prog=name, description=description, epilog=_EPILOG.format(name=name),
        formatter_class=argparse.RawDescriptionHelpFormatter)
    try:
        if (rest := parser.parse_known_args(running.non_ros_arguments())[1]):
            raise DjetError(f"unrecognized argument '{one_line(rest[0])}'; ROS arguments, such as "
                            "-r image:=/camera/image_raw, must follow '--ros-args'")
        return 0 if stop.is_set() else int(running.run_node(name, make, stop))
    except DjetError as error:
        return _fail(name, str(error))


def _fail(name: str, reason: str) -> int:
    print(f'{name}: error: {reason}', file=sys.stderr)
    return 2
