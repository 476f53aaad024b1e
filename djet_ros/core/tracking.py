"""Algorithm 1 of the paper: surfaces and pose in turn, until the pose rests."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

from djet_ros.core.basins import (
    basin_ahead,
    basin_of,
    BASIN_TUNING,
    judged,
    LEAST_SCALE,
    likeliest,
    lowest_around,
    right_basin,
)
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.fusion import Turn
from djet_ros.core.geometry import (
    epipolar_lines,
    fundamental,
    growth,
    inverse_depths,
    line_distances,
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
    robust_scale,
    Solution,
)
from djet_ros.core.joining import with_places
from djet_ros.core.pair import Limits, Pair, Round
from djet_ros.core.paraboloid import constrained_minimum, Paraboloids
from djet_ros.core.patches import as_matched, Placed
from djet_ros.core.rivals import (
    apart,
    carried_along,
    change,
    DECIDED,
    DEEP,
    goes_on,
    lie_on_a_plane,
    other_of_a_plane,
    preferences,
    refined_rivals,
    Rival,
    second_motion,
    SecondMotion,
)
from djet_ros.core.sketch import losses_in_front, refine_all
from djet_ros.core.slants import slopes_of_all
from djet_ros.core.starts import Known
from djet_ros.core.surfaces import comparable, ReprojectionSurface, ResidualSurface, with_minimum
from djet_ros.core.types import Array, Pose
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class TrackTuning:
    """Constants of the optimisation, each with where it comes from ("chosen" was not searched)."""

    # bends of the loss; chosen: beyond, a match has next to no weight anyway
    by_itself: float = 2.0
    # chosen: a body spread over less than this share of the area of the world's matches is not
    # mistaken for it
    small_body: float = 0.3
    # near end over far end: chosen, a body is about as deep as it is wide, and stands no nearer
    # than that
    flat: float = 0.5
    # chosen: steps on all matches to a pose that surfaces are only placed by
    steps_by_places: int = 2
    # chosen: by what matches may be noisier after the first round than in the end, where they are
    # held against the limits of their pair
    noisier_at_first: float = 1.25
    # pixels; chosen: what right matches are off, where planes are fitted to their depths
    off: float = 0.1
    # robust standard deviations; the usual three, within which a match agrees with a pose
    inlier: float = 3.0


TRACK_TUNING = TrackTuning()


@dataclass(frozen=True)
class Track:
    """
    Where Algorithm 1 ended.

    pose; problem: that of the voting matches, in the end; loss: the robust loss in force;
    residuals: those of the problem at the pose; voting: (N,) bool, matches that took part; placed:
    where gray levels have y (N, 2), through the last warp, or y itself where that was not asked;
    minima: (N, 2) the surfaces' own minima y*, joined with these for matches that voted; y_opt:
    (N, 2) the final step onto the epipolar line; losses: (N,) last known surface values; rounds:
    what led there; rivals: other motions that explain the voting matches; beside: other minima in
    the basin of the pose; guess: whether there are rivals because two bodies move, and nothing
    tells which is the world; carried: (N,) bool, matches that are carried along by the camera, and
    which the pose has not been told without yet, None where there are none.
    """

    pose: Pose
    problem: JetProblem
    loss: Loss
    residuals: Residuals
    voting: NDArray[np.bool_]
    minima: Array
    placed: Placed
    y_opt: Array
    losses: Array
    indefinite: int
    rounds: tuple[Round, ...] = ()
    rivals: tuple[Rival, ...] = ()
    beside: tuple[Rival, ...] = ()
    guess: bool = False
    carried: NDArray[np.bool_] | None = None

    @property
    def iterations(self) -> int:
        """Give how many rounds were made."""
        return len(self.rounds)

    @cached_property
    def scale(self) -> float:
        """Give the robust standard deviation of the residuals, in pixels of a typical surface."""
        return _scale(self.residuals.r)

    def inliers(self) -> NDArray[np.bool_]:
        """(N,) bool mask of the matches that voted and agree with the pose."""
        agree = np.abs(self.residuals.r) < TRACK_TUNING.inlier * self.scale
        inliers = self.voting.copy()
        inliers[inliers] = agree
        return inliers


def track_jointly(pair: Pair, surface: ResidualSurface, starts: list[Pose],
                  config: EstimatorConfig, ahead: Pose | None = None) -> Track | None:
    """
    Optimise the pose and the keypoints' places on their epipolar lines jointly.

    surface: on the matches of the pair. The cheapest of the refined `starts` goes on; of those
    that the matches do not decide between, each is led to its own end, and the one next to the
    motion before is taken where they are still undecided. Without any starts they are looked for
    around the pose ahead, which is likely, and from which the keypoints were followed: accurately
    enough that round one uses re-projection errors instead of surfaces. Where two bodies move, it
    is the camera's motion, as far as that can be told. None where too few matches have a usable
    surface, or where the pair is beyond its limits.
    """
    everything, turn = np.ones(len(pair.y), bool), pair.known.turn
    algorithm = _Algorithm(pair, surface, config, everything)
    track = algorithm.run(starts, ahead, pair.limits)
    if track is None or len(starts) == 1:
        return track
    first = algorithm.first
    algorithm, track = _contested(algorithm, track, pair, surface, config, ahead)
    rivals = _of_one_plane(track, first, surface.x)
    if rivals is not track.rivals:
        track = replace(track, rivals=rivals)
    if turn is not None and not turn.may_be(track.pose.R):
        for rival in first.rivals:
            led = _Algorithm(_untold(pair), surface, config, everything).run([rival])
            if led is not None and turn.prefers(led.pose.R, track.pose.R):
                track = led
    kept = np.linalg.norm(pair.y - pair.x, axis=1) < TRACK_TUNING.inlier * algorithm.noise
    world = carried_along(first.problem, kept[first.voting], track.pose, algorithm.noise,
                          config.min_matches, pair.before)
    if world is not None and (turn is None or not turn.prefers(track.pose.R, world.R)):
        return replace(track, carried=kept)
    track = _with_other_of_a_plane(track, pair)
    second = second_motion(first.problem, first.places, track.pose, algorithm.noise,
                           config.min_matches)
    if second is None:
        return track
    taken, other, guess = _of_the_camera(second, pair.before, turn)
    if taken is second.pose:
        members = np.zeros(len(pair.y), bool)
        members[first.voting] = second.members
        track = _Algorithm(_untold(pair), surface, config, members).run([taken]) or track
    return replace(track, rivals=(Rival(other, 0.0),), guess=True) if guess else track


def _untold(pair: Pair) -> Pair:
    """Give a pair of which nothing is known but its images."""
    return replace(pair, known=Known())


def _contested(algorithm: _Algorithm, track: Track, pair: Pair, surface: ResidualSurface,
               config: EstimatorConfig, ahead: Pose | None) -> tuple[_Algorithm, Track]:
    """
    Lead all basins to their own ends where the matches decide between none, and choose once more.

    After the first round keypoints lie, and patches are warped, as one pose has them, which
    favours it: a wrong one keeps matches that suit it, at three times the noise of the right one.
    A match that has no vote costs what one does that is far off. Re-projection errors are the same
    whatever pose they are seen by, and judged already.
    """
    if config.method == 'rpe' or all(rival.preference >= DECIDED for rival in track.rivals):
        return algorithm, track
    first = algorithm.first
    began = sorted([first.solution.pose, *first.rivals], key=lambda pose: apart(track.pose, pose))
    ends = [(algorithm, track)]
    for pose in began[1:]:
        led = _Algorithm(pair, surface, config, np.ones(len(pair.y), bool))
        end = led.run([pose], ahead)
        if end is not None:
            ends.append((led, end))
    loss = Loss('geman_mcclure', config.loss_scale * min(end.scale for _, end in ends))
    losses = np.full((len(ends), len(pair.y)), loss.scale**2)
    for row, (_, end) in zip(losses, ends):
        row[end.voting] = loss(end.residuals.r**2)[0]
    poses = [end.pose for _, end in ends]
    best = likeliest(losses, surface.x, poses, pair.before)
    algorithm, track = ends[best]
    rivals = [Rival(pose, float(preference))
              for pose, preference in zip(poses, preferences(losses, surface.x, best))
              if apart(track.pose, pose) > BASIN_TUNING.same_basin]
    return algorithm, replace(track, rivals=tuple(rivals))


def _of_one_plane(track: Track, first: _Optimised, x: Array) -> tuple[Rival, ...]:
    """
    Prefer a pose to its rivals by no more than chirality does, where all is one plane.

    x: (N, 2) pixels of the matches. The lines of two motions go through all that one plane shows
    (Longuet-Higgins, Proc. R. Soc. B 1986), and which are nearer is noise; the other motion may
    only have part of it behind a camera. That is asked of the first round, where both are held
    against the same places: later ones lie, and patches are warped, as the pose that was led on
    has them, and it makes itself sure.
    """
    if not (first.rivals and any(rival.preference >= DECIDED for rival in track.rivals)):
        return track.rivals
    agree = track.inliers()
    if not lie_on_a_plane(x[agree], track.placed.places[agree], track.scale):
        return track.rivals
    ours = first.nearest(track.pose)
    preferred = preferences(first.losses_behind(), first.places, ours)
    # What was in the same basin then is not held against it.
    preferred[ours] = np.inf
    return tuple(replace(rival, preference=min(
        rival.preference, float(preferred[first.nearest(rival.pose)])))
        for rival in track.rivals)


def _with_other_of_a_plane(track: Track, pair: Pair) -> Track:
    """
    Hold the other motion of a plane against a pose, where the starts led to none that is near it.

    Where the camera goes nearly towards the plane both are in one basin, and all starts may end at
    the same one.
    """
    agree = track.inliers()
    other = other_of_a_plane(track.pose, pair.current.K, pair.x[agree],
                             track.placed.places[agree], track.scale) if agree.any() else None
    if other is None or any(apart(rival.pose, other.pose) < apart(track.pose, other.pose) / 2
                            for rival in (*track.rivals, *track.beside)):
        return track
    return replace(track, beside=(*track.beside, other))


@dataclass(frozen=True)
class _Optimised:
    """
    Step 2 of a round: the problem of the M matches that voted, and its solution.

    voting: (N,) bool, which they are; places: (M, 2) their pixels in the previous image; rivals:
    the poses of other basins.
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
        """Give the poses of all basins, its own first, each where its own matches have it."""
        return [self.solution.pose, *refined_rivals(self.problem, self.rivals, self.loss)]

    def losses_behind(self) -> Array:
        """Losses (S, M) of matches for lying behind a camera, by the poses of all basins."""
        lines = refine_all(self.problem, self.basins, self.loss, 0)
        on_lines = lines.sign * self.loss(lines.r**2)[0]
        return losses_in_front(self.problem, lines, self.loss) - on_lines

    def nearest(self, pose: Pose) -> int:
        """Tell the number of the basin that a pose is next to."""
        return int(np.argmin([apart(one, pose) for one in self.basins]))


class _Algorithm:
    """
    Algorithm 1 of the paper on those matches (N,) of a pair that are alive.

    first: step 2 of the first round; noise: of the surfaces alone, at the end, in pixels.
    """

    first: _Optimised
    noise: float

    def __init__(self, pair: Pair, surface: ResidualSurface, config: EstimatorConfig,
                 alive: NDArray[np.bool_]) -> None:
        self._pair, self._surface, self._config = pair, surface, config
        self._K = pair.current.K
        self._keypoints, self._losses = pair.y.copy(), np.full(len(pair.y), np.nan)
        self._alive = alive
        self._plausible, self._ours = np.ones(len(pair.y), bool), np.ones(len(pair.y), bool)
        self._warp: Array | None = None

    def run(self, starts: list[Pose], ahead: Pose | None = None,
            limits: Limits | None = None) -> Track | None:
        """
        Take rounds until the pose rests; None where too few matches have a surface.

        limits: what it is given up beyond, as soon as it is.
        """
        limits = limits or Limits()
        poses, most, rounds = starts, self._config.max_iterations, []
        # Places that were followed tell the pose well enough to sample surfaces only once: around
        # them on its lines, as it stretches the patches.
        by_places = ahead is not None and most > 1
        for number in range(1, most + 1):
            # Step 1: update the local residuals around the keypoints and fit A', b, c.
            fits = self._fits(by_places)
            # Places by themselves have one, and nothing is left over there.
            paraboloids, no_minimum = ((fits, 0) if by_places
                                       else with_minimum(fits, self._config.indefinite))
            # Match culling: a keypoint without a surface is out, and keeps its last loss.
            voting = self._voting(paraboloids)
            if (voting.sum() < self._config.min_matches
                    or voting.sum() <= limits.agreeing * len(voting)):
                return None
            # Step 2: global pose optimisation.
            found = self._optimised(paraboloids, voting, poses, ahead, by_places)
            if number == 1:
                self.first = found
            last = (found.converged and self._seen_as_it_has_them) or number == most
            if last:
                found, placed, rivals, beside = self._concluded(found)
            # Keypoints go towards their optimum on the epipolar line of the new pose.
            pose = found.solution.pose
            if by_places and (self._noise_of_matches(pose)
                              > TRACK_TUNING.noisier_at_first * limits.noise):
                return None
            optimum = _optimum_on_line(paraboloids, self._surface.x,
                                       fundamental(self._K, pose.R, pose.t))
            self._losses[self._alive] = paraboloids.values(optimum)[self._alive]
            rounds.append(Round(self._keypoints, fits, self._warp, pose, optimum))
            if last:
                break
            self._advance(pose, optimum)
            poses, by_places = [pose], False
        minima = paraboloids.minima()
        minima[voting] = (self._K @ found.problem.rays_y)[:2].T
        return Track(pose, found.problem, found.loss, found.solution.residuals, voting, minima,
                     placed, optimum, self._losses, no_minimum, tuple(rounds), rivals, beside)

    @property
    def _seen_as_it_has_them(self) -> bool:
        """Whether surfaces are sampled as a pose has their patches: it is not at rest before."""
        return (self._warp is not None or not self._config.warp_reference
                or self._config.method == 'rpe')

    def _fits(self, by_places: bool) -> Paraboloids:
        """Fit surfaces around the keypoints, or take these as they are."""
        surface = (ReprojectionSurface(self._surface.x, self._pair.y) if by_places
                   else self._surface)
        return surface.around(self._keypoints, self._warp)

    def _voting(self, paraboloids: Paraboloids) -> NDArray[np.bool_]:
        """Tell which matches (N,) take part in the pose; those without a surface are dead."""
        self._alive = self._alive & paraboloids.usable
        # Outside of the window a minimum is extrapolated.
        within = (paraboloids.minimum_within(self._config.window // 2)
                  | (not self._config.cull_outside))
        return np.asarray(self._alive & self._plausible & self._ours & within)

    def _optimised(self, paraboloids: Paraboloids, voting: NDArray[np.bool_], poses: list[Pose],
                   ahead: Pose | None, by_places: bool) -> _Optimised:
        """Find the pose in the right basin of some."""
        config, places = self._config, self._surface.x.compress(voting, axis=0)
        problem = jet_problem(self._K, places, paraboloids.of(voting), config.epipole_blur,
                              config.weigh_by_fit and not by_places)
        if len(poses) > 1:
            basin = right_basin(problem, places, poses, config, self._pair.before,
                                self._pair.known.turn)
        elif not poses and ahead is not None:
            basin = basin_ahead(problem, places, ahead, config)
        else:
            basin = basin_of(problem, poses[0])
        loss = Loss(config.loss, config.loss_scale * basin.scale)
        steps = TRACK_TUNING.steps_by_places if by_places else MAX_STEPS
        solution = minimise(problem, basin.pose.R, basin.pose.t, loss, steps, basin.residuals)
        converged = len(poses) == 1 and change(basin.pose, solution.pose) < config.epsilon
        if basin.others_move:
            # What does not fit may be most, and would tell a wrong noise.
            self._ours[voting] = np.abs(solution.residuals.r) < TRACK_TUNING.by_itself * loss.scale
        return _Optimised(voting, places, problem, loss, solution, converged, basin.rivals)

    def _concluded(self, found: _Optimised
                   ) -> tuple[_Optimised, Placed, tuple[Rival, ...], tuple[Rival, ...]]:
        """Take in at the end where matches are found, and hold the pose against its rivals."""
        pair, voting = self._pair, found.voting
        rivals: tuple[Rival, ...] = ()
        self.noise = _scale(found.solution.residuals.r)
        placed = as_matched(pair.y)
        if self._config.join_matches and self._config.method != 'rpe':
            # Step 2 once more: where gray levels have matches is a measurement of its own.
            exactly = self._surface.placed(pair.y, self._warp, voting)
            placed.places[voting], placed.covariances[voting] = exactly
            found = _joined(found, self._K, exactly, self._config)
        if self.first.rivals:
            # Judge again between the basins, on all that is known.
            solution, rivals = judged(found.problem, found.places, found.solution,
                                      self.first.rivals, found.loss, pair.before)
            found = replace(found, solution=solution)
        beside: tuple[Rival, ...] = ()
        if self._config.loss != 'none':
            solution, beside = lowest_around(found.problem, found.places, found.solution,
                                             found.loss)
            found = replace(found, solution=solution)
        return found, placed, rivals, beside

    def _noise_of_matches(self, pose: Pose) -> float:
        """Tell how far matches are from their epipolar lines, in pixels."""
        lines = epipolar_lines(fundamental(self._K, pose.R, pose.t), self._surface.x)
        return robust_scale(line_distances(lines, self._pair.y))

    def _advance(self, pose: Pose, optimum: Array) -> None:
        """Move keypoints to where the next round samples, seen as the pose has it."""
        self._keypoints = np.where(self._alive[:, None],
                                   _advanced(self._keypoints, optimum, self._config),
                                   self._keypoints)
        if self._config.warp_reference:
            self._warp, self._plausible = _warps(pose, self._K, self._surface.x, optimum)


def _joined(found: _Optimised, K: Array, placed: Placed, config: EstimatorConfig) -> _Optimised:
    """Optimise the pose by surfaces and by where gray levels have matches, together."""
    solution = found.solution
    problem = with_places(found.problem, solution, K, placed)
    agreeing = np.abs(solution.residuals.r) < found.loss.scale
    residuals = epipolar_residuals(problem, solution.R, solution.t)
    loss = replace(found.loss, scale=config.loss_scale * _scale(residuals.r[agreeing]))
    return replace(found, problem=problem, loss=loss, solution=minimise(
        problem, solution.R, solution.t, loss, MAX_STEPS, residuals))


def hold(surface: ResidualSurface, K: Array, y: Array, pose: Pose) -> Track:
    """Take a pose as it is, and look at the surfaces there: the 5-point method's last word."""
    paraboloids = surface.around(y)
    voting = paraboloids.usable
    problem = jet_problem(K, surface.x, paraboloids)
    residuals = epipolar_residuals(problem, pose.R, pose.t)
    optimum = _optimum_on_line(paraboloids, surface.x, fundamental(K, pose.R, pose.t))
    return Track(pose, problem, Loss(), residuals, voting, paraboloids.minima(), as_matched(y),
                 optimum, paraboloids.values(optimum), 0)


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
    if second.width < TRACK_TUNING.small_body:
        return 0
    for one, other in orders:
        if second.flatness[one] < DEEP and second.flatness[other] > TRACK_TUNING.flat:
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


def _advanced(keypoints: Array, optimum: Array, config: EstimatorConfig) -> Array:
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
    x, y, rays_x, rays_y = (places.take(there, axis=0) for places in (x, y, rays_x, rays_y))
    rho, sigma = inverse_depths(pose.R, pose.t, rays_x, rays_y)
    slopes = slopes_of_all(x, rho, TRACK_TUNING.off / K[0, 0] * sigma)
    leaning = warp.take(there, axis=0) + slant_warp(K, pose.t, y, seen[there], slopes)
    alike = comparable(leaning)
    warp[there[alike]] = leaning[alike]
    return warp, plausible
