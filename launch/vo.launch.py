"""Start the odometry on a camera: ros2 launch djet_ros vo.launch.py image:=/camera/image_raw ."""

from djet_ros.ros.launching import arguments, CONFIG, node, sim_time
from launch import LaunchDescription
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node


def generate_launch_description():
    """Describe the node and, if asked for, RViz."""
    return LaunchDescription([
        *arguments('image', 'camera_info', 'params_file', 'base_frame', 'namespace', 'name',
                   'log_level', 'respawn', 'use_sim_time', 'rviz'),
        node('vo_node', LaunchConfiguration('name'), 'params_file'),
        Node(package='rviz2', executable='rviz2', name='rviz_of_vo', parameters=[sim_time()],
             arguments=['-d', PathJoinSubstitution([CONFIG, 'vo.rviz'])],
             condition=IfCondition(LaunchConfiguration('rviz'))),
    ])
