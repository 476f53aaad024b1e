"""
Motion priors from other sensors: a gyro's rotation, and the motion of another odometry.

Both give initial poses to the two-view estimate, and the gyro's rotation is fused with it. In
return, good pairs estimate the gyro's bias and show whether its rates can be trusted at all.
"""

from __future__ import annotations

from dataclasses import replace

from djet_ros.core.fusion import agrees, fused, MeasuredRotation
from djet_ros.core.starts import KnownMotion
from djet_ros.core.types import Array, RelativePose, Status, TRACKED
from djet_ros.odometry.guess import Guess, initial_pose
from djet_ros.odometry.inertial import Gyro
from djet_ros.odometry.uncertainty import UNKNOWN_MOTION
import numpy as np

# Stamps of the newest frame at the reference frame's pose, and of the current frame.
Span = tuple[int, int]

# rad: standard deviation of the rotation between two frames of a camera that stands still.
_STANDSTILL_SIGMA = 2e-4


class MotionPriors:
    """
    Priors for the pairs of one track; without a gyro (None) or a guess (None) they are empty.

    known_ns: stamp of the newest frame whose motion is known.
    """

    def __init__(self) -> None:
        self.gyro: Gyro | None = None
        self.guess: Guess | None = None
        self.known_ns = 0
        # The rotation (3, 3) of the newest pair that agreed with the gyro, and its covariance.
        self._by_images: tuple[Array, Array] | None = None
        self.refer(0)

    def refer(self, stamp_ns: int) -> None:
        """Take a frame of this stamp as one with the rotation of the reference frame."""
        # Newest frame with a rotation from the images: R (3, 3) from the reference frame.
        self._rotated_ns, self._R, self._covariance = stamp_ns, np.eye(3), np.zeros((3, 3))

    def forget_before(self, stamp_ns: int) -> None:
        """Drop measurements from before a stamp, as no later pair begins there."""
        for sensor in (self.gyro, self.guess):
            if sensor is not None:
                sensor.forget_before(stamp_ns)

    def of(self, span_ns: Span) -> KnownMotion:
        """Return the priors of a pair: of the rotation only while the gyro agrees with images."""
        motion = self.guess.motion(*span_ns) if self.guess else None
        trusted = self.gyro is not None and self.gyro.trusted
        return KnownMotion(self._turn(span_ns) if trusted else None,
                           None if motion is None else initial_pose(motion))

    def _turn(self, span_ns: Span) -> MeasuredRotation | None:
        """Return the rotation that the gyro measured, if it did."""
        return None if self.gyro is None else self.gyro.turn(*span_ns)

    def at_rest(self, span_ns: Span) -> bool | None:
        """Return whether a gyro measured no rotation since the last known motion, if it did."""
        return None if self.gyro is None else self.gyro.at_rest(
            max(span_ns[0], self.known_ns), span_ns[1])

    def may_mislead(self, relative: RelativePose) -> bool:
        """
        Return whether a pair may be bad because of a gyro that has never agreed with images.

        Rates in degrees per second, or those of another robot, lead all matches astray.
        """
        return (self.gyro is not None and not self.gyro.ever_agreed
                and relative.status not in TRACKED)

    def judge(self, turn: MeasuredRotation, relative: RelativePose) -> bool:
        """Return whether the gyro's rotation agrees with that of a pair, and count it."""
        agreed = agrees(turn, relative)
        if self.gyro is not None:
            self.gyro.judge(agreed)
        return agreed

    def fuse(self, relative: RelativePose, prior: MeasuredRotation | None, span_ns: Span
             ) -> RelativePose:
        """
        Return the pair fused with the gyro's rotation; DEGENERATE if both disagree.

        prior: the rotation that was its prior; None if the gyro is not trusted: then the gyro is
        judged, and the pair stays as it is.
        """
        self._by_images = None
        turn = prior or self._turn(span_ns)
        if self.gyro is None or turn is None or relative.status not in TRACKED:
            return relative
        agreed = self.judge(turn, relative)
        if agreed:
            self._by_images = relative.R, relative.covariance_6[:3, :3]
        if prior is None:
            return relative
        # The camera did not turn like this: something else fills the image.
        return fused(relative, prior) if agreed else replace(
            relative, status=Status.DEGENERATE, t=np.zeros(3))

    def learn(self, stamp_ns: int) -> None:
        """Estimate the gyro's bias from the pair fused last, up to a frame, if both agreed."""
        if self.gyro is not None and self._by_images is not None:
            self._learn(self.gyro, stamp_ns, *self._by_images)

    def learn_at_rest(self, stamp_ns: int) -> None:
        """Estimate the gyro's bias from a standstill up to a frame."""
        if self.gyro is not None:
            self._learn(self.gyro, stamp_ns, np.eye(3), np.eye(3) * _STANDSTILL_SIGMA**2)
            self.refer(stamp_ns)

    def _learn(self, gyro: Gyro, stamp_ns: int, R: Array, covariance: Array) -> None:
        """Estimate the bias from a frame's rotation (3, 3) from the reference frame."""
        turn = R @ self._R.T
        gyro.learn(self._rotated_ns, stamp_ns, turn,
                   covariance + turn @ self._covariance @ turn.T)
        self._rotated_ns, self._R, self._covariance = stamp_ns, R, covariance

    def dead_reckoned(self, span_ns: Span) -> tuple[Array, Array] | None:
        """
        Return the gyro's rotation as a motion (4, 4) of unknown translation, and its covariance.

        The covariance is (6, 6). None unless the gyro can be trusted without the images.
        """
        turn = self._turn(span_ns)
        if self.gyro is None or turn is None or not self.gyro.trusted_alone:
            return None
        motion, covariance = np.eye(4), UNKNOWN_MOTION.copy()
        motion[:3, :3] = turn.R.T
        # The error of the bias is fully correlated: n steps err n times as much as one.
        before = max(span_ns[0] - self.known_ns, 0) / (span_ns[1] - span_ns[0])
        covariance[3:, 3:] = (1 + 2 * before) * turn.R.T @ turn.covariance @ turn.R
        return motion, covariance
