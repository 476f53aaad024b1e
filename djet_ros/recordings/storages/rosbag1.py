"""ROS 1 bags, format 2.0 (http://wiki.ros.org/Bags/Format/2.0)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
import struct
from typing import BinaryIO

from djet_ros.recordings.storages.base import BrokenFile, Connection, ros2_name
from djet_ros.recordings.storages.chunked import Chunk, ChunkedFile, Place, read_exactly, Records
from djet_ros.recordings.storages.compression import decompress

MAGIC = b'#ROSBAG V2.0\n'

MESSAGE, BAG_HEADER, INDEX, CHUNK, CHUNK_INFO, CONNECTION = 2, 3, 4, 5, 6, 7

UINT32 = struct.Struct('<I')


class Ros1File(ChunkedFile):
    """One ROS 1 bag, with or without index (``.bag.active``), complete or truncated."""

    def __init__(self, path: Path) -> None:
        """Read the index, or scan the file if it has none."""
        self._topics: dict[int, tuple[str, str, str]] = {}
        super().__init__(path)
        self.connections = [
            Connection(number, topic, ros2_name(msgtype), 'ros1', definition,
                       self._counts[number])
            for number, (topic, msgtype, definition) in sorted(self._topics.items())]

    def _read_index(self, file: BinaryIO) -> bool:
        try:
            header, _, _ = _read_record(file, len(MAGIC))
            position, = _field(header, 'index_pos', '<Q')
            if not len(MAGIC) < position <= self.size:
                return False
            while position < self.size:
                header, begin, length = _read_record(file, position)
                data = read_exactly(file, begin, length)
                position = begin + length
                if _code(header) == CONNECTION:
                    self._learn(header, memoryview(data))
                elif _code(header) == CHUNK_INFO:
                    self._add_indexed(file, header, data)
            connections, chunks = (_field(_read_record(file, len(MAGIC))[0], name, '<I')[0]
                                   for name in ('conn_count', 'chunk_count'))
        except BrokenFile:
            return False
        return (connections, chunks) == (len(self._topics), len(self._chunks))

    def _add_indexed(self, file: BinaryIO, header: dict[str, bytes], counts: bytes) -> None:
        offset, = _field(header, 'chunk_pos', '<Q')
        start = _time(header, 'start_time')
        _, begin, length = _read_record(file, offset)
        self._chunks.append(Chunk(start, offset, begin + length - offset))
        for number, count in struct.iter_unpack('<II', counts[:len(counts) // 8 * 8]):
            self._counts[number] += count

    def _scan_records(self, file: BinaryIO) -> None:
        self._topics.clear()
        position = len(MAGIC)
        while True:
            header, begin, length = _read_record(file, position)
            code, end = _code(header), begin + length
            if code == CHUNK:
                self._scan_chunk(file, Chunk(0, position, min(end, self.size) - position))
            elif code in (CONNECTION, CHUNK_INFO):
                # The index repeats what was in the chunks.
                return
            elif code not in (BAG_HEADER, INDEX):
                raise BrokenFile(f'there is a record of kind {code} at byte {position}')
            position = end

    def _learn(self, header: dict[str, bytes], data: memoryview) -> None:
        number, = _field(header, 'conn', '<I')
        details = _fields(data)
        self._topics[number] = (_text(header, 'topic'), _text(details, 'type'),
                                _text(details, 'message_definition'))

    def _unpack(self, file: BinaryIO, chunk: Chunk) -> Records:
        header, begin, _ = _read_record(file, chunk.offset)
        if _code(header) != CHUNK:
            raise BrokenFile(f'there is no chunk at byte {chunk.offset}')
        size, = _field(header, 'size', '<I')
        data = read_exactly(file, begin, chunk.offset + chunk.length - begin)
        records = decompress(data, _text(header, 'compression'), size)
        if len(records) < size:
            return Records(records, f'the chunk at byte {chunk.offset} is cut short')
        return Records(records)

    def _places(self, records: Records, learn: bool = False) -> Iterator[Place]:
        for header, begin, end in _split_records(records):
            if learn and _code(header) == CONNECTION:
                self._learn(header, records.data[begin:end])
            elif _code(header) == MESSAGE:
                yield Place(_field(header, 'conn', '<I')[0], _time(header, 'time'), begin, end)


def _read_record(file: BinaryIO, position: int) -> tuple[dict[str, bytes], int, int]:
    """Return header, first data byte and data length of the record at a position."""
    size, = UINT32.unpack(read_exactly(file, position, UINT32.size))
    header = _fields(memoryview(read_exactly(file, position + UINT32.size, size)))
    begin = position + UINT32.size + size
    length, = UINT32.unpack(read_exactly(file, begin, UINT32.size))
    return header, begin + UINT32.size, length


def _split_records(records: Records) -> Iterator[tuple[dict[str, bytes], int, int]]:
    """Yield (header, first byte, end) of each record; raise BrokenFile after the last if torn."""
    data, torn = records
    position = 0
    while position < len(data):
        try:
            header_begin, header_end = _counted(data, position)
            begin, position = _counted(data, header_end)
            header = _fields(data[header_begin:header_end])
        except BrokenFile as error:
            raise BrokenFile(torn or str(error)) from error
        yield header, begin, position
    if torn:
        raise BrokenFile(torn)


def _fields(data: memoryview) -> dict[str, bytes]:
    """Return the fields ``name=value`` of a header, each preceded by its length."""
    fields = {}
    position = 0
    while position < len(data):
        begin, position = _counted(data, position)
        name, _, value = bytes(data[begin:position]).partition(b'=')
        fields[name.decode('ascii', 'replace')] = value
    return fields


def _counted(data: memoryview, position: int) -> tuple[int, int]:
    """Return first byte and end of bytes that are preceded by their length."""
    begin = position + UINT32.size
    if begin > len(data):
        raise BrokenFile('a chunk or header ends within a length')
    end = begin + UINT32.unpack_from(data, position)[0]
    if end > len(data):
        raise BrokenFile('a chunk or header ends within a record')
    return begin, end


def _field(header: dict[str, bytes], name: str, layout: str) -> tuple[int, ...]:
    try:
        return struct.unpack(layout, header[name])
    except (KeyError, struct.error) as error:
        raise BrokenFile(f"a record has no proper field '{name}'") from error


def _code(header: dict[str, bytes]) -> int:
    return _field(header, 'op', '<B')[0]


def _time(header: dict[str, bytes], name: str) -> int:
    seconds, nanoseconds = _field(header, name, '<II')
    return seconds * 10**9 + nanoseconds


def _text(header: dict[str, bytes], name: str) -> str:
    try:
        return header[name].decode()
    except (KeyError, UnicodeDecodeError) as error:
        raise BrokenFile(f"a record has no proper field '{name}'") from error
