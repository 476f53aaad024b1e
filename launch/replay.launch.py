"""Play a bag into the odometry: ros2 launch djet_ros replay.launch.py bag:=FOLDER ."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, IncludeLaunchDescription
from launch.conditions import IfCondition, UnlessCondition
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

SHARE = FindPackageShare('djet_ros')
LOOP = LaunchConfiguration('loop')

# Also understood by vo.launch.py, which is included.
PASSED_ON = ('image', 'params_file', 'rviz')

ARGUMENTS = [
    DeclareLaunchArgument('bag', description='folder or file of the recording'),
    DeclareLaunchArgument('rate', default_value='1.0', description='how many times as fast'),
    DeclareLaunchArgument('loop', default_value='false', choices=['true', 'false'],
                          description='begin again at the end'),
    DeclareLaunchArgument('image', default_value='/camera/image_rect',
                          description='topic of the images; as it stands, as djet kitti-to-bag '
                          'names it'),
    DeclareLaunchArgument('params_file',
                          default_value=PathJoinSubstitution([SHARE, 'config', 'replay.yaml']),
                          description='YAML file with parameters of vo_node; as it stands, every '
                          'image is worked on'),
    DeclareLaunchArgument('rviz', default_value='false', choices=['true', 'false'],
                          description='show it in RViz'),
]


def player(*options, condition):
    """Play the bag, once the node has had the time to find the player."""
    return ExecuteProcess(
        name='bag_player', output='screen', condition=condition,
        cmd=['ros2', 'bag', 'play', LaunchConfiguration('bag'), '--clock', '--delay', '3',
             '--rate', LaunchConfiguration('rate'), '--disable-keyboard-controls', *options])


def generate_launch_description():
    """Describe the player, and include vo.launch.py with simulated time."""
    vo = PathJoinSubstitution([SHARE, 'launch', 'vo.launch.py'])
    return LaunchDescription([
        *ARGUMENTS,
        IncludeLaunchDescription(PythonLaunchDescriptionSource(vo), launch_arguments={
            'use_sim_time': 'true', **{name: LaunchConfiguration(name) for name in PASSED_ON},
        }.items()),
        player(condition=UnlessCondition(LOOP)),
        player('--loop', condition=IfCondition(LOOP)),
    ])
