"""How surfaces lean against the image: planes through the inverse depths around points."""

from __future__ import annotations

from djet_ros.core.cells import cells_of
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

# Pixels; chosen: side of the cells in which one plane serves all points that lie in it, and
# standard deviations from it up to which they do.
_SIDE, _IN_PLANE = 48.0, 3.0


def slopes_of_all(x: Array, rho: Array, sigma: Array) -> Array:
    """
    Give `slopes` (N, 2) at the points themselves: of one plane in each cell of the image.

    x: (N, 2) pixels, rho: (N,) inverse depths and sigma: (N,) their standard deviations. Zero for
    points that do not lie in the plane of their cell.
    """
    _, cell, count = np.unique(cells_of(x, _SIDE), return_inverse=True, return_counts=True)
    middles = np.stack([np.bincount(cell, along) for along in x.T], axis=1) / count[:, None]
    level, lean = _planes(x, rho, sigma, middles)
    expected = level[cell] + (lean[cell] * (x - middles[cell])).sum(1)
    near = np.abs(rho - expected) < _IN_PLANE * np.hypot(sigma, _BENT * expected)
    return np.where((near & (rho > 0))[:, None], lean[cell] / np.maximum(rho, 1e-12)[:, None], 0.0)


def slopes(x: Array, rho: Array, sigma: Array, points: Array) -> Array:
    """
    Slopes (M, 2) of inverse depth at points (M, 2), a pixel, as shares of the inverse depth there.

    x: (N, 2) other pixels, rho: (N,) inverse depths and sigma: (N,) their standard deviations.
    Zero, as of a surface that faces the camera, where too few lie in one plane.
    """
    level, lean = _planes(x, rho, sigma, points)
    return np.where(level[:, None] > 0, lean / np.maximum(level, 1e-12)[:, None], 0.0)


def _planes(x: Array, rho: Array, sigma: Array, points: Array) -> tuple[Array, Array]:
    """
    Fit planes around points (M, 2): inverse depths (M,) there, and their slopes (M, 2) a pixel.

    The inverse depth of a plane is affine in pixels. It is fitted to the neighbours by least
    squares under a Cauchy loss, so that those beyond an edge count little. Not a number where too
    few lie in one plane.
    """
    if len(x) < _FEW or not len(points):
        return np.full(len(points), np.nan), np.full((len(points), 2), np.nan)
    away, near = cKDTree(x).query(
        points, k=min(_NEIGHBOURS, len(x)), distance_upper_bound=_REACH)
    # Points last: what is summed up over neighbours runs over contiguous memory.
    there = np.isfinite(away).T
    near = np.where(there, near.T, 0)
    value = rho[near]
    count = np.maximum(there.sum(0), 1)
    # The lower median of those that are there.
    level = np.take_along_axis(np.sort(np.where(there, value, np.inf), axis=0),
                               (count - 1)[None] // 2, axis=0)[0]
    level = np.where(there.any(0), level, 1.0)
    J = np.stack([np.ones_like(value), *((x.T[:, near] - points.T[:, None]) / _REACH)])
    JJ, Jv = J[:, None] * J, J * value
    trusted = there / (sigma[near]**2 + (_BENT * level)**2)
    prior = np.diag([1e-9, 1.0, 1.0]) / (_USUAL * level)[:, None, None]**2
    weights = trusted
    for _ in range(_ROUNDS):
        H = (JJ * weights).sum(2).transpose(2, 0, 1) + prior
        plane = np.linalg.solve(H, (Jv * weights).sum(1).T[:, :, None])[:, :, 0]
        squares = (value - (plane.T[:, None] * J).sum(0))**2 * trusted
        weights = trusted / (1 + squares / 4)
    here, lean = plane[:, 0], plane[:, 1:] / _REACH
    flat = ((there & (squares < 9)).sum(0) >= _FEW) & (here > 0)
    flat &= np.abs(lean).max(1) < _STEEPEST * here
    return np.where(flat, here, np.nan), np.where(flat[:, None], lean, np.nan)
