"""Lengths and units transferred from pair to pair, by the depths of points that pairs share."""

from __future__ import annotations

from typing import NamedTuple

from djet_ros.core.cells import CAUTIOUS_INFLATION, CELL
from djet_ros.core.geometry import depths_in_second, inverse_depths, rays
from djet_ros.core.types import Array, RelativePose
from djet_ros.odometry.scale import Length, unknown
import numpy as np
from numpy.typing import NDArray

# Minimum number of points that two pairs of views must share to transfer a length.
_MIN_SHARED = 20

# Parallax in rad below which a depth is noise (about a pixel of a car's camera).
_MIN_PARALLAX = 1.5e-3


def transferred_length(step: RelativePose, other: RelativePose, length: Length,
                       K: Array) -> Length:
    """
    Return the length of another motion from the same first view, from the length of a step.

    A point seen in both pairs has one depth, so its inverse depths in units of the translations
    are proportional to their lengths. Unknown if too few points are shared.
    """
    estimated = _ratio(_Depths.in_first_view(step, K), _Depths.in_first_view(other, K))
    if estimated is None:
        return unknown(length.value)
    ratio, sigma = estimated
    return Length(length.value * ratio,
                  float(np.hypot(length.value * sigma, length.sigma * ratio)), length.known)


def log_scale_ratio(step: RelativePose, step_length: float, loop: RelativePose,
                    loop_length: float, other: RelativePose, other_length: float,
                    K: Array) -> tuple[float, float] | None:
    """
    Estimate the unit of length at the far end of a loop relative to that at the near end.

    step: pair from the loop's first view to another, other: pair from its second view to another,
    each with its length in the unit of its place; loop_length is in the unit of the first.
    Returns (log ratio, standard deviation) by the more accurate of two estimates, None if too few
    points are shared:
    * Points seen in all three pairs have two depths in the second view. They are few, above all in
      small images.
    * Points shared by the loop and one other pair give the loop's length, once in each unit. They
      are many, but hardly determine it if the loop is short.
    """
    near, far = _Depths.in_first_view(step, K), _Depths.in_first_view(other, K)
    first = _Depths.in_first_view(loop, K)
    second = first.in_second_view(loop, K)
    estimates = []
    at_near, at_far = _ratio(near, first), _ratio(far, second)
    if at_near is not None and at_far is not None:
        estimates.append((np.log(at_near[0] * step_length / (at_far[0] * other_length)),
                          np.hypot(at_near[1] / at_near[0], at_far[1] / at_far[0])))
    in_step, in_loop = _shared(near, first)
    inverse = _from(near.inverse[in_step] / step_length, first.x[in_loop], loop.R,
                    loop_length * loop.t, K)
    by_length = _ratio(_Depths(second.x[in_loop], inverse, near.parallax[in_step]),
                       far.of(far.parallax > _MIN_PARALLAX))
    if by_length is not None:
        estimates.append((np.log(by_length[0] / other_length), by_length[1] / by_length[0]))
    if not estimates:
        return None
    ratio, sigma = min(estimates, key=lambda estimate: float(estimate[1]))
    return float(ratio), max(float(sigma), 1e-3)


class _Depths(NamedTuple):
    """
    Depths of M points in one view of a pair.

    x: (M, 2) pixels; inverse: (M,) inverse depths in units of the translation; parallax: (M,) rad.
    """

    x: Array
    inverse: Array
    parallax: Array

    @classmethod
    def in_first_view(cls, pair: RelativePose, K: Array) -> _Depths:
        """Return the depths of the inliers in the pair's first view."""
        x = pair.x[pair.inliers]
        rays_x, rays_y = rays(K, x), rays(K, pair.y_opt[pair.inliers])
        inverse, _ = inverse_depths(pair.R, pair.t, rays_x, rays_y)
        parallax = np.linalg.norm(np.cross(rays_y, rays_x @ pair.R.T), axis=1)
        return cls(x, inverse, parallax / (rays_y**2).sum(1))

    def in_second_view(self, pair: RelativePose, K: Array) -> _Depths:
        """Return the depths of the same points in the pair's second view."""
        return _Depths(pair.y[pair.inliers], _from(self.inverse, self.x, pair.R, pair.t, K),
                       self.parallax)

    def of(self, chosen: NDArray[np.bool_]) -> _Depths:
        """Return the depths of some of the points."""
        return _Depths(*(values[chosen] for values in self))


def _from(inverse: Array, x: Array, R: Array, t: Array, K: Array) -> Array:
    """Return the inverse depths (M,) of pixels x (M, 2) in a second view (R, t); NaN behind it."""
    ahead = depths_in_second(R, t, rays(K, x), inverse)
    return np.asarray(inverse / np.where(ahead > 0, ahead, np.nan))


def _shared(first: _Depths, second: _Depths) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return two index arrays (S,) of the points with the same pixels."""
    _, first_indices, second_indices = np.intersect1d(_pixel_keys(first.x), _pixel_keys(second.x),
                                                      return_indices=True)
    return first_indices, second_indices


def _pixel_keys(points: Array) -> NDArray[np.int64]:
    """Return keys (M,) of pixels (M, 2), equal for equal quarter pixels."""
    columns, rows = np.rint(4 * points).astype(np.int64).T
    return np.asarray(columns + (rows << 20))


def _ratio(reference: _Depths, others: _Depths) -> tuple[float, float] | None:
    """
    Return the ratio of others' inverse depths to the reference of the same points, with sigma.

    Only points with sufficient parallax in the reference are used; None if they are too few.
    """
    reference_indices, other_indices = _shared(reference, others)
    x, parallax = reference.x[reference_indices], reference.parallax[reference_indices]
    with np.errstate(divide='ignore', invalid='ignore'):
        ratios = others.inverse[other_indices] / reference.inverse[reference_indices]
    used = (parallax > _MIN_PARALLAX) & np.isfinite(ratios)
    if used.sum() < _MIN_SHARED:
        return None
    ratio = float(np.median(ratios[used]))
    if ratio <= 0:
        return None
    # Standard deviation of a median with independent errors per image cell, inflated.
    spread = 1.4826 * float(np.median(np.abs(ratios[used] - ratio)))
    cells = len(np.unique(x[used] // CELL, axis=0))
    return ratio, 1.2533 * spread * float(np.sqrt(CAUTIOUS_INFLATION / cells))
