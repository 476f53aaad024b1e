"""Where features are to be looked for in the next image: as a turn of the camera brings them."""

from __future__ import annotations

from collections.abc import Sequence

from djet_ros import compiled
from djet_ros.core.features import factor
from djet_ros.core.geometry import inverse_depths, rays, unit
from djet_ros.core.types import Array, Features, RelativePose
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

# Features of the largest size that are compared with all of their size, wherever they are.
_COMPARED = 250

# Rotations that are tried, each from two of their matches.
_SAMPLES = 300

# The few that moved farthest are near, or false.
_NEARLY_ALL = 0.98

# Inverse depth, in units of the motion before, of what is as near as can be seen again.
_NEAREST = 0.5

# Pixels by which the predicted turn may be off.
_ROOM = 20.0


def predict(previous: Features, current: Features, K: Array, known: Sequence[Array],
            reach: float, sure: bool = False) -> Array:
    """
    Tell where the previous features would be seen in the current image, were they far away.

    Gives pixels (N, 2). known: rotations (3, 3) that are likely, such as that of the motion
    before; reach: pixels by which near things may move otherwise; sure: whether the first of the
    known rotations has been measured, so that none has to be found.
    """
    R = known[0] if sure else likely_rotation(previous, current, K, known, reach)
    return _seen(K, rays(K, previous.points) @ R.T)


def foresee(previous: Features, K: Array, R: Array, before: RelativePose) -> Array:
    """
    Tell where the previous features will be seen if the camera goes on as it did before.

    Gives pixels (N, 2). R: (3, 3) its next turn; before: its motion up to the previous image. A
    feature moves beyond the turn as the nearest inlier of that motion will.
    """
    x, y = (places.compress(before.inliers, axis=0) for places in (before.x, before.y_opt))
    turned = rays(K, previous.points) @ R.T
    if not before.t.any() or not len(x):
        return _seen(K, turned)
    seen = rays(K, x)
    rho = inverse_depths(before.R, before.t, seen, rays(K, y))[0].clip(0, _NEAREST)
    step = rho[:, None] * before.t
    # With z = 1 of x: of the same length as rho, whatever the depth.
    there = (seen @ before.R.T + step) @ R.T
    shift = _seen(K, there + step) - _seen(K, there)
    return np.asarray(_seen(K, turned) + shift[nearest(y, previous.points)])


def nearest(points: Array, others: Array) -> NDArray[np.int64]:
    """Tell which (M,) of points (N, 2) is next to each of others (M, 2)."""
    if compiled.library is not None:
        return compiled.nearest(points, others)
    return np.asarray(cKDTree(points).query(others)[1])


def _seen(K: Array, places: Array) -> Array:
    """Pixels (N, 2) of places (N, 3); what is behind the camera is far out of the image."""
    image = places @ K.T
    return np.asarray(image[:, :2] / np.maximum(image[:, 2:], 1e-3))


def reach_of(motion: RelativePose, K: Array) -> float:
    """
    Tell how far from where the turn alone would bring them the inliers of a motion were seen.

    In pixels, with room for a camera that goes on half as fast again; for the pair after it.
    """
    x, y = motion.x[motion.inliers], motion.y_opt[motion.inliers]
    turned = rays(K, x) @ (K @ motion.R).T
    ways = np.linalg.norm(turned[:, :2] / turned[:, 2:] - y, axis=1)
    return _ROOM + 1.5 * float(np.quantile(ways, _NEARLY_ALL)) if len(ways) else np.inf


def likely_rotation(previous: Features, current: Features, K: Array, known: Sequence[Array],
                    reach: float) -> Array:
    """
    Find the rotation (3, 3) after which most matches of the largest features are within reach.

    Known rotations, none at all, and those of pairs of matches are tried; see `predict`.
    """
    x, y = _large_matches(previous, current)
    x, y = unit(rays(K, x)), unit(rays(K, y))
    tried = np.stack([*known, np.eye(3)])
    if len(x) >= 2:
        one, other = np.random.default_rng(0).integers(0, len(x), (2, _SAMPLES))
        turned = _frames(y[one], y[other]) @ _frames(x[one], x[other]).transpose(0, 2, 1)
        tried = np.concatenate([tried, turned])
    # y^T R x for all of them in one product.
    cosines = tried.reshape(-1, 9) @ (y[:, :, None] * x[:, None]).reshape(-1, 9).T
    agreement = 1 - 2 * (1 - cosines) * (K[0, 0] / reach)**2
    return np.asarray(tried[np.maximum(agreement, 0).sum(1).argmax()])


def _large_matches(previous: Features, current: Features) -> tuple[Array, Array]:
    """Mutual matches (M, 2) and (M, 2) among the features of the largest size there is."""
    there, here = _largest(previous), _largest(current)
    if not len(there) or not len(here):
        return np.empty((0, 2)), np.empty((0, 2))
    similarity = factor(previous.descriptors[there]) @ factor(current.descriptors[here]).T
    nearest = similarity.argmax(1)
    mutual = similarity.argmax(0)[nearest] == np.arange(len(there))
    return previous.points[there[mutual]], current.points[here[nearest[mutual]]]


def _largest(features: Features) -> NDArray[np.int64]:
    largest = features.octaves == features.octaves.max(initial=0)
    return np.flatnonzero(largest)[:_COMPARED]


def _frames(a: Array, b: Array) -> Array:
    """Frames (S, 3, 3) of pairs of directions (S, 3); of parallel ones, no rotation at all."""
    first, third = unit(a + b), unit(np.cross(a, b))
    return np.stack([first, np.cross(third, first), third], axis=2)
