"""The topics of the live nodes: their names and types."""

from __future__ import annotations

from collections.abc import Callable

from djet_ros.config.sections import NodeConfig

IMAGE_TYPES = {'raw': 'sensor_msgs/msg/Image', 'compressed': 'sensor_msgs/msg/CompressedImage'}
INFO_TYPE = 'sensor_msgs/msg/CameraInfo'

# Inputs of the odometry with odometry.scale 'speed'.
SPEED_TYPES = {
    'speed': 'geometry_msgs/msg/TwistStamped',
    'speed_odometry': 'nav_msgs/msg/Odometry',
}

# Inputs of the odometry with the parameter odometry.<topic>.
AUXILIARY_TYPES = {
    'imu': 'sensor_msgs/msg/Imu',
    'guess': 'nav_msgs/msg/Odometry',
    'mask': IMAGE_TYPES['raw'],
}

# Names without a leading slash are private (~/).
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

# Outputs of the odometry that the pose graph subscribes to.
GRAPH_INPUTS = {topic: _ODOMETRY_OUTPUTS[topic]
                for topic in ('odometry', 'relative_pose_cov', 'relative_pose_status')}


def odometry_outputs(config: NodeConfig) -> dict[str, str]:
    """Return the output topics of the odometry with their types."""
    left_out = {'path': not config.publish_path, '/tf': not config.publish_tf}
    return {topic: kind for topic, kind in _ODOMETRY_OUTPUTS.items() if not left_out.get(topic)}


def graph_outputs(*, tf: bool) -> dict[str, str]:
    """Return the output topics of the pose graph with their types."""
    return {topic: _ODOMETRY_OUTPUTS[topic]
            for topic in ('path', *['/tf'] * tf, '/diagnostics')}


def image_topics(resolve: Callable[[str], str], is_remapped: Callable[[str], bool],
                 transport: str) -> tuple[str, str]:
    """
    Return the resolved topics of the images and of their CameraInfo.

    resolve applies remappings, is_remapped returns whether there is one. As with image_transport,
    only image needs to be remapped: camera_info is in the same namespace, and compressed images
    are on <image>/compressed.
    """
    image = topic = resolve('image').removesuffix('/compressed')
    if transport == 'compressed':
        # This one may be remapped instead, as ROS 2's republish requires, to any name.
        topic = resolve(f'{image}/compressed')
        image = topic.removesuffix('/compressed')
    if is_remapped('camera_info'):
        info = resolve('camera_info')
    else:
        info = f'{image.rpartition("/")[0]}/camera_info'
    return topic, info


def full_name(topic: str) -> str:
    """Return the name of an output for ``resolve``: private, unless it is absolute."""
    return topic if topic.startswith('/') else f'~/{topic}'
