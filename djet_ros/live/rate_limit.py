"""Fewer images than come, chosen by their stamps alone: the same images, the same choice."""

from __future__ import annotations

from djet_ros.odometry.order import Order


class RateLimit:
    """
    Takes at most so many images a second of their stamps, on the average; all where hertz is 0.

    Time that passes is saved up, an image costs a period. As one and a half periods can be saved,
    a camera of just this rate may be early by half a period at times, and loses nothing.

    max_backwards, max_gap: by which stamps are late, as for the odometry; where they are not, and
    older than the newest one, all begins anew.
    """

    def __init__(self, hertz: float, max_backwards: float = 0.0, max_gap: float = 0.0) -> None:
        self._order = Order(max_backwards, max_gap)
        self._period = round(1e9 / hertz) if hertz else 0
        self._most = 3 * self._period // 2
        self._saved = 0
        self._took = True

    def takes(self, stamp_ns: int) -> bool:
        """Tell of the next image whether it is taken."""
        order = self._order
        # Stamps that stand still are a fault that others report, so they share one fate.
        if stamp_ns == order.newest:
            return self._took
        if order.newest is None or order.goes_back(stamp_ns):
            order.take(stamp_ns)
            self._saved = self._most
        elif stamp_ns > order.newest:
            # A late image brings no time with it.
            self._saved = min(self._saved + stamp_ns - order.newest, self._most)
            order.take(stamp_ns)
        self._took = self._saved >= self._period
        if self._took:
            self._saved -= self._period
        return self._took
