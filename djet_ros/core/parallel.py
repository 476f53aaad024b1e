"""
Parallel execution in two threads, if OpenCV may use as many (``cv2.setNumThreads``).

NumPy and OpenCV release the interpreter lock while they work on larger arrays; the remaining
Python code makes more than two threads useless. Results are the same as in sequence.
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

# Kept alive, as starting a thread takes longer than most of these tasks.
_pool = ThreadPoolExecutor(4, 'djet')

# Whether the current task runs in the background already: no core is left for more.
_in_background = ContextVar('in_background', default=False)


def run_both(first: Callable[[], First], second: Callable[[], Second]) -> tuple[First, Second]:
    """Run two functions in parallel, the first of them in the calling thread."""
    if cv2.getNumThreads() < 2 or _in_background.get():
        return first(), second()
    later = _pool.submit(second)
    try:
        done = first()
    finally:
        # A task that no thread has started runs here, so no two can wait for one another.
        running = not later.cancel()
        if running:
            wait([later])
    return done, later.result() if running else second()


def map_parallel(work: Callable[[Task], Result], tasks: Sequence[Task]) -> list[Result]:
    """Map a function over many small tasks in two threads; results in the order of the tasks."""
    if len(tasks) < 2:
        return [work(task) for task in tasks]

    def share(first: int) -> list[Result]:
        return [work(task) for task in tasks[first::2]]

    shares = run_both(lambda: share(0), lambda: share(1))
    return [shares[i % 2][i // 2] for i in range(len(tasks))]


def start_in_background(work: Callable[[], Result]) -> Callable[[], Result]:
    """
    Start a function in the background; returns a function to call once for its result.

    With a single thread, or if no thread was free to start it, it runs when its result is
    requested.
    """
    if cv2.getNumThreads() < 2:
        return work

    def task() -> Result:
        token = _in_background.set(True)
        try:
            return work()
        finally:
            _in_background.reset(token)

    later = _pool.submit(task)
    return lambda: work() if later.cancel() else later.result()
