"""Chunks of pairs on workers, of this machine or of a Dask cluster, and their results."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import (
    BrokenExecutor,
    Executor,
    FIRST_COMPLETED,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import contextmanager
from multiprocessing import active_children, parent_process, resource_tracker
from multiprocessing.context import SpawnContext, SpawnProcess
import os
import signal
from threading import current_thread, main_thread, Thread
from typing import Any, Protocol, TypeVar

from djet_ros import threads
from djet_ros.errors import DjetError
from djet_ros.lab.pairs import PairChunk
from djet_ros.lab.sequences import Dataset
from djet_ros.lab.store import in_order, RecordStore

# Few enough that a broken run loses little, enough that features of the first frame don't count.
PAIRS_PER_CHUNK = 5

# For which Ctrl-C may go unheard.
_SECONDS_UNHEARD = 1.0


class Chunk(Protocol):
    """Some pairs that are worked on together."""

    @property
    def name(self) -> str:
        """Name that is the same in every run."""

    @property
    def count(self) -> int:
        """How many pairs there are."""


C = TypeVar('C', bound=Chunk)
R = TypeVar('R')


def chunks_of(datasets: Sequence[Dataset], most: int = PAIRS_PER_CHUNK) -> list[PairChunk]:
    """Cut the pairs of all datasets into chunks of at most so many."""
    return [PairChunk(dataset, first, min(most, dataset.pairs - first))
            for dataset in datasets for first in range(0, dataset.pairs, most)]


def run(executor: Executor, chunks: Sequence[C], work: Callable[[C], list[R]],
        store: RecordStore[R], progress: Callable[[int, int], None]) -> list[R]:
    """
    Do the work of all chunks that the store does not have; gives all records in a fixed order.

    progress is called with (pairs done, pairs in all). Raises DjetError where a worker died;
    what was done until then is in the store.
    """
    total = sum(chunk.count for chunk in chunks)
    missing = [chunk for chunk in chunks if chunk.name not in store.chunks]
    done = total - sum(chunk.count for chunk in missing)
    progress(done, total)
    futures = {executor.submit(work, chunk): chunk for chunk in missing}
    try:
        for future in _as_they_end(futures):
            chunk = futures[future]
            store.add(chunk.name, future.result())
            done += chunk.count
            progress(done, total)
    except BrokenExecutor as error:
        raise DjetError('a worker died (killed, or out of memory); run the same command again: '
                        f'{store.path} keeps what was done') from error
    finally:
        _keep_finished(futures, store)
    return in_order(store, (chunk.name for chunk in chunks))


def _as_they_end(futures: Iterable[Future[R]]) -> Iterator[Future[R]]:
    """
    Give futures as they end.

    The system may hand Ctrl-C to any thread, and does not wake the first one for it: it has to
    wake by itself to hear of it.
    """
    left = set(futures)
    while left:
        ended, left = wait(left, _SECONDS_UNHEARD, FIRST_COMPLETED)
        yield from ended


def _keep_finished(futures: dict[Future[list[R]], C], store: RecordStore[R]) -> None:
    for future, chunk in futures.items():
        if chunk.name not in store.chunks and future.done() and not future.cancelled() \
                and future.exception() is None:
            store.add(chunk.name, future.result())


@contextmanager
def local_workers(count: int | None = None) -> Iterator[Executor]:
    """
    Give an executor of processes on this machine, by default one per core, one thread each.

    Ctrl-C ends them, in the middle of their chunks; after another error no new chunk begins.
    """
    # Set before the workers import NumPy; equal thread counts also keep its sums equal.
    os.environ.update(dict.fromkeys(threads.VARIABLES, '1'))
    # Starting it lets SIGINT through, which is not to be while a worker starts.
    resource_tracker.ensure_running()
    others = set(active_children())
    with _Pool(count, _Workers(), _follow_parent) as executor:
        try:
            yield executor
        except KeyboardInterrupt:
            # Before its futures are cancelled: it cannot tell a cancelled one that workers died.
            for worker in set(active_children()) - others:
                worker.terminate()
            raise
        finally:
            executor.shutdown(cancel_futures=True)


class _Pool(ProcessPoolExecutor):
    """Processes of which none is left half started by Ctrl-C."""

    def submit(self, *args: Any, **kwargs: Any) -> Future[Any]:
        with _interrupt_after():
            return super().submit(*args, **kwargs)


@contextmanager
def _interrupt_after() -> Iterator[None]:
    """Let Ctrl-C, SIGTERM and SIGHUP wait for the end of this block."""
    if current_thread() is not main_thread():
        # Python interrupts no other.
        yield
        return
    seen: list[int] = []
    before = {number: signal.signal(number, lambda number, _: seen.append(number))
              for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if seen:
        signal.raise_signal(seen[0])


class _Worker(SpawnProcess):
    """A process that leaves Ctrl-C to its parent, from its first instruction on."""

    def start(self) -> None:
        # It inherits what is blocked.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            super().start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


class _Workers(SpawnContext):
    Process = _Worker


@contextmanager
def dask_workers(address: str) -> Iterator[Executor]:
    """
    Give an executor that hands work to a Dask cluster by the address of its scheduler.

    Its workers need this package and must see the datasets under the same paths. DjetError where
    no scheduler answers.
    """
    from distributed import Client

    try:
        client = Client(address, timeout='10s', set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise DjetError(f"no Dask scheduler answers at '{address}': {error}") from error
    with client:
        yield client.get_executor()


def _follow_parent() -> None:
    """End with the parent, even where it was killed."""
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        # A pool's worker would wait for its next chunk for ever.
        os._exit(1)
