"""From two views to their relative pose: the way of a pair on one screen."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from time import perf_counter

from djet_ros.core.basins import BASIN_TUNING
from djet_ros.core.corners import detect_corners, detect_large_corners
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.features import detect_orb
from djet_ros.core.fusion import agrees
from djet_ros.core.hamming import smooth
from djet_ros.core.jet import robust_scale
from djet_ros.core.masks import blocked, Mask
from djet_ros.core.matching import match_foreseen, match_widely, Matches, RIGID
from djet_ros.core.memory import keep_freed_memory
from djet_ros.core.pair import Limits, Observer, Pair
from djet_ros.core.parallel import both
from djet_ros.core.radial import straight_image
from djet_ros.core.starts import all_round, five_point, Known, known_starts, starting_poses
from djet_ros.core.surfaces import (
    DescriptorDistances,
    DescriptorSurface,
    PhotometricSurface,
    ReprojectionSurface,
    ResidualSurface,
)
from djet_ros.core.tracking import hold, Track, track_jointly
from djet_ros.core.types import (
    Array,
    Features,
    of_one_camera,
    Pose,
    RelativePose,
    Status,
    View,
)
from djet_ros.core.verdict import verdict
import numpy as np
from numpy.typing import NDArray

# chosen: by as much the distances of matches from their epipolar lines may grow from one pair to
# the next (1.4 was the most that was seen), and pixels that are not worth speaking of.
_NOISIER, _LEAST_NOISE = 1.5, 0.1


class TwoViewEstimator:
    """
    Estimates the relative pose of two calibrated views, ``x_current = R x_previous + t``.

    Has no state but its parameters: the same views and prior give the same result.

    k1: radial distortion that images still have, without which it sees them.
    """

    def __init__(self, config: EstimatorConfig | None = None, k1: float = 0.0) -> None:
        self.config, self.k1 = config or EstimatorConfig(), k1
        keep_freed_memory()

    def view(self, gray: NDArray[np.uint8], K: Array, features: Features | None = None,
             left_out: Mask | None = None) -> View:
        """
        Prepare an undistorted gray image (H, W) uint8 with its camera matrix K (3, 3).

        features: where they are known already, in what it makes of the image; left_out: (H, W)
        bool, pixels that nothing is to be told from. ValueError where the image or K is none.
        """
        K = np.asarray(K, np.float64)
        if gray.ndim != 2 or gray.dtype != np.uint8 or K.shape != (3, 3):
            raise ValueError(f'an image is (H, W) uint8, and its K (3, 3); these are {gray.shape} '
                             f'{gray.dtype} and {K.shape}')
        if self.k1:
            gray, left_out = straight_image(gray, K, self.k1, left_out)
        mask = None if left_out is None else blocked(left_out)
        smoothed = smooth(gray)
        if features is None:
            features = self._detected(gray, mask, smoothed)
        return View(gray, K, features, smoothed, DescriptorDistances(self.config).seen(gray), mask)

    def seen(self, gray: NDArray[np.uint8], K: Array) -> NDArray[np.uint8]:
        """Give an image (H, W) as its views have it, with the pixels that pairs speak of."""
        return straight_image(gray, K, self.k1)[0] if self.k1 else gray

    def features(self, gray: NDArray[np.uint8], mask: Mask | None = None) -> Features:
        """Detect all features of a gray image (H, W) uint8, but where a mask (H, W) is True."""
        return self._detected(gray, mask, None).with_others

    def _detected(self, gray: NDArray[np.uint8], mask: Mask | None,
                  smoothed: NDArray[np.uint8] | None) -> Features:
        config = self.config
        if config.detector == 'orb':
            return detect_orb(gray, config.max_features, config.fast_threshold, mask)
        detect = detect_corners if config.detector == 'corners' else detect_large_corners
        return detect(gray, config.max_features, config.corner_contrast, mask, smoothed)

    def estimate(self, previous: View, current: View, prior: RelativePose | None = None,
                 known: Known | None = None) -> RelativePose:
        """
        Estimate the motion from the previous to the current view.

        prior: the motion before this one, as one more starting pose; known: what others than the
        images tell of this one. Never raises on image content: what can't be estimated comes back
        with a status that says why. ValueError where the views are not of one camera.
        """
        known, timings = known or Known(), dict[str, float]()
        _require_one_camera(previous, current)

        # Where the motion before foresees them, matches are near, and so is the pose.
        with _timed(timings, 'matching'):
            foreseen = match_foreseen(previous, current, prior, known, self.config.search_radius)
        if foreseen is not None and prior is not None:
            (x, y), bits, ahead = foreseen
            limits = _limits(prior)
            result = self.estimate_pair(Pair(previous, current, x, y, _pose(prior), known, ahead,
                                             limits, bits, sought=len(previous.features),
                                             timings=timings))
            if _as_good(result, limits):
                return result

        # Otherwise they are sought anywhere.
        with _timed(timings, 'matching'):
            x, y = match_widely(previous, current, prior, known, self.config.search_radius)
        sought = len(previous.features.with_others)
        return self.estimate_pair(Pair(previous, current, x, y, _pose(prior), known,
                                       sought=sought, timings=timings))

    def match(self, previous: View, current: View) -> Matches:
        """Match the features of two views: pixels x and y (N, 2), the surest matches first."""
        return match_widely(previous, current, None, Known(), self.config.search_radius)

    def estimate_matched(self, previous: View, current: View, x: Array, y: Array,
                         prior: RelativePose | None = None, observe: Observer | None = None,
                         covariances: Array | None = None) -> RelativePose:
        """
        Estimate from given matches x, y (N, 2) in pixels of the two views.

        prior: as for ``estimate``; observe: is shown each round of Algorithm 1; covariances:
        (N, 2, 2) of y up to a common factor, by which re-projection errors count. ValueError where
        the views are not of one camera, or a match is no pixel of finite numbers.
        """
        _require_one_camera(previous, current)
        x, y = (np.asarray(places, np.float64) for places in (x, y))
        if not (np.isfinite(x).all() and np.isfinite(y).all()):
            raise ValueError('matches are pixels of finite numbers; leave out what was not found')
        return self.estimate_pair(Pair(previous, current, x, y, _pose(prior), observe=observe,
                                       covariances=covariances))

    def estimate_pair(self, pair: Pair) -> RelativePose:
        """Estimate from matches, with all that is known; see ``Pair``."""
        if len(pair.x) < self.config.min_matches:
            return _failed(Status.TOO_FEW_MATCHES, pair)

        # Starting poses; none where those around the motion ahead will do.
        begun = self._begin(pair)
        if begun is None:
            return _failed(Status.DEGENERATE, pair)
        pair, starts, surface = begun

        # Joint epipolar tracking on the residual surfaces.
        track = self._track(pair, surface, starts)
        if track is None:
            return _failed(Status.TOO_FEW_MATCHES, pair)
        if track.carried is not None:
            return self.estimate_pair(replace(pair.without(track.carried), limits=Limits()))

        # What is to be believed of it.
        result = self._verdict(pair, track)
        turn = pair.known.turn
        if turn is None or agrees(turn, result):
            return result

        # A wrong basin of the camera's own motion has fewer inliers; another body may have more.
        track = self._track(pair, surface, all_round(turn.R, BASIN_TUNING.directions_of_many))
        if track is None:
            return result
        turned = self._verdict(pair, track)
        more = turned.inliers.sum() > result.inliers.sum()
        return turned if more and agrees(turn, turned) else result

    def _begin(self, pair: Pair) -> tuple[Pair, list[Pose], ResidualSurface] | None:
        """Give the pair with the matches that are used, starting poses, and the surfaces."""
        config = self.config
        if config.starts != 'several' or config.method == 'five_point':
            # The starting pose of the paper: the 5-point algorithm, and only what it agrees with.
            with _timed(pair.timings, 'starts'):
                found = five_point(pair.current.K, pair.x, pair.y, config.ransac_threshold,
                                   robust=False)
            if found is None:
                return None
            start, agree = found
            pair = pair.without(~agree)
            return pair, [start], self._sampled(pair)
        if pair.ahead is not None:
            with _timed(pair.timings, 'jet'):
                return pair, [], self._surface(pair)
        # The first surfaces need no pose, and are sampled beside the search for starts.
        timings = pair.timings
        began, jet = perf_counter(), timings.get('jet', 0.0)
        starts, surface = both(lambda: self._starts(pair), lambda: self._sampled(pair))
        # What was done beside the surfaces took no time: stages add up to all of it.
        alone = perf_counter() - began - (timings['jet'] - jet)
        timings['starts'] = timings.get('starts', 0.0) + alone
        return pair, starts, surface

    def _starts(self, pair: Pair) -> list[Pose]:
        """Collect starting poses: the 5-point algorithm, and what its RANSAC may have missed."""
        K, x, y = pair.current.K, pair.x, pair.y
        return [*starting_poses(K, x, y, self.config.ransac_threshold, pair.before),
                *known_starts(K, x, y, pair.known)]

    def _sampled(self, pair: Pair) -> ResidualSurface:
        """Give the surfaces with those of the first round, which they keep, sampled already."""
        with _timed(pair.timings, 'jet'):
            surface = self._surface(pair)
            if self.config.method == 'djet':
                surface.around(pair.y)
            return surface

    def _surface(self, pair: Pair) -> ResidualSurface:
        if self.config.method == 'djet':
            return DescriptorSurface(pair.previous, pair.current, pair.x, self.config)
        if self.config.method == 'pjet':
            return PhotometricSurface(pair.previous, pair.current, pair.x, self.config)
        return ReprojectionSurface(pair.x, pair.y, pair.covariances)

    def _track(self, pair: Pair, surface: ResidualSurface, starts: list[Pose]) -> Track | None:
        """Run Algorithm 1 from some starts; from those around the motion ahead without any."""
        ahead = None if starts else pair.ahead
        with _timed(pair.timings, 'jet'):
            if self.config.method == 'five_point':
                return hold(surface, pair.current.K, pair.y, starts[0])
            track = track_jointly(pair, surface, starts, self.config, ahead)
        if track is not None and pair.observe is not None:
            for step in track.rounds:
                pair.observe(step)
        return track

    def _verdict(self, pair: Pair, track: Track) -> RelativePose:
        with _timed(pair.timings, 'result'):
            return verdict(pair, track, self.config)


def _require_one_camera(previous: View, current: View) -> None:
    if not of_one_camera(previous, current):
        raise ValueError(f'views of {previous.gray.shape} and {current.gray.shape} pixels, or '
                         'their camera matrices, differ; a pair is of one camera')


def _failed(status: Status, pair: Pair) -> RelativePose:
    return RelativePose(status, x=pair.x, y=pair.y, timings=pair.timings)


def _limits(prior: RelativePose) -> Limits:
    """
    Tell what a pair has to keep to whose matches are to fit it no worse than those before theirs.

    Most have to agree: where another body moves, the motion before may be a compromise already.
    """
    return Limits(_NOISIER * max(robust_scale(prior.residuals), _LEAST_NOISE), RIGID)


def _as_good(result: RelativePose, limits: Limits) -> bool:
    """Tell whether a pair is sure, and keeps to limits."""
    return (result.status in (Status.OK, Status.NO_PARALLAX)
            and robust_scale(result.residuals) < limits.noise
            and result.inliers.mean() > limits.agreeing)


def _pose(prior: RelativePose | None) -> Pose | None:
    """Take a previous motion as a start, if its direction is known."""
    return Pose(prior.R, prior.t) if prior is not None and prior.t.any() else None


@contextmanager
def _timed(timings: dict[str, float], stage: str) -> Iterator[None]:
    """Add to the seconds of a stage."""
    start = perf_counter()
    try:
        yield
    finally:
        timings[stage] = timings.get(stage, 0.0) + perf_counter() - start
