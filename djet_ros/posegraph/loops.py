"""Edges between non-consecutive keyframes: links over a few keyframes, and loops."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator, MutableMapping
from dataclasses import replace
from typing import NamedTuple

from djet_ros.config.sections import SlamConfig
from djet_ros.core.cells import CAUTIOUS_INFLATION, CELL
from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.geometry import inverse_depths, rays, unit
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
import numpy as np
from numpy.typing import NDArray

# Search radius of features in a loop, as a share of the longer image side: a place is revisited
# from another viewpoint.
_SEARCH_RADIUS = 0.4

# Minimum number of points that two pairs of views must share to transfer a length.
_MIN_SHARED = 20

# Parallax in rad below which a depth is noise (about a pixel of a car's camera).
_MIN_PARALLAX = 1.5e-3


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
        # The k1 that is corrected in the features of each keyframe.
        self._lenses: list[float] = []
        self._places = PlaceIndex()
        # The odometry edge to each keyframe from its predecessor.
        self._before: dict[int, Edge] = {}
        self._first = 0
        # The newest keyframe, and its estimated motion back to its predecessor (cache).
        self._newest: tuple[int, RelativePose] | None = None

    def add(self, frame: Frame, before: Edge | None = None, k1: float = 0.0) -> None:
        """
        Add the next keyframe, and the edge from its predecessor.

        k1: radial distortion that the odometry had corrected in it.
        """
        number = self._first + len(self._times)
        gray, left_out = frame.gray, frame.left_out
        if k1:
            gray, left_out = undistort_image(gray, frame.K, k1, left_out)
        features = self._near.features(gray, None if left_out is None else blocked(left_out))
        self._kept[number] = KeyframeImage(frame, features)
        self._time += max(frame.stamp_ns - self._stamp_ns, 0)
        self._stamp_ns = frame.stamp_ns
        self._times.append(self._time)
        self._lenses.append(k1)
        self._places.add(features)
        if before is not None and before.kind == 'odometry':
            self._before[number] = before

    def forget(self, first: int) -> None:
        """Remove the keyframes before one."""
        for number in range(self._first, first):
            self._kept.pop(number, None)
            self._before.pop(number, None)
        del self._times[:first - self._first], self._lenses[:first - self._first]
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
        k1 = self._lens(current)
        relative = self._near.estimate(self._view(previous, k1), self._view(current, k1))
        if relative.status is Status.OK and self._is_verified(relative):
            yield _edge(previous, current, relative, unknown(guess), 'link')

    def loops(self, current: int, units: bool = False) -> Iterator[Edge]:
        """
        Yield loops of a keyframe: similar keyframes that pass geometric verification.

        units: whether to estimate the ratio of the units at both ends, see ``log_scale_ratio``.
        """
        config, here = self._config, current - self._first
        latest = self._times[here] - config.loop_gap * 1e9
        before = self._first + bisect_left(self._times, latest, hi=here)
        votes = self._places.votes(self._kept[current].features, before)
        votes[:self._first] = 0
        best = np.argsort(-votes, kind='stable')[:config.loop_candidates]
        for place in best[votes[best] >= config.loop_votes].tolist():
            yield from self._loop(current, place, units)

    def _loop(self, current: int, place: int, units: bool) -> Iterator[Edge]:
        k1 = self._lens(current)
        view, other = self._view(current, k1), self._view(place, k1)
        if not of_same_camera(view, other):
            return
        relative = self._wide.estimate(view, other)
        if relative.status in TRACKED and self._is_verified(relative):
            length = self._length(current, relative)
            edge = _edge(current, place, relative, length, 'loop')
            yield edge if not units else replace(
                edge, log_scale_ratio=self._log_scale_ratio(current, place, relative, length))

    def _log_scale_ratio(self, current: int, place: int, loop: RelativePose,
                         length: Length) -> tuple[float, float] | None:
        """Estimate the ratio of the units at the ends of a loop, from points shared with steps."""
        k1 = self._lens(current)
        near, far = self._depths(current, k1), self._depths(place, k1)
        if not length.known or near is None or far is None:
            return None
        return log_scale_ratio(*near, loop, length.value, *far, self._kept[current].frame.K)

    def _depths(self, number: int, k1: float) -> tuple[RelativePose, float] | None:
        """Return the motion of a keyframe back to its predecessor and its length, or None."""
        step = self._before.get(number)
        if step is None or step.source not in self._kept or not step.scale_known:
            return None
        back = self._back(number, step.source, k1)
        length = float(np.linalg.norm(step.motion[:3, 3]))
        return (back, length) if back.status is Status.OK and length else None

    def _back(self, number: int, neighbour: int, k1: float) -> RelativePose:
        """Estimate the motion back to the predecessor; cached for the newest keyframe."""
        if self._newest is not None and self._newest[0] == number:
            return self._newest[1]
        back = self._near.estimate(self._view(number, k1), self._view(neighbour, k1))
        if number == self._first + len(self._times) - 1:
            self._newest = number, back
        return back

    def _length(self, current: int, relative: RelativePose) -> Length:
        """Return the length of a loop's translation, from points shared with the last edge."""
        step = self._before.get(current)
        guess = float(np.linalg.norm(step.motion[:3, 3])) if step else 1.0
        if step is None or step.source not in self._kept or not step.scale_known or not guess:
            return unknown(guess)
        if relative.status is Status.NO_PARALLAX:
            # The same place: shorter than a step, in any direction.
            return Length(guess, guess, True)
        depths = self._depths(current, self._lens(current))
        if depths is None:
            return unknown(guess)
        share = np.sqrt(_variance_along(step)) / guess
        return transferred_length(depths[0], relative, Length(guess, guess * share, True),
                                  self._kept[current].frame.K)

    def _is_verified(self, relative: RelativePose) -> bool:
        inliers = int(relative.inliers.sum())
        return (inliers >= self._config.loop_inliers
                and inliers >= self._config.loop_share * len(relative.x))

    def _lens(self, keyframe: int) -> float:
        return self._lenses[keyframe - self._first]

    def _view(self, keyframe: int, k1: float) -> View:
        """
        Return the view of a keyframe with the radial distortion k1 corrected.

        k1 is that of the newest keyframe of a loop: a later estimate also holds for earlier
        keyframes. If it is 0 after a reset, the lens may be another, and each keyframe keeps its
        own.
        """
        own = self._lens(keyframe)
        k1 = k1 or own
        frame, features = self._kept[keyframe]
        estimator = TwoViewEstimator(self._wide.config, k1) if k1 else self._wide
        return estimator.view(frame.gray, frame.K, features if k1 == own else None,
                              frame.left_out)


def transferred_length(step: RelativePose, other: RelativePose, length: Length,
                       K: Array) -> Length:
    """
    Return the length of another motion from the same first view, from the length of a step.

    A point seen in both pairs has one depth, so its inverse depths in units of the translations
    are proportional to their lengths. Unknown if too few points are shared.
    """
    estimated = _ratio(_Depths.here(step, K), _Depths.here(other, K))
    if estimated is None:
        return unknown(length.value)
    ratio, sigma = estimated
    return Length(length.value * ratio,
                  float(np.hypot(length.value * sigma, length.sigma * ratio)), length.known)


def log_scale_ratio(step: RelativePose, step_length: float, loop: RelativePose,
                    loop_length: float, other: RelativePose, other_length: float,
                    K: Array) -> tuple[float, float] | None:
    """
    Estimate the unit of length at the far end of a loop relative to that at the near end.

    step: pair from the loop's first view to another, other: pair from its second view to another,
    each with its length in the unit of its place; loop_length is in the unit of the first.
    Returns (log ratio, standard deviation) by the more accurate of two estimates, None if too few
    points are shared:
    * Points seen in all three pairs have two depths in the second view. They are few, above all in
      small images.
    * Points shared by the loop and one other pair give the loop's length, once in each unit. They
      are many, but hardly determine it if the loop is short.
    """
    near, far = _Depths.here(step, K), _Depths.here(other, K)
    here = _Depths.here(loop, K)
    there = here.there(loop, K)
    estimates = []
    at_near, at_far = _ratio(near, here), _ratio(far, there)
    if at_near is not None and at_far is not None:
        estimates.append((np.log(at_near[0] * step_length / (at_far[0] * other_length)),
                          np.hypot(at_near[1] / at_near[0], at_far[1] / at_far[0])))
    mine, others = _shared(near, here)
    inverse = _from(near.inverse[mine] / step_length, here.x[others], loop.R,
                    loop_length * loop.t, K)
    both = _ratio(_Depths(there.x[others], inverse, near.parallax[mine]),
                  far.of(far.parallax > _MIN_PARALLAX))
    if both is not None:
        estimates.append((np.log(both[0] / other_length), both[1] / both[0]))
    if not estimates:
        return None
    ratio, sigma = min(estimates, key=lambda estimate: float(estimate[1]))
    return float(ratio), max(float(sigma), 1e-3)


class _Depths(NamedTuple):
    """
    Depths of M points in one view of a pair.

    x: (M, 2) pixels; inverse: (M,) inverse depths in units of the translation; parallax: (M,) rad.
    """

    x: Array
    inverse: Array
    parallax: Array

    @classmethod
    def here(cls, pair: RelativePose, K: Array) -> _Depths:
        """Return the depths of the inliers in the pair's first view."""
        x = pair.x[pair.inliers]
        rays_x, rays_y = rays(K, x), rays(K, pair.y_opt[pair.inliers])
        inverse, _ = inverse_depths(pair.R, pair.t, rays_x, rays_y)
        parallax = np.linalg.norm(np.cross(rays_y, rays_x @ pair.R.T), axis=1)
        return cls(x, inverse, parallax / (rays_y**2).sum(1))

    def there(self, pair: RelativePose, K: Array) -> _Depths:
        """Return the depths of the same points in the pair's second view."""
        return _Depths(pair.y[pair.inliers], _from(self.inverse, self.x, pair.R, pair.t, K),
                       self.parallax)

    def of(self, chosen: NDArray[np.bool_]) -> _Depths:
        """Return the depths of some of the points."""
        return _Depths(*(values[chosen] for values in self))


def _from(inverse: Array, x: Array, R: Array, t: Array, K: Array) -> Array:
    """Return the inverse depths (M,) of pixels x (M, 2) in a second view (R, t); NaN behind it."""
    ahead = (rays(K, x) @ R.T)[:, 2] + inverse * t[2]
    return np.asarray(inverse / np.where(ahead > 0, ahead, np.nan))


def _shared(first: _Depths, second: _Depths) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return two index arrays (S,) of the points with the same pixels."""
    _, mine, others = np.intersect1d(_pixel_keys(first.x), _pixel_keys(second.x),
                                     return_indices=True)
    return mine, others


def _pixel_keys(points: Array) -> NDArray[np.int64]:
    """Return keys (M,) of pixels (M, 2), equal for equal quarter pixels."""
    columns, rows = np.rint(4 * points).astype(np.int64).T
    return np.asarray(columns + (rows << 20))


def _ratio(sure: _Depths, others: _Depths) -> tuple[float, float] | None:
    """
    Return the ratio of others' inverse depths to those of the same points, and its sigma.

    Only points with sufficient parallax in sure are used; None if they are too few.
    """
    mine, theirs = _shared(sure, others)
    x, parallax = sure.x[mine], sure.parallax[mine]
    with np.errstate(divide='ignore', invalid='ignore'):
        ratios = others.inverse[theirs] / sure.inverse[mine]
    used = (parallax > _MIN_PARALLAX) & np.isfinite(ratios)
    if used.sum() < _MIN_SHARED:
        return None
    ratio = float(np.median(ratios[used]))
    if ratio <= 0:
        return None
    # Standard deviation of a median with independent errors per image cell, inflated.
    spread = 1.4826 * float(np.median(np.abs(ratios[used] - ratio)))
    cells = len(np.unique(x[used] // CELL, axis=0))
    return ratio, 1.2533 * spread * float(np.sqrt(CAUTIOUS_INFLATION / cells))


def _edge(source: int, target: int, relative: RelativePose, length: Length, kind: str) -> Edge:
    return Edge(source, target, camera_motion(relative, length.value),
                motion_covariance(relative, length) + LEAST_COVARIANCE, kind, length.known)


def _variance_along(edge: Edge) -> float:
    """Return the variance of the length of an edge's motion."""
    direction = unit(edge.motion[:3, 3])
    return float(direction @ edge.covariance[:3, :3] @ direction)
