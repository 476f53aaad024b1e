"""Play a bag into the odometry node: ros2 launch djet_ros replay.launch.py bag:=FOLDER ."""

from djet_ros.ros.launching import arguments, CONFIG
from launch import LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    ExecuteProcess,
    IncludeLaunchDescription,
    LogInfo,
    Shutdown,
)
from launch.conditions import IfCondition, UnlessCondition
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

LOOP = LaunchConfiguration('loop')


def shut_down_if_player_failed(event, context):
    """Shut down if the bag player failed; after a complete bag the nodes keep running."""
    if event.returncode and not context.is_shutdown:
        why = 'the bag player failed; see the output of bag_player'
        return [LogInfo(msg=why), Shutdown(reason=why)]
    return []


def player(*options, condition):
    """Describe the bag player, which waits for discovery before the first message."""
    return ExecuteProcess(
        name='bag_player', output='screen', condition=condition,
        on_exit=shut_down_if_player_failed,
        cmd=['ros2', 'bag', 'play', LaunchConfiguration('bag'), '--clock', '--delay', '3',
             '--rate', LaunchConfiguration('rate'), '--disable-keyboard-controls', *options])


def generate_launch_description():
    """Describe the bag player, and include vo.launch.py with simulated time."""
    vo = PathJoinSubstitution([FindPackageShare('djet_ros'), 'launch', 'vo.launch.py'])
    return LaunchDescription([
        DeclareLaunchArgument('bag', description='folder or file of the bag'),
        DeclareLaunchArgument('rate', default_value='1.0',
                              description='playback rate, relative to the recording'),
        DeclareLaunchArgument('loop', default_value='false', choices=['true', 'false'],
                              description='whether to restart the bag at its end'),
        # The topic is that of djet kitti-to-bag; the parameters process every image.
        *arguments('image', 'params_file', 'base_frame', 'rviz', image='/camera/image_rect',
                   params_file=PathJoinSubstitution([CONFIG, 'replay.yaml'])),
        IncludeLaunchDescription(PythonLaunchDescriptionSource(vo), launch_arguments={
            'use_sim_time': 'true'}.items()),
        player(condition=UnlessCondition(LOOP)),
        player('--loop', condition=IfCondition(LOOP)),
    ])
