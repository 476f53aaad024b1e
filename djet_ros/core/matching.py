"""
Which places of two views are the same: where the motion before foresees them, or anywhere near.

Features are found again by their descriptors; of the others, where these are few, the flow of the
image tells.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import cv2
from djet_ros.core.features import match_close, match_everywhere, match_nearby
from djet_ros.core.prediction import foresee, likely_rotation, predict, reach_of
from djet_ros.core.starts import Known
from djet_ros.core.types import Array, Pose, RelativePose, View
import numpy as np
from numpy.typing import NDArray

# chosen: share of the matches that agree in a rigid world; .6 was the least seen there, with the
# preset fast, and .2 to .6 before a lorry.
RIGID = 0.55

# Share of the inliers of the pair before that near matches have to come to.
_ENOUGH = 0.8

# Pixels around where the motion before foresees them in which features are sought first (19 of 20
# lie there, on streets and in the hand), and bits in which the sure ones differ at most: others
# differ by some 100, the best of ten.
_FORESEEN, _SURE_BITS = 24.0, 64

# Share of the matches that have to be within half of that.
_NEARLY_ALL = 0.9

# chosen: fewer matches than these leave a choice of motions, so that all are sought widely.
_MANY = 200

# chosen: fewer matches than these come of images with little texture, where each of them counts.
_FEW = 600

# Pixels in which the flow is sought; levels of the pyramid, which are few, as the turn is known;
# chosen: pixels by which it may miss on the way back.
_FLOW_WINDOW, _FLOW_LEVELS, _THERE_AND_BACK = (11, 11), 3, 1.0


class Matches(NamedTuple):
    """Pixels x and y (N, 2) of the same places in two views, the surest first."""

    x: Array
    y: Array


def match_foreseen(previous: View, current: View, prior: RelativePose | None, known: Known,
                   search_radius: float) -> tuple[Matches, Pose] | None:
    """
    Match features where the motion before foresees them; None where too few are there.

    Nor where other things move: a gyro is asked to tell these from the world. search_radius: as a
    share of the longer side. Gives the motion too, where the camera turns otherwise than before
    with the turn that the largest features tell.
    """
    if (prior is None or known.turn is not None or search_radius >= 1
            or prior.inliers.sum() < _MANY or prior.inliers.mean() < RIGID):
        return None
    reach = min(_FORESEEN, search_radius * max(current.gray.shape))
    R = prior.R if known.guess is None else known.guess.R
    matched = _match_close(previous, current, prior, R, reach)
    if matched is None:
        R = likely_rotation(previous.features, current.features, current.K, [R], reach)
        matched = _match_close(previous, current, prior, R, reach)
    return None if matched is None else (matched, Pose(R, prior.t))


def match_widely(previous: View, current: View, prior: RelativePose | None, known: Known,
                 search_radius: float) -> Matches:
    """
    Match features that lie near where a turn alone would bring them, or anywhere.

    search_radius: as a share of the longer side; 1 matches all with all.
    """
    there, here = previous.features, current.features
    if search_radius >= 1:
        pairs = match_everywhere(there, here)
        return Matches(there.points[pairs[:, 0]], here.points[pairs[:, 1]])
    radius = search_radius * max(current.gray.shape)
    rotations = [*known.rotations(), *([] if prior is None else [prior.R])]
    turned = predict(there, here, current.K, rotations, radius, sure=known.turn is not None)
    pairs = _match_turned(previous, current, turned, prior, radius)
    found = Matches(there.points[pairs[:, 0]], here.points[pairs[:, 1]])
    if len(pairs) >= _FEW:
        return found
    left = np.ones(len(there), bool)
    left[pairs[:, 0]] = False
    x, y = _followed(previous.gray, current.gray, there.points[left], turned[left], radius)
    return Matches(np.concatenate([found.x, x]), np.concatenate([found.y, y]))


def _match_close(previous: View, current: View, prior: RelativePose, R: Array, reach: float
                 ) -> Matches | None:
    """Match features next to where they are seen after a turn R (3, 3) and a way as before."""
    there = previous.features
    foreseen = replace(there, points=foresee(there, current.K, R, prior))
    pairs = match_close(foreseen, current.features, reach, _SURE_BITS)
    y = current.features.points[pairs[:, 1]]
    off = np.linalg.norm(y - foreseen.points[pairs[:, 0]], axis=1)
    # Where many are far off, as after a step twice as long, others are farther than the reach.
    if (len(pairs) < max(_ENOUGH * prior.inliers.sum(), _MANY)
            or np.quantile(off, _NEARLY_ALL) > reach / 2):
        return None
    return Matches(there.points[pairs[:, 0]], y)


def _match_turned(previous: View, current: View, places: Array, prior: RelativePose | None,
                  radius: float) -> NDArray[np.int64]:
    """Match features around places (N, 2): as far as the motion before took them, or wider."""
    turned = replace(previous.features, points=places)
    near = reach_of(prior, current.K) if prior is not None else radius
    pairs = match_nearby(turned, current.features, min(near, radius))
    if prior is not None and near < radius and len(pairs) < _ENOUGH * prior.inliers.sum():
        pairs = match_nearby(turned, current.features, radius)
    return pairs


def _followed(there: NDArray[np.uint8], here: NDArray[np.uint8], points: Array, turned: Array,
              radius: float) -> Matches:
    """
    Follow points (N, 2) by the flow of the image from where a turn alone would bring them.

    Lucas and Kanade's, by pyramids, there and back. A corner that is not found again, for its
    surroundings look otherwise or many are better, is often still where the flow leads.
    """
    if not len(points):
        return Matches(np.empty((0, 2)), np.empty((0, 2)))
    x, start = (places.astype(np.float32)[:, None] for places in (points, turned))
    y, seen = _flow(there, here, x, start)
    back, seen_back = _flow(here, there, y, x)
    good = (seen & seen_back & (np.linalg.norm(back - x, axis=2).ravel() < _THERE_AND_BACK)
            & (np.linalg.norm(y - start, axis=2).ravel() < radius))
    return Matches(points[good], y[good, 0].astype(np.float64))


def _flow(before: NDArray[np.uint8], after: NDArray[np.uint8], points: NDArray[np.float32],
          start: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Follow points (N, 1, 2) from where they may be: where they are, and (N,) whether seen."""
    found, seen, _ = cv2.calcOpticalFlowPyrLK(
        before, after, points, start.copy(), winSize=_FLOW_WINDOW, maxLevel=_FLOW_LEVELS,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW)
    return np.asarray(found, np.float32), np.asarray(seen).ravel() > 0
