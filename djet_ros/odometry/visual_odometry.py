"""From frames to a trajectory: the whole odometry on one screen."""

from __future__ import annotations

from dataclasses import dataclass, field

from djet_ros.config.sections import OdometryConfig
from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.types import Array, RelativePose, Status, View
from djet_ros.odometry.frame import continuity, Frame
from djet_ros.odometry.scale import Length, scale_source, ScaleSource
from djet_ros.odometry.uncertainty import (
    compose,
    motion_covariance,
    standstill_covariance,
    UNKNOWN_MOTION,
)
import numpy as np

# Statuses under which the motion of a pair was estimated.
TRACKED = (Status.OK, Status.NO_PARALLAX)

# Statuses of a frame at which the odometry started or restarted, without a pair.
STARTED = (Status.FIRST_FRAME, Status.TIME_JUMP, Status.SIZE_CHANGED)


@dataclass(frozen=True)
class OdometryResult:
    """
    What became of a frame.

    stamp_ns, frame_id: of the frame; status; previous_stamp_ns: of the reference frame that it
    was related to, None where it restarted; relative: the estimator's answer for that pair;
    motion: (4, 4) the current camera in the reference camera; pose: (4, 4) the current camera in
    the first camera (the last known one where the motion could not be estimated);
    motion_covariance, pose_covariance: (6, 6) in ROS order; scale: length that a unit translation
    was given; scale_known: whether that is metres; stationary: whether the camera stood still.

    since_ns: stamp of the newest frame that was where the reference frame is, which is later
    where the camera stood still: the motion came about after it; since_covariance: (6, 6) how
    sure it is that this frame was there.
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


class VisualOdometry:
    """
    Relates each frame to a reference frame and integrates the motions.

    The reference frame is the newest frame that was tracked, by three rules:
    * a bad pair keeps it, so that one bad frame is bridged by the next good one; after max_lost
      bad pairs in a row each newest frame becomes the reference, until one pair is good again.
      The motion in between is missing then, and the pose's covariance says so;
    * while the camera stands still it stays, so that noise does not add up;
    * a gap of more than max_gap, another image size or another camera begin a new reference at
      the last pose; a step back in time restarts everything.
    """

    def __init__(self, estimator: EstimatorConfig | None = None,
                 odometry: OdometryConfig | None = None,
                 scale: ScaleSource | None = None) -> None:
        odometry = odometry or OdometryConfig()
        self.configure(estimator or EstimatorConfig(), odometry, scale or scale_source(odometry))
        self.reset()

    def configure(self, estimator: EstimatorConfig, odometry: OdometryConfig,
                  scale: ScaleSource) -> None:
        """Take other parameters from the next frame on; the trajectory goes on."""
        self._config = odometry
        self._estimator = TwoViewEstimator(estimator)
        self._scale = scale

    def reset(self) -> None:
        """Forget everything; the next frame is the first."""
        self._last: Frame | None = None
        self._prior: RelativePose | None = None
        self._bad_pairs = 0
        self._pose, self._pose_covariance = np.eye(4), np.zeros((6, 6))

    def process(self, frame: Frame) -> OdometryResult:
        """Take the next frame; ValueError where its stamp is that of the last one."""
        # Can this frame be related to the past at all?
        last, self._last = self._last, frame
        status = (continuity(last, frame, self._config.max_gap) if last else Status.FIRST_FRAME)
        if last and frame.stamp_ns == last.stamp_ns:
            raise ValueError(f'two frames in a row have the stamp {frame.stamp_ns} ns')
        # Features are found once: now for the current frame, next time for the reference.
        view = self._estimator.view(frame.gray, frame.K)
        if status is not Status.OK:
            return self._start(frame, view, status, backwards=bool(
                last and frame.stamp_ns < last.stamp_ns))

        # The pair: the motion before it is one of its starting poses.
        relative = self._estimator.estimate(self._view, view, self._prior)
        length = self._length(frame, view, relative)
        if self._stands_still(relative):
            return self._stay(frame, relative, length)
        if relative.status not in TRACKED:
            return self._lose(frame, view, relative, length)

        # Integrate the motion and its uncertainty; this frame is the next reference.
        motion = camera_motion(relative, length.value)
        covariance = motion_covariance(relative, length)
        result = self._result(frame, relative.status, relative, length, motion, covariance)
        self._pose, self._pose_covariance = result.pose, result.pose_covariance
        self._refer_to(frame, view)
        self._prior, self._bad_pairs = relative, 0
        return result

    def _length(self, frame: Frame, view: View, relative: RelativePose) -> Length:
        """Length of the translation; what the pair itself shows of it is seen first."""
        # While the camera stood there was no way, whatever a wheel's noise may add up to.
        span = self._since_ns, frame.stamp_ns
        self._scale.observe(*span, self._view, view, relative)
        return self._scale.between(*span)

    def _stands_still(self, relative: RelativePose) -> bool:
        # Two equal images are DEGENERATE to most estimators, for want of any residual.
        if relative.status not in (*TRACKED, Status.DEGENERATE) or not len(relative.x):
            return False
        refined = len(relative.y_opt) == len(relative.x) and np.isfinite(relative.y_opt).all()
        y = relative.y_opt if refined else relative.y
        shift = np.linalg.norm(y - relative.x, axis=1)
        return float(np.median(shift)) < self._config.standstill

    def _start(self, frame: Frame, view: View, status: Status,
               backwards: bool) -> OdometryResult:
        """Begin a new reference: from nothing, or at the last pose with its motion unknown."""
        if backwards:
            self.reset()
            self._scale.reset()
            self._last = frame
        elif status is not Status.FIRST_FRAME:
            self._pose_covariance = compose(self._pose, self._pose_covariance, np.eye(4),
                                            UNKNOWN_MOTION)
        self._refer_to(frame, view)
        self._prior, self._bad_pairs = None, 0
        return OdometryResult(
            frame.stamp_ns, frame.frame_id, status, None, None, np.eye(4), self._pose,
            UNKNOWN_MOTION, self._pose_covariance, 0.0, False)

    def _stay(self, frame: Frame, relative: RelativePose, length: Length) -> OdometryResult:
        """Stand still: no motion, and the reference frame stays."""
        self._bad_pairs = 0
        result = self._result(frame, Status.NO_PARALLAX, relative, length, np.eye(4),
                              standstill_covariance(relative, length), stationary=True)
        self._since_ns, self._since_covariance = frame.stamp_ns, result.motion_covariance
        return result

    def _lose(self, frame: Frame, view: View, relative: RelativePose,
              length: Length) -> OdometryResult:
        """Take a bad pair: hold the pose, and give up the reference after too many of them."""
        self._bad_pairs += 1
        given_up = self._bad_pairs >= self._config.max_lost
        result = self._result(frame, relative.status, relative, length, np.eye(4), UNKNOWN_MOTION)
        if given_up:
            self._refer_to(frame, view)
            self._prior, self._pose_covariance = None, result.pose_covariance
        return result

    def _refer_to(self, frame: Frame, view: View) -> None:
        self._reference, self._view = frame, view
        self._since_ns, self._since_covariance = frame.stamp_ns, np.zeros((6, 6))

    def _result(self, frame: Frame, status: Status, relative: RelativePose, length: Length,
                motion: Array, covariance: Array, stationary: bool = False) -> OdometryResult:
        return OdometryResult(
            frame.stamp_ns, frame.frame_id, status, self._reference.stamp_ns, relative, motion,
            self._pose @ motion, covariance,
            compose(self._pose, self._pose_covariance, motion, covariance), length.value,
            length.known, stationary, self._since_ns, self._since_covariance)


def camera_motion(relative: RelativePose, length: float = 1.0) -> Array:
    """Pose (4, 4) of the current camera in the previous one, (R^T, -s R^T t), s the length."""
    motion = np.eye(4)
    motion[:3, :3] = relative.R.T
    motion[:3, 3] = -length * relative.R.T @ relative.t
    return motion
