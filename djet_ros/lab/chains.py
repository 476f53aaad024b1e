"""
Complete pipelines of other libraries, from two images to their relative pose.

Unlike the methods in ``peers``, they detect and match their own points. All their settings are
here; none comes from a preset. Settings that matter were chosen for their lowest errors, by means
and medians over nine rendered scenes, and checked on real frames:

* Lucas-Kanade: windows of 7, 9, 11, 13, 15, 21 and 31 pixels, 3 to 5 pyramid levels. Smaller
  windows are more accurate, down to 11; more levels track larger motions. OpenCV's defaults, 21
  and 3, leave 1.4 to 1.9 times the error, and lose some of every fifth frame. Forward-backward
  thresholds of 0.5 or 1 px, weaker corners, and larger blocks make no difference overall, or are
  worse.
* SIFT: ratios of 0.75 to 0.95 differ by a few per cent; lower contrast helps under water only.
  With ``enable_precise_upscale`` keypoints are not shifted by a quarter of a pixel: directions of
  forward drives are better by a tenth to a third, but rotations and other scenes worse.
* PoseLib: a Cauchy loss of 0.1 px, instead of the default 0.5 px, reduces the error of both by a
  fifth, most of all in sharp images; 0.25 px is better in blurred ones only. Thresholds of 0.5 to
  2 px, the Huber and a truncated loss are no better overall.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
from djet_ros.core.masks import Mask
from djet_ros.core.types import Array, RelativePose, Status
from djet_ros.lab.peers import as_relative_pose, poselib
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]

_POINTS = 2000
_RATIO = 0.85
_MIN_DISTANCE, _QUALITY = 8, 0.01
_WINDOW, _LEVELS = 11, 5
_MAX_ROUND_TRIP = 1.0
# Fewest matches for an estimate: more than the 5-point method needs for one hypothesis.
_MIN_MATCHES = 8


@dataclass(frozen=True)
class Points:
    """Points (N, 2) float32 of one image in pixels, and their descriptors (N, D), D may be 0."""

    image: Image
    places: NDArray[np.float32]
    descriptors: NDArray[np.float32]


@dataclass(frozen=True)
class Chain:
    """Functions that detect the points of an image, and match them as x, y (N, 2) in pixels."""

    detect: Callable[[Image, Mask | None], Points]
    match: Callable[[Points, Points], tuple[Array, Array]]

    def estimate(self, previous: Points, current: Points, K: Array) -> RelativePose:
        """Estimate the relative pose of two images from their points; K (3, 3)."""
        x, y = self.match(previous, current)
        if len(x) < _MIN_MATCHES:
            return RelativePose(Status.TOO_FEW_MATCHES, x=x, y=y)
        return as_relative_pose(poselib(K, x, y), K, x, y)


def root_sift(gray: Image, mask: Mask | None = None) -> Points:
    """
    Find the 2000 strongest SIFT points; descriptors are roots of SIFT's, scaled to a sum of 1.

    mask: (H, W) bool, where no point may be.

    R. Arandjelovic, A. Zisserman, "Three things everyone should know to improve object
    retrieval", CVPR 2012: distances of roots compare histograms by Hellinger's kernel.
    """
    keypoints, descriptors = cv2.SIFT.create(_POINTS).detectAndCompute(gray, _allowed(mask))
    if descriptors is None:
        return Points(gray, np.empty((0, 2), np.float32), np.empty((0, 128), np.float32))
    sums = np.maximum(descriptors.sum(axis=1, keepdims=True), np.float32(1e-9))
    return Points(gray, np.asarray(cv2.KeyPoint.convert(keypoints), np.float32).reshape(-1, 2),
                  np.sqrt(descriptors / sums))


def mutual_neighbours(previous: Points, current: Points) -> tuple[Array, Array]:
    """Match points that are nearest to each other and clearly nearer than the next (0.85)."""
    if min(len(previous.places), len(current.places)) < 2:
        return np.empty((0, 2)), np.empty((0, 2))
    # Descriptors have unit length.
    squares = np.maximum(2 - 2 * previous.descriptors @ current.descriptors.T, 0)
    nearest = squares.argmin(axis=1)
    first, second = np.partition(squares, 1, axis=1)[:, :2].T
    mutual = squares.argmin(axis=0)[nearest] == np.arange(len(nearest))
    mutual &= first < _RATIO ** 2 * second
    return (previous.places[mutual].astype(np.float64),
            current.places[nearest[mutual]].astype(np.float64))


def corners(gray: Image, mask: Mask | None = None) -> Points:
    """Find up to 2000 corners by Shi and Tomasi at least 8 pixels apart, outside a mask (H, W)."""
    detected = cv2.goodFeaturesToTrack(gray, _POINTS, _QUALITY, _MIN_DISTANCE, mask=_allowed(mask))
    places = np.asarray([] if detected is None else detected, np.float32).reshape(-1, 2)
    return Points(gray, places, np.empty((len(places), 0), np.float32))


def tracked(previous: Points, current: Points) -> tuple[Array, Array]:
    """Track corners by pyramids of Lucas and Kanade; keep those tracked back to within 1 px."""
    if not len(previous.places):
        return np.empty((0, 2)), np.empty((0, 2))
    moved, found = _flow(previous.image, current.image, previous.places)
    back, found_back = _flow(current.image, previous.image, moved)
    returned = found & found_back
    returned &= np.linalg.norm(back - previous.places, axis=1) <= _MAX_ROUND_TRIP
    return previous.places[returned].astype(np.float64), moved[returned].astype(np.float64)


def _flow(before: Image, after: Image, places: NDArray[np.float32]
          ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    tracked, status, _ = cv2.calcOpticalFlowPyrLK(before, after, places[:, None], np.empty(0),
                                                  winSize=(_WINDOW, _WINDOW), maxLevel=_LEVELS)
    return np.asarray(tracked, np.float32).reshape(-1, 2), status.ravel() > 0


def _allowed(mask: Mask | None) -> Image | None:
    """Return OpenCV's form of a mask: 255 where points are allowed."""
    return None if mask is None else np.where(mask, 0, 255).astype(np.uint8)


CHAINS: dict[str, Chain] = {'sift_poselib': Chain(root_sift, mutual_neighbours),
                            'klt_poselib': Chain(corners, tracked)}
