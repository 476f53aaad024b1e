"""Motion blur by the camera's rotation during the exposure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
from djet_ros.core.geometry import rotation_exp
from djet_ros.core.types import Array
from djet_ros.lab.scenes.camera import Shot
from djet_ros.lab.scenes.texture import Gray
import numpy as np

# Pictures that are averaged for each pixel by which the light moves, and at most.
_PER_PIXEL, _MOST = 1.0, 15


@dataclass(frozen=True)
class Shutter:
    """
    A shutter that is open for a part of the time between frames, half before and half after.

    open_part: 0 to 1; turning: rotation vector (3,) in camera axes per frame, by frame index.
    The light of a camera that turns moves by a homography, so the blur is that of any scene; what
    the way during the exposure adds, millimetres, is left out.
    """

    open_part: float
    turning: Callable[[int], Array]

    def __call__(self, shot: Shot) -> Gray:
        """Average the light over the exposure."""
        turn = self.open_part * self.turning(shot.index)
        steps = self._steps(float(np.linalg.norm(turn)) * shot.K[0, 0])
        K_inv, size = np.linalg.inv(shot.K), shot.radiance.shape[::-1]
        total = np.zeros_like(shot.radiance)
        for part in (np.arange(steps) + 0.5) / steps - 0.5:
            H = shot.K @ rotation_exp(part * turn) @ K_inv
            total += cv2.warpPerspective(shot.radiance, H, size, borderMode=cv2.BORDER_REPLICATE,
                                         flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        return np.asarray(total / np.float32(steps), np.float32)

    @staticmethod
    def _steps(pixels: float) -> int:
        """Return the number of images to average; odd, to include that of the frame's pose."""
        return min(2 * int(_PER_PIXEL * pixels / 2) + 1, _MOST)
