"""What a live node makes of its parameters, before ROS or a command line declares them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from djet_ros.config.flat import FlatParameter, section, with_values
from djet_ros.config.sections import Config, OdometryConfig
from djet_ros.errors import DjetError

# What a subscription or the queue was made with holds for its life; and nobody who knows the odom
# frame could follow it to other names or axes. A mask is read once.
FIXED = ('ros.image_transport', 'ros.qos_reliability', 'ros.qos_depth', 'ros.queue_policy',
         'ros.queue_size', 'odometry.frame_convention', 'odometry.camera_frame',
         'odometry.odom_frame', 'odometry.base_frame', 'odometry.mask_file')

# Of the odometry's parameters, those that a pose graph goes by too, beside the estimator's.
SHARED = ('preset', 'odometry.scale_uncertainty', 'odometry.rectified',
          'odometry.residual_k1', 'odometry.gray_range', 'odometry.frame_convention',
          'odometry.camera_frame', 'odometry.base_frame', 'odometry.mask', 'odometry.mask_file',
          'ros.image_transport', 'ros.qos_reliability', 'ros.queue_policy')

# What the odometry goes by; what belongs to another node is no unknown name.
ODOMETRY = frozenset(item.name for part in ('', 'estimator', 'odometry', 'ros')
                     for item in section(Config(), part))


def why_frames(config: OdometryConfig) -> str:
    """Say what asks tf how something is mounted; nothing where nothing does."""
    if config.base_frame:
        return f'odometry.base_frame is {config.base_frame}'
    if config.imu and config.imu_quaternion() is None:
        return 'odometry.imu is true without an odometry.imu_rotation'
    if config.guess_by_topic:
        return 'odometry.guess is true' if config.guess else 'odometry.scale is guess'
    return ''


# Values that only a recording has, by parameter.
_OFFLINE = {'odometry.scale': 'ground_truth'}


def live_choices(item: FlatParameter) -> tuple[str, ...]:
    """Give the values to choose from on a live graph; none where there is nothing to choose."""
    return tuple(one for one in item.description.choices if one != _OFFLINE.get(item.name))


def with_live_values(config: Config, values: Mapping[str, Any]) -> Config:
    """Give the configuration with values changed as ``with_values`` does, for a live graph."""
    for item in section(config, 'odometry'):
        offered, value = live_choices(item), values.get(item.name)
        if offered and isinstance(value, str) and value not in offered:
            why = ', which only a recording has' if value == _OFFLINE.get(item.name) else ''
            raise DjetError(f"{item.name} is '{value}'{why}; choose from {', '.join(offered)}")
    return with_values(config, values)
