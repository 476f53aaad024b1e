"""Queue of auxiliary inputs (IMU, guess, mask, speed, tf) until the tracker takes them."""

from __future__ import annotations

from collections.abc import Callable
from threading import Event
from typing import Any, NamedTuple

from djet_ros.live.frame_queue import FrameQueue
from djet_ros.live.stopwatch import Moment, Stopwatch

# Messages in the queue: minutes of a fast IMU.
_MAX_MESSAGES = 100_000


class _Queued(NamedTuple):
    """A message, the tracker's method that takes it, and its time of arrival."""

    take: Callable[[Any], None]
    message: Any
    at: Moment


class AuxiliaryQueue:
    """
    Messages in the order of arrival; put by one thread, passed to the tracker by another.

    newest: arrival of the last one; max_bytes: limit of the queue, beyond which the oldest are
    dropped.
    """

    def __init__(self, stopwatch: Stopwatch, max_bytes: float) -> None:
        self._stopwatch = stopwatch
        self._queue: FrameQueue[_Queued] = FrameQueue('latest', _MAX_MESSAGES, max_bytes)
        self._arrived = Event()
        self.newest: Moment | None = None

    def put(self, take: Callable[[Any], None], message: Any, size: int) -> None:
        """Queue a message of some bytes for a method of the tracker."""
        self.newest = at = self._stopwatch.now()
        self._queue.put(_Queued(take, message, at), size)
        self._arrived.set()

    def feed(self, until: float) -> None:
        """
        Pass the messages that arrived until a time to the tracker, which keeps a few.

        until: by the machine's clock (monotonic seconds).
        """
        while self.feed_next(lambda at: at.machine <= until):
            pass

    def feed_next(self, wanted: Callable[[Moment], bool]) -> bool:
        """Pass the oldest message to the tracker if its arrival is wanted; return whether."""
        waiting = self._queue.peek()
        if waiting is None or not wanted(waiting.at):
            return False
        if (one := self._queue.get(timeout=0)) is None:
            return False
        one.take(one.message)
        return True

    def expect(self) -> None:
        """Let the next ``wait`` return only for what arrives from now on."""
        self._arrived.clear()

    def wait(self, seconds: float) -> None:
        """Wait until a message arrives, or for some seconds."""
        self._arrived.wait(seconds)

    def wake(self) -> None:
        """End a ``wait``."""
        self._arrived.set()

    def clear(self) -> None:
        """Discard all messages."""
        self._queue.clear()

    def close(self) -> None:
        """Accept no more messages."""
        self._queue.close()
