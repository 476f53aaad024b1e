"""Edges between keyframes that are no neighbours: links over a few, and loops."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator, MutableMapping
from dataclasses import replace

from djet_ros.config.sections import SlamConfig
from djet_ros.core.covariance import CAUTIOUS_INFLATION, CELL
from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.geometry import rays, unit
from djet_ros.core.masks import blocked
from djet_ros.core.types import Array, RelativePose, Status, TRACKED, View
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
        self._stamps: list[int] = []
        self._places = PlaceIndex()
        # The neighbour before each keyframe: the motion to it has a length.
        self._before: dict[int, Edge] = {}
        self._first = 0

    def add(self, frame: Frame, before: Edge | None = None) -> None:
        """Take the next keyframe, later than all others, and the edge from its neighbour."""
        number = self._first + len(self._stamps)
        mask = None if frame.left_out is None else blocked(frame.left_out)
        features = self._near.features(frame.gray, mask)
        self._kept[number] = KeyframeImage(frame, features)
        self._stamps.append(frame.stamp_ns)
        self._places.add(features)
        if before is not None and before.kind == 'odometry':
            self._before[number] = before

    def forget(self, first: int) -> None:
        """Forget the keyframes before one; nothing is found between them and others any more."""
        for number in range(self._first, first):
            self._kept.pop(number, None)
            self._before.pop(number, None)
        del self._stamps[:first - self._first]
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
        relative = self._near.estimate(self._view(previous), self._view(current))
        if relative.status is Status.OK and self._is_sure(relative):
            yield _edge(previous, current, relative, unknown(guess), 'link')

    def loops(self, current: int, units: bool = False) -> Iterator[Edge]:
        """
        Propose keyframes that look like this one, and give those that geometry bears out.

        units: whether to compare the units of lengths at both ends, see ``unit_change``.
        """
        config, here = self._config, current - self._first
        latest = self._stamps[here] - config.loop_gap * 1e9
        before = self._first + bisect_left(self._stamps, latest, hi=here)
        votes = self._places.votes(self._kept[current].features, before)
        votes[:self._first] = 0
        best = np.argsort(-votes, kind='stable')[:config.loop_candidates]
        for place in best[votes[best] >= config.loop_votes].tolist():
            yield from self._loop(current, place, units)

    def _loop(self, current: int, place: int, units: bool) -> Iterator[Edge]:
        view, other = self._view(current), self._view(place)
        # The estimator takes both views to be of one camera.
        if not np.array_equal(view.K, other.K):
            return
        relative = self._wide.estimate(view, other)
        if relative.status in TRACKED and self._is_sure(relative):
            length = self._length(current, view, relative)
            edge = _edge(current, place, relative, length, 'loop')
            yield edge if not units else replace(
                edge, stretch=self._stretch(current, place, relative, length))

    def _stretch(self, current: int, place: int, loop: RelativePose,
                 length: Length) -> tuple[float, float] | None:
        """Compare the units at both ends of a loop, by points that the steps to both saw too."""
        depths = [self._depths(number) for number in (current, place)]
        if not length.known or depths[0] is None or depths[1] is None:
            return None
        return unit_change(*depths[0], loop, length.value, *depths[1],
                           self._view(current).K)

    def _depths(self, number: int) -> tuple[RelativePose, float] | None:
        """Motion from a keyframe back to its neighbour, and its length; None if not known."""
        step = self._before.get(number)
        if step is None or step.source not in self._kept or not step.scale_known:
            return None
        back = self._near.estimate(self._view(number), self._view(step.source))
        length = float(np.linalg.norm(step.motion[:3, 3]))
        return (back, length) if back.status is Status.OK and length else None

    def _length(self, current: int, view: View, relative: RelativePose) -> Length:
        """Length of a loop's translation, by the points that the last odometry edge saw too."""
        step = self._before.get(current)
        guess = float(np.linalg.norm(step.motion[:3, 3])) if step else 1.0
        if step is None or step.source not in self._kept or not step.scale_known or not guess:
            return unknown(guess)
        if relative.status is Status.NO_PARALLAX:
            # The same place again: nearer than any step, in whatever direction.
            return Length(guess, guess, True)
        back = self._near.estimate(view, self._view(step.source))
        if back.status is not Status.OK:
            return unknown(guess)
        share = np.sqrt(_variance_along(step)) / guess
        return transferred_length(back, relative, Length(guess, guess * share, True), view.K)

    def _is_sure(self, relative: RelativePose) -> bool:
        inliers = int(relative.inliers.sum())
        return (inliers >= self._config.loop_inliers
                and inliers >= self._config.loop_share * len(relative.x))

    def _view(self, keyframe: int) -> View:
        frame, features = self._kept[keyframe]
        return self._wide.view(frame.gray, frame.K, features, frame.left_out)


def transferred_length(step: RelativePose, other: RelativePose, length: Length,
                       K: Array) -> Length:
    """
    Length of another motion from the same first view, from the length of a step.

    A point that both pairs saw has one depth, so that its inverse depths in units of the two
    translations are as the lengths of these. Unknown where too few points are shared.
    """
    _, here, there = np.intersect1d(_pixels(step), _pixels(other), return_indices=True)
    depths, parallax = _inverse_depths(step, K)
    others, _ = _inverse_depths(other, K)
    sure = parallax[here] > _LEAST_PARALLAX
    ratios = others[there][sure] / depths[here][sure]
    ratios = ratios[np.isfinite(ratios)]
    if len(ratios) < _LEAST_SHARED:
        return unknown(length.value)
    ratio = float(np.median(ratios))
    if ratio <= 0:
        return unknown(length.value)
    # Standard deviation of a median, if places apart err independently, and more than that.
    spread = 1.4826 * float(np.median(np.abs(ratios - ratio)))
    places = len(np.unique(step.x[step.inliers][here][sure] // CELL, axis=0))
    sigma = 1.2533 * spread * np.sqrt(CAUTIOUS_INFLATION / places)
    return Length(length.value * ratio,
                  float(np.hypot(length.value * sigma, length.sigma * ratio)), length.known)


def unit_change(step: RelativePose, step_length: float, loop: RelativePose, loop_length: float,
                other: RelativePose, other_length: float, K: Array) -> tuple[float, float] | None:
    """
    Tell how much larger the unit of lengths is at the far end of a loop than at the near one.

    step: from the loop's first view to another, other: from its second view to another, with
    their lengths, each in the unit of its place; the loop's is in the first one's. A point that
    all three saw has two depths in the second view. Gives the logarithm of the ratio of the units
    and its standard deviation; None where too few points are shared.
    """
    _, here, there = np.intersect1d(_pixels(step), _pixels(loop), return_indices=True)
    depths, parallax = _inverse_depths(step, K)
    depths, parallax = depths[here] / step_length, parallax[here]
    x, y = (points[loop.inliers][there] for points in (loop.x, loop.y))
    # Depth at the far end, times the inverse depth at the near one.
    ahead = (rays(K, x) @ loop.R.T)[:, 2] + depths * loop_length * loop.t[2]
    _, seen, again = np.intersect1d(_numbers(y), _pixels(other), return_indices=True)
    others, far_parallax = _inverse_depths(other, K)
    sure = (np.minimum(parallax[seen], far_parallax[again]) > _LEAST_PARALLAX) & (
        depths[seen] > 0) & (ahead[seen] > 0) & (others[again] > 0)
    if sure.sum() < _LEAST_SHARED:
        return None
    there, near, far = others[again][sure], depths[seen][sure], ahead[seen][sure]
    ratios = np.log(there / other_length * far / near)
    ratio = float(np.median(ratios))
    spread = 1.4826 * float(np.median(np.abs(ratios - ratio)))
    places = len(np.unique(x[seen][sure] // CELL, axis=0))
    return ratio, max(1.2533 * spread * float(np.sqrt(CAUTIOUS_INFLATION / places)), 1e-3)


def _pixels(relative: RelativePose) -> NDArray[np.int64]:
    """Numbers (M,) for the inliers, equal where the pixels in the first view are."""
    return _numbers(relative.x[relative.inliers])


def _numbers(points: Array) -> NDArray[np.int64]:
    """Numbers (M,) of pixels (M, 2), equal where these are."""
    columns, rows = np.rint(4 * points).astype(np.int64).T
    return np.asarray(columns + (rows << 20))


def _inverse_depths(relative: RelativePose, K: Array) -> tuple[Array, Array]:
    """Inverse depths in units of the translation, and parallaxes in rad, (M,) of the inliers."""
    m = rays(K, relative.x[relative.inliers]) @ relative.R.T
    y = rays(K, relative.y_opt[relative.inliers])
    # y x (m + rho t) = 0, by least squares: linear, so that noise about zero stays about zero
    shift, lever = np.cross(y, m), np.cross(y, relative.t)
    inverse = -(shift * lever).sum(1) / np.maximum((lever**2).sum(1), 1e-12)
    return inverse, np.linalg.norm(shift, axis=1) / (y**2).sum(1)


def _edge(source: int, target: int, relative: RelativePose, length: Length, kind: str) -> Edge:
    return Edge(source, target, camera_motion(relative, length.value),
                motion_covariance(relative, length) + LEAST_COVARIANCE, kind, length.known)


def _variance_along(edge: Edge) -> float:
    """Variance of the length of an edge's motion."""
    direction = unit(edge.motion[:3, 3])
    return float(direction @ edge.covariance[:3, :3] @ direction)
