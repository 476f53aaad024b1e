"""Evaluation of a chunk of consecutive pairs of one sequence by every method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from time import perf_counter
from typing import Any

import cv2
from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.estimator_config import preset
from djet_ros.core.hamming import match_distances, smooth
from djet_ros.core.masks import blocked
from djet_ros.core.types import Array, Features, RelativePose, Status, View
from djet_ros.lab import peers
from djet_ros.lab.chains import CHAINS, Points
from djet_ros.lab.methods import Method
from djet_ros.lab.sequences import Dataset, opened
from djet_ros.odometry.frame import Frame
from djet_ros.odometry.result import camera_motion
from djet_ros.replay.pair_errors import has_direction, motion_errors
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

# Errors in degrees beyond which a pair has failed; FAILURE describes them.
GROSS_ROTATION = 1.0
GROSS_TRANSLATION = 10.0
FAILURE = (f'no pose, a rotation error above {GROSS_ROTATION:g} deg, or a translation direction '
           f'that is undetermined or has an error above {GROSS_TRANSLATION:g} deg')


@dataclass(frozen=True)
class PairChunk:
    """Pairs first, first + 1, … (count of them) of a dataset."""

    dataset: Dataset
    first: int
    count: int

    @property
    def name(self) -> str:
        """Return a name that is the same in every run."""
        return f'{self.dataset.name}:{self.first}+{self.count}'


@dataclass(frozen=True)
class PairRecord:
    """
    Result of one method on one pair of frames.

    previous, current: indices of the frames in their sequence; errors in degrees, NaN if estimate
    or truth is undetermined; failed: see FAILURE; hamming_mean: bits, over the inliers; rotation
    (vector in rad) and translation (unit length): pose of the current camera in the previous one;
    milliseconds: features of one frame, matching and estimation together.
    """

    sequence: str
    pair: int
    previous: int
    current: int
    method: str
    preset: str
    change: str
    status: str
    matches: int
    inliers: int
    failed: bool
    rotation_error_deg: float
    translation_error_deg: float
    hamming_mean: float
    rotation: tuple[float, float, float]
    translation: tuple[float, float, float]
    milliseconds: float


def evaluate_chunk(chunk: PairChunk, methods: Sequence[Method]) -> list[PairRecord]:
    """
    Estimate the pairs of a chunk by every method; pairs without ground truth are omitted.

    Each pair is estimated by itself, without a motion prior, so that the records do not depend on
    the distribution of pairs over workers.
    """
    # There is a worker per core: more threads would only compete.
    cv2.setNumThreads(1)
    sequence, frames = opened(chunk.dataset), chunk.dataset.frames
    assert sequence.poses is not None  # datasets without poses are refused at the start
    records: list[PairRecord] = []
    current: _Image | None = None
    for pair in range(chunk.first, chunk.first + chunk.count):
        previous = current or _Image(sequence.frame(frames[pair]))
        current = _Image(sequence.frame(frames[pair + 1]))
        true_motion = (np.linalg.inv(sequence.poses[frames[pair]])
                       @ sequence.poses[frames[pair + 1]])
        if np.isfinite(true_motion).all():
            shared = _SharedWork(previous, current)
            records += [_record(chunk.dataset, pair, method, shared, true_motion)
                        for method in methods]
    return records


@dataclass(frozen=True)
class MethodInput:
    """
    Input of a method: two views, matches x, y (N, 2) in pixels, and optionally an initial pose.

    seconds: time for the features of one view and the matching; covariances: (N, 2, 2) of y, if
    the method weights by them.
    """

    views: tuple[View, View]
    x: Array
    y: Array
    start: RelativePose | None
    seconds: float
    covariances: Array | None = None


def estimate(method: Method, given: MethodInput) -> RelativePose:
    """Estimate the relative pose of a pair by a method."""
    config = method.config
    if method.on_places:
        given = _with_places(method, given)
    if method.name in peers.ESTIMATORS:
        return peers.estimate(method.name, given.views[1].K, given.x, given.y, config.min_matches)
    return TwoViewEstimator(config).estimate_matched(
        *given.views, given.x, given.y, given.start, covariances=given.covariances)


class _Image:
    """
    An image with its features and views.

    Each is computed once for all methods with the same relevant settings.
    """

    def __init__(self, frame: Frame) -> None:
        self._gray, self.K, self._left_out = frame.gray, frame.K, frame.left_out
        # Excluded from detection, for all methods alike.
        self._mask = None if frame.left_out is None else blocked(frame.left_out)
        self._features: dict[Any, tuple[Features, float]] = {}
        self._views: dict[Any, tuple[View, float]] = {}
        self._points: dict[str, tuple[Points, float]] = {}

    def view(self, method: Method) -> tuple[View, float]:
        """Return the view with its features, and the seconds that they took."""
        config = method.config
        detected = (config.detector, config.max_features, config.fast_threshold,
                    config.corner_contrast)
        # A view also holds the image smoothed for the tests of the surfaces.
        key = (*detected, config.patch_scale, config.grading > 0)
        if key not in self._views:
            features, seconds = self._found(detected, TwoViewEstimator(config))
            start = perf_counter()
            view = TwoViewEstimator(config).view(self._gray, self.K, features, self._left_out)
            self._views[key] = view, seconds + perf_counter() - start
        return self._views[key]

    def _found(self, detected: Any, estimator: TwoViewEstimator) -> tuple[Features, float]:
        """Return the features of these settings of the detector, and their seconds."""
        if detected not in self._features:
            start = perf_counter()
            features = estimator.features(self._gray, self._mask)
            self._features[detected] = features, perf_counter() - start
        return self._features[detected]

    def points(self, method: str) -> tuple[Points, float]:
        """Return the points of a chain of that name, and the seconds that they took."""
        if method not in self._points:
            start = perf_counter()
            points = CHAINS[method].detect(self._gray, self._mask)
            self._points[method] = points, perf_counter() - start
        return self._points[method]

    @cached_property
    def smoothed(self) -> NDArray[np.uint8]:
        """Smooth the image (H, W) as ORB's binary tests see it."""
        return smooth(self._gray)


class _SharedWork:
    """Views and matches of a pair, shared by all methods with the same settings."""

    def __init__(self, previous: _Image, current: _Image) -> None:
        self._images = previous, current
        self._given: dict[Any, MethodInput] = {}
        self._chained: dict[str, tuple[RelativePose, float]] = {}

    def result(self, method: Method) -> tuple[RelativePose, int, float]:
        """Return the pose by a method, the number of matches, and the total time in seconds."""
        if method.name in CHAINS:
            found, seconds = self._by_chain(method.name)
            return found, len(found.x), seconds
        given = self.given(method)
        start = perf_counter()
        found = estimate(method, given)
        seconds = given.seconds + perf_counter() - start
        if method.name in peers.ESTIMATORS:
            found = self._with_hamming(found)
        return found, len(given.x), seconds

    def _with_hamming(self, found: RelativePose) -> RelativePose:
        """Add Hamming distances to a pose of others: for comparison only, and not timed."""
        if found.status is not Status.OK:
            return found
        smoothed = [image.smoothed for image in self._images]
        return replace(found, hamming=match_distances(smoothed[0], found.x, smoothed[1],
                                                      found.y_opt))

    def _by_chain(self, method: str) -> tuple[RelativePose, float]:
        """Return the pose by a complete pipeline, which does not depend on the preset."""
        if method not in self._chained:
            (previous, _), (current, seconds) = (image.points(method) for image in self._images)
            start = perf_counter()
            found = CHAINS[method].estimate(previous, current, self._images[1].K)
            seconds += perf_counter() - start
            self._chained[method] = self._with_hamming(found), seconds
        return self._chained[method]

    def given(self, method: Method) -> MethodInput:
        """Return the input of a method."""
        (previous, _), (current, seconds) = (image.view(method) for image in self._images)
        key = (id(previous), method.config.search_radius, method.good_start)
        if key not in self._given:
            start = perf_counter()
            x, y = TwoViewEstimator(method.config).match(previous, current)
            given = MethodInput((previous, current), x, y, None, seconds + perf_counter() - start)
            self._given[key] = _with_good_start(given) if method.good_start else given
        return self._given[key]


def _with_good_start(given: MethodInput) -> MethodInput:
    """Add the robust pose of RP-E as initial pose, and keep its inliers."""
    robust = TwoViewEstimator(preset('best', method='rpe')).estimate_matched(
        *given.views, given.x, given.y)
    if not robust.inliers.any():
        return given
    return replace(given, x=robust.x[robust.inliers], y=robust.y[robust.inliers], start=robust)


def _with_places(method: Method, given: MethodInput) -> MethodInput:
    """Return the matches refined by D-JET's gray-level alignment, or the input if none is."""
    config = replace(method.config, method='djet')
    found = TwoViewEstimator(config).estimate_matched(*given.views, given.x, given.y, given.start)
    voting = found.voting
    if not voting.any():
        return given
    return replace(given, x=found.x[voting], y=found.placed[voting],
                   covariances=found.placed_covariances[voting] if method.weighed else None)


def _record(dataset: Dataset, pair: int, method: Method, shared: _SharedWork,
            true_motion: Array) -> PairRecord:
    result, matches, seconds = shared.result(method)
    motion = camera_motion(result)
    rotation_error, translation_error = motion_errors(result.status, motion, true_motion)
    hamming = result.hamming[result.inliers] if len(result.hamming) else result.hamming
    hamming = hamming[np.isfinite(hamming)]
    return PairRecord(
        sequence=dataset.name, pair=pair, previous=dataset.frames[pair],
        current=dataset.frames[pair + 1], method=method.name, preset=method.preset,
        change=method.change, status=result.status.value, matches=matches,
        inliers=int(result.inliers.sum()),
        failed=has_failed(rotation_error, translation_error, true_motion),
        rotation_error_deg=rotation_error, translation_error_deg=translation_error,
        hamming_mean=float(hamming.mean()) if len(hamming) else float('nan'),
        rotation=_triple(Rotation.from_matrix(motion[:3, :3]).as_rotvec()),
        translation=_triple(motion[:3, 3]), milliseconds=seconds * 1e3)


def has_failed(rotation_error_deg: float, translation_error_deg: float,
               true_motion: Array) -> bool:
    """Return whether errors against the true motion (4, 4) are a failure, see FAILURE."""
    # Comparisons with NaN are false, so that undetermined errors are failures too.
    return not (rotation_error_deg <= GROSS_ROTATION
                and (translation_error_deg <= GROSS_TRANSLATION or not has_direction(true_motion)))


def _triple(vector: Array) -> tuple[float, float, float]:
    a, b, c = vector.tolist()
    return a, b, c
