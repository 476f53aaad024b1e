"""
From the odometry's messages to the steps of its way.

An Odometry says where the camera is, and the relative pose of the same stamp how it came there
and how sure that is. Neither says from which frame, nor whether the odometry began anew, nor
whether it knows lengths: here, and nowhere else, that is told from numbers that agree or are
huge. The reference is the newest frame at which the camera was not standing still, unless the
odometry says by its covariance that something is missing.
"""

from __future__ import annotations

from typing import Any

from djet_ros.core.types import Array, Status
from djet_ros.errors import DjetError
from djet_ros.odometry.messages import (
    LEAST_COVARIANCE,
    OPTICAL_TO_BODY,
    pose_of,
    twist_of_nothing,
)
from djet_ros.odometry.scale import UNKNOWN_LENGTH_SIGMA
from djet_ros.odometry.uncertainty import rotated, UNKNOWN_MOTION
from djet_ros.posegraph.steps import Step
import numpy as np

# Messages of one topic that may wait for their like on the other.
_WAITING = 1000

# An integrated rotation gets this variance (trace, rad^2) where nothing was known of a motion.
_HOLE = float(np.trace(UNKNOWN_MOTION[3:, 3:]))

# By which two ways to compute one pose may differ, in metres per metre and in radians.
_ROUNDING = 1e-6


class StepMessages:
    """
    Pairs Odometry and PoseWithCovarianceStamped of one stamp.

    convention: 'optical' or 'body', of the axes in messages. missing: how many relative poses
    did not come.
    """

    def __init__(self, convention: str) -> None:
        self._turn = np.eye(4)
        if convention == 'body':
            self._turn[:3, :3] = OPTICAL_TO_BODY.T
        self.reset()

    def reset(self) -> None:
        """Forget everything; the next frame is the first."""
        self.missing = 0
        self._odometries: dict[int, Any] = {}
        self._relatives: dict[int, Any] = {}
        # Where the next motion is told from.
        self._reference_ns: int | None = None
        self._pose = np.eye(4)
        self._rotation_variance = 0.0
        self._newest_odometry = self._newest_relative = -1

    def goes_back(self, odometry: Any) -> bool:
        """Tell of an Odometry whether it is of an earlier time than the last one."""
        return pose_of(odometry)[0] < self._newest_odometry

    def relative_pose(self, message: Any) -> list[Step]:
        """Take a relative pose, and give the step that is complete by it."""
        stamp, _ = pose_of(message)
        if stamp < self._newest_relative:
            self._relatives.clear()
        self._newest_relative = stamp
        _keep(self._relatives, stamp, message)
        return self._complete(stamp)

    def odometry(self, message: Any) -> list[Step]:
        """Take an Odometry that does not go back in time, and give the step that it completes."""
        stamp, pose = pose_of(message)
        if stamp == self._newest_odometry:
            return []
        self._newest_odometry = stamp
        if not np.isfinite(pose).all():
            raise DjetError(f'the odometry of {stamp} ns holds no pose')
        _keep(self._odometries, stamp, message)
        return [self._start(stamp)] if _begins_anew(message) else self._complete(stamp)

    def _complete(self, stamp: int) -> list[Step]:
        if stamp not in self._odometries or stamp not in self._relatives:
            return []
        relative = self._relatives[stamp]
        odometry = self._taken(stamp)
        _, motion = pose_of(relative)
        if not np.isfinite(motion).all():
            raise DjetError(f'the relative pose of {stamp} ns holds no pose')
        covariance = _covariance(relative)
        step = Step(stamp, Status.OK, self._turned(pose_of(odometry)[1]), self._reference_ns,
                    self._turned(motion), rotated(self._turn[:3, :3], covariance),
                    _is_length_known(covariance), odometry.header.frame_id)
        variance = _rotation_variance(odometry)
        if step.tracked:
            step.check(f'odometry edge to {stamp} ns')
        if not self._fits(step, variance - _rotation_variance(relative)):
            step = Step(stamp, Status.OK, step.pose, odom_frame=step.odom_frame)
        if not step.tracked or not np.allclose(step.motion, np.eye(4), rtol=0, atol=_ROUNDING**2):
            # From where it stands still, no motion will be told.
            self._reference_ns = stamp
        self._pose, self._rotation_variance = step.pose, variance
        return [step]

    def _fits(self, step: Step, variance_before: float) -> bool:
        """Tell whether motion and poses agree that the step is from the known reference."""
        if not step.tracked:
            return False
        off = np.linalg.inv(self._pose @ step.motion) @ step.pose - np.eye(4)
        reach = _ROUNDING * (1 + np.linalg.norm(step.pose[:3, 3]))
        return bool(np.abs(off[:3, :3]).max() < _ROUNDING and np.abs(off[:3, 3]).max() < reach
                    and variance_before - self._rotation_variance < _HOLE / 2)

    def _start(self, stamp: int) -> Step:
        """Begin anew: the odometry tells of no motion, and may have another frame."""
        odometry = self._taken(stamp)
        self._pose, self._reference_ns = self._turned(pose_of(odometry)[1]), stamp
        self._rotation_variance = _rotation_variance(odometry)
        return Step(stamp, Status.FIRST_FRAME, self._pose, odom_frame=odometry.header.frame_id)

    def _turned(self, pose: Array) -> Array:
        return np.asarray(self._turn @ pose @ self._turn.T)

    def _taken(self, stamp: int) -> Any:
        """Give the Odometry of a stamp; what waits from before it waits in vain."""
        odometry = self._odometries.pop(stamp)
        self._relatives = {at: one for at, one in self._relatives.items() if at > stamp}
        self.missing += sum(at < stamp for at in self._odometries)
        self._odometries = {at: one for at, one in self._odometries.items() if at > stamp}
        return odometry


def _keep(waiting: dict[int, Any], stamp: int, message: Any) -> None:
    waiting[stamp] = message
    if len(waiting) > _WAITING:
        del waiting[next(iter(waiting))]


def _covariance(message: Any) -> Array:
    return np.asarray(message.pose.covariance, np.float64).reshape(6, 6)


def _is_length_known(covariance: Array) -> bool:
    return bool(np.sqrt(np.trace(covariance[:3, :3])) < UNKNOWN_LENGTH_SIGMA / 2)


def _rotation_variance(message: Any) -> float:
    return float(np.trace(_covariance(message)[3:, 3:]))


def _begins_anew(odometry: Any) -> bool:
    """Tell of an Odometry whether it is of no pair, so that its velocity is unknown."""
    linear, angular = odometry.twist.twist.linear, odometry.twist.twist.angular
    if any((linear.x, linear.y, linear.z, angular.x, angular.y, angular.z)):
        return False
    unknown = twist_of_nothing()[1] + LEAST_COVARIANCE
    return np.allclose(np.asarray(odometry.twist.covariance), unknown.ravel(), rtol=1e-9, atol=0)
