"""
Another body that comes to fill the view, such as a lorry that passes close by.

All matches of a pair may then be on it, and fit its motion alone: nothing in the two images tells
that it is not the static world. But hardly any of them is a point of the world that the camera saw
before, and they move otherwise. A camera that turns away from all that it saw and goes elsewhere
would look the same, but hardly does both from one frame to the next.
"""

from __future__ import annotations

from djet_ros.core.geometry import direction_angle
from djet_ros.core.known_depths import same_points
from djet_ros.core.rivals import MIN_BODY_SHARE
from djet_ros.core.types import Array, RelativePose, Status, TRACKED, UNDECIDED
from djet_ros.core.verdict import as_undecided
from djet_ros.odometry.standstill import Standstill
import numpy as np

# rad; chosen: change of its direction up to which a motion goes on. Standard deviations of the
# direction, the usual three, that are no change.
_GOES_ON, _NO_CHANGE = 0.35, 3.0

# Nanoseconds; chosen: for so long a motion is doubted that may be that of a lorry. One that passes
# at walking pace has left the view by then.
PASSING_NS = 3_000_000_000


class Takeover:
    """
    Tells whether pairs follow the world, or what has taken over the view.

    standstill: knows which features of the reference view stood still.
    """

    def __init__(self, standstill: Standstill) -> None:
        self._standstill = standstill
        self.forget()

    def forget(self) -> None:
        """Forget everything, as it is unknown how the camera has moved."""
        # Direction in which it last moved, and the stamp up to which others are doubted.
        self._direction: Array | None = None
        self._doubted_until_ns: int | None = None

    def stay(self) -> None:
        """Note that the camera stands still."""
        self._doubted_until_ns = None

    def take(self, pair: RelativePose, stamp_ns: int) -> None:
        """Take a tracked pair; while others are doubted, a vague one tells nothing."""
        if self._doubts(stamp_ns) and self._change(pair) > _GOES_ON:
            return
        self._doubted_until_ns = None
        if pair.t.any():
            self._direction = pair.t

    def judged(self, before: RelativePose | None, pair: RelativePose, stamp_ns: int
               ) -> RelativePose:
        """
        Return a pair, as TWO_MOTIONS if another body has taken over the view.

        before: the pair that ends where it begins; stamp_ns: of its end.
        """
        tracked = pair.status in TRACKED
        if tracked and self._change(pair) < _GOES_ON + _uncertainty(pair):
            return pair
        doubted = self._doubts(stamp_ns)
        if not doubted and (tracked or pair.status in UNDECIDED) and pair.t.any():
            doubted = self._is_of_other_points(before, pair)
            if doubted:
                self._doubted_until_ns = stamp_ns + PASSING_NS
        return as_undecided(pair, Status.TWO_MOTIONS) if tracked and doubted else pair

    def _doubts(self, stamp_ns: int) -> bool:
        return self._doubted_until_ns is not None and stamp_ns < self._doubted_until_ns

    def _change(self, pair: RelativePose) -> float:
        """Return the angle between the directions of a motion and the last one; pi if unknown."""
        if self._direction is None or not pair.t.any():
            return float(np.pi)
        return direction_angle(pair.t, self._direction)

    def _is_of_other_points(self, before: RelativePose | None, pair: RelativePose) -> bool:
        """
        Return whether hardly any inlier of a pair is a point of the world as it was known.

        Of successive pairs a quarter and more were, on streets, indoors and by hand.
        """
        x = pair.x[pair.inliers]
        if self._standstill.stood:
            known = self._standstill.is_static(x)
        # Without a motion before, nothing tells that this one is another.
        elif self._direction is None or before is None or before.status not in TRACKED:
            return False
        else:
            known, _ = same_points(x, before.y_opt[before.inliers])
        return bool(known.sum() <= MIN_BODY_SHARE * len(known))


def _uncertainty(pair: RelativePose) -> float:
    """Return the change of direction that may be none, in rad."""
    if not pair.t.any():
        return 0.0
    return float(_NO_CHANGE * np.sqrt(np.linalg.eigvalsh(pair.covariance_5[3:, 3:])[-1]))
