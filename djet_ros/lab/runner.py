"""Distribution of chunks of pairs over workers, on this machine or a Dask cluster."""

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
from threading import Thread
from typing import Any, Protocol, TypeVar

from djet_ros import threads
from djet_ros.errors import DjetError
from djet_ros.interrupts import interrupt_after
from djet_ros.lab.pairs import PairChunk
from djet_ros.lab.sequences import Dataset
from djet_ros.lab.store import in_order, RecordStore

# Few enough that an interrupted run loses little; enough to amortise the features of the first
# frame.
PAIRS_PER_CHUNK = 5

# Longest delay in seconds of the reaction to Ctrl-C.
_SIGNAL_DELAY_S = 0.2


class Chunk(Protocol):
    """Some pairs that are processed together."""

    @property
    def name(self) -> str:
        """Return a name that is the same in every run."""

    @property
    def count(self) -> int:
        """Return the number of pairs."""


C = TypeVar('C', bound=Chunk)
R = TypeVar('R')


def chunks_of(datasets: Sequence[Dataset], most: int = PAIRS_PER_CHUNK) -> list[PairChunk]:
    """Split the pairs of all datasets into chunks of at most ``most`` pairs."""
    return [PairChunk(dataset, first, min(most, dataset.pairs - first))
            for dataset in datasets for first in range(0, dataset.pairs, most)]


def run(executor: Executor, chunks: Sequence[C], work: Callable[[C], list[R]],
        store: RecordStore[R], progress: Callable[[int, int], None]) -> list[R]:
    """
    Process all chunks that the store does not have, and return all records in a fixed order.

    progress is called with (pairs done, total). Raises DjetError if a worker died; finished chunks
    are in the store.
    """
    total = sum(chunk.count for chunk in chunks)
    missing = [chunk for chunk in chunks if chunk.name not in store.chunks]
    done = total - sum(chunk.count for chunk in missing)
    progress(done, total)
    futures = {executor.submit(work, chunk): chunk for chunk in missing}
    try:
        for future in as_completed(futures):
            chunk = futures[future]
            store.add(chunk.name, future.result())
            done += chunk.count
            progress(done, total)
    except BrokenExecutor as error:
        raise DjetError('a worker died (killed, or out of memory); run the same command again to '
                        f'resume: finished pairs are in {store.path}') from error
    finally:
        _keep_finished(futures, store)
    return in_order(store, (chunk.name for chunk in chunks))


def as_completed(futures: Iterable[Future[R]]) -> Iterator[Future[R]]:
    """
    Yield futures as they complete.

    The system may deliver Ctrl-C to any thread without waking the main one, which therefore wakes
    regularly to handle it. Not inside of ``wait``: an exception there may leave a future locked,
    and the pool would wait for it forever.
    """
    left = set(futures)
    while left:
        with interrupt_after():
            ended, left = wait(left, _SIGNAL_DELAY_S, FIRST_COMPLETED)
        yield from ended


def _keep_finished(futures: dict[Future[list[R]], C], store: RecordStore[R]) -> None:
    for future, chunk in futures.items():
        if chunk.name not in store.chunks and future.done() and not future.cancelled() \
                and future.exception() is None:
            store.add(chunk.name, future.result())


@contextmanager
def local_workers(count: int | None = None) -> Iterator[Executor]:
    """
    Yield an executor of processes on this machine, by default one per core, one thread each.

    Ctrl-C terminates them immediately; after another error no new chunk starts.
    """
    # Set before the workers import NumPy; a fixed thread count also makes its sums reproducible.
    os.environ.update(dict.fromkeys(threads.VARIABLES, '1'))
    # Started now, because its start unblocks SIGINT, which must stay blocked while workers start.
    resource_tracker.ensure_running()
    others = set(active_children())
    with _Pool(count, _Workers(), _follow_parent) as executor:
        try:
            yield executor
        except KeyboardInterrupt:
            # Before the futures are cancelled: the pool can't set an exception on cancelled ones.
            for worker in set(active_children()) - others:
                worker.terminate()
            raise
        finally:
            executor.shutdown(cancel_futures=True)


class _Pool(ProcessPoolExecutor):
    """Pool that defers Ctrl-C while a worker starts."""

    def submit(self, *args: Any, **kwargs: Any) -> Future[Any]:
        with interrupt_after():
            return super().submit(*args, **kwargs)


class _Worker(SpawnProcess):
    """Process that ignores Ctrl-C, which its parent handles."""

    def start(self) -> None:
        # The process inherits the signal mask.
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
    Yield an executor on a Dask cluster, by the address of its scheduler.

    Its workers need this package, and the datasets under the same paths. Raises DjetError if no
    scheduler answers.
    """
    from distributed import Client

    try:
        client = Client(address, timeout='10s', set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise DjetError(f"no Dask scheduler answers at '{address}': {error}") from error
    with client:
        yield client.get_executor()


def _follow_parent() -> None:
    """End this process with its parent, even if the parent was killed."""
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        # The worker of a pool would wait for its next chunk forever.
        os._exit(1)
