"""Play a bag into the odometry: ros2 launch djet_ros replay.launch.py bag:=FOLDER ."""

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


def end_without_a_player(event, context):
    """End all where the player failed; what it has played to its end can still be looked at."""
    if event.returncode and not context.is_shutdown:
        why = 'the bag is not played; see what bag_player says'
        return [LogInfo(msg=why), Shutdown(reason=why)]
    return []


def player(*options, condition):
    """Play the bag, once the node has had the time to find the player."""
    return ExecuteProcess(
        name='bag_player', output='screen', condition=condition, on_exit=end_without_a_player,
        cmd=['ros2', 'bag', 'play', LaunchConfiguration('bag'), '--clock', '--delay', '3',
             '--rate', LaunchConfiguration('rate'), '--disable-keyboard-controls', *options])


def generate_launch_description():
    """Describe the player, and include vo.launch.py with simulated time."""
    vo = PathJoinSubstitution([FindPackageShare('djet_ros'), 'launch', 'vo.launch.py'])
    return LaunchDescription([
        DeclareLaunchArgument('bag', description='folder or file of the recording'),
        DeclareLaunchArgument('rate', default_value='1.0', description='how many times as fast'),
        DeclareLaunchArgument('loop', default_value='false', choices=['true', 'false'],
                              description='begin again at the end'),
        # As djet kitti-to-bag names the images, and so that every image is worked on.
        *arguments('image', 'params_file', 'base_frame', 'rviz', image='/camera/image_rect',
                   params_file=PathJoinSubstitution([CONFIG, 'replay.yaml'])),
        IncludeLaunchDescription(PythonLaunchDescriptionSource(vo), launch_arguments={
            'use_sim_time': 'true'}.items()),
        player(condition=UnlessCondition(LOOP)),
        player('--loop', condition=IfCondition(LOOP)),
    ])
