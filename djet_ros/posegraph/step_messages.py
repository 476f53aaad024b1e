"""
Conversion of the odometry's messages to steps.

A step combines three messages of one stamp: the Odometry (pose of the camera), the relative pose
(motion and covariance) and the status (reference frame of the motion, kind of scale).
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import Any, NamedTuple

from djet_ros.core.types import Array, STARTED, TRACKED
from djet_ros.errors import DjetError
from djet_ros.odometry.messages import (
    frame_status,
    FrameStatus,
    OPTICAL_TO_BODY,
    pose_of,
    stamp_ns,
)
from djet_ros.odometry.scale import Scale
from djet_ros.odometry.uncertainty import rotated
from djet_ros.posegraph.steps import Step
import numpy as np

# Frames that may wait for the rest of their messages.
_MAX_WAITING = 1000


class _Parts(NamedTuple):
    """The messages of a frame received so far."""

    status: FrameStatus | None = None
    odometry: Any = None
    relative: Any = None

    @property
    def complete(self) -> bool:
        """Whether all messages of the frame are there."""
        return self.odometry is not None and self.status is not None and (
            self.relative is not None or self.status.status not in TRACKED)


class StepMessages:
    """
    Synchronises the Odometry, relative pose and status of each stamp.

    convention: axes in messages, 'optical' or 'body'; base_frame: frame of the vehicle if the
    odometry is of it, with the pose (4, 4) of the camera's optical frame in it, mounting; missing:
    number of frames whose messages were incomplete; newest_ns: stamp of the last Odometry, or -1.
    """

    def __init__(self, convention: str, base_frame: str = '', mounting: Array | None = None
                 ) -> None:
        self._axes = np.eye(4)
        if convention == 'body':
            self._axes[:3, :3] = OPTICAL_TO_BODY
        self._base_frame = base_frame
        self._mounting = self._axes if mounting is None else mounting
        self.missing = 0
        self._parts: dict[int, _Parts] = {}
        # Frames of failed pairs, newest last; one may be the reference of the next motion.
        self._bad: deque[Step] = deque(maxlen=_MAX_WAITING)
        self.newest_ns = -1

    def go_back(self, stamp: int) -> None:
        """Restart at a stamp; keep messages that are waiting for it."""
        self.missing, self.newest_ns = 0, -1
        self._bad.clear()
        self._parts = {at: parts for at, parts in self._parts.items()
                       if at == stamp and parts.odometry is None}

    def relative_pose(self, message: Any) -> list[Step]:
        """Take a relative pose, and return the steps that it completes."""
        return self._add(stamp_ns(message.header), relative=message)

    def status(self, message: Any) -> list[Step]:
        """Take a status message, and return the steps that it completes."""
        status = frame_status(message)
        return self._add(status.stamp_ns, status=status)

    def odometry(self, message: Any) -> list[Step]:
        """Take an Odometry that does not go back in time; return the steps that it completes."""
        stamp, pose = pose_of(message)
        if stamp == self.newest_ns:
            return []
        self.newest_ns = stamp
        if not np.isfinite(pose).all():
            raise DjetError(f'the pose of the odometry with stamp {stamp} ns is not finite; check '
                            'the publisher of the odometry')
        return self._add(stamp, odometry=message)

    def _add(self, stamp: int, **part: Any) -> list[Step]:
        parts = self._parts[stamp] = self._parts.get(stamp, _Parts())._replace(**part)
        if not parts.complete or parts.status is None:
            if len(self._parts) > _MAX_WAITING:
                del self._parts[next(iter(self._parts))]
            return []
        # Earlier frames will not be completed any more.
        self.missing += sum(at < stamp and one.odometry is not None
                            for at, one in self._parts.items())
        self._parts = {at: one for at, one in self._parts.items() if at > stamp}
        return self._step(parts.status, parts)

    def _step(self, status: FrameStatus, parts: _Parts) -> list[Step]:
        """
        Return the steps that a complete frame adds.

        A failed pair adds none, as the next pair may bridge it. If the next pair instead starts
        from its frame, that frame's step is added first.
        """
        step = self._without_motion(status, parts.odometry)
        if status.status in STARTED:
            self._bad.clear()
            return [step]
        if status.status not in TRACKED:
            self._bad.append(step)
            return []
        step = self._with_motion(step, status, parts)
        reference = [bad for bad in self._bad if bad.stamp_ns == step.previous_stamp_ns]
        self._bad.clear()
        return [*reference, step]

    def _without_motion(self, status: FrameStatus, odometry: Any) -> Step:
        """Return the step of a frame by its Odometry and status alone."""
        _, pose = pose_of(odometry)
        return Step(status.stamp_ns, status.status, _of_camera(pose, self._mounting),
                    odom_frame=odometry.header.frame_id, keyframe=status.keyframe,
                    camera_correction=status.camera_correction,
                    rotation_covariance=None if self._base_frame else rotation_covariance_of(
                        odometry, self._axes[:3, :3]))

    def _with_motion(self, step: Step, status: FrameStatus, parts: _Parts) -> Step:
        """Return a step with the relative pose; DjetError if it contradicts the Odometry."""
        expected = self._base_frame or parts.relative.header.frame_id
        if parts.odometry.child_frame_id != expected:
            raise DjetError(
                f"the child_frame_id of the odometry is '{parts.odometry.child_frame_id}', not "
                f"'{expected}'; give both nodes the same odometry.base_frame and "
                'odometry.frame_convention')
        _, motion = pose_of(parts.relative)
        if not np.isfinite(motion).all():
            raise DjetError(f'the relative pose with stamp {status.stamp_ns} ns is not finite; '
                            'check the publisher of the odometry')
        covariance = np.asarray(parts.relative.pose.covariance, np.float64).reshape(6, 6)
        step = replace(step, previous_stamp_ns=status.reference_ns,
                       motion=_of_camera(motion, self._axes),
                       covariance=rotated(self._axes[:3, :3].T, covariance),
                       scale_known=status.scale is not Scale.UNKNOWN,
                       metric=status.scale is Scale.METRIC)
        if step.tracked:
            step.check(f'odometry edge to {status.stamp_ns} ns')
        return step


def rotation_covariance_of(odometry: Any, axes: Array) -> Array | None:
    """
    Return the rotation covariance (3, 3) of an Odometry's pose, in the axes of the optical frame.

    axes: (3, 3) rotation of the optical frame in that of the messages. None if it is not finite.
    """
    covariance = np.asarray(odometry.pose.covariance, np.float64).reshape(6, 6)[3:, 3:]
    return axes.T @ covariance @ axes if np.isfinite(covariance).all() else None


def _of_camera(pose: Array, mounting: Array) -> Array:
    """Return the pose (4, 4) of the optical frame in its start, from that of its carrier."""
    return np.asarray(np.linalg.inv(mounting) @ pose @ mounting)
