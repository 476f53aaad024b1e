"""
Work side by side in two threads, if OpenCV may take as many (``cv2.setNumThreads``).

NumPy and OpenCV let go of the interpreter while they work on arrays of some size; what is left
to the interpreter keeps more than two threads from being of use. Results are those of doing
things in turn.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import cv2

First = TypeVar('First')
Second = TypeVar('Second')
Task = TypeVar('Task')
Result = TypeVar('Result')


def both(first: Callable[[], First], second: Callable[[], Second]) -> tuple[First, Second]:
    """Do two things at once, the first of them in the calling thread."""
    if cv2.getNumThreads() < 2:
        return first(), second()
    with ThreadPoolExecutor(1) as other:
        later = other.submit(second)
        return first(), later.result()


def each(work: Callable[[Task], Result], tasks: Sequence[Task]) -> list[Result]:
    """Do the same with each of many small tasks, in two shares; results in their order."""
    if len(tasks) < 2:
        return [work(task) for task in tasks]

    def share(first: int) -> list[Result]:
        return [work(task) for task in tasks[first::2]]

    shares = both(lambda: share(0), lambda: share(1))
    return [shares[i % 2][i // 2] for i in range(len(tasks))]
