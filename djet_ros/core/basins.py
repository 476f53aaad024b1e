"""Basins of attraction of the joint optimisation: which starts lead to the right minimum."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from djet_ros.core.covariance import CHI2_999, pose_differences
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.fusion import MeasuredRotation
from djet_ros.core.geometry import fit_rotation, norms
from djet_ros.core.jet import (
    clipped_scale,
    epipolar_residuals,
    JetProblem,
    Loss,
    minimise,
    Residuals,
    Solution,
)
from djet_ros.core.medians import quantile
from djet_ros.core.rivals import (
    preferences,
    PreviousMotion,
    refined_rivals,
    SIGNIFICANT_PREFERENCE,
    unsigned_distance,
)
from djet_ros.core.sketch import (
    costs_in_front,
    losses_at,
    moved_all,
    refine_all,
    RotationPrior,
    Sketch,
)
from djet_ros.core.starts import hemisphere_starts, starts_around, subsampled
from djet_ros.core.types import Array, Pose, Rival
import numpy as np
from numpy.typing import NDArray

# pixels; chosen, far below any noise: on perfect data the scale of the loss must not become zero
MIN_SCALE = 0.02


@dataclass(frozen=True)
class BasinTuning:
    """Constants of the choice; "chosen" is by judgement or trial, not derived."""

    # robust standard deviations; chosen: a second motion in the scene fits many matches loosely,
    # the camera's own fits most of them closely, so a loss with this scale tells basins apart
    tight: float = 1.0
    # chosen: the loss at a start says little of its basin, so all starts make a few steps on some
    # matches
    steps_to_sketch: int = 4
    matches_to_sketch: int = 800
    # chosen: with so few matches all starts are refined, which is cheap; basins are closer there
    few_matches: int = 400
    # chosen: around the predicted motion, on still fewer: most matches are of the static world, or
    # other starts are used
    matches_predicted: int = 200
    # chosen: and steps there, from all directions and then from the cheapest
    steps_predicted: tuple[int, int] = (4, 2)
    # chosen: translation directions on a hemisphere as starts in these cases
    directions: int = 10
    # chosen: and with many matches, which are planar or undecided less often: RANSAC may miss the
    # right basin if the camera moved by a hundredth of the depth
    many_directions: int = 20
    # chosen: number of the cheapest distinct basins that are refined
    refined_starts: int = 3
    # rad; chosen: poses closer than this are in one basin
    same_basin: float = 0.02
    # chosen: steps before costs are compared, by which nearly all converge; after 7 some had not
    # reached the right basin, and were missed
    steps_to_compare: int = 15
    # rad; chosen: standard deviation added to a measured rotation, and its weight in matches
    rotation_slack: float = 2e-4
    rotation_weight: float = 1000.0
    # rad; chosen: standard deviation of a rotation before the optimiser has converged
    rotation_noise: float = 5e-4
    # standard deviations within which a rotation is consistent with the measured one, the usual
    # three
    rotation_gate: float = 3.0
    # chosen: number of basins that are refined without the measured rotation, to see whether they
    # rotate away
    rotation_starts: int = 5
    # standard deviations for normal, independent errors; chosen: start distance to either side
    # from which other minima are sought, beyond what correlated errors displace the right one by
    nearby_distance: float = 20.0
    # chosen: steps from there
    steps_nearby: int = 6
    # squared Mahalanobis distance below which two minima are the same
    same_minimum: float = CHI2_999
    # chosen: columns and rows of parts of the image, with equally many matches each
    parts: tuple[int, int] = (4, 2)
    # chosen: steps from the motion of a part
    steps_of_part: int = 10
    # preference of the first basin over all others for a decision on few of the starts: an error
    # of one in three million, if errors in different cells are independent
    clear_preference: float = 5.0


BASIN_TUNING = BasinTuning()


@dataclass(frozen=True)
class Basin:
    """
    A pose, the scale of the residuals and the residuals there, and the poses of other basins.

    camera_in_minority: whether most matches follow another motion than the camera's.
    """

    pose: Pose
    scale: float
    residuals: Residuals
    camera_in_minority: bool = False
    rivals: tuple[Pose, ...] = ()


def choose_basin(problem: JetProblem, places: Array, starts: list[Pose],
                 config: EstimatorConfig, prior: PreviousMotion | None,
                 measured: MeasuredRotation | None) -> Basin:
    """
    Choose the basin of the camera's motion among starts and a hemisphere of directions.

    places: (N, 2) pixels of the matches; prior: the previous motion, which decides if the matches
    do not; measured: a measured rotation, with which the pose has to be consistent.
    """
    subset = problem.subset(subsampled(len(problem.blur), BASIN_TUNING.matches_to_sketch))
    scale = _noise(refine_all(subset, starts, Loss(), 0))
    tight = _tight_loss(config, scale)
    if measured is not None:
        # The majority of the matches gives the noise, and what fits the measured rotation fits it
        # well.
        scale = _noise(refine_all(subset, starts, tight, BASIN_TUNING.steps_to_sketch))
        tight = _tight_loss(config, scale)
        sketch = refine_all(subset, starts, tight, BASIN_TUNING.steps_to_compare,
                            _rotation_prior(measured, scale))
        starts = _cheapest_basins(subset, sketch, tight, BASIN_TUNING.rotation_starts)
    elif len(problem.blur) > BASIN_TUNING.few_matches:
        starts = [*starts, *hemisphere_starts(starts[0].R, BASIN_TUNING.many_directions)]
        sketch = refine_all(subset, starts, tight, BASIN_TUNING.steps_to_sketch)
        starts = _cheapest_basins(subset, sketch, tight, BASIN_TUNING.refined_starts)
    else:
        starts = [*starts, *hemisphere_starts(starts[0].R, BASIN_TUNING.directions)]
    return _refine_and_choose(problem, places, starts, tight, prior, measured)


def _refine_and_choose(problem: JetProblem, places: Array, starts: list[Pose], tight: Loss,
                       prior: PreviousMotion | None, measured: MeasuredRotation | None = None
                       ) -> Basin:
    """Refine starts on all matches, and choose the one of least cost as in `choose_basin`."""
    refined = refine_all(problem, starts, tight, BASIN_TUNING.steps_to_compare)
    possible, camera_in_minority = np.ones(len(refined), bool), False
    if measured is not None and (consistent := _has_rotation(measured, refined)).any():
        camera_in_minority = not consistent[costs_in_front(problem, refined, tight).argmin()]
        possible = consistent
    basins = _cheapest_basins(problem, refined, tight, BASIN_TUNING.refined_starts, possible)
    best = basins.pop(likeliest(losses_at(problem, basins, tight), places, basins, prior))
    # The noise of the matches does not depend on the motion that they follow.
    residuals = epipolar_residuals(problem, best.R, best.t)
    scale = (min(map(clipped_scale, refined.r)) if camera_in_minority
             else clipped_scale(residuals.r))
    return Basin(best, max(scale, MIN_SCALE), residuals, camera_in_minority, tuple(basins))


def choose_predicted_basin(problem: JetProblem, places: Array, predicted: PreviousMotion,
                           config: EstimatorConfig) -> Basin:
    """
    Choose among the basins around the predicted motion: its own, and a hemisphere of directions.

    predicted: t is zeros if its direction is unknown. A subset of the matches finds the basins,
    and all matches choose. If they do not clearly prefer one, also after the others have
    converged, basins are sought from all starts again, as some may lead to the same minimum; if
    that does not help, they are refined on all matches. If a rotation alone explains the matches,
    the choice does not matter.
    """
    subset = problem.subset(subsampled(len(problem.blur), BASIN_TUNING.matches_predicted))
    tight = Loss()
    basins = starts = [*starts_around(predicted, BASIN_TUNING.directions), *predicted.undecided]
    for steps in (0, *BASIN_TUNING.steps_predicted):
        refined = refine_all(subset, basins, tight, steps)
        tight = _tight_loss(config, _noise(refined))
        if steps:
            basins = _cheapest_basins(subset, refined, tight, BASIN_TUNING.refined_starts)
    if _is_pure_rotation(problem, config.min_parallax):
        return basin_of(problem, basins[0])
    if len(basins) > 1 and _is_clear(problem, places, basins, tight):
        # Before the others have converged, they cost more than they should.
        refined = refine_all(subset, basins, tight, BASIN_TUNING.steps_to_compare)
        basins = _cheapest_basins(subset, refined, tight, BASIN_TUNING.refined_starts)
        if _is_clear(problem, places, basins, tight):
            return basin_of(problem, basins[0])
    # Include all starts again: the cheapest so far may all be of one valley.
    refined = refine_all(subset, [*basins, *starts], tight, BASIN_TUNING.steps_to_compare)
    basins = _cheapest_basins(subset, refined, tight, BASIN_TUNING.refined_starts)
    if _is_clear(problem, places, basins, tight):
        return basin_of(problem, basins[0])
    prior = predicted if predicted.t.any() else None
    return _refine_and_choose(problem, places, basins, tight, prior)


def _noise(sketch: Sketch) -> float:
    """Return the robust standard deviation of the residuals at the pose that fits best."""
    return max(float(sketch.scales().min()), MIN_SCALE)


def _tight_loss(config: EstimatorConfig, noise: float) -> Loss:
    """Return the loss that tells basins apart, for residuals of some noise."""
    return Loss(config.loss, min(config.loss_scale, BASIN_TUNING.tight) * noise)


def _is_clear(problem: JetProblem, places: Array, basins: list[Pose], loss: Loss) -> bool:
    """Return whether matches clearly prefer the first of some basins to the others."""
    preferred = preferences(losses_at(problem, basins, loss), places, 0)
    return bool((preferred[1:] >= BASIN_TUNING.clear_preference).all())


def _is_pure_rotation(problem: JetProblem, parallax: float) -> bool:
    """Return whether a rotation alone brings three quarters of the matches close to y."""
    rays_x, rays_y = problem.rays_x.T, problem.rays_y.T
    rotated = rays_x @ fit_rotation(rays_x, rays_y).T
    offsets = norms(rotated[:, :2] / rotated[:, 2:] - rays_y[:, :2])
    return bool(quantile(offsets, 0.75) < parallax * problem.pixel)


def basin_of(problem: JetProblem, pose: Pose) -> Basin:
    """Return the basin of a single pose, without rivals."""
    residuals = epipolar_residuals(problem, pose.R, pose.t)
    return Basin(pose, max(clipped_scale(residuals.r), MIN_SCALE), residuals)


def choose_among_rivals(problem: JetProblem, places: Array, solution: Solution,
                        rivals: Sequence[Pose], loss: Loss, prior: PreviousMotion | None
                        ) -> tuple[Solution, tuple[Rival, ...]]:
    """Choose the likeliest of a solution and its rivals, with its preferences over the others."""
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
        if unsigned_distance(poses[best], pose) > BASIN_TUNING.same_basin)


def lowest_nearby_minimum(problem: JetProblem, places: Array, solution: Solution, loss: Loss
                          ) -> tuple[Solution, tuple[Rival, ...]]:
    """
    Return the lowest of the minima near a solution, and the others as its rivals.

    A redescending loss has a minimum for each group of matches that a pose takes for inliers. If
    few matches determine a direction, several lie side by side along it, within what is one basin
    elsewhere. So a subset of the matches is refined from either side along the two least
    determined directions, which nearly always leads back to the same minimum; the other ones are
    refined on all matches.
    """
    information = _information(solution.residuals, loss)
    if not np.isfinite(information).all():
        return solution, ()
    eigenvalues, axes = np.linalg.eigh(information)
    if eigenvalues[0] <= 1e-12 * eigenvalues[-1]:
        return solution, ()
    steps = (axes[:, :2] * BASIN_TUNING.nearby_distance / np.sqrt(eigenvalues[:2])).T
    starts = map(Pose, *moved_all(solution.R, solution.t, solution.residuals.tangents,
                                  np.concatenate([steps, -steps])))
    subset = problem.subset(subsampled(len(problem.blur), BASIN_TUNING.few_matches))
    refined = refine_all(subset, [solution.pose, *starts], loss, BASIN_TUNING.steps_nearby).poses()
    bound = BASIN_TUNING.same_minimum * len(problem.blur) / len(subset.blur)
    distinct = _distinct(refined, solution, information, bound)[1:]
    if not distinct:
        return solution, ()
    minima = [solution, *(minimise(problem, refined[index].R, refined[index].t, loss)
                          for index in distinct)]
    minima = [minima[index] for index in _distinct(
        [minimum.pose for minimum in minima], solution, information, BASIN_TUNING.same_minimum)]
    if len(minima) == 1:
        return solution, ()
    poses = [minimum.pose for minimum in minima]
    losses = losses_at(problem, poses, loss)
    best = int(losses.sum(1).argmin())
    preferred = preferences(losses, places, best)
    return minima[best], tuple(Rival(pose, float(preference)) for index, (pose, preference)
                               in enumerate(zip(poses, preferred)) if index != best)


def better_by_parts(problem: JetProblem, places: Array, pose: Pose, config: EstimatorConfig
                    ) -> Pose | None:
    """
    Return a pose that matches clearly prefer to a given one, found by a part of the image alone.

    If a body moves nearly as the camera does, one pose may fit both loosely, and starts from all
    matches lead to it. But a body covers one region: in most parts of the image, matches follow
    one motion only. places: (N, 2) pixels of the matches.
    """
    found = [pose, *(_motion_of(problem.subset(part), pose, config) for part in _parts(places))]
    tight = _tight_loss(config, _noise(refine_all(problem, found, Loss(), 0)))
    refined = refine_all(problem, found, tight, BASIN_TUNING.steps_to_compare)
    best = refined.pose(int(costs_in_front(problem, refined, tight).argmin()))
    preferred = preferences(losses_at(problem, [pose, best], tight), places, 1)[0]
    return best if preferred >= SIGNIFICANT_PREFERENCE else None


def _parts(places: Array) -> Iterator[NDArray[np.int64]]:
    """Return the indices of places (N, 2) in each part of the image."""
    columns, rows = BASIN_TUNING.parts
    for column in np.array_split(places[:, 0].argsort(kind='stable'), columns):
        yield from np.array_split(column[places[column, 1].argsort(kind='stable')], rows)


def _motion_of(part: JetProblem, pose: Pose, config: EstimatorConfig) -> Pose:
    """Return the motion of some matches alone, from that of all."""
    start = basin_of(part, pose)
    return minimise(part, pose.R, pose.t, _tight_loss(config, start.scale),
                    BASIN_TUNING.steps_of_part, start.residuals).pose


def _distinct(poses: Sequence[Pose], solution: Solution, information: Array, bound: float
              ) -> list[int]:
    """
    Return the indices of the poses that are farther than a bound from all kept before them.

    information: (5, 5) in the parameters of the solution, for the squared distances.
    """
    offsets = pose_differences(solution.R, solution.t, np.array([pose.R for pose in poses]),
                               np.array([pose.t for pose in poses]))
    kept: list[int] = []
    for index in range(len(poses)):
        if (_squared_distances(offsets[kept] - offsets[index], information) > bound).all():
            kept.append(index)
    return kept


def likeliest(losses: Array, places: Array, poses: Sequence[Pose],
              prior: PreviousMotion | None) -> int:
    """
    Return which of S poses costs least, or the nearest to the prior of those undecided.

    Unless the prior, which may be in the wrong basin itself, leaves that open.

    losses: (S, N) of the matches at the poses; places: (N, 2) their pixels.
    """
    best = int(losses.sum(1).argmin())
    if prior is None:
        return best
    undecided = preferences(losses, places, best) < SIGNIFICANT_PREFERENCE
    nearest = min(np.flatnonzero(undecided).tolist(),
                  key=lambda index: unsigned_distance(prior, poses[index]))
    return best if prior.leaves_open(poses[nearest], poses[best]) else nearest


def _has_rotation(measured: MeasuredRotation, sketch: Sketch) -> NDArray[np.bool_]:
    """
    Return the (S,) bool mask of poses whose rotation is consistent with the measured one.

    The motion of an object that fills the image is also found under the measured rotation, with a
    translation that compensates for the difference; refined without it, its rotation drifts away.
    """
    offsets = measured.correction(sketch.R)
    allowed = measured.covariance + BASIN_TUNING.rotation_noise**2 * np.eye(3)
    squared = (offsets * np.linalg.solve(allowed, offsets.T).T).sum(1)
    return np.asarray(squared < BASIN_TUNING.rotation_gate**2)


def _rotation_prior(measured: MeasuredRotation | None, scale: float) -> RotationPrior | None:
    """
    Return a prior that draws rotations to the measured one while a basin is chosen.

    The matches of a large moving object outweigh the rest of the scene, unless a measured rotation
    weighs more than all of them. In the final optimisation the matches decide alone.
    """
    if measured is None:
        return None
    variance = measured.covariance + BASIN_TUNING.rotation_slack**2 * np.eye(3)
    weight = BASIN_TUNING.rotation_weight * scale**2 * np.linalg.inv(variance)
    return RotationPrior(measured.R, np.asarray(weight))


def _cheapest_basins(problem: JetProblem, sketch: Sketch, loss: Loss, most: int,
                     possible: NDArray[np.bool_] | None = None) -> list[Pose]:
    """Return the cheapest poses of distinct basins, up to a maximum number."""
    chosen: list[int] = []
    R = sketch.R.reshape(-1, 9)
    # Squares of `unsigned_distance`, for all pairs at once.
    near = 5 - R @ R.T - 2 * np.abs(sketch.t @ sketch.t.T) <= BASIN_TUNING.same_basin**2
    excluded = np.zeros(len(sketch), bool) if possible is None else ~possible
    for index in costs_in_front(problem, sketch, loss).argsort(kind='stable').tolist():
        if excluded[index]:
            continue
        chosen.append(index)
        excluded |= near[index]
        if len(chosen) == most or excluded.all():
            break
        # A valley holds several poses that matches do not distinguish.
        information = _information(
            epipolar_residuals(problem, sketch.R[index], sketch.t[index]), loss)
        offsets = pose_differences(sketch.R[index], sketch.t[index], sketch.R, sketch.t)
        squared = _squared_distances(offsets, information)
        excluded |= squared <= BASIN_TUNING.same_minimum
    return [sketch.pose(index) for index in chosen]


def _information(residuals: Residuals, loss: Loss) -> Array:
    """Return the information (5, 5) about a pose, for normal and independent errors."""
    J, squared = residuals.jacobian, residuals.r**2
    _, weights = loss(squared)
    noise = max(float((weights * squared).sum() / weights.sum()), MIN_SCALE**2)
    return np.asarray((J * weights) @ J.T / noise)


def _squared_distances(offsets: Array, information: Array) -> Array:
    """Return the squared lengths (S,) of differences (S, 5), by the information (5, 5)."""
    return np.asarray((offsets @ information * offsets).sum(1))
