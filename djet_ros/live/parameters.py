"""Which parameters a live node has, and how it restricts their values."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from djet_ros.config.flat import FlatParameter, section, with_values
from djet_ros.config.sections import Config, OdometryConfig
from djet_ros.errors import DjetError

# Read-only parameters: those of subscriptions and the queue, the frames and axes of published
# poses, on which other nodes rely, and the mask file, which is read once.
FIXED_PARAMETERS = (
    'ros.image_transport', 'ros.qos_reliability', 'ros.qos_depth', 'ros.queue_policy',
    'ros.queue_size', 'odometry.frame_convention', 'odometry.camera_frame',
    'odometry.odom_frame', 'odometry.base_frame', 'odometry.mask_file')

# Parameters of the odometry that the pose graph node also uses, besides estimator.*.
SHARED_PARAMETERS = (
    'preset', 'odometry.scale_uncertainty', 'odometry.rectified', 'odometry.residual_k1',
    'odometry.gray_range', 'odometry.frame_convention', 'odometry.camera_frame',
    'odometry.base_frame', 'odometry.mask', 'odometry.mask_file', 'ros.image_transport',
    'ros.qos_reliability', 'ros.queue_policy')

# Parameters of the odometry node.
ODOMETRY_PARAMETERS = frozenset(
    item.name for part in ('', 'estimator', 'odometry', 'ros') for item in section(Config(), part))


def tf_reason(config: OdometryConfig) -> str:
    """Return which setting needs a mounting from tf, or '' if none does."""
    if config.base_frame:
        return f'odometry.base_frame is {config.base_frame}'
    if config.imu and config.imu_quaternion() is None:
        return 'odometry.imu is true without an odometry.imu_rotation'
    if config.guess_by_topic:
        return 'odometry.guess is true' if config.guess else 'odometry.scale is guess'
    return ''


# Choices that are available only for recordings, by parameter.
_OFFLINE = {'odometry.scale': 'ground_truth'}


def live_choices(item: FlatParameter) -> tuple[str, ...]:
    """Return the choices of a parameter on a live graph; empty if it has none."""
    return tuple(one for one in item.description.choices if one != _OFFLINE.get(item.name))


def with_live_values(config: Config, values: Mapping[str, Any]) -> Config:
    """Return the configuration with values changed as by ``with_values``, for a live graph."""
    for item in section(config, 'odometry'):
        offered, value = live_choices(item), values.get(item.name)
        if offered and isinstance(value, str) and value not in offered:
            why = ', which is available offline only' if value == _OFFLINE.get(item.name) else ''
            raise DjetError(f"{item.name} is '{value}'{why}; choose from {', '.join(offered)}")
    return with_values(config, values)
