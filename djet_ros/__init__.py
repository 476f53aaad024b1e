"""
D-JET: visual odometry by differential pose optimisation in descriptor space.

``VisualOdometry`` gives an ``OdometryResult`` for each ``Frame`` of a moving camera, and
``TwoViewEstimator`` a ``RelativePose`` for two images; a ``Status`` says how each went. Parameters
are in an ``EstimatorConfig``, as ``preset`` makes it, and in an ``OdometryConfig``.

    >>> odometry = VisualOdometry(preset('fast'))
    >>> for stamp_ns, gray in images:                      # gray: (H, W) uint8, undistorted
    ...     result = odometry.process(Frame(gray, K, stamp_ns))
    ...     print(result.status, result.pose)              # (4, 4): camera in the first camera

    >>> estimator = TwoViewEstimator()
    >>> one, other = estimator.view(gray, K), estimator.view(next_gray, K)
    >>> estimator.estimate(one, other)                     # x_other = R x_one + t, |t| = 1
    RelativePose(OK, rotation 0.1214 deg, t [0.005, 0.0096, -0.9999], 1407 of 1749 matches agree)
"""

from importlib import import_module
from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from djet_ros.config.sections import OdometryConfig
    from djet_ros.core.estimator import TwoViewEstimator
    from djet_ros.core.estimator_config import EstimatorConfig, preset
    from djet_ros.core.types import RelativePose, Status
    from djet_ros.odometry.frame import Frame
    from djet_ros.odometry.result import OdometryResult
    from djet_ros.odometry.visual_odometry import VisualOdometry

__version__ = '0.3.0'
__all__ = ['EstimatorConfig', 'Frame', 'OdometryConfig', 'OdometryResult', 'RelativePose',
           'Status', 'TwoViewEstimator', 'VisualOdometry', 'preset']

# Where the names above are. They are imported when they are asked for, so that commands that need
# none of them are quick.
_MODULES = {'EstimatorConfig': 'djet_ros.core.estimator_config',
            'Frame': 'djet_ros.odometry.frame',
            'OdometryConfig': 'djet_ros.config.sections',
            'OdometryResult': 'djet_ros.odometry.result',
            'preset': 'djet_ros.core.estimator_config',
            'RelativePose': 'djet_ros.core.types',
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
