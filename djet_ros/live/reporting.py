"""What both live sessions report: the log, throttled, and latencies; and to whom."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from time import monotonic
from typing import Protocol

from djet_ros.core.types import Array
from djet_ros.odometry.tracker import Outgoing
import numpy as np

# Seconds without a message after which its topic is reported as silent.
SILENCE_TIMEOUT = 2.0

# Seconds before the same warning is logged again.
_LOG_PERIOD = 5.0

# Newest messages whose latencies are reported.
_LATENCIES = 100


class Wiring(Protocol):
    """What a session needs from its node; all but ``publish`` is called from any thread."""

    def publish(self, outgoing: Sequence[Outgoing]) -> None:
        """Send messages, from the session's thread or from the one that calls it."""

    def log(self, level: str, text: str) -> None:
        """Log a line; level is 'info' or 'warning'."""

    def why_silent(self, topic: str) -> str:
        """Return why no messages may be arriving on a topic."""

    def wants(self, topic: str) -> bool:
        """Return whether an output that is made on demand has subscribers."""

    def now_ns(self) -> int:
        """Return the time of the node's clock in nanoseconds, which may be simulated."""

    def transform(self, parent: str, child: str) -> Array | None:
        """Return the pose (4, 4) of frame child in parent, or None if tf does not have it yet."""


class Throttle:
    """A throttled log; for one thread at a time."""

    def __init__(self, wiring: Wiring) -> None:
        self._wiring = wiring
        self._logged: dict[str, float] = {}

    def warn(self, key: str, text: str) -> None:
        """Log a warning, unless one with the same key was logged within _LOG_PERIOD."""
        now = monotonic()
        if now - self._logged.get(key, -np.inf) >= _LOG_PERIOD:
            self._logged[key] = now
            self._wiring.log('warning', text)

    def warn_missing(self, what: str, topic: str) -> None:
        """Warn that no messages arrive on a topic."""
        self.warn(what, f'waiting for {what} on {topic}: {self._wiring.why_silent(topic)}')

    def clear(self) -> None:
        """Forget all earlier warnings."""
        self._logged.clear()


class Latencies:
    """Latencies of the newest messages, from receipt to publication."""

    def __init__(self) -> None:
        self._seconds: deque[float] = deque(maxlen=_LATENCIES)

    def add(self, since: float) -> None:
        """Add the latency of a message received at a time (monotonic seconds) and done now."""
        self._seconds.append(monotonic() - since)

    def clear(self) -> None:
        """Remove all latencies."""
        self._seconds.clear()

    def values(self) -> dict[str, str]:
        """Return the values for the diagnostics; empty if there are none yet."""
        if not self._seconds:
            return {}
        median, high = np.percentile(self._seconds, (50, 95)) * 1e3
        return {'latency, median (ms)': f'{median:.1f}', 'latency, 95 % (ms)': f'{high:.1f}'}
