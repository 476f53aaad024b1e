"""D-JET: visual odometry by differential pose optimisation in descriptor space."""

from importlib import import_module
from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from djet_ros.config.sections import OdometryConfig
    from djet_ros.core.estimator import TwoViewEstimator
    from djet_ros.core.estimator_config import preset
    from djet_ros.core.types import Status
    from djet_ros.odometry.frame import Frame
    from djet_ros.odometry.visual_odometry import VisualOdometry

__version__ = '0.3.0'
__all__ = ['Frame', 'OdometryConfig', 'Status', 'TwoViewEstimator', 'VisualOdometry', 'preset']

# Where the names above are. They are imported when they are asked for, so that commands that need
# none of them are quick.
_MODULES = {'Frame': 'djet_ros.odometry.frame',
            'OdometryConfig': 'djet_ros.config.sections',
            'preset': 'djet_ros.core.estimator_config',
            'Status': 'djet_ros.core.types',
            'TwoViewEstimator': 'djet_ros.core.estimator',
            'VisualOdometry': 'djet_ros.odometry.visual_odometry'}


def __getattr__(name: str) -> Any:
    """Import what is asked for by its name alone."""
    if name not in _MODULES:
        raise AttributeError(f"module 'djet_ros' has no attribute '{name}'")
    return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    """Return the names that can be asked for."""
    return sorted({*globals(), *__all__})
