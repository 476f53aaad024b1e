"""Stamps that do not go on: those that are late, and those with which time begins anew."""

from __future__ import annotations

# Late images in a row that are no accident: the stamps have gone back, and stay there.
LATE_IN_A_ROW = 10


class Order:
    """
    The newest stamps of one camera, by which an older one is judged.

    max_backwards: seconds by which a stamp may be older than the newest one and count as late;
    max_gap: seconds between two images that belong together.
    """

    def __init__(self, max_backwards: float = 0.0, max_gap: float = 0.0) -> None:
        self.newest: int | None = None
        # The one before the newest, where both belong together.
        self._before: int | None = None
        self._late_in_a_row = 0
        self.configure(max_backwards, max_gap)

    def configure(self, max_backwards: float, max_gap: float) -> None:
        """Take other limits, in seconds; what is known of the stamps stays known."""
        self._backwards, self._gap = round(max_backwards * 1e9), round(max_gap * 1e9)

    def take(self, stamp_ns: int) -> None:
        """Let a stamp be the newest one, be it one with which time begins anew."""
        together = self.newest is not None and 0 < stamp_ns - self.newest <= self._gap
        self._before = self.newest if together else None
        self.newest = stamp_ns
        self._late_in_a_row = 0

    def goes_back(self, stamp_ns: int) -> bool:
        """Tell of a stamp whether it is before the newest one, and time begins anew with it."""
        if self.newest is None or stamp_ns >= self.newest:
            return False
        # It goes on after the one before: it is the newest one that was ahead, and the stamps
        # are soon beyond it.
        if self._before is not None and stamp_ns > self._before:
            return False
        self._late_in_a_row += 1
        return (self.newest - stamp_ns > self._backwards
                or self._late_in_a_row >= LATE_IN_A_ROW)
