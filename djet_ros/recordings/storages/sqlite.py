"""rosbag2's sqlite3 storage (.db3), with the schemas of all ROS 2 distributions."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import closing
from pathlib import Path
import sqlite3
import struct
from typing import Any, TypeAlias
from urllib.parse import quote

from djet_ros.recordings.storages.base import BrokenFile, Connection, LARGEST_PIECE, ros2_name

MAGIC = b'SQLite format 3\x00'

_TABLES = ('messages', 'topics', 'message_definitions')

_MESSAGE = 'SELECT topic_id, timestamp, data FROM messages WHERE rowid = ?'

Message: TypeAlias = tuple[int, int, memoryview]


class SqliteFile:
    """One rosbag2 database."""

    def __init__(self, path: Path) -> None:
        """Read the topics; raise BrokenFile if the file is no rosbag2 database."""
        self.path = path
        with closing(_connect(path)) as database:
            try:
                self.connections = self._read_topics(database)
            except sqlite3.Error as error:
                raise BrokenFile(str(error)) from error

    def _read_topics(self, database: sqlite3.Connection) -> list[Connection]:
        tables = _tables(database)
        if missing := {'topics', 'messages'} - tables:
            raise BrokenFile(f"it has no table '{min(missing)}': it was cut short, or not written "
                             'by rosbag2')
        # Message definitions are stored since ROS 2 Iron.
        definitions = dict(_bounded(database.execute(
            'SELECT topic_type, encoded_message_definition FROM message_definitions '
            "WHERE encoding = 'ros2msg'"))) if 'message_definitions' in tables else {}
        counts = _count(database)
        rows = list(_bounded(database.execute(
            'SELECT id, name, type, serialization_format FROM topics')))
        for row in rows:
            if not isinstance(row[0], int) or not all(isinstance(word, str) for word in row[1:]):
                raise BrokenFile(f"its table 'topics' holds the row {row!r:.80}")
        return [Connection(number, topic, ros2_name(msgtype), encoding,
                           str(definitions.get(msgtype, '')), counts.get(number, 0))
                for number, topic, msgtype, encoding in sorted(rows)]

    def messages(self, wanted: Collection[int]) -> Iterator[Message]:
        """
        Yield (connection number, stamp in ns, serialised message) in the order of stamps.

        If the file is damaged, yields everything before the damage, then raises BrokenFile.
        """
        messages = self._in_order(wanted)
        return _but_last_before_break(messages) if _ends_within_page(self.path) else messages

    def _in_order(self, wanted: Collection[int]) -> Iterator[Message]:
        # Only what is sorted is held, in memory or a temporary file: without an index, all of it.
        query = ('SELECT rowid FROM messages '
                 f'WHERE topic_id IN ({", ".join("?" * len(wanted))}) ORDER BY ')
        delivered = False
        with closing(_connect(self.path)) as database:
            # If the index by stamps is damaged but the messages are not: in recorded order.
            for order in ('timestamp, rowid', 'rowid'):
                try:
                    for row in database.execute(query + order, tuple(wanted)):
                        yield from map(_checked, database.execute(_MESSAGE, row))
                        delivered = True
                    return
                except sqlite3.Error as error:
                    if delivered or order == 'rowid':
                        raise BrokenFile(f'{error}; everything before that was read') from error


def _tables(database: sqlite3.Connection) -> set[str]:
    """
    Return the names of the tables of rosbag2's in a database.

    Raises BrokenFile if one has values that are not in the file but made up when they are read,
    without a limit: those of a virtual table, of a generated column, or a long default.
    """
    roots = dict(database.execute("SELECT name, rootpage FROM sqlite_master WHERE type = 'table' "
                                  f"AND name IN ({', '.join('?' * len(_TABLES))})", _TABLES))
    for name, root in roots.items():
        invented = database.execute('SELECT count(*) FROM pragma_table_xinfo(?) '
                                    'WHERE hidden OR length(dflt_value) > 99', (name,)).fetchone()
        if not root or invented != (0,):
            raise BrokenFile(f"its table '{name}' is not one of rosbag2's: it has values that are "
                             'not in the file')
    return set(roots)


def _bounded(rows: Iterator[tuple[Any, ...]]) -> Iterator[tuple[Any, ...]]:
    """Yield rows; raise BrokenFile if they exceed the limit of anything read at once."""
    size = 0
    for row in rows:
        size += sum(len(value) if isinstance(value, (str, bytes)) else 8 for value in row)
        if size > LARGEST_PIECE:
            raise BrokenFile(f'its topics and definitions exceed {LARGEST_PIECE} bytes')
        yield row


def _ends_within_page(path: Path) -> bool:
    with path.open('rb') as file:
        size, = struct.unpack_from('>H', file.read(18), 16)
    # The format writes 65536 as 1.
    return path.stat().st_size % (65536 if size == 1 else max(size, 1)) != 0


def _but_last_before_break(messages: Iterator[Message]) -> Iterator[Message]:
    """Drop the last message of a file truncated within a page, which sqlite fills with zeros."""
    held: list[Message] = []
    for message in messages:
        yield from held
        held = [message]
    yield from held


def _checked(row: tuple[Any, Any, Any]) -> Message:
    number, stamp, data = row
    if not isinstance(stamp, int) or not isinstance(data, bytes):
        raise BrokenFile(f"its table 'messages' holds the stamp {stamp!r:.40} with the data "
                         f'{data!r:.40}')
    return number, stamp, memoryview(data)


def _count(database: sqlite3.Connection) -> dict[int, int]:
    """Return messages per topic id; 1 each in a damaged file, which can't be counted."""
    try:
        return dict(_bounded(database.execute(
            'SELECT topic_id, count(*) FROM messages GROUP BY topic_id')))
    except sqlite3.DatabaseError:
        return dict.fromkeys((number for number, in database.execute('SELECT id FROM topics')), 1)


def _connect(path: Path) -> sqlite3.Connection:
    """Open a database read-only; raise BrokenFile if it can't be."""
    try:
        try:
            return _opened(path, 'mode=ro')
        except sqlite3.OperationalError:
            # A killed recorder leaves a journal, which a reader must not roll back.
            return _opened(path, 'immutable=1')
    except sqlite3.Error as error:
        raise BrokenFile(str(error)) from error


def _opened(path: Path, mode: str) -> sqlite3.Connection:
    database = sqlite3.connect(f'file:{quote(str(path.resolve()))}?{mode}', uri=True)
    try:
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LARGEST_PIECE)
        database.execute('PRAGMA trusted_schema = OFF')
        # Reads a truncated file as far as it goes.
        database.execute('PRAGMA writable_schema = ON')
        database.execute('SELECT count(*) FROM sqlite_master').fetchone()
    except sqlite3.Error:
        database.close()
        raise
    return database
