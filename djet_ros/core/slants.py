"""How surfaces lean against the image: planes through the inverse depths around points."""

from __future__ import annotations

from djet_ros import compiled
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

# Square of the usual three standard deviations.
_FITS = 9.0

# Half the side in pixels of the squares in which all points are told at once, and rounds of that.
_HALF, _ROUNDS_OF_ALL = 32.0, 3

# Chi-squared of two degrees of freedom that chance exceeds once in a hundred. What leans by noise
# alone leans as the pose would have it, be that wrong, and makes patches agree with it.
_BY_CHANCE = 9.2


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
    flat = ((there & (squares < _FITS)).sum(1) >= _FEW) & (here > 0)
    found = lean / (_REACH * np.where(flat, here, 1.0)[:, None])
    flat &= np.abs(found).max(1) < _STEEPEST
    return np.where(flat[:, None], found, 0.0)


def slopes_of_all(x: Array, rho: Array, sigma: Array) -> Array:
    """
    Slopes (N, 2) of inverse depth at points themselves, pixels x (N, 2), a pixel.

    rho, sigma: (N,) inverse depths and their standard deviations; where all are negative, so are
    slopes. As `slopes`, but with one plane for all points that are next to the middle of a square:
    squares overlap by half, and are summed up from their quarters. Many points cost a tenth so.
    """
    if len(x) < _FEW:
        return np.zeros((len(x), 2))
    u, v = x.T / _HALF - np.floor(x.min(0) / _HALF)[:, None]
    trusted = 1 / np.maximum(sigma**2 + (_BENT * rho)**2, 1e-18)
    planes, off, fitting = planes_at(u, v, rho, trusted)
    found, told = planes[:, 1:3] / _HALF, planes[:, 3]
    flat = ((off < _FITS) & (fitting >= _FEW) & (told > _BY_CHANCE)
            & (np.abs(found).max(1) < _STEEPEST * np.abs(rho)))
    return np.where(flat[:, None], found, 0.0)


def planes_at(u: Array, v: Array, rho: Array, trusted: Array) -> tuple[Array, Array, Array]:
    """
    Fit planes to inverse depths rho (N,) around points at u, v >= 0 (N,), in halves of squares.

    trusted: (N,) over the variances of rho. Gives planes (N, 4): their values at u = v = 0, their
    slopes along both, and by how much these lessen the sum of squares; the squares (N,) by which
    points are off theirs, in variances; and how many points (N,) of a square fit its plane.
    """
    usual = _USUAL * _HALF / _REACH
    if compiled.library is not None:
        return compiled.planes(u, v, rho, trusted, _ROUNDS_OF_ALL, usual)
    squares = _Squares(u, v)
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v, rho, u * rho, v * rho])
    weights = trusted
    for _ in range(_ROUNDS_OF_ALL):
        planes = _planes(squares.sums(weights * terms), usual)[:, squares.which]
        here, along_u, along_v, _ = planes
        off = (rho - here - along_u * u - along_v * v)**2 * trusted
        weights = trusted / (1 + off / 4)
    fits = (off < _FITS)[None].astype(float)
    return planes.T, off, squares.sums(fits)[0, squares.which]


class _Squares:
    """
    Squares with a side of two that overlap by half, and the points (N,) at u, v >= 0 in them.

    which: (N,) the square in whose middle each point is, of the S squares that are in use.
    """

    def __init__(self, u: Array, v: Array) -> None:
        columns, rows = u.astype(np.int64), v.astype(np.int64)
        # One more on each side, so that those at the edges are made of four quarters too.
        self._shape = int(rows.max()) + 3, int(columns.max()) + 3
        self._quarter = (rows + 1) * self._shape[1] + columns + 1
        middles = np.rint(v).astype(np.int64) * (self._shape[1] - 1) + np.rint(u).astype(np.int64)
        self._used, self.which = np.unique(middles, return_inverse=True)

    def sums(self, values: Array) -> Array:
        """Sum up values (V, N) of the points in each square, (V, S)."""
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

    r: the values; usual: slopes that are nothing out of the ordinary, as shares of the level.
    Gives (4, S): values at u = v = 0, slopes along both, and by how much these lessen the sum of
    squares.
    """
    n, u, v, uu, uv, vv, r, ur, vr = sums
    level = r / n
    # Of no depth at all, nothing leans.
    prior = 1 / np.maximum((usual * level)**2, 1e-18)
    # The level is eliminated first.
    uu, uv, vv = uu - u * u / n + prior, uv - u * v / n, vv - v * v / n + prior
    ur, vr = ur - u * level, vr - v * level
    scale = 1 / (uu * vv - uv**2)
    along_u, along_v = (vv * ur - uv * vr) * scale, (uu * vr - uv * ur) * scale
    return np.stack([level - (along_u * u + along_v * v) / n, along_u, along_v,
                     along_u * ur + along_v * vr])
