"""Pixels that are left out of an image: by its lens, by a still mask, by one for each stamp."""

from __future__ import annotations

from collections import deque
from functools import reduce
from typing import Any

from djet_ros.odometry.camera import Camera
from djet_ros.odometry.images import BadMessage, gray_image
from djet_ros.odometry.messages import stamp_ns
import numpy as np
from numpy.typing import NDArray

# Gray level below which a pixel of a mask is left out.
_FREE = 128

# Masks that wait for their image, or came too late for it.
_KEPT = 50


def left_out(gray: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """(H, W) bool, True where a mask (H, W) is dark."""
    return np.asarray(gray < _FREE)


class Masks:
    """A still mask (H, W) bool of the images as they come, or None; and others by their stamps."""

    def __init__(self, still: NDArray[np.bool_] | None = None) -> None:
        self._still = still
        self._undistorted: tuple[Camera, tuple[int, ...], NDArray[np.bool_]] | None = None
        self.reset()

    def reset(self) -> None:
        """Forget the masks of stamps."""
        self._waiting: deque[tuple[int, Any]] = deque(maxlen=_KEPT)

    def add(self, message: Any) -> None:
        """Take the mask of an image."""
        self._waiting.append((stamp_ns(message.header), message))

    def has(self, stamp: int) -> bool:
        """Tell whether the mask of an image has come."""
        return any(one == stamp for one, _ in self._waiting)

    def of(self, stamp: int, shape: tuple[int, ...], camera: Camera) -> NDArray[np.bool_] | None:
        """
        Give what is left out of an undistorted image, (H, W) bool, or None.

        shape: of the image as it came. Where there are no masks, what the camera does not see is
        given as the camera has it. Raises BadMessage where a mask is none, or for another size.
        """
        found = [message for one, message in self._waiting if one == stamp]
        while self._waiting and self._waiting[0][0] <= stamp:
            self._waiting.popleft()
        moving = None if not found else _undistorted(_gray(found[-1]), shape, camera, 'mask')
        parts = [part for part in (moving, self._of_camera(shape, camera), camera.unseen(shape))
                 if part is not None]
        return reduce(np.logical_or, parts) if parts else None

    def _of_camera(self, shape: tuple[int, ...], camera: Camera) -> NDArray[np.bool_] | None:
        """Give the still mask without the distortion of a camera, which seldom changes."""
        if self._still is None:
            return None
        if self._undistorted is None or self._undistorted[0] is not camera \
                or self._undistorted[1] != shape:
            self._undistorted = camera, shape, _undistorted(self._still, shape, camera,
                                                            'odometry.mask_file')
        return self._undistorted[2]


def _gray(message: Any) -> NDArray[np.bool_]:
    """(H, W) bool of a mask's message; BadMessage that says whose fault it is."""
    try:
        return left_out(gray_image(message))
    except BadMessage as problem:
        raise BadMessage(problem.reason, f'mask: {problem}') from None


def _undistorted(mask: NDArray[np.bool_], shape: tuple[int, ...], camera: Camera, what: str
                 ) -> NDArray[np.bool_]:
    if mask.shape != shape:
        raise BadMessage('mask_size', f'{what} has {mask.shape[1]}x{mask.shape[0]} pixels, the '
                         f'image {shape[1]}x{shape[0]}; both must be of one size, as they come')
    # What lies between a pixel that is left out and one that is not, is left out too.
    return np.asarray(camera.undistort(np.where(mask, 255, 0).astype(np.uint8)) > 0)
