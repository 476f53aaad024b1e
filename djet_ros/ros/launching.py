"""Launch arguments and node descriptions that the launch files share."""

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

# Arguments that override a parameter of the files unless they are empty: parameter and type.
_OVERRIDES = {'base_frame': ('odometry.base_frame', str), 'publish_tf': ('ros.publish_tf', bool),
              'image_transport': ('ros.image_transport', str)}

_BOOLEAN = {'choices': ['true', 'false'], 'default_value': 'false'}

# By name: the description, and further arguments of DeclareLaunchArgument.
_ARGUMENTS: dict[str, tuple[str, dict[str, Any]]] = {
    'image': ('image topic, relative to the namespace',
              {'default_value': 'camera/image_raw'}),
    'camera_info': ('CameraInfo topic; default: camera_info in the namespace of the image topic',
                    {'default_value': 'camera_info'}),
    'params_file': ('YAML file with parameters of vo_node; pose_graph_node also reads the '
                    'parameters that both nodes share from it',
                    {'default_value': PathJoinSubstitution([CONFIG, 'vo.yaml'])}),
    'slam_params_file': ('YAML file with parameters of pose_graph_node',
                         {'default_value': PathJoinSubstitution([CONFIG, 'slam.yaml'])}),
    'base_frame': ('frame of the vehicle whose pose is estimated, such as base_link; needs its '
                   'transform to the camera on tf; empty: value of the parameter file',
                   {'default_value': ''}),
    'namespace': ('namespace of nodes and topics, such as the name of a camera',
                  {'default_value': ''}),
    'name': ('name of the odometry node', {'default_value': 'vo_node'}),
    'log_level': ('minimum severity of log messages', {
        'default_value': 'info', 'choices': ['debug', 'info', 'warn', 'error', 'fatal']}),
    'respawn': ('whether to restart a node that ended with an error', _BOOLEAN),
    'publish_tf': ('whether to publish the pose of the odometry on tf; empty: value of the '
                   'parameter file',
                   {'choices': ['true', 'false', ''], 'default_value': ''}),
    'image_transport': ('raw, or compressed for <image>/compressed; empty: value of the parameter '
                        'file',
                        {'choices': ['raw', 'compressed', ''], 'default_value': ''}),
    'use_sim_time': ('whether to use the time of /clock; empty: value of the parameter file or of '
                     'an including launch file',
                     {'choices': ['true', 'false', ''], 'default_value': ''}),
    'rviz': ('whether to start RViz (package rviz2), configured for the default topic names',
             _BOOLEAN),
}


def arguments(*names: str, **defaults: str | Substitution) -> list[DeclareLaunchArgument]:
    """Declare arguments by name; defaults: values that replace the usual defaults."""
    return [DeclareLaunchArgument(name, description=text, **{
        **more, **({'default_value': defaults[name]} if name in defaults else {})})
            for name in names for text, more in [_ARGUMENTS[name]]]


def _sim_time(context: LaunchContext) -> dict[str, ParameterValue]:
    """Return the parameter use_sim_time if the argument is set, as files may set it too."""
    given = LaunchConfiguration('use_sim_time')
    return ({'use_sim_time': ParameterValue(given, value_type=bool)} if given.perform(context)
            else {})


def rviz() -> OpaqueFunction:
    """Describe RViz, which is optional; DjetError at launch if it is not installed."""
    def describe(context: LaunchContext) -> list[Node]:
        try:
            get_package_prefix('rviz2')
        except PackageNotFoundError:
            raise DjetError('rviz:=true needs rviz2, which is not installed: sudo '
                            'apt install ros-$ROS_DISTRO-rviz2') from None
        return [Node(package='rviz2', executable='rviz2', name='rviz_of_vo',
                     parameters=[_sim_time(context)],
                     arguments=['-d', PathJoinSubstitution([CONFIG, 'vo.rviz'])])]

    return OpaqueFunction(function=describe, condition=IfCondition(LaunchConfiguration('rviz')))


def node(executable: str, name: str | Substitution, *files: str,
         overrides: Sequence[str] = ('base_frame', 'image_transport')) -> OpaqueFunction:
    """
    Describe a node of this package on the camera given by the arguments.

    files: arguments that are parameter files; overrides: arguments that override them.
    """
    def describe(context: LaunchContext) -> list[Node]:
        for file in files:
            # ROS would only warn, and start the node without the file.
            if not (path := Path(LaunchConfiguration(file).perform(context))).is_file():
                raise DjetError(f'{file}:={path} does not exist or is not a file; give the path '
                                'of a YAML parameter file')
        values = _sim_time(context)
        for argument in overrides:
            parameter, kind = _OVERRIDES[argument]
            # An empty argument must not override a file.
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
