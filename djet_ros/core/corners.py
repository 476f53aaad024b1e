"""
Corners at three scales, evenly distributed over the image, with descriptors.

A corner is a place around which gradients vary in all directions: the smaller eigenvalue of the
structure tensor is large (Shi and Tomasi, "Good Features to Track", CVPR 1994). If it is small
relative to the larger one there is an edge, whose stair steps look like corners at a single scale
only.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import cv2
from djet_ros import compiled
from djet_ros.core.cells import in_few_bytes, rank_in_cells
from djet_ros.core.hamming import dense_descriptors, describable, Image, Pixels, smooth
from djet_ros.core.masks import Mask, masked_at
from djet_ros.core.medians import quantile
from djet_ros.core.orb_pattern import REACH
from djet_ros.core.parallel import map_parallel
from djet_ros.core.types import Features
import numpy as np
from numpy.typing import NDArray

# Downscaling of the image for each octave, and the number of corners of each as a share of the
# maximum.
_SCALES = (1.0, 1.44, 2.0)
_QUOTAS = (0.7, 0.25, 0.18)

# Octaves that are always detected. The middle one only helps if these have few corners, or if
# views are far apart and a corner is seen at another scale; then its corners come on top.
_FINE, _MIDDLE, _COARSE = 0, 1, 2
_DEFAULT_OCTAVES = _FINE, _COARSE

# Side of the block, in every second pixel, over which gradients are averaged.
_BLOCK = 3

# Minimum ratio of the smaller to the larger eigenvalue; below, the block is an edge.
_MIN_RATIO = 0.1

# Least contrast of a corner as a share of the steepest edge that may be in a block of JPEG (8
# pixels) with it: weaker ones may be ripples of the compression. 0.08 to 0.12 are as good, in a
# corridor with and without compression.
_MIN_PROMINENCE, _PROMINENT_WITHIN = 0.1, 8

# Rows of blocks that are processed at once.
_STRIP = 64

# Radii of the non-maximum suppression, in every second pixel: corners are maxima of the wide one,
# and of the narrow one if there are not enough.
_WIDE_RADIUS, _NARROW_RADIUS = 3, 1

# chosen: share of the requested corners that is enough.
_ENOUGH = 0.9

# chosen: share of the requested corners that is enough for the coarsest octave alone.
_MANY_LARGE = 0.6

# Side of the cells in pixels; the strongest corner of each cell comes first, then the second
# strongest, and so on.
_CELL = 40

# Noise alone makes no corner of more than 0.6 of its standard deviation per pixel; chosen:
# somewhat more, as the flattest blocks underestimate it by an eighth.
_NOISE_FACTOR = 0.8

# Second difference along rows of that along columns: zero on gradients and on horizontal or
# vertical edges, and with a gain of six on the standard deviation of noise (Immerkaer, CVIU 64,
# 1996).
_MIXED_DIFFERENCE = np.outer([1, -2, 1], [1, -2, 1]).astype(np.float32)
_NOISE_GAIN = 6.0

# Noise estimation: side of the blocks in pixels, spacing of the rows of blocks, and the quantile
# of the blocks that is taken to be flat.
_NOISE_BLOCK, _ROW_SPACING, _FLAT_QUANTILE = 8, 96, 0.2

# Response of a Sobel operator to a gradient of 1 per pixel.
_SOBEL_GAIN = 8.0


def detect_corners(gray: Image, max_features: int, contrast: float,
                   mask: Mask | None = None, smoothed: Image | None = None) -> Features:
    """
    Detect corners in a gray image (H, W) uint8; none in images too small for a descriptor.

    contrast: minimum rms gradient of a corner in its weakest direction, in gray levels per pixel,
    raised by noise. Points have sub-pixel accuracy; descriptors are ORB's, unrotated, at the
    nearest pixel of the downscaled image. Octaves number the scales; if there are enough corners
    without the middle one, it provides the additional features. mask: (H, W) bool, True where no
    point may be; smoothed: gray as ORB's tests sample it, if computed already.
    """
    def octave_corners(octave: int, most: int) -> Features:
        return _detect_octave(gray, octave, most, contrast, mask, smoothed)

    quotas = [round(share * max_features) for share in _QUOTAS]
    corners = Features.concatenated(map_parallel(
        lambda octave: octave_corners(octave, quotas[octave]), _DEFAULT_OCTAVES))
    if len(corners) < _ENOUGH * sum(quotas[octave] for octave in _DEFAULT_OCTAVES):
        middle = octave_corners(_MIDDLE, max_features - len(corners))
        return Features.concatenated([corners, middle])
    return replace(corners, additional=lambda: octave_corners(_MIDDLE, quotas[_MIDDLE]))


def detect_large_corners(gray: Image, max_features: int, contrast: float,
                         mask: Mask | None = None, smoothed: Image | None = None) -> Features:
    """
    Detect corners of the coarsest octave only, if there are not few.

    In the downscaled image they take a quarter of the time, and are as informative.
    """
    large = _detect_octave(gray, _COARSE, max_features, contrast, mask, smoothed)
    if len(large) >= _MANY_LARGE * max_features:
        return large
    small = _detect_octave(gray, _FINE, max_features - len(large), contrast, mask, smoothed)
    return Features.concatenated([small, large])


def image_noise(image: Image) -> float:
    """Estimate the standard deviation of image noise, in gray levels, from the flattest blocks."""
    if len(image) < _NOISE_BLOCK + 2 or image.shape[1] < _NOISE_BLOCK:
        return 0.0
    mean = quantile(_block_curvatures(image) / _NOISE_BLOCK**2, _FLAT_QUANTILE)
    # The mean absolute value of a normal variable is sqrt(2 / pi) of its standard deviation.
    return float(mean * np.sqrt(np.pi / 2) / _NOISE_GAIN)


def _block_curvatures(image: Image) -> NDArray[np.int32]:
    """Return the sums (B,) of absolute mixed second differences in blocks of some rows."""
    if compiled.library is not None:
        return compiled.block_curvatures(image, _NOISE_BLOCK, _ROW_SPACING)
    first = np.arange(0, len(image) - _NOISE_BLOCK - 1, _ROW_SPACING)
    rows = image[first[:, None] + np.arange(_NOISE_BLOCK + 2)]
    curved = cv2.filter2D(rows.reshape(-1, image.shape[1]), cv2.CV_16S, _MIXED_DIFFERENCE)
    # The outer rows are only needed for the differences.
    per_row = image.shape[1] // _NOISE_BLOCK
    sizes = np.abs(curved.reshape(rows.shape)[:, 1:-1, :per_row * _NOISE_BLOCK])
    blocks = sizes.reshape(len(first), _NOISE_BLOCK, per_row, _NOISE_BLOCK)
    return np.asarray(blocks.sum((1, 3), dtype=np.int32).ravel())


def corner_slopes(image: Image) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """
    Return the mean square gradients of blocks in their weakest and strongest direction, per pixel.

    (H // 2, W // 2) each: for blocks around every second pixel, which takes a third of the time.
    Those in the weakest direction are 0 on edges.
    """
    # With even sides halving is exact, and OpenCV is five times as fast.
    height, width = (side // 2 for side in image.shape)
    image = image[:2 * height, :2 * width]
    if compiled.library is not None and min(height, width) > 1:
        return compiled.corner_slopes(image, _MIN_RATIO, 0.5 / _SOBEL_GAIN**2)
    slopes, steepness = np.empty((2, height, width), np.float32)
    for first in range(0, height, _STRIP):
        strip = slice(first, first + _STRIP)
        slopes[strip], steepness[strip] = _slopes_of_rows(image, first,
                                                          min(first + _STRIP, height))
    return slopes, steepness


def _slopes_of_rows(image: Image, first: int, after: int
                    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the same for some rows of blocks; few rows keep temporary images in the cache."""
    # Including neighbouring rows, and the rows that the gradients of these need.
    start, end = max(first - 1, 0), min(after + 1, len(image) // 2)
    top = max(2 * start - 1, 0)
    dx, dy = (slope[2 * start - top:2 * end - top].astype(np.float32)
              for slope in cv2.spatialGradient(image[top:2 * end + 1]))
    dx_dy = dx * dy
    dx *= dx
    dy *= dy
    xx, xy, yy = (_block_means(products)[first - start:after - start]
                  for products in (dx, dx_dy, dy))
    trace = xx + yy
    # Not cv2.magnitude: its last bit depends on the memory alignment of the arrays.
    xx -= yy
    xx *= xx
    xy *= xy
    xy *= 4
    xx += xy
    spread = np.sqrt(xx, out=xx)
    least, most = trace - spread, trace + spread
    np.copyto(least, 0, where=least < most * np.float32(_MIN_RATIO))
    unit = np.float32(0.5 / _SOBEL_GAIN**2)
    return np.asarray(least * unit, np.float32), np.asarray(most * unit, np.float32)


def _block_means(products: NDArray[Any]) -> NDArray[np.float32]:
    """Return means over blocks around every second pixel; both sides of the products are even."""
    height, width = products.shape
    halved = cv2.resize(products, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.boxFilter(halved, -1, (_BLOCK, _BLOCK)), np.float32)


def spread_out(points: Pixels, strengths: NDArray[np.float32], most: int,
               first: NDArray[np.bool_]) -> NDArray[np.int64]:
    """
    Choose at most so many of (N, 2) points, the strongest of each cell first; sorted indices.

    first: (N,) bool mask of points that come before all others.
    """
    by_strength = _strongest_first(strengths)
    if compiled.library is not None and len(points):
        return compiled.spread_out(points, by_strength, first, _CELL, most)
    columns, rows = (points[by_strength, axis] // _CELL for axis in (0, 1))
    late = ~first[by_strength]
    rank = rank_in_cells(in_few_bytes((rows * (columns.max(initial=0) + 1) + columns) * 2 + late))
    later = in_few_bytes(rank + (rank.max(initial=0) + 1) * late)
    return np.asarray(np.sort(by_strength[np.argsort(later, kind='stable')[:most]]))


def _strongest_first(strengths: NDArray[np.float32]) -> NDArray[np.int64]:
    """
    Return the indices that sort strengths (N,) >= 0 in descending order, stably.

    The bits of such floats sort like integers. With their indices appended all keys differ, and an
    in-place sort takes a third of the time of a stable `argsort`.
    """
    keys = (~strengths.view(np.uint32)).astype(np.uint64) << np.uint64(32)
    keys |= np.arange(len(keys), dtype=np.uint64)
    keys.sort()
    return (keys & np.uint64(2**32 - 1)).astype(np.int64)


def _detect_octave(gray: Image, octave: int, most: int, contrast: float, mask: Mask | None,
                   smoothed: Image | None) -> Features:
    """Detect the corners of one octave; none if the image is too small for a descriptor."""
    scale = _SCALES[octave]
    if min(gray.shape) <= 2 * scale * (REACH + 1):
        none = np.empty(0, np.float32)
        return Features.with_descriptors(np.empty((0, 2)), np.empty(0, np.int32), none, none,
                                         np.empty((0, 32), np.uint8))
    image = _downscaled(gray, scale)
    slopes, steepness = corner_slopes(image)
    contrast = max(contrast, _NOISE_FACTOR * image_noise(image))
    zoom = np.array(gray.shape[::-1]) / image.shape[::-1]

    peaks, strongest = _prominent(slopes, steepness, *_peaks(slopes, contrast, image.shape))
    points = _exact_peaks(slopes, peaks)
    # Maxima of the narrow radius are only used if there are not enough of the wide one.
    usable = (np.ones(len(peaks), bool) if mask is None
              else ~masked_at(mask, (points + 0.5) * zoom - 0.5))
    if (strongest & usable).sum() >= _ENOUGH * most:
        usable &= strongest
    points, strengths = points.compress(usable, axis=0), slopes.ravel()[peaks[usable]]
    chosen = spread_out(_nearest_pixels(points), strengths, most, strongest[usable])
    points, strengths = points.take(chosen, axis=0), strengths[chosen]

    @cache
    def describe() -> Image:
        # The image is computed again, which is rare: a view that is kept would keep it in memory.
        # The result is cached, as the pairs of a view with its predecessor and its successor both
        # need it.
        sampled = (smoothed if scale == 1 and smoothed is not None
                   else smooth(_downscaled(gray, scale)))
        return dense_descriptors(sampled, _nearest_pixels(points))

    return Features((points + 0.5) * zoom - 0.5, np.full(len(points), octave, np.int32),
                    np.zeros(len(points), np.float32), np.sqrt(strengths), describe)


def _downscaled(gray: Image, scale: float) -> Image:
    """Return the image downscaled by a factor."""
    if scale == 1:
        return gray
    width, height = (max(1, round(side / scale)) for side in gray.shape[::-1])
    return np.asarray(cv2.resize(gray, (width, height)), np.uint8)


def _peaks(slopes: NDArray[np.float32], contrast: float, shape: tuple[int, ...]
           ) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """
    Find slopes above contrast^2 that are local maxima with room for a descriptor.

    shape: of the image. Returns their indices (M,) in the flat array, and (M,) whether they are
    maxima of the wide radius too. The margin allows for a sub-pixel position up to a pixel away.
    """
    if compiled.library is not None:
        margin = REACH + 1
        height, width = (max(side - margin, 0) // 2 for side in shape)
        return compiled.peaks(slopes, contrast**2, margin // 2, (width, height))
    above = slopes > contrast**2
    # Indices of the flat array are five times as fast.
    peaks = np.flatnonzero(_is_local_maximum(slopes, _NARROW_RADIUS) & above)
    rows, columns = np.divmod(peaks, slopes.shape[1])
    peaks = peaks[describable(2 * np.stack([columns, rows], axis=1) + 1, shape, 1)]
    return peaks, _is_local_maximum(slopes, _WIDE_RADIUS).ravel()[peaks]


def _prominent(slopes: NDArray[np.float32], steepness: NDArray[np.float32],
               peaks: NDArray[np.int64], strongest: NDArray[np.bool_]
               ) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the peaks (M,), and whether they are strongest, that stand out from edges nearby."""
    side = _PROMINENT_WITHIN + 1  # in every second pixel
    steepest = cv2.dilate(steepness, np.ones((side, side), np.uint8)).ravel()[peaks]
    prominent = slopes.ravel()[peaks] >= np.float32(_MIN_PROMINENCE**2) * steepest
    return peaks[prominent], strongest[prominent]


def _is_local_maximum(slopes: NDArray[np.float32], radius: int) -> NDArray[np.bool_]:
    side = 2 * radius + 1
    return np.asarray(slopes == cv2.dilate(slopes, np.ones((side, side), np.uint8)))


def _exact_peaks(slopes: NDArray[np.float32], peaks: NDArray[np.int64]) -> NDArray[np.float64]:
    """
    Return the pixels (M, 2) of the image where parabolas through peaks of the slopes are highest.

    peaks: (M,) indices of the peaks in the flat array, none of them at its border.
    """
    if compiled.library is not None:
        return compiled.exact_peaks(slopes, peaks)
    flat, width = slopes.ravel(), slopes.shape[1]
    values, points = flat[peaks], np.empty((len(peaks), 2))
    for axis, index, step in ((0, peaks % width, 1), (1, peaks // width, width)):
        before, after = flat[peaks - step], flat[peaks + step]
        curvature = np.maximum(2 * values - before - after, np.float32(1e-9))
        highest = index + np.clip((after - before) / (2 * curvature), -0.5, 0.5)
        # The centre of two pixels is half a pixel beyond the first.
        points[:, axis] = 2 * highest + 0.5
    return points


def _nearest_pixels(points: NDArray[np.float64]) -> Pixels:
    return np.rint(points).astype(np.int64)
