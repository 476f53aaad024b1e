"""Trajectories laid onto their ground truth."""

from __future__ import annotations

from djet_ros.core.types import Array
import numpy as np


def aligned(estimate: Array, truth: Array, scaled: bool = True) -> Array:
    """
    Move positions (N, 3) onto the true ones (N, 3), as a whole and with the least squares.

    Not scaled: their common scale is free as well (Umeyama, PAMI 1991). Rows that are NaN in the
    truth are moved with the others.
    """
    known = np.isfinite(truth).all(axis=1)
    centre, goal = estimate[known].mean(0), truth[known].mean(0)
    here, there = estimate[known] - centre, truth[known] - goal
    U, D, Vt = np.linalg.svd(there.T @ here)
    S = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    spread = float((here**2).sum())
    scale = 1.0 if scaled or not spread else float((D * S).sum()) / spread
    return np.asarray(scale * (estimate - centre) @ ((U * S) @ Vt).T + goal)


def position_rmse(estimate: Array, truth: Array) -> float:
    """Root mean square distance of positions (N, 3); rows of NaN in the truth are left out."""
    squared = ((estimate - truth)**2).sum(axis=1)
    return float(np.sqrt(np.nanmean(squared)))
