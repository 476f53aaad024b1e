"""The two-view estimator: from two views to their relative pose, step by step."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from time import perf_counter

from djet_ros.core.algorithm import evaluate_at, Track
from djet_ros.core.basins import BASIN_TUNING
from djet_ros.core.bodies import (
    are_of_one_motion,
    fits_followed_body,
    is_continued,
    LeftOut,
    of_followed_body,
)
from djet_ros.core.corners import detect_corners, detect_large_corners
from djet_ros.core.correction import AS_CALIBRATED, Correction
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.features import detect_orb
from djet_ros.core.fusion import agrees
from djet_ros.core.hamming import smooth
from djet_ros.core.jet import robust_scale
from djet_ros.core.masks import blocked, Mask
from djet_ros.core.matching import match_predicted, match_widely, Matches, MIN_RIGID_SHARE
from djet_ros.core.memory import keep_freed_memory
from djet_ros.core.pair import Observer, Pair
from djet_ros.core.parallel import run_both
from djet_ros.core.radial import undistort_image
from djet_ros.core.rivals import MIN_BODY_SHARE, PreviousMotion
from djet_ros.core.starts import (
    external_starts,
    five_point,
    hemisphere_starts,
    KnownMotion,
    starting_poses,
)
from djet_ros.core.surfaces import (
    DescriptorDistances,
    DescriptorSurface,
    PhotometricSurface,
    ReprojectionSurface,
    ResidualSurface,
)
from djet_ros.core.tracking import track_jointly
from djet_ros.core.types import (
    Array,
    Features,
    of_same_camera,
    Pose,
    RelativePose,
    require_gray,
    Status,
    TRACKED,
    View,
)
from djet_ros.core.verdict import verdict, with_left_out
import numpy as np
from numpy.typing import NDArray

# chosen: factor by which the noise of the matches (robust standard deviation of their distances
# from the epipolar lines) may grow from one pair to the next; 1.4 was the most observed. Below
# _MIN_NOISE pixels, growth is ignored.
_MAX_NOISE_GROWTH, _MIN_NOISE = 1.5, 0.1


class TwoViewEstimator:
    """
    Estimates the relative pose of two calibrated views, ``x_current = R x_previous + t``.

    Stateless apart from its parameters: the same views and prior give the same result.

    correction: deviation of the camera from its calibration; views are without it.
    """

    def __init__(self, config: EstimatorConfig | None = None,
                 correction: Correction = AS_CALIBRATED) -> None:
        self.config, self.correction = config or EstimatorConfig(), correction
        keep_freed_memory()

    def view(self, gray: NDArray[np.uint8], K: Array, features: Features | None = None,
             left_out: Mask | None = None) -> View:
        """
        Prepare an undistorted gray image (H, W) uint8 with its camera matrix K (3, 3).

        The view keeps the image itself, which must not change afterwards (a ``Frame`` has a copy).
        features: its features, if already detected in the image as prepared here; left_out: (H, W)
        bool mask of pixels to ignore. Raises ValueError if one of them has the wrong shape or
        type.
        """
        require_gray(gray, np.asarray(K), left_out)
        K = self.correction.camera_matrix(K)
        gray, left_out = undistort_image(gray, K, self.correction.k1, left_out)
        mask = None if left_out is None else blocked(left_out)
        smoothed = smooth(gray)
        if features is None:
            features = self._detected(gray, mask, smoothed)
        surface_gray = DescriptorDistances(self.config).smoothed(gray)
        return View(gray, K, features, smoothed, surface_gray, mask)

    def undistorted(self, gray: NDArray[np.uint8], K: Array) -> NDArray[np.uint8]:
        """Return an image (H, W) undistorted as in its views, to whose pixels results refer."""
        return undistort_image(gray, self.correction.camera_matrix(K), self.correction.k1)[0]

    def features(self, gray: NDArray[np.uint8], mask: Mask | None = None) -> Features:
        """Detect all features of a gray image (H, W) uint8, except where a mask (H, W) is True."""
        return self._detected(gray, mask, None).with_additional

    def _detected(self, gray: NDArray[np.uint8], mask: Mask | None,
                  smoothed: NDArray[np.uint8] | None) -> Features:
        config = self.config
        if config.detector == 'orb':
            return detect_orb(gray, config.max_features, config.fast_threshold, mask)
        detect = detect_corners if config.detector == 'corners' else detect_large_corners
        return detect(gray, config.max_features, config.corner_contrast, mask, smoothed)

    def estimate(self, previous: View, current: View, prior: RelativePose | None = None,
                 known: KnownMotion | None = None) -> RelativePose:
        """
        Estimate the motion from the previous to the current view.

        prior: the previous motion, used to predict matches and as a starting pose; known:
        measurements of this motion from other sources than the images. Never raises on image
        content: a failure is reported by the status. Raises ValueError if the views differ in size
        or camera matrix.
        """
        known, timings = known or KnownMotion(), dict[str, float]()
        _require_one_camera(previous, current)

        # If the previous motion predicts the features, matches are searched nearby, and basins
        # around that motion.
        with _timed(timings, 'matching'):
            predicted = match_predicted(previous, current, prior, known, self.config.search_radius)
        if predicted is not None and prior is not None:
            (x, y), bits, motion = predicted
            result = self._estimate_followed(Pair(
                previous, current, x, y, _previous_motion(prior), known, motion, bits,
                sought=len(previous.features), timings=timings), prior)
            if _fits_as_well(result, prior):
                return result

        # Otherwise match in the whole search radius.
        with _timed(timings, 'matching'):
            x, y = match_widely(previous, current, prior, known, self.config.search_radius)
        return self._estimate_followed(Pair(
            previous, current, x, y, _previous_motion(prior), known,
            sought=len(previous.features.with_additional), timings=timings), prior)

    def _estimate_followed(self, pair: Pair, prior: RelativePose | None) -> RelativePose:
        """
        Estimate the motion of the body that the previous pair followed.

        The matches of another body, if one moved there, are left out: by now they may be the
        majority, or one pose may fit both bodies loosely. But all matches are used if they prove
        to be of one motion, or if those that are kept neither fit as well as before nor continue
        the previous motion: a body that hides most of the world leaves few matches, many of them
        false. If depths tell that what was left out is the static world, the pair is estimated
        without regard to the one before.
        """
        if prior is None:
            return self.estimate_pair(pair)
        followed = of_followed_body(prior, pair.x)
        if (~followed).sum() <= MIN_BODY_SHARE * len(followed):
            return self.estimate_pair(pair)
        alone = self._estimate_alone(pair, followed)
        if alone is None:
            return self.estimate_pair(pair)
        left_out = LeftOut(alone, pair.current.K)
        if left_out.is_world():
            return self.estimate_pair(replace(pair, prior=None, predicted=None))
        reliable = _fits_as_well(alone, prior)
        alone = replace(alone, left_out=~alone.of_body & ~left_out.readmitted())
        return self._of_followed_or_all(pair, alone, reliable)

    def _of_followed_or_all(self, pair: Pair, alone: RelativePose, reliable: bool
                            ) -> RelativePose:
        """
        Return the estimate by the followed matches alone, or that by all.

        reliable: whether the former fit as well as the pair before did.
        """
        before, continued = pair.prior, is_continued(pair.prior, alone)
        sure = reliable and continued and before is not None and not before.undecided
        if sure and not fits_followed_body(alone):
            return alone
        result = self.estimate_pair(pair)
        replaced = not (reliable or continued) or are_of_one_motion(before, alone, result)
        return result if replaced else alone

    def _estimate_alone(self, pair: Pair, followed: NDArray[np.bool_]) -> RelativePose | None:
        """
        Estimate the motion of some of the matches (N,) alone.

        None if they do not determine one motion: also if that is a rotation alone, or if some of
        them turn out to be attached to the camera.
        """
        result = self._estimate_part(pair, followed)
        return result if result.status is Status.OK and len(result.x) == len(pair.x) else None

    def _estimate_part(self, pair: Pair, kept: NDArray[np.bool_]) -> RelativePose:
        """
        Estimate the motion of some matches (N,) of a pair; the others are outliers of the result.

        The result is without them if it has no motion, or if some of those kept are attached to
        the camera.
        """
        result = self.estimate_pair(pair.of(kept))
        whole = len(result.inliers) == kept.sum()
        return with_left_out(result, pair, kept) if whole else result

    def match(self, previous: View, current: View) -> Matches:
        """Match the features of two views: pixels x and y (N, 2), the most reliable first."""
        return match_widely(previous, current, None, KnownMotion(), self.config.search_radius)

    def estimate_matched(self, previous: View, current: View, x: Array, y: Array,
                         prior: RelativePose | None = None, observe: Observer | None = None,
                         covariances: Array | None = None) -> RelativePose:
        """
        Estimate the motion from given matches x, y (N, 2) in pixels of the two views.

        prior: as for ``estimate``; observe: called with each round of Algorithm 1; covariances:
        (N, 2, 2) of y up to a common factor, which weight the residuals of method rpe. Raises
        ValueError if the views differ in size or camera matrix, or if matches are not finite or
        not pairs of pixels.
        """
        _require_one_camera(previous, current)
        x, y = (np.asarray(places, np.float64) for places in (x, y))
        if x.shape != y.shape or x.ndim != 2 or x.shape[1] != 2:
            raise ValueError(f'expected matches x and y (N, 2) in pixels, got {x.shape} and '
                             f'{y.shape}')
        if not (np.isfinite(x).all() and np.isfinite(y).all()):
            raise ValueError('matches must be finite; remove those that were not found')
        return self.estimate_pair(Pair(previous, current, x, y, _previous_motion(prior),
                                       observe=observe, covariances=covariances))

    def estimate_near(self, previous: View, current: View, relative: RelativePose, start: Pose,
                      known: KnownMotion | None = None) -> RelativePose:
        """
        Estimate the motion again from the matches of a result, in the basin of one motion alone.

        start: that motion, such as a rival that other evidence has decided for; known: as for
        ``estimate``.
        """
        pair = Pair(
            previous, current, relative.x, relative.y, PreviousMotion(start.R, start.t),
            known or KnownMotion(), start=start, sought=relative.sought,
            timings=relative.timings)
        kept = relative.of_body
        return self.estimate_pair(pair) if kept.all() else self._estimate_part(pair, kept)

    def estimate_pair(self, pair: Pair) -> RelativePose:
        """Estimate the motion of a ``Pair``: its matches and all prior knowledge."""
        if len(pair.x) < self.config.min_matches:
            return _failed(Status.TOO_FEW_MATCHES, pair)

        # Starting poses; none if the predicted motion serves as the start.
        initial = self._initialise(pair)
        if initial is None:
            return _failed(Status.DEGENERATE, pair)
        pair, starts, surface = initial

        # Joint epipolar tracking on the residual surfaces.
        track = self._track(pair, surface, starts)
        if track is None:
            return _failed(Status.TOO_FEW_MATCHES, pair)
        if track.attached is not None:
            return self.estimate_pair(pair.without(track.attached))

        # Sign of t, covariance, status.
        result = self._verdict(pair, track)
        measured = pair.known.rotation
        if measured is None or agrees(measured, result):
            return result

        # The measured rotation disagrees. A wrong basin of the camera's own motion has fewer
        # inliers than the right one; another moving body may have more.
        starts = hemisphere_starts(measured.R, BASIN_TUNING.many_directions)
        track = self._track(pair, surface, starts)
        if track is None:
            return result
        second = self._verdict(pair, track)
        more = second.inliers.sum() > result.inliers.sum()
        return second if more and agrees(measured, second) else result

    def _initialise(self, pair: Pair) -> tuple[Pair, list[Pose], ResidualSurface] | None:
        """
        Return the pair with the matches in use, the starting poses, and the surfaces.

        None if the 5-point algorithm finds no essential matrix. Starts are empty if the pair has a
        predicted motion.
        """
        config = self.config
        if config.starts != 'several' or config.method == 'five_point':
            # The paper's start: the 5-point algorithm, and only its inliers.
            with _timed(pair.timings, 'starts'):
                initial = five_point(pair.current.K, pair.x, pair.y, config.ransac_threshold,
                                     robust=False)
            if initial is None:
                return None
            start, agree = initial
            pair = pair.without(~agree)
            return pair, [start], self._sampled_surface(pair)
        if pair.start is not None:
            return pair, [pair.start], self._sampled_surface(pair)
        if pair.predicted is not None:
            with _timed(pair.timings, 'jet'):
                return pair, [], self._surface(pair)
        # The first surfaces need no pose, so they are sampled in parallel with the search for
        # starts.
        timings = pair.timings
        started, jet = perf_counter(), timings.get('jet', 0.0)
        starts, surface = run_both(lambda: self._starts(pair), lambda: self._sampled_surface(pair))
        # Time that overlaps with sampling is counted as 'jet' only, so that stages add up to the
        # total.
        elapsed = perf_counter() - started - (timings['jet'] - jet)
        timings['starts'] = timings.get('starts', 0.0) + elapsed
        return pair, starts, surface

    def _starts(self, pair: Pair) -> list[Pose]:
        """Collect starting poses: the 5-point algorithm, and alternatives that RANSAC may miss."""
        K, x, y = pair.current.K, pair.x, pair.y
        return [*starting_poses(K, x, y, self.config.ransac_threshold, pair.prior),
                *external_starts(K, x, y, pair.known)]

    def _sampled_surface(self, pair: Pair) -> ResidualSurface:
        """Return the surfaces, with those of the first round sampled (and cached) already."""
        with _timed(pair.timings, 'jet'):
            surface = self._surface(pair)
            if self.config.method == 'djet':
                surface.fit_around(pair.y)
            return surface

    def _surface(self, pair: Pair) -> ResidualSurface:
        if self.config.method == 'djet':
            return DescriptorSurface(pair.previous, pair.current, pair.x, self.config)
        if self.config.method == 'pjet':
            return PhotometricSurface(pair.previous, pair.current, pair.x, self.config)
        return ReprojectionSurface(pair.x, pair.y, pair.covariances)

    def _track(self, pair: Pair, surface: ResidualSurface, starts: list[Pose]) -> Track | None:
        """Run Algorithm 1 from given starts, or around the predicted motion if there are none."""
        with _timed(pair.timings, 'jet'):
            if self.config.method == 'five_point':
                return evaluate_at(surface, pair.current.K, pair.y, starts[0])
            track = track_jointly(pair, surface, starts, self.config)
        if track is not None and pair.observe is not None:
            for step in track.rounds:
                pair.observe(step)
        return track

    def _verdict(self, pair: Pair, track: Track) -> RelativePose:
        with _timed(pair.timings, 'result'):
            return verdict(pair, track, self.config)


def _require_one_camera(previous: View, current: View) -> None:
    if not of_same_camera(previous, current):
        raise ValueError('views of a pair must have the same size and camera matrix; sizes are '
                         f'{previous.gray.shape} and {current.gray.shape}')


def _failed(status: Status, pair: Pair) -> RelativePose:
    return RelativePose(status, x=pair.x, y=pair.y, timings=pair.timings)


def _fits_as_well(result: RelativePose, prior: RelativePose) -> bool:
    """
    Return whether a pair has a motion that its matches fit about as well as those of the prior.

    Most of them have to agree: with another moving body, the prior may be a compromise already.
    """
    before, now = (robust_scale(pair.residuals[pair.of_body]) for pair in (prior, result))
    return (result.status in TRACKED and now < _MAX_NOISE_GROWTH * max(before, _MIN_NOISE)
            and result.inliers[result.of_body].mean() > MIN_RIGID_SHARE)


def _previous_motion(prior: RelativePose | None) -> PreviousMotion | None:
    """Return the motion of the prior, if its translation direction is known."""
    return PreviousMotion.of(prior) if prior is not None and prior.t.any() else None


@contextmanager
def _timed(timings: dict[str, float], stage: str) -> Iterator[None]:
    """Add the duration of a block to the seconds of a stage."""
    start = perf_counter()
    try:
        yield
    finally:
        timings[stage] = timings.get(stage, 0.0) + perf_counter() - start
