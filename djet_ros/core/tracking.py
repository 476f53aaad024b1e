"""Algorithm 1 of the paper: surfaces and pose in turn, until the pose rests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.geometry import (
    epipolar_lines,
    fundamental,
    growth,
    homogeneous,
    patch_warp,
    rays,
    stretches,
)
from djet_ros.core.jet import (
    epipolar_residuals,
    jet_problem,
    JetProblem,
    Loss,
    minimise,
    Residuals,
    robust_scale,
    Solution,
)
from djet_ros.core.paraboloid import constrained_minimum, Paraboloids
from djet_ros.core.sketch import costs_in_front, refine_all, Sketch
from djet_ros.core.starts import thinned
from djet_ros.core.surfaces import ResidualSurface, with_minimum
from djet_ros.core.types import Array, Pose
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class TrackTuning:
    """Constants of the optimisation, each with where it comes from ("chosen" was not searched)."""

    # pixels; chosen, far below any noise: perfect data must not shrink the loss to nothing
    least_scale: float = 0.02
    # pixels; chosen, about a window: so near to the epipole the direction of a line is noise, and
    # a match that fits by chance would hold the epipole and make it look far surer than it is
    epipole_blur: float = 5.0
    # robust standard deviations; chosen: a second motion in the scene fits many matches loosely,
    # the camera's own fits most of them closely, so a loss that bends here tells basins apart
    tight: float = 1.0
    # chosen: where a start lies says little of its basin, so all make a few steps on some matches
    steps_to_sketch: int = 4
    matches_to_sketch: int = 800
    # chosen: it costs little to refine all starts on so few, and there basins lie closer
    few_matches: int = 400
    # chosen: the cheapest two that lie in different basins are refined
    refined_starts: int = 2
    # rad; chosen: poses nearer than this lie in one basin
    same_basin: float = 0.02
    # chosen: steps on all matches before costs are compared
    steps_to_compare: int = 7
    # variances of a residual; from a rendered dive, where few matches leave a choice between a
    # plane's own motion and its twin: matches of one neighbourhood err alike
    undecided: float = 10.0
    # chosen: a patch that would be stretched or shrunk by more is a false match
    most_stretch: float = 2.0
    # robust standard deviations; the usual three, within which a match agrees with a pose
    inlier: float = 3.0


TUNING = TrackTuning()


@dataclass(frozen=True)
class Track:
    """
    Where Algorithm 1 ended.

    pose; loss: the robust loss in force; residuals: those of the voting matches at the pose;
    voting: (N,) bool, matches that took part; minima: (N, 2) the surfaces' own minima y*;
    y_opt: (N, 2) the final step onto the epipolar line; losses: (N,) last known surface values.
    """

    pose: Pose
    loss: Loss
    residuals: Residuals
    voting: NDArray[np.bool_]
    minima: Array
    y_opt: Array
    losses: Array
    indefinite: int
    iterations: int

    def scale(self) -> float:
        """Give the robust standard deviation of the residuals, in pixels of a typical surface."""
        return _scale(self.residuals.r)

    def inliers(self) -> NDArray[np.bool_]:
        """(N,) bool mask of the matches that voted and agree with the pose."""
        agree = np.abs(self.residuals.r) < TUNING.inlier * self.scale()
        inliers = self.voting.copy()
        inliers[inliers] = agree
        return inliers


@dataclass(frozen=True)
class Round:
    """
    One round of Algorithm 1 on N matches, as an observer is shown it.

    keypoints: (N, 2) pixels around which the surfaces were sampled; fits: the paraboloids there;
    warp: (N, 2, 2) through which the reference patches were seen, None where they were not warped;
    pose: the one found on them; optimum: (N, 2) the places y + v_opt on its epipolar lines.
    """

    keypoints: Array
    fits: Paraboloids
    warp: Array | None
    pose: Pose
    optimum: Array


Observer = Callable[[Round], None]


def track_jointly(surface: ResidualSurface, K: Array, y: Array, starts: list[Pose],
                  config: EstimatorConfig, prior: Pose | None = None,
                  observe: Observer | None = None) -> Track | None:
    """
    Optimise the pose and the keypoints' places on their epipolar lines jointly.

    y: (N, 2) initial keypoints in the current image. The cheapest of the refined `starts` goes
    on; of those that cost the same the one next to the prior, the previous motion. None where too
    few matches have a usable surface. observe: is called at the end of each round.
    """
    keypoints, losses = y.copy(), np.full(len(y), np.nan)
    alive = np.ones(len(y), bool)
    poses, warp = starts, None
    plausible = np.ones(len(y), bool)
    for iteration in range(1, config.max_iterations + 1):
        # Step 1: update the local residuals around the keypoints and fit A', b, c.
        fits = surface.around(keypoints, warp)
        paraboloids, no_minimum = with_minimum(fits, config.indefinite)
        # Match culling: a keypoint without a surface is out, and keeps its last loss.
        alive &= paraboloids.usable
        voting = alive & plausible & (
            _minimum_inside(paraboloids, config) | (not config.cull_outside))
        if voting.sum() < config.min_matches:
            return None
        # Step 2: global pose optimisation.
        problem = jet_problem(K, surface.x[voting], _take(paraboloids, voting),
                              TUNING.epipole_blur, config.weigh_by_fit)
        solution, loss = _cheapest(problem, poses, config, prior)
        pose = _pose(solution)
        # Keypoints go towards their optimum on the epipolar line of the new pose.
        optimum = _optimum_on_line(paraboloids, surface.x, fundamental(K, pose.R, pose.t))
        losses[alive] = paraboloids.values(optimum)[alive]
        if observe is not None:
            observe(Round(keypoints, fits, warp, pose, optimum))
        converged = len(poses) == 1 and _change(poses[0], pose) < config.epsilon
        poses = [pose]
        if converged or iteration == config.max_iterations:
            break
        keypoints = np.where(alive[:, None], _advance(keypoints, optimum, config), keypoints)
        if config.warp_reference:
            warp, plausible = _warps(pose, K, surface.x, optimum)
    return Track(pose, loss, solution.residuals, voting, paraboloids.minima(), optimum, losses,
                 no_minimum, iteration)


def hold(surface: ResidualSurface, K: Array, y: Array, pose: Pose) -> Track:
    """Take a pose as it is, and look at the surfaces there: the 5-point method's last word."""
    paraboloids = surface.around(y)
    voting = paraboloids.usable
    residuals = epipolar_residuals(jet_problem(K, surface.x, paraboloids), pose.R, pose.t)
    optimum = _optimum_on_line(paraboloids, surface.x, fundamental(K, pose.R, pose.t))
    return Track(pose, Loss(), residuals, voting, paraboloids.minima(), optimum,
                 paraboloids.values(optimum), 0, 0)


def _cheapest(problem: JetProblem, starts: list[Pose], config: EstimatorConfig,
              prior: Pose | None) -> tuple[Solution, Loss]:
    """Refine the most promising starts, and the cheapest of them to the end."""
    if len(starts) == 1:
        best, scale = starts[0], _scale(epipolar_residuals(problem, starts[0].R, starts[0].t).r)
    else:
        best, scale = _right_basin(problem, starts, config, prior)
    loss = Loss(config.loss, config.loss_scale * scale)
    return minimise(problem, best.R, best.t, loss), loss


def _right_basin(problem: JetProblem, starts: list[Pose], config: EstimatorConfig,
                 prior: Pose | None) -> tuple[Pose, float]:
    """Choose among starts by what they come to; also gives the scale of the residuals there."""
    some = problem.subset(thinned(len(problem.blur), TUNING.matches_to_sketch))
    scale = max(refine_all(some, starts, Loss(), 0).scales().min(), TUNING.least_scale)
    tight = Loss(config.loss, min(config.loss_scale, TUNING.tight) * scale)
    if len(problem.blur) > TUNING.few_matches:
        starts = _promising(some, refine_all(some, starts, tight, TUNING.steps_to_sketch), tight)
    refined = refine_all(problem, starts, tight, TUNING.steps_to_compare)
    costs, scales = costs_in_front(problem, refined, tight), refined.scales()
    best = int(costs.argmin())
    if prior is not None:
        undecided = costs[best] + TUNING.undecided * max(scales[best], TUNING.least_scale)**2
        best = min(np.flatnonzero(costs < undecided).tolist(),
                   key=lambda number: _apart(prior, refined.pose(number)))
    return refined.pose(best), max(float(scales[best]), TUNING.least_scale)


def _promising(problem: JetProblem, sketch: Sketch, loss: Loss) -> list[Pose]:
    """Choose the cheapest poses that lie in different basins."""
    chosen: list[Pose] = []
    for number in costs_in_front(problem, sketch, loss).argsort(kind='stable').tolist():
        pose = sketch.pose(number)
        if all(_apart(other, pose) > TUNING.same_basin for other in chosen):
            chosen.append(pose)
    return chosen[:TUNING.refined_starts]


def _pose(solution: Solution) -> Pose:
    return Pose(solution.R, solution.t)


def _scale(residuals: Array) -> float:
    return max(robust_scale(residuals), TUNING.least_scale)


def _minimum_inside(paraboloids: Paraboloids, config: EstimatorConfig) -> NDArray[np.bool_]:
    """(N,) bool mask of the minima inside the sampled window: the rest is extrapolation."""
    reach = np.abs(paraboloids.minima() - paraboloids.centres).max(1)
    return np.asarray(reach <= config.window // 2)


def _optimum_on_line(paraboloids: Paraboloids, x: Array, F: Array) -> Array:
    """Places y + v_opt (N, 2) for the paraboloids around their centres."""
    lines = epipolar_lines(F, x)
    h = -(homogeneous(paraboloids.centres) * lines).sum(1)
    v = constrained_minimum(paraboloids.A, paraboloids.b, lines[:, :2], h)
    return np.asarray(paraboloids.centres + v)


def _advance(keypoints: Array, optimum: Array, config: EstimatorConfig) -> Array:
    """Move keypoints towards their optimum by the chosen strategy ("Keypoint iterations")."""
    way = optimum - keypoints
    if config.step == 'share':
        return keypoints + config.step_share * way
    length = np.linalg.norm(way, axis=1, keepdims=True)
    # Beyond the sampled window a paraboloid says nothing, so no step is longer than that.
    longest = 1.0 if config.step == 'pixel' else config.window / 2
    return np.asarray(keypoints + way * np.minimum(1.0, longest / np.maximum(length, 1e-12)))


def _warps(pose: Pose, K: Array, x: Array, y: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Tell how patches at x are seen at y, as they are where that is not plausible."""
    seen = growth(pose.R, pose.t, rays(K, x), rays(K, y))
    seen = np.where(np.isnan(seen), 1.0, seen)  # without any parallax, or on the epipole
    warp = patch_warp(K, pose.R, y, seen)
    least, most = stretches(warp)
    plausible = (seen > 0) & (least > 1 / TUNING.most_stretch) & (most < TUNING.most_stretch)
    return np.where(plausible[:, None, None], warp, np.eye(2)), plausible


def _change(before: Pose, after: Pose) -> float:
    """Measure ||p - p_prev||: rotation and direction together, in rad to first order."""
    return float(np.linalg.norm(np.concatenate([(after.R - before.R).ravel() / np.sqrt(2),
                                                after.t - before.t])))


def _apart(a: Pose, b: Pose) -> float:
    """Measure how different two motions are while the sign of t is not yet settled."""
    return min(_change(a, b), _change(a, Pose(b.R, -b.t)))


def _take(paraboloids: Paraboloids, chosen: NDArray[np.bool_]) -> Paraboloids:
    p = paraboloids
    return Paraboloids(p.centres[chosen], p.A[chosen], p.b[chosen], p.c[chosen], p.usable[chosen])
