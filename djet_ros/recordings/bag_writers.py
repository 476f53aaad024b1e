"""
Writers of bags: image sequences as rosbag2, and the results of a running replay.

Bags have the format of ROS 2 Jazzy (rosbag2 metadata version 9, chunked and indexed MCAP or
sqlite3). The same input gives the same bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
import sqlite3
from typing import Any

from djet_ros.errors import DjetError
from djet_ros.odometry import static_frames
from djet_ros.odometry.messages import OPTICAL_TO_BODY
from djet_ros.recordings.closing import Closing
from djet_ros.recordings.decoding import jazzy, MAKE
from djet_ros.recordings.frame_sequence import FrameSequence
from djet_ros.recordings.outputs import created_whole
from djet_ros.recordings.recording import SequenceRecording, WORLD_FRAME
import numpy as np
from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError

STORAGES = {'mcap': StoragePlugin.MCAP, 'sqlite3': StoragePlugin.SQLITE3}
# Suffixes of the one storage file, which is named after its folder.
SUFFIXES = ('.mcap', '.db3')

FOREVER = QosTime(9223372036, 854775807)


def qos(depth: int, durability: QosDurability) -> Qos:
    """Return a reliable QoS profile, compatible with reliable and best-effort subscribers."""
    return Qos(QosHistory.KEEP_LAST, depth, QosReliability.RELIABLE, durability, FOREVER, FOREVER,
               QosLiveliness.AUTOMATIC, FOREVER, avoid_ros_namespace_conventions=False)


VOLATILE = qos(10, QosDurability.VOLATILE)
LATCHED = qos(1, QosDurability.TRANSIENT_LOCAL)


def write_kitti_bag(sequence: FrameSequence, out: Path, storage: str = 'mcap',
                    progress: Callable[[], None] = lambda: None, overwrite: bool = False
                    ) -> None:
    """
    Write a sequence as a rosbag2 folder.

    Topics: /camera/image_rect (mono8; image_raw if distorted), /camera/camera_info,
    /ground_truth/pose (camera in the frame of the first camera, if known), /imu/data_raw (if the
    sequence has one) and /tf_static (map to camera_first, REP 103; camera to imu).
    ``progress`` is called after each frame. The bag gets its name when it is complete; a failure
    or an interrupt leaves nothing behind (a kill leaves a hidden folder next to it), and with
    ``overwrite`` keeps the old bag. Raises DjetError if ``out`` exists (with ``overwrite``: if it
    holds anything but such a bag) or can't be written.
    """
    recording = SequenceRecording(sequence, imu=True)
    with _naming_errors(out), created_whole(out, overwrite, _is_written_here,
                                            'bag folder as this command writes it') as folder:
        with Writer(folder, version=9, storage_plugin=STORAGES[storage]) as writer:
            _write_map_frame(writer, int(sequence.stamps_ns[0]))
            for topic, stamp, message in recording.messages():
                _write(writer, topic, message, stamp)
                if topic == recording.image_topic:
                    progress()


class ResultBag(Closing):
    """
    An MCAP bag that grows message by message and stays readable if the process is killed.

    Each new stamp closes the chunk before it and flushes it to the operating system, so that a
    kill loses at most the messages of the last stamp. Leaving the ``with`` statement completes
    the bag, even after an error. Raises DjetError if the folder exists or can't be written.
    """

    def __init__(self, path: Path) -> None:
        """Create the folder and the file in it."""
        self.path = path
        self._stamp: int | None = None
        with self._naming_errors():
            self._writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
            self._writer.open()

    def write(self, topic: str, message: Any, stamp_ns: int) -> None:
        """Append a message object of Jazzy; a topic is registered with its first message."""
        with self._naming_errors():
            if stamp_ns != self._stamp:
                self._flush()
                self._stamp = stamp_ns
            _write(self._writer, topic, message, stamp_ns)

    def close(self) -> None:
        """Write the index and the metadata; the file is closed even if they do not fit."""
        with self._naming_errors():
            try:
                self._writer.close()
            except OSError:
                # rosbags leaves its file open, and only its newer versions offer to close it.
                storage: Any = self._writer.storage
                with suppress(OSError):  # that of what could not be written
                    if storage is not None:
                        storage.bio.close()
                raise

    def _flush(self) -> None:
        # rosbags offers no flush; its MCAP storage keeps an open chunk in memory.
        storage: Any = self._writer.storage
        if storage.chunk.bio.tell():
            storage.close_chunk()
            storage.bio.flush()

    @contextmanager
    def _naming_errors(self) -> Iterator[None]:
        try:
            yield
        except WriterError as error:
            raise DjetError(f'{self.path} exists; choose another name or remove it') from error
        except OSError as error:
            raise DjetError(f'{self.path} could not be written: {error.strerror}; the messages '
                            'written so far are readable') from error


def _is_written_here(folder: Path) -> bool:
    """Return whether a folder holds a bag of ``write_kitti_bag`` and nothing else."""
    held = {path.name for path in folder.iterdir() if path.is_file() and not path.is_symlink()}
    return len(held) == len(list(folder.iterdir())) and held in (
        {'metadata.yaml', f'{folder.name}{suffix}'} for suffix in SUFFIXES)


def _write(writer: Writer, topic: str, message: Any, stamp_ns: int) -> None:
    msgtype = message.__msgtype__
    connection = next((known for known in writer.connections if known.topic == topic),
                      None) or _connect(writer, topic, msgtype)
    writer.write(connection, stamp_ns, jazzy().serialize_cdr(message, msgtype))


def _write_map_frame(writer: Writer, stamp_ns: int) -> None:
    """Write the pose of the first camera in the map (x forward, y left, z up)."""
    pose = np.eye(4)
    pose[:3, :3] = OPTICAL_TO_BODY
    _write(writer, static_frames.TOPIC, MAKE.frame(stamp_ns, 'map', WORLD_FRAME, pose), stamp_ns)


def _connect(writer: Writer, topic: str, msgtype: str) -> Connection:
    offered = LATCHED if topic == static_frames.TOPIC else VOLATILE
    return writer.add_connection(topic, msgtype, typestore=jazzy(),
                                 offered_qos_profiles=[offered])


@contextmanager
def _naming_errors(out: Path) -> Iterator[None]:
    """Convert errors to DjetError that names the bag."""
    try:
        yield
    except (OSError, WriterError, sqlite3.Error) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise DjetError(f'{out} could not be written: {reason}; nothing was left '
                        'behind') from error
