"""Masks of image regions to ignore: the robot's own body, moving objects."""

from __future__ import annotations

import cv2
from djet_ros.core.orb_pattern import REACH
import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]


def blocked(left_out: Mask) -> Mask:
    """
    Return the mask (H, W) where no descriptor may be: `left_out` (H, W), dilated by its reach.

    A descriptor compares places up to REACH pixels away, the outermost most often: at the edge of
    a mask half of its tests would compare masked pixels, 6 pixels away still a third. So the whole
    patch has to be free. A surface samples two more pixels to each side, but the patch at its
    centre is unmasked, and the weights of matches handle the rest.
    """
    side = 2 * REACH + 1
    return np.asarray(cv2.dilate(left_out.astype(np.uint8), np.ones((side, side), np.uint8)) > 0)


def masked_at(mask: Mask | None, points: NDArray[np.float64] | NDArray[np.int64]) -> Mask:
    """Return the mask at points (N, 2) in pixels, (N,) bool; False outside or without one."""
    result = np.zeros(len(points), bool)
    if mask is None or not len(points):
        return result
    pixels = np.rint(points).astype(np.int64)
    inside = ((pixels >= 0) & (pixels < mask.shape[::-1])).all(1)
    result[inside] = mask[pixels[inside, 1], pixels[inside, 0]]
    return result
