"""Buffer of stamped measurements, which may be out of order or of a time before a restart."""

from __future__ import annotations

from bisect import bisect_right, insort
from typing import Generic, TypeVar

Value = TypeVar('Value')

# Stamps that go back by more mean that time restarted, as when a bag loops.
_BACK_NS = 500_000_000


class Stamped(Generic[Value]):
    """Values by their stamps in ns, sorted; kept: the most values that are kept."""

    def __init__(self, kept: int) -> None:
        self._kept = kept
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self.stamps: list[int] = []
        self._values: dict[int, Value] = {}

    def __len__(self) -> int:
        return len(self.stamps)

    def __contains__(self, stamp_ns: int) -> bool:
        return stamp_ns in self._values

    def __getitem__(self, stamp_ns: int) -> Value:
        return self._values[stamp_ns]

    def goes_back(self, stamp_ns: int) -> bool:
        """Return whether time restarted with a stamp."""
        return bool(self.stamps) and stamp_ns < self.stamps[-1] - _BACK_NS

    def add(self, stamp_ns: int, value: Value) -> None:
        """Take a value; a second one with the same stamp is ignored."""
        if stamp_ns in self._values:
            return
        insort(self.stamps, stamp_ns)
        self._values[stamp_ns] = value
        if len(self.stamps) > self._kept:
            self._drop(1)

    def covers(self, stamp_ns: int) -> bool:
        """Return whether there is a value at a stamp, or after it."""
        return bool(self.stamps) and self.stamps[-1] >= stamp_ns

    def forget_before(self, stamp_ns: int) -> None:
        """Drop values before the last one up to a stamp."""
        self._drop(bisect_right(self.stamps, stamp_ns) - 1)

    def _drop(self, number: int) -> None:
        for stamp in self.stamps[:max(number, 0)]:
            del self._values[stamp]
        del self.stamps[:max(number, 0)]
