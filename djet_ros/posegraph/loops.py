"""Edges between keyframes that are no neighbours: links over a few, and loops."""

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
from djet_ros.core.radial import straight_image
from djet_ros.core.types import Array, of_one_camera, RelativePose, Status, TRACKED, View
from djet_ros.odometry.frame import Frame
from djet_ros.odometry.messages import LEAST_COVARIANCE
from djet_ros.odometry.scale import Length, unknown
from djet_ros.odometry.uncertainty import motion_covariance
from djet_ros.odometry.visual_odometry import camera_motion
from djet_ros.posegraph.keyframe_images import KeyframeImage
from djet_ros.posegraph.places import PlaceIndex
from djet_ros.posegraph.pose_graph import Edge
import numpy as np
from numpy.typing import NDArray

# A place is seen again from beside, from nearer or from farther off: its features are sought in
# a wider circle than those of the next frame.
_SEARCH_RADIUS = 0.4

# Points that two pairs of views must share, for the one to tell the other its length.
_LEAST_SHARED = 20

# Parallax in rad below which a depth is noise (about a pixel of a car's camera).
_LEAST_PARALLAX = 1.5e-3


class EdgeFinder:
    """
    Estimates edges between keyframes from their images, which are kept until they are forgotten.

    Keyframes have the numbers in which they come: 0, 1 and so on. kept: where their images and
    features are kept; in memory unless said otherwise.
    """

    def __init__(self, estimator: EstimatorConfig, config: SlamConfig,
                 kept: MutableMapping[int, KeyframeImage] | None = None) -> None:
        self._config = config
        self._near = TwoViewEstimator(estimator)
        self._wide = TwoViewEstimator(replace(
            estimator, search_radius=max(estimator.search_radius, _SEARCH_RADIUS)))
        self._kept: MutableMapping[int, KeyframeImage] = {} if kept is None else kept
        # Nanoseconds that have gone by until each keyframe; a step back in time takes none.
        self._times: list[int] = []
        self._stamp_ns = self._time = 0
        # The k1 without which each keyframe's features are.
        self._lenses: list[float] = []
        self._places = PlaceIndex()
        # The neighbour before each keyframe: the motion to it has a length.
        self._before: dict[int, Edge] = {}
        self._first = 0
        # The newest keyframe that was asked, and its motion back to its neighbour.
        self._newest: tuple[int, RelativePose] | None = None

    def add(self, frame: Frame, before: Edge | None = None, k1: float = 0.0) -> None:
        """
        Take the next keyframe, and the edge from its neighbour.

        k1: radial distortion without which the odometry saw it.
        """
        number = self._first + len(self._times)
        gray, left_out = frame.gray, frame.left_out
        if k1:
            gray, left_out = straight_image(gray, frame.K, k1, left_out)
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
        """Forget the keyframes before one; nothing is found between them and others any more."""
        for number in range(self._first, first):
            self._kept.pop(number, None)
            self._before.pop(number, None)
        del self._times[:first - self._first], self._lenses[:first - self._first]
        self._first = first
        self._places.forget(first)

    def links(self, current: int) -> Iterator[Edge]:
        """
        Link a keyframe to the last few before it, but for its neighbour, by direct estimates.

        Their lengths are taken as unknown: the odometry's are in the graph already.
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
        if relative.status is Status.OK and self._is_sure(relative):
            yield _edge(previous, current, relative, unknown(guess), 'link')

    def loops(self, current: int, units: bool = False) -> Iterator[Edge]:
        """
        Propose keyframes that look like this one, and give those that geometry bears out.

        units: whether to compare the units of lengths at both ends, see ``unit_change``.
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
        if not of_one_camera(view, other):
            return
        relative = self._wide.estimate(view, other)
        if relative.status in TRACKED and self._is_sure(relative):
            length = self._length(current, relative)
            edge = _edge(current, place, relative, length, 'loop')
            yield edge if not units else replace(
                edge, stretch=self._stretch(current, place, relative, length))

    def _stretch(self, current: int, place: int, loop: RelativePose,
                 length: Length) -> tuple[float, float] | None:
        """Compare the units at both ends of a loop, by points that the steps to both saw too."""
        k1 = self._lens(current)
        near, far = self._depths(current, k1), self._depths(place, k1)
        if not length.known or near is None or far is None:
            return None
        return unit_change(*near, loop, length.value, *far, self._kept[current].frame.K)

    def _depths(self, number: int, k1: float) -> tuple[RelativePose, float] | None:
        """Motion from a keyframe back to its neighbour, and its length; None if not known."""
        step = self._before.get(number)
        if step is None or step.source not in self._kept or not step.scale_known:
            return None
        back = self._back(number, step.source, k1)
        length = float(np.linalg.norm(step.motion[:3, 3]))
        return (back, length) if back.status is Status.OK and length else None

    def _back(self, number: int, neighbour: int, k1: float) -> RelativePose:
        """Estimate a keyframe's motion back to its neighbour; several loops may ask the newest."""
        if self._newest is not None and self._newest[0] == number:
            return self._newest[1]
        back = self._near.estimate(self._view(number, k1), self._view(neighbour, k1))
        if number == self._first + len(self._times) - 1:
            self._newest = number, back
        return back

    def _length(self, current: int, relative: RelativePose) -> Length:
        """Length of a loop's translation, by the points that the last odometry edge saw too."""
        step = self._before.get(current)
        guess = float(np.linalg.norm(step.motion[:3, 3])) if step else 1.0
        if step is None or step.source not in self._kept or not step.scale_known or not guess:
            return unknown(guess)
        if relative.status is Status.NO_PARALLAX:
            # The same place again: nearer than any step, in whatever direction.
            return Length(guess, guess, True)
        depths = self._depths(current, self._lens(current))
        if depths is None:
            return unknown(guess)
        share = np.sqrt(_variance_along(step)) / guess
        return transferred_length(depths[0], relative, Length(guess, guess * share, True),
                                  self._kept[current].frame.K)

    def _is_sure(self, relative: RelativePose) -> bool:
        inliers = int(relative.inliers.sum())
        return (inliers >= self._config.loop_inliers
                and inliers >= self._config.loop_share * len(relative.x))

    def _lens(self, keyframe: int) -> float:
        return self._lenses[keyframe - self._first]

    def _view(self, keyframe: int, k1: float) -> View:
        """
        Give the view of a keyframe without a radial distortion, as the newest of a loop has it.

        All of a loop are seen through one lens so: what is found of it later is true of before.
        Where nothing is known any more, the lens may be another one, and each keeps its own.
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
    Length of another motion from the same first view, from the length of a step.

    A point that both pairs saw has one depth, so that its inverse depths in units of the two
    translations are as the lengths of these. Unknown where too few points are shared.
    """
    told = _ratio(_Depths.here(step, K), _Depths.here(other, K))
    if told is None:
        return unknown(length.value)
    ratio, sigma = told
    return Length(length.value * ratio,
                  float(np.hypot(length.value * sigma, length.sigma * ratio)), length.known)


def unit_change(step: RelativePose, step_length: float, loop: RelativePose, loop_length: float,
                other: RelativePose, other_length: float, K: Array) -> tuple[float, float] | None:
    """
    Tell how much larger the unit of lengths is at the far end of a loop than at the near one.

    step: from the loop's first view to another, other: from its second view to another, with
    their lengths, each in the unit of its place; the loop's is in the first one's. Gives the
    logarithm of the ratio of the units and its standard deviation, by what is surer; None where
    too few points are shared.
    * Points that all three saw have two depths in the second view. Few are found so often, above
      all in small images.
    * Points that the loop shares with one of the others tell its length, once in either unit.
      There are many, but of a loop with hardly any length they tell little.
    """
    near, far = _Depths.here(step, K), _Depths.here(other, K)
    here = _Depths.here(loop, K)
    there = here.there(loop, K)
    ways = []
    at_near, at_far = _ratio(near, here), _ratio(far, there)
    if at_near is not None and at_far is not None:
        ways.append((np.log(at_near[0] * step_length / (at_far[0] * other_length)),
                     np.hypot(at_near[1] / at_near[0], at_far[1] / at_far[0])))
    mine, others = _shared(near, here)
    inverse = _from(near.inverse[mine] / step_length, here.x[others], loop.R,
                    loop_length * loop.t, K)
    both = _ratio(_Depths(there.x[others], inverse, near.parallax[mine]),
                  far.of(far.parallax > _LEAST_PARALLAX))
    if both is not None:
        ways.append((np.log(both[0] / other_length), both[1] / both[0]))
    if not ways:
        return None
    change, sigma = min(ways, key=lambda way: float(way[1]))
    return float(change), max(float(sigma), 1e-3)


class _Depths(NamedTuple):
    """
    What a pair tells of M points in one of its views.

    x: (M, 2) pixels; inverse: (M,) inverse depths in units of the translation; parallax: (M,) rad.
    """

    x: Array
    inverse: Array
    parallax: Array

    @classmethod
    def here(cls, pair: RelativePose, K: Array) -> _Depths:
        """Of the inliers in the pair's first view."""
        x = pair.x[pair.inliers]
        rays_x, rays_y = rays(K, x), rays(K, pair.y_opt[pair.inliers])
        inverse, _ = inverse_depths(pair.R, pair.t, rays_x, rays_y)
        parallax = np.linalg.norm(np.cross(rays_y, rays_x @ pair.R.T), axis=1)
        return cls(x, inverse, parallax / (rays_y**2).sum(1))

    def there(self, pair: RelativePose, K: Array) -> _Depths:
        """Of the same points in the pair's second view."""
        return _Depths(pair.y[pair.inliers], _from(self.inverse, self.x, pair.R, pair.t, K),
                       self.parallax)

    def of(self, chosen: NDArray[np.bool_]) -> _Depths:
        """Give some of the points."""
        return _Depths(*(values[chosen] for values in self))


def _from(inverse: Array, x: Array, R: Array, t: Array, K: Array) -> Array:
    """Inverse depths (M,) in a view to which R, t lead, of pixels x (M, 2); NaN behind it."""
    ahead = (rays(K, x) @ R.T)[:, 2] + inverse * t[2]
    return np.asarray(inverse / np.where(ahead > 0, ahead, np.nan))


def _shared(first: _Depths, second: _Depths) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Give indices (S,) of the points that are the same pixels of a view."""
    _, mine, others = np.intersect1d(_numbers(first.x), _numbers(second.x), return_indices=True)
    return mine, others


def _numbers(points: Array) -> NDArray[np.int64]:
    """Numbers (M,) of pixels (M, 2), equal where these are."""
    columns, rows = np.rint(4 * points).astype(np.int64).T
    return np.asarray(columns + (rows << 20))


def _ratio(sure: _Depths, others: _Depths) -> tuple[float, float] | None:
    """
    Tell by what factor others have larger inverse depths of the same points, and its sigma.

    By points of which the former are sure; None where they are too few.
    """
    mine, theirs = _shared(sure, others)
    x, parallax = sure.x[mine], sure.parallax[mine]
    with np.errstate(divide='ignore', invalid='ignore'):
        ratios = others.inverse[theirs] / sure.inverse[mine]
    told = (parallax > _LEAST_PARALLAX) & np.isfinite(ratios)
    if told.sum() < _LEAST_SHARED:
        return None
    ratio = float(np.median(ratios[told]))
    if ratio <= 0:
        return None
    # Standard deviation of a median, if places apart err independently, and more than that.
    spread = 1.4826 * float(np.median(np.abs(ratios[told] - ratio)))
    places = len(np.unique(x[told] // CELL, axis=0))
    return ratio, 1.2533 * spread * float(np.sqrt(CAUTIOUS_INFLATION / places))


def _edge(source: int, target: int, relative: RelativePose, length: Length, kind: str) -> Edge:
    return Edge(source, target, camera_motion(relative, length.value),
                motion_covariance(relative, length) + LEAST_COVARIANCE, kind, length.known)


def _variance_along(edge: Edge) -> float:
    """Variance of the length of an edge's motion."""
    direction = unit(edge.motion[:3, 3])
    return float(direction @ edge.covariance[:3, :3] @ direction)
