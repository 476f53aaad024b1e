"""Rate limit of the images, by their stamps alone, so that it is deterministic."""

from __future__ import annotations

from djet_ros.odometry.order import Order


class RateLimit:
    """
    A token bucket: accepts at most hertz images per second on average; all if hertz is 0.

    Time between stamps fills the bucket, each accepted image takes one period. The bucket holds
    one and a half periods, so that a camera of exactly this rate loses no image if its stamps
    are early by up to half a period.

    max_backwards, max_gap: limits of late stamps, as for the odometry; stamps that go back
    further reset the bucket.
    """

    def __init__(self, hertz: float, max_backwards: float = 0.0, max_gap: float = 0.0) -> None:
        self._order = Order(max_backwards, max_gap)
        self._period = round(1e9 / hertz) if hertz else 0
        self._most = 3 * self._period // 2
        self._saved = 0
        self._took = True

    def takes(self, stamp_ns: int) -> bool:
        """Return whether the next image is accepted."""
        order = self._order
        # Repeated stamps are a fault that is reported elsewhere: treat them as the first.
        if stamp_ns == order.newest:
            return self._took
        if order.newest is None or order.goes_back(stamp_ns):
            order.take(stamp_ns)
            self._saved = self._most
        elif stamp_ns > order.newest:
            # A late image adds no time.
            self._saved = min(self._saved + stamp_ns - order.newest, self._most)
            order.take(stamp_ns)
        self._took = self._saved >= self._period
        if self._took:
            self._saved -= self._period
        return self._took
