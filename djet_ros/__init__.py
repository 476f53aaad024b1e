"""D-JET: visual odometry by differential pose optimisation in descriptor space."""

from importlib import import_module
from typing import Any

__version__ = '0.3.0'

# What the motion between images takes, and where it is; commands that need none of it are quick,
# as it is imported where it is asked for.
_LIBRARY = {'Frame': 'djet_ros.odometry.frame',
            'OdometryConfig': 'djet_ros.config.sections',
            'preset': 'djet_ros.core.estimator_config',
            'Status': 'djet_ros.core.types',
            'TwoViewEstimator': 'djet_ros.core.estimator',
            'VisualOdometry': 'djet_ros.odometry.visual_odometry'}


def __getattr__(name: str) -> Any:
    """Import what is asked for by its name alone."""
    if name not in _LIBRARY:
        raise AttributeError(f"module 'djet_ros' has no attribute '{name}'")
    return getattr(import_module(_LIBRARY[name]), name)
