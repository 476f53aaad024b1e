"""Another odometry on tf as a guess: the motion of the camera's frame in a fixed frame."""

from __future__ import annotations

from typing import Any

from djet_ros.core.types import Array
from djet_ros.odometry.guess import Guess
from djet_ros.odometry.moving_frames import MovingFrames
import numpy as np


class FrameGuess(Guess):
    """Poses of the camera's frame in a fixed frame, through the chain of frames between them."""

    def __init__(self, fixed: str) -> None:
        super().__init__()
        self._fixed, self.camera, self._frames = fixed, '', MovingFrames()

    @property
    def fixed(self) -> str:
        """Return the name of the fixed frame."""
        return self._fixed

    def look_for(self, camera: str) -> None:
        """Set the name of the camera's frame; ``mount`` takes the images' axes in it."""
        self.camera = camera

    def add_message(self, message: Any, *, static: bool) -> None:
        """Take a TFMessage of /tf or of /tf_static."""
        self._frames.add(message, static=static)

    def reset(self) -> None:
        """Forget the poses of moving frames."""
        super().reset()
        self._frames.reset()

    def go_back(self, stamp_ns: int) -> None:
        """Forget the poses from before time went back to a stamp."""
        self._frames.go_back(stamp_ns)

    def covers(self, stamp_ns: int) -> bool:
        """Return whether all moving frames between the two have a pose at a stamp or after it."""
        return self._frames.covers(self._fixed, self.camera, stamp_ns)

    def forget_before(self, stamp_ns: int) -> None:
        """Drop poses that are not needed after the stamp of an image."""
        self._frames.forget_before(stamp_ns)

    def _at(self, start_ns: int, end_ns: int) -> Array:
        return self._frames.poses(self._fixed, self.camera, np.array([start_ns, end_ns]))
