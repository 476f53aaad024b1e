"""Start odometry and loop closure: ros2 launch djet_ros slam.launch.py image:=/camera/image ."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, PythonExpression
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterFile, ParameterValue
from launch_ros.substitutions import FindPackageShare

CONFIG = PathJoinSubstitution([FindPackageShare('djet_ros'), 'config'])
IMAGE = LaunchConfiguration('image')
CAMERA = [('image', IMAGE), ('camera_info', LaunchConfiguration('camera_info'))]
SIM_TIME = {'use_sim_time': ParameterValue(LaunchConfiguration('use_sim_time'), value_type=bool)}
PARAMETERS = ParameterFile(LaunchConfiguration('params_file'))

ARGUMENTS = [
    DeclareLaunchArgument('image', default_value='/camera/image_raw',
                          description='topic of the images'),
    DeclareLaunchArgument(
        'camera_info',
        default_value=PythonExpression(['"', IMAGE, '".rpartition("/")[0] + "/camera_info"']),
        description='topic of their CameraInfo; as it stands, beside the images'),
    DeclareLaunchArgument('params_file', default_value=PathJoinSubstitution([CONFIG, 'vo.yaml']),
                          description='YAML file with parameters of vo_node; pose_graph_node '
                          'takes from it what both have to agree on'),
    DeclareLaunchArgument('slam_params_file',
                          default_value=PathJoinSubstitution([CONFIG, 'slam.yaml']),
                          description='YAML file with parameters of pose_graph_node'),
    DeclareLaunchArgument('use_sim_time', default_value='false', choices=['true', 'false'],
                          description='take the time from /clock'),
]


def generate_launch_description():
    """Describe both nodes; together they publish map -> odom -> camera."""
    return LaunchDescription([
        *ARGUMENTS,
        Node(package='djet_ros', executable='vo_node', name='vo_node', output='screen',
             remappings=CAMERA, parameters=[PARAMETERS, {'ros.publish_tf': True}, SIM_TIME]),
        Node(package='djet_ros', executable='pose_graph_node', name='pose_graph_node',
             output='screen', remappings=CAMERA,
             parameters=[PARAMETERS, ParameterFile(LaunchConfiguration('slam_params_file')),
                         SIM_TIME]),
    ])
