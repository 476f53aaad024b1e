"""
Other motions that explain the matches of a pair: of another basin, or of another body.

Few matches, or those of one plane, can fit two motions about equally well; and if a lorry fills
half of the image, each half has its own motion.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
from djet_ros.core.cells import sum_by_cell
from djet_ros.core.geometry import (
    chirality_signs,
    inverse_depths,
    norms,
    rays,
    rotation_angle,
    unit,
)
from djet_ros.core.jet import clipped_scale, epipolar_residuals, JetProblem, Loss, robust_scale
from djet_ros.core.medians import median
from djet_ros.core.sketch import losses_in_front, refine_all
from djet_ros.core.starts import starts_around, subsampled
from djet_ros.core.types import Array, Pose, RelativePose, Rival
import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

# Preference (a z-score, see `preferences`) above which matches decide between two motions: one
# error in a hundred (one-sided), if errors in different cells are independent.
SIGNIFICANT_PREFERENCE = 2.33

# rad; chosen: bound of the change of a camera's motion from one pair to the next.
_MAX_CHANGE = 0.1

# Matches on which rivals are refined before they are compared on all; matches that suffice to
# reject a plane in most scenes; optimiser steps.
_REFINED_ON, _SCREENED_ON = 400, 60
_STEPS = 6

# Robust standard deviations beyond which a match is an outlier of a motion, and within which it is
# an inlier.
OUTLIER, INLIER = 6.0, 3.0

# chosen: a body with less than this share of the matches is not mistaken for the static world.
MIN_BODY_SHARE = 0.125

# chosen: translation directions on a hemisphere from which a second motion is sought.
_DIRECTIONS = 10

# Maximum number of outliers among which a second motion is sought.
_MAX_OUTLIERS = 150

# chosen: share of the matches that may be off the plane in a planar scene; it was close to 0 on
# rendered planes.
_MAX_OFF_PLANE = 0.1

# chosen: factor by which their errors may exceed the noise; on rendered planes at most 1.3, in
# other scenes that a plane fits loosely 1.5 to 4, except for two of fifteen.
_MAX_EXCESS = 1.5

# Rounds of reweighting in which a plane is fitted, as many as of `fit_rotation`.
_PLANE_ROUNDS = 5

# Quantiles of the inverse depths of a body that are its far and near end; chosen: some points are
# outliers.
_FAR_QUANTILE, _NEAR_QUANTILE = 0.1, 0.95

# Ratio of near to far depth below which points are of the static world, which extends from the
# ground in front of the camera to the horizon.
DEEP_RATIO = 0.25

# chosen: ratio above which points may be of one body: it is about as deep as it is wide, and no
# nearer than its depth.
_COMPACT_BODY = 0.5

# chosen: noise of an inverse depth over the near end; above, noise would make a plane look deep.
_MAX_DEPTH_NOISE = 0.1

# chosen: a match that moves by less than this multiple of what counts as still moves slightly; and
# the share of such matches, of those that are still, from which a camera has moved. Before one
# that stands it was below a tenth, and above 0.9 before one that moves.
SLIGHTLY, MAX_SLIGHTLY = 3.0, 0.25


@dataclass(frozen=True)
class SecondMotion:
    """
    Two motions in one pair, t of both with the sign that brings their points in front.

    motions: the one with most inliers, and the other one; members: (N,) bool, inliers of that;
    width: the area over which its exclusive inliers spread, over that of the exclusive inliers of
    the first; flatness: near over far depth of both, NaN if hidden by noise.
    """

    motions: tuple[Pose, Pose]
    members: NDArray[np.bool_]
    width: float
    flatness: tuple[float, float]


def pose_distance(one: Pose, other: Pose) -> float:
    """Return ||p - p'||: rotation and translation direction together, in rad to first order."""
    turned, moved = (other.R - one.R).ravel(), other.t - one.t
    return float(np.sqrt(turned @ turned / 2 + moved @ moved))


def unsigned_distance(one: Pose, other: Pose) -> float:
    """Return the distance of two motions, minimal over the sign of t."""
    return min(pose_distance(one, other), pose_distance(one, Pose(other.R, -other.t)))


def continues_motion(prior: Pose, one: Pose, other: Pose) -> bool:
    """Return whether a motion is close to the previous one, and another clearly less so."""
    return _continues(pose_distance, prior, one, other)


def _continues(distance: Callable[[Pose, Pose], float], prior: Pose, one: Pose, other: Pose
               ) -> bool:
    near = distance(prior, one)
    return near < _MAX_CHANGE and 2 * near < distance(prior, other)


@dataclass(frozen=True)
class PreviousMotion(Pose):
    """
    The motion of the pair before, and others between which its matches do not decide.

    A pair that may itself be in the wrong basin must not lead the next ones there.
    """

    undecided: tuple[Pose, ...] = ()

    @classmethod
    def of(cls, pair: RelativePose) -> PreviousMotion:
        """Return the motion of a pair."""
        return cls(pair.R, pair.t, tuple(rival.pose for rival in pair.rivals
                                         if rival.preference < SIGNIFICANT_PREFERENCE))

    def leaves_open(self, one: Pose, other: Pose) -> bool:
        """Return whether the other motion, and not the one, continues one of these."""
        return any(_continues(unsigned_distance, each, other, one) for each in self.undecided)


def preferences(losses: Array, places: Array, chosen: int) -> Array:
    """
    Return by how many standard deviations matches prefer one of S poses to each of them (S,).

    losses: (S, N) of the matches at the poses; places: (N, 2) their pixels. Vuong's test
    (Econometrica 1989): for two fitted models, neither of them nested in the other, the summed
    difference of losses is about normal with the variance of its terms, and its sign tells which
    is closer to the truth. Errors are correlated within a cell, so the terms are cells: with D_c
    the difference in cell c,

        z = sum_c D_c / sqrt(sum_c D_c^2).

    The probability that a pose preferred by z is the wrong one is Phi(-z) at most.
    """
    by_cell = sum_by_cell(places, losses - losses[chosen])
    return np.asarray(by_cell.sum(1) / np.sqrt(np.maximum((by_cell**2).sum(1), 1e-300)))


def refined_rivals(problem: JetProblem, rivals: Sequence[Pose], loss: Loss) -> list[Pose]:
    """Optimise rivals to the minima of their basins, on a subset of the matches."""
    subset = problem.subset(subsampled(len(problem.blur), _REFINED_ON))
    return refine_all(subset, rivals, loss, _STEPS).poses()


def is_planar(x: Array, y: Array, noise: float) -> bool:
    """
    Return whether matches x, y (N, 2) in pixels fit one homography.

    Nearly all of them have to, and as closely as their noise allows: with larger errors, depths
    may remain that determine the motion. noise: robust standard deviation in pixels.
    """
    subset = subsampled(len(x), _REFINED_ON)
    H, _ = cv2.findHomography(x[subset], y[subset], cv2.USAC_MAGSAC, INLIER * noise)
    return H is not None and _fits_homography(np.asarray(H, np.float64), x, y, noise)


def _fits_homography(H: Array, x: Array, y: Array, noise: float) -> bool:
    """Return whether a homography (3, 3) brings x to y, both (N, 2), to within their noise."""
    if not np.isfinite(H).all():
        return False
    errors = norms(cv2.perspectiveTransform(x[:, None], H)[:, 0] - y)
    # For normal errors in both directions the median distance is 1.18 standard deviations.
    return bool(median(errors) < _MAX_EXCESS * 1.18 * noise
                and (errors > OUTLIER * noise).mean() < _MAX_OFF_PLANE)


def planar_twin(pose: Pose, K: Array, x: Array, y: Array, noise: float) -> Rival | None:
    """
    Return the second motion that explains matches x, y (N, 2) of one plane.

    With n the normal of the plane over its distance, H = R + t n' is also the homography of a
    second motion, whose t is about along n (Longuet-Higgins, Proc. R. Soc. B 1986). Only chirality
    decides between the two, which gives the preference. noise: as for ``is_planar``; None if the
    scene is not planar, or both motions are the same.
    """
    few, subset = (subsampled(len(x), count) for count in (_SCREENED_ON, _REFINED_ON))
    # A few matches suffice to reject a plane in most scenes.
    if _induced_homography(pose, K, x[few], y[few], noise) is None:
        return None
    x, y = x[subset], y[subset]
    H = _induced_homography(pose, K, x, y, noise)
    if H is None:
        return None
    rays_x = rays(K, x)
    _, rotations, translations, normals = cv2.decomposeHomographyMat(H, np.eye(3))
    candidates = [Pose(np.asarray(R, np.float64), unit(np.asarray(t, np.float64).ravel()))
                  for R, t in zip(rotations, translations) if t.any()]
    if len(candidates) < len(rotations):
        return None
    farthest = int(np.argmax([unsigned_distance(pose, candidate) for candidate in candidates]))
    ahead = rays_x @ normals[farthest].ravel() > 0
    behind = ahead != (ahead.mean() > 0.5)
    losses = np.stack([np.zeros(len(x)), behind])
    return Rival(candidates[farthest], float(preferences(losses, x, 0)[1]))


def _induced_homography(pose: Pose, K: Array, x: Array, y: Array, noise: float) -> Array | None:
    """Return H = R + t n' (3, 3), with n fitted to the inverse depths; None if it does not fit."""
    rays_x = rays(K, x)
    inverse, sigma = inverse_depths(pose.R, pose.t, rays_x, rays(K, y))
    if not (np.isfinite(inverse) & np.isfinite(sigma) & (sigma > 0)).all():
        return None
    H = np.asarray(pose.R + np.outer(pose.t, _fitted_plane(rays_x, inverse, sigma)))
    return H if _fits_homography(K @ H @ np.linalg.inv(K), x, y, noise) else None


def _fitted_plane(rays_x: Array, inverse: Array, sigma: Array) -> Array:
    """
    Return the n (3,) of a plane, n'x = rho, fitted to inverse depths (N,) of rays (N, 3).

    Robust as `fit_rotation`: false matches that slip along their epipolar lines are inliers of the
    motion, and a few of them would shift the plane by more than its noise. sigma: (N,) errors of
    the depths.
    """
    design, depths, weights = rays_x / sigma[:, None], inverse / sigma, np.ones(len(sigma))
    for _ in range(_PLANE_ROUNDS):
        weighted = design.T * weights
        # Of a few matches, or those on a row, the shortest, as of `np.linalg.lstsq`, which takes
        # four times as long.
        n = cv2.solve(weighted @ design, (weighted @ depths)[:, None],
                      flags=cv2.DECOMP_SVD)[1][:, 0]
        squared = (design @ n - depths)**2
        weights = 1 / (1 + squared / max(median(squared), 1e-18))
    return np.asarray(n)


def second_motion(problem: JetProblem, places: Array, first: Pose, scale: float,
                  least: int) -> SecondMotion | None:
    """
    Search for a second motion among the outliers of the first one.

    problem: all matches, with places (N, 2) in pixels; scale: robust standard deviation of the
    inliers' residuals; least: minimum number of inliers of a motion, besides a share of those of
    the first: a smaller body is not mistaken for the static world. Outliers are far from their
    epipolar line, or on its wrong half: a body that moves against the camera along its path has
    the same lines with the opposite direction. None if there are few outliers, or if no more than
    half of them agree: false matches that are off by a few pixels agree with many motions.
    """
    residuals = epipolar_residuals(problem, first.R, first.t).r
    first = _with_chirality(problem, first, np.abs(residuals) < INLIER * scale)
    scale = min(max(robust_scale(residuals), scale), 3 * scale)
    distances = _distances(problem, first)
    outliers = np.flatnonzero(distances > OUTLIER * scale)
    least = max(least, round(MIN_BODY_SHARE * (distances < INLIER * scale).sum()))
    if len(outliers) < least:
        return None
    pose = fit_motion(problem.subset(outliers), first, scale)
    members = _distances(problem, pose) < INLIER * scale
    agreeing = members[outliers].sum()
    if agreeing < least or agreeing <= len(outliers) / 2:
        return None
    motions, exclusive = (first, pose), _exclusive(distances, members, scale)
    first_area, second_area = (_area(places[each]) for each in exclusive)
    return SecondMotion(motions, members, second_area / max(first_area, 1e-9),
                        _flatness_of_both(problem, motions, exclusive))


def _exclusive(distances: Array, members: NDArray[np.bool_], scale: float
               ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """
    Return which matches (N,) fit the first of two motions only, and which the second only.

    distances: (N,) to the lines of the first; members: (N,) bool, inliers of the second.
    """
    return (distances < INLIER * scale) & ~members, members & (distances > OUTLIER * scale)


def _flatness_of_both(problem: JetProblem, motions: tuple[Pose, Pose],
                      exclusive: tuple[NDArray[np.bool_], NDArray[np.bool_]]
                      ) -> tuple[float, float]:
    """Return near over far depth of the matches (N,) bool that each of two motions has alone."""
    first, second = (_flatness(problem.subset(np.flatnonzero(only)), motion)
                     for motion, only in zip(motions, exclusive))
    return first, second


def static_by_depth(flatness: tuple[float, float]) -> int | None:
    """
    Return which of two bodies, 0 or 1, is the static world; None if depths do not tell.

    It is the one whose points span near to far depths, if those of the other do not.
    """
    for one, other in ((0, 1), (1, 0)):
        if flatness[one] < DEEP_RATIO and flatness[other] > _COMPACT_BODY:
            return one
    return None


def is_static_world(problem: JetProblem, one: Pose, other: Pose, scale: float) -> bool:
    """Return whether depths tell that one of two motions is the camera's: `static_by_depth`."""
    distances, to_other = (_distances(problem, pose) for pose in (one, other))
    exclusive = _exclusive(distances, to_other < INLIER * scale, scale)
    return static_by_depth(_flatness_of_both(problem, (one, other), exclusive)) == 0


def fit_motion(problem: JetProblem, near: Pose, scale: float) -> Pose:
    """Fit the motion with most inliers among some matches, from starts around another motion."""
    rough, tight = (Loss('geman_mcclure', share * scale) for share in (OUTLIER, INLIER))
    subset = problem.subset(subsampled(len(problem.blur), _MAX_OUTLIERS))
    sketch = refine_all(subset, starts_around(near, _DIRECTIONS), rough, _STEPS)
    candidates = refine_all(problem, sketch.poses(), tight, 1)
    best = int(losses_in_front(problem, candidates, tight).sum(1).argmin())
    refined = refine_all(problem, [candidates.pose(best)], tight, _STEPS)
    return _with_chirality(problem, refined.pose(0), np.abs(refined.r[0]) < INLIER * scale)


def motion_without_attached(problem: JetProblem, fixed: NDArray[np.bool_], pose: Pose,
                            scale: float, least: int, prior: Pose | None = None) -> Pose | None:
    """
    Return the motion without the fixed matches, if these are attached to the camera.

    A bonnet or an arm is at the same pixels in each pair. It fits any motion without rotation, as
    the sky does, and biases the camera's rotation to zero. So a motion is fitted to all other
    matches. It is the camera's if it is that of the static world (its points span near to far
    depths, or it continues the previous motion), and if most of the matches that stay in place are
    outliers of it. None otherwise.

    problem: all matches; fixed: (N,) bool, matches that stay in place; pose: the motion of all,
    where the search starts; scale: robust standard deviation of the inliers' residuals; least: see
    ``second_motion``; prior: the previous motion.
    """
    least = max(least, round(MIN_BODY_SHARE * len(fixed)))
    if min(fixed.sum(), (~fixed).sum()) < least:
        return None
    moving = problem.subset(~fixed)
    motion = fit_motion(moving, pose, scale)
    # Matches that stay in place are less noisy than those that move.
    scale = max(clipped_scale(epipolar_residuals(moving, motion.R, motion.t).r), scale)
    tight = refine_all(moving, [motion], Loss('geman_mcclure', INLIER * scale), _STEPS)
    motion = _with_chirality(moving, tight.pose(0), np.abs(tight.r[0]) < INLIER * scale)
    distances = _distances(problem, motion)
    agree = distances[~fixed] < INLIER * scale
    attached = (distances[fixed] > OUTLIER * scale).sum()
    if agree.mean() <= 0.5 or attached < least or attached <= fixed.sum() / 2:
        return None
    deep = _flatness(moving.subset(agree), motion) < DEEP_RATIO
    continued = prior is not None and continues_motion(prior, motion, pose)
    return motion if deep or continued else None


def may_stand(problem: JetProblem, shift: Array, pose: Pose, focal: float, noise: float,
              least: int, prior: Pose | None) -> bool:
    """
    Return whether the camera may stand still while a body that fills most of the image passes.

    The motion of the body fits what stands still too, as infinitely far. But if a camera moves
    without rotation, not only the sky hardly moves: more points are so far that they move
    slightly. The static world also has depths from near to far. A motion that continues the
    previous one is the camera's.

    problem: all matches; shift: (N,) their displacements; focal: focal length; noise: robust
    standard deviation of the matches; all in pixels; least: minimum number of matches that stand
    still; prior: the previous motion.
    """
    still, slightly = OUTLIER * noise, SLIGHTLY * OUTLIER * noise
    standing, moving = (shift < still).sum(), shift > slightly
    between = len(shift) - standing - moving.sum()
    if (focal * rotation_angle(pose.R, np.eye(3)) > slightly or standing < least
            or between >= MAX_SLIGHTLY * standing
            or (prior is not None and pose_distance(prior, pose) < _MAX_CHANGE)):
        return False
    agree = _distances(problem, pose) < INLIER * noise
    return not _flatness(problem.subset(np.flatnonzero(agree & moving)), pose) < DEEP_RATIO


def false_alarms(agreeing: int, matches: int, chance: float) -> float:
    """
    Return the logarithm (base 10) of the number of motions expected from false matches alone.

    chance: probability that a false match agrees with a motion. A motion through 5 of n matches
    that k agree with is expected n - 5 (sizes) . C(n, k) . C(k, 5) . 10 (solutions) . chance^(k-5)
    times by chance alone (a-contrario model of Moisan and Stival, IJCV 2004, for 5 points). Below
    0 the motion is significant.
    """
    if agreeing <= 5:
        return float('inf')
    log = (np.log(max(matches - 5, 1) * 10.0) + _log_choose(matches, agreeing)
           + _log_choose(agreeing, 5) + (agreeing - 5) * np.log(min(chance, 1.0)))
    return float(log / np.log(10))


def _log_choose(n: int, k: int) -> float:
    return float(gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1))


def _distances(problem: JetProblem, pose: Pose) -> Array:
    """Return the distances (N,) of matches from their epipolar half-lines, as residuals."""
    lines = refine_all(problem, [pose], Loss(), 0)
    # Indefinite surfaces that are kept as printed have losses below 0.
    return np.asarray(np.sqrt(np.abs(losses_in_front(problem, lines, Loss(), signs=(1.0,))[0])))


def _with_chirality(problem: JetProblem, pose: Pose, agreeing: NDArray[np.bool_]) -> Pose:
    """Return a pose with the sign of t that brings more points in front of both cameras."""
    votes = chirality_signs(pose.R, pose.t, problem.rays_x.T, problem.rays_y.T)
    return Pose(pose.R, pose.t if votes @ agreeing >= 0 else -pose.t)


def _flatness(problem: JetProblem, pose: Pose) -> float:
    """Return the near over the far depth of a body's points, NaN if noise hides it."""
    if not len(problem.blur):
        return float('nan')
    noise = robust_scale(epipolar_residuals(problem, pose.R, pose.t).r)
    rho, sigma = inverse_depths(pose.R, pose.t, problem.rays_x.T, problem.rays_y.T)
    far, near = np.quantile(rho, (_FAR_QUANTILE, _NEAR_QUANTILE))
    blurred = near <= 0 or noise * problem.pixel * np.median(sigma) > _MAX_DEPTH_NOISE * near
    return float('nan') if blurred else float(max(far / near, 0.0))


def _area(places: Array) -> float:
    """Return the area of the standard ellipse of places (N, 2), up to a constant factor."""
    return float(np.sqrt(max(np.linalg.det(np.cov(places.T)), 0.0))) if len(places) > 2 else 0.0
