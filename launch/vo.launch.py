"""Start the odometry on a camera: ros2 launch djet_ros vo.launch.py image:=/camera/image_raw ."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, PythonExpression
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterFile, ParameterValue
from launch_ros.substitutions import FindPackageShare

CONFIG = PathJoinSubstitution([FindPackageShare('djet_ros'), 'config'])
IMAGE = LaunchConfiguration('image')
SIM_TIME = {'use_sim_time': ParameterValue(LaunchConfiguration('use_sim_time'), value_type=bool)}

ARGUMENTS = [
    DeclareLaunchArgument('image', default_value='/camera/image_raw',
                          description='topic of the images'),
    DeclareLaunchArgument(
        'camera_info',
        default_value=PythonExpression(['"', IMAGE, '".rpartition("/")[0] + "/camera_info"']),
        description='topic of their CameraInfo; as it stands, beside the images'),
    DeclareLaunchArgument('params_file', default_value=PathJoinSubstitution([CONFIG, 'vo.yaml']),
                          description='YAML file with parameters of vo_node'),
    DeclareLaunchArgument('use_sim_time', default_value='false', choices=['true', 'false'],
                          description='take the time from /clock'),
    DeclareLaunchArgument('rviz', default_value='false', choices=['true', 'false'],
                          description='show it in RViz'),
]


def generate_launch_description():
    """Describe the node and, if asked for, RViz."""
    return LaunchDescription([
        *ARGUMENTS,
        Node(package='djet_ros', executable='vo_node', name='vo_node', output='screen',
             remappings=[('image', IMAGE), ('camera_info', LaunchConfiguration('camera_info'))],
             parameters=[ParameterFile(LaunchConfiguration('params_file')), SIM_TIME]),
        Node(package='rviz2', executable='rviz2', name='rviz_of_vo', parameters=[SIM_TIME],
             arguments=['-d', PathJoinSubstitution([CONFIG, 'vo.rviz'])],
             condition=IfCondition(LaunchConfiguration('rviz'))),
    ])
