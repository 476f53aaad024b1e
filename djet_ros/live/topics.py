"""The topics of the live faces: what they are called and what goes over them."""

from __future__ import annotations

from collections.abc import Callable

from djet_ros.config.sections import NodeConfig

IMAGE_TYPES = {'raw': 'sensor_msgs/msg/Image', 'compressed': 'sensor_msgs/msg/CompressedImage'}
INFO_TYPE = 'sensor_msgs/msg/CameraInfo'

# Of the odometry, with odometry.scale 'speed'.
SPEED_TYPES = {
    'speed': 'geometry_msgs/msg/TwistStamped',
    'speed_odometry': 'nav_msgs/msg/Odometry',
}

# Of the odometry, with the parameter odometry.<topic>.
BESIDE_TYPES = {
    'imu': 'sensor_msgs/msg/Imu',
    'guess': 'nav_msgs/msg/Odometry',
    'mask': IMAGE_TYPES['raw'],
}

# Those without a leading slash are below the node's name.
_ODOMETRY_OUTPUTS = {
    'relative_pose': 'geometry_msgs/msg/PoseStamped',
    'relative_pose_cov': 'geometry_msgs/msg/PoseWithCovarianceStamped',
    'relative_pose_status': 'diagnostic_msgs/msg/DiagnosticArray',
    'odometry': 'nav_msgs/msg/Odometry',
    'debug_image': 'sensor_msgs/msg/Image',
    'landmarks': 'sensor_msgs/msg/PointCloud2',
    '/diagnostics': 'diagnostic_msgs/msg/DiagnosticArray',
    'path': 'nav_msgs/msg/Path',
    '/tf': 'tf2_msgs/msg/TFMessage',
}

# What the pose graph takes of the odometry, by the name of the latter's output.
GRAPH_INPUTS = ('odometry', 'relative_pose_cov', 'relative_pose_status')

_GRAPH_OUTPUTS = ('path', '/tf', '/diagnostics')


def odometry_outputs(config: NodeConfig) -> dict[str, str]:
    """Give the types of what an odometry publishes, by topic."""
    left_out = {'path': not config.publish_path, '/tf': not config.publish_tf}
    return {topic: kind for topic, kind in _ODOMETRY_OUTPUTS.items() if not left_out.get(topic)}


def graph_outputs(*, tf: bool) -> dict[str, str]:
    """Give the types of what a pose graph publishes, by topic."""
    return {topic: _ODOMETRY_OUTPUTS[topic] for topic in _GRAPH_OUTPUTS if tf or topic != '/tf'}


def graph_input_type(topic: str) -> str:
    """Give the type of one of GRAPH_INPUTS."""
    return _ODOMETRY_OUTPUTS[topic]


def image_topics(resolve: Callable[[str], str], is_remapped: Callable[[str], bool],
                 transport: str) -> tuple[str, str]:
    """
    Resolve the names of the images and of their CameraInfo.

    resolve gives the full name with remappings, is_remapped tells whether there is one. As with
    image_transport, only the image's name needs to be remapped: camera_info is taken beside it,
    and the compressed images below it.
    """
    image = topic = resolve('image').removesuffix('/compressed')
    if transport == 'compressed':
        # Many remap this one, as ROS 2's republish asks for. It may be called anything.
        topic = resolve(f'{image}/compressed')
        image = topic.removesuffix('/compressed')
    if is_remapped('camera_info'):
        info = resolve('camera_info')
    else:
        info = f'{image.rpartition("/")[0]}/camera_info'
    return topic, info


def full_name(topic: str) -> str:
    """Give the name under which an output is asked for: below the node, or as it stands."""
    return topic if topic.startswith('/') else f'~/{topic}'
