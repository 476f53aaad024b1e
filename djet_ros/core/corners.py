"""
Corners of three sizes, well spread over the image, each with a descriptor.

A corner is a place around which gradients vary in all directions: the smaller eigenvalue of their
second moments is large (Shi and Tomasi, "Good Features to Track", CVPR 1994). Where it is small
beside the larger one there is an edge, whose stair steps pass for corners at one size only.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
from djet_ros.core.cells import rank_in_cells
from djet_ros.core.hamming import dense_descriptors, describable, Image, Pixels, smooth
from djet_ros.core.masks import at, Mask
from djet_ros.core.orb_pattern import REACH
from djet_ros.core.parallel import each
from djet_ros.core.types import Features
import numpy as np
from numpy.typing import NDArray

# How many times smaller the image is made for corners of each size, and their shares of all.
_SIZES = ((1.0, 0.6), (1.44, 0.25), (2.07, 0.15))

# Side of the block, in each second pixel, over which gradients are collected.
_BLOCK = 3

# Least share of the smaller eigenvalue in the larger one; the rest are edges.
_LEAST_RATIO = 0.1

# Rows of blocks that are looked at at once.
_STRIP = 64

# Corners are the strongest of all that are so near, in each second pixel each way: those of the
# wider surroundings come first, and the others where there are not enough.
_APART, _AT_LEAST_APART = 3, 1

# The strongest of each cell of this side, in pixels, come first, then the second, and so on.
_CELL = 40

# Sum of the weights of a Sobel operator's side, times its distance: its answer to a slope of 1.
_SOBEL = 8.0


def detect_corners(gray: Image, max_features: int, contrast: float,
                   mask: Mask | None = None, smoothed: Image | None = None) -> Features:
    """
    Detect corners in a gray image (H, W) uint8; images too small for a descriptor give none.

    contrast: rms slope, in gray levels per pixel, that a corner has at least in its weakest
    direction. Points lie between pixels; descriptors are ORB's, unrotated, of the nearest pixels
    in the image made smaller. Octaves number the sizes. mask: (H, W) bool, where no point may be;
    smoothed: gray as ORB's tests see it, where that is known already.
    """
    sizes = [(octave, scale, round(share * max_features))
             for octave, (scale, share) in enumerate(_SIZES)
             if min(gray.shape) > 2 * scale * (REACH + 1)]
    found = each(lambda size: _of_size(gray, *size, contrast, mask), sizes)
    if not found:
        none = np.empty(0, np.float32)
        return Features.described(np.empty((0, 2)), np.empty(0, np.int32), none, none,
                                  np.empty((0, 32), np.uint8))
    points, octaves, responses, pixels = zip(*found)
    places = [(scale, there) for (_, scale, _), there in zip(sizes, pixels)]
    return Features(np.concatenate(points), np.concatenate(octaves),
                    np.zeros(sum(map(len, points)), np.float32), np.concatenate(responses),
                    lambda: _descriptors(gray, places, smoothed))


def corner_slopes(image: Image) -> NDArray[np.float32]:
    """
    Mean square slopes of blocks in their weakest direction, per pixel; 0 on edges.

    Gives (H // 2, W // 2): of blocks around each second pixel, which takes a third of the time.
    """
    # Halves are exact, and OpenCV is five times as fast, where both sides are even.
    height, width = (side // 2 for side in image.shape)
    image, slopes = image[:2 * height, :2 * width], np.empty((height, width), np.float32)
    for first in range(0, height, _STRIP):
        slopes[first:first + _STRIP] = _slopes_of_rows(image, first, min(first + _STRIP, height))
    return slopes


def _slopes_of_rows(image: Image, first: int, after: int) -> NDArray[np.float32]:
    """Slopes of some rows of blocks: what stands for an image meanwhile stays in the cache."""
    # With the rows that are next to them, and those that these take their slopes from.
    start, end = max(first - 1, 0), min(after + 1, len(image) // 2)
    top = max(2 * start - 1, 0)
    dx, dy = (slope[2 * start - top:2 * end - top].astype(np.float32)
              for slope in cv2.spatialGradient(image[top:2 * end + 1]))
    both = dx * dy
    dx *= dx
    dy *= dy
    xx, xy, yy = (_over_block(products)[first - start:after - start]
                  for products in (dx, both, dy))
    trace = xx + yy
    # Not by cv2.magnitude: its last bit depends on where in memory the arrays lie.
    xx -= yy
    xx *= xx
    xy *= xy
    xy *= 4
    xx += xy
    spread = np.sqrt(xx, out=xx)
    least, most = trace - spread, trace + spread
    most *= np.float32(_LEAST_RATIO)
    np.copyto(least, 0, where=least < most)
    least *= np.float32(0.5 / _SOBEL**2)
    return np.asarray(least, np.float32)


def _over_block(products: NDArray[Any]) -> NDArray[np.float32]:
    """Means over blocks around each second pixel; both sides of the products are even."""
    height, width = products.shape
    halved = cv2.resize(products, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.boxFilter(halved, -1, (_BLOCK, _BLOCK)), np.float32)


def spread_out(points: Pixels, strengths: NDArray[np.float32], most: int,
               first: NDArray[np.bool_]) -> NDArray[np.int64]:
    """
    Choose, in order, at most so many of (N, 2) points: the best of each cell before others.

    first: (N,) bool mask of points that come before all others.
    """
    by_strength = _strongest_first(strengths)
    columns, rows = (points[by_strength, axis] // _CELL for axis in (0, 1))
    late = ~first[by_strength]
    rank = rank_in_cells(_short((rows * (columns.max(initial=0) + 1) + columns) * 2 + late))
    later = _short(rank + (rank.max(initial=0) + 1) * late)
    return np.asarray(np.sort(by_strength[np.argsort(later, kind='stable')[:most]]))


def _strongest_first(strengths: NDArray[np.float32]) -> NDArray[np.int64]:
    """
    Give the order of strengths (N,), none below 0, of equal ones the first first.

    Bits of such numbers are ordered as they are. With their places they differ all, and sorted as
    they are they take a third of the time of a stable `argsort`.
    """
    keys = (~strengths.view(np.uint32)).astype(np.uint64) << np.uint64(32)
    keys |= np.arange(len(keys), dtype=np.uint64)
    keys.sort()
    return (keys & np.uint64(2**32 - 1)).astype(np.int64)


def _short(numbers: NDArray[np.int64]) -> NDArray[Any]:
    """Give numbers from 0 on in as few bytes as hold them: sorted ten times as fast."""
    return numbers.astype(np.min_scalar_type(numbers.max(initial=0)))


def _of_size(gray: Image, octave: int, scale: float, most: int, contrast: float,
             mask: Mask | None,
             ) -> tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.float32], Pixels]:
    """Points, octaves and responses of the corners of one size; their pixels in its image."""
    image = _made_smaller(gray, scale)
    slopes = corner_slopes(image)
    lonely, peaks = (slopes == cv2.dilate(slopes, np.ones((side, side), np.uint8))
                     for side in (2 * _APART + 1, 2 * _AT_LEAST_APART + 1))
    # Of a flat array, five times as fast.
    rows, columns = np.divmod(np.flatnonzero(peaks & (slopes > contrast**2)), slopes.shape[1])
    points = _exact_peaks(slopes, rows, columns)
    zoom = np.array(gray.shape[::-1]) / image.shape[::-1]
    inside = describable(_pixels(points), image.shape) & ~at(mask, (points + 0.5) * zoom - 0.5)
    points, rows, columns = points.compress(inside, axis=0), rows[inside], columns[inside]
    strengths = slopes[rows, columns]
    chosen = spread_out(_pixels(points), strengths, most, lonely[rows, columns])
    points, strengths = points[chosen], strengths[chosen]
    return ((points + 0.5) * zoom - 0.5, np.full(len(points), octave, np.int32),
            np.sqrt(strengths), _pixels(points))


def _descriptors(gray: Image, places: Sequence[tuple[float, Pixels]],
                 smoothed: Image | None) -> Image:
    """Descriptors (N, 32) at pixels of the image made smaller by a scale, for some scales."""
    def of_size(place: tuple[float, Pixels]) -> Image:
        scale, pixels = place
        seen = (smoothed if scale == 1 and smoothed is not None
                else smooth(_made_smaller(gray, scale)))
        return dense_descriptors(seen, pixels)

    return np.concatenate(each(of_size, places))


def _made_smaller(gray: Image, scale: float) -> Image:
    """Image so many times smaller."""
    if scale == 1:
        return gray
    width, height = (max(1, round(side / scale)) for side in gray.shape[::-1])
    return np.asarray(cv2.resize(gray, (width, height)), np.uint8)


def _exact_peaks(slopes: NDArray[np.float32], rows: NDArray[np.int64],
                 columns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Pixels (N, 2) of the image at which parabolas through peaks of the slopes are highest."""
    padded = cv2.copyMakeBorder(slopes, 1, 1, 1, 1, cv2.BORDER_REPLICATE)
    here, places = slopes[rows, columns], []
    for index, down, right in ((columns, 0, 1), (rows, 1, 0)):
        before = padded[rows + 1 - down, columns + 1 - right]
        after = padded[rows + 1 + down, columns + 1 + right]
        curvature = np.maximum(2 * here - before - after, np.float32(1e-9))
        places.append(index + np.clip((after - before) / (2 * curvature), -0.5, 0.5))
    # The middle of two pixels is half a pixel beyond the first.
    return 2 * np.stack(places, axis=1).astype(np.float64) + 0.5


def _pixels(points: NDArray[np.float64]) -> Pixels:
    return np.rint(points).astype(np.int64)
