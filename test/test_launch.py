"""Launch files and what they configure: read without ROS, described and started with it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
import json
import os
from pathlib import Path
import re
import shlex
import shutil
import signal
import subprocess
import sys
from time import monotonic, sleep
from typing import Any

from djet_ros.config.flat import from_flat
from djet_ros.config.sections import NodeConfig, OdometryConfig
from djet_ros.config.yaml_files import load_yaml
from djet_ros.live.topics import graph_outputs, odometry_outputs
import pytest
from ros_graph import command
import yaml

ROOT = Path(__file__).parents[1]
FILES = sorted((ROOT / 'launch').glob('*.launch.py'))

ARGUMENTS = {
    'vo.launch.py': {'image', 'camera_info', 'params_file', 'base_frame', 'namespace', 'name',
                     'log_level', 'respawn', 'publish_tf', 'image_transport', 'use_sim_time',
                     'rviz'},
    'slam.launch.py': {'image', 'camera_info', 'params_file', 'slam_params_file', 'base_frame',
                       'namespace', 'log_level', 'respawn', 'publish_tf', 'image_transport',
                       'use_sim_time'},
    'replay.launch.py': {'bag', 'rate', 'loop', 'image', 'params_file', 'base_frame', 'rviz'},
}


def topics(rviz: Any) -> list[str]:
    return [display['Topic']['Value'] for display in rviz['Visualization Manager']['Displays']
            if 'Topic' in display]


def test_every_launch_file_is_python() -> None:
    assert {path.name for path in FILES} == ARGUMENTS.keys()
    for path in FILES:
        compile(path.read_text(), path, 'exec')


def test_replay_yaml_differs_from_the_defaults_in_queue_policy_and_path() -> None:
    assert load_yaml(ROOT / 'config' / 'replay.yaml') == from_flat(
        {'ros.queue_policy': 'every', 'ros.publish_path': True})


def test_rviz_shows_what_the_node_publishes() -> None:
    shown = topics(yaml.safe_load((ROOT / 'config' / 'vo.rviz').read_text()))
    assert shown == ['/vo_node/odometry', '/vo_node/path', '/vo_node/landmarks',
                     '/vo_node/debug_image']


def test_robot_localization_example_fuses_only_the_twist() -> None:
    page = (ROOT / 'doc' / 'slam-backend.md').read_text()
    block, = re.findall(r'```yaml\n(ekf_filter_node:.*?)```', page, re.DOTALL)
    recipe = yaml.safe_load(block)['ekf_filter_node']['ros__parameters']
    node, topic = recipe['odom0'].strip('/').split('/')
    assert (node, odometry_outputs(NodeConfig())[topic]) == ('vo_node', 'nav_msgs/msg/Odometry')
    assert recipe['odom_frame'] == recipe['world_frame'] == OdometryConfig().odom_frame
    # its order: x y z, roll pitch yaw, their velocities, three accelerations
    assert recipe['odom0_config'] == [False] * 6 + [True] * 6 + [False] * 3


def texts(value: Any) -> Iterator[str]:
    """Return all texts in a JSON value, the names of fields among them."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for one in [*value, *value.values()] if isinstance(value, dict) else value:
            yield from texts(one)


def test_foxglove_shows_what_the_nodes_publish_and_the_launch_files_camera() -> None:
    layout = json.loads((ROOT / 'config' / 'foxglove.json').read_text())
    outputs = [('vo_node', odometry_outputs(NodeConfig(publish_path=True, publish_tf=True))),
               ('pose_graph_node', graph_outputs(tf=True))]
    published = {topic if topic.startswith('/') else f'/{node}/{topic}'
                 for node, topics_of_node in outputs for topic in topics_of_node}
    images = '/camera/image_raw'
    assert f"'default_value': '{images[1:]}'" in (
        ROOT / 'djet_ros' / 'ros' / 'launching.py').read_text()
    camera = {images, images.rpartition('/')[0] + '/camera_info'}
    shown = {text for text in texts(layout) if text.startswith('/')}
    assert shown <= published | camera
    assert shown >= {images, '/vo_node/debug_image', '/vo_node/path',
                     '/pose_graph_node/path', '/diagnostics'}
    assert 'vo_node: visual odometry' in texts(layout)


def test_every_foxglove_panel_is_in_the_layout() -> None:
    layout = json.loads((ROOT / 'config' / 'foxglove.json').read_text())
    placed = [text for text in texts(layout['layout']) if '!' in text]
    assert sorted(placed) == sorted(layout['configById'])


@pytest.mark.parametrize('path', FILES, ids=lambda path: path.name)
def test_launch_arguments_have_descriptions(path: Path) -> None:
    pytest.importorskip('launch_ros', reason='launch comes with ROS 2')
    from launch.actions import DeclareLaunchArgument
    from launch.launch_description_sources import get_launch_description_from_python_launch_file
    description = get_launch_description_from_python_launch_file(str(path))
    # Its own; where the package is installed, those of included files are found as well.
    arguments = [one for one in description.entities if isinstance(one, DeclareLaunchArgument)]
    assert {argument.name for argument in arguments} == ARGUMENTS[path.name]
    assert all(argument.description for argument in arguments)


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """Return the environment of an installed package: its share, and the node where ROS looks."""
    pytest.importorskip('rclpy', reason='rclpy is missing: no ROS 2 is sourced here')
    index = tmp_path / 'share' / 'ament_index' / 'resource_index' / 'packages'
    index.mkdir(parents=True)
    (index / 'djet_ros').touch()
    share = tmp_path / 'share' / 'djet_ros'
    for folder in ('config', 'launch'):
        shutil.copytree(ROOT / folder, share / folder)
    commands = tmp_path / 'lib' / 'djet_ros'
    commands.mkdir(parents=True)
    for name in ('vo_node', 'pose_graph_node'):
        node = commands / name
        node.write_text(f'#!/bin/sh\nexec {shlex.join(command(name))} "$@"\n')
        node.chmod(0o755)
    return {**os.environ, 'PYTHONPATH': f'{ROOT}:{os.environ.get("PYTHONPATH", "")}',
            'AMENT_PREFIX_PATH': f'{tmp_path}:{os.environ["AMENT_PREFIX_PATH"]}',
            'ROS_DOMAIN_ID': str(1 + os.getpid() % 100), 'ROS_LOG_DIR': str(tmp_path / 'log')}


def launched(environment: dict[str, str], log: Path, *launch_arguments: str, until: str,
             times: int = 1) -> str:
    """Run ros2 launch until its output has a text so often, end it by Ctrl-C, give the output."""
    with log.open('w') as file:
        # A shell's background job, such as this run of the tests may be, has Ctrl-C switched off.
        process = subprocess.Popen(
            ['ros2', 'launch', 'djet_ros', *launch_arguments], env=environment, stdout=file,
            stderr=subprocess.STDOUT, start_new_session=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler))
    try:
        end = monotonic() + 30
        while log.read_text().count(until) < times and monotonic() < end \
                and process.poll() is None:
            sleep(0.1)
        process.send_signal(signal.SIGINT)
        process.wait(20)
    finally:
        # No node may be left on the graph of the next test.
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    return log.read_text()


def parameters_of_launched(environment: dict[str, str], folder: Path, *launch_arguments: str
                           ) -> tuple[bool, bool]:
    """Return use_sim_time and ros.publish_tf of the odometry that a launch file starts."""
    node = folder / 'lib' / 'djet_ros' / 'vo_node'
    node.write_text(f'#!/bin/sh\nexec {shlex.join([sys.executable, "-c", TELL])} "$@"\n')
    output = launched(environment, folder / 'out', *launch_arguments, until='TOLD')
    clock, tf = re.findall(r'TOLD (\w+) (\w+)', output)[0]
    return clock == 'True', tf == 'True'


# What a node gets, by rclpy alone: the launch is under test.
TELL = """
import rclpy
rclpy.init()
node = rclpy.create_node('vo_node', automatically_declare_parameters_from_overrides=True)
tf = node.has_parameter('ros.publish_tf') and node.get_parameter('ros.publish_tf').value
print('TOLD', node.get_parameter('use_sim_time').value, tf, flush=True)
rclpy.spin(node)
"""


@pytest.mark.ros
def test_vo_launch_starts_the_node_on_the_topics_given(
        environment: dict[str, str], tmp_path: Path) -> None:
    output = launched(environment, tmp_path / 'out', 'vo.launch.py', 'image:=/left/image_raw',
                      until='queue policy')
    assert 'images from /left/image_raw, camera_info from /left/camera_info' in output
    assert 'queue policy latest' in output
    assert re.search(r'vo_node-1\]: process has finished cleanly', output)


@pytest.mark.ros
def test_vo_launch_names_and_respawns_the_node(
        environment: dict[str, str], tmp_path: Path) -> None:
    broken = tmp_path / 'lib' / 'djet_ros' / 'vo_node'
    broken.write_text('#!/bin/sh\necho started with "$@"\nexit 1\n')
    output = launched(environment, tmp_path / 'out', 'vo.launch.py', 'namespace:=left',
                      'name:=eye', 'respawn:=true', 'log_level:=warn',
                      until='process started with pid', times=2)
    assert '__node:=eye' in output
    assert '__ns:=/left' in output
    assert '--log-level warn' in output


@pytest.mark.ros
def test_missing_parameter_file_ends_the_launch(
        environment: dict[str, str], tmp_path: Path) -> None:
    output = launched(environment, tmp_path / 'out', 'vo.launch.py', 'params_file:=/no/such.yaml',
                      until='params_file')
    assert 'params_file:=/no/such.yaml does not exist or is not a file' in output
    assert 'process started' not in output


OUTER = """\
from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch_ros.actions import SetParameter
def generate_launch_description():
    return LaunchDescription([SetParameter('use_sim_time', True), IncludeLaunchDescription(
        PythonLaunchDescriptionSource({!r}))])
"""

OWN = '/**: {ros__parameters: {use_sim_time: true, ros: {publish_tf: true}}}'


@pytest.mark.ros
@pytest.mark.parametrize(('file', 'given', 'clock', 'tf'), [
    ('vo.launch.py', (), True, True),
    ('vo.launch.py', ('use_sim_time:=false',), False, True),
    ('vo.launch.py', ('publish_tf:=false',), True, False),
    ('slam.launch.py', (), True, True),
    ('slam.launch.py', ('publish_tf:=false',), True, False)])
def test_launch_arguments_override_the_parameter_file(
        environment: dict[str, str], tmp_path: Path, file: str, given: tuple[str, ...],
        clock: bool, tf: bool) -> None:
    own = tmp_path / 'own.yaml'
    own.write_text(OWN)
    assert parameters_of_launched(environment, tmp_path, file, f'params_file:={own}', *given) == (
        clock, tf)


@pytest.mark.ros
def test_slam_launch_publishes_tf_by_default(
        environment: dict[str, str], tmp_path: Path) -> None:
    assert parameters_of_launched(environment, tmp_path, 'slam.launch.py') == (False, True)


@pytest.mark.ros
@pytest.mark.parametrize('included', ['vo.launch.py', 'replay.launch.py'])
def test_launch_arguments_set_tf_and_image_transport(
        environment: dict[str, str], tmp_path: Path, included: str) -> None:
    given = ['publish_tf:=true', 'image_transport:=compressed', 'image:=/eye/image_raw']
    with_bag = [*given, 'bag:=/no/bag'] if included == 'replay.launch.py' else given
    outside = with_player(environment, tmp_path, 'exec sleep 60')
    output = launched(outside, tmp_path / 'out', included, *with_bag, until='queue policy')
    assert 'images from /eye/image_raw/compressed, camera_info from /eye/camera_info' in output
    assert parameters_of_launched(outside, tmp_path, included, *with_bag)[1]


@pytest.mark.ros
def test_including_launch_file_can_set_use_sim_time(
        environment: dict[str, str], tmp_path: Path) -> None:
    inner = tmp_path / 'share' / 'djet_ros' / 'launch' / 'vo.launch.py'
    inner.with_name('outer.launch.py').write_text(OUTER.format(str(inner)))
    assert parameters_of_launched(environment, tmp_path, 'outer.launch.py') == (True, False)


@pytest.mark.ros
def test_missing_rviz_ends_the_launch_with_one_line(
        environment: dict[str, str], tmp_path: Path) -> None:
    from ament_index_python.packages import get_packages_with_prefixes
    if 'rviz2' in get_packages_with_prefixes():
        pytest.skip('rviz2 is installed')
    output = launched(environment, tmp_path / 'out', 'vo.launch.py', 'rviz:=true', until='rviz2')
    assert 'rviz:=true needs rviz2, which is not installed: sudo apt install ros-$ROS_' in output
    assert 'process started' not in output


@pytest.mark.ros
def test_two_cameras_have_their_own_nodes_and_topics(
        environment: dict[str, str], tmp_path: Path) -> None:
    pytest.importorskip('tf2_ros', reason='tf2_ros_py is not installed')
    output = launched(environment, tmp_path / 'out', 'two_cameras.launch.xml',
                      'base_frame:=base_link',
                      until='queue policy', times=2)
    for side in ('left', 'right'):
        assert f'[{side}.vo_node]: images from /{side}/camera/image_raw, camera_info from ' \
               f'/{side}/camera/camera_info' in output


def with_player(environment: dict[str, str], folder: Path, does: str) -> dict[str, str]:
    """Return an environment with a fake ``ros2 bag``, as it may not be installed."""
    (folder / 'bin').mkdir()
    ros2 = folder / 'bin' / 'ros2'
    ros2.write_text(f'#!/bin/sh\n[ "$1" = bag ] && {{ {does}; }}\n'
                    f'exec {shlex.quote(str(shutil.which("ros2")))} "$@"\n')
    ros2.chmod(0o755)
    return {**environment, 'PATH': f'{ros2.parent}:{environment["PATH"]}'}


@pytest.mark.ros
def test_replay_launch_ends_if_the_player_fails(
        environment: dict[str, str], tmp_path: Path) -> None:
    for code, until in ((3, 'NEVER'), (0, 'queue policy')):
        place = tmp_path / str(code)
        place.mkdir()
        begun = monotonic()
        output = launched(with_player(environment, place, f'exit {code}'), place / 'out',
                          'replay.launch.py', 'bag:=/no/bag', until=until)
        assert monotonic() - begun < 20
        assert ('the bag player failed' in output) is bool(code)
    assert re.search(r'vo_node-\d\]: process has finished cleanly', output)


@pytest.mark.ros
def test_replay_launch_plays_a_bag_into_a_node_that_drops_nothing(
        environment: dict[str, str], tmp_path: Path) -> None:
    output = launched(with_player(environment, tmp_path, 'exec sleep 60'), tmp_path / 'out',
                      'replay.launch.py', 'bag:=/no/bag', 'loop:=true', until='queue policy')
    assert 'images from /camera/image_rect, camera_info from /camera/camera_info' in output
    assert 'queue policy every' in output
    assert re.search(r'bag_player-\d\]: process started', output)
    assert re.search(r'vo_node-\d\]: process has finished cleanly', output)


@pytest.mark.ros
def test_slam_launch_feeds_the_pose_graph_with_the_odometry(
        environment: dict[str, str], tmp_path: Path) -> None:
    pytest.importorskip('gtsam', reason='GTSAM is not installed: the extra slam')
    output = launched(environment, tmp_path / 'out', 'slam.launch.py', 'image:=/left/image_raw',
                      until='odometry from')
    assert re.search(r'odometry from /vo_node/odometry, images from /left/image_raw, '
                     'camera_info from /left/camera_info', output)
    assert 'unknown parameter' not in output
    for node in ('vo_node-1', 'pose_graph_node-2'):
        assert f'[{node}]: process has finished cleanly' in output
