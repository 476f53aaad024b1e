"""From two views to their relative pose: the way of a pair on one screen."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from time import perf_counter

from djet_ros.core.basins import Ahead, TUNING as BASIN_TUNING
from djet_ros.core.corners import detect_corners
from djet_ros.core.covariance import difference, pose_covariance, spanning, squared_distance
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.features import detect_orb
from djet_ros.core.fusion import agrees
from djet_ros.core.geometry import (
    epipolar_lines,
    facing,
    fit_rotation,
    fundamental,
    line_distances,
    rays,
)
from djet_ros.core.hamming import match_distances, smooth
from djet_ros.core.jet import robust_scale
from djet_ros.core.masks import blocked, Mask
from djet_ros.core.matching import match_foreseen, match_widely, Matches, RIGID
from djet_ros.core.memory import keep_freed_memory
from djet_ros.core.paraboloid import quantile
from djet_ros.core.parallel import both
from djet_ros.core.rivals import DECIDED, false_alarms, goes_on
from djet_ros.core.starts import all_round, five_point, Known, known_starts, starting_poses
from djet_ros.core.surfaces import (
    DescriptorDistances,
    DescriptorSurface,
    PhotometricSurface,
    ReprojectionSurface,
    ResidualSurface,
)
from djet_ros.core.tracking import hold, Observer, Track, track_jointly, TUNING
from djet_ros.core.types import Array, Features, Pose, RelativePose, Status, View
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

# Bits that differ between the descriptors of matches beyond which they are no better than chance:
# 128 differ between places that have nothing to do with one another, and 20 to 40 between matches.
_CHANCE_BITS = 112

# chosen: by as much the distances of matches from their epipolar lines may grow from one pair to
# the next (1.4 was the most that was seen), and pixels that are not worth speaking of.
_NOISIER, _LEAST_NOISE = 1.5, 0.1

# Parallax has to exceed the noise of the matches by this factor to be believed.
_OUT_OF_NOISE = 3.0

# Squared Mahalanobis distance, over five degrees of freedom, that one pose of a thousand exceeds.
_SURPRISING = 20.5

# chosen: what a standard deviation of a preference counts, as neighbouring cells err together too.
_TRUSTED = 0.5

# rad; no ellipsoid spans two motions that are further from one another, as the sphere of
# directions is bent: up to here chord and arc agree to a twentieth.
_FAR = 0.5


class TwoViewEstimator:
    """
    Estimates the relative pose of two calibrated views, ``x_current = R x_previous + t``.

    Has no state but its parameters: the same views and prior give the same result.
    """

    def __init__(self, config: EstimatorConfig | None = None) -> None:
        self.config = config or EstimatorConfig()
        keep_freed_memory()

    def view(self, gray: NDArray[np.uint8], K: Array, features: Features | None = None,
             left_out: Mask | None = None) -> View:
        """
        Prepare an undistorted gray image (H, W) uint8 with its camera matrix K (3, 3).

        features: where they are known already; left_out: (H, W) bool, pixels that nothing is to
        be told from.
        """
        mask = None if left_out is None else blocked(left_out)
        smoothed = smooth(gray)
        if features is None:
            features = self.features(gray, mask, smoothed)
        return View(gray, K, features, smoothed, DescriptorDistances(self.config).seen(gray), mask)

    def features(self, gray: NDArray[np.uint8], mask: Mask | None = None,
                 smoothed: NDArray[np.uint8] | None = None) -> Features:
        """Detect the features of a gray image (H, W) uint8, but where a mask (H, W) is True."""
        if self.config.detector == 'corners':
            return detect_corners(gray, self.config.max_features, self.config.corner_contrast,
                                  mask, smoothed)
        return detect_orb(gray, self.config.max_features, self.config.fast_threshold, mask)

    def estimate(self, previous: View, current: View, prior: RelativePose | None = None,
                 known: Known | None = None) -> RelativePose:
        """
        Estimate the motion from the previous to the current view.

        prior: the motion before this one, as one more starting pose; known: what others than the
        images tell of this one. Never raises on image content: what can't be estimated comes back
        with a status that says why.
        """
        known, timings = known or Known(), dict[str, float]()
        with _timed(timings, 'matching'):
            foreseen = match_foreseen(previous, current, prior, known, self.config.search_radius)
        if foreseen is not None and prior is not None:
            (x, y), bits, ahead = foreseen
            result = self.estimate_matched(previous, current, x, y, prior, timings, known=known,
                                           ahead=ahead, bits=bits)
            if _as_good(result, prior):
                return replace(result, timings=timings)
        with _timed(timings, 'matching'):
            x, y = match_widely(previous, current, prior, known, self.config.search_radius)
        return replace(
            self.estimate_matched(previous, current, x, y, prior, timings, known=known),
            timings=timings)

    def match(self, previous: View, current: View) -> Matches:
        """Match the features of two views: pixels x and y (N, 2), the surest matches first."""
        return match_widely(previous, current, None, Known(), self.config.search_radius)

    def estimate_matched(self, previous: View, current: View, x: Array, y: Array,
                         prior: RelativePose | None = None,
                         timings: dict[str, float] | None = None,
                         observe: Observer | None = None,
                         known: Known | None = None, ahead: Pose | None = None,
                         bits: Array | None = None) -> RelativePose:
        """
        Estimate from given matches x, y (N, 2) in pixels of the two views.

        timings: gets the seconds of each stage; observe: is shown each round of Algorithm 1;
        known: as for ``estimate``; ahead: the motion by which matches were foreseen where they
        are, so that its basin will do as a start where none other comes near; its t may be zeros;
        bits: (N,) in which descriptors at x and y differ, where that is known already.
        """
        known = known or Known()
        timings = {} if timings is None else timings
        if len(x) < self.config.min_matches:
            return RelativePose(Status.TOO_FEW_MATCHES, x=x, y=y)

        # Starting poses; none where those around the motion ahead will do.
        before = _pose(prior)
        begun = self._begin(previous, current, x, y, before, known, ahead is not None, timings)
        if begun is None:
            return RelativePose(Status.DEGENERATE, x=x, y=y)
        starts, surface, y = begun
        # Where starts were sought, some matches may have been left out.
        alike = None if starts or bits is None else (y, bits)

        # Joint epipolar tracking on the residual surfaces.
        K, x = current.K, surface.x

        def others() -> list[Pose]:
            with _timed(timings, 'starts', within='jet'):
                return self._starts(K, x, y, before, known)

        # Where it is known how the camera goes on, so is where features were followed from.
        likely = None if starts or ahead is None else Ahead(ahead, others)
        track = self._track(surface, K, y, starts, before, observe, known, likely, timings)
        if track is None:
            return RelativePose(Status.TOO_FEW_MATCHES, x=x, y=y)

        # What is to be believed of it.
        with _timed(timings, 'result'):
            result = self._result(previous, current, surface, y, track, before, alike)
        if known.turn is None or agrees(known.turn, result):
            return result

        # A wrong basin of the camera's own motion has fewer inliers; another body may have more.
        starts = all_round(known.turn.R, BASIN_TUNING.directions_of_many)
        track = self._track(surface, K, y, starts, before, observe, known, None, timings)
        if track is None:
            return result
        with _timed(timings, 'result'):
            turned = self._result(previous, current, surface, y, track, before, alike)
        more = turned.inliers.sum() > result.inliers.sum()
        return turned if more and agrees(known.turn, turned) else result

    def _begin(self, previous: View, current: View, x: Array, y: Array, before: Pose | None,
               known: Known, goes_on: bool, timings: dict[str, float]
               ) -> tuple[list[Pose], ResidualSurface, Array] | None:
        """Give starting poses, the surfaces, and the keypoints y that these are around."""
        config = self.config
        if config.starts != 'several' or config.method == 'five_point':
            # The starting pose of the paper: the 5-point algorithm, and only what it agrees with.
            with _timed(timings, 'starts'):
                found = five_point(current.K, x, y, config.ransac_threshold, robust=False)
            if found is None:
                return None
            x, y = x[found[1]], y[found[1]]
            return [found[0]], self._surface(previous, current, x, y, timings), y
        if goes_on:
            with _timed(timings, 'jet'):
                return [], self._surface_of(previous, current, x, y), y
        # The first surfaces need no pose, and are sampled beside the search for starts.
        began, jet = perf_counter(), timings.get('jet', 0.0)
        starts, surface = both(lambda: self._starts(current.K, x, y, before, known),
                               lambda: self._surface(previous, current, x, y, timings))
        # What was done beside the surfaces took no time: stages add up to all of it.
        timings['starts'] = perf_counter() - began - (timings['jet'] - jet)
        return starts, surface, y

    def _starts(self, K: Array, x: Array, y: Array, before: Pose | None,
                known: Known) -> list[Pose]:
        """Collect starting poses: the 5-point algorithm, and what its RANSAC may have missed."""
        return [*starting_poses(K, x, y, self.config.ransac_threshold, before),
                *known_starts(K, x, y, known)]

    def _surface(self, previous: View, current: View, x: Array, y: Array,
                 timings: dict[str, float]) -> ResidualSurface:
        with _timed(timings, 'jet'):
            surface = self._surface_of(previous, current, x, y)
            if self.config.method == 'djet':
                surface.around(y)  # it keeps them: the first round of tracking finds them done
            return surface

    def _surface_of(self, previous: View, current: View, x: Array, y: Array) -> ResidualSurface:
        if self.config.method == 'djet':
            return DescriptorSurface(previous, current, x, self.config)
        if self.config.method == 'pjet':
            return PhotometricSurface(previous, current, x, self.config)
        return ReprojectionSurface(x, y)

    def _track(self, surface: ResidualSurface, K: Array, y: Array, starts: list[Pose],
               before: Pose | None, observe: Observer | None, known: Known, ahead: Ahead | None,
               timings: dict[str, float]) -> Track | None:
        with _timed(timings, 'jet'):
            if self.config.method == 'five_point':
                return hold(surface, K, y, starts[0])
            return track_jointly(surface, K, y, starts, self.config, before, observe, known.turn,
                                 ahead)

    def _result(self, previous: View, current: View, surface: ResidualSurface, y: Array,
                track: Track, before: Pose | None, alike: tuple[Array, Array] | None
                ) -> RelativePose:
        """Settle the direction of t, the covariance, and whether it is to be believed."""
        x, K, R = surface.x, current.K, track.pose.R
        inliers = track.inliers()
        # Chirality: E = [t]_x R leaves the sign of t open, positive depths decide it.
        rays_x, rays_y = rays(K, x[inliers]), rays(K, track.minima[inliers])
        sign = facing(R, track.pose.t, rays_x, rays_y)
        t = sign * track.pose.t

        covariances = pose_covariance(
            track.residuals, track.loss, x[track.voting], t, sign < 0)
        hamming = match_distances(previous.smoothed, x, current.smoothed, track.y_opt, alike)
        status = Status.OK
        if (inliers.sum() < self.config.min_matches or not np.isfinite(covariances[0]).all()
                or _by_chance(hamming[inliers])):
            status, t = Status.DEGENERATE, np.zeros(3)
        elif self._false_alarm(track, int(inliers.sum()), current.gray.shape):
            status = Status.TOO_FEW_INLIERS
        else:
            # Where a rotation alone explains the matches, any direction of t would do.
            R_alone = fit_rotation(rays_x, rays_y)
            parallax = _parallax(K, R_alone, rays_x, track.minima[inliers])
            if parallax < max(self.config.min_parallax, _OUT_OF_NOISE * track.scale()):
                status, R, t = Status.NO_PARALLAX, R_alone, np.zeros(3)
            else:
                status, covariances = _judged(Pose(R, t), covariances, track, before)
        lines = epipolar_lines(fundamental(K, R, track.pose.t), x)
        return RelativePose(
            status, R, t, *covariances, x=x, y=y, placed=track.placed,
            y_opt=track.y_opt, inliers=inliers, voting=track.voting,
            residuals=line_distances(lines, y),
            hamming=hamming, losses=track.losses, culled=int((~track.voting).sum()),
            indefinite=track.indefinite, iterations=track.iterations,
            rivals=tuple(rival.pose for rival in track.rivals))

    def _false_alarm(self, track: Track, agreeing: int, shape: tuple[int, ...]) -> bool:
        """
        Tell whether false matches would bring about a motion that as many agree with.

        One that may be anywhere in a disc of the search radius r lies within w of a line through
        its middle with a probability of at most 4 w / (pi r).
        """
        radius = min(self.config.search_radius, 0.5) * max(shape)
        chance = 4 * TUNING.inlier * track.scale() / (np.pi * radius)
        return false_alarms(agreeing, len(track.voting), chance) > 0


def _as_good(result: RelativePose, prior: RelativePose) -> bool:
    """
    Tell whether a pair is sure, and its matches fit it no worse than those before theirs.

    Most have to agree: where another body moves, the motion before may be a compromise already.
    """
    noise = max(robust_scale(prior.residuals), _LEAST_NOISE)
    return (result.status in (Status.OK, Status.NO_PARALLAX)
            and robust_scale(result.residuals) < _NOISIER * noise
            and result.inliers.mean() > RIGID)


def _judged(pose: Pose, covariances: tuple[Array, Array], track: Track,
            before: Pose | None) -> tuple[Status, tuple[Array, Array]]:
    """
    Tell whether rivals leave a pose unsure, and widen its covariances to span them.

    Those that the covariance allows of are spanned by it already. Any other is the true motion
    with the probability that the preference comes from noise.
    """
    status = Status.TWO_MOTIONS if track.guess else Status.OK
    for rival in track.rivals:
        off = difference(pose.R, pose.t, rival.pose)
        if squared_distance(covariances[0], off) < _SURPRISING:
            continue
        undecided = rival.preference < DECIDED and not _goes_on(before, pose, rival.pose)
        if undecided and np.linalg.norm(off) > _FAR and not track.guess:
            status = Status.AMBIGUOUS
        covariances = spanning(covariances[0], pose.t, off,
                               float(ndtr(-_TRUSTED * rival.preference)))
    return status, covariances


def _goes_on(before: Pose | None, pose: Pose, rival: Pose) -> bool:
    """Tell whether the motion before decides for a pose, whichever sign a rival's t may have."""
    return before is not None and all(
        goes_on(before, pose, Pose(rival.R, sign * rival.t)) for sign in (1, -1))


def _by_chance(hamming: Array) -> bool:
    """Tell of descriptor distances (N,), NaN where there is none, whether chance explains them."""
    known = hamming[np.isfinite(hamming)]
    return bool(known.size and np.median(known) > _CHANCE_BITS)


def _pose(prior: RelativePose | None) -> Pose | None:
    """Take a previous motion as a start, if its direction is known."""
    return Pose(prior.R, prior.t) if prior is not None and prior.t.any() else None


def _parallax(K: Array, R: Array, rays_x: Array, y: Array) -> float:
    """Upper quartile of the distances in pixels of y from where rotation alone would bring x."""
    rotated = rays_x @ (K @ R).T
    return quantile(np.linalg.norm(y - rotated[:, :2] / rotated[:, 2:], axis=1), 0.75)


@contextmanager
def _timed(timings: dict[str, float], stage: str, within: str = '') -> Iterator[None]:
    """Add to the seconds of a stage; of one within another, that other does not have them."""
    start = perf_counter()
    try:
        yield
    finally:
        spent = perf_counter() - start
        timings[stage] = timings.get(stage, 0.0) + spent
        if within:
            timings[within] = timings.get(within, 0.0) - spent
