"""Parts of an image that nothing is to be told from: the robot's own body, things that move."""

from __future__ import annotations

import cv2
from djet_ros.core.orb_pattern import REACH
import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]


def blocked(left_out: Mask) -> Mask:
    """
    (H, W) bool, where no descriptor may stand: next to a pixel (H, W) bool that is left out.

    A descriptor compares places up to REACH pixels away, the outermost most often: at the edge of
    a mask half of its tests would be about what is masked, 6 pixels away still a third. So the
    whole patch has to be free. What a surface samples beyond that, two pixels to each side, the
    patch of its middle has all around it as well, and the matches' own weights deal with it.
    """
    side = 2 * REACH + 1
    return np.asarray(cv2.dilate(left_out.astype(np.uint8), np.ones((side, side), np.uint8)) > 0)


def at(mask: Mask | None, points: NDArray[np.float64] | NDArray[np.int64]) -> Mask:
    """(N,) bool, the mask next to points (N, 2) in pixels; False beyond it, or without one."""
    result = np.zeros(len(points), bool)
    if mask is None or not len(points):
        return result
    pixels = np.rint(points).astype(np.int64)
    inside = ((pixels >= 0) & (pixels < mask.shape[::-1])).all(1)
    result[inside] = mask[pixels[inside, 1], pixels[inside, 0]]
    return result
