"""
Several bodies that move: following one of them from pair to pair.

Of a pair alone, the body with most matches is the likeliest to be the static world. But a lorry
that is overtaken may come to have most matches, and as long as it moves in about the same
direction, one pose fits both nearly. So its matches are left out from when they first contradict
the motion of the others, until most of them no longer do.
"""

from __future__ import annotations

from typing import NamedTuple

from djet_ros.core.basins import MIN_SCALE
from djet_ros.core.covariance import is_within, pose_difference
from djet_ros.core.jet import epipolar_residuals, jet_problem, JetProblem, Loss, robust_scale
from djet_ros.core.rivals import (
    continues_motion,
    fit_motion,
    INLIER,
    is_static_world,
    MIN_BODY_SHARE,
    OUTLIER,
    pose_distance,
    PreviousMotion,
)
from djet_ros.core.sketch import refine_all
from djet_ros.core.surfaces import ReprojectionSurface
from djet_ros.core.types import Array, Pose, RelativePose
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import bdtrc

# Robust standard deviations within which a match that was left out as of another body fits a
# motion after all; and by how much that counts against one that does not; chosen: a body that
# moves in about the same direction fits by chance in much of its area.
_FITTING_LEFT_OUT, _BY_CHANCE = 1.0, 1 / 3

# chosen: number of matches around a place that tell of which body it is; of a body, more than a
# row where its epipolar lines agree by chance.
_NEIGHBOURS = 15

# chosen: share of those around a place that follow another motion only, of which it is then part.
_SHARE = 0.75

# Significance of the sign test: one false alarm in hours of video. Fewer matches cannot reach it.
_SIGNIFICANCE = 1e-5
_FEWEST = int(np.ceil(-np.log2(_SIGNIFICANCE)))

# rad; chosen: a motion as close to the previous one continues it, whatever else moves; and how far
# a continuing one may be: twice as much, and false matches seemed to continue a motion.
_CLOSE, _CONTINUING = 0.01, 0.05

# chosen: steps of the optimiser, and how often the other body is determined anew.
_STEPS, _REPETITIONS = 6, 2


def of_followed_body(before: RelativePose, x: Array) -> NDArray[np.bool_]:
    """
    Return which places x (N, 2) in the second image of a pair are of the body whose motion it has.

    There the nearest matches of that pair fit its motion rather than contradict it. A single one
    tells little: of a body that moves in the same direction, as a lorry that is overtaken, the
    epipolar lines are nearly the same. All, if no body contradicts.
    """
    if not before.inliers.any():
        return np.ones(len(x), bool)
    evidence = _evidence(before)
    if (evidence < 0).sum() <= MIN_BODY_SHARE * len(evidence):
        return np.ones(len(x), bool)
    return np.asarray(evidence[_nearest(before.y, x)].sum(1) >= 0)


def _evidence(pair: RelativePose) -> Array:
    """Return the evidence (N,) of matches that they are of the body whose motion a pair has."""
    errors = _errors(pair)
    contradicting = np.where(errors > OUTLIER, -1.0, 0.0)
    evidence = np.where(errors < INLIER, 1.0, contradicting)
    if pair.left_out is not None:
        by_chance = np.where(errors < _FITTING_LEFT_OUT, _BY_CHANCE, -1.0)
        evidence[pair.left_out] = by_chance[pair.left_out]
    return evidence


def _errors(pair: RelativePose) -> Array:
    """Return the distances (N,) of matches from their lines, in robust standard deviations."""
    return np.asarray(np.abs(pair.residuals) / _noise(pair))


def _noise(pair: RelativePose) -> float:
    return max(robust_scale(pair.residuals[pair.inliers]), MIN_SCALE)


def _nearest(places: Array, x: Array) -> NDArray[np.int64]:
    """Return the indices (N, k) of the places (M, 2) that are nearest to each of x (N, 2)."""
    count = min(_NEIGHBOURS, len(places))
    return np.asarray(cKDTree(places).query(x, count)[1]).reshape(len(x), count)


def is_continued(prior: Pose | None, pair: RelativePose) -> bool:
    """Return whether a pair goes on by the previous motion."""
    return prior is not None and pose_distance(prior, Pose(pair.R, pair.t)) < _CONTINUING


def fits_followed_body(pair: RelativePose) -> bool:
    """Return whether most of the matches that a pair left out fit its motion."""
    fitting = _errors(pair)[~pair.of_body] < INLIER
    return bool(2 * fitting.sum() > len(fitting))


def are_of_one_motion(before: PreviousMotion | None, alone: RelativePose, by_all: RelativePose
                      ) -> bool:
    """
    Return whether the matches that a pair left out are of its motion after all.

    alone: the pair without them; by_all: with them; before: the previous motion. The pair alone
    has to be within the covariance by all: if nothing else moves, matches are left out where the
    previous motion was inaccurate. (Few matches determine little, and any pose is within the
    covariance of those alone.) Otherwise they are if only the pose by all goes on by the previous
    motion, or by one that it left open. That the pose without them goes on does not decide: the
    previous motion may be the wrong one.
    """
    one, other = Pose(alone.R, alone.t), Pose(by_all.R, by_all.t)
    if is_within(by_all.own_covariance_5, pose_difference(one.R, one.t, other)):
        return True
    return before is not None and (
        continues_motion(before, other, one) or before.leaves_open(one, other))


class LeftOut:
    """
    The matches of a pair, some of which it left out, and the motion of those.

    K: (3, 3) camera matrix; motion: None if they are too few for a body.
    """

    def __init__(self, pair: RelativePose, K: Array) -> None:
        self._pair, self._noise = pair, _noise(pair)
        self._problem = jet_problem(
            K, pair.x, ReprojectionSurface(pair.x, pair.y).fit_around(pair.y))
        chosen = np.flatnonzero(~pair.of_body)
        self.motion = None if len(chosen) < _FEWEST else fit_motion(
            self._problem.subset(chosen), Pose(pair.R, pair.t), self._noise)

    def readmitted(self) -> NDArray[np.bool_]:
        """
        Return which of them (N,), of all matches, are not of another body after all.

        They fit the motion of the pair, and not that of the other body. All if they are too few
        for a body.
        """
        chosen = ~self._pair.of_body
        if self.motion is None:
            return chosen
        of_other = np.abs(_residuals(self._problem, self.motion)) < INLIER * self._noise
        return np.asarray(chosen & (_errors(self._pair) < INLIER) & ~of_other)

    def is_world(self) -> bool:
        """
        Return whether they are the static world, as their depths tell.

        The pair before may have followed a moving object.
        """
        followed = Pose(self._pair.R, self._pair.t)
        return self.motion is not None and is_static_world(
            self._problem, self.motion, followed, self._noise)


class Continuing(NamedTuple):
    """A motion that continues the previous one, and the (N,) bool mask of the other body."""

    pose: Pose
    other: NDArray[np.bool_]


def continuing_motion(problem: JetProblem, places: Array, prior: Pose, pose: Pose, noise: float
                      ) -> Continuing | None:
    """
    Return the motion that continues the previous one, if a pose is that of another body.

    While a lorry is overtaken, its matches become the majority, and the pose that fits them may
    still fit most of the others. The rest are outliers, many of which agree with a motion near the
    previous one. By chance, as many would if they were on the other side of their epipolar lines;
    the sign test compares the two. None if it does not decide, if the pose continues the previous
    motion, prior, as well, or if nearly all matches fit it. places: (N, 2) pixels; noise: robust
    standard deviation of the inliers' residuals.
    """
    pose = _aligned(pose, prior)
    if pose_distance(prior, pose) < _CLOSE:
        return None
    errors = _residuals(problem, pose) / noise
    outliers = np.abs(errors) > OUTLIER
    alone = (np.abs(errors) < INLIER).mean() > 1 - MIN_BODY_SHARE
    if alone or outliers.sum() < _FEWEST:
        return None
    found = fit_motion(problem.subset(np.flatnonzero(outliers)), prior, noise)
    tight = Loss('geman_mcclure', INLIER * noise)
    for _ in range(_REPETITIONS):
        other = _of_other(places, _residuals(problem, found) / noise, errors)
        if (~other).sum() < _FEWEST:
            return None
        rest = problem.subset(np.flatnonzero(~other))
        found = refine_all(rest, [found], tight, _STEPS).pose(0)
    found = _aligned(found, prior)
    own = _residuals(problem, found) / noise
    if (pose_distance(prior, found) > _CONTINUING or not continues_motion(prior, found, pose)
            or not _is_significant(own[outliers], errors[outliers])):
        return None
    return Continuing(found, _of_other(places, own, errors))


def _aligned(pose: Pose, prior: Pose) -> Pose:
    """Return a pose with the sign of t that is nearer to the prior's."""
    return Pose(pose.R, pose.t if pose.t @ prior.t >= 0 else -pose.t)


def _residuals(problem: JetProblem, pose: Pose) -> Array:
    return epipolar_residuals(problem, pose.R, pose.t).r


def _of_other(places: Array, own: Array, other: Array) -> NDArray[np.bool_]:
    """
    Return which matches (N,) fit another motion only, or are where most do.

    places: (N, 2); own, other: (N,) residuals to both motions, in standard deviations.
    """
    fits_own, fits_other = np.abs(own) < INLIER, np.abs(other) < INLIER
    known, only_other = np.flatnonzero(fits_own | fits_other), fits_other & ~fits_own
    if not len(known):
        return only_other
    of_other, rest = only_other.copy(), ~only_other
    around = only_other[known[_nearest(places[known], places[rest])]]
    of_other[rest] = around.mean(1) > _SHARE
    return of_other


def _is_significant(own: Array, other: Array) -> bool:
    """
    Return whether outliers of one motion agree with another by more than chance.

    own, other: (M,) their residuals to both, in standard deviations. Mirrored at the line of the
    other motion, a match has the residual own - 2 other.
    """
    agreeing, mirrored = (int((np.abs(each) < INLIER).sum()) for each in (own, own - 2 * other))
    return bool(agreeing and bdtrc(agreeing - 1, agreeing + mirrored, 0.5) < _SIGNIFICANCE)
