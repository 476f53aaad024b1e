"""Fewer images than come, chosen by their stamps alone: the same images, the same choice."""

from __future__ import annotations


class RateLimit:
    """
    Takes at most so many images a second of their stamps, on the average; all where hertz is 0.

    Time that passes is saved up, an image costs a period. As one and a half periods can be saved,
    a camera of just this rate may be early by half a period at times, and loses nothing.
    """

    def __init__(self, hertz: float) -> None:
        self._period = round(1e9 / hertz) if hertz else 0
        self._most = 3 * self._period // 2
        self._newest: int | None = None
        self._saved = 0
        self._took = True

    def takes(self, stamp_ns: int) -> bool:
        """Tell of the next image whether it is taken. A stamp that goes back starts anew."""
        # Stamps that stand still are a fault that others report, so they share one fate.
        if stamp_ns == self._newest:
            return self._took
        if self._newest is None or stamp_ns < self._newest:
            self._saved = self._most
        else:
            self._saved = min(self._saved + stamp_ns - self._newest, self._most)
        self._newest = stamp_ns
        self._took = self._saved >= self._period
        if self._took:
            self._saved -= self._period
        return self._took
