"""Algorithm 1 of the paper: alternate between surfaces and pose until the pose converges."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

from djet_ros.core.basins import (
    basin_of,
    BASIN_TUNING,
    choose_among_rivals,
    choose_basin,
    choose_predicted_basin,
    likeliest,
    lowest_nearby_minimum,
    MIN_SCALE,
)
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.fusion import MeasuredRotation
from djet_ros.core.geometry import (
    depth_ratio,
    epipolar_lines,
    fundamental,
    inverse_depths,
    line_distances,
    line_values,
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
    robust_scale,
    Solution,
)
from djet_ros.core.joining import fuse_alignment
from djet_ros.core.pair import Limits, Pair, Round
from djet_ros.core.paraboloid import constrained_minimum, Paraboloids
from djet_ros.core.patches import Aligned, unaligned
from djet_ros.core.rivals import (
    continues_motion,
    DECIDED,
    DEEP_RATIO,
    is_planar,
    motion_without_attached,
    planar_twin,
    pose_distance,
    preferences,
    refined_rivals,
    Rival,
    second_motion,
    SecondMotion,
    unsigned_distance,
)
from djet_ros.core.sketch import losses_in_front, refine_all
from djet_ros.core.slants import slopes_of_all
from djet_ros.core.starts import KnownMotion
from djet_ros.core.surfaces import (
    has_moderate_stretch,
    ReprojectionSurface,
    ResidualSurface,
    resolve_indefinite,
)
from djet_ros.core.types import Array, Pose
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class TrackTuning:
    """Constants of the optimisation, each with its origin ("chosen" is an empirical value)."""

    # loss scales; chosen: if most matches follow another motion, matches beyond this are removed,
    # where they have next to no weight anyway
    cull_factor: float = 2.0
    # share of the area of the other motion's matches; chosen: a body smaller than this is not
    # mistaken for the static world
    small_body: float = 0.3
    # ratio of near to far depth; chosen: a body is about as deep as it is wide, and no nearer than
    # its depth
    compact_body: float = 0.5
    # chosen: optimiser steps in a first round on matched points, whose pose only places the
    # surfaces
    first_round_steps: int = 2
    # chosen: factor on the noise limit of a pair after that first round
    first_round_noise: float = 1.25
    # pixels; chosen: noise of inliers when planes are fitted to their depths
    depth_noise: float = 0.1
    # robust standard deviations; usual inlier threshold
    inlier: float = 3.0


TRACK_TUNING = TrackTuning()


@dataclass(frozen=True)
class Track:
    """
    The result of Algorithm 1.

    pose; problem: the final least-squares problem of the voting matches; loss: its robust loss;
    residuals: those at the pose; voting: (N,) bool, matches that took part; placed:
    photometrically aligned y (N, 2) under the last warp, or y itself without alignment; minima:
    (N, 2) minima y* of the surfaces, combined with `placed` for voting matches; y_opt: (N, 2) the
    final step onto the epipolar line; losses: (N,) last known surface values; rounds: the rounds
    that were made; rivals: other motions that explain the voting matches; nearby: other minima in
    the basin of the pose; body_ambiguous: whether two bodies move and nothing decides which of
    them is the static world (the other motion is the rival); attached: (N,) bool, matches on what
    moves with the camera, which the pose still includes, None if there are none.
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
    rounds: tuple[Round, ...] = ()
    rivals: tuple[Rival, ...] = ()
    nearby: tuple[Rival, ...] = ()
    body_ambiguous: bool = False
    attached: NDArray[np.bool_] | None = None

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
        agree = np.abs(self.residuals.r) < TRACK_TUNING.inlier * self.scale
        inliers = self.voting.copy()
        inliers[inliers] = agree
        return inliers


def track_jointly(pair: Pair, surface: ResidualSurface, starts: list[Pose],
                  config: EstimatorConfig, predicted: Pose | None = None) -> Track | None:
    """
    Optimise the pose and the places of the keypoints on their epipolar lines jointly.

    surface: residual surfaces on the matches of the pair. The starts are refined, and the best
    basin is taken; if the matches do not decide between basins, each is optimised to the end, and
    if they still do not, the one nearest to the previous motion is taken. Without starts, basins
    are sought around the predicted motion; the keypoints were tracked from its prediction,
    accurately enough for round one to use re-projection errors in place of surfaces. If two bodies
    move, the camera's motion is returned, as far as it can be identified. None if too few matches
    have a usable surface, or if the pair exceeds its limits.
    """
    all_alive, measured = np.ones(len(pair.y), bool), pair.known.rotation
    algorithm = _Algorithm(pair, surface, config, all_alive)
    track = algorithm.run(starts, predicted, pair.limits)
    if track is None or len(starts) == 1:
        return track
    first = algorithm.first
    algorithm, track = _resolve_basins(algorithm, track, pair, surface, config, predicted)
    rivals = _planar_preferences(track, first, surface.x)
    if rivals is not track.rivals:
        track = replace(track, rivals=rivals)
    if measured is not None and not measured.compatible_with(track.pose.R):
        for rival in first.rivals:
            candidate = _Algorithm(_images_only(pair), surface, config, all_alive).run([rival])
            if candidate is not None and measured.prefers(candidate.pose.R, track.pose.R):
                track = candidate
    fixed = np.linalg.norm(pair.y - pair.x, axis=1) < TRACK_TUNING.inlier * algorithm.noise
    world = motion_without_attached(first.problem, fixed[first.voting], track.pose,
                                    algorithm.noise, config.min_matches, pair.prior)
    if world is not None and (measured is None or not measured.prefers(track.pose.R, world.R)):
        return replace(track, attached=fixed)
    track = _with_planar_twin(track, pair)
    second = second_motion(first.problem, first.places, track.pose, algorithm.noise,
                           config.min_matches)
    if second is None:
        return track
    taken, other, guess = _camera_motion(second, pair.prior, measured)
    if taken is second.pose:
        members = np.zeros(len(pair.y), bool)
        members[first.voting] = second.members
        track = _Algorithm(_images_only(pair), surface, config, members).run([taken]) or track
    return replace(track, rivals=(Rival(other, 0.0),), body_ambiguous=True) if guess else track


def _images_only(pair: Pair) -> Pair:
    """Return a pair without measurements from other sources than the images."""
    return replace(pair, known=KnownMotion())


def _resolve_basins(algorithm: _Algorithm, track: Track, pair: Pair, surface: ResidualSurface,
                    config: EstimatorConfig, predicted: Pose | None) -> tuple[_Algorithm, Track]:
    """
    Optimise all basins to the end if the matches do not decide between them, and choose again.

    After round one keypoints and patch warps follow one pose, which favours it: a wrong pose keeps
    matches that suit it, at three times the noise of the right one. Matches that do not vote cost
    as much as outliers. Re-projection errors do not depend on the pose that places them, and are
    compared already.
    """
    if config.method == 'rpe' or all(rival.preference >= DECIDED for rival in track.rivals):
        return algorithm, track
    first = algorithm.first
    starts = sorted([first.solution.pose, *first.rivals],
                    key=lambda pose: unsigned_distance(track.pose, pose))
    ends = [(algorithm, track)]
    for pose in starts[1:]:
        candidate = _Algorithm(pair, surface, config, np.ones(len(pair.y), bool))
        end = candidate.run([pose], predicted)
        if end is not None:
            ends.append((candidate, end))
    loss = Loss('geman_mcclure', config.loss_scale * min(end.scale for _, end in ends))
    losses = np.full((len(ends), len(pair.y)), loss.scale**2)
    for row, (_, end) in zip(losses, ends):
        row[end.voting] = loss(end.residuals.r**2)[0]
    poses = [end.pose for _, end in ends]
    best = likeliest(losses, surface.x, poses, pair.prior)
    algorithm, track = ends[best]
    rivals = [Rival(pose, float(preference))
              for pose, preference in zip(poses, preferences(losses, surface.x, best))
              if unsigned_distance(track.pose, pose) > BASIN_TUNING.same_basin]
    return algorithm, replace(track, rivals=tuple(rivals))


def _planar_preferences(track: Track, first: _Optimised, x: Array) -> tuple[Rival, ...]:
    """
    Limit the preferences over rivals to what chirality decides, if the scene is one plane.

    x: (N, 2) pixels of the matches. Two motions explain all matches of one plane (Longuet-Higgins,
    Proc. R. Soc. B 1986), and which fits better is noise; only points behind a camera can exclude
    one. That is tested in round one, where both motions are evaluated at the same places: in later
    rounds keypoints and warps follow the current pose, which favours itself.
    """
    if not (first.rivals and any(rival.preference >= DECIDED for rival in track.rivals)):
        return track.rivals
    agree = track.inliers()
    if not is_planar(x[agree], track.placed.places[agree], track.scale):
        return track.rivals
    ours = first.nearest(track.pose)
    preferred = preferences(first.chirality_losses(), first.places, ours)
    # A rival that was in the same basin in round one is not compared by it.
    preferred[ours] = np.inf
    return tuple(replace(rival, preference=min(
        rival.preference, float(preferred[first.nearest(rival.pose)])))
        for rival in track.rivals)


def _with_planar_twin(track: Track, pair: Pair) -> Track:
    """
    Add the second motion of a plane to the nearby minima, if no start led close to it.

    If the camera moves nearly along the normal of the plane, both are in one basin, and all starts
    may end at the same one.
    """
    agree = track.inliers()
    other = planar_twin(track.pose, pair.current.K, pair.x[agree],
                        track.placed.places[agree], track.scale) if agree.any() else None
    if other is None:
        return track
    near = unsigned_distance(track.pose, other.pose) / 2
    if any(unsigned_distance(rival.pose, other.pose) < near
           for rival in (*track.rivals, *track.nearby)):
        return track
    return replace(track, nearby=(*track.nearby, other))


@dataclass(frozen=True)
class _Optimised:
    """
    Step 2 of a round: the problem of the M voting matches, and its solution.

    voting: (N,) bool; places: (M, 2) their pixels in the previous image; rivals: poses of other
    basins.
    """

    voting: NDArray[np.bool_]
    places: Array
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
        return int(np.argmin([unsigned_distance(one, pose) for one in self.basins]))


class _Algorithm:
    """
    Algorithm 1 of the paper on the matches (N,) of a pair that are alive.

    first: step 2 of the first round; noise: that of the surfaces alone, at the end, in pixels.
    """

    first: _Optimised
    noise: float

    def __init__(self, pair: Pair, surface: ResidualSurface, config: EstimatorConfig,
                 alive: NDArray[np.bool_]) -> None:
        self._pair, self._surface, self._config = pair, surface, config
        self._K = pair.current.K
        self._keypoints, self._losses = pair.y.copy(), np.full(len(pair.y), np.nan)
        self._alive = alive
        self._plausible, self._on_motion = np.ones(len(pair.y), bool), np.ones(len(pair.y), bool)
        self._warp: Array | None = None

    def run(self, starts: list[Pose], predicted: Pose | None = None,
            limits: Limits | None = None) -> Track | None:
        """
        Make rounds until the pose converges; None if too few matches have a surface.

        limits: also None as soon as they are exceeded.
        """
        limits = limits or Limits()
        poses, most, rounds = starts, self._config.max_iterations, []
        # If the matches were predicted and tracked, their pose is accurate enough to sample
        # surfaces only once: around their places on its epipolar lines, under its patch warps.
        by_points = predicted is not None and most > 1
        for number in range(1, most + 1):
            # Step 1: update the local residuals around the keypoints and fit A', b, c.
            fits = self._fits(by_points)
            # Re-projection paraboloids always have a minimum.
            paraboloids, no_minimum = ((fits, 0) if by_points
                                       else resolve_indefinite(fits, self._config.indefinite))
            # Match culling: a keypoint without a surface is dropped, and keeps its last loss.
            voting = self._voting(paraboloids)
            if (voting.sum() < self._config.min_matches
                    or voting.sum() <= limits.min_agreeing * len(voting)):
                return None
            # Step 2: global pose optimisation.
            found = self._optimised(paraboloids, voting, poses, predicted, by_points)
            if number == 1:
                self.first = found
            last = (found.converged and self._is_warped) or number == most
            if last:
                found, placed, rivals, nearby = self._concluded(found)
            # Keypoints move towards their optimum on the epipolar line of the new pose.
            pose = found.solution.pose
            if by_points and (self._match_noise(pose)
                              > TRACK_TUNING.first_round_noise * limits.max_noise):
                return None
            optimum = _optimum_on_line(paraboloids, self._surface.x,
                                       fundamental(self._K, pose.R, pose.t))
            self._losses[self._alive] = paraboloids.values(optimum)[self._alive]
            rounds.append(Round(self._keypoints, fits, self._warp, pose, optimum))
            if last:
                break
            self._advance(pose, optimum)
            poses, by_points = [pose], False
        minima = paraboloids.minima()
        minima[voting] = (self._K @ found.problem.rays_y)[:2].T
        return Track(pose, found.problem, found.loss, found.solution.residuals, voting, minima,
                     placed, optimum, self._losses, no_minimum, tuple(rounds), rivals, nearby)

    @property
    def _is_warped(self) -> bool:
        """Return whether the surfaces are sampled under warps, if these are in use."""
        return (self._warp is not None or not self._config.warp_reference
                or self._config.method == 'rpe')

    def _fits(self, by_points: bool) -> Paraboloids:
        """Fit surfaces around the keypoints, or paraboloids of re-projection errors."""
        surface = (ReprojectionSurface(self._surface.x, self._pair.y) if by_points
                   else self._surface)
        return surface.fit_around(self._keypoints, self._warp)

    def _voting(self, paraboloids: Paraboloids) -> NDArray[np.bool_]:
        """Return which matches (N,) take part in the pose; drop those without a surface."""
        self._alive = self._alive & paraboloids.usable
        # Outside of the window a minimum is extrapolated.
        within = (paraboloids.minimum_within(self._config.window // 2)
                  | (not self._config.cull_outside))
        return np.asarray(self._alive & self._plausible & self._on_motion & within)

    def _optimised(self, paraboloids: Paraboloids, voting: NDArray[np.bool_], poses: list[Pose],
                   predicted: Pose | None, by_points: bool) -> _Optimised:
        """Choose a basin among the starting poses and optimise the pose in it."""
        config, places = self._config, self._surface.x.compress(voting, axis=0)
        problem = jet_problem(self._K, places, paraboloids.of(voting), config.epipole_blur,
                              config.weigh_by_fit and not by_points)
        if len(poses) > 1:
            basin = choose_basin(problem, places, poses, config, self._pair.prior,
                                 self._pair.known.rotation)
        elif not poses and predicted is not None:
            basin = choose_predicted_basin(problem, places, predicted, config)
        else:
            basin = basin_of(problem, poses[0])
        loss = Loss(config.loss, config.loss_scale * basin.scale)
        steps = TRACK_TUNING.first_round_steps if by_points else MAX_STEPS
        solution = minimise(problem, basin.pose.R, basin.pose.t, loss, steps, basin.residuals)
        converged = len(poses) == 1 and pose_distance(basin.pose, solution.pose) < config.epsilon
        if basin.camera_in_minority:
            # Matches of the other motion may be the majority, and would bias the noise estimate.
            bound = TRACK_TUNING.cull_factor * loss.scale
            self._on_motion[voting] = np.abs(solution.residuals.r) < bound
        return _Optimised(voting, places, problem, loss, solution, converged, basin.rivals)

    def _concluded(self, found: _Optimised
                   ) -> tuple[_Optimised, Aligned, tuple[Rival, ...], tuple[Rival, ...]]:
        """Add photometric alignment, and compare the pose with rivals and nearby minima."""
        pair, voting = self._pair, found.voting
        rivals: tuple[Rival, ...] = ()
        self.noise = _scale(found.solution.residuals.r)
        placed = unaligned(pair.y)
        if self._config.join_matches and self._config.method != 'rpe':
            # Step 2 once more: photometric alignment is a measurement of its own.
            exactly = self._surface.aligned(pair.y, self._warp, voting)
            placed.places[voting], placed.covariances[voting] = exactly
            found = _with_photometric(found, self._K, exactly, self._config)
        if self.first.rivals:
            # Choose among the basins again, with all measurements.
            solution, rivals = choose_among_rivals(found.problem, found.places, found.solution,
                                                   self.first.rivals, found.loss, pair.prior)
            found = replace(found, solution=solution)
        nearby: tuple[Rival, ...] = ()
        if self._config.loss != 'none':
            solution, nearby = lowest_nearby_minimum(found.problem, found.places, found.solution,
                                                     found.loss)
            found = replace(found, solution=solution)
        return found, placed, rivals, nearby

    def _match_noise(self, pose: Pose) -> float:
        """Return the robust standard deviation of the epipolar distances, in pixels."""
        lines = epipolar_lines(fundamental(self._K, pose.R, pose.t), self._surface.x)
        return robust_scale(line_distances(lines, self._pair.y))

    def _advance(self, pose: Pose, optimum: Array) -> None:
        """Move the keypoints to where the next round samples, and warp patches by the pose."""
        self._keypoints = np.where(self._alive[:, None],
                                   _advanced(self._keypoints, optimum, self._config),
                                   self._keypoints)
        if self._config.warp_reference:
            self._warp, self._plausible = _warps(pose, self._K, self._surface.x, optimum)


def _with_photometric(found: _Optimised, K: Array, placed: Aligned, config: EstimatorConfig
                      ) -> _Optimised:
    """Optimise the pose by surfaces and photometric alignment together."""
    solution = found.solution
    problem = fuse_alignment(found.problem, solution, K, placed)
    agreeing = np.abs(solution.residuals.r) < found.loss.scale
    residuals = epipolar_residuals(problem, solution.R, solution.t)
    loss = replace(found.loss, scale=config.loss_scale * _scale(residuals.r[agreeing]))
    return replace(found, problem=problem, loss=loss, solution=minimise(
        problem, solution.R, solution.t, loss, MAX_STEPS, residuals))


def evaluate_at(surface: ResidualSurface, K: Array, y: Array, pose: Pose) -> Track:
    """Evaluate the surfaces at a pose without optimising it: the result of method five_point."""
    paraboloids = surface.fit_around(y)
    voting = paraboloids.usable
    problem = jet_problem(K, surface.x, paraboloids)
    residuals = epipolar_residuals(problem, pose.R, pose.t)
    optimum = _optimum_on_line(paraboloids, surface.x, fundamental(K, pose.R, pose.t))
    return Track(pose, problem, Loss(), residuals, voting, paraboloids.minima(), unaligned(y),
                 optimum, paraboloids.values(optimum), 0)


def _camera_motion(second: SecondMotion, prior: Pose | None, measured: MeasuredRotation | None
                   ) -> tuple[Pose, Pose, bool]:
    """
    Return the motion of the camera, that of another body, and whether the choice is a guess.

    If nothing decides, the more spread-out one is taken, as the static world surrounds what moves
    in it.
    """
    decided = _decide_camera(second, prior, measured)
    taken = int(second.width > 1) if decided is None else decided
    return second.both[taken], second.both[1 - taken], decided is None


def _decide_camera(second: SecondMotion, prior: Pose | None,
                   measured: MeasuredRotation | None) -> int | None:
    """
    Return which of two motions, 0 or 1, is the camera's; None if undecided.

    It is the one with the measured rotation, or that continues the previous motion; the one with
    matches over a much larger area; or the one whose points span near to far depths while those of
    the other do not.
    """
    both, orders = second.both, ((0, 1), (1, 0))
    for one, other in orders:
        if measured is not None and measured.prefers(both[one].R, both[other].R):
            return one
    for one, other in orders:
        if prior is not None and continues_motion(prior, both[one], both[other]):
            return one
    if second.width < TRACK_TUNING.small_body:
        return 0
    for one, other in orders:
        compact = second.flatness[other] > TRACK_TUNING.compact_body
        if second.flatness[one] < DEEP_RATIO and compact:
            return one
    return None


def _scale(residuals: Array) -> float:
    return max(clipped_scale(residuals), MIN_SCALE)


def _optimum_on_line(paraboloids: Paraboloids, x: Array, F: Array) -> Array:
    """Places y + v_opt (N, 2) of least value on the epipolar lines, for paraboloids."""
    lines = epipolar_lines(F, x)
    h = -line_values(lines, paraboloids.centres)
    v = constrained_minimum(paraboloids.A, paraboloids.b, lines[:, :2], h)
    return np.asarray(paraboloids.centres + v)


def _advanced(keypoints: Array, optimum: Array, config: EstimatorConfig) -> Array:
    """Move keypoints towards their optimum by the configured strategy ("Keypoint iterations")."""
    step = optimum - keypoints
    if config.step == 'share':
        return keypoints + config.step_share * step
    length = np.linalg.norm(step, axis=1, keepdims=True)
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
    seen = depth_ratio(pose.R, pose.t, rays_x, rays_y)
    # Unit scale without parallax or on the epipole; not plausible behind the camera.
    seen = np.where(np.isfinite(seen), seen, np.where(np.isnan(seen), 1.0, -1.0))
    warp = patch_warp(K, pose.R, y, seen)
    plausible = (seen > 0) & has_moderate_stretch(warp)
    warp = np.where(plausible[:, None, None], warp, np.eye(3, 2))
    # The slant of a patch is estimated from the depths of its neighbours.
    there = np.flatnonzero(plausible)
    x, y, rays_x, rays_y = (places.take(there, axis=0) for places in (x, y, rays_x, rays_y))
    rho, sigma = inverse_depths(pose.R, pose.t, rays_x, rays_y)
    slopes = slopes_of_all(x, rho, TRACK_TUNING.depth_noise / K[0, 0] * sigma)
    slanted = warp.take(there, axis=0) + slant_warp(K, pose.t, y, seen[there], slopes)
    slant_ok = has_moderate_stretch(slanted)
    warp[there[slant_ok]] = slanted[slant_ok]
    return warp, plausible
