"""How surfaces lean against the image: planes through the inverse depths around points."""

from __future__ import annotations

from djet_ros.core.types import Array
import numpy as np
from scipy.spatial import cKDTree

# Pixels up to which a surface is taken to be flat, and how many points there may tell it.
_REACH, _NEIGHBOURS = 50.0, 16

# chosen: so many points have to lie in the plane, to three standard deviations.
_FEW = 6

# chosen: by which share real surfaces are off a plane, and what a slope of inverse depth is that
# is nothing out of the ordinary, as a share of the depth over the whole reach.
_BENT, _USUAL = 0.01, 1.0

# Shares a pixel beyond which a surface is seen too much from the side; a road is at 0.016.
_STEEPEST = 0.03

_ROUNDS = 4


def slopes(x: Array, rho: Array, sigma: Array, points: Array) -> Array:
    """
    Slopes (M, 2) of inverse depth at points (M, 2), a pixel, as shares of the inverse depth there.

    x: (N, 2) other pixels, rho: (N,) inverse depths and sigma: (N,) their standard deviations. The
    inverse depth of a plane is affine in pixels. It is fitted to the neighbours by least squares
    under a Cauchy loss, so that those beyond an edge count little. Zero, as of a surface that
    faces the camera, where too few lie in one plane.
    """
    if len(x) < _FEW or not len(points):
        return np.zeros((len(points), 2))
    away, near = cKDTree(x).query(
        points, k=min(_NEIGHBOURS, len(x)), distance_upper_bound=_REACH)
    there = np.isfinite(away)
    near = np.where(there, near, 0)
    value = rho[near]
    count = np.maximum(there.sum(1), 1)
    # The lower median of those that are there.
    level = np.take_along_axis(np.sort(np.where(there, value, np.inf), axis=1),
                               (count - 1)[:, None] // 2, axis=1)[:, 0]
    level = np.where(there.any(1), level, 1.0)
    J = np.concatenate([np.ones_like(value)[:, :, None], (x[near] - points[:, None]) / _REACH], 2)
    trusted = there / (sigma[near]**2 + (_BENT * level[:, None])**2)
    prior = np.diag([1e-9, 1.0, 1.0]) / (_USUAL * level)[:, None, None]**2
    weights = trusted
    for _ in range(_ROUNDS):
        back = (J * weights[:, :, None]).transpose(0, 2, 1)
        plane = np.linalg.solve(back @ J + prior, back @ value[:, :, None])
        squares = (value - (J @ plane)[:, :, 0])**2 * trusted
        weights = trusted / (1 + squares / 4)
    here, lean = plane[:, 0, 0], plane[:, 1:, 0]
    flat = ((there & (squares < 9)).sum(1) >= _FEW) & (here > 0)
    found = lean / (_REACH * np.where(flat, here, 1.0)[:, None])
    flat &= np.abs(found).max(1) < _STEEPEST
    return np.where(flat[:, None], found, 0.0)
