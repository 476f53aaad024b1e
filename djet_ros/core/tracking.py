"""Algorithm 1 of the paper: surfaces and pose in turn, until the pose rests."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.fusion import Turn
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
from djet_ros.core.rivals import (
    apart,
    change,
    DECIDED,
    goes_on,
    preferences,
    refined_rivals,
    Rival,
    second_motion,
    SecondMotion,
)
from djet_ros.core.sketch import costs_in_front, Held, refine_all, Sketch
from djet_ros.core.starts import all_round, thinned
from djet_ros.core.surfaces import ResidualSurface, with_minimum
from djet_ros.core.types import Array, Pose
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation


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
    # chosen: directions all round from which basins are looked for then
    directions: int = 10
    # chosen: the cheapest that lie in different basins are refined
    refined_starts: int = 3
    # rad; chosen: poses nearer than this lie in one basin
    same_basin: float = 0.02
    # chosen: steps on all matches before costs are compared
    steps_to_compare: int = 7
    # rad; chosen: what a rotation that was measured is not trusted with, and for how many matches'
    # worth of surprise it counts
    turn_slack: float = 2e-4
    # rad; chosen: standard deviation of a rotation that is not yet refined to the end
    turn_fits: float = 5e-4
    # chosen: basins that are left to themselves to see whether they turn away
    turned_starts: int = 5
    # chosen: rounds in which residuals that do not belong together are left out, and from how many
    # robust standard deviations on
    core_rounds: int = 8
    core: float = 2.5
    # bends of the loss; chosen: beyond, a match has next to no weight anyway
    by_itself: float = 2.0
    turn_weight: float = 1000.0
    # chosen: a patch that would be stretched or shrunk by more is a false match
    most_stretch: float = 2.0
    # chosen: a body spread over less than this share of the area of the world's matches is not
    # mistaken for it
    small_body: float = 0.3
    # robust standard deviations; the usual three, within which a match agrees with a pose
    inlier: float = 3.0


TUNING = TrackTuning()


@dataclass(frozen=True)
class Track:
    """
    Where Algorithm 1 ended.

    pose; loss: the robust loss in force; residuals: those of the voting matches at the pose;
    voting: (N,) bool, matches that took part; minima: (N, 2) the surfaces' own minima y*;
    y_opt: (N, 2) the final step onto the epipolar line; losses: (N,) last known surface values;
    rivals: other motions that explain the voting matches; guess: whether that is so because two
    bodies move, and nothing tells which is the world.
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
    rivals: tuple[Rival, ...] = ()
    guess: bool = False

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
                  observe: Observer | None = None, turn: Turn | None = None) -> Track | None:
    """
    Optimise the pose and the keypoints' places on their epipolar lines jointly.

    y: (N, 2) initial keypoints in the current image. The cheapest of the refined `starts` goes
    on; of those that the matches do not decide between, the one next to the prior, the previous
    motion. Where two bodies move, it is the camera's motion, as far as that can be told. None
    where too few matches have a usable surface. observe: is called at the end of each round; turn:
    a rotation that was measured, which tells basins and bodies apart.
    """
    found = _track(surface, K, y, starts, config, prior, observe, turn, np.ones(len(y), bool))
    if found is None:
        return None
    track, begun = found
    if len(starts) == 1 or turn is not None:
        return track
    second = second_motion(begun.problem, begun.places, track.pose, track.scale(),
                           config.min_matches)
    if second is None:
        return track
    taken, other, guess = _of_the_camera(second, prior)
    if taken is second.pose:
        members = np.zeros(len(y), bool)
        members[begun.voting] = second.members
        again = _track(surface, K, y, [taken], config, prior, observe, None, members)
        track = again[0] if again is not None else track
    return replace(track, rivals=(Rival(other, 0.0),), guess=True) if guess else track


class _Begun(NamedTuple):
    """The first round: its problem, the pixels (M, 2) of its matches, and (N,) bool which."""

    problem: JetProblem
    places: Array
    voting: NDArray[np.bool_]


def _track(surface: ResidualSurface, K: Array, y: Array, starts: list[Pose],
           config: EstimatorConfig, prior: Pose | None, observe: Observer | None,
           turn: Turn | None, alive: NDArray[np.bool_]) -> tuple[Track, _Begun] | None:
    """Run Algorithm 1 on the matches that are alive, a mask (N,) bool."""
    keypoints, losses = y.copy(), np.full(len(y), np.nan)
    poses, warp, begun, basin = starts, None, None, _Basin(starts[0], 1.0)
    judged: tuple[Rival, ...] = ()
    plausible, ours = np.ones(len(y), bool), np.ones(len(y), bool)
    for iteration in range(1, config.max_iterations + 1):
        # Step 1: update the local residuals around the keypoints and fit A', b, c.
        fits = surface.around(keypoints, warp)
        paraboloids, no_minimum = with_minimum(fits, config.indefinite)
        # Match culling: a keypoint without a surface is out, and keeps its last loss.
        alive = alive & paraboloids.usable
        voting = alive & plausible & ours & (
            _minimum_inside(paraboloids, config) | (not config.cull_outside))
        if voting.sum() < config.min_matches:
            return None
        # Step 2: global pose optimisation.
        places = surface.x[voting]
        problem = jet_problem(K, places, _take(paraboloids, voting), TUNING.epipole_blur,
                              config.weigh_by_fit)
        begun = begun or _Begun(problem, places, voting)
        if len(poses) > 1:
            basin = _right_basin(problem, places, poses, config, prior, turn)
        else:
            scale = _scale(epipolar_residuals(problem, poses[0].R, poses[0].t).r)
            basin = replace(basin, pose=poses[0], scale=scale, others_move=False)
        loss = Loss(config.loss, config.loss_scale * basin.scale)
        solution = minimise(problem, basin.pose.R, basin.pose.t, loss)
        converged = len(poses) == 1 and change(basin.pose, _pose(solution)) < config.epsilon
        last = converged or iteration == config.max_iterations
        if last and basin.rivals:
            # Judge again between the basins, on the last surfaces.
            solution, judged = _judged(problem, places, solution, basin.rivals, loss, prior)
        pose = _pose(solution)
        if basin.others_move:
            # What does not fit may be most, and would tell a wrong noise.
            ours[voting] = np.abs(solution.residuals.r) < TUNING.by_itself * loss.scale
        # Keypoints go towards their optimum on the epipolar line of the new pose.
        optimum = _optimum_on_line(paraboloids, surface.x, fundamental(K, pose.R, pose.t))
        losses[alive] = paraboloids.values(optimum)[alive]
        if observe is not None:
            observe(Round(keypoints, fits, warp, pose, optimum))
        poses = [pose]
        if last:
            break
        keypoints = np.where(alive[:, None], _advance(keypoints, optimum, config), keypoints)
        if config.warp_reference:
            warp, plausible = _warps(pose, K, surface.x, optimum)
    assert begun is not None  # there is at least one iteration
    return Track(pose, loss, solution.residuals, voting, paraboloids.minima(), optimum, losses,
                 no_minimum, iteration, judged), begun


def hold(surface: ResidualSurface, K: Array, y: Array, pose: Pose) -> Track:
    """Take a pose as it is, and look at the surfaces there: the 5-point method's last word."""
    paraboloids = surface.around(y)
    voting = paraboloids.usable
    residuals = epipolar_residuals(jet_problem(K, surface.x, paraboloids), pose.R, pose.t)
    optimum = _optimum_on_line(paraboloids, surface.x, fundamental(K, pose.R, pose.t))
    return Track(pose, Loss(), residuals, voting, paraboloids.minima(), optimum,
                 paraboloids.values(optimum), 0, 0)


@dataclass(frozen=True)
class _Basin:
    """
    A pose, the scale of the residuals there, and the poses of other basins.

    others_move: whether most matches tell another motion.
    """

    pose: Pose
    scale: float
    others_move: bool = False
    rivals: tuple[Pose, ...] = ()


def _right_basin(problem: JetProblem, places: Array, starts: list[Pose],
                 config: EstimatorConfig, prior: Pose | None, turn: Turn | None) -> _Basin:
    """Choose among starts by what they come to."""
    some = problem.subset(thinned(len(problem.blur), TUNING.matches_to_sketch))
    scale = max(refine_all(some, starts, Loss(), 0).scales().min(), TUNING.least_scale)
    tight = Loss(config.loss, min(config.loss_scale, TUNING.tight) * scale)
    if turn is not None:
        # Whatever moves as most matches do tells their noise, and what fits the turn fits it well.
        scale = max(refine_all(some, starts, tight, TUNING.steps_to_sketch).scales().min(),
                    TUNING.least_scale)
        tight = replace(tight, scale=min(config.loss_scale, TUNING.tight) * scale)
        starts = _promising(some, refine_all(some, starts, tight, TUNING.steps_to_compare,
                                             _held(turn, scale)), tight, TUNING.turned_starts)
    elif len(problem.blur) > TUNING.few_matches:
        starts = _promising(some, refine_all(some, starts, tight, TUNING.steps_to_sketch), tight,
                            TUNING.refined_starts)
    else:
        starts = [*starts, *all_round(starts[0].R, TUNING.directions)]
    refined = refine_all(problem, starts, tight, TUNING.steps_to_compare)
    possible, others_move = np.ones(len(refined), bool), False
    if turn is not None and (turned_so := _turned_so(turn, refined)).any():
        others_move = not turned_so[costs_in_front(problem, refined, tight).argmin()]
        possible = turned_so
    basins = _promising(problem, refined, tight, TUNING.refined_starts, possible)
    best = basins.pop(_likeliest(problem, places, basins, tight, prior))
    # All matches are placed equally well, whatever they move with.
    scale = (min(map(_core_scale, refined.r)) if others_move
             else robust_scale(epipolar_residuals(problem, best.R, best.t).r))
    return _Basin(best, max(scale, TUNING.least_scale), others_move, tuple(basins))


def _judged(problem: JetProblem, places: Array, solution: Solution, rivals: Sequence[Pose],
            loss: Loss, prior: Pose | None) -> tuple[Solution, tuple[Rival, ...]]:
    """Take the likeliest of a solution and its rivals, and tell how much it is preferred."""
    poses = [_pose(solution), *refined_rivals(problem, rivals, loss)]
    best = _likeliest(problem, places, poses, loss, prior)
    if best != 0:
        solution = minimise(problem, poses[best].R, poses[best].t, loss)
        poses[best] = _pose(solution)
    preferred = preferences(problem, places, poses, best, loss)
    return solution, tuple(
        Rival(pose, float(preference)) for pose, preference in zip(poses, preferred)
        if apart(poses[best], pose) > TUNING.same_basin)


def _likeliest(problem: JetProblem, places: Array, poses: list[Pose], loss: Loss,
               prior: Pose | None) -> int:
    """Which of some poses costs least, or, of those undecided between, is next to the prior."""
    costs = costs_in_front(problem, refine_all(problem, poses, loss, 0), loss)
    best = int(costs.argmin())
    if prior is None:
        return best
    undecided = preferences(problem, places, poses, best, loss) < DECIDED
    return min(np.flatnonzero(undecided).tolist(), key=lambda number: apart(prior, poses[number]))


def _of_the_camera(second: SecondMotion, prior: Pose | None) -> tuple[Pose, Pose, bool]:
    """
    Tell the camera's motion from that of another body, and whether that is a guess.

    It is the one that goes on like the motion before. Else it is the wider one, for the world
    surrounds what moves in it: for sure where the other one is far smaller.
    """
    if prior is not None:
        for one, other in ((second.first, second.pose), (second.pose, second.first)):
            if goes_on(prior, one, other):
                return one, other, False
    if second.width < TUNING.small_body:
        return second.first, second.pose, False
    if second.width > 1:
        return second.pose, second.first, True
    return second.first, second.pose, True


def _core_scale(residuals: Array) -> float:
    """Give the standard deviation of the residuals that belong together, which may be few."""
    scale = robust_scale(residuals)
    for _ in range(TUNING.core_rounds):
        scale = robust_scale(residuals[np.abs(residuals) < TUNING.core * scale])
    return scale


def _turned_so(turn: Turn, sketch: Sketch) -> NDArray[np.bool_]:
    """
    (S,) bool mask of the poses whose rotation is the measured one, within what both are good for.

    The motion of something that fills the image is found under the measured rotation too, by a
    direction that makes up for the difference; left to itself it turns away.
    """
    off = Rotation.from_matrix(turn.R @ sketch.R.transpose(0, 2, 1)).as_rotvec()
    allowed = turn.covariance + TUNING.turn_fits**2 * np.eye(3)
    return np.asarray((off * np.linalg.solve(allowed, off.T).T).sum(1) < TUNING.inlier**2)


def _held(turn: Turn | None, scale: float) -> Held | None:
    """
    Draw rotations to the one that was measured, while a basin is chosen.

    The matches of something large that moves by itself outweigh what is left of the scene, unless
    a measured rotation counts for more than all of them. In the end the matches decide alone.
    """
    if turn is None:
        return None
    variance = turn.covariance + TUNING.turn_slack**2 * np.eye(3)
    return Held(turn.R, np.asarray(TUNING.turn_weight * scale**2 * np.linalg.inv(variance)))


def _promising(problem: JetProblem, sketch: Sketch, loss: Loss, most: int,
               possible: NDArray[np.bool_] | None = None) -> list[Pose]:
    """Choose the cheapest poses that lie in different basins, up to a number of them."""
    chosen: list[Pose] = []
    for number in costs_in_front(problem, sketch, loss).argsort(kind='stable').tolist():
        pose = sketch.pose(number)
        if (possible is None or possible[number]) and all(
                apart(other, pose) > TUNING.same_basin for other in chosen):
            chosen.append(pose)
    return chosen[:most]


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


def _take(paraboloids: Paraboloids, chosen: NDArray[np.bool_]) -> Paraboloids:
    p = paraboloids
    return Paraboloids(p.centres[chosen], p.A[chosen], p.b[chosen], p.c[chosen], p.usable[chosen])
