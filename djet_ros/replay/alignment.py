"""Alignment of trajectories with ground truth."""

from __future__ import annotations

from djet_ros.core.types import Array
import numpy as np


def aligned(estimate: Array, truth: Array, metric: bool = True) -> Array:
    """
    Align positions (N, 3) with the true ones (N, 3) by least squares (Umeyama, PAMI 1991).

    metric: whether the estimate has true lengths; otherwise its scale is estimated as well. Rows
    that are NaN in the truth are only transformed.
    """
    known = np.isfinite(truth).all(axis=1)
    centre, goal = estimate[known].mean(0), truth[known].mean(0)
    centred, centred_truth = estimate[known] - centre, truth[known] - goal
    U, D, Vt = np.linalg.svd(centred_truth.T @ centred)
    S = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    spread = float((centred**2).sum())
    scale = 1.0 if metric or not spread else float((D * S).sum()) / spread
    return np.asarray(scale * (estimate - centre) @ ((U * S) @ Vt).T + goal)


def position_rmse(estimate: Array, truth: Array) -> float:
    """Return the RMSE of positions (N, 3); rows that are NaN in the truth are ignored."""
    squared = ((estimate - truth)**2).sum(axis=1)
    return float(np.sqrt(np.nanmean(squared)))
