"""
From the odometry's messages to steps.

An Odometry says where the camera is, the relative pose of the same stamp how it came there and
how sure that is, and the status of the same stamp from which frame, and whether lengths are known.
"""

from __future__ import annotations

from collections import deque
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
_WAITING = 1000


class _Parts(NamedTuple):
    """What has come of a frame so far."""

    status: FrameStatus | None = None
    odometry: Any = None
    relative: Any = None

    @property
    def complete(self) -> bool:
        """Whether nothing more is to come."""
        return self.odometry is not None and self.status is not None and (
            self.relative is not None or self.status.status not in TRACKED)


class StepMessages:
    """
    Brings together the Odometry, the relative pose and the status of one stamp.

    convention: 'optical' or 'body', of the axes in messages; base_frame: whose odometry it is, if
    not the camera's, with the camera's optical frame in it, mounting (4, 4). missing: of how many
    frames only a part came.
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
        # Bad frames, the newest last, from which the next motion may be told.
        self._bad: deque[Step] = deque(maxlen=_WAITING)
        self._newest = -1

    def goes_back(self, odometry: Any) -> bool:
        """Tell of an Odometry whether it is of an earlier time than the last one."""
        return stamp_ns(odometry.header) < self._newest

    def go_back(self, stamp: int) -> None:
        """Begin anew at a stamp; what waits from then on may belong to it."""
        self.missing, self._newest = 0, -1
        self._bad.clear()
        self._parts = {at: parts for at, parts in self._parts.items()
                       if at == stamp and parts.odometry is None}

    def relative_pose(self, message: Any) -> list[Step]:
        """Take a relative pose, and give the step that is complete by it."""
        return self._add(stamp_ns(message.header), relative=message)

    def status(self, message: Any) -> list[Step]:
        """Take what ``Messages.status`` makes, and give the step that is complete by it."""
        status = frame_status(message)
        return self._add(status.stamp_ns, status=status)

    def odometry(self, message: Any) -> list[Step]:
        """Take an Odometry that does not go back in time, and give the step that it completes."""
        stamp, pose = pose_of(message)
        if stamp == self._newest:
            return []
        self._newest = stamp
        if not np.isfinite(pose).all():
            raise DjetError(f'the odometry of {stamp} ns holds no pose')
        return self._add(stamp, odometry=message)

    def _add(self, stamp: int, **part: Any) -> list[Step]:
        parts = self._parts[stamp] = self._parts.get(stamp, _Parts())._replace(**part)
        if not parts.complete or parts.status is None:
            if len(self._parts) > _WAITING:
                del self._parts[next(iter(self._parts))]
            return []
        # What waits from before waits in vain.
        self.missing += sum(at < stamp and one.odometry is not None
                            for at, one in self._parts.items())
        self._parts = {at: one for at, one in self._parts.items() if at > stamp}
        return self._step(parts.status, parts)

    def _step(self, said: FrameStatus, parts: _Parts) -> list[Step]:
        """
        Give the step of a frame; none for a bad pair, which may be bridged.

        Where it is not, the step of its frame comes before the one that is told from there.
        """
        _, pose = pose_of(parts.odometry)
        frame = parts.odometry.header.frame_id
        here, turn = _of_camera(pose, self._mounting), None
        if not self._base_frame:
            turn = turn_of(parts.odometry, self._axes[:3, :3])
        if said.status not in TRACKED:
            alone = Step(said.stamp_ns, said.status, here, odom_frame=frame,
                         keyframe=said.keyframe, k1=said.k1, turn=turn)
            if said.status in STARTED:
                self._bad.clear()
                return [alone]
            self._bad.append(alone)
            return []
        expected = self._base_frame or parts.relative.header.frame_id
        if parts.odometry.child_frame_id != expected:
            raise DjetError(
                f"the odometry is of '{parts.odometry.child_frame_id}', and not of '{expected}'; "
                'give both nodes the same odometry.base_frame and odometry.frame_convention')
        _, motion = pose_of(parts.relative)
        if not np.isfinite(motion).all():
            raise DjetError(f'the relative pose of {said.stamp_ns} ns holds no pose')
        covariance = np.asarray(parts.relative.pose.covariance, np.float64).reshape(6, 6)
        step = Step(said.stamp_ns, said.status, here, said.reference_ns,
                    _of_camera(motion, self._axes), rotated(self._axes[:3, :3].T, covariance),
                    said.scale is not Scale.UNKNOWN, frame, said.scale is Scale.METRIC,
                    said.keyframe, said.k1, turn)
        if step.tracked:
            step.check(f'odometry edge to {said.stamp_ns} ns')
        reference = [bad for bad in self._bad if bad.stamp_ns == step.previous_stamp_ns]
        self._bad.clear()
        return [*reference, step]


def turn_of(odometry: Any, axes: Array) -> Array | None:
    """
    Covariance (3, 3) of the rotation of an Odometry's pose, along the axes of the optical frame.

    axes: (3, 3) the optical frame in that of the messages; None where the message has none.
    """
    covariance = np.asarray(odometry.pose.covariance, np.float64).reshape(6, 6)[3:, 3:]
    return axes.T @ covariance @ axes if np.isfinite(covariance).all() else None


def _of_camera(pose: Array, mounting: Array) -> Array:
    """Pose (4, 4) of the optical frame in where it began, from that of what it is mounted on."""
    return np.asarray(np.linalg.inv(mounting) @ pose @ mounting)
