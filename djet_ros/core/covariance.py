"""Covariance of the estimated pose."""

from __future__ import annotations

from djet_ros.core.geometry import sphere_tangents
from djet_ros.core.jet import Loss, Residuals
from djet_ros.core.types import Array
import numpy as np
from numpy.typing import NDArray

# Matches in one cell of this side (pixels) are taken to err together: ORB finds one corner in
# several octaves, and neighbours share what is wrong with a surface (an occlusion edge, leaves).
_CELL = 32

# What correlation over longer distances leaves unexplained, as a factor on the variances. Measured
# once, as the normalised squared error on rendered streets; tests hold it on other scenes.
_INFLATION = 2.2


def pose_covariance(residuals: Residuals, loss: Loss, places: Array, t: Array,
                    flipped: bool) -> tuple[Array, Array]:
    """
    Covariance of (rotation vector in rad from the left, direction of t) at the minimum.

    places: (N, 2) pixels of the matches; t: (3,) the direction that was settled on, `flipped`
    where it is the opposite of the optimiser's. Gives (5, 5) in the basis ``sphere_tangents(t)``,
    and (6, 6) over (rotation vector, t), of rank 5 because t keeps its length. The sandwich
    H^-1 (sum over cells of s s^T) H^-1, with s the summed gradients of a cell's matches, takes
    the noise from the residuals themselves (cluster-robust, Liang and Zeger, Biometrika 1986).
    All NaN where the matches do not determine the pose, or lie in too few cells.
    """
    J = residuals.jacobian
    squared = residuals.r**2
    _, weights = loss(squared)
    # A robust loss curves less than its weights say (Huber, Robust Statistics, section 7.6).
    flattening = loss.curvature(squared).mean() / weights.mean() if len(squared) else 0.0
    H = flattening * (J * weights) @ J.T
    unknown = np.full((5, 5), np.nan), np.full((6, 6), np.nan)
    if not np.isfinite(H).all() or flattening <= 0 or np.linalg.cond(H) > 1e14:
        return unknown
    scores, cells = _summed_by_cell(J * (weights * residuals.r), places)
    if cells <= 5:  # the gradients sum to zero, so these leave some direction without any noise
        return unknown
    H_inverse = np.linalg.inv(H)
    covariance = H_inverse @ (scores @ scores.T) @ H_inverse
    covariance *= _INFLATION * cells / (cells - 5)
    covariance = (covariance + covariance.T) / 2
    # t and -t share their essential matrix: where one moves forwards, the other moves back.
    turned = _blocks(-residuals.tangents if flipped else residuals.tangents)
    covariance_6 = turned @ covariance @ turned.T
    basis = _blocks(sphere_tangents(t))
    return basis.T @ covariance_6 @ basis, covariance_6


def _blocks(tangents: Array) -> Array:
    """Lift (6, 5) of steps (rotation, two tangents) to (rotation, direction)."""
    lift = np.zeros((6, 5))
    lift[:3, :3], lift[3:, 3:] = np.eye(3), tangents
    return lift


def _summed_by_cell(scores: Array, places: Array) -> tuple[Array, int]:
    """Sum scores (5, N) over the cells of the image; gives (5, C) and C."""
    cells: NDArray[np.int64] = (places // _CELL).astype(np.int64)
    _, cell = np.unique(cells[:, 0] * 2**32 + cells[:, 1], return_inverse=True)
    count = int(cell.max()) + 1
    return np.stack([np.bincount(cell, row, count) for row in scores]), count
