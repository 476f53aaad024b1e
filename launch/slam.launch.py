"""Start odometry and loop closure: ros2 launch djet_ros slam.launch.py image:=/camera/image ."""

from djet_ros.ros.launching import arguments, node
from launch import LaunchDescription


def generate_launch_description():
    """Describe both nodes; together they publish map -> odom -> camera or base_frame."""
    return LaunchDescription([
        *arguments('image', 'camera_info', 'params_file', 'slam_params_file', 'base_frame',
                   'namespace', 'log_level', 'respawn', 'publish_tf', 'image_transport',
                   'use_sim_time', publish_tf='true'),
        node('vo_node', 'vo_node', 'params_file',
             overrides=('base_frame', 'publish_tf', 'image_transport')),
        node('pose_graph_node', 'pose_graph_node', 'params_file', 'slam_params_file'),
    ])
