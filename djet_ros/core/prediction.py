"""Prediction of where features are seen in the next image."""

from __future__ import annotations

from collections.abc import Sequence

from djet_ros import compiled
from djet_ros.core.features import signed_bits
from djet_ros.core.geometry import inverse_depths, norms, rays, unit
from djet_ros.core.types import Array, Features, RelativePose
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

# Features of the largest size that are compared all with all.
_MAX_COMPARED = 250

# Rotation hypotheses, each from two matches.
_HYPOTHESES = 300

# Quantile of the displacements that ignores the largest, which are near points or outliers.
_QUANTILE = 0.98

# Bound of the inverse depth, in units of the baseline: nearer points leave the image.
_MAX_INVERSE_DEPTH = 0.5

# Pixels; margin for errors of the predicted rotation.
_MARGIN = 20.0


def predict_at_infinity(previous: Features, current: Features, K: Array, known: Sequence[Array],
                        reach: float, measured: bool = False) -> Array:
    """
    Predict the pixels (N, 2) of the previous features under the rotation alone (infinite depth).

    known: likely rotations (3, 3), such as that of the previous motion; reach: search radius in
    pixels, for the displacement by parallax; measured: whether known[0] is measured, so that no
    rotation has to be estimated.
    """
    R = known[0] if measured else likely_rotation(previous, current, K, known, reach)
    return _project(K, rays(K, previous.points) @ R.T)


def predict_constant_motion(previous: Features, K: Array, R: Array, prior: RelativePose) -> Array:
    """
    Predict the pixels (N, 2) of the previous features by a constant-velocity model.

    R: (3, 3) the next rotation; prior: the previous motion. Each feature has the parallax of the
    nearest inlier of that motion, predicted from its depth.
    """
    x, y = (places.compress(prior.inliers, axis=0) for places in (prior.x, prior.y_opt))
    rotated = rays(K, previous.points) @ R.T
    if not prior.t.any() or not len(x):
        return _project(K, rotated)
    rays_x = rays(K, x)
    rho = inverse_depths(prior.R, prior.t, rays_x, rays(K, y))[0].clip(0, _MAX_INVERSE_DEPTH)
    step = rho[:, None] * prior.t
    # Points scaled to z = 1 in the first camera, so that the step is rho t for any depth.
    points = (rays_x @ prior.R.T + step) @ R.T
    shift = _project(K, points + step) - _project(K, points)
    return np.asarray(_project(K, rotated) + shift[nearest(y, previous.points)])


def nearest(points: Array, queries: Array) -> NDArray[np.int64]:
    """Return the indices (M,) of the points (N, 2) nearest to each of queries (M, 2)."""
    if compiled.library is not None:
        return compiled.nearest(points, queries)
    return np.asarray(cKDTree(points).query(queries)[1])


def _project(K: Array, places: Array) -> Array:
    """Project points (N, 3) to pixels (N, 2), those behind the camera far off the image."""
    image = places @ K.T
    return np.asarray(image[:, :2] / np.maximum(image[:, 2:], 1e-3))


def search_radius_after(motion: RelativePose, K: Array) -> float:
    """
    Return the search radius in pixels around the rotation alone, from the inliers of a motion.

    For the next pair, with a margin for a camera that accelerates by half.
    """
    x, y = motion.x[motion.inliers], motion.y_opt[motion.inliers]
    rotated = rays(K, x) @ (K @ motion.R).T
    displacements = norms(rotated[:, :2] / rotated[:, 2:] - y)
    if not len(displacements):
        return np.inf
    return _MARGIN + 1.5 * float(np.quantile(displacements, _QUANTILE))


def likely_rotation(previous: Features, current: Features, K: Array, known: Sequence[Array],
                    reach: float) -> Array:
    """
    Estimate the rotation (3, 3) that brings most matches of the largest features within reach.

    Hypotheses are the known rotations, identity, and rotations from pairs of matches; see
    `predict_at_infinity`.
    """
    x, y = _large_matches(previous, current)
    x, y = unit(rays(K, x)), unit(rays(K, y))
    tried = np.stack([*known, np.eye(3)])
    if len(x) >= 2:
        one, other = np.random.default_rng(0).integers(0, len(x), (2, _HYPOTHESES))
        rotated = _frames(y[one], y[other]) @ _frames(x[one], x[other]).transpose(0, 2, 1)
        tried = np.concatenate([tried, rotated])
    # y^T R x of all hypotheses in one product.
    cosines = tried.reshape(-1, 9) @ (y[:, :, None] * x[:, None]).reshape(-1, 9).T
    agreement = 1 - 2 * (1 - cosines) * (K[0, 0] / reach)**2
    return np.asarray(tried[np.maximum(agreement, 0).sum(1).argmax()])


def _large_matches(previous: Features, current: Features) -> tuple[Array, Array]:
    """Mutual nearest matches (M, 2) and (M, 2) among the features of the largest octave."""
    large_previous, large_current = _largest(previous), _largest(current)
    if not len(large_previous) or not len(large_current):
        return np.empty((0, 2)), np.empty((0, 2))
    similarity = (signed_bits(previous.descriptors[large_previous])
                  @ signed_bits(current.descriptors[large_current]).T)
    partner = similarity.argmax(1)
    mutual = similarity.argmax(0)[partner] == np.arange(len(large_previous))
    return previous.points[large_previous[mutual]], current.points[large_current[partner[mutual]]]


def _largest(features: Features) -> NDArray[np.int64]:
    largest = features.octaves == features.octaves.max(initial=0)
    return np.flatnonzero(largest)[:_MAX_COMPARED]


def _frames(a: Array, b: Array) -> Array:
    """Orthonormal frames (S, 3, 3) of pairs of directions (S, 3), zeros if they are parallel."""
    first, third = unit(a + b), unit(np.cross(a, b))
    return np.stack([first, np.cross(third, first), third], axis=2)
