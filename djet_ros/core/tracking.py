"""Algorithm 1 of the paper: surfaces and pose in turn, until the pose rests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

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
    # variances of a residual, that a rival may cost more; from a rendered dive, where few matches
    # leave a choice between a plane's own motion and its twin: matches of one neighbourhood err
    # alike. The first surfaces, which see half of the matches on frames far apart, are so unsure
    # that rivals are followed; at the end the motion before decides between them
    undecided: float = 10.0
    # chosen: so many, the cheapest of them, are followed to the end
    followed: int = 3
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
    on, with its rivals where the first surfaces do not decide between them; the last ones do. Of
    those that cost the same the one next to the prior, the previous motion, is taken. None where
    too few matches have a usable surface. observe: is called for each round of the one taken.
    """
    n = len(y)
    untouched = _Keypoints(y.copy(), np.full(n, np.nan), np.ones(n, bool), None, np.ones(n, bool))
    sight = _look(surface, K, untouched, config)
    if sight is None:
        return None
    sole = len(starts) == 1
    followed = [way for rival in _rivals(sight.problem, starts, config)
                if (way := _follow(surface, K, sight, rival, config, sole)) is not None]
    taken = _cheapest_way(followed, prior)
    if taken is None:
        return None
    if observe is not None:
        for seen in taken.rounds:
            observe(seen)
    return taken.track


@dataclass(frozen=True)
class _Keypoints:
    """
    Where matches are between two rounds.

    places: (N, 2); losses: (N,) last known surface values; alive: (N,) bool, not culled; warp,
    plausible: how their patches are seen, (N, 2, 2), and whether that can be, (N,) bool.
    """

    places: Array
    losses: Array
    alive: NDArray[np.bool_]
    warp: Array | None
    plausible: NDArray[np.bool_]


@dataclass(frozen=True)
class _Sight:
    """What a round sees around keypoints: fits, what was made of them, and the problem posed."""

    keypoints: _Keypoints
    fits: Paraboloids
    paraboloids: Paraboloids
    no_minimum: int
    voting: NDArray[np.bool_]
    problem: JetProblem


@dataclass(frozen=True)
class _Way:
    """A start followed to its end: the track, what the last round saw, and all rounds."""

    track: Track
    problem: JetProblem
    solution: Solution
    rounds: list[Round]


def _look(surface: ResidualSurface, K: Array, keypoints: _Keypoints,
          config: EstimatorConfig) -> _Sight | None:
    """Step 1: update the local residuals around the keypoints and fit A', b, c."""
    fits = surface.around(keypoints.places, keypoints.warp)
    paraboloids, no_minimum = with_minimum(fits, config.indefinite)
    # Match culling: a keypoint without a surface is out, and keeps its last loss.
    alive = keypoints.alive & paraboloids.usable
    voting = alive & keypoints.plausible & (
        _minimum_inside(paraboloids, config) | (not config.cull_outside))
    if voting.sum() < config.min_matches:
        return None
    problem = jet_problem(K, surface.x[voting], _take(paraboloids, voting),
                          TUNING.epipole_blur, config.weigh_by_fit)
    return _Sight(replace(keypoints, alive=alive), fits, paraboloids, no_minimum, voting, problem)


def _follow(surface: ResidualSurface, K: Array, sight: _Sight, start: Pose,
            config: EstimatorConfig, sole: bool) -> _Way | None:
    """
    Go on from a start on the first sight, round by round, until the pose rests.

    sole: there was no other start, so that the pose may rest there as well.
    """
    rounds: list[Round] = []
    pose, seen = start, sight
    for iteration in range(1, config.max_iterations + 1):
        # Step 2: global pose optimisation.
        scale = _scale(epipolar_residuals(seen.problem, pose.R, pose.t).r)
        loss = Loss(config.loss, config.loss_scale * scale)
        solution = minimise(seen.problem, pose.R, pose.t, loss)
        before, pose = pose, _pose(solution)
        # Keypoints go towards their optimum on the epipolar line of the new pose.
        alive, places = seen.keypoints.alive, seen.keypoints.places
        optimum = _optimum_on_line(seen.paraboloids, surface.x, fundamental(K, pose.R, pose.t))
        losses = np.where(alive, seen.paraboloids.values(optimum), seen.keypoints.losses)
        rounds.append(Round(places, seen.fits, seen.keypoints.warp, pose, optimum))
        rests = (sole or iteration > 1) and _change(before, pose) < config.epsilon
        if rests or iteration == config.max_iterations:
            break
        places = np.where(alive[:, None], _advance(places, optimum, config), places)
        warp, plausible = (_warps(pose, K, surface.x, optimum) if config.warp_reference
                           else (None, np.ones(len(places), bool)))
        sought = _look(surface, K, _Keypoints(places, losses, alive, warp, plausible), config)
        if sought is None:
            return None
        seen = sought
    track = Track(pose, loss, solution.residuals, seen.voting, seen.paraboloids.minima(), optimum,
                  losses, seen.no_minimum, iteration)
    return _Way(track, seen.problem, solution, rounds)


def _cheapest_way(ways: list[_Way], prior: Pose | None) -> _Way | None:
    """Take the way that ends at the least cost; a match that has no vote pays the most."""
    if len(ways) < 2:
        return ways[0] if ways else None
    scale = min(way.track.scale() for way in ways)
    tight = Loss('geman_mcclure', TUNING.tight * scale)
    most = max(len(way.problem.blur) for way in ways)
    costs = [_cost(way, tight) + tight.scale**2 * (most - len(way.problem.blur)) for way in ways]
    cheapest = min(costs)
    if prior is None:
        return ways[costs.index(cheapest)]
    return min((way for way, cost in zip(ways, costs)
                if cost <= cheapest + TUNING.undecided * scale**2),
               key=lambda way: _apart(prior, way.track.pose))


def _cost(way: _Way, loss: Loss) -> float:
    """Sum up the loss where a way ends, points behind the cameras as well."""
    at, residuals = way.solution, way.solution.residuals
    sketch = Sketch(at.R[None], at.t[None], np.array([at.cost]), residuals.r[None],
                    residuals.sign[None])
    return float(costs_in_front(way.problem, sketch, loss)[0])


def hold(surface: ResidualSurface, K: Array, y: Array, pose: Pose) -> Track:
    """Take a pose as it is, and look at the surfaces there: the 5-point method's last word."""
    paraboloids = surface.around(y)
    voting = paraboloids.usable
    residuals = epipolar_residuals(jet_problem(K, surface.x, paraboloids), pose.R, pose.t)
    optimum = _optimum_on_line(paraboloids, surface.x, fundamental(K, pose.R, pose.t))
    return Track(pose, Loss(), residuals, voting, paraboloids.minima(), optimum,
                 paraboloids.values(optimum), 0, 0)


def _rivals(problem: JetProblem, starts: list[Pose], config: EstimatorConfig) -> list[Pose]:
    """Refine the most promising starts; give the cheapest, and what costs hardly more."""
    if len(starts) == 1:
        return starts
    some = problem.subset(thinned(len(problem.blur), TUNING.matches_to_sketch))
    scale = max(refine_all(some, starts, Loss(), 0).scales().min(), TUNING.least_scale)
    tight = Loss(config.loss, min(config.loss_scale, TUNING.tight) * scale)
    if len(problem.blur) > TUNING.few_matches:
        sketch = refine_all(some, starts, tight, TUNING.steps_to_sketch)
        promising = _distinct(sketch, costs_in_front(some, sketch, tight))
        starts = [sketch.pose(number) for number in promising[:TUNING.refined_starts]]
    refined = refine_all(problem, starts, tight, TUNING.steps_to_compare)
    costs = costs_in_front(problem, refined, tight)
    best = int(costs.argmin())
    undecided = costs[best] + TUNING.undecided * _scale(refined.r[best])**2
    return [refined.pose(number) for number in _distinct(refined, costs)
            if costs[number] <= undecided][:TUNING.followed]


def _distinct(sketch: Sketch, costs: Array) -> list[int]:
    """Give the numbers of the poses by cost, of each basin only the cheapest."""
    chosen: list[int] = []
    for number in costs.argsort(kind='stable').tolist():
        pose = sketch.pose(number)
        if all(_apart(sketch.pose(other), pose) > TUNING.same_basin for other in chosen):
            chosen.append(number)
    return chosen


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
