"""
Which places of two views are the same: where the motion before foresees them, or anywhere near.

Features are followed by the flow of the image. Where nothing foresees them, they are also found
again by their descriptors, among those of the other view.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from djet_ros.core.features import match_everywhere, match_nearby
from djet_ros.core.flow import FAR, follow, NEAR, reach_of_levels
from djet_ros.core.geometry import fit_rotation, rays
from djet_ros.core.hamming import match_distances
from djet_ros.core.paraboloid import quantile
from djet_ros.core.prediction import foresee, likely_rotation, predict, reach_of
from djet_ros.core.starts import Known
from djet_ros.core.types import Array, Pose, RelativePose, View
import numpy as np
from numpy.typing import NDArray

# chosen: share of the matches that agree in a rigid world; .6 was the least seen there, with the
# preset fast, and .2 to .6 before a lorry.
RIGID = 0.55

# Share of the matches of the pair before that those which are foreseen have to come to, and of its
# inliers near matches by descriptors.
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
    Where N features were foreseen by a motion, and where the flow took them from there.

    places, y: (N, 2) pixels; bits: (N,) in which descriptors differ at x and y, infinite for those
    that are lost; motion: the one before, but where the camera turns otherwise with that turn.
    """

    places: Array
    y: Array
    bits: Array
    motion: Pose

    def matches(self, previous: View) -> tuple[Matches, Array]:
        """Give those that are not lost, and their bits."""
        first = _surest(self.bits)
        return Matches(previous.features.points[first], self.y[first]), self.bits[first]

    def are_many(self, prior: RelativePose) -> bool:
        """Tell whether about as many are found as the pair before had matches."""
        wanted = _ENOUGH * _expected(len(prior.x), prior, len(self.y))
        return bool(np.isfinite(self.bits).sum() >= max(wanted, _MANY))

    def stray(self, reach: float) -> bool:
        """Tell whether so many are far off that others are beyond the reach of the flow."""
        found = np.isfinite(self.bits)
        off = np.linalg.norm((self.y - self.places)[found], axis=1)
        return len(off) < _MANY or quantile(off, _NEARLY_ALL) > reach / 2


def match_foreseen(previous: View, current: View, prior: RelativePose | None, known: Known,
                   search_radius: float) -> Foreseen | None:
    """
    Follow features from where the motion before foresees them; None where it does not.

    Nor where other things move: a gyro is asked to tell these from the world. search_radius: as a
    share of the longer side.
    """
    if (prior is None or known.turn is not None or search_radius >= 1
            or prior.inliers.sum() < _MANY or prior.inliers.mean() < RIGID):
        return None
    near, far = (min(reach_of_levels(levels), search_radius * max(current.gray.shape))
                 for levels in (NEAR, FAR))
    R = prior.R if known.guess is None else known.guess.R
    found = _followed(previous, current, prior, R, near, NEAR)
    if found.stray(near):
        R = _turned(previous, current, found, R, far)
        found = _followed(previous, current, prior, R, far, FAR)
    return None if found.stray(far) else found


def _followed(previous: View, current: View, prior: RelativePose, R: Array, reach: float,
              levels: int) -> Foreseen:
    """Follow features from where they are seen after a turn R (3, 3) and a way as before."""
    places = foresee(previous.features, current.K, R, prior)
    return Foreseen(places, *follow(previous, current, places, reach, levels), Pose(R, prior.t))


def _turned(previous: View, current: View, found: Foreseen, R: Array, reach: float) -> Array:
    """
    Tell how the camera turned (3, 3), where it did not by R.

    By the places that were found, or where these are few by the largest features.
    """
    these, K = np.isfinite(found.bits), current.K
    if these.sum() < _MANY:
        return likely_rotation(previous.features, current.features, K, [R], reach)
    return np.asarray(fit_rotation(rays(K, found.places[these]), rays(K, found.y[these])) @ R)


def match_widely(previous: View, current: View, prior: RelativePose | None, known: Known,
                 search_radius: float, turn: Array | None = None) -> Matches:
    """
    Match features that lie near where a turn alone would bring them, or anywhere.

    search_radius: as a share of the longer side; 1 matches all with all, by descriptors alone.
    turn: (3, 3) the one that is known already, so that none has to be found.
    """
    previous, current = (replace(view, features=view.features.with_others)
                         for view in (previous, current))
    there, here = previous.features, current.features
    if search_radius >= 1:
        pairs = match_everywhere(there, here)
        return Matches(there.points[pairs[:, 0]], here.points[pairs[:, 1]])
    radius = search_radius * max(current.gray.shape)
    rotations = [*known.rotations(), *([] if prior is None else [prior.R])]
    sure = known.turn is not None
    if turn is not None:
        rotations, sure = [turn], True
    places = predict(there, here, current.K, rotations, radius, sure)
    y, bits = follow(previous, current, places, radius)
    pairs = _match_turned(previous, current, places, prior, radius)
    y, bits = _settled(previous, current, y, bits, pairs)
    first = _surest(bits)
    return Matches(there.points[first], y[first])


def _match_turned(previous: View, current: View, places: Array, prior: RelativePose | None,
                  radius: float) -> NDArray[np.int64]:
    """Match features around places (N, 2): as far as the motion before took them, or wider."""
    turned = replace(previous.features, points=places)
    near = reach_of(prior, current.K) if prior is not None else radius
    pairs = match_nearby(turned, current.features, min(near, radius))
    if (prior is not None and near < radius
            and len(pairs) < _ENOUGH * _expected(prior.inliers.sum(), prior, len(places))):
        pairs = match_nearby(turned, current.features, radius)
    return pairs


def _expected(found: int, prior: RelativePose, sought: int) -> float:
    """Tell how many the motion before would have found among so many features, as of its own."""
    return float(found * (sought / prior.sought if prior.sought else 1.0))


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
