"""What the launch files of the nodes share: their arguments, and how a node is started."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_prefix, PackageNotFoundError
from djet_ros.errors import DjetError
from launch import LaunchContext
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitution import Substitution
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterFile, ParameterValue
from launch_ros.substitutions import FindPackageShare

CONFIG = PathJoinSubstitution([FindPackageShare('djet_ros'), 'config'])

# Arguments by which parameters are set on top of files, where they are not empty.
_SAID = {'base_frame': ('odometry.base_frame', str), 'publish_tf': ('ros.publish_tf', bool),
         'image_transport': ('ros.image_transport', str)}

_TRUTH = {'choices': ['true', 'false'], 'default_value': 'false'}

# By name: the description, and what else DeclareLaunchArgument is told.
_ARGUMENTS: dict[str, tuple[str, dict[str, Any]]] = {
    'image': ('topic of the images, relative to the namespace',
              {'default_value': 'camera/image_raw'}),
    'camera_info': ('topic of their CameraInfo; as it stands, beside the images',
                    {'default_value': 'camera_info'}),
    'params_file': ('YAML file with parameters of vo_node; pose_graph_node takes from it what '
                    'both have to agree on',
                    {'default_value': PathJoinSubstitution([CONFIG, 'vo.yaml'])}),
    'slam_params_file': ('YAML file with parameters of pose_graph_node',
                         {'default_value': PathJoinSubstitution([CONFIG, 'slam.yaml'])}),
    'base_frame': ('frame of the vehicle whose pose is wanted, such as base_link; tf knows the '
                   'camera on it; empty: as the parameters say', {'default_value': ''}),
    'namespace': ('namespace of nodes and topics, such as the name of a camera',
                  {'default_value': ''}),
    'name': ('name of the odometry node', {'default_value': 'vo_node'}),
    'log_level': ('from which level on the nodes log', {
        'default_value': 'info', 'choices': ['debug', 'info', 'warn', 'error', 'fatal']}),
    'respawn': ('start a node again that has ended by an error', _TRUTH),
    'publish_tf': ("whether the odometry's pose goes to tf; empty: as the parameters say",
                   {'choices': ['true', 'false', ''], 'default_value': ''}),
    'image_transport': ('raw, or compressed for <image>/compressed; empty: as the parameters say',
                        {'choices': ['raw', 'compressed', ''], 'default_value': ''}),
    'use_sim_time': ('take the time from /clock; empty: as the parameters or an outer launch file '
                     'say', {'choices': ['true', 'false', ''], 'default_value': ''}),
    'rviz': ('show it in RViz (package rviz2), for the names as they stand', _TRUTH),
}


def arguments(*names: str, **defaults: str | Substitution) -> list[DeclareLaunchArgument]:
    """Declare arguments by name; defaults: other default values than usual."""
    return [DeclareLaunchArgument(name, description=text, **{
        **more, **({'default_value': defaults[name]} if name in defaults else {})})
            for name in names for text, more in [_ARGUMENTS[name]]]


def _sim_time(context: LaunchContext) -> dict[str, ParameterValue]:
    """Give the parameter use_sim_time where it was asked for, as files may say it too."""
    given = LaunchConfiguration('use_sim_time')
    return ({'use_sim_time': ParameterValue(given, value_type=bool)} if given.perform(context)
            else {})


def rviz() -> OpaqueFunction:
    """Describe RViz, which the odometry itself does not need."""
    def describe(context: LaunchContext) -> list[Node]:
        try:
            get_package_prefix('rviz2')
        except PackageNotFoundError:
            raise DjetError('rviz:=true needs rviz2, which is not installed: '
                            'apt install ros-$ROS_DISTRO-rviz2') from None
        return [Node(package='rviz2', executable='rviz2', name='rviz_of_vo',
                     parameters=[_sim_time(context)],
                     arguments=['-d', PathJoinSubstitution([CONFIG, 'vo.rviz'])])]

    return OpaqueFunction(function=describe, condition=IfCondition(LaunchConfiguration('rviz')))


def node(executable: str, name: str | Substitution, *files: str,
         says: Sequence[str] = ('base_frame', 'image_transport')) -> OpaqueFunction:
    """
    Describe a node of ours on the camera that the arguments name.

    files: arguments that hold a parameter file; says: those that say more on top of these.
    """
    def describe(context: LaunchContext) -> list[Node]:
        for file in files:
            # ROS would say it in passing and start the node without.
            if not (path := Path(LaunchConfiguration(file).perform(context))).is_file():
                raise DjetError(f'{file}:={path} is no file')
        values = _sim_time(context)
        for argument in says:
            parameter, kind = _SAID[argument]
            # An empty one would take away what a file says.
            given = LaunchConfiguration(argument)
            if given.perform(context):
                values[parameter] = ParameterValue(given, value_type=kind)
        return [Node(
            package='djet_ros', executable=executable, name=name, output='screen',
            namespace=LaunchConfiguration('namespace'), respawn=LaunchConfiguration('respawn'),
            respawn_delay=2.0,
            remappings=[(topic, LaunchConfiguration(topic)) for topic in ('image', 'camera_info')],
            parameters=[*(ParameterFile(LaunchConfiguration(file)) for file in files), values],
            ros_arguments=['--log-level', LaunchConfiguration('log_level')])]

    return OpaqueFunction(function=describe)
