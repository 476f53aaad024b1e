"""Another odometry beside the camera: where the camera went between two images, by its word."""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort

from djet_ros.core.types import Array, Pose
from djet_ros.odometry.interpolation import poses_at
import numpy as np

# Poses that are kept: a minute and more of the fastest odometries.
_KEPT = 20_000

# A gap between two poses that is not bridged.
_LONGEST_GAP_NS = 500_000_000

# Stamps that go back by more belong to another time, as when a bag begins again.
_BACK_NS = 500_000_000

# Metres below which a motion has no direction.
_SHORTEST = 1e-6


class Guess:
    """Poses of a frame that moves with the camera, in a frame that stands still."""

    def __init__(self) -> None:
        self.mounting: Array | None = None
        self.reset()

    def reset(self) -> None:
        """Forget all poses."""
        self._stamps: list[int] = []
        self._poses: dict[int, Array] = {}

    def mount(self, mounting: Array) -> None:
        """Take the camera (4, 4) in the frame whose poses come."""
        self.mounting = mounting

    def add(self, stamp_ns: int, pose: Array) -> None:
        """Take a pose (4, 4); NaN ones are ignored, and so are those of a stamp that is known."""
        if not np.isfinite(pose).all() or stamp_ns in self._poses:
            return
        if self._stamps and stamp_ns < self._stamps[-1] - _BACK_NS:
            self.reset()
        insort(self._stamps, stamp_ns)
        self._poses[stamp_ns] = pose
        if len(self._stamps) > _KEPT:
            self._drop(1)

    def covers(self, stamp_ns: int) -> bool:
        """Tell whether there is a pose at the stamp of an image, or after it."""
        return bool(self._stamps) and self._stamps[-1] >= stamp_ns

    def forget_before(self, stamp_ns: int) -> None:
        """Let go of what was before an image that no other will be related to."""
        self._drop(max(bisect_right(self._stamps, stamp_ns) - 1, 0))

    def motion(self, start_ns: int, end_ns: int) -> Array | None:
        """Pose (4, 4) of the camera at the end in the camera at the start; None if unknown."""
        if self.mounting is None or not self._stamps:
            return None
        # The two about each stamp.
        places = [bisect_left(self._stamps, stamp) for stamp in (start_ns, end_ns)]
        near = sorted({max(min(place - back, len(self._stamps) - 1), 0)
                       for place in places for back in (0, 1)})
        stamps = [self._stamps[place] for place in near]
        start, end = poses_at(np.array(stamps, np.int64),
                              np.array([self._poses[stamp] for stamp in stamps]),
                              np.array([start_ns, end_ns]), _LONGEST_GAP_NS)
        if not (np.isfinite(start).all() and np.isfinite(end).all()):
            return None
        T = self.mounting
        return np.asarray(np.linalg.inv(start @ T) @ end @ T)

    def _drop(self, number: int) -> None:
        """Drop the oldest poses."""
        for stamp in self._stamps[:number]:
            del self._poses[stamp]
        del self._stamps[:number]


def as_start(motion: Array) -> Pose | None:
    """Word a motion (4, 4) as the estimator's x_current = R x_previous + t; None without a way."""
    length = float(np.linalg.norm(motion[:3, 3]))
    if length < _SHORTEST:
        return None
    R = motion[:3, :3].T
    return Pose(R, -R @ motion[:3, 3] / length)
