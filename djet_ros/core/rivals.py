"""
Other motions that explain the matches of a pair: in another basin, or of another body.

Two views can leave a choice. A few matches, or those of one plane, fit two motions about equally
well; and where a lorry fills half of the image, each half has a motion of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
from djet_ros.core.cells import summed_by_cell
from djet_ros.core.geometry import inverse_depths, rays, sides, unit
from djet_ros.core.jet import core_scale, JetProblem, Loss, robust_scale
from djet_ros.core.sketch import losses_in_front, refine_all, Sketch
from djet_ros.core.starts import around, thinned
from djet_ros.core.types import Array, Pose
import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

# Standard deviations by which matches have to prefer a pose to be sure of it: one wrong of a
# hundred that are as close as this.
DECIDED = 2.33

# rad; chosen: as much as a camera's motion may change from one pair to the next.
_LIKE_BEFORE = 0.1

# Matches on which rivals are refined before they are compared on all; and so few of a world that
# is no plane tell that it is none.
_REFINED_ON, _SCREENED = 400, 60
_STEPS = 6

# Robust standard deviations: strays disagree with a motion for sure, and members agree with it.
_STRAY, _MEMBER = 6.0, 3.0

# chosen: a body with less than this share of the world's matches is not mistaken for it.
_SMALL_SHARE = 0.125

# chosen: directions all round from which it is looked for.
_DIRECTIONS = 10

# A second motion is looked for among so many strays at most.
_STRAYS = 150

# chosen: share of the matches that may stray from a plane which is all there is; next to none did
# from rendered ones.
_OFF_PLANE = 0.1

# chosen: by what factor they may be off it more than noise has them; of rendered planes it was 1.3
# at most, and of the others that a plane explains loosely 1.5 to 4, but for two of fifteen.
_ON_PLANE = 1.5

# Shares of a body's points before its far and its near end; chosen: some are not of it.
_FAR_END, _NEAR_END = 0.1, 0.95

# Near end over far end of what is a world: it reaches from the ground before the camera to the
# horizon.
DEEP = 0.25

# chosen: noise of an inverse depth over that of the near end; more would make a plane look deep.
_BLURRED = 0.1


@dataclass(frozen=True)
class Rival:
    """Another motion, and by how many standard deviations the matches prefer the chosen one."""

    pose: Pose
    preference: float


@dataclass(frozen=True)
class SecondMotion:
    """
    Two motions in one pair; t of both has the sign that brings their points to the front.

    first: the one that most matches follow; pose: the other one; members: (N,) bool mask of the
    matches that agree with that; width: the area that those are spread over which follow it
    alone, over that of those which follow the first alone; flatness: of the first and the other,
    distance of the near end over that of the far one, NaN where noise hides it.
    """

    first: Pose
    pose: Pose
    members: NDArray[np.bool_]
    width: float
    flatness: tuple[float, float]

    @property
    def both(self) -> tuple[Pose, Pose]:
        """Give both motions, the first one first."""
        return self.first, self.pose


def change(one: Pose, other: Pose) -> float:
    """Measure ||p - p'||: rotation and direction together, in rad to first order."""
    return float(np.linalg.norm(np.concatenate([(other.R - one.R).ravel() / np.sqrt(2),
                                                other.t - one.t])))


def apart(one: Pose, other: Pose) -> float:
    """Measure how different two motions are while the sign of t is not yet settled."""
    return min(change(one, other), change(one, Pose(other.R, -other.t)))


def goes_on(before: Pose, one: Pose, other: Pose) -> bool:
    """Tell whether a motion is like the one before, and another one clearly less so."""
    near = change(before, one)
    return near < _LIKE_BEFORE and 2 * near < change(before, other)


def preferences(losses: Array, places: Array, chosen: int) -> Array:
    """
    Tell by how many standard deviations matches prefer one of some poses to each (S,).

    losses: (S, N) of the matches at the poses; places: (N, 2) their pixels. Vuong's test
    (Econometrica 1989): of two models that are both fitted and neither a special case of the
    other, the summed difference of losses is about normal, with the variance of its parts, and
    its sign tells which is nearer to the truth. The matches of one cell err together, so these
    parts are cells: with D_c the difference in cell c,

        z = sum_c D_c / sqrt(sum_c D_c^2).

    The probability that a pose preferred by z is the wrong one is Phi(-z) at most.
    """
    by_cell = summed_by_cell(places, losses - losses[chosen])
    return np.asarray(by_cell.sum(1) / np.sqrt(np.maximum((by_cell**2).sum(1), 1e-300)))


def refined_rivals(problem: JetProblem, rivals: Sequence[Pose], loss: Loss) -> list[Pose]:
    """Bring rivals to the minima of their basins, on some of the matches."""
    some = problem.subset(thinned(len(problem.blur), _REFINED_ON))
    return refine_all(some, rivals, loss, _STEPS).poses()


def lie_on_a_plane(x: Array, y: Array, noise: float) -> bool:
    """
    Tell whether matches x, y (N, 2), in pixels, are seen as those of one plane are.

    Nearly all of them, and as closely as their noise lets them be: where that is large, depths may
    hide in it that still tell. noise: robust standard deviation in pixels.
    """
    some = thinned(len(x), _REFINED_ON)
    H, _ = cv2.findHomography(x[some], y[some], cv2.USAC_MAGSAC, _MEMBER * noise)
    return H is not None and _as_of_a_plane(np.asarray(H, np.float64), x, y, noise)


def _as_of_a_plane(H: Array, x: Array, y: Array, noise: float) -> bool:
    """Tell whether a plane's homography (3, 3) brings x to y, both (N, 2), as noise lets it."""
    if not np.isfinite(H).all():
        return False
    off = np.linalg.norm(cv2.perspectiveTransform(x[:, None], H)[:, 0] - y, axis=1)
    # Of normal errors in both directions the median is 1.18 standard deviations.
    return bool(np.median(off) < _ON_PLANE * 1.18 * noise
                and (off > _STRAY * noise).mean() < _OFF_PLANE)


def other_of_a_plane(pose: Pose, K: Array, x: Array, y: Array, noise: float) -> Rival | None:
    """
    Give the other motion by which matches x, y (N, 2) are seen as those of one plane are.

    With n the plane's normal over its distance, H = R + t n' is also that of a second motion,
    whose t is about along n (Longuet-Higgins, Proc. R. Soc. B 1986). Chirality alone decides
    between the two. noise: as for ``lie_on_a_plane``; None where all is not one plane, or the
    other motion is the same.
    """
    few, some = (thinned(len(x), count) for count in (_SCREENED, _REFINED_ON))
    # Few tell already of most worlds that they are none.
    if _homography(pose, K, x[few], y[few], noise) is None:
        return None
    x, y = x[some], y[some]
    H = _homography(pose, K, x, y, noise)
    if H is None:
        return None
    rays_x = rays(K, x)
    _, turns, ways, normals = cv2.decomposeHomographyMat(H, np.eye(3))
    others = [Pose(np.asarray(R, np.float64), unit(np.asarray(t, np.float64).ravel()))
              for R, t in zip(turns, ways) if t.any()]
    if len(others) < len(turns):
        return None
    farthest = int(np.argmax([apart(pose, other) for other in others]))
    ahead = rays_x @ normals[farthest].ravel() > 0
    behind = ahead != (ahead.mean() > 0.5)
    losses = np.stack([np.zeros(len(x)), behind])
    return Rival(others[farthest], float(preferences(losses, x, 0)[1]))


def _homography(pose: Pose, K: Array, x: Array, y: Array, noise: float) -> Array | None:
    """Give H = R + t n' (3, 3) of matches, see above, by the n that fits their inverse depths."""
    rays_x = rays(K, x)
    inverse, sigma = inverse_depths(pose.R, pose.t, rays_x, rays(K, y))
    if not (np.isfinite(inverse) & np.isfinite(sigma) & (sigma > 0)).all():
        return None
    n = np.linalg.lstsq(rays_x / sigma[:, None], inverse / sigma, rcond=None)[0]
    H = np.asarray(pose.R + np.outer(pose.t, n))
    return H if _as_of_a_plane(K @ H @ np.linalg.inv(K), x, y, noise) else None


def second_motion(problem: JetProblem, places: Array, first: Pose, scale: float,
                  least: int) -> SecondMotion | None:
    """
    Look for a motion that most of the matches agree with which stray from the first one.

    problem: all matches, with places (N, 2) in pixels; scale: robust standard deviation of the
    residuals of those that agree; least: how many matches make a motion; a body that has much
    fewer than the first is not looked for, as it is not mistaken for the world. Strays are far
    from their epipolar line, or on its wrong half: a body that moves against the camera along its
    way shares its lines, not their direction. None where strays are few, or agree no better than
    false matches do: those off by a few pixels agree with many a motion, so it takes more than
    half.
    """
    on = refine_all(problem, [first], Loss(), 0)
    first = _in_front(problem, first, np.abs(on.r[0]) < _MEMBER * scale)
    scale = min(max(robust_scale(on.r[0]), scale), 3 * scale)
    off = _distances(problem, replace(on, t=first.t[None]))
    strays = np.flatnonzero(off > _STRAY * scale)
    least = max(least, round(_SMALL_SHARE * (off < _MEMBER * scale).sum()))
    if len(strays) < least:
        return None
    pose = _motion_of(problem.subset(strays), first, scale)
    members = _distances(problem, refine_all(problem, [pose], Loss(), 0)) < _MEMBER * scale
    followers = members[strays].sum()
    if followers < least or followers <= len(strays) / 2:
        return None
    only_first = (off < _MEMBER * scale) & ~members
    only_second = members & (off > _STRAY * scale)
    return SecondMotion(first, pose, members,
                        _area(places[only_second]) / max(_area(places[only_first]), 1e-9),
                        (_flatness(problem.subset(only_first), first),
                         _flatness(problem.subset(only_second), pose)))


def _motion_of(alone: JetProblem, near: Pose, scale: float) -> Pose:
    """Find the motion that most of some matches agree with, from all round another one."""
    rough, tight = (Loss('geman_mcclure', share * scale) for share in (_STRAY, _MEMBER))
    some = alone.subset(thinned(len(alone.blur), _STRAYS))
    found = refine_all(some, around(near, _DIRECTIONS), rough, _STEPS)
    seen = refine_all(alone, found.poses(), tight, 1)
    best = int(losses_in_front(alone, seen, tight).sum(1).argmin())
    refined = refine_all(alone, [seen.pose(best)], tight, _STEPS)
    return _in_front(alone, refined.pose(0), np.abs(refined.r[0]) < _MEMBER * scale)


def carried_along(problem: JetProblem, kept: NDArray[np.bool_], pose: Pose, scale: float,
                  least: int, before: Pose | None = None) -> Pose | None:
    """
    Tell whether matches that keep their pixels are carried along by a camera that moves.

    A bonnet or an arm is where it was in each pair. It agrees with any motion of a camera that
    does not turn, as the sky does, and bends that of the world until it does not turn. So the
    motion of all others is asked. It is the camera's where it is that of a world, as that reaches
    from near to far or goes on as before, and where most of what keeps its pixels strays from it.

    problem: all matches; kept: (N,) bool mask of those; pose: of all, from which it is looked for;
    scale: robust standard deviation of the residuals of those that agree; least: see
    ``second_motion``; before: the motion before this one. Gives the motion of the others, or None.
    """
    least = max(least, round(_SMALL_SHARE * len(kept)))
    if min(kept.sum(), (~kept).sum()) < least:
        return None
    alone = problem.subset(~kept)
    world = _motion_of(alone, pose, scale)
    # What keeps its pixels is seen more exactly than what moves.
    scale = max(core_scale(refine_all(alone, [world], Loss(), 0).r[0]), scale)
    tight = refine_all(alone, [world], Loss('geman_mcclure', _MEMBER * scale), _STEPS)
    world = _in_front(alone, tight.pose(0), np.abs(tight.r[0]) < _MEMBER * scale)
    off = _distances(problem, refine_all(problem, [world], Loss(), 0))
    follow = off[~kept] < _MEMBER * scale
    carried = (off[kept] > _STRAY * scale).sum()
    if follow.mean() <= 0.5 or carried < least or carried <= kept.sum() / 2:
        return None
    deep = _flatness(alone.subset(follow), world) < DEEP
    return world if deep or (before is not None and goes_on(before, world, pose)) else None


def false_alarms(agreeing: int, matches: int, chance: float) -> float:
    """
    Give the logarithm (base 10) of how many motions false matches would bring about.

    chance: probability that a false match agrees with a motion. A motion through 5 of n matches
    that k agree with is expected n - 5 (sizes) . C(n, k) . C(k, 5) . 10 (solutions) . chance^(k-5)
    times by chance alone (a-contrario model of Moisan and Stival, IJCV 2004, for 5 points).
    Below 0 it tells something about the world.
    """
    if agreeing <= 5:
        return float('inf')
    log = (np.log(max(matches - 5, 1) * 10.0) + _log_choose(matches, agreeing)
           + _log_choose(agreeing, 5) + (agreeing - 5) * np.log(min(chance, 1.0)))
    return float(log / np.log(10))


def _log_choose(n: int, k: int) -> float:
    return float(gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1))


def _distances(problem: JetProblem, on: Sketch) -> Array:
    """
    Distances (N,) of matches from their epipolar half-lines, in those of the residuals.

    on: a pose, and how far they are from its lines, whichever the sign of t.
    """
    # Indefinite surfaces that are kept as printed have losses below 0.
    return np.asarray(np.sqrt(np.abs(losses_in_front(problem, on, Loss(), signs=(1.0,))[0])))


def _in_front(problem: JetProblem, pose: Pose, agreeing: NDArray[np.bool_]) -> Pose:
    """Give t the sign that brings more of the points to the front of both cameras."""
    votes = sides(pose.R, pose.t, problem.rays_x.T, problem.rays_y.T)
    return Pose(pose.R, pose.t if votes @ agreeing >= 0 else -pose.t)


def _flatness(problem: JetProblem, pose: Pose) -> float:
    """Distance of a body's near end over that of its far one, NaN where noise hides it."""
    if not len(problem.blur):
        return float('nan')
    noise = robust_scale(refine_all(problem, [pose], Loss(), 0).r[0])
    rho, sigma = inverse_depths(pose.R, pose.t, problem.rays_x.T, problem.rays_y.T)
    # One unit of the residuals, in those of rays, for a match of typical sharpness.
    pixel = np.sqrt(np.median(np.abs(problem.spread[0] + problem.spread[2])) / 2)
    far, near = np.quantile(rho, (_FAR_END, _NEAR_END))
    blurred = near <= 0 or noise * pixel * np.median(sigma) > _BLURRED * near
    return float('nan') if blurred else float(max(far / near, 0.0))


def _area(places: Array) -> float:
    """Area of the ellipse of one standard deviation of places (N, 2), but for a constant."""
    return float(np.sqrt(max(np.linalg.det(np.cov(places.T)), 0.0))) if len(places) > 2 else 0.0
