"""Fewer images than come, chosen by their stamps alone: the same images, the same choice."""

from __future__ import annotations

from djet_ros.odometry.tracker import LATE_IN_A_ROW


class RateLimit:
    """
    Takes at most so many images a second of their stamps, on the average; all where hertz is 0.

    Time that passes is saved up, an image costs a period. As one and a half periods can be saved,
    a camera of just this rate may be early by half a period at times, and loses nothing.

    max_backwards: seconds by which a stamp may be older than the newest one and count as late, as
    for the odometry. Beyond it, or where stamps stay back, all begins anew.
    """

    def __init__(self, hertz: float, max_backwards: float = 0.0) -> None:
        self._backwards = round(max_backwards * 1e9)
        self._late_in_a_row = 0
        self._period = round(1e9 / hertz) if hertz else 0
        self._most = 3 * self._period // 2
        self._newest: int | None = None
        self._saved = 0
        self._took = True

    def takes(self, stamp_ns: int) -> bool:
        """Tell of the next image whether it is taken."""
        # Stamps that stand still are a fault that others report, so they share one fate.
        if stamp_ns == self._newest:
            return self._took
        if self._newest is None or self._went_back(stamp_ns, self._newest):
            self._newest, self._saved = stamp_ns, self._most
        # A late image brings no time with it.
        passed = max(stamp_ns - self._newest, 0)
        self._saved = min(self._saved + passed, self._most)
        self._newest += passed
        self._took = self._saved >= self._period
        if self._took:
            self._saved -= self._period
        return self._took

    def _went_back(self, stamp_ns: int, newest: int) -> bool:
        self._late_in_a_row = self._late_in_a_row + 1 if stamp_ns < newest else 0
        return stamp_ns < newest and (newest - stamp_ns > self._backwards
                                      or self._late_in_a_row >= LATE_IN_A_ROW)
