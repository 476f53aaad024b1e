"""
Speed of the pipeline, as ratios to a plain OpenCV pipeline measured in the same run.

Absolute times depend on the machine. Ratios are comparable, because both sides are measured
alternately and repeatedly in the same process.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from time import perf_counter
from typing import Any, TypeVar

import cv2
from djet_ros import compiled
from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.estimator_config import preset
from djet_ros.core.orb_pattern import REACH
from djet_ros.core.parallel import start_in_background
from djet_ros.core.surfaces import DescriptorDistances
from djet_ros.core.types import Array, RelativePose, View
from djet_ros.errors import DjetError
from djet_ros.lab.corrected_images import corrected_images
from djet_ros.recordings.recording import open_recording, refuse, Warn
import numpy as np
from numpy.typing import NDArray

POINTS = (250, 500, 1000, 2000, 4000)
WINDOWS = (3, 5, 7, 9, 11, 13, 15)

# Number of matches for which the time of the D-JET stage is reported.
QUOTED_POINTS = 1000

# Repetitions of each measurement, of which the minimum counts.
_REPEATS = 7

Key = TypeVar('Key')


def bench(source: Path, pairs: int,
          progress: Callable[[str], None] = lambda stage: None,
          warn: Warn = refuse) -> dict[str, Any]:
    """
    Measure the first pairs of a recording with one thread, then with OpenCV's default number.

    Returns the results of the single-threaded run, and those of the other under 'all_cores'. Times
    include reading: files of a folder are decoded; raw images of a bag need no decoding. warn:
    called with the damage of a bag, which ends there. Raises DjetError if the source is no
    recording of at least two frames.
    """
    frames = _first_frames(source, pairs + 1, warn)
    progress('one thread')
    cv2.setNumThreads(1)
    figures = measure(frames)
    progress('all cores')
    cv2.setNumThreads(-1)
    figures['all_cores'] = measure_pipeline(frames)
    return figures


@dataclass(frozen=True)
class _Frames:
    """The first frames of a recording: how many, their camera matrix, and the first two."""

    source: Path
    count: int
    K: Array
    first: tuple[NDArray[np.uint8], NDArray[np.uint8]]

    def images(self) -> Iterator[NDArray[np.uint8]]:
        """Read the frames anew, and one more if there is one, to be prepared beside the last."""
        with open_recording(self.source) as recording:
            for seen in islice(corrected_images(recording), self.count + 1):
                yield seen.gray


def _first_frames(source: Path, most: int, warn: Warn) -> _Frames:
    with open_recording(source) as recording:
        seen = list(islice(corrected_images(recording, warn), most))
    if len(seen) < 2:
        raise DjetError(f'{source} has {len(seen)} frames; at least 2 are needed')
    return _Frames(source, len(seen), seen[0].camera.K, (seen[0].gray, seen[1].gray))


def measure(frames: _Frames) -> dict[str, Any]:
    """Measure everything: pipeline, D-JET stage by matches and window, descriptors, memory."""
    figures = measure_pipeline(frames)
    figures['compiled_loops'] = compiled.library is not None
    previous, current, x, y = _crowded_pair(frames)
    figures['kernel_speedup_over_cv2'] = kernel_speedup(previous)
    figures['kernel_tests'] = preset('best').binary_tests
    by_points = interleaved_minima({n: _stage(previous, current, x[:n], y[:n])
                                    for n in POINTS if n <= len(x)})
    figures['djet_ms_by_points'] = by_points
    figures['djet_stage_ms'] = by_points.get(QUOTED_POINTS, float('nan'))
    figures['djet_ms_by_window'] = interleaved_minima({
        w: _stage(previous, current, x[:QUOTED_POINTS], y[:QUOTED_POINTS], window=w)
        for w in WINDOWS})
    figures['bytes_per_frame'] = view_bytes(_estimator().view(frames.first[0], frames.K))
    return figures


def measure_pipeline(frames: _Frames) -> dict[str, Any]:
    """Measure times from reading to pose, of two presets and OpenCV, in turn on each frame."""
    ours, fast, plain = (_Pipeline(frames, 'best'), _Pipeline(frames, 'fast'),
                         _PlainChain(frames))
    times: dict[str, list[float]] = {'ours': [], 'fast': [], 'plain': []}
    for index in range(frames.count):
        # Alternate the order, so that none always finds the file in the cache.
        order = [('ours', ours.take), ('fast', fast.take), ('plain', plain.take)]
        for name, step in order if index % 2 else reversed(order):
            start = perf_counter()
            step()
            times[name].append(perf_counter() - start)
    # The first frame has no pair; it warms up the caches.
    ours_s, fast_s, plain_s = (float(np.median(times[name][1:])) for name in times)
    return {'pairs': len(times['ours']) - 1, 'pipeline_over_opencv': ours_s / plain_s,
            'pairs_per_second': 1 / float(np.mean(times['ours'][1:])),
            'fast_over_opencv': fast_s / plain_s,
            'fast_pairs_per_second': 1 / float(np.mean(times['fast'][1:])),
            'pipeline_ms': 1e3 * ours_s, 'opencv_ms': 1e3 * plain_s,
            'stages_ms': ours.stages_ms()}


class _Pipeline:
    """Our pipeline from recording to pose, frame by frame, as in a replay."""

    def __init__(self, frames: _Frames, preset_name: str) -> None:
        self._images, self._K = frames.images(), frames.K
        self._estimator = TwoViewEstimator(preset(preset_name))
        self._view: View | None = None
        self._ahead = self._view_of_next()
        self._prior: RelativePose | None = None
        self._timings: list[dict[str, float]] = []

    def take(self) -> None:
        """Estimate the pair that ends with the next frame, preparing another in parallel."""
        start = perf_counter()
        view, following = self._ahead, start_in_background(self._view_of_next)
        if self._view is not None and view is not None:
            self._prior = self._estimator.estimate(self._view, view, self._prior)
        self._view, self._ahead = view, following()
        if self._prior is not None:
            timings = self._prior.timings
            # Work done in parallel to the pair does not count: stages add up to the total.
            rest = perf_counter() - start - sum(timings.values())
            self._timings.append({'reading + features': rest, **timings})

    def _view_of_next(self) -> View | None:
        image = next(self._images, None)
        return None if image is None else self._estimator.view(image, self._K)

    def stages_ms(self) -> dict[str, float]:
        """Return mean times over all pairs, 0 for pairs without a stage, so that they add up."""
        stages = dict.fromkeys(stage for timings in self._timings for stage in timings)
        return {stage: 1e3 * float(np.mean([timings.get(stage, 0.0) for timings in self._timings]))
                for stage in stages}


class _PlainChain:
    """OpenCV's usual chain: ORB, brute-force cross-check, 5-point RANSAC, recoverPose."""

    def __init__(self, frames: _Frames) -> None:
        self._images, self._K = frames.images(), frames.K
        self._orb = cv2.ORB.create(preset('best').max_features)
        self._matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
        self._last: tuple[Any, Any] | None = None

    def take(self) -> None:
        keypoints, descriptors = self._orb.detectAndCompute(next(self._images), None)
        if self._last is not None:
            matches = self._matcher.match(self._last[1], descriptors)
            x = np.array([self._last[0][m.queryIdx].pt for m in matches])
            y = np.array([keypoints[m.trainIdx].pt for m in matches])
            E, mask = cv2.findEssentialMat(x, y, self._K, method=cv2.RANSAC, prob=0.999,
                                           threshold=1.0)
            cv2.recoverPose(E[:3], x, y, self._K, mask=mask)
        self._last = keypoints, descriptors


def kernel_speedup(view: View) -> float:
    """
    Return the time of cv2.ORB.compute over that of our surfaces (preset best) on as many pixels.

    OpenCV computes all 256 tests on given keypoints, but no distances. Ours computes the tests of
    the preset ('kernel_tests' of the results) and the distances.
    """
    config = preset('best')
    distances, radius = DescriptorDistances(config), config.window // 2
    height, width = view.gray.shape
    rng = np.random.default_rng(0)
    border = REACH + radius + 20
    points = np.stack([rng.integers(border, width - border, QUOTED_POINTS),
                       rng.integers(border, height - border, QUOTED_POINTS)], axis=1)
    offsets = np.mgrid[-radius:radius + 1, -radius:radius + 1].reshape(2, -1).T
    dense = (points[:, None] + offsets).reshape(-1, 2)
    orb = cv2.ORB.create(nlevels=1, edgeThreshold=REACH + 1)

    keypoints = [cv2.KeyPoint(float(x), float(y), 31.0, 0.0) for x, y in dense.tolist()]

    def opencv() -> None:
        orb.compute(view.gray, keypoints)

    def ours() -> None:
        seen = distances.smoothed(view.gray)
        distances.surfaces(distances.reference(seen, points), seen, points, radius)

    least = interleaved_minima({'opencv': _seconds(opencv), 'ours': _seconds(ours)})
    return least['opencv'] / least['ours']


def view_bytes(view: View) -> int:
    """Return the memory of a frame's view in bytes."""
    features = view.features
    arrays: tuple[NDArray[Any], ...] = (
        view.gray, view.smoothed, view.surface_gray, features.points, features.octaves,
        features.angles, features.responses, features.descriptors)
    return sum(array.nbytes for array in arrays)


def _estimator(**changes: Any) -> TwoViewEstimator:
    return TwoViewEstimator(preset('best', **changes))


def _crowded_pair(frames: _Frames) -> tuple[View, View, Array, Array]:
    """Return views and many matches of the first two frames, in random order for subsetting."""
    # ORB: our corners keep a minimum distance, which limits their number.
    crowd = _estimator(detector='orb', max_features=4 * max(POINTS), fast_threshold=5)
    previous, current = (crowd.view(image, frames.K) for image in frames.first)
    x, y = crowd.match(previous, current)
    order = np.random.default_rng(0).permutation(len(x))
    return previous, current, x[order], y[order]


def _stage(previous: View, current: View, x: Array, y: Array, **changes: Any
           ) -> Callable[[], float]:
    """Return a function that measures surfaces and optimisation on given matches, in ms."""
    estimator = _estimator(**changes)
    return lambda: 1e3 * estimator.estimate_matched(previous, current, x, y).timings['jet']


def interleaved_minima(measurements: Mapping[Key, Callable[[], float]]) -> dict[Key, float]:
    """
    Return the minimum over repetitions of each measurement.

    All are made once before any is repeated, so that other load of the machine affects all alike.
    """
    rounds = [{key: measurement() for key, measurement in measurements.items()}
              for _ in range(_REPEATS)]
    return {key: min(one[key] for one in rounds) for key in measurements}


def _seconds(action: Callable[[], None]) -> Callable[[], float]:
    def measurement() -> float:
        start = perf_counter()
        action()
        return perf_counter() - start
    return measurement
