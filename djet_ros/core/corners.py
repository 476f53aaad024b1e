"""
Corners of several sizes, well spread over the image, each with a descriptor.

A corner is a place around which gradients vary in all directions: the smaller eigenvalue of their
second moments is large (Shi and Tomasi, "Good Features to Track", CVPR 1994). Where it is small
beside the larger one there is an edge, whose stair steps pass for corners at one size only.
"""

from __future__ import annotations

from typing import Any

import cv2
from djet_ros.core.hamming import dense_descriptors, describable, Image, Pixels, smooth
from djet_ros.core.types import Features
import numpy as np
from numpy.typing import NDArray

# How many times smaller the image is made for corners of each size, and their shares of all.
_SIZES = ((1.0, 0.5), (1.44, 0.3), (2.07, 0.2))

# Side of the block, in pixels, over which gradients are collected.
_BLOCK = 7

# Least share of the smaller eigenvalue in the larger one; the rest are edges.
_LEAST_RATIO = 0.1

# Corners are the strongest of all pixels that are so near, in pixels each way.
_APART = 3

# The strongest of each cell of this side, in pixels, come first, then the second, and so on.
_CELL = 40

# Sum of the weights of a Sobel operator's side, times its distance: its answer to a slope of 1.
_SOBEL = 8.0


def detect_corners(gray: Image, max_features: int, contrast: float) -> Features:
    """
    Detect corners in a gray image (H, W) uint8; images too small for a descriptor give none.

    contrast: rms slope, in gray levels per pixel, that a corner has at least in its weakest
    direction. Points are whole pixels, where residual surfaces take their references. Octaves
    number the sizes; descriptors are ORB's, unrotated, in the image made smaller.
    """
    found = [_of_size(gray, octave, scale, round(share * max_features), contrast)
             for octave, (scale, share) in enumerate(_SIZES)]
    points, octaves, responses, descriptors = (np.concatenate(part) for part in zip(*found))
    return Features(points, octaves, np.zeros(len(points), np.float32), responses, descriptors)


def corner_slopes(image: Image) -> NDArray[np.float32]:
    """Mean square slope (H, W) of a block in its weakest direction, per pixel; 0 on edges."""
    dx, dy = cv2.spatialGradient(image)
    # Into as little new memory as can be: fresh pages cost more than the sums.
    xx, xy, yy = (_over_block(cv2.multiply(a, b, dtype=cv2.CV_32F))
                  for a, b in ((dx, dx), (dx, dy), (dy, dy)))
    trace = xx + yy
    xx -= yy
    xy *= 2
    spread = cv2.magnitude(xx, xy, xx)
    least = np.subtract(trace, spread, out=yy)
    most = np.add(trace, spread, out=trace)
    most *= np.float32(_LEAST_RATIO)
    least *= least >= most
    least *= np.float32(0.5 / _SOBEL**2)
    return np.asarray(least, np.float32)


def _over_block(products: NDArray[Any]) -> NDArray[np.float32]:
    return np.asarray(cv2.boxFilter(products, -1, (_BLOCK, _BLOCK), products), np.float32)


def spread_out(points: Pixels, strengths: NDArray[np.float32], most: int) -> NDArray[np.int64]:
    """Choose, in order, at most so many of (N, 2) points: the best of each cell before others."""
    cells = (points // _CELL) @ np.array([1, 2**20])
    order = np.lexsort((-strengths, cells))
    _, first, count = np.unique(cells[order], return_index=True, return_counts=True)
    rank = np.empty(len(points), np.int64)
    rank[order] = np.arange(len(points)) - np.repeat(first, count)
    return np.asarray(np.sort(np.lexsort((-strengths, rank))[:most]))


def _of_size(gray: Image, octave: int, scale: float, most: int, contrast: float,
             ) -> tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.float32], Image]:
    """Points, octaves, responses and descriptors of the corners of one size."""
    width, height = (max(1, round(side / scale)) for side in gray.shape[::-1])
    image = gray if scale == 1 else np.asarray(cv2.resize(gray, (width, height)), np.uint8)
    slopes = corner_slopes(image)
    near = np.ones((2 * _APART + 1, 2 * _APART + 1), np.uint8)
    rows, columns = np.nonzero((slopes == cv2.dilate(slopes, near)) & (slopes > contrast**2))
    points = np.stack([columns, rows], axis=1)
    points = points[describable(points, image.shape)]
    strengths = slopes[points[:, 1], points[:, 0]]
    chosen = spread_out(points, strengths, most)
    points, strengths = points[chosen], strengths[chosen]
    descriptors = dense_descriptors(smooth(image), points)
    zoom = np.array(gray.shape[::-1]) / (width, height)
    return (np.rint((points + 0.5) * zoom - 0.5), np.full(len(points), octave, np.int32),
            np.sqrt(strengths), descriptors)
