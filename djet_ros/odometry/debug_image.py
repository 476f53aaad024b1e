"""Drawing of a pair: displacements of its matches, and distances from their epipolar lines."""

from __future__ import annotations

import cv2
from djet_ros.core.types import Array, RelativePose
import numpy as np
from numpy.typing import NDArray

# Factor by which residuals, fractions of a pixel, are drawn longer.
MAGNIFICATION = 20.0

_INLIER, _OUTLIER, _RESIDUAL = (80, 220, 80), (60, 60, 230), (0, 210, 255)
_OTHER_BODY = (230, 140, 60)

# Fractional bits of the integer coordinates for OpenCV.
_SHIFT = 4


def debug_image(gray: NDArray[np.uint8], relative: RelativePose) -> NDArray[np.uint8]:
    """
    Draw a pair on its current image (H, W), return (H, W, 3) BGR.

    Green: displacement of an inlier from x to y; red: of an outlier; blue: of a match of another
    body, which was left out; yellow: 20 times the residual from y to the optimum on its epipolar
    line.
    """
    picture = np.asarray(cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    inliers = (relative.inliers if len(relative.inliers) == len(relative.x)
               else np.zeros(len(relative.x), bool))
    left_out = (np.zeros(len(relative.x), bool) if relative.left_out is None
                else relative.left_out)
    _draw(picture, relative.x[left_out], relative.y[left_out], _OTHER_BODY)
    outliers = ~inliers & ~left_out
    _draw(picture, relative.x[outliers], relative.y[outliers], _OUTLIER)
    _draw(picture, relative.x[inliers], relative.y[inliers], _INLIER)
    if len(relative.y_opt) == len(relative.y):
        y, y_opt = relative.y[inliers], relative.y_opt[inliers]
        _draw(picture, y, y + MAGNIFICATION * (y_opt - y), _RESIDUAL)
    cv2.putText(picture, f'{relative.status.value}  {inliers.sum()}/{len(inliers)}', (8, 20),
                cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
    return picture


def _draw(picture: NDArray[np.uint8], start: Array, end: Array,
          colour: tuple[int, int, int]) -> None:
    lines = np.stack([start, end], axis=1)
    # Points far outside would overflow OpenCV's integers.
    limit = 4.0 * max(picture.shape)
    shown = lines[np.isfinite(lines).all(axis=(1, 2)) & (np.abs(lines) < limit).all(axis=(1, 2))]
    cv2.polylines(picture, list(np.rint(shown * 2**_SHIFT).astype(np.int32)), False, colour, 1,
                  cv2.LINE_AA, _SHIFT)
