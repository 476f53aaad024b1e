"""Start the odometry on a camera: ros2 launch djet_ros vo.launch.py image:=/camera/image_raw ."""

from djet_ros.ros.launching import arguments, node, rviz
from launch import LaunchDescription
from launch.substitutions import LaunchConfiguration


def generate_launch_description():
    """Describe the node and, with rviz:=true, RViz."""
    return LaunchDescription([
        *arguments('image', 'camera_info', 'params_file', 'base_frame', 'namespace', 'name',
                   'log_level', 'respawn', 'publish_tf', 'image_transport', 'use_sim_time',
                   'rviz'),
        # Before the node, which must not start if RViz is requested and not installed.
        rviz(),
        node('vo_node', LaunchConfiguration('name'), 'params_file',
             overrides=('base_frame', 'publish_tf', 'image_transport')),
    ])
