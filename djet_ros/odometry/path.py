"""The path of the newest poses, which is published at a limited rate."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any


class Path:
    """
    Poses (PoseStamped) in the odom frame.

    length: number of poses that are kept; period: least seconds between two publications.
    """

    def __init__(self, length: int, period: float) -> None:
        self._poses: deque[Any] = deque()
        self._published_ns: int | None = None
        self.configure(length, period)

    def configure(self, length: int, period: float) -> None:
        """Change the parameters; the newest poses are kept."""
        self._poses = deque(self._poses, maxlen=length)
        self._period_ns = period * 1e9

    def discard_poses(self) -> None:
        """Remove the poses, as those that follow are of another frame."""
        self._poses.clear()

    def reset(self) -> None:
        """Remove the poses; the next one is published."""
        self._poses.clear()
        self._published_ns = None

    def add(self, pose: Any, stamp_ns: int) -> Sequence[Any]:
        """Add a pose; return all of them if they are to be published now, otherwise none."""
        self._poses.append(pose)
        if self._published_ns is not None and stamp_ns - self._published_ns < self._period_ns:
            return ()
        self._published_ns = stamp_ns
        return self._poses
