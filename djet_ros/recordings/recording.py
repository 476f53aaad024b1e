"""
Recordings as one stream of messages: bags and folders of image files.

A folder of images, and a ground-truth file, are converted to the messages that an equivalent bag
would hold, so that all sources pass through the same tracker.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath
import re
from typing import Any

from djet_ros.core.types import Array
from djet_ros.errors import DjetError, one_line
from djet_ros.odometry import static_frames
from djet_ros.odometry.messages import stamp_ns
from djet_ros.recordings.bags import Bag, BagMessage, is_bag, Topic
from djet_ros.recordings.closing import Closing
from djet_ros.recordings.datasets import open_sequence
from djet_ros.recordings.decoding import MAKE
from djet_ros.recordings.frame_sequence import DamagedImage, FrameSequence
from djet_ros.recordings.imu import ImuTrack
from djet_ros.recordings.kitti import read_poses
from djet_ros.recordings.text import lines
from djet_ros.recordings.trajectories import read_tum
import numpy as np
from numpy.typing import NDArray

# Called with what is wrong, in one line.
Warn = Callable[[str], None]

IMAGE_TOPIC = '/camera/image_rect'
RAW_IMAGE_TOPIC = '/camera/image_raw'
INFO_TOPIC = '/camera/camera_info'
GROUND_TRUTH_TOPIC = '/ground_truth/pose'
IMU_TOPIC = '/imu/data_raw'
CAMERA_FRAME = 'camera'
IMU_FRAME = 'imu'
WORLD_FRAME = 'camera_first'

IMAGE_TYPES = ('sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage')
CAMERA_INFO_TYPES = ('sensor_msgs/msg/CameraInfo',)
POSE_TYPES = ('geometry_msgs/msg/PoseStamped', 'nav_msgs/msg/Odometry',
              'geometry_msgs/msg/TransformStamped')

# Message types of the auxiliary inputs besides images and CameraInfo, by name of the input.
AUXILIARY = {
    'speed': ('geometry_msgs/msg/TwistStamped', 'nav_msgs/msg/Odometry'),
    'imu': ('sensor_msgs/msg/Imu',),
    'guess': ('nav_msgs/msg/Odometry',),
    'mask': IMAGE_TYPES,
    'tf': ('tf2_msgs/msg/TFMessage',),
}

# Patterns of the topic name for inputs whose type other topics have too.
_TOPIC_PATTERNS = {'mask': re.compile('mask'), 'tf': re.compile('^/tf$')}


class Recording(Closing):
    """
    Images, CameraInfo and optionally ground truth and auxiliary inputs, as messages in order.

    ``len()`` is the number of images, as far as it is known in advance. ground_truth_topic: None
    if there is no ground truth, or if several topics may be it, ground_truth_choices;
    ground_truth_file: the file that replaces the recording's own, or None; auxiliary: topics of
    the auxiliary inputs by their names in AUXILIARY, and under 'frames' the topic of the static
    frames, which hold the mounting of an IMU.
    """

    image_topic: str
    info_topic: str
    ground_truth_topic: str | None
    ground_truth_choices: Sequence[str] = ()
    ground_truth_file: Path | None = None
    auxiliary: dict[str, str]

    @abstractmethod
    def __len__(self) -> int:
        """Count the images."""

    @abstractmethod
    def messages(self, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
        """Yield the messages, of all or some topics; raise DjetError if the file is damaged."""

    def static_frames(self) -> Iterator[Any]:
        """Yield the TFMessages of /tf_static; raise DjetError if the file is damaged."""
        yield from ()


def refuse(damage: str) -> None:
    """Raise DjetError, where a damaged recording is of no use."""
    raise DjetError(damage)


def up_to_damage(messages: Iterator[BagMessage], warn: Warn) -> Iterator[BagMessage]:
    """Yield the messages of a recording; if it is damaged, end there and call warn with that."""
    try:
        yield from messages
    except DjetError as damage:
        warn(str(damage))


class SequenceRecording(Recording):
    """A sequence of image files, as the messages of an equivalent bag."""

    def __init__(self, sequence: FrameSequence, imu: bool = False, poses: Path | None = None,
                 damaged: bool = False) -> None:
        """
        Wrap a sequence; raise DjetError if the file of poses is invalid.

        imu: whether to include its IMU samples, if it has any; poses, damaged: see
        ``open_recording``.
        """
        self._sequence = sequence
        self._damaged = damaged
        # Poses with stamps of their own, or with None one per image, if any are known.
        self._truth_ns: NDArray[np.int64] | None = None
        self._truth = sequence.poses
        if poses is not None:
            self._truth_ns, self._truth = _read_truth(poses, len(sequence))
        self.ground_truth_file = poses
        self._imu = sequence.imu if imu else None
        # By ROS convention the topic's name shows whether images are rectified.
        self.image_topic = RAW_IMAGE_TOPIC if sequence.distorted else IMAGE_TOPIC
        self.info_topic = INFO_TOPIC
        self.ground_truth_topic = None if self._truth is None else GROUND_TRUTH_TOPIC
        self.auxiliary = {} if self._imu is None else {'imu': IMU_TOPIC,
                                                       'frames': static_frames.TOPIC}

    def __len__(self) -> int:
        """Count the images."""
        return len(self._sequence)

    def messages(self, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
        """
        Yield ground truth, CameraInfo and image of each frame in turn.

        The image comes last, after everything up to its stamp and the first IMU sample not before
        it, so that a consumer can process it at once.
        """
        sequence = self._sequence
        samples: Iterator[BagMessage] = iter(())
        if self._truth is not None and self._truth_ns is not None:
            yield from _stamped_poses(self._truth_ns, self._truth)
        if self._imu is not None and (
                topics is None or not set(topics).isdisjoint(self.auxiliary.values())):
            yield _imu_frame(int(sequence.stamps_ns[0]), self._imu)
            samples = _imu_messages(self._imu)
        for index, stamp in enumerate(sequence.stamps_ns.tolist()):
            for sample in samples:
                yield sample
                if sample.stamp_ns >= stamp:
                    break
            if self._truth is not None and self._truth_ns is None \
                    and np.isfinite(self._truth[index]).all():
                yield _ground_truth(stamp, self._truth[index])
            if topics is None or self.image_topic in topics:
                yield BagMessage(INFO_TOPIC, stamp, MAKE.camera_info(
                    stamp, CAMERA_FRAME, sequence.K, sequence.size, sequence.distortion,
                    sequence.model))
                yield BagMessage(self.image_topic, stamp, self._image(index, stamp))

    def _image(self, index: int, stamp: int) -> Any:
        try:
            return MAKE.picture(stamp, CAMERA_FRAME, self._sequence.raw(index))
        except DamagedImage as damaged:
            if not self._damaged:
                raise
            return MAKE.compressed(stamp, CAMERA_FRAME, damaged.path.read_bytes())

    def static_frames(self) -> Iterator[Any]:
        """Yield the rotation between IMU and camera, if the IMU is included."""
        if self._imu is not None:
            yield _imu_frame(int(self._sequence.stamps_ns[0]), self._imu).message

    def close(self) -> None:
        """Nothing is held open."""


class BagRecording(Recording):
    """
    The images of one camera in a bag, with ground truth and auxiliary inputs.

    Topics that are not named are found by type and name; raises DjetError with the candidates if
    they are ambiguous.
    """

    def __init__(self, path: Path, image_topic: str | None = None, info_topic: str | None = None,
                 poses: Path | None = None, auxiliary: Mapping[str, str | None] | None = None,
                 strict: bool = True) -> None:
        """Open the bag and choose the topics; see ``open_recording``."""
        self.bag = Bag(path)
        try:
            self._topics = [topic for topic in self.bag.topics if topic.message_count]
            if not self._topics:
                # If the file is damaged, this raises with the reason.
                next(self.bag.messages(), None)
                raise DjetError(f'{path} holds no messages; record it again')
            image = self._choose('image', '--image-topic', IMAGE_TYPES, image_topic)
            self.image_topic, self._count = image.name, image.message_count
            self.info_topic = self._info_topic(info_topic)
            choices = self._ground_truth_topics()
            self.ground_truth_topic = (
                GROUND_TRUTH_TOPIC if poses is not None else
                choices[0] if len(choices) == 1 else None)
            self.ground_truth_choices = choices if self.ground_truth_topic is None else ()
            self.auxiliary = dict(self._auxiliary_topics(auxiliary or {}, strict))
            self._require_one_type()
            self.ground_truth_file = poses
            self._poses = None if poses is None else _read_truth(poses, self._count)
        except BaseException:
            self.close()
            raise

    def __len__(self) -> int:
        """Count the images (in a damaged bag, those that can be counted)."""
        return self._count

    def messages(self, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
        """Yield the messages in recorded order, with the poses of a ground-truth file."""
        wanted = {topic for topic in (self.image_topic, self.info_topic, self.ground_truth_topic,
                                      *self.auxiliary.values())
                  if topic and (topics is None or topic in topics)}
        if self._poses is None:
            yield from self.bag.messages(wanted)
            return
        wanted.discard(GROUND_TRUTH_TOPIC)
        stamps, poses = self._poses
        if stamps is None:
            yield from self._with_poses(wanted, poses)
            return
        yield from _stamped_poses(stamps, poses)
        yield from self.bag.messages(wanted)

    def _with_poses(self, wanted: set[str], poses: Array) -> Iterator[BagMessage]:
        """Yield the messages, with a pose of a file without stamps before each image."""
        rows = iter(poses)
        for message in self.bag.messages(wanted | {self.image_topic}):
            if message.topic == self.image_topic and (pose := next(rows, None)) is not None:
                yield _ground_truth(stamp_ns(message.message.header), pose)
            if message.topic in wanted:
                yield message

    def static_frames(self) -> Iterator[Any]:
        """Yield the TFMessages of /tf_static; raise DjetError if the file is damaged."""
        if static_frames.TOPIC in {topic.name for topic in self._fitting((static_frames.TYPE,))}:
            for one in self.bag.messages({static_frames.TOPIC}):
                yield one.message

    def close(self) -> None:
        """Close the bag."""
        self.bag.close()

    def _auxiliary_topics(self, wanted: Mapping[str, str | None], strict: bool
                          ) -> Iterator[tuple[str, str]]:
        """Yield (input, topic) of the auxiliary inputs; strict: raise DjetError if one lacks."""
        for what, name in wanted.items():
            # The bag's ground truth is not a measurement, even if a file replaces it.
            have = [topic.name for topic in self._fitting(AUXILIARY[what])
                    if topic.name not in (*self._ground_truth_topics(), self.image_topic)]
            pattern = _TOPIC_PATTERNS.get(what)
            chosen = [topic for topic in have if topic == name or (
                name is None and (pattern is None or pattern.search(topic)))]
            if len(chosen) == 1:
                yield what, chosen[0]
            elif strict:
                raise DjetError(f'{self.bag.path} has {_why_not_one(what, name, have)}')
        if wanted and any(topic.name == static_frames.TOPIC for topic in self._topics):
            yield 'frames', static_frames.TOPIC

    def _require_one_type(self) -> None:
        """Raise DjetError if a chosen topic was recorded with several types."""
        for name in (self.image_topic, self.info_topic, self.ground_truth_topic,
                     *self.auxiliary.values()):
            types = sorted(topic.msgtype for topic in self._topics if topic.name == name)
            if len(types) > 1:
                raise DjetError(one_line(
                    f"{self.bag.path} has messages of several types on '{name}': "
                    f'{", ".join(types)}; record them on topics of their own'))

    def _fitting(self, types: Collection[str]) -> list[Topic]:
        return [topic for topic in self._topics if topic.msgtype in types]

    def _choose(self, what: str, option: str, types: Collection[str], name: str | None) -> Topic:
        """Return the topic of a name or, without a name, the only one of these types."""
        fitting = self._fitting(types)
        chosen = [topic for topic in fitting if name in (None, topic.name)]
        if len(chosen) == 1:
            return chosen[0]
        if not fitting:
            others = ', '.join(f'{topic.name} ({topic.msgtype})' for topic in self._topics[:12])
            otherwise = ('' if types is IMAGE_TYPES else
                         ', or put the images into a folder with their calibration.yaml')
            raise DjetError(f'{self.bag.path} has no {what} topic, only {one_line(others)}; '
                            f'record it too{otherwise}')
        choices = one_line(', '.join(
            f'{topic.name} ({topic.message_count})' for topic in fitting))
        if name is not None:
            raise DjetError(f"{self.bag.path} has no {what} topic '{name}'; choose from {choices}")
        raise DjetError(f'{self.bag.path} has {len(chosen)} {what} topics: {choices}; '
                        f'choose one with {option}')

    def _info_topic(self, name: str | None) -> str:
        """Return the CameraInfo of the image's namespace, or the only one of a single camera."""
        if name is None:
            have = self._fitting(CAMERA_INFO_TYPES)
            # As in image_transport: .../image_raw and .../image_raw/compressed both belong to
            # .../camera_info.
            for folder in list(PurePosixPath(self.image_topic).parents)[:2]:
                if (info := str(folder / 'camera_info')) in {topic.name for topic in have}:
                    return info
            if len(have) == 1 and len(self._fitting(IMAGE_TYPES)) > 1:
                raise DjetError(f'{self.bag.path} has no camera_info in the namespace of '
                                f'{self.image_topic}; to use {have[0].name}, name it with '
                                '--info-topic')
        return self._choose('CameraInfo', '--info-topic', CAMERA_INFO_TYPES, name).name

    def _ground_truth_topics(self) -> list[str]:
        """Return the topics of poses with ground truth in their names."""
        return [topic.name for topic in self._fitting(POSE_TYPES)
                if re.search('ground_?truth', topic.name)]


def open_recording(path: Path, image_topic: str | None = None, info_topic: str | None = None,
                   poses: Path | None = None, auxiliary: Mapping[str, str | None] | None = None,
                   strict: bool = True, damaged: bool = False) -> Recording:
    """
    Open a bag, or a folder of image files in one of the layouts of ``open_sequence``.

    poses: ground truth in place of the recording's own, a KITTI (one row per image) or TUM
    (stamped) file; auxiliary: the auxiliary inputs to read, by their names in AUXILIARY, each with
    its topic, or None to find it; strict: whether a missing input is an error; damaged: whether
    image files that can't be decoded are passed on, as CompressedImage, as those of a bag are.
    Raises DjetError.
    """
    auxiliary = auxiliary or {}
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise DjetError(f'{path} is neither a file nor a folder; name a bag or a folder of images')
    if is_bag(path) or not path.exists():
        return BagRecording(path, image_topic, info_topic, poses, auxiliary, strict)
    if strict and (image_topic or info_topic or auxiliary.keys() - {'imu'}
                   or any(auxiliary.values())):
        raise DjetError(f'{path} is a folder of images, not a bag: it has no topics, and no '
                        'recorded speeds, guesses, masks or tf; omit these options')
    sequence = open_sequence(path, own_poses=poses is None)
    if strict and 'imu' in auxiliary and sequence.imu is None:
        raise DjetError(f'{path} holds no IMU data; set odometry.imu to false, or name a '
                        'recording with an IMU')
    return SequenceRecording(sequence, 'imu' in auxiliary, poses, damaged)


def _why_not_one(what: str, name: str | None, have: Collection[str]) -> str:
    """Return what a bag has in place of one topic for an auxiliary input, and a remedy."""
    if what == 'tf':
        return 'no topic /tf, which odometry.guess_frame requires; record it too'
    if not have:
        named = '' if name is None else f"'{name}' "
        return (f"no topic {named}for '{what}' ({' or '.join(AUXILIARY[what])}); record one, or "
                'set the parameters so that none is needed')
    which = f"no single topic for '{what}'" if name is None else f"no topic '{name}' for '{what}'"
    return f'{which}; choose one with --{what}-topic from: {", ".join(have)}'


def _read_truth(path: Path, images: int) -> tuple[NDArray[np.int64] | None, Array]:
    """Return (stamps, poses) of a TUM file, or (None, poses) of a KITTI file, one per image."""
    first = next((text for _, text in lines(path)), '')
    columns = len(first.replace(',', ' ').split())
    if columns == 8:
        return read_tum(path)
    if columns != 12:
        raise DjetError(f'{path} begins with a row of {columns} words; a TUM file has 8 numbers '
                        'in a row (stamp x y z qx qy qz qw), a KITTI file 12; convert it')
    poses = read_poses(path)
    if len(poses) != images:
        raise DjetError(f'{path} has {len(poses)} poses, the recording has {images} images; name '
                        'the file of poses of this recording')
    return None, poses


def _stamped_poses(stamps_ns: NDArray[np.int64], poses: Array) -> Iterator[BagMessage]:
    """Yield messages of poses with stamps of their own."""
    for stamp, pose in zip(stamps_ns.tolist(), poses, strict=True):
        yield _ground_truth(stamp, pose)


def _ground_truth(stamp: int, pose: Array) -> BagMessage:
    return BagMessage(GROUND_TRUTH_TOPIC, stamp, MAKE.pose_in(stamp, WORLD_FRAME, pose))


def _imu_frame(stamp: int, imu: ImuTrack) -> BagMessage:
    """Return the static transform of the IMU, with its rotation only: rates need no position."""
    pose = np.eye(4)
    pose[:3, :3] = imu.to_camera
    return BagMessage(static_frames.TOPIC, stamp,
                      MAKE.frame(stamp, CAMERA_FRAME, IMU_FRAME, pose))


def _imu_messages(imu: ImuTrack) -> Iterator[BagMessage]:
    for stamp, rates, accelerations in zip(imu.stamps_ns.tolist(), imu.rates, imu.accelerations):
        yield BagMessage(IMU_TOPIC, stamp, MAKE.imu(stamp, IMU_FRAME, rates, accelerations))
