"""
Recordings that are a row of compressed chunks (MCAP, ROS 1 bags), read in time order.

The storage readers of rosbags want a file that was closed properly, and decompress a chunk
without a bound. Recorders lose power, and files come from strangers; so here a file without an
index is walked from its start, everything before a break is delivered before the break is
reported, and no chunk takes more memory than LARGEST_PIECE. Memory holds a few chunks and, per
message that waits for its turn, its place; never the whole file.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection, Iterator
from functools import lru_cache
from heapq import heappop, heappush
from pathlib import Path
from typing import BinaryIO, NamedTuple

from djet_ros.recordings.storages.base import BrokenFile, Connection, LARGEST_PIECE

# Chunks of one recorder overlap by a message or two; more are open where tools merged topics.
OPEN_CHUNKS = 4
# Messages outside chunks are read in stretches of about this size.
STRETCH = 4 << 20


class Chunk(NamedTuple):
    """
    A stretch of the file whose messages are read at once.

    start: ns of its earliest message; offset, length: bytes in the file;
    loose: the records lie in the file as they are, without a chunk around them.
    """

    start: int
    offset: int
    length: int
    loose: bool = False


class Records(NamedTuple):
    """The unpacked records of a chunk, and how it is torn if some are missing at its end."""

    data: memoryview
    torn: str | None = None


class Place(NamedTuple):
    """Where a message lies: connection number, stamp in ns, first byte and end in its chunk."""

    connection: int
    stamp: int
    begin: int
    end: int


class ChunkedFile(ABC):
    """A recording of which subclasses know the records."""

    def __init__(self, path: Path) -> None:
        """Find the connections and chunks, by the index or by walking the whole file."""
        self.path = path
        self.size = path.stat().st_size
        self.connections: list[Connection] = []
        self._chunks: list[Chunk] = []
        self._counts: Counter[int] = Counter()
        self._broken: str | None = None
        with path.open('rb') as file:
            if not self._read_index(file):
                self._scan(file)

    @abstractmethod
    def _read_index(self, file: BinaryIO) -> bool:
        """Fill in connections and chunks from the index; False where it is absent or damaged."""

    def _scan(self, file: BinaryIO) -> None:
        """Fill in connections and chunks by walking the file up to its end or break."""
        self._chunks.clear()
        self._counts.clear()
        try:
            self._scan_records(file)
        except BrokenFile as error:
            self._broken = str(error)

    def _scan_chunk(self, file: BinaryIO, chunk: Chunk) -> None:
        """Take a chunk with what it tells of connections."""
        start = None
        # The chunk is kept even if the loop meets its break: what lies before that is good.
        try:
            for place in self._places(self._unpack(file, chunk), learn=True):
                self._counts[place.connection] += 1
                start = place.stamp if start is None else min(start, place.stamp)
        finally:
            if start is not None:
                self._chunks.append(chunk._replace(start=start))

    @abstractmethod
    def _scan_records(self, file: BinaryIO) -> None:
        """Walk the file anew, with ``_scan_chunk`` for its chunks; BrokenFile at its break."""

    @abstractmethod
    def _unpack(self, file: BinaryIO, chunk: Chunk) -> Records:
        """Unpack as much of a chunk as there is; BrokenFile where there is nothing."""

    @abstractmethod
    def _places(self, records: Records, learn: bool = False) -> Iterator[Place]:
        """
        Find the messages among records; BrokenFile after the last if some are missing.

        learn: whether to take what the records tell of connections, too.
        """

    def messages(self, wanted: Collection[int]) -> Iterator[tuple[int, int, memoryview]]:
        """
        Yield (connection number, stamp in ns, serialised message) in the order of stamps.

        After the last message before a break in the file, raises BrokenFile.
        """
        with self.path.open('rb') as file:
            chunks = sorted(self._chunks)
            unpacked = lru_cache(maxsize=OPEN_CHUNKS)(lambda n: self._unpack(file, chunks[n]))
            waiting: list[tuple[int, int, int, int, int]] = []
            broken = self._broken
            loaded = 0
            while True:
                while loaded < len(chunks) and (
                        not waiting or chunks[loaded].start <= waiting[0][0]):
                    try:
                        for place in self._places(unpacked(loaded)):
                            if place.connection in wanted:
                                heappush(waiting, (place.stamp, loaded, place.begin, place.end,
                                                   place.connection))
                    except BrokenFile as error:
                        broken = broken or str(error)
                        del chunks[loaded + 1:]
                    loaded += 1
                if not waiting:
                    break
                stamp, number, begin, end, connection = heappop(waiting)
                yield connection, stamp, unpacked(number).data[begin:end]
        if broken:
            raise BrokenFile(f'{broken}; everything before that was read')


def read_exactly(file: BinaryIO, offset: int, length: int) -> bytes:
    """Bytes of the file, never more than LARGEST_PIECE; BrokenFile where it ends before them."""
    if not 0 <= length <= LARGEST_PIECE or offset >= 2**63:
        raise BrokenFile(f'a record at byte {offset} declares {length} bytes')
    file.seek(offset)
    data = file.read(length)
    if len(data) < length:
        raise BrokenFile(f'it is cut short at byte {offset + len(data)}')
    return data
