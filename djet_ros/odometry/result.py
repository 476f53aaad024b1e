"""Result of the odometry for one frame."""

from __future__ import annotations

from dataclasses import dataclass, field

from djet_ros.core.correction import AS_CALIBRATED, Correction
from djet_ros.core.types import Array, RelativePose, Status
from djet_ros.odometry.frame import Frame, Reference
from djet_ros.odometry.scale import Common, Length, Scale
from djet_ros.odometry.uncertainty import UNKNOWN_MOTION
import numpy as np


@dataclass(frozen=True)
class OdometryResult:
    """
    Estimated motion and pose of a frame.

    stamp_ns, frame_id: of the frame; status: of the frame or of its pair; previous_stamp_ns: stamp
    of the reference frame, None if the odometry (re)started; relative: two-view estimate between
    both; motion: (4, 4) the current camera in the reference camera; pose: (4, 4) the current
    camera in the first camera. If the motion could not be estimated, the pose is the last one,
    with the rotation of the gyro or of an AMBIGUOUS pair where there is one.

    motion_covariance, pose_covariance: (6, 6) in ROS order; pose_covariance includes correlated
    errors of the lengths, also how far a relative scale may have drifted since the first frame.

    scale: length of the unit translation, in metres if `metric`, otherwise in the unit of the
    track; scale_known: whether it means anything; measured: whether the scale source measured it,
    rather than landmarks alone carried it on; common: its error shared with other steps.

    stationary: whether the camera stood still; since_ns: stamp of the newest frame whose pose is
    that of the reference frame, later than previous_stamp_ns after a standstill without creep, so
    that the motion took place after it; since_covariance: (6, 6) of that frame's pose in the
    reference frame.

    keyframe: whether the frame is a keyframe of the sliding window, None if there is no window or
    the motion is unknown; camera_correction: of the calibration, estimated from landmarks, with
    which the image was processed.
    """

    stamp_ns: int
    frame_id: str
    status: Status
    previous_stamp_ns: int | None
    relative: RelativePose | None
    motion: Array
    pose: Array
    motion_covariance: Array
    pose_covariance: Array
    scale: float
    scale_known: bool
    stationary: bool = False
    since_ns: int | None = None
    since_covariance: Array = field(default_factory=lambda: np.zeros((6, 6)))
    metric: bool = True
    measured: bool = True
    common: Common | None = None
    keyframe: bool | None = None
    camera_correction: Correction = AS_CALIBRATED

    @classmethod
    def without_pair(cls, frame: Frame, status: Status, pose: Array, pose_covariance: Array,
                     keyframe: bool | None, correction: Correction) -> OdometryResult:
        """Return the result of a frame at which the odometry started or restarted."""
        return cls(frame.stamp_ns, frame.frame_id, status, None, None, np.eye(4), pose,
                   UNKNOWN_MOTION, pose_covariance, 0.0, False, keyframe=keyframe,
                   camera_correction=correction)

    @classmethod
    def of_pair(cls, frame: Frame, reference: Reference, pair: RelativePose, length: Length,
                motion: Array, motion_covariance: Array, pose: Array, pose_covariance: Array,
                keyframe: bool | None, correction: Correction) -> OdometryResult:
        """Return the result of a frame and its reference frame."""
        return cls(frame.stamp_ns, frame.frame_id, pair.status, reference.frame.stamp_ns, pair,
                   motion, pose, motion_covariance, pose_covariance, length.value, length.known,
                   False, reference.since_ns, reference.since_covariance, length.metric,
                   length.measured, length.common, keyframe, correction)

    def __repr__(self) -> str:
        """Sum up the frame in a line: its arrays would fill a screen."""
        return (f'OdometryResult({self.status}, stamp_ns {self.stamp_ns}, '
                f'position {self.pose[:3, 3].round(4).tolist()}, scale {self.scale_kind}, '
                f'{self.relative!r})')

    @property
    def scale_kind(self) -> Scale:
        """Return the unit of the translation's length."""
        return Length(self.scale, 0.0, self.scale_known, self.metric).scale


def camera_motion(relative: RelativePose, length: float = 1.0) -> Array:
    """Return the current camera's pose (4, 4) in the previous one: (R^T, -length R^T t)."""
    motion = np.eye(4)
    motion[:3, :3] = relative.R.T
    motion[:3, 3] = -length * relative.R.T @ relative.t
    return motion
