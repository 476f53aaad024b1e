"""Algorithm 1 of the paper: surfaces and pose in turn, until the pose rests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

from djet_ros.core.basins import (
    Ahead,
    Basin,
    basin_ahead,
    basin_of,
    judged,
    LEAST_SCALE,
    right_basin,
)
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.fusion import Turn
from djet_ros.core.geometry import (
    epipolar_lines,
    fundamental,
    growth,
    inverse_depths,
    patch_warp,
    rays,
    slant_warp,
    values_on,
)
from djet_ros.core.jet import (
    core_scale,
    epipolar_residuals,
    jet_problem,
    JetProblem,
    Loss,
    MAX_STEPS,
    minimise,
    Residuals,
    Solution,
    with_places,
)
from djet_ros.core.paraboloid import constrained_minimum, Paraboloids
from djet_ros.core.rivals import change, goes_on, Rival, second_motion, SecondMotion
from djet_ros.core.slants import slopes_of_all
from djet_ros.core.surfaces import comparable, ReprojectionSurface, ResidualSurface, with_minimum
from djet_ros.core.types import Array, Pose
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class TrackTuning:
    """Constants of the optimisation, each with where it comes from ("chosen" was not searched)."""

    # pixels; chosen, about a window: so near to the epipole the direction of a line is noise, and
    # a match that fits by chance would hold the epipole and make it look far surer than it is
    epipole_blur: float = 5.0
    # bends of the loss; chosen: beyond, a match has next to no weight anyway
    by_itself: float = 2.0
    # chosen: a body spread over less than this share of the area of the world's matches is not
    # mistaken for it
    small_body: float = 0.3
    # near end over far end: chosen, a body is about as deep as it is wide, and stands no nearer
    # than that; the world reaches from the ground before the camera to the horizon
    flat: float = 0.5
    deep: float = 0.25
    # chosen: steps on all matches to a pose that surfaces are only placed by
    steps_by_places: int = 2
    # pixels; chosen: what right matches are off, where planes are fitted to their depths
    off: float = 0.1
    # robust standard deviations; the usual three, within which a match agrees with a pose
    inlier: float = 3.0


TUNING = TrackTuning()


@dataclass(frozen=True)
class Track:
    """
    Where Algorithm 1 ended.

    pose; loss: the robust loss in force; residuals: those of the voting matches at the pose;
    voting: (N,) bool, matches that took part; placed: (N, 2) where gray levels have y, through the
    last warp, or y itself where that was not asked; minima: (N, 2) the surfaces' own minima y*,
    joined with these for matches that voted; y_opt: (N, 2) the final step onto the epipolar line;
    losses: (N,) last known surface values; rivals: other motions that explain the voting matches;
    guess: whether that is so because two bodies move, and nothing tells which is the world.
    """

    pose: Pose
    loss: Loss
    residuals: Residuals
    voting: NDArray[np.bool_]
    minima: Array
    placed: Array
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
    warp: (N, 3, 2) through which the reference patches were seen, None where they were not warped;
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
                  observe: Observer | None = None, turn: Turn | None = None,
                  ahead: Ahead | None = None) -> Track | None:
    """
    Optimise the pose and the keypoints' places on their epipolar lines jointly.

    y: (N, 2) initial keypoints in the current image. The cheapest of the refined `starts` goes
    on; of those that the matches do not decide between, the one next to the prior, the previous
    motion. Without any starts they are looked for around the pose ahead. Where two bodies move, it
    is the camera's motion, as far as that can be told. None where too few matches have a usable
    surface. observe: is called at the end of each round; turn: a rotation that was measured, which
    tells basins and bodies apart; ahead: a pose that is likely, from which the keypoints were
    followed: exactly enough for the first round to go by them alone.
    """
    found = _track(surface, K, y, starts, config, prior, observe, turn, np.ones(len(y), bool),
                   ahead)
    if found is None:
        return None
    track, begun = found
    if len(starts) == 1:
        return track
    if turn is not None and not turn.may_be(track.pose.R):
        for rival in begun.rivals:
            led = _track(surface, K, y, [rival], config, prior, observe, None,
                         np.ones(len(y), bool))
            if led is not None and turn.prefers(led[0].pose.R, track.pose.R):
                track = led[0]
    second = second_motion(begun.problem, begun.places, track.pose, begun.scale,
                           config.min_matches)
    if second is None:
        return track
    taken, other, guess = _of_the_camera(second, prior, turn)
    if taken is second.pose:
        members = np.zeros(len(y), bool)
        members[begun.voting] = second.members
        again = _track(surface, K, y, [taken], config, prior, observe, None, members)
        track = again[0] if again is not None else track
    return replace(track, rivals=(Rival(other, 0.0),), guess=True) if guess else track


class _FirstRound(NamedTuple):
    """
    The first round: its problem, the pixels (M, 2) of its matches, and (N,) bool which.

    rivals: the poses of other basins; scale: noise of the surfaces alone, at the end.
    """

    problem: JetProblem
    places: Array
    voting: NDArray[np.bool_]
    rivals: tuple[Pose, ...]
    scale: float


def _track(surface: ResidualSurface, K: Array, y: Array, starts: list[Pose],
           config: EstimatorConfig, prior: Pose | None, observe: Observer | None,
           turn: Turn | None, alive: NDArray[np.bool_],
           ahead: Ahead | None = None) -> tuple[Track, _FirstRound] | None:
    """Run Algorithm 1 on the matches that are alive, a mask (N,) bool."""
    keypoints, placed, losses = y.copy(), y.copy(), np.full(len(y), np.nan)
    poses, begun = starts, None
    # Places that were followed tell the pose well enough to sample surfaces only once: around them
    # on its lines, as it stretches the patches.
    by_places = ahead is not None and config.max_iterations > 1
    warp: Array | None = None
    rival_poses: tuple[Pose, ...] = ()
    rivals: tuple[Rival, ...] = ()
    plausible, ours = np.ones(len(y), bool), np.ones(len(y), bool)
    for iteration in range(1, config.max_iterations + 1):
        # Step 1: update the local residuals around the keypoints and fit A', b, c.
        fits = (ReprojectionSurface(surface.x, y) if by_places else surface).around(keypoints,
                                                                                    warp)
        paraboloids, no_minimum = with_minimum(fits, config.indefinite)
        # Match culling: a keypoint without a surface is out, and keeps its last loss.
        alive = alive & paraboloids.usable
        voting = alive & plausible & ours & (
            # The rest is extrapolation.
            paraboloids.minimum_within(config.window // 2) | (not config.cull_outside))
        if voting.sum() < config.min_matches:
            return None
        # Step 2: global pose optimisation.
        places = surface.x[voting]
        problem = jet_problem(K, places, paraboloids.of(voting), TUNING.epipole_blur,
                              config.weigh_by_fit)
        basin = _basin(problem, places, poses, config, prior, turn, ahead)
        begun = begun or _FirstRound(problem, places, voting, basin.rivals, basin.scale)
        rival_poses = rival_poses or basin.rivals
        loss = Loss(config.loss, config.loss_scale * basin.scale)
        solution = minimise(problem, basin.pose.R, basin.pose.t, loss,
                            TUNING.steps_by_places if by_places else MAX_STEPS, basin.residuals)
        converged = len(poses) == 1 and change(basin.pose, solution.pose) < config.epsilon
        last = converged or iteration == config.max_iterations
        if last:
            begun = begun._replace(scale=_scale(solution.residuals.r))
        if last and config.join_matches and config.method != 'rpe':
            # Step 2 once more: where matches are found is a measurement of its own.
            placed[voting] = y[voting] if warp is None else surface.placed(y, warp, voting)
            problem, solution, loss = _joined(problem, K, placed[voting], solution, loss, config)
        if last and rival_poses:
            # Judge again between the basins, on all that is known.
            solution, rivals = judged(problem, places, solution, rival_poses, loss, prior)
        pose = solution.pose
        if basin.others_move:
            # What does not fit may be most, and would tell a wrong noise.
            ours[voting] = np.abs(solution.residuals.r) < TUNING.by_itself * loss.scale
        # Keypoints go towards their optimum on the epipolar line of the new pose.
        optimum = _optimum_on_line(paraboloids, surface.x, fundamental(K, pose.R, pose.t))
        losses[alive] = paraboloids.values(optimum)[alive]
        if observe is not None:
            observe(Round(keypoints, fits, warp, pose, optimum))
        poses, by_places = [pose], False
        if last:
            break
        keypoints = np.where(alive[:, None], _advance(keypoints, optimum, config), keypoints)
        if config.warp_reference:
            warp, plausible = _warps(pose, K, surface.x, optimum)
    assert begun is not None  # there is at least one iteration
    minima = paraboloids.minima()
    minima[voting] = (K @ problem.rays_y)[:2].T
    return Track(pose, loss, solution.residuals, voting, minima, placed, optimum, losses,
                 no_minimum, iteration, rivals), begun


def _joined(problem: JetProblem, K: Array, y: Array, solution: Solution, loss: Loss,
            config: EstimatorConfig) -> tuple[JetProblem, Solution, Loss]:
    """Optimise the pose by surfaces and by where matches were found, y (N, 2), together."""
    problem = with_places(problem, solution, K, y)
    agreeing = np.abs(solution.residuals.r) < loss.scale
    residuals = epipolar_residuals(problem, solution.R, solution.t)
    loss = replace(loss, scale=config.loss_scale * _scale(residuals.r[agreeing]))
    return problem, minimise(problem, solution.R, solution.t, loss, MAX_STEPS, residuals), loss


def hold(surface: ResidualSurface, K: Array, y: Array, pose: Pose) -> Track:
    """Take a pose as it is, and look at the surfaces there: the 5-point method's last word."""
    paraboloids = surface.around(y)
    voting = paraboloids.usable
    residuals = epipolar_residuals(jet_problem(K, surface.x, paraboloids), pose.R, pose.t)
    optimum = _optimum_on_line(paraboloids, surface.x, fundamental(K, pose.R, pose.t))
    return Track(pose, Loss(), residuals, voting, paraboloids.minima(), y, optimum,
                 paraboloids.values(optimum), 0, 0)


def _basin(problem: JetProblem, places: Array, poses: list[Pose], config: EstimatorConfig,
           prior: Pose | None, turn: Turn | None, ahead: Ahead | None) -> Basin:
    """Take the right basin of several poses, of those around one ahead, or of the only one."""
    if len(poses) > 1:
        return right_basin(problem, places, poses, config, prior, turn)
    if not poses and ahead is not None:
        return basin_ahead(problem, places, ahead, config)
    return basin_of(problem, poses[0])


def _of_the_camera(second: SecondMotion, prior: Pose | None, turn: Turn | None
                   ) -> tuple[Pose, Pose, bool]:
    """
    Tell the camera's motion from that of another body, and whether that is a guess.

    Where nothing tells, it is the wider one, for the world surrounds what moves in it.
    """
    told = _told_apart(second, prior, turn)
    taken = int(second.width > 1) if told is None else told
    return second.both[taken], second.both[1 - taken], told is None


def _told_apart(second: SecondMotion, prior: Pose | None, turn: Turn | None) -> int | None:
    """
    Tell which of two motions, 0 or 1, is the camera's; None where that would be a guess.

    It is the one that turns as was measured, or that goes on like the motion before; the one that
    many more places of the image follow; or the one whose points reach from near to far, if those
    of the other do not.
    """
    both, orders = second.both, ((0, 1), (1, 0))
    for one, other in orders:
        if turn is not None and turn.prefers(both[one].R, both[other].R):
            return one
    for one, other in orders:
        if prior is not None and goes_on(prior, both[one], both[other]):
            return one
    if second.width < TUNING.small_body:
        return 0
    for one, other in orders:
        if second.flatness[one] < TUNING.deep and second.flatness[other] > TUNING.flat:
            return one
    return None


def _scale(residuals: Array) -> float:
    return max(core_scale(residuals), LEAST_SCALE)


def _optimum_on_line(paraboloids: Paraboloids, x: Array, F: Array) -> Array:
    """Places y + v_opt (N, 2) for the paraboloids around their centres."""
    lines = epipolar_lines(F, x)
    h = -values_on(lines, paraboloids.centres)
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
    """
    Tell how patches at x are seen at y, as they are where that is not plausible.

    They lean as depths around them say; where that makes them too unlike, they face the camera.
    """
    rays_x, rays_y = rays(K, x), rays(K, y)
    seen = growth(pose.R, pose.t, rays_x, rays_y)
    # Of the same size without any parallax, or on the epipole; gone where it comes too near.
    seen = np.where(np.isfinite(seen), seen, np.where(np.isnan(seen), 1.0, -1.0))
    warp = patch_warp(K, pose.R, y, seen)
    plausible = (seen > 0) & comparable(warp)
    warp = np.where(plausible[:, None, None], warp, np.eye(3, 2))
    # Neighbours tell how the surface leans that a patch is on.
    there = np.flatnonzero(plausible)
    x, y = x[there], y[there]
    rho, sigma = inverse_depths(pose.R, pose.t, rays_x[there], rays_y[there])
    slopes = slopes_of_all(x, rho, TUNING.off / K[0, 0] * sigma)
    leaning = warp[there] + slant_warp(K, pose.t, y, seen[there], slopes)
    alike = comparable(leaning)
    warp[there[alike]] = leaning[alike]
    return warp, plausible
