"""Covariance of the estimated pose."""

from __future__ import annotations

from djet_ros.core.geometry import sphere_tangents
from djet_ros.core.jet import Loss, Residuals
from djet_ros.core.types import Array
import numpy as np
from numpy.typing import NDArray

# Matches in one cell of this side (pixels) are taken to err together: ORB finds one corner in
# several octaves, and neighbours share what is wrong with a surface (an occlusion edge, leaves).
CELL = 32

# What correlation over longer distances leaves unexplained, as a factor on the variances. Measured
# once, as the normalised squared error on rendered streets; tests hold it on other scenes.
_INFLATION = 1.6

# The same where cells are summed without a jackknife: over the ground, and in the length of a
# loop. It is what the pose's was before patches were warped, and has not been measured anew.
CAUTIOUS_INFLATION = 4.0

# Of what is known in a direction of the pose, the matches of one cell may make up all but this.
_LEAST_SUPPORT = 1e-6


def pose_covariance(residuals: Residuals, loss: Loss, places: Array, t: Array,
                    flipped: bool) -> tuple[Array, Array]:
    """
    Covariance of (rotation vector in rad from the left, direction of t) at the minimum.

    places: (N, 2) pixels of the matches; t: (3,) the direction that was settled on, `flipped`
    where it is the opposite of the optimiser's. Gives (5, 5) in the basis ``sphere_tangents(t)``,
    and (6, 6) over (rotation vector, t), of rank 5 because t keeps its length. All NaN where the
    matches do not determine the pose, only those of one cell do, or they lie in too few cells.

    The noise is taken from the matches themselves: from how far the pose would move without those
    of a cell, cell by cell (delete-a-group jackknife, to first order; Bell and McCaffrey, Survey
    Methodology 2002). Where few cells decide about a direction, their moves say little; so the
    mean is taken of the moves that are seen and of those that noise would make, which are large
    there, at the size that has the seen ones on average.
    """
    J = residuals.jacobian
    squared = residuals.r**2
    _, weights = loss(squared)
    # A robust loss curves less than its weights say (Huber, Robust Statistics, section 7.6).
    flattening = loss.curvature(squared).mean() / weights.mean() if len(squared) else 0.0
    H = (J * weights) @ J.T
    unknown = np.full((5, 5), np.nan), np.full((6, 6), np.nan)
    if not np.isfinite(H).all() or flattening <= 0 or np.linalg.cond(H) > 1e12:
        return unknown
    H_cells, gradients = _summed_by_cell(
        places, J[:, None] * (J * weights), J * (weights * residuals.r))
    cells = len(gradients)
    if cells <= 5:  # so many are gone with the pose's own freedom
        return unknown
    whitening = np.linalg.inv(np.linalg.cholesky(H))
    if np.linalg.eigvalsh(whitening @ H_cells @ whitening.T).max() > 1 - _LEAST_SUPPORT:
        return unknown
    without = np.linalg.inv(H - H_cells)
    moves = (without @ gradients[:, :, None])[:, :, 0]
    seen = moves.T @ moves
    by_noise = (without - np.linalg.inv(H)).sum(0)
    by_noise *= np.trace(np.linalg.solve(by_noise, seen)) / 5
    covariance = _INFLATION * (1 - 1 / cells) / flattening**2 * (seen + by_noise) / 2
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


def _summed_by_cell(places: Array, *values: Array) -> list[Array]:
    """Sum values (..., N) over the C cells of the image that have matches; each (C, ...)."""
    cells: NDArray[np.int64] = (places // CELL).astype(np.int64)
    _, cell = np.unique(cells[:, 0] * 2**32 + cells[:, 1], return_inverse=True)
    order = np.argsort(cell, kind='stable')
    first = np.searchsorted(cell[order], np.arange(cell.max() + 1))
    return [np.moveaxis(np.add.reduceat(value[..., order], first, axis=-1), -1, 0)
            for value in values]
