"""Reading bags: rosbag2 folders and files, and ROS 1 bags, as one stream of messages."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import contextmanager, ExitStack
from pathlib import Path, PurePosixPath
import re
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from djet_ros.config.safe_files import read_yaml
from djet_ros.errors import DjetError, one_line
from djet_ros.recordings.closing import Closing
from djet_ros.recordings.decoding import Decoder, decoder
from djet_ros.recordings.storages import BrokenFile, Connection, open_storage, Storage
from djet_ros.recordings.storages.compression import decompress_file, ZSTD_MAGIC
from djet_ros.recordings.text import by_numbers

# Stamps of ROS have seconds of 32 bits, since 1970.
_STAMPS_END = 2**31 * 10**9

STORAGE_NAMES = re.compile(r'.*\.(mcap|db3)(\.zstd)?')


class Topic(NamedTuple):
    """A topic of a bag: its name, its type and how many messages it has."""

    name: str
    msgtype: str
    message_count: int


class BagMessage(NamedTuple):
    """One message: its topic, the time in ns at which it was recorded, and the Jazzy object."""

    topic: str
    stamp_ns: int
    message: Any


class Bag(Closing):
    """
    A bag, read as a stream: only a few messages are in memory at any time.

    Opens a rosbag2 folder (with or without metadata.yaml), one of its files (.mcap, .db3, also
    .zstd), or a ROS 1 bag; raises DjetError if the path is none of these. Close it, or use it in
    a ``with`` statement: of a bag with file compression, one file at a time is unpacked to a
    temporary folder.
    """

    def __init__(self, path: Path) -> None:
        """Open the files and list the topics."""
        self.path = path
        self._stack = ExitStack()
        self._scratch: Path | None = None
        try:
            with _naming_errors(path):
                files = _files(path)
            self._storages = [(file, self._opened(file)) for file in files]
        except BaseException:
            self.close()
            raise
        counts: Counter[tuple[str, str]] = Counter()
        for _, storage in self._storages:
            for connection in storage.connections:
                counts[connection.topic, connection.msgtype] += connection.message_count
        self.topics = [Topic(*key, count) for key, count in sorted(counts.items())]

    def messages(self, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
        """
        Yield the messages of some topics (default: all) in recorded order.

        If the bag is damaged, yields everything before the damage, then raises DjetError.
        """
        for file, storage in self._storages:
            chosen = {connection.number: connection for connection in storage.connections
                      if topics is None or connection.topic in topics}
            with _naming_errors(file):
                # Another file may have replaced it since.
                self._unpacked(file)
                yield from _decoded(storage, chosen)

    def close(self) -> None:
        """Remove the unpacked file."""
        self._stack.close()

    def _opened(self, file: Path) -> Storage:
        with _naming_errors(file):
            return open_storage(self._unpacked(file))

    def _unpacked(self, file: Path) -> Path:
        """Return the file or, if it is compressed, an unpacked copy, which replaces the last."""
        with file.open('rb') as stream:
            if stream.read(len(ZSTD_MAGIC)) != ZSTD_MAGIC:
                return file
        if self._scratch is None:
            self._scratch = Path(self._stack.enter_context(TemporaryDirectory(prefix='djet-')))
        if not (self._scratch / file.name).exists():
            for other in self._scratch.iterdir():
                other.unlink()
            decompress_file(file, self._scratch)
        return self._scratch / file.name


def is_bag(path: Path) -> bool:
    """Return whether a path is taken for a bag: any file, or a folder with files of a bag."""
    return path.is_file() or (path.is_dir() and (
        (path / 'metadata.yaml').exists() or bool(_storage_files(path))))


@contextmanager
def _naming_errors(path: Path) -> Iterator[None]:
    """Convert errors to DjetError that names the file."""
    try:
        yield
    except BrokenFile as error:
        raise DjetError(f'{path}: {one_line(error)}') from error
    except OSError as error:
        raise DjetError(f'{path} could not be read: {error.strerror or error}') from error


def _decoded(storage: Storage, chosen: dict[int, Connection]) -> Iterator[BagMessage]:
    decoders: dict[int, Decoder] = {}
    for number, stamp, data in storage.messages(chosen):
        topic = chosen[number].topic
        try:
            if not 0 <= stamp < _STAMPS_END:
                raise BrokenFile('it was recorded at a time that ROS has no stamp for')
            if number not in decoders:
                decoders[number] = decoder(chosen[number])
            message = decoders[number](data)
        except BrokenFile as error:
            raise BrokenFile(f'the message on {topic} at {stamp} ns: {error}') from error
        yield BagMessage(topic, stamp, message)


def _files(path: Path) -> list[Path]:
    """Return the storage files of a bag in recorded order."""
    if path.is_dir():
        return _listed(path)
    if not path.is_file():
        state = 'is no regular file' if path.exists() else 'does not exist'
        raise DjetError(f'{path} {state}; name a bag or a folder of images')
    return [path]


def _storage_files(folder: Path) -> list[Path]:
    """Return the storage files of a folder in recorded order: name_2 comes before name_10."""
    files = [path for path in folder.iterdir() if STORAGE_NAMES.fullmatch(path.name)]
    return sorted(files, key=by_numbers)


def _listed(folder: Path) -> list[Path]:
    """Return the storage files of a rosbag2 folder in the order of its metadata.yaml."""
    metadata = folder / 'metadata.yaml'
    if not metadata.exists() or not metadata.stat().st_size:
        # metadata.yaml is written last: a recorder that was killed, or ran out of disk space,
        # leaves only the storage files.
        if files := _storage_files(folder):
            return files
        raise DjetError(f'{folder} is no bag: it has neither metadata.yaml nor .mcap or .db3 '
                        'files')
    try:
        names = read_yaml(metadata)['rosbag2_bagfile_information']['relative_file_paths']
        paths = [PurePosixPath(name) for name in names]
    except (KeyError, TypeError) as error:
        raise DjetError(f"{metadata} has no list 'relative_file_paths' of file names; remove it "
                        'to read the storage files themselves') from error
    for path in paths:
        listed = f"{metadata} lists '{one_line(path)}'"
        if path.is_absolute() or '..' in path.parts:
            raise DjetError(f'{listed}, which lies outside the bag; correct the list, or do not '
                            'trust this bag')
        # Before version 4 paths began with the name of the folder.
        if not (folder / path.name).is_file():
            raise DjetError(f'{listed}, which does not exist; copy it there')
    if not paths:
        raise DjetError(f'{metadata} lists no files; remove it to read the storage files')
    name, count = Counter(path.name for path in paths).most_common(1)[0]
    if count > 1:
        raise DjetError(f"{metadata} lists '{one_line(name)}' {count} times; correct the list")
    return [folder / path.name for path in paths]
