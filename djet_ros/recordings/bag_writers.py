"""
Writing bags: image sequences as rosbag2, and the results of a replay as they come.

Bags are written as ROS 2 Jazzy writes them (rosbag2 metadata version 9, chunked and indexed MCAP
or sqlite3). The same input gives the same bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
import sqlite3
from typing import Any

from djet_ros.core.types import Array
from djet_ros.errors import DjetError
from djet_ros.recordings.bags import is_bag
from djet_ros.recordings.closing import Closing
from djet_ros.recordings.decoding import jazzy, message_type
from djet_ros.recordings.outputs import appearing
from djet_ros.recordings.sequence import FrameSequence
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
from scipy.spatial.transform import Rotation

STORAGES = {'mcap': StoragePlugin.MCAP, 'sqlite3': StoragePlugin.SQLITE3}

IMAGE_TOPIC = '/camera/image_rect'
INFO_TOPIC = '/camera/camera_info'
GROUND_TRUTH_TOPIC = '/ground_truth/pose'
CAMERA_FRAME = 'camera'
WORLD_FRAME = 'camera_first'

# From map (x forward, y left, z up) to an optical frame (z forward, x right, y down): REP 103.
OPTICAL = (-0.5, 0.5, -0.5, 0.5)

FOREVER = QosTime(9223372036, 854775807)


def qos(depth: int, durability: QosDurability) -> Qos:
    """Offer reliable delivery, which subscribers of either reliability accept."""
    return Qos(QosHistory.KEEP_LAST, depth, QosReliability.RELIABLE, durability, FOREVER, FOREVER,
               QosLiveliness.AUTOMATIC, FOREVER, avoid_ros_namespace_conventions=False)


VOLATILE = qos(10, QosDurability.VOLATILE)
LATCHED = qos(1, QosDurability.TRANSIENT_LOCAL)


def write_kitti_bag(sequence: FrameSequence, out: Path, storage: str = 'mcap',
                    progress: Callable[[int], None] | None = None,
                    overwrite: bool = False) -> None:
    """
    Write a sequence as a rosbag2 folder.

    Topics: /camera/image_rect (mono8), /camera/camera_info, /ground_truth/pose (camera in the
    first camera, where the sequence knows it) and /tf_static (map to camera_first, REP 103).
    ``progress`` is called with the number of frames written so far. The bag appears under its
    name when it is complete; a failure or an interrupt leaves nothing (a kill a hidden folder
    beside it), and with ``overwrite`` leaves the old bag. Raises DjetError where ``out`` exists
    or can't be written.
    """
    if storage not in STORAGES:
        raise DjetError(f"storage is '{storage}'; choose from {', '.join(STORAGES)}")
    with _left_whole(out), appearing(out, overwrite, is_bag, 'bag folder') as folder:
        writer = Writer(folder, version=9, storage_plugin=STORAGES[storage])
        with writer:
            for written, messages in enumerate(_frames(sequence), 1):
                for topic, message, stamp in messages:
                    _write(writer, topic, message, stamp)
                if progress is not None:
                    progress(written)


class ResultBag(Closing):
    """
    An MCAP bag that grows message by message and stays readable if the process is killed.

    Each new stamp closes the chunk before it and hands it to the operating system, so that a
    kill loses the messages of the last stamp at most. Leaving the ``with`` statement completes
    the bag, after an error too. DjetError where the folder exists or can't be written.
    """

    def __init__(self, path: Path) -> None:
        """Create the folder and the file in it."""
        self.path = path
        self._stamp: int | None = None
        with self._blaming():
            self._writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
            self._writer.open()

    def write(self, topic: str, message: Any, stamp_ns: int) -> None:
        """Append a message object of Jazzy; the topic is made known on its first message."""
        with self._blaming():
            if stamp_ns != self._stamp:
                self._flush()
                self._stamp = stamp_ns
            _write(self._writer, topic, message, stamp_ns)

    def close(self) -> None:
        """Write the index and the metadata."""
        with self._blaming():
            self._writer.close()

    def _flush(self) -> None:
        # rosbags offers no flush; its MCAP storage keeps an open chunk in memory.
        storage: Any = self._writer.storage
        if storage.chunk.bio.tell():
            storage.close_chunk()
            storage.bio.flush()

    @contextmanager
    def _blaming(self) -> Iterator[None]:
        try:
            yield
        except WriterError as error:
            raise DjetError(f'{self.path} exists; choose another name or remove it') from error
        except OSError as error:
            raise DjetError(f'{self.path} could not be written: {error.strerror}; what was '
                            'written before is readable') from error


def _write(writer: Writer, topic: str, message: Any, stamp_ns: int) -> None:
    msgtype = message.__msgtype__
    connection = next((known for known in writer.connections if known.topic == topic),
                      None) or _connect(writer, topic, msgtype)
    writer.write(connection, stamp_ns, jazzy().serialize_cdr(message, msgtype))


def _connect(writer: Writer, topic: str, msgtype: str) -> Connection:
    offered = LATCHED if topic == '/tf_static' else VOLATILE
    return writer.add_connection(topic, msgtype, typestore=jazzy(),
                                 offered_qos_profiles=[offered])


@contextmanager
def _left_whole(out: Path) -> Iterator[None]:
    """Name the bag in what the user is told."""
    try:
        yield
    except (OSError, WriterError, sqlite3.Error) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise DjetError(f'{out} could not be written: {reason}; nothing was left '
                        'behind') from error


def _frames(sequence: FrameSequence) -> Iterator[list[tuple[str, Any, int]]]:
    """
    Yield the messages (topic, message, stamp) of one frame after the other.

    The image comes last: whoever acts on it then has everything of the same stamp.
    """
    for index, stamp in enumerate(sequence.stamps_ns.tolist()):
        messages = []
        if index == 0:
            messages.append(('/tf_static', _map_transform(stamp), stamp))
        if sequence.poses is not None and np.isfinite(sequence.poses[index]).all():
            pose = pose_stamped(sequence.poses[index], _header(stamp, WORLD_FRAME))
            messages.append((GROUND_TRUTH_TOPIC, pose, stamp))
        header = _header(stamp, CAMERA_FRAME)
        messages.append((INFO_TOPIC, camera_info(sequence.K, sequence.size, header), stamp))
        messages.append((IMAGE_TOPIC, mono8(sequence.image(index), header), stamp))
        yield messages


def camera_info(K: Array, size: tuple[int, int], header: Any) -> Any:
    """Make the CameraInfo of rectified images (width, height) with camera matrix K (3, 3)."""
    roi = message_type('sensor_msgs/msg/RegionOfInterest')(
        x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return message_type('sensor_msgs/msg/CameraInfo')(
        header=header, height=size[1], width=size[0], distortion_model='plumb_bob',
        d=np.zeros(5), k=K.ravel(), r=np.eye(3).ravel(),
        p=np.hstack([K, np.zeros((3, 1))]).ravel(), binning_x=0, binning_y=0, roi=roi)


def mono8(image: np.ndarray, header: Any) -> Any:
    """Make the Image of a (H, W) uint8 array."""
    height, width = image.shape
    return message_type('sensor_msgs/msg/Image')(
        header=header, height=height, width=width, encoding='mono8', is_bigendian=0, step=width,
        data=np.ascontiguousarray(image).ravel())


def pose_stamped(pose: Array, header: Any) -> Any:
    """Make the PoseStamped of a pose (4, 4)."""
    x, y, z = pose[:3, 3].tolist()
    rotation = Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True).tolist()
    return message_type('geometry_msgs/msg/PoseStamped')(
        header=header, pose=message_type('geometry_msgs/msg/Pose')(
            position=message_type('geometry_msgs/msg/Point')(x=x, y=y, z=z),
            orientation=message_type('geometry_msgs/msg/Quaternion')(*rotation)))


def _map_transform(stamp_ns: int) -> Any:
    transform = message_type('geometry_msgs/msg/Transform')(
        translation=message_type('geometry_msgs/msg/Vector3')(x=0.0, y=0.0, z=0.0),
        rotation=message_type('geometry_msgs/msg/Quaternion')(*OPTICAL))
    return message_type('tf2_msgs/msg/TFMessage')(transforms=[
        message_type('geometry_msgs/msg/TransformStamped')(
            header=_header(stamp_ns, 'map'), child_frame_id=WORLD_FRAME, transform=transform)])


def _header(stamp_ns: int, frame_id: str) -> Any:
    seconds, rest = divmod(stamp_ns, 10**9)
    return message_type('std_msgs/msg/Header')(
        stamp=message_type('builtin_interfaces/msg/Time')(sec=seconds, nanosec=rest),
        frame_id=frame_id)
