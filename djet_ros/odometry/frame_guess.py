"""Another odometry that tf tells: how the camera's frame moves in one that stands still."""

from __future__ import annotations

from typing import Any

from djet_ros.core.types import Array
from djet_ros.odometry.guess import Guess
from djet_ros.odometry.moving_frames import MovingFrames
import numpy as np


class FrameGuess(Guess):
    """The camera's own frame in one that stands still, through whatever is between them on tf."""

    def __init__(self, still: str) -> None:
        super().__init__()
        self._still, self.camera, self._frames = still, '', MovingFrames()

    @property
    def still(self) -> str:
        """Name the frame that stands still."""
        return self._still

    def look_for(self, camera: str) -> None:
        """Say what the camera's frame is called; ``mount`` takes the images' axes in it."""
        self.camera = camera

    def hear(self, message: Any, *, static: bool) -> None:
        """Take a TFMessage of /tf or of /tf_static."""
        self._frames.add(message, static=static)

    def reset(self) -> None:
        """Forget all that moves."""
        super().reset()
        self._frames.reset()

    def go_back(self, stamp_ns: int) -> None:
        """Hear that time begins anew at a stamp; what came of the new time already stays."""
        self._frames.go_back(stamp_ns)

    def covers(self, stamp_ns: int) -> bool:
        """Tell whether all that moves between the two is known at a stamp, or after it."""
        return self._frames.covers(self._still, self.camera, stamp_ns)

    def forget_before(self, stamp_ns: int) -> None:
        """Let go of what was before an image that no other will be related to."""
        self._frames.forget_before(stamp_ns)

    def _at(self, start_ns: int, end_ns: int) -> Array:
        return self._frames.poses(self._still, self.camera, np.array([start_ns, end_ns]))
