"""One image of the moving camera, and whether it can be related to the one before."""

from __future__ import annotations

from dataclasses import dataclass

from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.types import Array, of_one_camera, Status, View
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Frame:
    """
    An image as the odometry takes it.

    gray: (H, W) uint8, free of distortion; K: (3, 3) its camera matrix in pixels, pixel centres
    at integers; stamp_ns: time of exposure in nanoseconds; frame_id: name of the camera's frame;
    left_out: (H, W) bool, pixels that nothing is to be told from, or None.
    """

    gray: NDArray[np.uint8]
    K: Array
    stamp_ns: int
    frame_id: str = 'camera'
    left_out: NDArray[np.bool_] | None = None

    def view(self, estimator: TwoViewEstimator) -> View:
        """Prepare it for an estimator, without what is left out."""
        return estimator.view(self.gray, self.K, left_out=self.left_out)


def continuity(previous: Frame, current: Frame, max_gap: float) -> Status:
    """
    Tell whether a frame follows another: OK, TIME_JUMP or SIZE_CHANGED.

    TIME_JUMP is a step back in time or a gap of more than max_gap seconds; SIZE_CHANGED is another
    image size or another camera matrix.
    """
    gap = (current.stamp_ns - previous.stamp_ns) * 1e-9
    if gap < 0 or gap > max_gap:
        return Status.TIME_JUMP
    if not of_one_camera(previous, current):
        return Status.SIZE_CHANGED
    return Status.OK
