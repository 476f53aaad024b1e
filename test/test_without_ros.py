"""The error message of a node started without ROS."""

from __future__ import annotations

import json
from pathlib import Path
import subprocess
import sys

import pytest

# Of a sourced ROS, the rest of this Python stays.
PATHS = [path for path in sys.path if not (Path(path) / 'rclpy').exists()]


@pytest.mark.parametrize('node', ['vo_node', 'pose_graph_node'])
@pytest.mark.parametrize('arguments', [
    [], ['--help'], ['--ros-args', '-r', 'image:=/camera/image']])
def test_the_nodes_name_in_one_line_the_missing_module(
        tmp_path: Path, arguments: list[str], node: str) -> None:
    program = (f'import sys; sys.path[:] = {json.dumps(PATHS)}; '
               f'from djet_ros.cli.nodes import {node}; sys.exit({node}())')
    done = subprocess.run([sys.executable, '-c', program, *arguments], capture_output=True,
                          text=True, check=False, cwd=tmp_path)
    assert done.returncode == 2
    line, = done.stderr.splitlines()
    assert line.startswith(f'{node}: error: rclpy is missing: install ROS 2')


def test_the_live_odometry_needs_no_library_that_ubuntu_does_not_package() -> None:
    # rosdep installs neither, and the node runs without them.
    program = ('import sys; sys.modules["rosbags"] = sys.modules["gtsam"] = None; '
               'import djet_ros.live.odometry_node')
    subprocess.run([sys.executable, '-c', program], check=True)
