"""
Anything that can be replayed, as one stream of messages: bags and folders of image files.

A folder becomes the messages that its bag would hold, and a ground-truth file becomes messages
too, so that all of them pass through the same tracker.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Collection, Iterator, Mapping
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

IMAGE_TOPIC = '/camera/image_rect'
RAW_IMAGE_TOPIC = '/camera/image_raw'
INFO_TOPIC = '/camera/camera_info'
GROUND_TRUTH_TOPIC = '/ground_truth/pose'
IMU_TOPIC = '/imu/data_raw'
STATIC_FRAMES_TOPIC = '/tf_static'
CAMERA_FRAME = 'camera'
IMU_FRAME = 'imu'
WORLD_FRAME = 'camera_first'

IMAGE_TYPES = ('sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage')
CAMERA_INFO_TYPES = ('sensor_msgs/msg/CameraInfo',)
POSE_TYPES = ('geometry_msgs/msg/PoseStamped', 'nav_msgs/msg/Odometry',
              'geometry_msgs/msg/TransformStamped')

# What may be recorded beside a camera, by the name of its topic in a live node: its types.
BESIDE = {
    'speed': ('geometry_msgs/msg/TwistStamped', 'nav_msgs/msg/Odometry'),
    'imu': ('sensor_msgs/msg/Imu',),
    'guess': ('nav_msgs/msg/Odometry',),
    'mask': IMAGE_TYPES,
    'tf': ('tf2_msgs/msg/TFMessage',),
}

# Words by which those are known of which others have the type as well.
_KNOWN_BY = {'mask': re.compile('mask'), 'tf': re.compile('^/tf$')}


class Recording(Closing):
    """
    Images, CameraInfo, perhaps ground truth and what else was recorded, as messages in order.

    ``len()`` is the number of images, as far as it is known beforehand. ground_truth_topic is
    None where there is none; ground_truth_file: where it comes from instead of the recording.
    beside: topics of what else is wanted, by names in BESIDE, and under 'frames' that of the
    static frames, which tell how an IMU is mounted.
    """

    image_topic: str
    info_topic: str
    ground_truth_topic: str | None
    ground_truth_file: Path | None = None
    beside: dict[str, str]

    @abstractmethod
    def __len__(self) -> int:
        """Count the images."""

    @abstractmethod
    def messages(self, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
        """Yield the messages, or only those of some topics; DjetError where there is damage."""

    def static_frames(self) -> Iterator[Any]:
        """Yield the TFMessages of /tf_static; DjetError where there is damage."""
        yield from ()


class SequenceRecording(Recording):
    """A sequence of image files as the messages of the bag that would be made of it."""

    def __init__(self, sequence: FrameSequence, imu: bool = False, poses: Path | None = None,
                 damaged: bool = False) -> None:
        """
        Take a sequence; DjetError where a file of poses is none.

        imu: whether what its IMU felt is wanted too, where it has one; poses: ground truth instead
        of its own, and damaged: whether damaged images are handed on, see ``open_recording``.
        """
        self._sequence = sequence
        self._damaged = damaged
        # Poses with stamps of their own, and a pose for each image or None.
        self._stamped: tuple[NDArray[np.int64], Array] | None = None
        self._poses = sequence.poses
        if poses is not None:
            stamps, truth = _read_truth(poses, len(sequence))
            self._stamped = None if stamps is None else (stamps, truth)
            self._poses = truth if stamps is None else None
        self.ground_truth_file = poses
        self._imu = sequence.imu if imu else None
        # By the name everybody knows whether images are rectified.
        self.image_topic = RAW_IMAGE_TOPIC if sequence.distorted else IMAGE_TOPIC
        self.info_topic = INFO_TOPIC
        known = self._poses is not None or self._stamped is not None
        self.ground_truth_topic = GROUND_TRUTH_TOPIC if known else None
        self.beside = {} if self._imu is None else {'imu': IMU_TOPIC,
                                                    'frames': STATIC_FRAMES_TOPIC}

    def __len__(self) -> int:
        """Count the images."""
        return len(self._sequence)

    def messages(self, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
        """
        Yield ground truth, CameraInfo and image of each frame in turn.

        The image comes last: whoever acts on it then has everything up to its stamp, and the
        first sample of the IMU beyond it.
        """
        sequence, felt = self._sequence, 0
        yield from _stamped_poses(self._stamped)
        for index, stamp in enumerate(sequence.stamps_ns.tolist()):
            if self._imu is not None and (
                    topics is None or not set(topics).isdisjoint(self.beside.values())):
                if index == 0:
                    yield _imu_frame(stamp, self._imu)
                for sample in self._imu.until(felt, stamp):
                    yield _imu_message(self._imu, sample)
                    felt = sample + 1
            if self._poses is not None and np.isfinite(self._poses[index]).all():
                yield _ground_truth(stamp, self._poses[index])
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
        """Yield how the IMU is turned against the camera, where it is wanted."""
        if self._imu is not None:
            yield _imu_frame(int(self._sequence.stamps_ns[0]), self._imu).message

    def close(self) -> None:
        """Nothing is held open."""


class BagRecording(Recording):
    """
    The camera in a bag, with its ground truth and what else is wanted.

    Topics that aren't named are found; DjetError lists the choices where that is not possible.
    """

    def __init__(self, path: Path, image_topic: str | None = None, info_topic: str | None = None,
                 poses: Path | None = None, beside: Mapping[str, str | None] | None = None,
                 strict: bool = True) -> None:
        """Open the bag and choose the topics; see ``open_recording``."""
        self.bag = Bag(path)
        try:
            self._topics = [topic for topic in self.bag.topics if topic.message_count]
            if not self._topics:
                # If a break is the reason, this tells it.
                next(self.bag.messages(), None)
                raise DjetError(f'{path} holds no message; record it again')
            image = self._choose('image', '--image-topic', IMAGE_TYPES, image_topic)
            self.image_topic, self._count = image.name, image.message_count
            self.info_topic = self._info_topic(info_topic)
            self.ground_truth_topic = (self._ground_truth_topic() if poses is None
                                       else GROUND_TRUTH_TOPIC)
            self.beside = dict(self._beside(beside or {}, strict))
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
        """Yield the messages in the order of recording, and what the file of poses adds."""
        wanted = {topic for topic in (self.image_topic, self.info_topic, self.ground_truth_topic,
                                      *self.beside.values())
                  if topic and (topics is None or topic in topics)}
        if self._poses is None:
            yield from self.bag.messages(wanted)
            return
        wanted.discard(GROUND_TRUTH_TOPIC)
        stamps, poses = self._poses
        if stamps is None:
            yield from self._each_with_its_pose(wanted, poses)
            return
        yield from _stamped_poses((stamps, poses))
        yield from self.bag.messages(wanted)

    def _each_with_its_pose(self, wanted: set[str], poses: Array) -> Iterator[BagMessage]:
        """Poses without stamps belong to the images, one to each."""
        rows = iter(poses)
        for message in self.bag.messages(wanted | {self.image_topic}):
            if message.topic == self.image_topic and (pose := next(rows, None)) is not None:
                yield _ground_truth(stamp_ns(message.message.header), pose)
            if message.topic in wanted:
                yield message

    def static_frames(self) -> Iterator[Any]:
        """Yield the TFMessages of /tf_static; DjetError where there is damage."""
        if static_frames.TOPIC in {topic.name for topic in self._fitting((static_frames.TYPE,))}:
            for one in self.bag.messages({static_frames.TOPIC}):
                yield one.message

    def close(self) -> None:
        """Close the bag."""
        self.bag.close()

    def _beside(self, wanted: Mapping[str, str | None], strict: bool
                ) -> Iterator[tuple[str, str]]:
        """Find the topics of what is wanted by name; where that is not strict, those there are."""
        for what, name in wanted.items():
            # The bag's own ground truth is no measurement, even where other poses replace it.
            fitting = [topic.name for topic in self._fitting(BESIDE[what]) if topic.name not in (
                self._ground_truth_topic(), self.image_topic)
                and (what not in _KNOWN_BY or _KNOWN_BY[what].search(topic.name))]
            chosen = [topic for topic in fitting if name in (None, topic)]
            if len(chosen) == 1:
                yield what, chosen[0]
            elif strict and what == 'tf':
                raise DjetError(f'{self.bag.path} has no /tf, which odometry.guess_frame asks '
                                'for; record it too')
            elif strict and name is not None:
                raise DjetError(f"{self.bag.path} has no topic '{name}' for '{what}'; choose with "
                                f'--{what}-topic from: {", ".join(fitting) or "none"}')
            elif strict:
                raise DjetError(f"{self.bag.path}: one topic of '{what}' is needed; choose one "
                                f'with --{what}-topic from: {", ".join(fitting) or "none"}')
        if wanted and any(topic.name == STATIC_FRAMES_TOPIC for topic in self._topics):
            yield 'frames', STATIC_FRAMES_TOPIC

    def _require_one_type(self) -> None:
        """Raise DjetError if a chosen topic was recorded with several types."""
        for name in (self.image_topic, self.info_topic, self.ground_truth_topic,
                     *self.beside.values()):
            types = sorted(topic.msgtype for topic in self._topics if topic.name == name)
            if len(types) > 1:
                raise DjetError(one_line(
                    f"{self.bag.path} has messages of several types on '{name}': "
                    f'{", ".join(types)}; record them on topics of their own'))

    def _fitting(self, types: Collection[str]) -> list[Topic]:
        return [topic for topic in self._topics if topic.msgtype in types]

    def _choose(self, what: str, option: str, types: Collection[str], name: str | None) -> Topic:
        """Topic of some types by its name or, without one, because there is only one."""
        fitting = self._fitting(types)
        chosen = [topic for topic in fitting if name in (None, topic.name)]
        if len(chosen) == 1:
            return chosen[0]
        if not fitting:
            others = ', '.join(f'{topic.name} ({topic.msgtype})' for topic in self._topics[:12])
            raise DjetError(f'{self.bag.path} has no {what} topic, but {one_line(others)}; '
                            'record it too')
        choices = one_line(', '.join(
            f'{topic.name} ({topic.message_count})' for topic in fitting))
        if name is not None:
            raise DjetError(f"{self.bag.path} has no {what} topic '{name}'; choose from {choices}")
        raise DjetError(f'{self.bag.path} has {len(chosen)} {what} topics: {choices}; '
                        f'choose one with {option}')

    def _info_topic(self, name: str | None) -> str:
        """Topic beside the images (image_transport's rule), or the only one of an only camera."""
        if name is None:
            have = self._fitting(CAMERA_INFO_TYPES)
            # .../image_raw/compressed belongs to .../camera_info, as .../image_raw does.
            for folder in list(PurePosixPath(self.image_topic).parents)[:2]:
                if (beside := str(folder / 'camera_info')) in {topic.name for topic in have}:
                    return beside
            if len(have) == 1 and len(self._fitting(IMAGE_TYPES)) > 1:
                raise DjetError(f'{self.bag.path} has no CameraInfo beside {self.image_topic}; '
                                f'if {have[0].name} is meant, say so with --info-topic')
        return self._choose('CameraInfo', '--info-topic', CAMERA_INFO_TYPES, name).name

    def _ground_truth_topic(self) -> str | None:
        """Name the only topic that calls itself ground truth."""
        fitting = [topic.name for topic in self._fitting(POSE_TYPES)
                   if re.search('ground_?truth', topic.name)]
        return fitting[0] if len(fitting) == 1 else None


def open_recording(path: Path, image_topic: str | None = None, info_topic: str | None = None,
                   poses: Path | None = None, beside: Mapping[str, str | None] | None = None,
                   strict: bool = True, damaged: bool = False) -> Recording:
    """
    Open a bag, or a folder of image files in one of the layouts of ``open_sequence``.

    poses: ground truth instead of the recording's own, as KITTI (one row per image) or TUM
    (stamped) file; beside: what else is wanted, by names in BESIDE, each with its topic or, where
    that is to be found, None; strict: whether it has to be there; damaged: whether files of images
    that can't be decoded are handed on as a bag's are, as CompressedImage. Raises DjetError.
    """
    beside = beside or {}
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise DjetError(f'{path} is neither a file nor a folder; give a bag or a folder of images')
    if is_bag(path) or not path.exists():
        return BagRecording(path, image_topic, info_topic, poses, beside, strict)
    if strict and (image_topic or info_topic or beside.keys() - {'imu'} or any(beside.values())):
        raise DjetError(f'{path} is a folder of images; topics, speeds, guesses and masks by '
                        'stamp are for bags')
    sequence = open_sequence(path, own_poses=poses is None)
    if strict and 'imu' in beside and sequence.imu is None:
        raise DjetError(f'{path} holds nothing of an IMU; leave odometry.imu out, or give a '
                        'recording that has one')
    return SequenceRecording(sequence, 'imu' in beside, poses, damaged)


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


def _stamped_poses(known: tuple[NDArray[np.int64], Array] | None) -> Iterator[BagMessage]:
    """Make messages of poses with stamps of their own, if there are any."""
    if known is not None:
        for stamp, pose in zip(known[0].tolist(), known[1], strict=True):
            yield _ground_truth(stamp, pose)


def _ground_truth(stamp: int, pose: Array) -> BagMessage:
    return BagMessage(GROUND_TRUTH_TOPIC, stamp, MAKE.pose_in(stamp, WORLD_FRAME, pose))


def _imu_frame(stamp: int, imu: ImuTrack) -> BagMessage:
    """Tell how the IMU is turned against the camera; where it is does not matter to its rates."""
    pose = np.eye(4)
    pose[:3, :3] = imu.to_camera
    return BagMessage(STATIC_FRAMES_TOPIC, stamp,
                      MAKE.frame(stamp, CAMERA_FRAME, IMU_FRAME, pose))


def _imu_message(imu: ImuTrack, index: int) -> BagMessage:
    stamp = int(imu.stamps_ns[index])
    return BagMessage(IMU_TOPIC, stamp, MAKE.imu(
        stamp, IMU_FRAME, imu.rates[index], imu.accelerations[index]))
