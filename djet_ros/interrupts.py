"""Signals that end a program, held back while something must be done as a whole."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import signal
from threading import current_thread, main_thread

# Ctrl-C, an orderly end, and the end of the terminal.
_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@contextmanager
def interrupt_after() -> Iterator[None]:
    """Defer Ctrl-C, SIGTERM and SIGHUP to the end of this block; blocks may be nested."""
    if current_thread() is not main_thread():
        # Python handles signals in the main thread only.
        yield
        return
    seen: list[int] = []
    before = {number: signal.signal(number, lambda number, _: seen.append(number))
              for number in _ENDING}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if seen:
        signal.raise_signal(seen[0])
