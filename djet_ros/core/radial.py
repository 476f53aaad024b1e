"""
What radial distortion does to points and images, and how it is undone.

By a coefficient k1, points u = (X/Z, Y/Z) are seen at u (1 + k1 |u|^2). What is called straight is
without it.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import cv2
from djet_ros.core.geometry import inverse_of, rays
from djet_ros.core.masks import Mask
from djet_ros.core.types import Array
import numpy as np
from numpy.typing import NDArray

# Share by which k1 moves points at most: what is farther out is in no image, and must not be
# folded into one.
FARTHEST = 0.1

# Steps to where a point is without k1; each leaves a hundredth of what the one before did.
_STRAIGHTENINGS = 3


def stretch(u: Array, k1: float) -> Array:
    """By what k1 multiplies points u (N, 2), (N, 1)."""
    # Components first, and without np.clip: a third of the time.
    moved = k1 * (u[:, :1] * u[:, :1] + u[:, 1:] * u[:, 1:])
    return np.asarray(1 + np.minimum(np.maximum(moved, -FARTHEST), FARTHEST))


def bending(K: Array, u: Array, k1: float) -> Array:
    """Tell how pixels of points u (N, 2) move with where they were without k1, (N, 2, 2)."""
    by_point = 2 * k1 * u[:, :, None] * u[:, None]
    by_point[:, [0, 1], [0, 1]] += stretch(u, k1)
    return np.asarray(K[:2, :2] @ by_point @ inverse_of(K)[:2, :2])


def straight_rays(K: Array, pixels: Array, k1: float) -> Array:
    """Take pixels (N, 2) as k1 shows them to their viewing rays (N, 3), with z = 1."""
    towards = rays(K, pixels)
    u = seen = towards[:, :2]
    for _ in range(_STRAIGHTENINGS):
        u = seen / stretch(u, k1)
    towards[:, :2] = u
    return towards


def straightened(K: Array, pixels: Array, k1: float) -> Array:
    """Tell where pixels (N, 2) were without k1."""
    return _pixels(K, straight_rays(K, pixels, k1)[:, :2])


def bent(K: Array, pixels: Array, k1: float) -> Array:
    """Tell where k1 shows pixels (N, 2) that are without."""
    u = rays(K, pixels)[:, :2]
    return _pixels(K, u * stretch(u, k1))


def _pixels(K: Array, u: Array) -> Array:
    return np.asarray(u @ K[:2, :2].T + K[:2, 2])


class _Undoing(NamedTuple):
    """OpenCV's maps to a straight image, and (H, W) what of that the other one does not show."""

    maps: tuple[Any, Any]
    unseen: Mask


def straight_image(gray: NDArray[np.uint8], K: Array, k1: float, left_out: Mask | None = None,
                   before: float = 0.0) -> tuple[NDArray[np.uint8], Mask | None]:
    """
    Give an image (H, W) without k1, and what is left out of it.

    left_out: (H, W) bool, of the image as it is, or None; before: k1 that it is without already.
    """
    height, width = gray.shape
    undoing = _undoing(np.asarray(K, float).tobytes(), (height, width), k1, before)
    # A black rim would be an edge that moves with the camera.
    straight = cv2.remap(gray, *undoing.maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    hidden = undoing.unseen
    if left_out is not None:
        hidden = hidden | (cv2.remap(left_out.astype(np.uint8), *undoing.maps, cv2.INTER_NEAREST,
                                     borderMode=cv2.BORDER_REPLICATE) > 0)
    return np.asarray(straight, np.uint8), hidden if hidden.any() else None


@lru_cache(maxsize=4)
def _undoing(matrix: bytes, shape: tuple[int, int], k1: float, before: float) -> _Undoing:
    K, (height, width) = np.frombuffer(matrix).reshape(3, 3), shape
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1, dtype=float)
    x, y = straightened(K, bent(K, pixels.reshape(-1, 2), k1), before).T.reshape(2, height, width)
    # Up to half a pixel beyond the middles of the outermost ones something is seen.
    unseen = ((np.abs(x - (width - 1) / 2) > width / 2)
              | (np.abs(y - (height - 1) / 2) > height / 2))
    maps = cv2.convertMaps(x.astype(np.float32), y.astype(np.float32), cv2.CV_16SC2)
    return _Undoing(maps, unseen)
