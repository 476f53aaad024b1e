"""MCAP files (https://mcap.dev/spec): the usual storage of ROS 2 recordings."""

from __future__ import annotations

from binascii import crc32
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
import struct
from typing import BinaryIO

from djet_ros.recordings.storages.base import BrokenFile, Connection, ros2_name
from djet_ros.recordings.storages.chunked import (
    Chunk,
    ChunkedFile,
    Place,
    read_exactly,
    Records,
    STRETCH,
)
from djet_ros.recordings.storages.compression import decompress

MAGIC = b'\x89MCAP0\r\n'
FOOTER_SIZE = 9 + 20 + len(MAGIC)

FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK = 0x02, 0x03, 0x04, 0x05, 0x06
CHUNK_INDEX, STATISTICS, DATA_END = 0x08, 0x0B, 0x0F
# Codes from 0x80 are free for anybody's records; these are the ones that the format defines.
LAST_DEFINED, FIRST_FREE = 0x0F, 0x80

RECORD = struct.Struct('<BQ')
MESSAGE_HEAD = struct.Struct('<HIQQ')


class McapFile(ChunkedFile):
    """One MCAP file, with or without index, complete or truncated."""

    def __init__(self, path: Path) -> None:
        """Read the index, or scan the file if it has none."""
        self._schemas: dict[int, tuple[str, str]] = {}
        self._channels: dict[int, tuple[int, str, str]] = {}
        super().__init__(path)
        self.connections = [self._connection(*item) for item in sorted(self._channels.items())]

    def _connection(self, number: int, channel: tuple[int, str, str]) -> Connection:
        schema, topic, encoding = channel
        msgtype, definition = self._schemas.get(schema, ('', ''))
        return Connection(number, topic, ros2_name(msgtype), encoding, definition,
                          self._counts[number])

    def _read_index(self, file: BinaryIO) -> bool:
        footer_start = self.size - FOOTER_SIZE
        if footer_start < len(MAGIC):
            return False
        footer = read_exactly(file, footer_start, FOOTER_SIZE)
        code, length, summary_start = struct.unpack_from('<BQQ', footer)
        if (code, length) != (FOOTER, 20) or not footer.endswith(MAGIC):
            return False
        if not len(MAGIC) < summary_start < footer_start:
            return False
        try:
            return self._read_summary(read_exactly(file, summary_start,
                                                   footer_start - summary_start))
        except BrokenFile:
            return False

    def _read_summary(self, summary: bytes) -> bool:
        """Read the summary section; return False if it does not account for every message."""
        total, schemas, channels, indexed = -1, -1, -1, 0
        for code, begin, end in split_records(Records(memoryview(summary))):
            fields = Fields(summary[begin:end])
            if code in (SCHEMA, CHANNEL):
                self._learn(code, fields)
            elif code == CHUNK_INDEX:
                start, _, offset, length = fields.unpack('<QQQQ')
                offsets = len(fields.blob()) // 10
                # Each message index is a record of 15 bytes and 16 more per message.
                indexed += (fields.unpack('<Q')[0] - 15 * offsets) // 16
                self._chunks.append(Chunk(start, offset + RECORD.size, length - RECORD.size))
            elif code == STATISTICS:
                total, schemas, channels = fields.unpack('<QHI')
                fields.unpack('<IIIQQ')
                self._counts = Counter(dict(struct.iter_unpack('<HQ', fields.blob(multiple=10))))
        # The file has an entry for each message, and may leave out the counts by channel.
        return ((total, schemas, channels)
                == (indexed, len(self._schemas), len(self._channels))
                and total == self._counts.total() <= self.size)

    def _scan_records(self, file: BinaryIO) -> None:
        self._schemas.clear()
        self._channels.clear()
        position = len(MAGIC)
        while True:
            code, length = RECORD.unpack(read_exactly(file, position, RECORD.size))
            begin = position + RECORD.size
            position = begin + length
            if code in (DATA_END, FOOTER):
                return
            if not (0 < code <= LAST_DEFINED or code >= FIRST_FREE):
                raise BrokenFile(f'there is no record at byte {begin - RECORD.size}')
            if code == CHUNK:
                self._scan_chunk(file, Chunk(0, begin, min(length, self.size - begin)))
            elif code in (SCHEMA, CHANNEL):
                self._learn(code, Fields(read_exactly(file, begin, length)))
            if position > self.size:
                raise BrokenFile(f'it is cut short at byte {self.size}')
            if code == MESSAGE:
                self._add_loose(Place(*_message(read_exactly(file, begin, MESSAGE_HEAD.size), 0),
                                      begin - RECORD.size, position))

    def _add_loose(self, place: Place) -> None:
        """Add a message outside chunks to the last group of them, or begin a new one."""
        self._counts[place.connection] += 1
        last = self._chunks[-1] if self._chunks else None
        if (last and last.loose and last.offset + last.length == place.begin
                and last.length < STRETCH):
            self._chunks[-1] = Chunk(min(last.start, place.stamp), last.offset,
                                     place.end - last.offset, loose=True)
        else:
            self._chunks.append(Chunk(place.stamp, place.begin, place.end - place.begin,
                                      loose=True))

    def _learn(self, code: int, fields: Fields) -> None:
        if code == SCHEMA:
            number, = fields.unpack('<H')
            msgtype, encoding, definition = fields.text(), fields.text(), fields.text()
            known = encoding in ('ros2msg', 'ros1msg')
            self._schemas[number] = (msgtype, definition if known else '')
        else:
            number, schema = fields.unpack('<HH')
            self._channels[number] = (schema, fields.text(), fields.text())

    def _unpack(self, file: BinaryIO, chunk: Chunk) -> Records:
        data = read_exactly(file, chunk.offset, chunk.length)
        if chunk.loose:
            return Records(memoryview(data))
        fields = Fields(data)
        _, _, size, crc = fields.unpack('<QQQI')
        compression = fields.text()
        fields.unpack('<Q')
        records = decompress(fields.rest(), compression, size)
        if len(records) < size:
            return Records(records, f'the chunk at byte {chunk.offset} is cut short')
        if crc and crc32(records) != crc:
            raise BrokenFile(f'the chunk at byte {chunk.offset} does not match its checksum')
        return Records(records)

    def _places(self, records: Records, learn: bool = False) -> Iterator[Place]:
        for code, begin, end in split_records(records):
            if learn and code in (SCHEMA, CHANNEL):
                self._learn(code, Fields(bytes(records.data[begin:end])))
            elif code == MESSAGE:
                yield Place(*_message(records.data, begin), begin + MESSAGE_HEAD.size, end)


class Fields:
    """Sequential reader of the fields of a record; raises BrokenFile at its end."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._position = 0

    def unpack(self, layout: str) -> tuple[int, ...]:
        """Read the integers of a struct layout."""
        return struct.unpack(layout, self._take(struct.calcsize(layout)))

    def blob(self, multiple: int = 1) -> bytes:
        """Read bytes preceded by their length, which must be a multiple of ``multiple``."""
        size, = self.unpack('<I')
        if size % multiple:
            raise BrokenFile(f'a list of {multiple}-byte entries has {size} bytes')
        return self._take(size)

    def text(self) -> str:
        """Read UTF-8 text preceded by its length."""
        try:
            return self.blob().decode()
        except UnicodeDecodeError as error:
            raise BrokenFile('a name in it is not text') from error

    def rest(self) -> memoryview:
        """Return everything that was not read yet."""
        return memoryview(self._data)[self._position:]

    def _take(self, size: int) -> bytes:
        begin, self._position = self._position, self._position + size
        if self._position > len(self._data):
            raise BrokenFile('a record in it is shorter than its fields')
        return self._data[begin:self._position]


def split_records(records: Records) -> Iterator[tuple[int, int, int]]:
    """Yield (code, first byte, end) of each record; raise BrokenFile after the last if torn."""
    data, torn = records
    position = 0
    while position + RECORD.size <= len(data):
        code, length = RECORD.unpack_from(data, position)
        end = position + RECORD.size + length
        if end > len(data):
            break
        yield code, position + RECORD.size, end
        position = end
    if torn or position < len(data):
        raise BrokenFile(torn or 'a chunk ends within a record')


def _message(records: bytes | memoryview, begin: int) -> tuple[int, int]:
    """Return channel and log time of the message record whose fields begin there."""
    if begin + MESSAGE_HEAD.size > len(records):
        raise BrokenFile('a message record is too short')
    channel, _, stamp, _ = MESSAGE_HEAD.unpack_from(records, begin)
    return channel, stamp
