"""Readers of the file formats of bags, with messages in the order of their stamps."""

from __future__ import annotations

from pathlib import Path

from djet_ros.recordings.storages import mcap, rosbag1, sqlite
from djet_ros.recordings.storages.base import BrokenFile, Connection, Storage

__all__ = ['BrokenFile', 'Connection', 'Storage', 'open_storage']

FORMATS = ((mcap.MAGIC, mcap.McapFile), (sqlite.MAGIC, sqlite.SqliteFile),
           (rosbag1.MAGIC, rosbag1.Ros1File))


def open_storage(path: Path) -> Storage:
    """Open a file by its content, not its name. Raises BrokenFile or OSError."""
    with path.open('rb') as file:
        start = file.read(16)
    for magic, storage in FORMATS:
        if start.startswith(magic):
            return storage(path)
    if not start:
        raise BrokenFile('it is empty (0 bytes)')
    raise BrokenFile(f'it is no MCAP, rosbag2 sqlite3 or ROS 1 bag (format 2.0): it begins with '
                     f'{start[:8]!r}; name a bag, or a folder of images, also for a video')
