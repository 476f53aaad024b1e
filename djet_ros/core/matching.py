"""
Feature matching between two views: near predicted places, or within the search radius.

Features are tracked by optical flow. Without a prediction they are also matched by their
descriptors.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from djet_ros.core.features import match_everywhere, match_nearby
from djet_ros.core.flow import flow_reach, NEAR_LEVELS, track_features
from djet_ros.core.geometry import norms
from djet_ros.core.hamming import match_distances
from djet_ros.core.medians import quantile
from djet_ros.core.prediction import (
    predict_at_infinity,
    predict_constant_motion,
    search_radius_after,
)
from djet_ros.core.rivals import PreviousMotion
from djet_ros.core.starts import KnownMotion
from djet_ros.core.types import Array, RelativePose, View
import numpy as np
from numpy.typing import NDArray

# chosen: share of inliers in a rigid scene; 0.6 was the least observed there, with the preset
# fast, and 0.2 to 0.6 with a lorry in view.
MIN_RIGID_SHARE = 0.55

# Share of the inliers expected from the previous pair that predicted matches have to reach.
_MIN_SHARE = 0.8

# Share of the matches that have to be within half of the search radius of their prediction.
_QUANTILE = 0.9

# chosen: with fewer matches the motion may be ambiguous, so the whole radius is searched.
_MIN_MATCHES = 200

# Pixels; largest distance between a corner and the tracked point of the same place, as corner
# positions are that inaccurate.
_SAME_PLACE = 2.0

# Bits by which one of two places has to be more similar to be preferred: about two standard
# deviations of the descriptor distance of the same place.
_CLEAR_BITS = 10


class Matches(NamedTuple):
    """Pixels x and y (N, 2) of the same places in two views, the most reliable first."""

    x: Array
    y: Array


class PredictedMatches(NamedTuple):
    """
    Matches near places predicted by a motion, and their descriptor distances in bits (N,).

    motion: the previous one, with the rotation of the external guess if there is one.
    """

    matches: Matches
    bits: Array
    motion: PreviousMotion


def match_predicted(previous: View, current: View, prior: RelativePose | None, known: KnownMotion,
                    search_radius: float) -> PredictedMatches | None:
    """
    Track features from where the previous motion predicts them; None if too few are nearby.

    Also None with a measured rotation, and if the scene is not rigid: then a wide search gives the
    choice of motions. search_radius: as a share of the longer image side.
    """
    if (prior is None or known.rotation is not None or search_radius >= 1
            or prior.inliers.sum() < _MIN_MATCHES
            or prior.inliers[prior.of_body].mean() < MIN_RIGID_SHARE):
        return None
    reach = min(flow_reach(NEAR_LEVELS), search_radius * max(current.gray.shape))
    motion = (PreviousMotion.of(prior) if known.guess is None
              else PreviousMotion(known.guess.R, prior.t))
    predicted = predict_constant_motion(previous.features, current.K, motion.R, prior)
    y, bits = track_features(previous, current, predicted, reach, NEAR_LEVELS)
    tracked = np.isfinite(bits)
    if tracked.sum() < max(_MIN_SHARE * _expected(prior, len(tracked)), _MIN_MATCHES):
        return None
    # If many are far from their prediction, as after a step twice as long, others are beyond the
    # search radius.
    offsets = norms((y - predicted).compress(tracked, axis=0))
    if quantile(offsets, _QUANTILE) > reach / 2:
        return None
    first = _most_similar_first(bits)
    x = previous.features.points.take(first, axis=0)
    return PredictedMatches(Matches(x, y.take(first, axis=0)), bits[first], motion)


def match_widely(previous: View, current: View, prior: RelativePose | None, known: KnownMotion,
                 search_radius: float) -> Matches:
    """
    Match features within the search radius of where the rotation alone would bring them.

    search_radius: as a share of the longer image side; 1 matches all with all, by descriptors
    alone.
    """
    previous, current = (replace(view, features=view.features.with_additional)
                         for view in (previous, current))
    points = previous.features.points
    if search_radius >= 1:
        pairs = match_everywhere(previous.features, current.features)
        return Matches(points[pairs[:, 0]], current.features.points[pairs[:, 1]])
    radius = search_radius * max(current.gray.shape)
    rotations = [*known.rotations(), *([] if prior is None else [prior.R])]
    rotated = predict_at_infinity(previous.features, current.features, current.K, rotations,
                                  radius, measured=known.rotation is not None or known.stood)
    y, bits = track_features(previous, current, rotated, radius)
    pairs = _match_rotated(previous, current, rotated, prior, radius)
    y, bits = _resolved(previous, current, y, bits, pairs)
    first = _most_similar_first(bits)
    return Matches(points.take(first, axis=0), y.take(first, axis=0))


def _match_rotated(previous: View, current: View, places: Array, prior: RelativePose | None,
                   radius: float) -> NDArray[np.int64]:
    """Match features around places (N, 2): within the previous displacements first, or wider."""
    rotated = replace(previous.features, points=places)
    near = search_radius_after(prior, current.K) if prior is not None else radius
    pairs = match_nearby(rotated, current.features, min(near, radius))
    if (prior is not None and near < radius
            and len(pairs) < _MIN_SHARE * _expected(prior, len(places))):
        pairs = match_nearby(rotated, current.features, radius)
    return pairs


def _expected(prior: RelativePose, sought: int) -> float:
    """Return how many inliers the previous motion would have had among so many features."""
    return float(prior.inliers.sum() * (sought / prior.sought if prior.sought else 1.0))


def _resolved(previous: View, current: View, y: Array, bits: Array, pairs: NDArray[np.int64]
              ) -> tuple[Array, Array]:
    """
    Resolve conflicts between tracked places and descriptor matches of the same feature.

    y (N, 2), bits (N,): as from ``track_features``; pairs (M, 2): indices of matches. The clearly
    more similar place is taken; if neither is, the feature is dropped. If both are the same place,
    the tracked one is kept, as more accurate.
    """
    y, bits = y.copy(), bits.copy()
    tracked, other = pairs.T
    matched = current.features.points[other]
    distance = match_distances(previous.smoothed, previous.features.points[tracked],
                               current.smoothed, matched)
    lost = np.isinf(bits[tracked])
    elsewhere = ~lost & (norms(y[tracked] - matched) > _SAME_PLACE)
    more_similar = lost | (elsewhere & (distance < bits[tracked] - _CLEAR_BITS))
    unclear = elsewhere & ~more_similar & ~(distance > bits[tracked] + _CLEAR_BITS)
    y[tracked[more_similar]] = matched[more_similar]
    bits[tracked[more_similar]] = distance[more_similar]
    bits[tracked[unclear]] = np.inf
    return y, bits


def _most_similar_first(bits: Array) -> NDArray[np.int64]:
    """Return the indices of places that were not lost, the most similar ones first."""
    return np.argsort(bits, kind='stable')[:np.isfinite(bits).sum()]
