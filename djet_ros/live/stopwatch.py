"""Time that a live node waits: the machine's, or that of a simulated clock that runs slower."""

from __future__ import annotations

from collections.abc import Callable
from time import monotonic
from typing import NamedTuple

# Seconds after which a node's clock that does not advance has stopped, as while a player pauses.
# A simulator may need more than a second for a step.
_STANDSTILL = 2.0

# Seconds between two looks at a clock that is slower than the machine's.
_SHORTEST, _LONGEST = 0.001, 0.02


class Moment(NamedTuple):
    """A moment by the machine's clock (monotonic seconds) and by the node's (nanoseconds)."""

    machine: float
    node: int


class Stopwatch:
    """
    Measures time by the machine's clock or the node's, whichever has advanced less.

    Messages of a bag that is played slowly come as slowly as its clock runs; those of one that is
    played fast still need the machine's time to arrive. A node's clock that has stopped or was set
    back does not count, so that nothing waits for it. May be used from any thread.
    """

    def __init__(self, now_ns: Callable[[], int]) -> None:
        """now_ns: the node's clock."""
        self._now_ns = now_ns
        self._advanced = Moment(monotonic(), now_ns())

    def now(self) -> Moment:
        """Return the present."""
        moment = Moment(monotonic(), self._now_ns())
        if moment.node != self._advanced.node:
            self._advanced = moment
        return moment

    def left(self, start: Moment, seconds: float) -> float:
        """Return for how long to wait before asking again; 0 or less once seconds have passed."""
        now = self.now()
        by_machine = seconds - (now.machine - start.machine)
        stopped = now.machine - self._advanced.machine > _STANDSTILL
        left = seconds - elapsed(start, now)
        if by_machine > 0 or stopped or left <= 0:
            return by_machine
        # A system clock that is slewed is microseconds behind.
        return min(max(left, _SHORTEST), _LONGEST)


def elapsed(start: Moment, end: Moment) -> float:
    """Return the seconds between two moments by the clock that has advanced less."""
    by_machine, by_node = end.machine - start.machine, (end.node - start.node) * 1e-9
    return min(by_machine, by_node) if by_node >= 0 else by_machine
