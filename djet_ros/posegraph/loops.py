"""Edges between non-consecutive keyframes: links over a few keyframes, and loops."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator, MutableMapping
from dataclasses import replace

from djet_ros.config.sections import SlamConfig
from djet_ros.core.correction import AS_CALIBRATED, Correction
from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.geometry import unit
from djet_ros.core.masks import blocked
from djet_ros.core.radial import undistort_image
from djet_ros.core.types import Array, of_same_camera, RelativePose, Status, TRACKED, View
from djet_ros.odometry.frame import Frame
from djet_ros.odometry.messages import LEAST_COVARIANCE
from djet_ros.odometry.result import camera_motion
from djet_ros.odometry.scale import Length, unknown
from djet_ros.odometry.uncertainty import motion_covariance
from djet_ros.posegraph.keyframe_images import KeyframeImage
from djet_ros.posegraph.places import PlaceIndex
from djet_ros.posegraph.pose_graph import Edge
from djet_ros.posegraph.shared_points import log_scale_ratio, transferred_length
import numpy as np

# Search radius of features in a loop, as a share of the longer image side: a place is revisited
# from another viewpoint.
_SEARCH_RADIUS = 0.4


class EdgeFinder:
    """
    Estimates edges between keyframes from their images, which it stores.

    Keyframes are numbered in the order in which they are added: 0, 1 and so on. kept: storage of
    their images and features, in memory by default.
    """

    def __init__(self, estimator: EstimatorConfig, config: SlamConfig,
                 kept: MutableMapping[int, KeyframeImage] | None = None) -> None:
        self._config = config
        self._near = TwoViewEstimator(estimator)
        self._wide = TwoViewEstimator(replace(
            estimator, search_radius=max(estimator.search_radius, _SEARCH_RADIUS)))
        self._kept: MutableMapping[int, KeyframeImage] = {} if kept is None else kept
        # Elapsed time in ns at each keyframe; steps back in time count as 0.
        self._times: list[int] = []
        self._stamp_ns = self._time = 0
        # What is corrected in the features of each keyframe.
        self._corrections: list[Correction] = []
        self._places = PlaceIndex()
        # The odometry edge to each keyframe from its predecessor.
        self._before: dict[int, Edge] = {}
        self._first = 0
        # The newest keyframe, and its estimated motion back to its predecessor (cache).
        self._newest: tuple[int, RelativePose] | None = None

    def add(self, frame: Frame, before: Edge | None = None,
            correction: Correction = AS_CALIBRATED) -> None:
        """
        Add the next keyframe, and the edge from its predecessor.

        correction: what the odometry had corrected in it.
        """
        number = self._first + len(self._times)
        gray, left_out = undistort_image(frame.gray, correction.camera_matrix(frame.K),
                                         correction.k1, frame.left_out)
        features = self._near.features(gray, None if left_out is None else blocked(left_out))
        self._kept[number] = KeyframeImage(frame, features)
        self._time += max(frame.stamp_ns - self._stamp_ns, 0)
        self._stamp_ns = frame.stamp_ns
        self._times.append(self._time)
        self._corrections.append(correction)
        self._places.add(features)
        if before is not None and before.kind == 'odometry':
            self._before[number] = before

    def forget(self, first: int) -> None:
        """Remove the keyframes before one."""
        for number in range(self._first, first):
            self._kept.pop(number, None)
            self._before.pop(number, None)
        del self._times[:first - self._first], self._corrections[:first - self._first]
        self._first = first
        self._places.forget(first)

    def links(self, current: int) -> Iterator[Edge]:
        """
        Yield two-view estimates to the last few keyframes before one, except its predecessor.

        Their lengths count as unknown, as those of the odometry are in the graph already.
        """
        motion, previous = np.eye(4), current
        for step in range(self._config.links):
            before = self._before.get(previous)
            if before is None or before.source not in self._kept:
                return
            motion, previous = before.motion @ motion, before.source
            if step:
                yield from self._link(current, previous, float(np.linalg.norm(motion[:3, 3])))

    def _link(self, current: int, previous: int, guess: float) -> Iterator[Edge]:
        relative = self._estimated(self._near, previous, current, self._correction(current))
        if relative and relative.status is Status.OK and self._is_verified(relative):
            yield _edge(previous, current, relative, unknown(guess), 'link')

    def loops(self, current: int, units: bool = False) -> Iterator[Edge]:
        """
        Yield loops of a keyframe: similar keyframes that pass geometric verification.

        units: whether to estimate the ratio of the units at both ends, see ``log_scale_ratio``.
        """
        config, index = self._config, current - self._first
        latest = self._times[index] - config.loop_gap * 1e9
        before = self._first + bisect_left(self._times, latest, hi=index)
        votes = self._places.votes(self._kept[current].features, before)
        votes[:self._first] = 0
        best = np.argsort(-votes, kind='stable')[:config.loop_candidates]
        for place in best[votes[best] >= config.loop_votes].tolist():
            yield from self._loop(current, place, units)

    def _loop(self, current: int, place: int, units: bool) -> Iterator[Edge]:
        relative = self._estimated(self._wide, current, place, self._correction(current))
        if relative and relative.status in TRACKED and self._is_verified(relative):
            length = self._length(current, relative)
            edge = _edge(current, place, relative, length, 'loop')
            yield edge if not units else replace(
                edge, log_scale_ratio=self._log_scale_ratio(current, place, relative, length))

    def _log_scale_ratio(self, current: int, place: int, loop: RelativePose,
                         length: Length) -> tuple[float, float] | None:
        """Estimate the ratio of the units at the ends of a loop, from points shared with steps."""
        correction = self._correction(current)
        near, far = self._depths(current, correction), self._depths(place, correction)
        if not length.known or near is None or far is None:
            return None
        return log_scale_ratio(*near, loop, length.value, *far, self._K(current))

    def _depths(self, number: int, correction: Correction) -> tuple[RelativePose, float] | None:
        """Return the motion of a keyframe back to its predecessor and its length, or None."""
        step = self._before.get(number)
        if step is None or step.source not in self._kept or not step.scale_known:
            return None
        back = self._back(number, step.source, correction)
        length = float(np.linalg.norm(step.motion[:3, 3]))
        return (back, length) if back and back.status is Status.OK and length else None

    def _back(self, number: int, neighbour: int, correction: Correction) -> RelativePose | None:
        """
        Estimate the motion back to the predecessor; None if that is of another camera.

        Cached for the newest keyframe.
        """
        if self._newest is not None and self._newest[0] == number:
            return self._newest[1]
        back = self._estimated(self._near, number, neighbour, correction)
        if back and number == self._first + len(self._times) - 1:
            self._newest = number, back
        return back

    def _estimated(self, estimator: TwoViewEstimator, one: int, other: int,
                   correction: Correction) -> RelativePose | None:
        """Estimate the motion from one keyframe to another; None if they are of two cameras."""
        views = self._view(one, correction), self._view(other, correction)
        return estimator.estimate(*views) if of_same_camera(*views) else None

    def _length(self, current: int, relative: RelativePose) -> Length:
        """Return the length of a loop's translation, from points shared with the last edge."""
        step = self._before.get(current)
        guess = float(np.linalg.norm(step.motion[:3, 3])) if step else 1.0
        if step is None or step.source not in self._kept or not step.scale_known or not guess:
            return unknown(guess)
        if relative.status is Status.NO_PARALLAX:
            # The same place: shorter than a step, in any direction.
            return Length(guess, guess, True)
        depths = self._depths(current, self._correction(current))
        if depths is None:
            return unknown(guess)
        share = np.sqrt(_variance_along(step)) / guess
        return transferred_length(depths[0], relative, Length(guess, guess * share, True),
                                  self._K(current))

    def _is_verified(self, relative: RelativePose) -> bool:
        inliers = int(relative.inliers.sum())
        return (inliers >= self._config.loop_inliers
                and inliers >= self._config.loop_share * len(relative.x))

    def _correction(self, keyframe: int) -> Correction:
        return self._corrections[keyframe - self._first]

    def _K(self, keyframe: int) -> Array:
        return self._correction(keyframe).camera_matrix(self._kept[keyframe].frame.K)

    def _view(self, keyframe: int, correction: Correction) -> View:
        """
        Return the view of a keyframe, corrected.

        By the correction of the newest keyframe of a loop: a later estimate also holds for earlier
        keyframes. If there is none after a reset, the camera may be another, and each keyframe
        keeps its own.
        """
        own = self._correction(keyframe)
        correction = correction if any(correction) else own
        frame, features = self._kept[keyframe]
        estimator = (TwoViewEstimator(self._wide.config, correction) if any(correction)
                     else self._wide)
        return estimator.view(frame.gray, frame.K, features if correction.k1 == own.k1 else None,
                              frame.left_out)


def _edge(source: int, target: int, relative: RelativePose, length: Length, kind: str) -> Edge:
    return Edge(source, target, camera_motion(relative, length.value),
                motion_covariance(relative, length) + LEAST_COVARIANCE, kind, length.known)


def _variance_along(edge: Edge) -> float:
    """Return the variance of the length of an edge's motion."""
    direction = unit(edge.motion[:3, 3])
    return float(direction @ edge.covariance[:3, :3] @ direction)
