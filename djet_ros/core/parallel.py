"""
Work side by side in two threads, if OpenCV may take as many (``cv2.setNumThreads``).

NumPy and OpenCV let go of the interpreter while they work on arrays of some size; what is left
to the interpreter keeps more than two threads from being of use. Results are those of doing
things in turn.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextvars import ContextVar
from typing import TypeVar

import cv2

First = TypeVar('First')
Second = TypeVar('Second')
Task = TypeVar('Task')
Result = TypeVar('Result')

# Kept, as it takes longer to make a thread than to do much of what these do.
_others = ThreadPoolExecutor(4, 'djet')

# Whether this is something that was begun beside something else: no core is left for more.
_beside = ContextVar('beside', default=False)


def both(first: Callable[[], First], second: Callable[[], Second]) -> tuple[First, Second]:
    """Do two things at once, the first of them in the calling thread."""
    if cv2.getNumThreads() < 2 or _beside.get():
        return first(), second()
    later = _others.submit(second)
    try:
        done = first()
    finally:
        # What nobody has begun is done here: so no two can wait for one another.
        begun = not later.cancel()
        if begun:
            wait([later])
    return done, later.result() if begun else second()


def each(work: Callable[[Task], Result], tasks: Sequence[Task]) -> list[Result]:
    """Do the same with each of many small tasks, in two shares; results in their order."""
    if len(tasks) < 2:
        return [work(task) for task in tasks]

    def share(first: int) -> list[Result]:
        return [work(task) for task in tasks[first::2]]

    shares = both(lambda: share(0), lambda: share(1))
    return [shares[i % 2][i // 2] for i in range(len(tasks))]


def started_beside(work: Callable[[], Result]) -> Callable[[], Result]:
    """
    Start something that is needed later; gives what waits for its result, to be called once.

    Where there is one thread, or none had time to begin it, it is done when it is needed.
    """
    if cv2.getNumThreads() < 2:
        return work

    def beside() -> Result:
        token = _beside.set(True)
        try:
            return work()
        finally:
            _beside.reset(token)

    later = _others.submit(beside)
    return lambda: work() if later.cancel() else later.result()
