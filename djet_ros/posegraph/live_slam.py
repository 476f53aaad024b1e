"""
The live pose graph, from messages to messages, without clock, thread or socket.

Its motions come from the odometry, its loops from the images of keyframes.
"""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from djet_ros.config.sections import Config
from djet_ros.core.types import Array
from djet_ros.errors import DjetError
from djet_ros.odometry.camera import Camera, is_rectified, same_camera
from djet_ros.odometry.frame import Frame
from djet_ros.odometry.images import BadMessage, gray_image
from djet_ros.odometry.masks import Masks
from djet_ros.odometry.messages import (
    camera_frame,
    frame_of,
    MessageFactory,
    MessageType,
    mounted_frame,
    OPTICAL_TO_BODY,
    stamp_ns,
)
from djet_ros.odometry.static_frames import Transform
from djet_ros.odometry.tracker import Outgoing
from djet_ros.posegraph.keyframe_map import KeyframeMap
from djet_ros.posegraph.step_messages import StepMessages
from djet_ros.posegraph.steps import Step
import numpy as np
from numpy.typing import NDArray

_DIAGNOSTICS_PERIOD_NS = 10**9


class LiveSlam:
    """
    Closes loops on a running odometry.

    config: sections slam and estimator, and the parameters shared with the odometry, listed in
    live/parameters.py; static_mask: (H, W) bool, pixels that odometry.mask_file excludes from
    all images; message_type: function from a type name to its class; image_topic: resolved image
    topic, for odometry.rectified 'auto'; node: node name in the diagnostics.

    Outgoing topics: /tf (map to odometry frame, for each step), path (optimised poses of the
    keyframes and of the newest frame), /diagnostics.
    """

    def __init__(self, config: Config, message_type: MessageType, image_topic: str = '',
                 node: str = 'pose_graph_node',
                 static_mask: NDArray[np.bool_] | None = None) -> None:
        self.config, self.slam = config, config.slam
        # Returns values that the live node adds to each diagnostics message.
        self.node_values: Callable[[], dict[str, str]] = dict
        # Why the newest message discarded the map, for the log.
        self.remark = ''
        self._messages = MessageFactory(message_type)
        self._node = node
        self._rectified = is_rectified(config.odometry.rectified, image_topic)
        # Pose of the camera's optical frame in the frame whose poses are published.
        self._mounting = np.eye(4)
        if config.odometry.frame_convention == 'body':
            self._mounting[:3, :3] = OPTICAL_TO_BODY
        self.mounted = not config.odometry.base_frame
        self._info: Any = None
        self._camera: Camera | None = None
        # Images with their cameras by stamp; None before the first CameraInfo.
        self._images: OrderedDict[int, tuple[Any, Camera | None]] = OrderedDict()
        # frame_id of the newest image.
        self._image_frame = ''
        self._masks = Masks(static_mask)
        self.reset()

    def reset(self) -> None:
        """Discard the map and all waiting messages, but not the CameraInfo."""
        self._images.clear()
        self._masks.reset()
        self._begin()

    def _begin(self) -> None:
        self.map = KeyframeMap(self.config, max_keyframes=self.slam.max_keyframes)
        # Stamp of the last optimisation (ns), and whether edges were found since.
        self._optimised_ns, self._changed = 0, False
        # Why the newest message was rejected, for the log; None if it was accepted.
        self.problem: DjetError | None = None
        self.rejected: Counter[str] = Counter()
        self._steps = self._new_steps()
        self._last: Step | None = None
        self._path_stamp = self._said_stamp = -np.inf
        self._said = ''

    def _new_steps(self) -> StepMessages:
        config = self.config.odometry
        return StepMessages(config.frame_convention, config.base_frame,
                            self._mounting if config.base_frame else None)

    def mount(self, transform: Transform) -> str:
        """
        Look up the pose of the camera in base_frame, without which no odometry can be used.

        Returns what is missing for it, or ''.
        """
        if not self._images:
            return 'no image received yet, whose frame_id is the frame of the camera'
        config = self.config.odometry
        newest, _ = next(reversed(self._images.values()))
        camera, axes = mounted_frame(config, frame_of(newest.header))
        found = transform(config.base_frame, camera)
        if found is None:
            return (f"tf has no transform from '{config.base_frame}' (odometry.base_frame) to "
                    f"'{camera}'; publish it on /tf_static")
        self._mounting, self.mounted = np.asarray(found @ axes), True
        self._steps = self._new_steps()
        return ''

    # Inputs

    def camera_info(self, message: Any) -> None:
        """Take a CameraInfo for the images that arrive after it."""
        if self._info is None or not same_camera(self._info, message):
            self._info = message
            try:
                self._camera = Camera.from_info(message, self._rectified,
                                                self.config.odometry.residual_k1)
                self.problem = None
            except BadMessage as problem:
                self._camera = None
                self._reject('camera_info', problem)

    def image(self, message: Any) -> None:
        """Take an Image or CompressedImage; it waits for the odometry of its stamp."""
        stamp, self._image_frame = stamp_ns(message.header), frame_of(message.header)
        self._images[stamp] = message, self._camera
        self._images.move_to_end(stamp)
        if len(self._images) > self.slam.image_buffer:
            self._images.popitem(last=False)

    def mask(self, message: Any) -> None:
        """Take the mask of an image (odometry.mask)."""
        self._masks.add(message)

    def relative_pose(self, message: Any) -> list[Outgoing]:
        """Take a PoseWithCovarianceStamped of the current camera in the previous one."""
        try:
            self._check_convention(message.header.frame_id)
            return self._take(self._steps.relative_pose(message))
        except DjetError as problem:
            self._reject('relative_pose_cov', problem)
            return []

    def relative_pose_status(self, message: Any) -> list[Outgoing]:
        """Take the status that the odometry publishes for a frame."""
        try:
            return self._take(self._steps.status(message))
        except DjetError as problem:
            self._reject('relative_pose_status', problem)
            return []

    def odometry(self, message: Any) -> list[Outgoing]:
        """Take an Odometry; a step back in time starts a new map."""
        stamp, steps = stamp_ns(message.header), self._steps
        if stamp < steps.newest_ns:
            self.remark = (f'the odometry went back in time by '
                           f'{(steps.newest_ns - stamp) * 1e-9:.3f} s: map of '
                           f'{len(self.map.keyframes)} keyframes discarded; a new map starts')
            # Its image, and perhaps its other messages, have arrived already: keep them.
            self._begin()
            steps.go_back(stamp)
            self._steps = steps
        try:
            return self._take(self._steps.odometry(message))
        except DjetError as problem:
            self._reject('odometry', problem)
            return []

    # Outputs

    def work(self, *, at_once: bool = False) -> list[Outgoing]:
        """
        Search the loops of one keyframe, and optimise if slam.optimise_period has passed.

        To be called while no messages are waiting. at_once: optimise without regard to the period.
        """
        self._changed |= self.map.search_loops()
        if not self._changed or self._last is None:
            return []
        waited = self._last.stamp_ns - self._optimised_ns
        if not at_once and waited < self.slam.optimise_period * 1e9:
            return []
        self.map.optimise()
        self._optimised_ns, self._changed = self._last.stamp_ns, False
        return [self._path(self._last)]

    @property
    def idle(self) -> bool:
        """Whether no keyframe is queued for the loop search."""
        return not self.map.waiting

    @property
    def state(self) -> tuple[str, str]:
        """Return the level (OK, WARN, ERROR) and summary for the diagnostics."""
        if self.problem is not None:
            return 'ERROR', 'message rejected'
        if not self.mounted:
            return 'WARN', 'waiting for the mounting of the camera on tf'
        if self._last is None:
            return 'WARN', 'waiting for odometry'
        if self._last.odom_frame == self.slam.map_frame:
            return 'ERROR', 'slam.map_frame is odom_frame'
        if not self.map.keyframes:
            return 'WARN', ('waiting for camera_info' if self._info is None
                            else 'waiting for the images of the odometry')
        return 'OK', 'mapping'

    def diagnostics(self, stamp: int) -> Outgoing:
        """Return the diagnostics message with a stamp in nanoseconds."""
        graph, (level, summary) = self.map, self.state
        values = {
            'state': summary,
            'keyframes': str(len(graph.keyframes)),
            'keyframes forgotten': str(graph.first),
            'keyframes waiting': str(graph.waiting),
            'keyframes without image': str(graph.without_image),
            'loops': str(graph.count('loop')),
            'loops not trusted': str(graph.rejected_loops),
            'links': str(graph.count('link')),
            'unknown motions': str(graph.count('unknown')),
            'optimisations': str(graph.optimisations),
            'relative poses missing': str(self._steps.missing),
            **{f'messages rejected: {topic}': str(count)
               for topic, count in sorted(self.rejected.items())},
            **self.node_values()}
        return Outgoing('/diagnostics', self._messages.diagnostics(
            stamp, f'{self._node}: pose graph', level,
            f'{summary}: {self.problem}' if self.problem else summary, values,
            frame_of(self._info.header) if self._info is not None else ''))

    def _take(self, steps: list[Step]) -> list[Outgoing]:
        outgoing = []
        for step in steps:
            self.problem = None
            self.map.extend(step, self._frame)
            self._forget_images(step)
            self._last = step
            # tf refuses a frame that is its own parent.
            if self.slam.publish_tf and self.map.keyframes \
                    and step.odom_frame != self.slam.map_frame:
                outgoing.append(Outgoing('/tf', self._messages.frame(
                    step.stamp_ns, self.slam.map_frame, step.odom_frame,
                    self._turned(self.map.correction))))
            if self.map.keyframes and \
                    step.stamp_ns - self._path_stamp >= self.slam.path_period * 1e9:
                outgoing.append(self._path(step))
            outgoing += self._diagnostics_if_due(step.stamp_ns)
        return outgoing

    def _frame(self, stamp: int) -> Frame | None:
        """Return the frame of the image with a stamp, and remove the image; None without one."""
        message, camera = self._images.pop(stamp, (None, None))
        # The first CameraInfo may arrive after the first image that the odometry used it for.
        camera = camera or self._camera
        if message is None or camera is None:
            return None
        try:
            raw = gray_image(message, self.config.odometry.gray_limits())
            return Frame(camera.corrected(raw), camera.K, stamp, frame_of(message.header),
                         self._masks.of(stamp, raw.shape, camera))
        except BadMessage as problem:
            self._reject('image', problem)
            return None

    def _forget_images(self, step: Step) -> None:
        """Remove the images since the last step: keyframes are made of later ones only."""
        # After a step back in time, earlier ones may wait for the new map.
        after = -np.inf if self._last is None else self._last.stamp_ns
        for stamp in [one for one in self._images if after < one <= step.stamp_ns]:
            del self._images[stamp]

    def _path(self, last: Step) -> Outgoing:
        self._path_stamp = last.stamp_ns
        poses = [(one.stamp_ns, one.pose) for one in self.map.keyframes]
        if poses[-1][0] != last.stamp_ns:
            poses.append((last.stamp_ns, self.map.correction @ last.pose))
        return Outgoing('path', self._messages.path([
            self._messages.pose_in(stamp, self.slam.map_frame, self._turned(pose))
            for stamp, pose in poses]))

    def _turned(self, pose: Array) -> Array:
        return np.asarray(self._mounting @ pose @ np.linalg.inv(self._mounting))

    def _check_convention(self, frame: str) -> None:
        """Raise DjetError if a frame of the odometry is named by the other frame_convention."""
        own = self.config.odometry
        other = replace(own, camera_frame='', frame_convention=(
            'optical' if own.frame_convention == 'body' else 'body'))
        if frame != camera_frame(own, self._image_frame) \
                and frame == camera_frame(other, self._image_frame):
            raise DjetError(
                f"the relative pose is in '{frame}', which has the axes of "
                f'odometry.frame_convention {other.frame_convention}, while it is '
                f'{own.frame_convention} here; give both nodes the same')

    def _reject(self, topic: str, problem: DjetError) -> None:
        self.rejected[topic] += 1
        self.problem = problem

    def _diagnostics_if_due(self, stamp: int) -> list[Outgoing]:
        if self._said == self.state[1] and stamp - self._said_stamp < _DIAGNOSTICS_PERIOD_NS:
            return []
        self._said, self._said_stamp = self.state[1], stamp
        return [self.diagnostics(stamp)]
