"""Poses of one frame, buffered by their stamps."""

from __future__ import annotations

from bisect import bisect_left

from djet_ros.core.types import Array
from djet_ros.odometry.interpolation import poses_at, Stamps
from djet_ros.odometry.stamped import Stamped
import numpy as np

# Poses that are kept: more than a minute of the fastest odometries.
_KEPT = 20_000

# Longest gap between two poses over which they are interpolated.
_LONGEST_GAP_NS = 500_000_000


class PoseTrack:
    """Poses of a frame in another; kept: the most poses that are kept."""

    def __init__(self, kept: int = _KEPT) -> None:
        self._poses = Stamped[Array](kept)

    def reset(self) -> None:
        """Forget all poses."""
        self._poses.clear()

    def go_back(self, stamp_ns: int) -> None:
        """Forget all poses from before time went back to a stamp; newer ones are kept."""
        if self._poses.goes_back(stamp_ns):
            self.reset()

    def add(self, stamp_ns: int, pose: Array) -> None:
        """Take a pose (4, 4); NaN, and a second one with the same stamp, are ignored."""
        if not np.isfinite(pose).all():
            return
        # First, as a bag that loops repeats its stamps.
        self.go_back(stamp_ns)
        self._poses.add(stamp_ns, pose)

    def covers(self, stamp_ns: int) -> bool:
        """Return whether there is a pose at a stamp, or after it."""
        return self._poses.covers(stamp_ns)

    def forget_before(self, stamp_ns: int) -> None:
        """Drop poses that are not needed from a stamp on."""
        self._poses.forget_before(stamp_ns)

    def at(self, stamps_ns: Stamps) -> Array:
        """Return poses (N, 4, 4) at stamps (N,), interpolated; NaN where that is impossible."""
        # The two around each stamp.
        stamps = self._poses.stamps
        places = [bisect_left(stamps, stamp) for stamp in stamps_ns.tolist()]
        near = sorted({max(min(place - back, len(stamps) - 1), 0)
                       for place in places for back in (0, 1)} if stamps else ())
        known = [stamps[place] for place in near]
        return poses_at(np.array(known, np.int64),
                        np.array([self._poses[stamp] for stamp in known]).reshape(-1, 4, 4),
                        stamps_ns, _LONGEST_GAP_NS)
