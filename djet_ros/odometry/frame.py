"""A frame of the moving camera, and the reference frame that later ones are related to."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.types import Array, of_same_camera, RelativePose, require_gray, Status, View
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Frame:
    """
    An image with its camera matrix and stamp.

    gray: (H, W) uint8, undistorted; K: (3, 3) its camera matrix in pixels, pixel centres at
    integers; stamp_ns: time of exposure in nanoseconds; frame_id: name of the camera's frame;
    left_out: (H, W) bool, mask of pixels to ignore, or None. The frame keeps copies of writeable
    arrays: one buffer may hold all images in turn. Raises ValueError for an image of another shape
    or type or without pixels, a mask of another size, a K that is no camera matrix, and a stamp
    that is no whole number, as of seconds.
    """

    gray: NDArray[np.uint8]
    K: Array
    stamp_ns: int
    frame_id: str = 'camera'
    left_out: NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        """Refuse what no view can be prepared of, before the odometry starts on it."""
        object.__setattr__(self, 'K', np.array(self.K, np.float64))
        require_gray(self.gray, self.K, self.left_out)
        if not isinstance(self.stamp_ns, int | np.integer):
            raise ValueError(f'stamp_ns is {self.stamp_ns!r}; give whole nanoseconds, such as '
                             'round(seconds * 1e9)')
        # As the reference, the frame outlives many images; a copy takes 0.03 ms.
        for name in ('gray', 'left_out'):
            pixels = getattr(self, name)
            if pixels is not None and pixels.flags.writeable:
                object.__setattr__(self, name, pixels.copy())

    def view(self, estimator: TwoViewEstimator) -> View:
        """Return the view that an estimator prepares of it, without the ignored pixels."""
        return estimator.view(self.gray, self.K, left_out=self.left_out)


@dataclass(frozen=True)
class Reference:
    """
    The reference frame, and the newest stamp at which the camera was still at its pose.

    view: of the frame; pair: the one that ends with it, None if there is none; since_ns: stamp of
    the frame, or of a later one in a standstill; since_covariance: (6, 6) of the camera's pose at
    that stamp in the reference frame.
    """

    frame: Frame
    view: View
    pair: RelativePose | None
    since_ns: int
    since_covariance: Array = field(default_factory=lambda: np.zeros((6, 6)))

    def seen_by(self, estimator: TwoViewEstimator) -> Reference:
        """Return the same with the view that another estimator prepares, without its pair."""
        return replace(self, view=self.frame.view(estimator), pair=None)


def continuity(previous: Frame, current: Frame, max_gap: float) -> Status:
    """
    Return whether a frame can be related to the previous one: OK, TIME_JUMP or SIZE_CHANGED.

    TIME_JUMP: a step back in time, or a gap of more than max_gap seconds; SIZE_CHANGED: another
    image size or camera matrix.
    """
    if not 0 <= current.stamp_ns - previous.stamp_ns <= round(max_gap * 1e9):
        return Status.TIME_JUMP
    if not of_same_camera(previous, current):
        return Status.SIZE_CHANGED
    return Status.OK
