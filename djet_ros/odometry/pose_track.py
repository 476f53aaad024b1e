"""Poses of one frame by their stamps, as they come."""

from __future__ import annotations

from bisect import bisect_left

from djet_ros.core.types import Array
from djet_ros.odometry.interpolation import poses_at, Stamps
from djet_ros.odometry.stamped import Stamped
import numpy as np

# Poses that are kept: a minute and more of the fastest odometries.
_KEPT = 20_000

# A gap between two poses that is not bridged.
_LONGEST_GAP_NS = 500_000_000


class PoseTrack:
    """Where a frame was in another; kept: how many of the newest poses."""

    def __init__(self, kept: int = _KEPT) -> None:
        self._poses = Stamped[Array](kept)

    def reset(self) -> None:
        """Forget all poses."""
        self._poses.clear()

    def go_back(self, stamp_ns: int) -> None:
        """Forget all poses unless the last ones are of the time that begins anew at a stamp."""
        if self._poses.goes_back(stamp_ns):
            self.reset()

    def add(self, stamp_ns: int, pose: Array) -> None:
        """Take a pose (4, 4); NaN ones are ignored, and so are those of a stamp that is known."""
        if not np.isfinite(pose).all() or stamp_ns in self._poses:
            return
        self.go_back(stamp_ns)
        self._poses.add(stamp_ns, pose)

    def covers(self, stamp_ns: int) -> bool:
        """Tell whether there is a pose at a stamp, or after it."""
        return self._poses.covers(stamp_ns)

    def forget_before(self, stamp_ns: int) -> None:
        """Let go of what is not needed from a stamp on."""
        self._poses.forget_before(stamp_ns)

    def at(self, stamps_ns: Stamps) -> Array:
        """Poses (N, 4, 4) at stamps (N,), between those that are known; NaN elsewhere."""
        # The two about each stamp.
        stamps = self._poses.stamps
        places = [bisect_left(stamps, stamp) for stamp in stamps_ns.tolist()]
        near = sorted({max(min(place - back, len(stamps) - 1), 0)
                       for place in places for back in (0, 1)} if stamps else ())
        known = [stamps[place] for place in near]
        return poses_at(np.array(known, np.int64),
                        np.array([self._poses[stamp] for stamp in known]).reshape(-1, 4, 4),
                        stamps_ns, _LONGEST_GAP_NS)
