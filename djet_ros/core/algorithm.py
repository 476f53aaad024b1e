"""
Algorithm 1 of the paper: alternate between residual surfaces and pose until the pose converges.

`Algorithm` runs it from one starting pose or from several; `core.tracking` compares the results of
several runs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

from djet_ros.core.basins import (
    basin_of,
    choose_among_rivals,
    choose_basin,
    choose_predicted_basin,
    lowest_nearby_minimum,
    MIN_SCALE,
)
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.geometry import (
    depth_ratio,
    epipolar_lines,
    fundamental,
    inverse_depths,
    line_values,
    norms,
    patch_warp,
    rays,
    slant_warp,
)
from djet_ros.core.jet import (
    clipped_scale,
    epipolar_residuals,
    jet_problem,
    JetProblem,
    Loss,
    MAX_STEPS,
    minimise,
    Residuals,
    Solution,
)
from djet_ros.core.joining import fuse_alignment
from djet_ros.core.pair import Pair, Round
from djet_ros.core.paraboloid import constrained_minimum, Paraboloids
from djet_ros.core.patches import Aligned, unaligned
from djet_ros.core.rivals import (
    INLIER,
    pose_distance,
    PreviousMotion,
    refined_rivals,
    unsigned_distance,
)
from djet_ros.core.sketch import losses_in_front, refine_all
from djet_ros.core.slants import slopes_of_all
from djet_ros.core.surfaces import (
    has_moderate_stretch,
    ReprojectionSurface,
    ResidualSurface,
    resolve_indefinite,
)
from djet_ros.core.types import Array, Pose, Rival
import numpy as np
from numpy.typing import NDArray


# Loss scales; chosen: if most matches follow another motion, matches beyond this are removed,
# where they have next to no weight anyway.
_CULL_FACTOR = 2.0

# chosen: optimiser steps in a first round on matched points, whose pose only places the surfaces.
_FIRST_ROUND_STEPS = 2

# Pixels; chosen: noise of inliers when planes are fitted to their depths.
_DEPTH_NOISE = 0.1


@dataclass(frozen=True)
class Track:
    """
    The result of Algorithm 1.

    pose; problem: the final least-squares problem of the voting matches; loss: its robust loss;
    residuals: those at the pose; voting: (N,) bool, matches that took part; placed:
    photometrically aligned y (N, 2) under the last warp, or y itself without alignment; minima:
    (N, 2) minima y* of the surfaces, combined with `placed` for voting matches; y_opt: (N, 2) the
    final step onto the epipolar line; losses: (N,) last known surface values; indefinite: number
    of surfaces without a minimum in the last round; surface_noise: robust standard deviation of
    the residuals of the surfaces alone, without photometric alignment, in pixels; rounds: the
    rounds that were made; rivals: other motions that explain the voting matches; nearby: other
    minima in the basin of the pose.

    Set by ``core.tracking``: body_ambiguous: whether two bodies move and nothing decides which of
    them is the static world (the other motion is the rival); attached: (N,) bool, matches on what
    moves with the camera, which the pose still includes, None if there are none; left_out: (N,)
    bool, matches of another body, which the pose does not include, None if there are none.
    """

    pose: Pose
    problem: JetProblem
    loss: Loss
    residuals: Residuals
    voting: NDArray[np.bool_]
    minima: Array
    placed: Aligned
    y_opt: Array
    losses: Array
    indefinite: int
    surface_noise: float
    rounds: tuple[Round, ...] = ()
    rivals: tuple[Rival, ...] = ()
    nearby: tuple[Rival, ...] = ()
    body_ambiguous: bool = False
    attached: NDArray[np.bool_] | None = None
    left_out: NDArray[np.bool_] | None = None

    @property
    def iterations(self) -> int:
        """Return the number of rounds."""
        return len(self.rounds)

    @cached_property
    def scale(self) -> float:
        """Return the robust standard deviation of the residuals, in pixels."""
        return _scale(self.residuals.r)

    def inliers(self) -> NDArray[np.bool_]:
        """Return the (N,) bool mask of voting matches within the inlier threshold of the pose."""
        agree = np.abs(self.residuals.r) < INLIER * self.scale
        inliers = self.voting.copy()
        inliers[inliers] = agree
        return inliers


@dataclass(frozen=True)
class OptimisedPose:
    """
    Step 2 of a round: the least-squares problem of the M voting matches, and its solution.

    voting: (N,) bool; x: (M, 2) their pixels in the previous image; converged: whether the pose
    moved by less than epsilon; rivals: poses of other basins.
    """

    voting: NDArray[np.bool_]
    x: Array
    problem: JetProblem
    loss: Loss
    solution: Solution
    converged: bool
    rivals: tuple[Pose, ...]

    @cached_property
    def basins(self) -> list[Pose]:
        """Poses of all basins, its own first, each at its own minimum."""
        return [self.solution.pose, *refined_rivals(self.problem, self.rivals, self.loss)]

    def chirality_losses(self) -> Array:
        """Return the losses (S, M) of matches for chirality alone, at the poses of all basins."""
        lines = refine_all(self.problem, self.basins, self.loss, 0)
        on_lines = lines.sign * self.loss(lines.r**2)[0]
        return losses_in_front(self.problem, lines, self.loss) - on_lines

    def nearest(self, pose: Pose) -> int:
        """Return the index of the basin whose pose is nearest to a pose."""
        return int(np.argmin([unsigned_distance(basin, pose) for basin in self.basins]))


class Algorithm:
    """
    Algorithm 1 of the paper on the matches (N,) of a pair.

    alive: (N,) bool, the matches to use, all if None; first: step 2 of the first round, once it
    was made.
    """

    first: OptimisedPose

    def __init__(self, pair: Pair, surface: ResidualSurface, config: EstimatorConfig,
                 alive: NDArray[np.bool_] | None = None) -> None:
        self.pair, self.surface, self.config = pair, surface, config
        self._K, count = pair.current.K, len(pair.y)
        self._keypoints, self._losses = pair.y.copy(), np.full(count, np.nan)
        self._alive = np.ones(count, bool) if alive is None else alive
        self._plausible, self._on_motion = np.ones(count, bool), np.ones(count, bool)
        self._warp: Array | None = None

    def rerun(self, start: Pose, predicted: PreviousMotion | None = None,
              alive: NDArray[np.bool_] | None = None) -> Track | None:
        """Run the algorithm afresh from a single pose, on the matches in a mask (N,) or all."""
        return Algorithm(self.pair, self.surface, self.config, alive).run([start], predicted)

    def run(self, starts: list[Pose], predicted: PreviousMotion | None = None) -> Track | None:
        """
        Make rounds until the pose converges; None if too few matches have a surface.

        starts: poses among whose basins the first round chooses; if there are none, it chooses
        among those around the predicted motion.
        """
        poses, rounds = starts, list[Round]()
        # If the matches were predicted and tracked, their pose is accurate enough to sample
        # surfaces only once: around their places on its epipolar lines, under its patch warps.
        # The first round then uses re-projection errors.
        by_points = predicted is not None and self.config.max_iterations > 1
        while True:
            # Step 1: update the local residuals around the keypoints: A', b, c.
            fits, paraboloids, indefinite = self._fitted(by_points)
            voting = self._voting(paraboloids)
            if voting.sum() < self.config.min_matches:
                return None
            # Step 2: global pose optimisation.
            optimised = self._optimised(paraboloids, voting, poses, predicted, by_points)
            if not rounds:
                self.first = optimised
            if ((optimised.converged and self._is_warped)
                    or len(rounds) + 1 == self.config.max_iterations):
                break
            pose = optimised.solution.pose
            # Keypoints move towards their optimum on the epipolar line of the new pose.
            rounds.append(self._round(fits, paraboloids, pose))
            self._advance(pose, rounds[-1].optimum)
            poses, by_points = [pose], False
        surface_noise = _scale(optimised.solution.residuals.r)
        optimised, placed = self._with_alignment(optimised)
        optimised, rivals, nearby = self._at_best_minimum(optimised)
        rounds.append(self._round(fits, paraboloids, optimised.solution.pose))
        minima = paraboloids.minima()
        minima[voting] = (self._K @ optimised.problem.rays_y)[:2].T
        solution = optimised.solution
        return Track(solution.pose, optimised.problem, optimised.loss, solution.residuals, voting,
                     minima, placed, rounds[-1].optimum, self._losses, indefinite, surface_noise,
                     tuple(rounds), rivals, nearby)

    @property
    def _is_warped(self) -> bool:
        """Return whether the surfaces are sampled under warps, if these are in use."""
        return (self._warp is not None or not self.config.warp_reference
                or self.config.method == 'rpe')

    def _fitted(self, by_points: bool) -> tuple[Paraboloids, Paraboloids, int]:
        """
        Fit surfaces around the keypoints, or paraboloids of re-projection errors.

        Returns the fits, the same with indefinite ones treated, and the number of these.
        """
        if by_points:
            fits = ReprojectionSurface(self.surface.x, self.pair.y).fit_around(self._keypoints)
            return fits, fits, 0  # they always have a minimum
        fits = self.surface.fit_around(self._keypoints, self._warp)
        return fits, *resolve_indefinite(fits, self.config.indefinite)

    def _voting(self, paraboloids: Paraboloids) -> NDArray[np.bool_]:
        """
        Return which matches (N,) take part in the pose.

        Match culling: a keypoint without a surface is dropped, and keeps its last loss.
        """
        self._alive = self._alive & paraboloids.usable
        # Far from the sampled pixels a minimum is extrapolated.
        within = (paraboloids.minimum_within(self.config.window // 2)
                  | (not self.config.cull_outside))
        return np.asarray(self._alive & self._plausible & self._on_motion & within)

    def _optimised(self, paraboloids: Paraboloids, voting: NDArray[np.bool_], poses: list[Pose],
                   predicted: PreviousMotion | None, by_points: bool) -> OptimisedPose:
        """Choose a basin among the starting poses and optimise the pose in it."""
        config, x = self.config, self.surface.x.compress(voting, axis=0)
        problem = jet_problem(self._K, x, paraboloids.of(voting), config.epipole_blur,
                              config.weigh_by_fit and not by_points)
        if len(poses) > 1:
            basin = choose_basin(problem, x, poses, config, self.pair.prior,
                                 self.pair.known.rotation)
        elif not poses and predicted is not None:
            basin = choose_predicted_basin(problem, x, predicted, config)
        else:
            basin = basin_of(problem, poses[0])
        loss = Loss(config.loss, config.loss_scale * basin.scale)
        steps = _FIRST_ROUND_STEPS if by_points else MAX_STEPS
        solution = minimise(problem, basin.pose.R, basin.pose.t, loss, steps, basin.residuals)
        converged = len(poses) == 1 and pose_distance(basin.pose, solution.pose) < config.epsilon
        if basin.camera_in_minority:
            # Matches of the other motion may be the majority, and would bias the noise estimate.
            self._on_motion[voting] = np.abs(solution.residuals.r) < _CULL_FACTOR * loss.scale
        return OptimisedPose(voting, x, problem, loss, solution, converged, basin.rivals)

    def _round(self, fits: Paraboloids, paraboloids: Paraboloids, pose: Pose) -> Round:
        """Find the optimum of each keypoint on its epipolar line, update losses."""
        optimum = _optimum_on_line(paraboloids, self.surface.x,
                                   fundamental(self._K, pose.R, pose.t))
        self._losses[self._alive] = paraboloids.values(optimum)[self._alive]
        return Round(self._keypoints, fits, self._warp, pose, optimum)

    def _advance(self, pose: Pose, optimum: Array) -> None:
        """Move the keypoints to where the next round samples, and warp patches by the pose."""
        self._keypoints = np.where(self._alive[:, None],
                                   _advanced(self._keypoints, optimum, self.config),
                                   self._keypoints)
        if self.config.warp_reference:
            self._warp, self._plausible = _warps(pose, self._K, self.surface.x, optimum)

    def _with_alignment(self, optimised: OptimisedPose) -> tuple[OptimisedPose, Aligned]:
        """Make step 2 once more with photometric alignment, a measurement of its own."""
        pair, voting, placed = self.pair, optimised.voting, unaligned(self.pair.y)
        if not self.config.join_matches or self.config.method == 'rpe':
            return optimised, placed
        aligned = self.surface.aligned(pair.y, self._warp, voting)
        placed.places[voting], placed.covariances[voting] = aligned
        return _with_photometric(optimised, self._K, aligned, self.config), placed

    def _at_best_minimum(self, optimised: OptimisedPose
                         ) -> tuple[OptimisedPose, tuple[Rival, ...], tuple[Rival, ...]]:
        """
        Choose once more among the basins of the first round, and among the minima of the best one.

        With all measurements. Returns the other basins and the other minima as rivals.
        """
        problem, solution, loss = optimised.problem, optimised.solution, optimised.loss
        rivals: tuple[Rival, ...] = ()
        nearby: tuple[Rival, ...] = ()
        if self.first.rivals:
            solution, rivals = choose_among_rivals(
                problem, optimised.x, solution, self.first.rivals, loss, self.pair.prior)
        if self.config.loss != 'none':
            solution, nearby = lowest_nearby_minimum(problem, optimised.x, solution, loss)
        return replace(optimised, solution=solution), rivals, nearby


def _with_photometric(optimised: OptimisedPose, K: Array, placed: Aligned, config: EstimatorConfig
                      ) -> OptimisedPose:
    """Optimise the pose by surfaces and photometric alignment together."""
    solution = optimised.solution
    problem = fuse_alignment(optimised.problem, solution, K, placed)
    agreeing = np.abs(solution.residuals.r) < optimised.loss.scale
    residuals = epipolar_residuals(problem, solution.R, solution.t)
    loss = replace(optimised.loss, scale=config.loss_scale * _scale(residuals.r[agreeing]))
    return replace(optimised, problem=problem, loss=loss, solution=minimise(
        problem, solution.R, solution.t, loss, MAX_STEPS, residuals))


def evaluate_at(surface: ResidualSurface, K: Array, y: Array, pose: Pose) -> Track:
    """Evaluate the surfaces at a pose without optimising it: the result of method five_point."""
    paraboloids = surface.fit_around(y)
    voting = paraboloids.usable
    problem = jet_problem(K, surface.x, paraboloids)
    residuals = epipolar_residuals(problem, pose.R, pose.t)
    optimum = _optimum_on_line(paraboloids, surface.x, fundamental(K, pose.R, pose.t))
    return Track(pose, problem, Loss(), residuals, voting, paraboloids.minima(), unaligned(y),
                 optimum, paraboloids.values(optimum), 0, _scale(residuals.r))


def _scale(residuals: Array) -> float:
    return max(clipped_scale(residuals), MIN_SCALE)


def _optimum_on_line(paraboloids: Paraboloids, x: Array, F: Array) -> Array:
    """Return the places y + v_opt (N, 2) of least value on the epipolar lines of x (N, 2)."""
    lines = epipolar_lines(F, x)
    h = -line_values(lines, paraboloids.centres)
    v = constrained_minimum(paraboloids.A, paraboloids.b, lines[:, :2], h)
    return np.asarray(paraboloids.centres + v)


def _advanced(keypoints: Array, optimum: Array, config: EstimatorConfig) -> Array:
    """Move keypoints towards their optimum by the configured strategy ("Keypoint iterations")."""
    step = optimum - keypoints
    if config.step == 'share':
        return keypoints + config.step_share * step
    length = norms(step)[:, None]
    # Beyond the sampled window the paraboloid is not valid, so no step is longer than that.
    longest = 1.0 if config.step == 'pixel' else config.window / 2
    return np.asarray(keypoints + step * np.minimum(1.0, longest / np.maximum(length, 1e-12)))


def _warps(pose: Pose, K: Array, x: Array, y: Array) -> tuple[Array, NDArray[np.bool_]]:
    """
    Return the warps of patches from x to y, and (N,) bool whether they are plausible.

    Patches slant as the depths of their neighbours say; if that deforms them too much, they are
    fronto-parallel. Warps that are not plausible are identity.
    """
    rays_x, rays_y = rays(K, x), rays(K, y)
    ratio = depth_ratio(pose.R, pose.t, rays_x, rays_y)
    # Unit scale without parallax or on the epipole; not plausible behind the camera.
    ratio = np.where(np.isfinite(ratio), ratio, np.where(np.isnan(ratio), 1.0, -1.0))
    warp = patch_warp(K, pose.R, y, ratio)
    plausible = (ratio > 0) & has_moderate_stretch(warp)
    warp = np.where(plausible[:, None, None], warp, np.eye(3, 2))
    # The slant of a patch is estimated from the depths of its neighbours.
    indices = np.flatnonzero(plausible)
    x, y, rays_x, rays_y = (places.take(indices, axis=0) for places in (x, y, rays_x, rays_y))
    rho, sigma = inverse_depths(pose.R, pose.t, rays_x, rays_y)
    slopes = slopes_of_all(x, rho, _DEPTH_NOISE / K[0, 0] * sigma)
    slanted = warp.take(indices, axis=0) + slant_warp(K, pose.t, y, ratio[indices], slopes)
    slant_ok = has_moderate_stretch(slanted)
    warp[indices[slant_ok]] = slanted[slant_ok]
    return warp, plausible
