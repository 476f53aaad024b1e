"""Another odometry as a guess: the camera's motion between two images, by its poses."""

from __future__ import annotations

from djet_ros.core.types import Array, Pose
from djet_ros.odometry.pose_track import PoseTrack
import numpy as np

# Metres below which a translation has no direction.
_SHORTEST = 1e-6


class Guess:
    """
    Poses of a frame that is fixed to the camera, in a frame that is fixed to the world.

    mounting: (4, 4) the camera in the frame whose poses are measured; None while it is unknown.
    """

    def __init__(self) -> None:
        self.mounting: Array | None = None
        self._poses = PoseTrack()

    def reset(self) -> None:
        """Forget all poses."""
        self._poses.reset()

    def go_back(self, stamp_ns: int) -> None:
        """Forget the poses from before time went back to a stamp."""
        self._poses.go_back(stamp_ns)

    def mount(self, mounting: Array) -> None:
        """Set the camera's pose (4, 4) in the frame whose poses are measured."""
        self.mounting = mounting

    def add(self, stamp_ns: int, pose: Array) -> None:
        """Take a pose (4, 4) of that frame."""
        self._poses.add(stamp_ns, pose)

    def covers(self, stamp_ns: int) -> bool:
        """Return whether there is a pose at the stamp of an image, or after it."""
        return self._poses.covers(stamp_ns)

    def forget_before(self, stamp_ns: int) -> None:
        """Drop poses that are not needed after the stamp of an image."""
        self._poses.forget_before(stamp_ns)

    def motion(self, start_ns: int, end_ns: int) -> Array | None:
        """Return the camera's pose (4, 4) at the end in the camera at the start, or None."""
        if self.mounting is None:
            return None
        start, end = self._at(start_ns, end_ns)
        if not (np.isfinite(start).all() and np.isfinite(end).all()):
            return None
        T = self.mounting
        return np.asarray(np.linalg.inv(start @ T) @ end @ T)

    def _at(self, start_ns: int, end_ns: int) -> Array:
        """Return poses (2, 4, 4) at two stamps, NaN if they are unknown."""
        return self._poses.at(np.array([start_ns, end_ns]))


def initial_pose(motion: Array) -> Pose | None:
    """Return a motion (4, 4) as x_current = R x_previous + t; None without a translation."""
    length = float(np.linalg.norm(motion[:3, 3]))
    if length < _SHORTEST:
        return None
    R = motion[:3, :3].T
    return Pose(R, -R @ motion[:3, 3] / length)
