"""Poses of one frame by their stamps, as they come."""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort

from djet_ros.core.types import Array
from djet_ros.odometry.interpolation import poses_at, Stamps
import numpy as np

# Poses that are kept: a minute and more of the fastest odometries.
_KEPT = 20_000

# A gap between two poses that is not bridged.
_LONGEST_GAP_NS = 500_000_000

# Stamps that go back by more belong to another time, as when a bag begins again.
_BACK_NS = 500_000_000


class PoseTrack:
    """Where a frame was in another; kept: how many of the newest poses."""

    def __init__(self, kept: int = _KEPT) -> None:
        self._kept = kept
        self.reset()

    def reset(self) -> None:
        """Forget all poses."""
        self._stamps: list[int] = []
        self._poses: dict[int, Array] = {}

    def add(self, stamp_ns: int, pose: Array) -> None:
        """Take a pose (4, 4); NaN ones are ignored, and so are those of a stamp that is known."""
        if not np.isfinite(pose).all() or stamp_ns in self._poses:
            return
        if self._stamps and stamp_ns < self._stamps[-1] - _BACK_NS:
            self.reset()
        insort(self._stamps, stamp_ns)
        self._poses[stamp_ns] = pose
        if len(self._stamps) > self._kept:
            self._drop(1)

    def covers(self, stamp_ns: int) -> bool:
        """Tell whether there is a pose at a stamp, or after it."""
        return bool(self._stamps) and self._stamps[-1] >= stamp_ns

    def forget_before(self, stamp_ns: int) -> None:
        """Let go of what is not needed from a stamp on."""
        self._drop(max(bisect_right(self._stamps, stamp_ns) - 1, 0))

    def at(self, stamps_ns: Stamps) -> Array:
        """Poses (N, 4, 4) at stamps (N,), between those that are known; NaN elsewhere."""
        # The two about each stamp.
        places = [bisect_left(self._stamps, stamp) for stamp in stamps_ns.tolist()]
        near = sorted({max(min(place - back, len(self._stamps) - 1), 0)
                       for place in places for back in (0, 1)} if self._stamps else ())
        known = [self._stamps[place] for place in near]
        return poses_at(np.array(known, np.int64),
                        np.array([self._poses[stamp] for stamp in known]).reshape(-1, 4, 4),
                        stamps_ns, _LONGEST_GAP_NS)

    def _drop(self, number: int) -> None:
        """Drop the oldest poses."""
        for stamp in self._stamps[:number]:
            del self._poses[stamp]
        del self._stamps[:number]
