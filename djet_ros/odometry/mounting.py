"""
Pose and twist of a vehicle's base frame, from those of the camera on it.

T (4, 4) is the pose of the camera's optical frame in the base frame. Poses are perturbed as in
``uncertainty``: p + dp and exp(dtheta) R along the axes of the frame in which they are given.
"""

from __future__ import annotations

from djet_ros.core.geometry import skew
from djet_ros.core.types import Array
from djet_ros.odometry.uncertainty import block_rotation, symmetric
import numpy as np


def pose_of_base(pose: Array, covariance: Array, T: Array) -> tuple[Array, Array]:
    """Return the base's pose (4, 4) in the first base, with covariance (6, 6), by the camera's."""
    result = np.asarray(T @ pose @ np.linalg.inv(T))
    # The camera is a lever arm t away from the base's origin: p' = R_T p + t - R' t.
    J = _lever(T, skew(result[:3, :3] @ T[:3, 3]))
    return result, symmetric(J @ covariance @ J.T)


def twist_of_base(velocity: Array, covariance: Array, T: Array) -> tuple[Array, Array]:
    """Return the base's twist (6,) along its axes, with covariance (6, 6), by the camera's."""
    # The base's origin is at -R_T^T t in the camera, and rotates with it.
    J = _lever(T, skew(T[:3, 3]))
    return np.asarray(J @ velocity), symmetric(J @ covariance @ J.T)


def _lever(T: Array, arm: Array) -> Array:
    """Return the Jacobian (6, 6) of a rotation by T, then a lever arm, its skew matrix (3, 3)."""
    J = block_rotation(T[:3, :3])
    J[:3, 3:] = arm @ T[:3, :3]
    return J
