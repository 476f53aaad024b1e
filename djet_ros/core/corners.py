"""
Corners of three sizes, well spread over the image, each with a descriptor.

A corner is a place around which gradients vary in all directions: the smaller eigenvalue of their
second moments is large (Shi and Tomasi, "Good Features to Track", CVPR 1994). Where it is small
beside the larger one there is an edge, whose stair steps pass for corners at one size only.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import cv2
from djet_ros import compiled
from djet_ros.core.cells import rank_in_cells, short
from djet_ros.core.hamming import dense_descriptors, describable, Image, Pixels, smooth
from djet_ros.core.masks import at, Mask
from djet_ros.core.orb_pattern import REACH
from djet_ros.core.paraboloid import quantile
from djet_ros.core.parallel import each
from djet_ros.core.types import Features
import numpy as np
from numpy.typing import NDArray

# How many times smaller the image is made for corners of each size, by octaves, and how many of
# them are told, as shares of what is asked for.
_SCALES = (1.0, 1.44, 2.0)
_SHARES = (0.7, 0.25, 0.18)

# Octaves that are always told. The one between helps only where they have few corners, or where
# views are so far apart that a corner is seen in another size; these are told beyond what is asked
# for.
_SMALLEST, _BETWEEN, _LARGEST = 0, 1, 2
_FOLLOWED = _SMALLEST, _LARGEST

# Side of the block, in each second pixel, over which gradients are collected.
_BLOCK = 3

# Least share of the smaller eigenvalue in the larger one; the rest are edges.
_LEAST_RATIO = 0.1

# Rows of blocks that are looked at at once.
_STRIP = 64

# Corners are the strongest of all that are so near, in each second pixel each way: those of the
# wider surroundings, and others beside them where there are not enough.
_APART, _AT_LEAST_APART = 3, 1

# chosen: share of the corners that are wanted that is enough.
_ENOUGH = 0.9

# chosen: share of them that is many for corners of the largest size, which are fewer.
_MANY = 0.6

# The strongest of each cell of this side, in pixels, come first, then the second, and so on.
_CELL = 40

# Of noise alone no corner has a slope of more than 0.6 of its standard deviation a pixel; chosen:
# somewhat more, as the flattest blocks tell an eighth too little of it.
_ABOVE_NOISE = 0.8

# Second differences along rows of those along columns: what a slope or an edge along either has
# none of, and six times the standard deviation of noise (Immerkaer, CVIU 64, 1996).
_TWICE_CURVED = np.outer([1, -2, 1], [1, -2, 1]).astype(np.float32)
_OF_NOISE = 6.0

# Side in pixels of the blocks in which noise is told, from one row of them to the next, and which
# share of the blocks is taken to be flat.
_FLAT_BLOCK, _ROWS_APART, _FLAT = 8, 96, 0.2

# Sum of the weights of a Sobel operator's side, times its distance: its answer to a slope of 1.
_SOBEL = 8.0


def detect_corners(gray: Image, max_features: int, contrast: float,
                   mask: Mask | None = None, smoothed: Image | None = None) -> Features:
    """
    Detect corners in a gray image (H, W) uint8; images too small for a descriptor give none.

    contrast: rms slope, in gray levels per pixel, that a corner has at least in its weakest
    direction, and more than noise makes of nothing. Points lie between pixels; descriptors are
    ORB's, unrotated, of the nearest pixels in the image made smaller. Octaves number the sizes;
    where there are enough without it, those of the middle size are the others. mask: (H, W) bool,
    where no point may be; smoothed: gray as ORB's tests see it, where that is known already.
    """
    def of_size(octave: int, most: int) -> Features:
        return _of_size(gray, octave, most, contrast, mask, smoothed)

    wanted = [round(share * max_features) for share in _SHARES]
    found = Features.together(each(lambda octave: of_size(octave, wanted[octave]), _FOLLOWED))
    if len(found) < _ENOUGH * sum(wanted[octave] for octave in _FOLLOWED):
        return Features.together([found, of_size(_BETWEEN, max_features - len(found))])
    return replace(found, others=lambda: of_size(_BETWEEN, wanted[_BETWEEN]))


def detect_large_corners(gray: Image, max_features: int, contrast: float,
                         mask: Mask | None = None, smoothed: Image | None = None) -> Features:
    """
    Detect the same corners, but those of the largest size alone, where these are not few.

    In so small an image they are found in a quarter of the time, and each tells as much.
    """
    large = _of_size(gray, _LARGEST, max_features, contrast, mask, smoothed)
    if len(large) >= _MANY * max_features:
        return large
    small = _of_size(gray, _SMALLEST, max_features - len(large), contrast, mask, smoothed)
    return Features.together([small, large])


def noise_of(image: Image) -> float:
    """Tell the standard deviation of an image's noise, in gray levels, where it is flattest."""
    if len(image) < _FLAT_BLOCK + 2 or image.shape[1] < _FLAT_BLOCK:
        return 0.0
    mean = quantile(_curved_blocks(image) / _FLAT_BLOCK**2, _FLAT)
    # The mean of what is normal, whatever its sign, is sqrt(2 / pi) of its standard deviation.
    return float(mean * np.sqrt(np.pi / 2) / _OF_NOISE)


def _curved_blocks(image: Image) -> NDArray[np.int32]:
    """Sum up the absolute differences of both ways in blocks (B,), of some rows of an image."""
    if compiled.library is not None:
        return compiled.curved_blocks(image, _FLAT_BLOCK, _ROWS_APART)
    first = np.arange(0, len(image) - _FLAT_BLOCK - 1, _ROWS_APART)
    rows = image[first[:, None] + np.arange(_FLAT_BLOCK + 2)]
    curved = cv2.filter2D(rows.reshape(-1, image.shape[1]), cv2.CV_16S, _TWICE_CURVED)
    # The rows beside each row of blocks are there for its differences.
    across = image.shape[1] // _FLAT_BLOCK
    sizes = np.abs(curved.reshape(rows.shape)[:, 1:-1, :across * _FLAT_BLOCK])
    blocks = sizes.reshape(len(first), _FLAT_BLOCK, across, _FLAT_BLOCK)
    return np.asarray(blocks.sum((1, 3), dtype=np.int32).ravel())


def corner_slopes(image: Image) -> NDArray[np.float32]:
    """
    Mean square slopes of blocks in their weakest direction, per pixel; 0 on edges.

    Gives (H // 2, W // 2): of blocks around each second pixel, which takes a third of the time.
    """
    # Halves are exact, and OpenCV is five times as fast, where both sides are even.
    height, width = (side // 2 for side in image.shape)
    image, slopes = image[:2 * height, :2 * width], np.empty((height, width), np.float32)
    if compiled.library is not None and min(height, width) > 1:
        return compiled.corner_slopes(image, _LEAST_RATIO, 0.5 / _SOBEL**2)
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
    if compiled.library is not None and len(points):
        return compiled.spread_out(points, by_strength, first, _CELL, most)
    columns, rows = (points[by_strength, axis] // _CELL for axis in (0, 1))
    late = ~first[by_strength]
    rank = rank_in_cells(short((rows * (columns.max(initial=0) + 1) + columns) * 2 + late))
    later = short(rank + (rank.max(initial=0) + 1) * late)
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


def _of_size(gray: Image, octave: int, most: int, contrast: float, mask: Mask | None,
             smoothed: Image | None) -> Features:
    """Detect the corners of one size; none in an image that has no room for a descriptor."""
    scale = _SCALES[octave]
    if min(gray.shape) <= 2 * scale * (REACH + 1):
        none = np.empty(0, np.float32)
        return Features.described(np.empty((0, 2)), np.empty(0, np.int32), none, none,
                                  np.empty((0, 32), np.uint8))
    image = _made_smaller(gray, scale)
    slopes, contrast = corner_slopes(image), max(contrast, _ABOVE_NOISE * noise_of(image))
    zoom = np.array(gray.shape[::-1]) / image.shape[::-1]

    found, strongest = _peaks(slopes, contrast, image.shape)
    points = _exact_peaks(slopes, found)
    # Others beside the strongest come where there are not enough of these.
    wanted = np.ones(len(found), bool) if mask is None else ~at(mask, (points + 0.5) * zoom - 0.5)
    if (strongest & wanted).sum() >= _ENOUGH * most:
        wanted &= strongest
    points, strengths = points.compress(wanted, axis=0), slopes.ravel()[found[wanted]]
    chosen = spread_out(_pixels(points), strengths, most, strongest[wanted])
    points, strengths = points.take(chosen, axis=0), strengths[chosen]

    @cache
    def describe() -> Image:
        # The image is made anew, which is seldom: views that are kept would keep it. What comes of
        # it is asked for twice, by the pair of a view with the one before and with the next.
        seen = (smoothed if scale == 1 and smoothed is not None
                else smooth(_made_smaller(gray, scale)))
        return dense_descriptors(seen, _pixels(points))

    return Features((points + 0.5) * zoom - 0.5, np.full(len(points), octave, np.int32),
                    np.zeros(len(points), np.float32), np.sqrt(strengths), describe)


def _made_smaller(gray: Image, scale: float) -> Image:
    """Image so many times smaller."""
    if scale == 1:
        return gray
    width, height = (max(1, round(side / scale)) for side in gray.shape[::-1])
    return np.asarray(cv2.resize(gray, (width, height)), np.uint8)


def _peaks(slopes: NDArray[np.float32], contrast: float, shape: tuple[int, ...]
           ) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """
    Find slopes that are the strongest of all that are at least so near, in an image of a shape.

    Gives their places (M,) in the flat array, and (M,) whether they are of their wider
    surroundings too. Wherever the corner is in there, up to a pixel off, its descriptor has room.
    """
    if compiled.library is not None:
        margin = REACH + 1
        height, width = (max(side - margin, 0) // 2 for side in shape)
        return compiled.peaks(slopes, contrast**2, margin // 2, (width, height))
    above = slopes > contrast**2
    # Of a flat array, five times as fast.
    found = np.flatnonzero(_highest(slopes, _AT_LEAST_APART) & above)
    rows, columns = np.divmod(found, slopes.shape[1])
    found = found[describable(2 * np.stack([columns, rows], axis=1) + 1, shape, 1)]
    return found, _highest(slopes, _APART).ravel()[found]


def _highest(slopes: NDArray[np.float32], apart: int) -> NDArray[np.bool_]:
    side = 2 * apart + 1
    return np.asarray(slopes == cv2.dilate(slopes, np.ones((side, side), np.uint8)))


def _exact_peaks(slopes: NDArray[np.float32], found: NDArray[np.int64]) -> NDArray[np.float64]:
    """
    Pixels (M, 2) of the image at which parabolas through peaks of the slopes are highest.

    found: (M,) places of the peaks in the flat array, none of them at its border.
    """
    if compiled.library is not None:
        return compiled.exact_peaks(slopes, found)
    flat, width = slopes.ravel(), slopes.shape[1]
    here, points = flat[found], np.empty((len(found), 2))
    for axis, index, step in ((0, found % width, 1), (1, found // width, width)):
        before, after = flat[found - step], flat[found + step]
        curvature = np.maximum(2 * here - before - after, np.float32(1e-9))
        highest = index + np.clip((after - before) / (2 * curvature), -0.5, 0.5)
        # The middle of two pixels is half a pixel beyond the first.
        points[:, axis] = 2 * highest + 0.5
    return points


def _pixels(points: NDArray[np.float64]) -> Pixels:
    return np.rint(points).astype(np.int64)
