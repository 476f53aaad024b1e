"""Covariance of the estimated pose."""

from __future__ import annotations

from djet_ros.core.jet import Loss, Residuals
from djet_ros.core.types import Array
import numpy as np


def pose_covariance(residuals: Residuals, loss: Loss) -> tuple[Array, Array]:
    """
    Covariance of (rotation vector in rad from the left, direction of t) at the minimum.

    Gives (5, 5) in the tangent basis of t, and (6, 6) over (rotation vector, t), which has rank 5
    because t keeps its length. The sandwich H^-1 (sum w^2 r^2 j j^T) H^-1 with H = J^T W J takes
    the noise from the residuals themselves, match by match, so that it needs no noise model.
    All NaN where the matches do not determine the pose.
    """
    J = residuals.jacobian
    _, weights = loss(residuals.r**2)
    H = (J * weights) @ J.T
    scores = J * (weights * residuals.r)
    if not np.isfinite(H).all() or np.linalg.cond(H) > 1e14:
        return np.full((5, 5), np.nan), np.full((6, 6), np.nan)
    H_inverse = np.linalg.inv(H)
    matches = residuals.r.size
    covariance = H_inverse @ (scores @ scores.T) @ H_inverse * (matches / max(matches - 5, 1))
    covariance = (covariance + covariance.T) / 2
    lift = np.zeros((6, 5))
    lift[:3, :3], lift[3:, 3:] = np.eye(3), residuals.tangents
    return covariance, lift @ covariance @ lift.T
