"""
Covariances of motions and poses, in ROS order (x, y, z, rotation about x, y, z).

A pose (R, p) is perturbed as in geometry_msgs/PoseWithCovariance: p + dp and exp(dtheta) R, both
along the axes of the frame in which the pose is given.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from djet_ros.core.geometry import skew
from djet_ros.core.types import Array, RelativePose
from djet_ros.odometry.scale import Common, Length, UNKNOWN_LENGTH_SIGMA
import numpy as np

# Standard deviation of an unknown rotation, in rad.
_UNKNOWN_ANGLE = np.pi

# Correlated errors of consecutive pairs, an autoregressive process: their share of a pair's
# variance, and their correlation from pair to pair; by `djet lab lengths`, a metre a frame.
_CORRELATED, _PERSISTENCE = 0.25, 0.9

# Metres, or units of the track: least standard deviation of a position.
_LEAST_SIGMA = 1e-3

# Covariance (6, 6) of an unknown motion.
UNKNOWN_MOTION = np.diag([UNKNOWN_LENGTH_SIGMA**2] * 3 + [_UNKNOWN_ANGLE**2] * 3)
UNKNOWN_MOTION.setflags(write=False)  # results share it


def motion_covariance(relative: RelativePose, length: Length) -> Array:
    """
    Return the covariance (6, 6) of the current camera in the previous one, (R^T, -s R^T t).

    It is that of (rotation, direction), plus the variance of the length s along the direction. A
    translation without a direction (no parallax) has the standard deviation s along each axis.
    """
    if not np.isfinite(relative.covariance_6).all():
        return UNKNOWN_MOTION.copy()
    back, t = relative.R.T, relative.t
    # With R -> exp(w) R:  dtheta = -R^T w  and  dp = -s R^T [t]x w - s R^T dt. A measured s of
    # zero does not make the direction exact.
    J, s = np.zeros((6, 6)), max(length.value, _LEAST_SIGMA)
    J[:3, :3], J[:3, 3:] = -s * back @ skew(t), -s * back
    J[3:, :3] = -back
    covariance = J @ relative.covariance_6 @ J.T
    direction = back @ t
    if t.any():
        covariance[:3, :3] += length.sigma**2 * np.outer(direction, direction)
    else:
        covariance[:3] = covariance[:, :3] = 0.0
        sigma = max(length.value, _LEAST_SIGMA) if length.known else UNKNOWN_LENGTH_SIGMA
        covariance[:3, :3] = np.eye(3) * sigma**2
    return symmetric(covariance)


def standstill_covariance(relative: RelativePose, length: Length, hidden: float = 0.0) -> Array:
    """
    Return the covariance (6, 6) of a standstill: a tenth of a usual length, and the rotation's.

    length: of a usual translation; if it is unknown, so is a tenth of it. hidden: of one that
    displaces pixels by no more than in a standstill: of a slow camera, that is more.
    """
    sigma = max(0.1 * length.value, hidden) if length.known else UNKNOWN_LENGTH_SIGMA
    rotation = relative.covariance_6[:3, :3]
    if not np.isfinite(rotation).all():
        # A standstill bounds the rotation as well as a displacement of about a pixel does.
        rotation = np.eye(3) * 1e-6
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = np.eye(3) * max(sigma, _LEAST_SIGMA)**2
    covariance[3:, 3:] = rotation
    return symmetric(covariance)


def compose(pose: Array, pose_covariance: Array, motion: Array, covariance: Array) -> Array:
    """
    Return the covariance (6, 6) of ``pose @ motion``, both (4, 4) with independent errors.

    To first order: the motion's error is rotated to the outer frame, and an error of the pose's
    rotation has the motion's translation as its lever arm.
    """
    lever = _lever(pose, motion)
    return symmetric(lever @ pose_covariance @ lever.T + rotated(pose[:3, :3], covariance))


@dataclass(frozen=True)
class PathCovariance:
    """
    Covariance of an integrated pose whose steps have correlated errors.

    pose: (6, 6) covariance of the pose; with_common: (6, 2) its cross-covariance with the two
    errors of `Common`, which all lengths share; with_pair: (6, 6) its cross-covariance with the
    correlated part of the last pair's error, whitened by the pair's covariance.
    """

    pose: Array = field(default_factory=lambda: np.zeros((6, 6)))
    with_common: Array = field(default_factory=lambda: np.zeros((6, 2)))
    with_pair: Array = field(default_factory=lambda: np.zeros((6, 6)))

    def moved(self, pose: Array, motion: Array, covariance: Array,
              common: Common | None = None) -> PathCovariance:
        """
        Return that of ``pose @ motion``, both (4, 4), if the motion's error is independent.

        covariance: (6, 6) of the motion's own error; common: further errors of its length.
        """
        lever = _lever(pose, motion)
        moved = PathCovariance(compose(pose, self.pose, motion, covariance),
                               lever @ self.with_common)
        return moved if common is None else moved._with_length_errors(pose, motion, common)

    def moved_by_pair(self, pose: Array, motion: Array, covariance: Array,
                      common: Common | None = None) -> PathCovariance:
        """
        Return that of ``pose @ motion``, both (4, 4), for the motion of a single pair.

        Consecutive pairs see the same features, so their errors are correlated.
        """
        moved = self.moved(pose, motion, covariance, common)
        values, axes = np.linalg.eigh(rotated(pose[:3, :3], covariance))
        turn = block_rotation(pose[:3, :3])
        # Along the axes of the camera the correlated error stays the same.
        root = (axes * np.sqrt(np.maximum(values, 0.0))) @ axes.T @ turn
        before = _PERSISTENCE * _lever(pose, motion) @ self.with_pair
        cross = before @ root.T
        return replace(moved, pose=symmetric(moved.pose + cross + cross.T),
                       with_pair=before + _CORRELATED * root)

    def _with_length_errors(self, pose: Array, motion: Array, common: Common) -> PathCovariance:
        """Add the errors that lengths have in common."""
        along = np.zeros(6)
        along[:3] = pose[:3, :3] @ motion[:3, 3]
        with_common = self.with_common * common.kept
        cross = np.outer(with_common.sum(1), along)
        return PathCovariance(
            symmetric(self.pose + cross + cross.T
                      + common.variances.sum() * np.outer(along, along)),
            with_common + np.outer(along, common.variances))


def inflated_for_chain(covariance: Array) -> Array:
    """
    Return the covariance (6, 6) of a pair for a pose graph, whose edges have independent errors.

    Along a long chain, as loops close them, the inflated independent errors add up to as much as
    the correlated ones; a chain of a few pairs is more certain than that.
    """
    return covariance * (1 + 2 * _CORRELATED * _PERSISTENCE / (1 - _PERSISTENCE))


def _lever(pose: Array, motion: Array) -> Array:
    """Return the Jacobian (6, 6) of ``pose @ motion``, both (4, 4), by the pose's error."""
    lever = np.eye(6)
    lever[:3, 3:] = -skew(pose[:3, :3] @ motion[:3, 3])
    return lever


def rotated(R: Array, covariance: Array) -> Array:
    """Return a covariance (6, 6) along the axes of another frame, to which R (3, 3) rotates."""
    turn = block_rotation(R)
    return np.asarray(turn @ covariance @ turn.T)


def block_rotation(R: Array) -> Array:
    """Return the block-diagonal matrix (6, 6) of R (3, 3), R."""
    # np.kron takes twenty times as long, and a frame needs a dozen of these.
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = R
    return turn


def of_inverse(motion: Array, covariance: Array) -> Array:
    """Return the covariance (6, 6) of the inverse of a motion (4, 4) with a covariance."""
    # (R^T, -R^T p) with p + dp and exp(dtheta) R.
    R, p = motion[:3, :3], motion[:3, 3]
    J = np.zeros((6, 6))
    J[:3, :3], J[:3, 3:], J[3:, 3:] = R.T, R.T @ skew(p), R.T
    return symmetric(J @ covariance @ J.T)


def symmetric(covariance: Array) -> Array:
    """Return the symmetric part of a covariance, without rounding errors."""
    return np.asarray((covariance + covariance.T) / 2)
