"""Masks of ignored pixels: beyond the undistorted image, a static mask, and one per image."""

from __future__ import annotations

from collections import deque
from functools import reduce
from typing import Any

from djet_ros.odometry.camera import Camera
from djet_ros.odometry.images import BadMessage, gray_image
from djet_ros.odometry.messages import stamp_ns
import numpy as np
from numpy.typing import NDArray

# Gray level of a mask below which a pixel is ignored.
FREE = 128

# Masks that are kept until their image comes.
_KEPT = 50


def left_out(gray: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return the ignored pixels (H, W) bool: True where a mask (H, W) is dark."""
    return np.asarray(gray < FREE)


class Masks:
    """Masks by stamp, and a static mask (H, W) bool or None; all before undistortion."""

    def __init__(self, static: NDArray[np.bool_] | None = None) -> None:
        self._static = static
        self._undistorted: tuple[Camera, tuple[int, ...], NDArray[np.bool_]] | None = None
        self.reset()

    def reset(self) -> None:
        """Forget the masks by stamp."""
        self._waiting: deque[tuple[int, Any]] = deque(maxlen=_KEPT)

    def add(self, message: Any) -> None:
        """Take the mask of an image."""
        self._waiting.append((stamp_ns(message.header), message))

    def has(self, stamp: int) -> bool:
        """Return whether the mask of an image was received."""
        return any(one == stamp for one, _ in self._waiting)

    def of(self, stamp: int, shape: tuple[int, ...], camera: Camera) -> NDArray[np.bool_] | None:
        """
        Return the ignored pixels of an undistorted image, (H, W) bool, or None.

        shape: of the image before undistortion. Without masks it is the camera's ``unseen`` object
        itself. Raises BadMessage if a mask is no image, or of another size.
        """
        found = [message for one, message in self._waiting if one == stamp]
        while self._waiting and self._waiting[0][0] <= stamp:
            self._waiting.popleft()
        moving = None if not found else _undistorted(_gray(found[-1]), shape, camera, 'mask')
        parts = [part for part in (moving, self._of_camera(shape, camera), camera.unseen(shape))
                 if part is not None]
        return reduce(np.logical_or, parts) if parts else None

    def _of_camera(self, shape: tuple[int, ...], camera: Camera) -> NDArray[np.bool_] | None:
        """Return the undistorted static mask; cached, as the camera rarely changes."""
        if self._static is None:
            return None
        if self._undistorted is None or self._undistorted[0] is not camera \
                or self._undistorted[1] != shape:
            self._undistorted = camera, shape, _undistorted(self._static, shape, camera,
                                                            'odometry.mask_file')
        return self._undistorted[2]


def _gray(message: Any) -> NDArray[np.bool_]:
    """Return the ignored pixels of a mask's message; raises BadMessage that names the mask."""
    try:
        return left_out(gray_image(message))
    except BadMessage as problem:
        raise BadMessage(problem.reason, f'mask: {problem}') from None


def _undistorted(mask: NDArray[np.bool_], shape: tuple[int, ...], camera: Camera, what: str
                 ) -> NDArray[np.bool_]:
    if mask.shape != shape:
        raise BadMessage('mask_size', f'{what} has {mask.shape[1]}x{mask.shape[0]} pixels, the '
                         f'image {shape[1]}x{shape[0]}; both must have the same size')
    # A pixel interpolated from any ignored one is ignored.
    ignored = np.asarray(camera.undistort(np.where(mask, 255, 0).astype(np.uint8)) > 0)
    ignored.setflags(write=False)  # all frames may share it
    return ignored
