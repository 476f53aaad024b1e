"""
Recordings that are a row of compressed chunks (MCAP, ROS 1 bags), read in time order.

The storage readers of rosbags want a file that was closed properly, and decompress a chunk
without a bound. Recorders lose power, and files come from strangers; so here a file without an
index is walked from its start, everything before a break is delivered before the break is
reported, and no chunk takes more memory than LARGEST_PIECE. Memory holds the chunks of which a
message waits for its turn, within bounds; never the whole file.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection, Iterator
from heapq import heappop, heappush
from pathlib import Path
from typing import BinaryIO, NamedTuple

from djet_ros.recordings.storages.base import BrokenFile, Connection, LARGEST_PIECE

# Chunks of one recorder overlap by a message or two; more are held where tools merged topics, or
# wrote one after the other. These are half a gigabyte of chunks, and 150 MB of messages' places.
MOST_HELD = 4 * LARGEST_PIECE
MOST_WAITING = 1 << 19
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


class Waiting:
    """Messages that wait for their turn, and the chunks that they keep in memory."""

    def __init__(self) -> None:
        self._heap: list[tuple[int, int, int, int, memoryview]] = []
        # Of each chunk: its size, and how many of its messages wait.
        self._sizes: dict[int, int] = {}
        self._counts: Counter[int] = Counter()
        self._held = 0

    def __bool__(self) -> bool:
        return bool(self._heap)

    def add(self, chunk: int, place: Place, data: memoryview) -> bool:
        """Take a message of a chunk, whose records are given; False where that is one too many."""
        heappush(self._heap, (place.stamp, chunk, place.begin, place.connection,
                              data[place.begin:place.end]))
        if chunk not in self._sizes:
            self._sizes[chunk] = len(data)
            self._held += len(data)
        self._counts[chunk] += 1
        return len(self._heap) <= MOST_WAITING and self._held <= MOST_HELD

    def first(self) -> int:
        """Give the earliest stamp, in ns."""
        return self._heap[0][0]

    def pop(self) -> tuple[int, int, memoryview]:
        """Take out the earliest: connection number, stamp in ns, serialised message."""
        stamp, chunk, _, connection, data = heappop(self._heap)
        self._counts[chunk] -= 1
        if not self._counts[chunk]:
            self._held -= self._sizes.pop(chunk)
            del self._counts[chunk]
        return connection, stamp, data


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
            waiting = Waiting()
            broken = self._broken
            loaded = 0
            while True:
                while loaded < len(chunks) and (
                        not waiting or chunks[loaded].start <= waiting.first()):
                    if torn := self._load(file, chunks[loaded], loaded, wanted, waiting):
                        broken = broken or torn
                        del chunks[loaded + 1:]
                    loaded += 1
                if not waiting:
                    break
                yield waiting.pop()
        if broken:
            raise BrokenFile(f'{broken}; everything before that was read')

    def _load(self, file: BinaryIO, chunk: Chunk, number: int, wanted: Collection[int],
              waiting: Waiting) -> str | None:
        """Let the messages of a chunk wait; give how it is broken, if it is."""
        full = False
        try:
            records = self._unpack(file, chunk)
            for place in self._places(records):
                if place.connection in wanted and not waiting.add(number, place, records.data):
                    full = True
                    break
        except BrokenFile as error:
            return str(error)
        if full:
            # What waits may belong after what was not read: none of it can be delivered.
            raise BrokenFile(
                f'its messages are so far out of order, at byte {chunk.offset}, that more than '
                f'{MOST_WAITING} of them or {MOST_HELD >> 20} MB of chunks would have to be held '
                'to sort them; everything before that was read')
        return None


def read_exactly(file: BinaryIO, offset: int, length: int) -> bytes:
    """Bytes of the file, never more than LARGEST_PIECE; BrokenFile where it ends before them."""
    if not 0 <= length <= LARGEST_PIECE or offset >= 2**63:
        raise BrokenFile(f'a record at byte {offset} declares {length} bytes')
    file.seek(offset)
    data = file.read(length)
    if len(data) < length:
        raise BrokenFile(f'it is cut short at byte {offset + len(data)}')
    return data
