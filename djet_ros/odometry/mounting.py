"""
From the camera to the vehicle that carries it.

T (4, 4) is the camera's optical frame in the vehicle's base frame. Poses are perturbed as in
``uncertainty``: p + dp and exp(dtheta) R along the axes of the frame in which they are given.
"""

from __future__ import annotations

from djet_ros.core.geometry import skew
from djet_ros.core.types import Array
from djet_ros.odometry.uncertainty import block_rotation, symmetric
import numpy as np


def pose_of_base(pose: Array, covariance: Array, T: Array) -> tuple[Array, Array]:
    """Pose (4, 4) of the base in where it began, and covariance (6, 6), from the camera's."""
    result = np.asarray(T @ pose @ np.linalg.inv(T))
    # The base's origin swings about the camera: p' = R_T p + t - R' t.
    J = _lever(T, skew(result[:3, :3] @ T[:3, 3]))
    return result, symmetric(J @ covariance @ J.T)


def twist_of_base(velocity: Array, covariance: Array, T: Array) -> tuple[Array, Array]:
    """Velocity (6,) of the base along its axes, and covariance (6, 6), from the camera's."""
    # The base's origin is seen from the camera at -R_T^T t, and turns with it.
    J = _lever(T, skew(T[:3, 3]))
    return np.asarray(J @ velocity), symmetric(J @ covariance @ J.T)


def _lever(T: Array, arm: Array) -> Array:
    """Jacobian (6, 6) of a turn by T's rotation, with a lever arm (3, 3) after it."""
    J = block_rotation(T[:3, :3])
    J[:3, 3:] = arm @ T[:3, :3]
    return J
