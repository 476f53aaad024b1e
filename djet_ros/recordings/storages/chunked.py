"""
Bags of compressed chunks (MCAP, ROS 1 bags), read in time order.

The readers of rosbags require a properly closed file, and decompress chunks without a size limit.
But recorders lose power, and files may be malicious. So here a file without an index is scanned
from its start, everything before a damage is delivered before it is reported, and no chunk takes
more memory than LARGEST_PIECE. Only chunks with pending messages are kept in memory, within
limits.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection, Iterator
from heapq import heappop, heappush
from pathlib import Path
from typing import BinaryIO, NamedTuple

from djet_ros.recordings.storages.base import BrokenFile, Connection, LARGEST_PIECE

# Limits for sorting: bytes of chunks held (half a gigabyte) and pending messages (150 MB of their
# positions). Chunks of one recorder overlap by a message or two; more are held if a tool merged
# topics, or wrote them one after the other.
MOST_HELD = 4 * LARGEST_PIECE
MOST_WAITING = 1 << 19
# Messages outside chunks are grouped to about this many bytes.
STRETCH = 4 << 20


class Chunk(NamedTuple):
    """
    A part of the file whose messages are read at once.

    start: stamp of its earliest message in ns; offset, length: bytes in the file; loose: whether
    the records are directly in the file, without a chunk around them.
    """

    start: int
    offset: int
    length: int
    loose: bool = False


class Records(NamedTuple):
    """The decompressed records of a chunk; torn: the damage, if some at its end are missing."""

    data: memoryview
    torn: str | None = None


class Place(NamedTuple):
    """Position of a message: connection number, stamp in ns, first byte and end in its chunk."""

    connection: int
    stamp: int
    begin: int
    end: int


class Waiting:
    """Priority queue of messages by stamp, and the chunks that they keep in memory."""

    def __init__(self) -> None:
        self._heap: list[tuple[int, int, int, int, memoryview]] = []
        # By chunk: its size in bytes, and its number of pending messages.
        self._sizes: dict[int, int] = {}
        self._counts: Counter[int] = Counter()
        self._held = 0

    def __bool__(self) -> bool:
        return bool(self._heap)

    def add(self, chunk: int, place: Place, data: memoryview) -> bool:
        """Add a message of a chunk; data: the chunk's records. Return False beyond a limit."""
        heappush(self._heap, (place.stamp, chunk, place.begin, place.connection,
                              data[place.begin:place.end]))
        if chunk not in self._sizes:
            self._sizes[chunk] = len(data)
            self._held += len(data)
        self._counts[chunk] += 1
        return len(self._heap) <= MOST_WAITING and self._held <= MOST_HELD

    def first(self) -> int:
        """Return the earliest stamp, in ns."""
        return self._heap[0][0]

    def pop(self) -> tuple[int, int, memoryview]:
        """Remove and return the earliest: connection number, stamp in ns, serialised message."""
        stamp, chunk, _, connection, data = heappop(self._heap)
        self._counts[chunk] -= 1
        if not self._counts[chunk]:
            self._held -= self._sizes.pop(chunk)
            del self._counts[chunk]
        return connection, stamp, data


class ChunkedFile(ABC):
    """Base of the readers of chunked files; subclasses know the format of records."""

    def __init__(self, path: Path) -> None:
        """Find the connections and chunks, by the index or by scanning the whole file."""
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
        """Read connections and chunks from the index; return False if it is absent or damaged."""

    def _scan(self, file: BinaryIO) -> None:
        """Find connections and chunks by scanning the file up to its end or a damage."""
        self._chunks.clear()
        self._counts.clear()
        try:
            self._scan_records(file)
        except BrokenFile as error:
            self._broken = str(error)

    def _scan_chunk(self, file: BinaryIO, chunk: Chunk) -> None:
        """Add a chunk and the connections that it declares."""
        start = None
        # A damaged chunk is kept too: its messages before the damage are valid.
        try:
            for place in self._places(self._unpack(file, chunk), learn=True):
                self._counts[place.connection] += 1
                start = place.stamp if start is None else min(start, place.stamp)
        finally:
            if start is not None:
                self._chunks.append(chunk._replace(start=start))

    @abstractmethod
    def _scan_records(self, file: BinaryIO) -> None:
        """Scan the file, with ``_scan_chunk`` for its chunks; raise BrokenFile at a damage."""

    @abstractmethod
    def _unpack(self, file: BinaryIO, chunk: Chunk) -> Records:
        """Decompress as much of a chunk as there is; raise BrokenFile if there is nothing."""

    @abstractmethod
    def _places(self, records: Records, learn: bool = False) -> Iterator[Place]:
        """
        Yield the messages among records; raise BrokenFile after the last if some are missing.

        learn: whether to add the connections that the records declare, too.
        """

    def messages(self, wanted: Collection[int]) -> Iterator[tuple[int, int, memoryview]]:
        """
        Yield (connection number, stamp in ns, serialised message) in the order of stamps.

        If the file is damaged, yields everything before the damage, then raises BrokenFile.
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
        """Queue the messages of a chunk; return the damage if it has one."""
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
            # Pending messages may be later than those not read: none of them can be delivered.
            raise BrokenFile(
                f'its messages are so far out of order, at byte {chunk.offset}, that sorting them '
                f'would take more than {MOST_WAITING} messages or {MOST_HELD >> 20} MB of chunks '
                'in memory; everything before that was read')
        return None


def read_exactly(file: BinaryIO, offset: int, length: int) -> bytes:
    """Return bytes of a file, at most LARGEST_PIECE; raise BrokenFile if it ends before them."""
    if not 0 <= length <= LARGEST_PIECE or offset >= 2**63:
        raise BrokenFile(f'a record at byte {offset} declares {length} bytes, at most '
                         f'{LARGEST_PIECE} are read')
    file.seek(offset)
    data = file.read(length)
    if len(data) < length:
        raise BrokenFile(f'it is cut short at byte {offset + len(data)}')
    return data
