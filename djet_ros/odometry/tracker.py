"""
The odometry from ROS messages to ROS messages, without clock, thread or socket.

The live nodes and the offline replay are thin front ends of it, so that the same messages in the
same order give the same poses everywhere.
"""

from __future__ import annotations

from collections.abc import Callable
import math
from typing import Any, NamedTuple

from djet_ros import compiled
from djet_ros.config.sections import Config, NODE_NAME, OdometryConfig
from djet_ros.core.types import Array, STARTED, TRACKED, View
from djet_ros.odometry.auxiliary import AuxiliaryInputs
from djet_ros.odometry.camera import Camera, is_rectified, same_camera
from djet_ros.odometry.debug_image import debug_image
from djet_ros.odometry.diagnostics import Counts, diagnose, Diagnosis, StampRate
from djet_ros.odometry.frame import Frame
from djet_ros.odometry.health import (
    arm_without_metres,
    calibration_off,
    Complaint,
    deviation_text,
    frame_mismatch,
    has_frame,
    Health,
    restart_reason,
)
from djet_ros.odometry.images import BadMessage
from djet_ros.odometry.messages import (
    frame_of,
    Messages,
    MessageType,
    mounted_frame,
    stamp_ns,
)
from djet_ros.odometry.order import Order
from djet_ros.odometry.path import Path
from djet_ros.odometry.preprocessing import Preprocessor, Settings
from djet_ros.odometry.result import OdometryResult
from djet_ros.odometry.scale import same_scale, scale_source, ScaleSource
from djet_ros.odometry.state import State, StateMachine
from djet_ros.odometry.static_frames import Transform
from djet_ros.odometry.visual_odometry import VisualOdometry
import numpy as np
from numpy.typing import NDArray

_DIAGNOSTICS_PERIOD_NS = 10**9


class Outgoing(NamedTuple):
    """A message to publish; a topic without a leading slash is in the node's namespace."""

    topic: str
    message: Any


class Tracker:
    """
    Runs the odometry on images with their CameraInfo, and makes messages of the results.

    message_type: returns the class for a type name such as 'sensor_msgs/msg/Image'; image_topic:
    resolved name of the image topic, by which odometry.rectified 'auto' decides; speed_topics:
    topics of speeds, for texts; static_mask: (H, W) bool, pixels of all images that
    odometry.mask_file excludes; node: name of the node in diagnostics.

    Outgoing topics: relative_pose, relative_pose_cov (for pairs whose motion was estimated),
    relative_pose_status, odometry (also for a first frame), path, /tf (both if configured),
    /diagnostics (on a change of state and once per second of the images' stamps).
    """

    def __init__(self, config: Config, message_type: MessageType,
                 scale: ScaleSource | None = None, image_topic: str = '',
                 speed_topics: str = 'speed or speed_odometry', node: str = NODE_NAME,
                 static_mask: NDArray[np.bool_] | None = None) -> None:
        self.config = config
        # What a front end adds to each diagnostics message, as its latency, and to complaints.
        self.node_values: Callable[[], dict[str, str]] = dict
        self.node_complaints: Callable[[], list[Complaint]] = list
        self._message_type = message_type
        self._image_topic = image_topic
        self._speed_topics = speed_topics
        self._scale = scale or scale_source(config.odometry)
        self._inputs = AuxiliaryInputs(config.odometry, self._scale, static_mask)
        self._odometry = VisualOdometry(config.estimator, config.odometry, self._scale,
                                        self._inputs.gyro, self._inputs.guess)
        self._node = node
        self._mounting: Array | None = None
        self._messages = Messages(message_type, config.odometry, node)
        self._info: Any = None
        self._info_frame = ''
        self._camera: Camera | None = None
        self._masked = static_mask is not None
        self._states = StateMachine()
        self._forget()

    def reset(self) -> None:
        """
        Forget all images, poses, speeds and counts; the next image is the first.

        The CameraInfo is kept, because a latched one is not sent twice.
        """
        self._odometry.reset()
        self._scale.reset()
        self._inputs.reset()
        self._forget()

    def _forget(self) -> None:
        self.counts = Counts()
        self.last: OdometryResult | None = None
        # Outcome of the newest image: a status, or the reason why it was not used.
        self.verdict = ''
        # Why the newest message could not be used, for a log; None if it could.
        self.problem: BadMessage | None = None
        # Why the newest frame restarted the odometry, for a log.
        self.remark = ''
        # Whether the newest frame reset everything, as its stamp went back.
        self.went_back = False
        self._frame: Frame | None = None
        self._preprocessor = Preprocessor()
        self._health = Health(self.config.odometry, self._speed_topics)
        odometry = self.config.odometry
        self._order = Order(odometry.max_backwards, odometry.max_gap)
        self._path = Path(self.config.ros.path_length, self.config.ros.path_period)
        self._rate = StampRate()
        self._states.reset()
        self._enter_waiting()
        # The last diagnostics: state, detail and names of the complaints, and the stamp.
        self._reported: tuple[tuple[str, ...], int] | None = None

    def configure(self, config: Config) -> None:
        """
        Change the parameters from the next frame on; the trajectory continues.

        Raises DjetError if the scale needs something that is not available at run time.
        """
        before, after = self.config.odometry, config.odometry
        if not same_scale(before, after):
            self._scale = scale_source(after)
        self.config = config
        self._odometry.configure(config.estimator, after, self._scale)
        self._inputs.configure(after, self._scale)
        self._odometry.set_priors(self._inputs.gyro, self._inputs.guess)
        self._messages = Messages(self._message_type, after, self._node, self._mounting)
        self._health.configure(after)
        self._order.configure(after.max_backwards, after.max_gap)
        self._path.configure(config.ros.path_length, config.ros.path_period)
        # A path has poses of one frame only.
        if _frames(before) != _frames(after):
            self._path.discard_poses()
        if self._info is not None and (before.rectified, before.residual_k1) != (
                after.rectified, after.residual_k1):
            info, self._info = self._info, None
            self.camera_info(info)

    def camera_info(self, message: Any) -> list[Outgoing]:
        """Take a CameraInfo; a new camera is made only if it differs from the last one."""
        self._info_frame = frame_of(message.header)
        if self._info is not None and same_camera(self._info, message):
            return []
        self._info = message
        try:
            config = self.config.odometry
            self._camera = Camera.from_info(
                message, is_rectified(config.rectified, self._image_topic),
                config.residual_k1)
        except BadMessage as problem:
            self._camera = None
            self.counts.rejected_infos[problem.reason] += 1
            return self._reject(problem, stamp_ns(message.header))
        self._odometry.recalibrated()
        self.problem = None
        if self.last is None:
            self._enter_waiting()
        return []

    @property
    def camera(self) -> Camera | None:
        """Return the camera of the newest CameraInfo; None if there is no usable one."""
        return self._camera

    def prepare_ahead(self, message: Any) -> None:
        """
        Prepare an image ahead, in parallel with the work on the one before it.

        This is optional, does not change the results, and the image need not be processed.
        """
        if self._camera is not None and not self._states.paused:
            # A mask of the image may not be known yet.
            masked = self._masked or bool(self.config.odometry.mask)
            self._preprocessor.start(message, self._settings(self._camera), not masked)

    def _settings(self, camera: Camera) -> Settings:
        return Settings(camera, self._odometry.estimator, self.config.odometry.gray_limits())

    def follows_gap(self, image: Any) -> bool:
        """
        Return whether an image comes after a gap of more than max_gap, or has a wrong stamp.

        The image after it decides which; a front end should wait for that one.
        """
        return not self._states.paused and self._order.follows_gap(stamp_ns(image.header))

    def image(self, message: Any, following: Any = None) -> list[Outgoing]:
        """
        Process an Image or a CompressedImage, return the messages to publish.

        following: the image after it, if known; it matters only if this one ``follows_gap``.
        """
        self.counts.received += 1
        stamp = stamp_ns(message.header)
        if self._states.paused:
            self._drop('paused')
            return self._diagnostics_if_due(stamp)
        if self._camera is None:
            return self._without_camera(stamp)
        following_ns = None if following is None else stamp_ns(following.header)
        if self._frame is not None and (reason := self._order.misplaced(stamp, following_ns)):
            self._drop(reason, frame_of(message.header))
            return self._diagnostics_if_due(self._frame.stamp_ns)
        try:
            prepared = self._preprocessor.image(message, self._settings(self._camera))
            left_out = self._inputs.left_out(stamp, frame_of(message.header), prepared.shape,
                                             self._camera)
        except BadMessage as problem:
            self.counts.rejected[problem.reason] += 1
            self.verdict = problem.reason
            return self._reject(problem, stamp)
        self._health.image(prepared.few_levels, left_out)
        # A view that was prepared ahead is without the pixels that the camera does not see only.
        usable = left_out is self._camera.unseen(prepared.shape)
        return self._process(Frame(prepared.gray, self._camera.K, stamp, frame_of(message.header),
                                   left_out), prepared.view if usable else None)

    @property
    def mounted(self) -> bool:
        """Return whether the camera's pose on base_frame is known, or not needed."""
        return not self.config.odometry.base_frame or self._mounting is not None

    def mount(self, transform: Transform, image_frame: str) -> str:
        """
        Look up the camera's pose on base_frame, which all poses in the odom frame need.

        image_frame: frame_id of the images. Returns a text on what was found, or an empty one.
        """
        config = self.config.odometry
        camera, axes = mounted_frame(config, image_frame)
        found = transform(config.base_frame, camera)
        if found is None:
            return ''
        self._mounting = np.asarray(found @ axes)
        self._messages = Messages(self._message_type, config, self._node, self._mounting)
        x, y, z = found[:3, 3]
        return f'{camera} is at ({x:.3f}, {y:.3f}, {z:.3f}) m on {config.base_frame}'

    def pause(self) -> None:
        """Drop all images until ``resume``; the state is kept."""
        self._states.paused = True

    def resume(self) -> None:
        """Process images again; after more than max_gap the odometry restarts."""
        self._states.paused = False
        self._enter_waiting()

    def images_stopped(self) -> None:
        """Note that no image has come for a while; for front ends, which have a clock."""
        self._enter_waiting()
        self._rate = StampRate()

    @property
    def state(self) -> State:
        """Return the state of the odometry."""
        return self._states.state

    @property
    def detail(self) -> str:
        """Return the detail of the state, such as a status or a reason."""
        return self._states.detail

    def speed(self, message: Any) -> None:
        """Take a TwistStamped or an Odometry as the camera's speed, for odometry.scale 'speed'."""
        linear = (message.twist.twist if hasattr(message.twist, 'twist') else message.twist).linear
        self._scale.add_speed(stamp_ns(message.header), math.hypot(linear.x, linear.y, linear.z))

    def imu(self, message: Any) -> None:
        """Take an Imu, for odometry.imu."""
        self._inputs.imu(message)

    def guess(self, message: Any) -> None:
        """Take an Odometry as a guess, for odometry.guess and odometry.scale 'guess'."""
        self._inputs.other_odometry(message)

    def tf(self, message: Any) -> None:
        """Take a TFMessage of /tf, for odometry.guess_frame."""
        self._inputs.tf(message, static=False)

    def tf_static(self, message: Any) -> None:
        """Take a TFMessage of /tf_static, for odometry.guess_frame."""
        self._inputs.tf(message, static=True)

    def mask(self, message: Any) -> None:
        """Take the mask of an image, for odometry.mask."""
        self._inputs.mask(message)

    def needs(self, image: Any) -> str:
        """
        Return the name of an input that an image still needs, or an empty string.

        A front end should wait for it for a moment; later it is of no use to the image.
        """
        return self._inputs.needs(stamp_ns(image.header), frame_of(image.header))

    def missing_mountings(self, image_frame: str) -> dict[str, tuple[str, str]]:
        """Return frames (parent, child) with an unknown transform, keyed by 'imu' or 'guess'."""
        return self._inputs.missing_mountings(image_frame)

    @property
    def wants_frames(self) -> bool:
        """Return whether transforms are still to be looked up on tf."""
        return not self.mounted or self._inputs.wants_mountings

    def mount_sensor(self, what: str, mounting: Array) -> None:
        """Take a transform (4, 4) of ``missing_mountings``."""
        self._inputs.mount(what, mounting)

    def count_dropped(self, reason: str, number: int = 1) -> None:
        """Count images that a front end received and dropped."""
        self.counts.received += number
        self.counts.dropped[reason] += number
        self._health.dropped(reason, number)

    def count_lost(self, number: int) -> None:
        """Note images that were sent and never received."""
        self._health.dropped('lost', number)

    @property
    def complaints(self) -> list[Complaint]:
        """Return the present problems and their remedies."""
        more = self._of_camera
        return [*self._health.complaints(self._scale, self.mounted),
                *(one for one in more if one is not None),
                *self.complaints_of_inputs, *self.node_complaints()]

    @property
    def _of_camera(self) -> tuple[Complaint | None, ...]:
        frame = self.last.frame_id if self.last else ''
        return (calibration_off(self._odometry.calibration),
                frame_mismatch(self._info_frame, frame),
                arm_without_metres(self.config.odometry, self._mounting))

    @property
    def complaints_of_content(self) -> list[Complaint]:
        """Return the problems of a whole recording."""
        found = (self._health.stamps_stood(), self._health.few_levels(),
                 self._health.never_measured(self._scale), self._health.two_cameras(),
                 *self._of_camera, *self.complaints_of_inputs)
        return [one for one in found if one is not None]

    @property
    def masked(self) -> str:
        """Return a text if a mask excludes nearly all of the newest image, or ''."""
        found = self._health.masked(least=1)
        return found.text if found else ''

    @property
    def complaints_of_inputs(self) -> list[Complaint]:
        """Return the problems of the inputs other than images."""
        return self._inputs.complaints(self.last.frame_id if self.last else '')

    def diagnosis(self) -> Diagnosis:
        """Return the content of a diagnostics message."""
        diagnosis = diagnose(self.state, self.detail, self.counts,
                             self.last, self._rate.hertz, self.complaints)
        diagnosis.values['scale source'] = self.config.odometry.scale
        diagnosis.values['inner loops'] = compiled.in_use()
        if (found := self._odometry.calibration) is not None:
            diagnosis.values['calibration off by'] = deviation_text(found)
        diagnosis.values.update(self._inputs.values())
        diagnosis.values.update(self.node_values())
        return diagnosis

    def diagnostics(self, stamp: int) -> Outgoing:
        """Return the diagnostics message with a stamp in nanoseconds."""
        diagnosis = self.diagnosis()
        return Outgoing('/diagnostics', self._messages.diagnostics(
            stamp, f'{self._node}: visual odometry', diagnosis.level, diagnosis.summary,
            diagnosis.values, self.last.frame_id if self.last else ''))

    def drawing(self) -> NDArray[np.uint8] | None:
        """Draw the last pair, (H, W, 3) BGR; None without one. Slow: only on demand."""
        if self._frame is None or self.last is None or self.last.relative is None:
            return None
        gray = self._odometry.estimator.undistorted(self._frame.gray, self._frame.K)
        return debug_image(gray, self.last.relative)

    def debug_image(self) -> Outgoing | None:
        """Return the same as a message, for subscribers; None without a pair."""
        picture = self.drawing()
        if picture is None or self._frame is None:
            return None
        return Outgoing('debug_image', self._messages.picture(
            self._frame.stamp_ns, self._frame.frame_id, picture))

    def landmarks(self) -> Outgoing | None:
        """Return the landmarks in the last frame; None unless they were observed in it."""
        if self.last is None or not self._odometry.newest_is_reference \
                or not len(places := self._odometry.landmarks()):
            return None
        return Outgoing('landmarks', self._messages.landmarks(self.last, places))

    def settled(self) -> Array:
        """Return landmarks (M, 3), in the first camera, that the last image refined last."""
        return self._in_first(self._odometry.landmarks(settled=True))

    def unsettled(self) -> Array:
        """Return landmarks (M, 3), in the first camera, that the next image may refine."""
        return self._in_first(self._odometry.landmarks())

    def _in_first(self, places: Array) -> Array:
        pose = self._odometry.reference_pose
        return np.asarray(places @ pose[:3, :3].T + pose[:3, 3])

    def _without_camera(self, stamp: int) -> list[Outgoing]:
        """Drop an image without a camera; an unusable CameraInfo stays the state."""
        self._drop('waiting_for_camera_info')
        self._enter_waiting()
        return self._diagnostics_if_due(stamp)

    def _drop(self, reason: str, image_frame: str | None = None) -> None:
        self.counts.dropped[reason] += 1
        self._health.dropped(reason, image_frame=image_frame)
        self.verdict = reason

    def _reject(self, problem: BadMessage, stamp: int) -> list[Outgoing]:
        self.problem = problem
        self._states.enter(State.REJECTING, problem.reason)
        return self._diagnostics_if_due(stamp)

    def _process(self, frame: Frame, view: View | None) -> list[Outgoing]:
        self.went_back = self._frame is not None and frame.stamp_ns < self._frame.stamp_ns
        if self.went_back:
            self._path.reset()
        result = self._odometry.process(frame, view)
        self.remark = restart_reason(result, self._frame.stamp_ns if self._frame else None,
                                     self.config.odometry)
        self.last, self._frame, self.problem = result, frame, None
        self._order.take(frame.stamp_ns)
        self._health.processed(result)
        self.counts.processed += 1
        self.verdict = result.status.value
        self.counts.status[self.verdict] += 1
        self._rate.add(frame.stamp_ns)
        self._states.processed(result, first=self.counts.processed == 1,
                               max_lost=self.config.odometry.max_lost)
        return [*self._poses(result), *self._diagnostics_if_due(frame.stamp_ns)]

    def _poses(self, result: OdometryResult) -> list[Outgoing]:
        make = self._messages
        outgoing = []
        if result.status in TRACKED:
            outgoing += [Outgoing('relative_pose', make.relative_pose(result)),
                         Outgoing('relative_pose_cov', make.relative_pose_cov(result))]
        outgoing.append(Outgoing('relative_pose_status', make.status(result)))
        if not self.mounted:
            return outgoing
        outgoing.append(Outgoing('odometry', make.odometry(result)))
        if result.status in TRACKED or result.status in STARTED:
            if self.config.ros.publish_tf and has_frame(self.config.odometry, result.frame_id):
                outgoing.append(Outgoing('/tf', make.transform(result)))
            if self.config.ros.publish_path and (
                    poses := self._path.add(make.pose_stamped(result), result.stamp_ns)):
                outgoing.append(Outgoing('path', make.path(poses)))
        return outgoing

    def _enter_waiting(self) -> None:
        """Enter the state of waiting for what is missing; an unusable CameraInfo stays it."""
        if self._camera is not None:
            self._states.enter(State.WAITING_FOR_IMAGE)
        elif self._info is None:
            self._states.enter(State.WAITING_FOR_CAMERA_INFO)

    def _diagnostics_if_due(self, stamp: int) -> list[Outgoing]:
        what = *self._states.key, *(one.name for one in self.complaints)
        if self._reported is not None:
            before, reported = self._reported
            if before == what and 0 <= stamp - reported < _DIAGNOSTICS_PERIOD_NS:
                return []
        self._reported = what, stamp
        return [self.diagnostics(stamp)]


def _frames(config: OdometryConfig) -> tuple[str, ...]:
    """Return what frames and axes the poses in the odom frame depend on."""
    return config.odom_frame, config.base_frame, config.camera_frame, config.frame_convention
