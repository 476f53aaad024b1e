"""A bounded queue between the thread that receives frames and the one that works on them."""

from __future__ import annotations

from collections import deque
from threading import Condition
from typing import Generic, TypeVar

Item = TypeVar('Item')


class FrameQueue(Generic[Item]):
    """
    First in, first out, for any number of threads.

    Policy 'latest': where ``size`` items wait already, the oldest is dropped and counted.
    Policy 'every': ``put`` waits for room instead, and nothing is dropped.
    """

    def __init__(self, policy: str, size: int) -> None:
        """Make an empty queue; ValueError for an unknown policy or a size below one."""
        if policy not in ('latest', 'every') or size < 1:
            raise ValueError(f"queue policy '{policy}' with size {size}; it must be latest or "
                             'every, with at least 1')
        self._drops = policy == 'latest'
        self._size = size
        self._items: deque[Item] = deque()
        self._changed = Condition()
        self._closed = False
        self._dropped = 0

    @property
    def dropped(self) -> int:
        """Count the items dropped so far to make room."""
        with self._changed:
            return self._dropped

    def put(self, item: Item, timeout: float | None = None) -> bool:
        """
        Append an item; False where the queue is closed, or stayed full for timeout seconds.

        Only policy 'every' ever waits.
        """
        with self._changed:
            if self._drops:
                if not self._closed and len(self._items) == self._size:
                    self._items.popleft()
                    self._dropped += 1
            elif not self._changed.wait_for(self._has_room, timeout):
                return False
            if self._closed:
                return False
            self._items.append(item)
            self._changed.notify_all()
            return True

    def get(self, timeout: float | None = None) -> Item | None:
        """Take the oldest item, waiting for one; None after timeout, or if closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._items or self._closed, timeout)
            if not self._items:
                return None
            item = self._items.popleft()
            self._changed.notify_all()
            return item

    def peek(self) -> Item | None:
        """Give the oldest item without taking it; None where nothing waits."""
        with self._changed:
            return self._items[0] if self._items else None

    @property
    def has_room(self) -> bool:
        """Whether ``put`` would not have to wait."""
        with self._changed:
            return self._drops or self._has_room()

    def clear(self) -> int:
        """Throw away what waits, and tell how many items that was."""
        with self._changed:
            count = len(self._items)
            self._items.clear()
            self._changed.notify_all()
            return count

    def close(self) -> None:
        """Take no more items and wake up who waits; what waits in the queue can still be got."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def __len__(self) -> int:
        """Count the items that wait."""
        with self._changed:
            return len(self._items)

    def _has_room(self) -> bool:
        return self._closed or len(self._items) < self._size
