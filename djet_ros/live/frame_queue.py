"""A bounded queue between the thread that receives frames and the one that processes them."""

from __future__ import annotations

from collections import deque
from math import inf
from threading import Condition
from typing import Generic, TypeVar

Item = TypeVar('Item')


class FrameQueue(Generic[Item]):
    """
    Thread-safe FIFO queue; ``put`` never blocks.

    Policy 'latest': if ``size`` items are queued, the oldest is dropped and counted.
    Policy 'every': the number of items is not limited.
    If the queued items weigh ``room`` or more, one is dropped and counted with either policy: the
    oldest with 'latest', the new one with 'every'.
    """

    def __init__(self, policy: str, size: int, room: float = inf) -> None:
        """Create an empty queue; ValueError for an unknown policy or a size below one."""
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
        """Return the number of items dropped so far."""
        with self._changed:
            return self._dropped

    def put(self, item: Item, weight: float = 0.0) -> bool:
        """Append an item with a weight; return False if it is dropped or the queue is closed."""
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
        """Remove and return the oldest item; None after timeout, or if closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._items or self._closed, timeout)
            if not self._items:
                return None
            return self._pop()

    def peek(self, timeout: float = 0.0) -> Item | None:
        """Return the oldest item without removing it; None after timeout, or if closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._items or self._closed, timeout)
            return self._items[0][0] if self._items else None

    @property
    def has_room(self) -> bool:
        """Whether ``put`` would keep a new item; always with policy 'latest'."""
        with self._changed:
            return self._drops or self._closed or self._weight < self._room

    @property
    def weight(self) -> float:
        """Return the total weight of the queued items."""
        with self._changed:
            return self._weight

    def clear(self) -> None:
        """Remove all items."""
        with self._changed:
            self._items.clear()
            self._weight = 0.0

    def close(self) -> None:
        """Accept no more items and wake up waiting threads; queued items can still be taken."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def __len__(self) -> int:
        """Return the number of queued items."""
        with self._changed:
            return len(self._items)

    def _pop(self) -> Item:
        item, weight = self._items.popleft()
        self._weight -= weight
        return item
