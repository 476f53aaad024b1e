"""Slants of surfaces against the image plane: planes through inverse depths around points."""

from __future__ import annotations

from djet_ros import compiled
from djet_ros.core.types import Array
import numpy as np
from scipy.spatial import cKDTree

# Neighbourhood in pixels within which a surface is taken to be flat, and the most points used.
_REACH, _NEIGHBOURS = 50.0, 16

# chosen: points that have to lie in the plane, within three standard deviations.
_MIN_POINTS = 6

# chosen: relative deviation of real surfaces from a plane; and the prior standard deviation of the
# change of inverse depth over the neighbourhood, relative to it.
_NONPLANARITY, _PRIOR_SLOPE = 0.01, 1.0

# Limit of the relative slope of inverse depth, per pixel: beyond it a surface is seen too
# obliquely. A road is at 0.016.
_MAX_SLOPE = 0.03

_ROUNDS = 4

# Square of three standard deviations.
_INLIER = 9.0

# Half the side in pixels of the squares of `slopes_of_all`, and rounds of its robust fit.
_HALF_SIDE, _SQUARE_ROUNDS = 32.0, 3

# 99 % quantile of chi-squared with two degrees of freedom: the least significance of a slant. A
# slant fitted to noise follows the pose that the depths come from, and warps the patches to agree
# with it, even if it is wrong.
_SIGNIFICANT = 9.2


def slopes(x: Array, rho: Array, sigma: Array, points: Array) -> Array:
    """
    Return the relative gradient (M, 2) of inverse depth at points (M, 2), per pixel.

    x: (N, 2) other pixels, rho: (N,) their inverse depths and sigma: (N,) standard deviations. The
    inverse depth of a plane is affine in pixels. It is fitted to the neighbours by least squares
    with a Cauchy loss, which down-weights those beyond a depth edge. Zero, as for a
    fronto-parallel surface, if too few points lie in one plane.
    """
    if len(x) < _MIN_POINTS or not len(points):
        return np.zeros((len(points), 2))
    distances, neighbours = cKDTree(x).query(
        points, k=min(_NEIGHBOURS, len(x)), distance_upper_bound=_REACH)
    is_near = np.isfinite(distances)
    neighbours = np.where(is_near, neighbours, 0)
    value = rho[neighbours]
    count = np.maximum(is_near.sum(1), 1)
    # The lower median of the neighbours.
    level = np.take_along_axis(np.sort(np.where(is_near, value, np.inf), axis=1),
                               (count - 1)[:, None] // 2, axis=1)[:, 0]
    level = np.where(is_near.any(1), level, 1.0)
    offsets = (x[neighbours] - points[:, None]) / _REACH
    J = np.concatenate([np.ones_like(value)[:, :, None], offsets], 2)
    trusted = is_near / (sigma[neighbours]**2 + (_NONPLANARITY * level[:, None])**2)
    prior = np.diag([1e-9, 1.0, 1.0]) / (_PRIOR_SLOPE * level)[:, None, None]**2
    weights = trusted
    for _ in range(_ROUNDS):
        back = (J * weights[:, :, None]).transpose(0, 2, 1)
        plane = np.linalg.solve(back @ J + prior, back @ value[:, :, None])
        squares = (value - (J @ plane)[:, :, 0])**2 * trusted
        weights = trusted / (1 + squares / 4)
    level_at_point, slope = plane[:, 0, 0], plane[:, 1:, 0]
    flat = ((is_near & (squares < _INLIER)).sum(1) >= _MIN_POINTS) & (level_at_point > 0)
    gradients = slope / (_REACH * np.where(flat, level_at_point, 1.0)[:, None])
    flat &= np.abs(gradients).max(1) < _MAX_SLOPE
    return np.where(flat[:, None], gradients, 0.0)


def slopes_of_all(x: Array, rho: Array, sigma: Array) -> Array:
    """
    Return the gradient (N, 2) of inverse depth, per pixel, at the measured pixels x (N, 2).

    rho, sigma: (N,) inverse depths and their standard deviations; if all rho are negative, so are
    the slopes. As `slopes`, but with one plane for all points near the centre of a square; squares
    overlap by half, and are summed from their quarters. For many points this takes a tenth of the
    time.
    """
    if len(x) < _MIN_POINTS:
        return np.zeros((len(x), 2))
    u, v = x.T / _HALF_SIDE - np.floor(x.min(0) / _HALF_SIDE)[:, None]
    trusted = 1 / np.maximum(sigma**2 + (_NONPLANARITY * rho)**2, 1e-18)
    planes, squared, counts = planes_at(u, v, rho, trusted)
    gradients, improvement = planes[:, 1:3] / _HALF_SIDE, planes[:, 3]
    flat = ((squared < _INLIER) & (counts >= _MIN_POINTS) & (improvement > _SIGNIFICANT)
            & (np.abs(gradients).max(1) < _MAX_SLOPE * np.abs(rho)))
    return np.where(flat[:, None], gradients, 0.0)


def planes_at(u: Array, v: Array, rho: Array, trusted: Array) -> tuple[Array, Array, Array]:
    """
    Fit planes to inverse depths rho (N,) at u, v >= 0 (N,), in half sides of squares.

    trusted: (N,) inverse variances of rho. Returns planes (N, 4): value at u = v = 0, slopes along
    u and v, and the decrease of the sum of squares by these; the normalised squared residuals (N,)
    of the points; and the number of points (N,) of each square that fit its plane.
    """
    usual = _PRIOR_SLOPE * _HALF_SIDE / _REACH
    if compiled.library is not None:
        return compiled.planes(u, v, rho, trusted, _SQUARE_ROUNDS, usual)
    squares = _Squares(u, v)
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v, rho, u * rho, v * rho])
    weights = trusted
    for _ in range(_SQUARE_ROUNDS):
        planes = _planes(squares.sums(weights * terms), usual)[:, squares.indices]
        offset, along_u, along_v, _ = planes
        squared = (rho - offset - along_u * u - along_v * v)**2 * trusted
        weights = trusted / (1 + squared / 4)
    fits = (squared < _INLIER)[None].astype(float)
    return planes.T, squared, squares.sums(fits)[0, squares.indices]


class _Squares:
    """
    Squares of side two that overlap by half, and the points (N,) at u, v >= 0 in them.

    indices: (N,) index of the square whose centre is nearest to each point, among the S in use.
    """

    def __init__(self, u: Array, v: Array) -> None:
        columns, rows = u.astype(np.int64), v.astype(np.int64)
        # One more on each side, so that squares at the edges have four quarters too.
        self._shape = int(rows.max()) + 3, int(columns.max()) + 3
        self._quarter = (rows + 1) * self._shape[1] + columns + 1
        middles = np.rint(v).astype(np.int64) * (self._shape[1] - 1) + np.rint(u).astype(np.int64)
        self._used, self.indices = np.unique(middles, return_inverse=True)

    def sums(self, values: Array) -> Array:
        """Sum values (V, N) over the points in each square; returns (V, S)."""
        size = self._shape[0] * self._shape[1]
        places = self._quarter + size * np.arange(len(values))[:, None]
        quarters = np.bincount(places.ravel(), values.ravel(), size * len(values)).reshape(
            -1, *self._shape)
        pairs = quarters[:, 1:] + quarters[:, :-1]
        return np.asarray((pairs[:, :, 1:] + pairs[:, :, :-1]).reshape(
            len(values), -1)[:, self._used])


def _planes(sums: Array, usual: float) -> Array:
    """
    Fit planes to points, by sums (9, S) of their weights, and of u, v, uu, uv, vv, r, ur, vr.

    r: the values; usual: prior standard deviation of the slopes, relative to the mean value.
    Returns (4, S): value at u = v = 0, slopes along u and v, and the decrease of the sum of
    squares by these.
    """
    n, u, v, uu, uv, vv, r, ur, vr = sums
    level = r / n
    # Without depth there is no slant.
    prior = 1 / np.maximum((usual * level)**2, 1e-18)
    # The mean is eliminated first.
    uu, uv, vv = uu - u * u / n + prior, uv - u * v / n, vv - v * v / n + prior
    ur, vr = ur - u * level, vr - v * level
    scale = 1 / (uu * vv - uv**2)
    along_u, along_v = (vv * ur - uv * vr) * scale, (uu * vr - uv * ur) * scale
    return np.stack([level - (along_u * u + along_v * v) / n, along_u, along_v,
                     along_u * ur + along_v * vr])
