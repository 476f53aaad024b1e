"""
Anything that can be replayed, as one stream of messages: bags and folders of image files.

A folder becomes the messages that its bag would hold, and a ground-truth file becomes messages
too, so that all of them pass through the same tracker.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import cast, Protocol

from djet_ros.core.types import Array
from djet_ros.errors import DjetError
from djet_ros.odometry.messages import stamp_ns
from djet_ros.recordings.bag_writers import (
    CAMERA_FRAME,
    GROUND_TRUTH_TOPIC,
    IMAGE_TOPIC,
    INFO_TOPIC,
    WORLD_FRAME,
)
from djet_ros.recordings.bags import BagMessage, BagSource, is_bag
from djet_ros.recordings.datasets import open_sequence
from djet_ros.recordings.decoding import MAKE
from djet_ros.recordings.kitti import KittiSequence, read_poses
from djet_ros.recordings.sequence import FrameSequence
from djet_ros.recordings.text import lines
from djet_ros.recordings.trajectories import read_tum
import numpy as np
from numpy.typing import NDArray

SPEED_TYPES = ('geometry_msgs/msg/TwistStamped', 'nav_msgs/msg/Odometry')


class Source(Protocol):
    """
    A recording: images, CameraInfo, perhaps ground truth and speeds, as messages in order.

    ``len()`` is the number of images, as far as it is known beforehand.
    """

    image_topic: str
    info_topic: str
    ground_truth_topic: str | None
    speed_topic: str | None

    def __len__(self) -> int:
        """Count the images."""

    def messages(self, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
        """Yield the messages, or only those of some topics; DjetError where there is damage."""

    def close(self) -> None:
        """Let go of files."""


class SequenceSource:
    """A FrameSequence as the messages of the bag that would be made of it."""

    def __init__(self, sequence: FrameSequence) -> None:
        self._sequence = sequence
        self.image_topic, self.info_topic = IMAGE_TOPIC, INFO_TOPIC
        self.ground_truth_topic = None if sequence.poses is None else GROUND_TRUTH_TOPIC
        self.speed_topic: str | None = None

    def __len__(self) -> int:
        """Count the images."""
        return len(self._sequence)

    def messages(self, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
        """Yield ground truth, CameraInfo and image of each frame in turn."""
        sequence = self._sequence
        for index, stamp in enumerate(sequence.stamps_ns.tolist()):
            if sequence.poses is not None and np.isfinite(sequence.poses[index]).all():
                yield _ground_truth(stamp, sequence.poses[index])
            if topics is None or IMAGE_TOPIC in topics:
                yield BagMessage(INFO_TOPIC, stamp, MAKE.camera_info(
                    stamp, CAMERA_FRAME, sequence.K, sequence.size))
                yield BagMessage(IMAGE_TOPIC, stamp, MAKE.picture(
                    stamp, CAMERA_FRAME, sequence.image(index)))

    def close(self) -> None:
        """Nothing is held open."""


class RecordedSource:
    """The camera in a bag, with its ground truth and its speeds where they are wanted."""

    def __init__(self, path: Path, image_topic: str | None = None, info_topic: str | None = None,
                 poses: Path | None = None, speed: bool = False,
                 speed_topic: str | None = None) -> None:
        """Open the bag; DjetError where a topic or the file of poses does not fit."""
        self._source = BagSource(path, image_topic, info_topic)
        try:
            self.image_topic, self.info_topic = self._source.image_topic, self._source.info_topic
            self.ground_truth_topic = (self._source.ground_truth_topic if poses is None
                                       else GROUND_TRUTH_TOPIC)
            self.speed_topic = self._speed_topic(speed_topic) if speed else None
            self._poses = None if poses is None else _read_truth(poses, len(self._source))
        except BaseException:
            self.close()
            raise

    def __len__(self) -> int:
        """Count the images."""
        return len(self._source)

    def messages(self, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
        """Yield the messages in the order of recording, and what the file of poses adds."""
        wanted = {topic for topic in (self.image_topic, self.info_topic, self.ground_truth_topic,
                                      self.speed_topic)
                  if topic and (topics is None or topic in topics)}
        if self._poses is None:
            yield from self._source.bag.messages(wanted)
            return
        wanted.discard(GROUND_TRUTH_TOPIC)
        stamps, poses = self._poses
        if stamps is None:
            yield from self._each_with_its_pose(wanted, poses)
            return
        for stamp, pose in zip(stamps.tolist(), poses, strict=True):
            yield _ground_truth(stamp, pose)
        yield from self._source.bag.messages(wanted)

    def _each_with_its_pose(self, wanted: set[str], poses: Array) -> Iterator[BagMessage]:
        """Poses without stamps belong to the images, one to each."""
        rows = iter(poses)
        for message in self._source.bag.messages(wanted | {self.image_topic}):
            if message.topic == self.image_topic and (pose := next(rows, None)) is not None:
                yield _ground_truth(stamp_ns(message.message.header), pose)
            if message.topic in wanted:
                yield message

    def close(self) -> None:
        """Close the bag."""
        self._source.close()

    def _speed_topic(self, name: str | None) -> str:
        fitting = [topic.name for topic in self._source.bag.topics
                   if topic.msgtype in SPEED_TYPES
                   and topic.name != self._source.ground_truth_topic]
        chosen = [topic for topic in fitting if name in (None, topic)]
        if len(chosen) != 1:
            raise DjetError(f"{self._source.bag.path}: scale 'speed' needs one topic of speeds; "
                            f'choose one with --speed-topic from: {", ".join(fitting) or "none"}')
        return chosen[0]


def open_source(path: Path, image_topic: str | None = None, info_topic: str | None = None,
                poses: Path | None = None, speed: bool = False,
                speed_topic: str | None = None) -> Source:
    """
    Open a bag, or a folder in the layout of KITTI, TUM RGB-D or EuRoC.

    poses: ground truth instead of the recording's own, as KITTI (one row per image) or TUM
    (stamped) file; speed: whether speeds are wanted too. Raises DjetError.
    """
    if path.is_file() or (path.is_dir() and is_bag(path)) or not path.exists():
        return RecordedSource(path, image_topic, info_topic, poses, speed, speed_topic)
    if image_topic or info_topic or speed:
        raise DjetError(f'{path} is a folder of images; topics and scale speed are for bags')
    if poses is not None:
        return SequenceSource(KittiSequence(path, poses))
    # What is a bag has been told apart above.
    return SequenceSource(cast(FrameSequence, open_sequence(path)))


def _read_truth(path: Path, images: int) -> tuple[NDArray[np.int64] | None, Array]:
    """Poses of a TUM file with their stamps, or of a KITTI file, which must have one per image."""
    first = next((text for _, text in lines(path)), '')
    if len(first.replace(',', ' ').split()) == 8:
        return read_tum(path)
    poses = read_poses(path)
    if len(poses) != images:
        raise DjetError(f'{path} has {len(poses)} poses, the recording has {images} images; give '
                        'the file that belongs to it')
    return None, poses


def _ground_truth(stamp: int, pose: Array) -> BagMessage:
    return BagMessage(GROUND_TRUTH_TOPIC, stamp, MAKE.pose_in(stamp, WORLD_FRAME, pose))
