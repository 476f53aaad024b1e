"""What a live node makes of its parameters, before ROS or a command line declares them."""

from __future__ import annotations

from djet_ros.config.flat import section
from djet_ros.config.sections import Config
from djet_ros.errors import DjetError

# What a subscription or the queue was made with holds for its life; and nobody who knows the odom
# frame could follow it to other axes.
FIXED = ('ros.image_transport', 'ros.qos_reliability', 'ros.qos_depth', 'ros.queue_policy',
         'ros.queue_size', 'odometry.frame_convention', 'odometry.base_frame')

# Of the odometry's parameters, those that a pose graph goes by too, beside the estimator's.
SHARED = ('preset', 'odometry.scale_uncertainty', 'odometry.rectified',
          'odometry.frame_convention', 'ros.image_transport', 'ros.qos_reliability',
          'ros.queue_policy')

# What the odometry goes by; what belongs to another node is no unknown name.
ODOMETRY = frozenset(item.name for part in ('', 'estimator', 'odometry', 'ros')
                     for item in section(Config(), part))


def for_a_live_graph(config: Config) -> Config:
    """Refuse what can't be had on a live graph."""
    if config.odometry.scale == 'ground_truth':
        raise DjetError("odometry.scale is 'ground_truth', which only a recording has; choose "
                        'none, constant, speed or camera_height')
    return config
