"""
Pixels, columns and rows of a sensor that are off, as in thermal cameras and in the dark.

What they add to an image stays in place while the world moves. In a scene of weak texture the
camera would seem to stand still, or to move along its columns only.
"""

from __future__ import annotations

from itertools import pairwise

import cv2
from djet_ros.core.jet import robust_scale
from djet_ros.core.medians import medians
from djet_ros.core.types import Array
from djet_ros.odometry.images import Gray
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

# chosen: a broken pixel is beyond its eight neighbours by more than this many gray levels, and by
# twice their range; and share of such pixels below which an image is left as it is. An optical
# image is smoother: of a million pixels, 1 to 80 were in real ones, 500 with noise of 10 levels.
_LEAST_OFF, _LEAST_SHARE = 30, 1e-4

# chosen: share of that share in a part of an image from which the whole is looked at. Of 8 pixels
# expected there, the fewest in an image of 640 x 480, fewer than 2 are met once in 300 images.
_FEW = 0.25

_NEIGHBOURS = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], np.uint8)

# chosen: bands in which the steps from a column to the next are compared, few to tell whether any
# has an offset; and columns over which their sum is kept: what is smoother neither is a corner nor
# changes a descriptor.
_BANDS, _FEW_BANDS, _WIDTH = 32, 16, 15

# chosen: excess of equal over unequal signs of a column's bend in both halves of an image, from
# which columns have offsets. Tall things are in few of the columns: at most 0.1 in real images,
# 0.2 in rendered streets, and 0.5 or more with offsets of one gray level (standard deviation).
_AGREEMENT = 0.4

# Gray levels: robust standard deviation of the steps below which an image is left as it is. A
# mosaic of colour filters may leave 0.4, of which next to nothing survives rounding.
_LEAST_STEPS = 0.7

# chosen: robust standard deviations beyond which a step is an edge of the scene.
_EDGE = 6.0


def without_defects(gray: Gray) -> Gray:
    """Return an image (H, W) of a sensor without its broken pixels and its stripes, if any."""
    return without_stripes(without_broken_pixels(gray))


def without_broken_pixels(gray: Gray) -> Gray:
    """
    Return an image (H, W) with neighbours in place of broken pixels, if it has any.

    They are all over a sensor, so next to none in the middle quarter of the rows rule them out, at
    a quarter of the cost.
    """
    height = len(gray)
    middle, *_ = _broken_pixels(gray[3 * height // 8:5 * height // 8 + 1])
    if np.count_nonzero(middle) < _FEW * _LEAST_SHARE * middle.size:
        return gray
    broken, low, high = _broken_pixels(gray)
    if np.count_nonzero(broken) < _LEAST_SHARE * gray.size:
        return gray
    return np.where(broken, cv2.addWeighted(low, 0.5, high, 0.5, 0), gray)


def _broken_pixels(gray: Gray) -> tuple[NDArray[np.bool_], Gray, Gray]:
    """Return which pixels of an image (H, W) are broken, and the range of their neighbours."""
    low, high = (np.asarray(extreme(gray, _NEIGHBOURS), np.uint8)
                 for extreme in (cv2.erode, cv2.dilate))
    off = cv2.max(cv2.subtract(gray, high), cv2.subtract(low, gray))
    span = cv2.subtract(high, low)
    return (off > cv2.add(span, span)) & (off > _LEAST_OFF), low, high


def without_stripes(gray: Gray) -> Gray:
    """Return an image (H, W) without offsets of its columns and rows, if it has any."""
    of_columns, of_rows = offsets(gray, 0), offsets(gray, 1)
    if of_columns is None and of_rows is None:
        return gray
    level = gray.astype(np.float32)
    if of_columns is not None:
        level -= of_columns
    if of_rows is not None:
        level -= of_rows[:, None]
    return np.clip(np.rint(level), 0, 255).astype(np.uint8)


def offsets(gray: Gray, axis: int) -> Array | None:
    """
    Return the offsets in gray levels of columns (axis 0) or rows (axis 1); None if there are none.

    Offsets of columns make the same steps at all heights, and what is in the scene does not: the
    median of a column's steps over bands of the image tells them. So does each half of the bands:
    if both correlate by r, 2 r / (1 + r) is the reliability of the whole (Spearman and Brown, of
    tests), by which it is shrunk.
    """
    if gray.shape[axis] < _BANDS or not _has_offsets(gray, axis):
        return None
    steps = np.diff(_bands(gray, axis, _BANDS), axis=1)
    whole, *halves = (medians(bands.T) for bands in (steps, *np.split(steps, 2)))
    spread = robust_scale(whole)
    if spread < _LEAST_STEPS:
        return None
    edges = np.max(np.abs(halves), axis=0) > _EDGE * spread
    found, upper, lower = (_summed(np.where(edges, 0, each)) for each in (whole, *halves))
    r = max(float(np.corrcoef(upper, lower)[0, 1]), 0.0)
    return np.asarray(found * 2 * r / (1 + r))


def _has_offsets(gray: Gray, axis: int) -> bool:
    """
    Return whether both halves of an image (H, W) bend in the same columns (axis 0) or rows (1).

    Bends, or differences of steps, since a wall may brighten from column to column.
    """
    bends = np.sign(np.diff(_bands(gray, axis, _FEW_BANDS), n=2, axis=1))
    upper, lower = (half.sum(0) for half in np.split(bends, 2))
    return bool(np.sign(upper * lower).mean() > _AGREEMENT)


def _summed(steps: Array) -> Array:
    """Return the sum (N + 1,) of steps (N,) from one to the next, without what is smooth."""
    total = np.concatenate([[0.0], np.cumsum(steps)])
    return np.asarray(total - uniform_filter1d(total, _WIDTH))


def _bands(gray: Gray, axis: int, count: int) -> Array:
    """Return the mean gray levels (count, W or H) of an image (H, W) in bands across an axis."""
    edges = np.linspace(0, gray.shape[axis], count + 1).astype(int)
    bands = (gray[low:high] if axis == 0 else gray[:, low:high]
             for low, high in pairwise(edges))
    return np.stack([cv2.reduce(band, axis, cv2.REDUCE_AVG, dtype=cv2.CV_32F).ravel()
                     for band in bands])
