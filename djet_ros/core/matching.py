"""
Which places of two views are the same: where the motion before foresees them, or anywhere near.

Features are followed by the flow of the image. Where nothing foresees them, they are also found
again by their descriptors, among those of the other view.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from djet_ros.core.features import match_everywhere, match_nearby
from djet_ros.core.flow import follow, NEAR, reach_of_levels
from djet_ros.core.hamming import match_distances
from djet_ros.core.paraboloid import quantile
from djet_ros.core.prediction import foresee, predict, reach_of
from djet_ros.core.starts import Known
from djet_ros.core.types import Array, Pose, RelativePose, View
import numpy as np
from numpy.typing import NDArray

# chosen: share of the matches that agree in a rigid world; .6 was the least seen there, with the
# preset fast, and .2 to .6 before a lorry.
RIGID = 0.55

# Share of the inliers of the pair before that near matches have to come to.
_ENOUGH = 0.8

# Share of the matches that lie within half of the flow's reach of where they are foreseen.
_NEARLY_ALL = 0.9

# chosen: fewer matches than these leave a choice of motions, so that all are sought widely.
_MANY = 200

# Pixels between a corner and the same place followed there: corners are that far off.
_SAME = 2.0

# Bits by which one of two places has to look more alike to be taken: about two standard
# deviations of the distance between descriptors of one place.
_CLEARLY = 10


class Matches(NamedTuple):
    """Pixels x and y (N, 2) of the same places in two views, the surest first."""

    x: Array
    y: Array


class Foreseen(NamedTuple):
    """
    Matches that a motion foresaw, and in how many bits (N,) their descriptors differ.

    motion: the one before, with the turn that is guessed where one is.
    """

    matches: Matches
    bits: Array
    motion: Pose


def match_foreseen(previous: View, current: View, prior: RelativePose | None, known: Known,
                   search_radius: float) -> Foreseen | None:
    """
    Follow features from where the motion before foresees them; None where too few are near.

    Nor where other things move: a gyro is asked to tell these from the world. search_radius: as a
    share of the longer side.
    """
    if (prior is None or known.turn is not None or search_radius >= 1
            or prior.inliers.sum() < _MANY or prior.inliers.mean() < RIGID):
        return None
    reach = min(reach_of_levels(NEAR), search_radius * max(current.gray.shape))
    motion = Pose(prior.R if known.guess is None else known.guess.R, prior.t)
    foreseen = foresee(previous.features, current.K, motion.R, prior)
    y, bits = follow(previous, current, foreseen, reach, NEAR)
    found = np.isfinite(bits)
    if found.sum() < max(_ENOUGH * _expected(prior, len(found)), _MANY):
        return None
    # Where many are far off, as after a step twice as long, others are farther than the reach.
    off = np.linalg.norm((y - foreseen).compress(found, axis=0), axis=1)
    if quantile(off, _NEARLY_ALL) > reach / 2:
        return None
    first = _surest(bits)
    return Foreseen(Matches(previous.features.points.take(first, axis=0), y.take(first, axis=0)),
                    bits[first], motion)


def match_widely(previous: View, current: View, prior: RelativePose | None, known: Known,
                 search_radius: float) -> Matches:
    """
    Match features that lie near where a turn alone would bring them, or anywhere.

    search_radius: as a share of the longer side; 1 matches all with all, by descriptors alone.
    """
    previous, current = (replace(view, features=view.features.with_others)
                         for view in (previous, current))
    there, here = previous.features, current.features
    if search_radius >= 1:
        pairs = match_everywhere(there, here)
        return Matches(there.points[pairs[:, 0]], here.points[pairs[:, 1]])
    radius = search_radius * max(current.gray.shape)
    rotations = [*known.rotations(), *([] if prior is None else [prior.R])]
    turned = predict(there, here, current.K, rotations, radius, sure=known.turn is not None)
    y, bits = follow(previous, current, turned, radius)
    pairs = _match_turned(previous, current, turned, prior, radius)
    y, bits = _settled(previous, current, y, bits, pairs)
    first = _surest(bits)
    return Matches(there.points.take(first, axis=0), y.take(first, axis=0))


def _match_turned(previous: View, current: View, places: Array, prior: RelativePose | None,
                  radius: float) -> NDArray[np.int64]:
    """Match features around places (N, 2): as far as the motion before took them, or wider."""
    turned = replace(previous.features, points=places)
    near = reach_of(prior, current.K) if prior is not None else radius
    pairs = match_nearby(turned, current.features, min(near, radius))
    if (prior is not None and near < radius
            and len(pairs) < _ENOUGH * _expected(prior, len(places))):
        pairs = match_nearby(turned, current.features, radius)
    return pairs


def _expected(prior: RelativePose, sought: int) -> float:
    """Tell how many inliers the motion before would have had among so many features."""
    return float(prior.inliers.sum() * (sought / prior.sought if prior.sought else 1.0))


def _settled(previous: View, current: View, y: Array, bits: Array, pairs: NDArray[np.int64]
             ) -> tuple[Array, Array]:
    """
    Settle where features are that were followed to one place, and matched with another.

    y (N, 2), bits (N,): as from ``follow``; pairs (M, 2): indices of matches. The place that looks
    clearly more alike is taken; where neither does, none is, and of the same place the exact one.
    """
    there, here = pairs.T
    matched, y, bits = current.features.points[here], y.copy(), bits.copy()
    alike = match_distances(previous.smoothed, previous.features.points[there], current.smoothed,
                            matched)
    lost = np.isinf(bits[there])
    elsewhere = ~lost & (np.linalg.norm(y[there] - matched, axis=1) > _SAME)
    better = lost | (elsewhere & (alike < bits[there] - _CLEARLY))
    neither = elsewhere & ~better & ~(alike > bits[there] + _CLEARLY)
    y[there[better]], bits[there[better]] = matched[better], alike[better]
    bits[there[neither]] = np.inf
    return y, bits


def _surest(bits: Array) -> NDArray[np.int64]:
    """Give the indices of places that are not lost, those first that look most alike."""
    return np.argsort(bits, kind='stable')[:np.isfinite(bits).sum()]
