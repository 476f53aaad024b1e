"""Checks of the covariances in messages, for any images."""

from __future__ import annotations

from djet_ros.config.sections import OdometryConfig
from djet_ros.core.types import TRACKED
from djet_ros.odometry.messages import Messages
from djet_ros.odometry.result import OdometryResult
import numpy as np
from ros_messages import message_type

# Above the variances of an unknown motion.
ABSURD = 1e12


def check_messages(result: OdometryResult) -> None:
    """Check all covariances published for a frame: none is zero or infinite."""
    make = Messages(message_type, OdometryConfig())
    odometry = make.odometry(result)
    estimates = {'pose': odometry.pose, 'twist': odometry.twist}
    if result.status in TRACKED:
        estimates['relative pose'] = make.relative_pose_cov(result).pose
    for name, one in estimates.items():
        covariance = np.reshape(one.covariance, (6, 6))
        where = f'{name} of a frame that is {result.status.value}'
        assert np.isfinite(covariance).all(), where
        assert (np.diag(covariance) > 0).all(), where
        assert (np.diag(covariance) < ABSURD).all(), where
        # As correlations, so that radians do not drown in metres.
        deviations = np.sqrt(np.diag(covariance))
        correlation = covariance / np.outer(deviations, deviations)
        assert np.allclose(correlation, correlation.T, rtol=0, atol=1e-9), where
        assert np.linalg.eigvalsh(correlation)[0] > -1e-9, where
