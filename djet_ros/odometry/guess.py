"""Another odometry beside the camera: where the camera went between two images, by its word."""

from __future__ import annotations

from djet_ros.core.types import Array, Pose
from djet_ros.odometry.pose_track import PoseTrack
import numpy as np

# Metres below which a motion has no direction.
_SHORTEST = 1e-6


class Guess:
    """Poses of a frame that moves with the camera, in a frame that stands still."""

    def __init__(self) -> None:
        self.mounting: Array | None = None
        self._poses = PoseTrack()

    def reset(self) -> None:
        """Forget all poses."""
        self._poses.reset()

    def go_back(self, stamp_ns: int) -> None:
        """Hear that time begins anew at a stamp; what came of the new time already stays."""
        self._poses.go_back(stamp_ns)

    def mount(self, mounting: Array) -> None:
        """Take the camera (4, 4) in the frame whose poses come."""
        self.mounting = mounting

    def add(self, stamp_ns: int, pose: Array) -> None:
        """Take a pose (4, 4) of that frame."""
        self._poses.add(stamp_ns, pose)

    def covers(self, stamp_ns: int) -> bool:
        """Tell whether there is a pose at the stamp of an image, or after it."""
        return self._poses.covers(stamp_ns)

    def forget_before(self, stamp_ns: int) -> None:
        """Let go of what was before an image that no other will be related to."""
        self._poses.forget_before(stamp_ns)

    def motion(self, start_ns: int, end_ns: int) -> Array | None:
        """Pose (4, 4) of the camera at the end in the camera at the start; None if unknown."""
        if self.mounting is None:
            return None
        start, end = self._at(start_ns, end_ns)
        if not (np.isfinite(start).all() and np.isfinite(end).all()):
            return None
        T = self.mounting
        return np.asarray(np.linalg.inv(start @ T) @ end @ T)

    def _at(self, start_ns: int, end_ns: int) -> Array:
        """Poses (2, 4, 4) at two stamps, NaN where they are not known."""
        return self._poses.at(np.array([start_ns, end_ns]))


def as_start(motion: Array) -> Pose | None:
    """Word a motion (4, 4) as the estimator's x_current = R x_previous + t; None without a way."""
    length = float(np.linalg.norm(motion[:3, 3]))
    if length < _SHORTEST:
        return None
    R = motion[:3, :3].T
    return Pose(R, -R @ motion[:3, 3] / length)
