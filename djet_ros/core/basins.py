"""Basins of the joint optimisation: which starting pose leads to the right one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from djet_ros.core.covariance import differences, SURPRISING
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.fusion import Turn
from djet_ros.core.geometry import fit_rotation
from djet_ros.core.jet import (
    core_scale,
    epipolar_residuals,
    JetProblem,
    Loss,
    minimise,
    Residuals,
    Solution,
)
from djet_ros.core.paraboloid import median, quantile
from djet_ros.core.rivals import apart, DECIDED, preferences, refined_rivals, Rival
from djet_ros.core.sketch import (
    costs_in_front,
    Held,
    losses_at,
    moved_all,
    refine_all,
    Sketch,
)
from djet_ros.core.starts import all_round, around, thinned
from djet_ros.core.types import Array, Pose
import numpy as np
from numpy.typing import NDArray

# pixels; chosen, far below any noise: perfect data must not shrink the loss to nothing
LEAST_SCALE = 0.02


@dataclass(frozen=True)
class BasinTuning:
    """Constants of the choice, each with where it comes from ("chosen" was not searched)."""

    # robust standard deviations; chosen: a second motion in the scene fits many matches loosely,
    # the camera's own fits most of them closely, so a loss that bends here tells basins apart
    tight: float = 1.0
    # chosen: where a start lies says little of its basin, so all make a few steps on some matches
    steps_to_sketch: int = 4
    matches_to_sketch: int = 800
    # chosen: it costs little to refine all starts on so few, and there basins lie closer
    few_matches: int = 400
    # chosen: around the motion ahead, on still fewer: most are of the world, or others are asked
    matches_ahead: int = 200
    # chosen: and steps on the way there, from all directions and then from the cheapest
    steps_ahead: tuple[int, int] = (4, 2)
    # chosen: directions all round from which basins are looked for then, and around the motion
    # before
    directions: int = 10
    # chosen: and by many matches, which lie in a plane or are in doubt less often: RANSAC may miss
    # the right one where the camera went a hundredth of the distance
    directions_of_many: int = 20
    # chosen: the cheapest that lie in different basins are refined
    refined_starts: int = 3
    # rad; chosen: poses nearer than this lie in one basin
    same_basin: float = 0.02
    # chosen: steps before costs are compared, by which nearly all rest; after 7 some had not yet
    # come to the right basin, and were passed over
    steps_to_compare: int = 15
    # rad; chosen: what a rotation that was measured is not trusted with, and for how many matches'
    # worth of surprise it counts
    turn_slack: float = 2e-4
    turn_weight: float = 1000.0
    # rad; chosen: standard deviation of a rotation that is not yet refined to the end
    turn_fits: float = 5e-4
    # standard deviations, the usual three, within which a rotation is the measured one
    agreeing: float = 3.0
    # chosen: basins that are left to themselves to see whether they turn away
    turned_starts: int = 5
    # standard deviations that normal, independent errors would have; chosen: from so far on either
    # side other minima are looked for, beyond what errors alike let the right one be away
    beside: float = 20.0
    # chosen: steps from there
    steps_beside: int = 6
    # squared distance: what is nearer is the same minimum
    same_minimum: float = SURPRISING
    # standard deviations by which matches prefer the basin ahead to all others: one wrong of three
    # millions
    clear: float = 5.0


BASIN_TUNING = BasinTuning()


@dataclass(frozen=True)
class Basin:
    """
    A pose, the scale of the residuals there, these themselves, and the poses of other basins.

    others_move: whether most matches tell another motion.
    """

    pose: Pose
    scale: float
    residuals: Residuals
    others_move: bool = False
    rivals: tuple[Pose, ...] = ()


def right_basin(problem: JetProblem, places: Array, starts: list[Pose],
                config: EstimatorConfig, prior: Pose | None, turn: Turn | None) -> Basin:
    """
    Choose among starts, and directions all round, by what they come to.

    places: (N, 2) pixels of the matches; prior: the motion before, which decides where the matches
    do not; turn: a rotation that was measured, which all of them have to have.
    """
    some = problem.subset(thinned(len(problem.blur), BASIN_TUNING.matches_to_sketch))
    scale = max(refine_all(some, starts, Loss(), 0).scales().min(), LEAST_SCALE)
    tight = Loss(config.loss, min(config.loss_scale, BASIN_TUNING.tight) * scale)
    if turn is not None:
        # Whatever moves as most matches do tells their noise, and what fits the turn fits it well.
        scale = max(refine_all(some, starts, tight, BASIN_TUNING.steps_to_sketch).scales().min(),
                    LEAST_SCALE)
        tight = replace(tight, scale=min(config.loss_scale, BASIN_TUNING.tight) * scale)
        starts = _promising(some, refine_all(some, starts, tight, BASIN_TUNING.steps_to_compare,
                                             _held(turn, scale)), tight,
                            BASIN_TUNING.turned_starts)
    elif len(problem.blur) > BASIN_TUNING.few_matches:
        starts = [*starts, *all_round(starts[0].R, BASIN_TUNING.directions_of_many)]
        starts = _promising(some, refine_all(some, starts, tight, BASIN_TUNING.steps_to_sketch),
                            tight, BASIN_TUNING.refined_starts)
    else:
        starts = [*starts, *all_round(starts[0].R, BASIN_TUNING.directions)]
    return _likeliest_basin(problem, places, starts, tight, prior, turn)


def _likeliest_basin(problem: JetProblem, places: Array, starts: list[Pose], tight: Loss,
                     prior: Pose | None, turn: Turn | None = None) -> Basin:
    """Refine starts on all matches, and take the one that comes to the least, as right_basin."""
    refined = refine_all(problem, starts, tight, BASIN_TUNING.steps_to_compare)
    possible, others_move = np.ones(len(refined), bool), False
    if turn is not None and (turned_so := _turned_so(turn, refined)).any():
        others_move = not turned_so[costs_in_front(problem, refined, tight).argmin()]
        possible = turned_so
    basins = _promising(problem, refined, tight, BASIN_TUNING.refined_starts, possible)
    best = basins.pop(likeliest(losses_at(problem, basins, tight), places, basins, prior))
    # All matches are placed equally well, whatever they move with.
    residuals = epipolar_residuals(problem, best.R, best.t)
    scale = min(map(core_scale, refined.r)) if others_move else core_scale(residuals.r)
    return Basin(best, max(scale, LEAST_SCALE), residuals, others_move, tuple(basins))


def basin_ahead(problem: JetProblem, places: Array, ahead: Pose,
                config: EstimatorConfig) -> Basin:
    """
    Choose among the basins around the motion before: its own, and of directions all round.

    ahead: t zeros where its direction is not known. Some matches lead to the basins, and all
    choose. Where these are not clearly for one, basins are led to until they rest, for some may
    have been on the way to one and the same; where that does not help, all matches lead them on.
    Where a turn alone explains the matches, none of that matters.
    """
    some = problem.subset(thinned(len(problem.blur), BASIN_TUNING.matches_ahead))
    tight = Loss()
    basins = starts = around(ahead, BASIN_TUNING.directions)
    for steps in (0, *BASIN_TUNING.steps_ahead):
        found = refine_all(some, basins, tight, steps)
        scale = max(found.scales().min(), LEAST_SCALE)
        tight = Loss(config.loss, min(config.loss_scale, BASIN_TUNING.tight) * scale)
        if steps:
            basins = _promising(some, found, tight, BASIN_TUNING.refined_starts)
    if ((len(basins) > 1 and _is_clear(problem, places, basins, tight))
            or _mere_turn(problem, config.min_parallax)):
        return basin_of(problem, basins[0])
    # All of them again: those that cost least so far may be, or all have been, of one valley.
    found = refine_all(some, [*basins, *starts], tight, BASIN_TUNING.steps_to_compare)
    basins = _promising(some, found, tight, BASIN_TUNING.refined_starts)
    if _is_clear(problem, places, basins, tight):
        return basin_of(problem, basins[0])
    return _likeliest_basin(problem, places, basins, tight, ahead if ahead.t.any() else None)


def _is_clear(problem: JetProblem, places: Array, basins: list[Pose], loss: Loss) -> bool:
    """Tell whether matches clearly prefer the first of some basins to the others."""
    preferred = preferences(losses_at(problem, basins, loss), places, 0)
    return bool((preferred[1:] >= BASIN_TUNING.clear).all())


def _mere_turn(problem: JetProblem, parallax: float) -> bool:
    """Tell whether a turn alone brings three quarters of the matches to within some pixels."""
    rays_x, rays_y = problem.rays_x.T, problem.rays_y.T
    turned = rays_x @ fit_rotation(rays_x, rays_y).T
    off = np.linalg.norm(turned[:, :2] / turned[:, 2:] - rays_y[:, :2], axis=1)
    # A typical residual surface is of a pixel.
    pixel = np.sqrt(median(np.abs(problem.spread[0] + problem.spread[2])) / 2)
    return bool(quantile(off, 0.75) < parallax * pixel)


def basin_of(problem: JetProblem, pose: Pose) -> Basin:
    """Give the basin of a pose that has no rival."""
    residuals = epipolar_residuals(problem, pose.R, pose.t)
    return Basin(pose, max(core_scale(residuals.r), LEAST_SCALE), residuals)


def judged(problem: JetProblem, places: Array, solution: Solution, rivals: Sequence[Pose],
           loss: Loss, prior: Pose | None) -> tuple[Solution, tuple[Rival, ...]]:
    """Take the likeliest of a solution and its rivals, and tell how much it is preferred."""
    poses = [solution.pose, *refined_rivals(problem, rivals, loss)]
    losses = losses_at(problem, poses, loss)
    best = likeliest(losses, places, poses, prior)
    if best != 0:
        solution = minimise(problem, poses[best].R, poses[best].t, loss)
        poses[best] = solution.pose
        losses[best] = losses_at(problem, [solution.pose], loss)[0]
    preferred = preferences(losses, places, best)
    return solution, tuple(
        Rival(pose, float(preference)) for pose, preference in zip(poses, preferred)
        if apart(poses[best], pose) > BASIN_TUNING.same_basin)


def lowest_around(problem: JetProblem, places: Array, solution: Solution, loss: Loss
                  ) -> tuple[Solution, tuple[Rival, ...]]:
    """
    Take the lowest of the minima that lie beside a solution, and give the others as its rivals.

    A loss that redescends has one for each group of matches that a pose takes for right. Where few
    decide about a direction, these lie side by side along it, within what is one basin elsewhere.
    So some matches are led back from either side along the two directions that are told least, to
    the minimum that they were at, but for few; the others are refined on all.
    """
    information = _information(solution.residuals, loss)
    if not np.isfinite(information).all():
        return solution, ()
    told, axes = np.linalg.eigh(information)
    if told[0] <= 1e-12 * told[-1]:
        return solution, ()
    steps = (axes[:, :2] * BASIN_TUNING.beside / np.sqrt(told[:2])).T
    starts = map(Pose, *moved_all(solution.R, solution.t, solution.residuals.tangents,
                                  np.concatenate([steps, -steps])))
    some = problem.subset(thinned(len(problem.blur), BASIN_TUNING.few_matches))
    led = refine_all(some, [solution.pose, *starts], loss, BASIN_TUNING.steps_beside).poses()
    bound = BASIN_TUNING.same_minimum * len(problem.blur) / len(some.blur)
    others = _unlike(led, solution, information, bound)[1:]
    minima = [solution, *(minimise(problem, led[number].R, led[number].t, loss)
                          for number in others)]
    minima = [minima[number] for number in _unlike(
        [minimum.pose for minimum in minima], solution, information, BASIN_TUNING.same_minimum)]
    if len(minima) == 1:
        return solution, ()
    poses = [minimum.pose for minimum in minima]
    losses = losses_at(problem, poses, loss)
    best = int(losses.sum(1).argmin())
    preferred = preferences(losses, places, best)
    return minima[best], tuple(Rival(pose, float(preference)) for number, (pose, preference)
                               in enumerate(zip(poses, preferred)) if number != best)


def _unlike(poses: Sequence[Pose], solution: Solution, information: Array, bound: float
            ) -> list[int]:
    """
    Find the numbers of poses that are farther from all before them than a bound has it.

    information: (5, 5) in the parameters of the solution, by which squared distances are taken.
    """
    off = differences(solution.R, solution.t, np.array([pose.R for pose in poses]),
                      np.array([pose.t for pose in poses]))
    kept: list[int] = []
    for number in range(len(poses)):
        if (_squared(off[kept] - off[number], information) > bound).all():
            kept.append(number)
    return kept


def likeliest(losses: Array, places: Array, poses: Sequence[Pose], prior: Pose | None) -> int:
    """
    Which of S poses costs least, or, of those undecided between, is next to the prior.

    losses: (S, N) of the matches there; places: (N, 2) their pixels.
    """
    best = int(losses.sum(1).argmin())
    if prior is None:
        return best
    undecided = preferences(losses, places, best) < DECIDED
    return min(np.flatnonzero(undecided).tolist(), key=lambda number: apart(prior, poses[number]))


def _turned_so(turn: Turn, sketch: Sketch) -> NDArray[np.bool_]:
    """
    (S,) bool mask of the poses whose rotation is the measured one, within what both are good for.

    The motion of something that fills the image is found under the measured rotation too, by a
    direction that makes up for the difference; left to itself it turns away.
    """
    off = turn.off(sketch.R)
    allowed = turn.covariance + BASIN_TUNING.turn_fits**2 * np.eye(3)
    return np.asarray((off * np.linalg.solve(allowed, off.T).T).sum(1) < BASIN_TUNING.agreeing**2)


def _held(turn: Turn | None, scale: float) -> Held | None:
    """
    Draw rotations to the one that was measured, while a basin is chosen.

    The matches of something large that moves by itself outweigh what is left of the scene, unless
    a measured rotation counts for more than all of them. In the end the matches decide alone.
    """
    if turn is None:
        return None
    variance = turn.covariance + BASIN_TUNING.turn_slack**2 * np.eye(3)
    return Held(turn.R, np.asarray(BASIN_TUNING.turn_weight * scale**2 * np.linalg.inv(variance)))


def _promising(problem: JetProblem, sketch: Sketch, loss: Loss, most: int,
               possible: NDArray[np.bool_] | None = None) -> list[Pose]:
    """Choose the cheapest poses that lie in different basins, up to a number of them."""
    chosen: list[int] = []
    R = sketch.R.reshape(-1, 9)
    # Squares of what `apart` gives, of all at once.
    near = 5 - R @ R.T - 2 * np.abs(sketch.t @ sketch.t.T) <= BASIN_TUNING.same_basin**2
    passed = np.zeros(len(sketch), bool) if possible is None else ~possible
    for number in costs_in_front(problem, sketch, loss).argsort(kind='stable').tolist():
        if passed[number]:
            continue
        chosen.append(number)
        if len(chosen) == most:
            break
        # A valley has room for several that matches do not tell from one another.
        information = _information(
            epipolar_residuals(problem, sketch.R[number], sketch.t[number]), loss)
        off = differences(sketch.R[number], sketch.t[number], sketch.R, sketch.t)
        passed |= near[number] | (_squared(off, information) <= BASIN_TUNING.same_minimum)
    return [sketch.pose(number) for number in chosen]


def _information(residuals: Residuals, loss: Loss) -> Array:
    """Information (5, 5) of matches about a pose, were their errors normal and independent."""
    J, squared = residuals.jacobian, residuals.r**2
    _, weights = loss(squared)
    noise = max(float((weights * squared).sum() / weights.sum()), LEAST_SCALE**2)
    return np.asarray((J * weights) @ J.T / noise)


def _squared(off: Array, information: Array) -> Array:
    """Squared lengths (S,) of differences (S, 5), by the information (5, 5) about a pose."""
    return np.asarray((off @ information * off).sum(1))
