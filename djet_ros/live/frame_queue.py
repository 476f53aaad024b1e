"""A bounded queue between the thread that receives frames and the one that works on them."""

from __future__ import annotations

from collections import deque
from math import inf
from threading import Condition
from typing import Generic, TypeVar

Item = TypeVar('Item')


class FrameQueue(Generic[Item]):
    """
    First in, first out, for any number of threads; whoever puts something in never waits.

    Policy 'latest': where ``size`` items wait already, the oldest is dropped and counted.
    Policy 'every': all wait, however many.
    Where those that wait weigh ``room`` or more, one is dropped and counted with either policy:
    the oldest with 'latest', with 'every' the one that comes.
    """

    def __init__(self, policy: str, size: int, room: float = inf) -> None:
        """Make an empty queue; ValueError for an unknown policy or a size below one."""
        if policy not in ('latest', 'every') or size < 1:
            raise ValueError(f"queue policy '{policy}' with size {size}; it must be latest or "
                             'every, with at least 1')
        self._drops = policy == 'latest'
        self._size = size
        self._room = room
        self._items: deque[tuple[Item, float]] = deque()
        self._weight = 0.0
        self._changed = Condition()
        self._closed = False
        self._dropped = 0

    @property
    def dropped(self) -> int:
        """Count the items dropped so far to make room."""
        with self._changed:
            return self._dropped

    def put(self, item: Item, weight: float = 0.0) -> bool:
        """Append an item of some weight; False where the queue is closed or does not take it."""
        with self._changed:
            if self._closed:
                return False
            while self._items and (self._weight >= self._room
                                   or (self._drops and len(self._items) == self._size)):
                self._dropped += 1
                if not self._drops:
                    return False
                self._pop()
            self._items.append((item, weight))
            self._weight += weight
            self._changed.notify()
            return True

    def get(self, timeout: float | None = None) -> Item | None:
        """Take the oldest item, waiting for one; None after timeout, or if closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._items or self._closed, timeout)
            if not self._items:
                return None
            return self._pop()

    def peek(self, timeout: float = 0.0) -> Item | None:
        """Give the oldest item without taking it; None where none comes in time, or if closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._items or self._closed, timeout)
            return self._items[0][0] if self._items else None

    @property
    def has_room(self) -> bool:
        """Whether an item would be taken now; with policy 'latest' any is."""
        with self._changed:
            return self._drops or self._closed or self._weight < self._room

    @property
    def weight(self) -> float:
        """Weigh the items that wait."""
        with self._changed:
            return self._weight

    def clear(self) -> None:
        """Throw away what waits."""
        with self._changed:
            self._items.clear()
            self._weight = 0.0

    def close(self) -> None:
        """Take no more items and wake up who waits; what waits in the queue can still be got."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def __len__(self) -> int:
        """Count the items that wait."""
        with self._changed:
            return len(self._items)

    def _pop(self) -> Item:
        item, weight = self._items.popleft()
        self._weight -= weight
        return item
