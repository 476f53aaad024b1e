"""
Covariances of poses in ROS order (x, y, z, rotation about x, y, z).

A pose (R, p) is perturbed as geometry_msgs/PoseWithCovariance has it: p + dp and exp(dtheta) R,
both along the axes of the frame in which the pose is given.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from djet_ros.core.geometry import skew
from djet_ros.core.types import Array, RelativePose
from djet_ros.odometry.scale import Common, Length, UNKNOWN_LENGTH_SIGMA
import numpy as np

# A rotation about which nothing is known: standard deviation of half a turn.
_UNKNOWN_ANGLE = np.pi

# Share of a pair's variance that is of errors which the next pair has too, and how much of such an
# error is left a pair later: by `djet lab lengths`, a metre a frame.
_ALIKE, _PASSED_ON = 0.25, 0.9

# Metres, or units of the track, to which no place is known better.
_SHORTEST = 1e-3

# Covariance (6, 6) of a motion about which nothing is known.
UNKNOWN_MOTION = np.diag([UNKNOWN_LENGTH_SIGMA**2] * 3 + [_UNKNOWN_ANGLE**2] * 3)


def motion_covariance(relative: RelativePose, length: Length) -> Array:
    """
    Covariance (6, 6) of the current camera in the previous one, (R^T, -s R^T t).

    To the covariance of (rotation, direction) comes the length's own, along the direction. A
    translation without a direction (no parallax) may have gone its length along any axis.
    """
    if not np.isfinite(relative.covariance_6).all():
        return UNKNOWN_MOTION.copy()
    back, t = relative.R.T, relative.t
    # With R -> exp(w) R:  dtheta = -R^T w  and  dp = -s R^T [t]x w - s R^T dt. Where it is
    # measured that s is nothing, the direction is off all the same.
    J, s = np.zeros((6, 6)), max(length.value, _SHORTEST)
    J[:3, :3], J[:3, 3:] = -s * back @ skew(t), -s * back
    J[3:, :3] = -back
    covariance = J @ relative.covariance_6 @ J.T
    direction = back @ t
    if t.any():
        covariance[:3, :3] += length.sigma**2 * np.outer(direction, direction)
    else:
        covariance[:3] = covariance[:, :3] = 0.0
        reach = max(length.value, _SHORTEST) if length.known else UNKNOWN_LENGTH_SIGMA
        covariance[:3, :3] = np.eye(3) * reach**2
    return symmetric(covariance)


def standstill_covariance(relative: RelativePose, length: Length) -> Array:
    """
    Covariance (6, 6) of no motion: the rotation's own, and a tenth of a usual translation.

    A translation of unknown length is unknown also where it was short.
    """
    sigma = 0.1 * length.value if length.known else UNKNOWN_LENGTH_SIGMA
    rotation = relative.covariance_6[:3, :3]
    if not np.isfinite(rotation).all():
        # Standing still tells the rotation about as well as a displacement of a pixel would.
        rotation = np.eye(3) * 1e-6
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = np.eye(3) * max(sigma, _SHORTEST)**2
    covariance[3:, 3:] = rotation
    return symmetric(covariance)


def compose(pose: Array, pose_covariance: Array, motion: Array, covariance: Array) -> Array:
    """
    Covariance (6, 6) of ``pose @ motion``, both (4, 4) and with independent errors.

    First order: the motion's error is turned into the outer frame, and an error of the
    pose's rotation swings the motion like a lever.
    """
    lever = _lever(pose, motion)
    return symmetric(lever @ pose_covariance @ lever.T + rotated(pose[:3, :3], covariance))


@dataclass(frozen=True)
class PathCovariance:
    """
    How sure an integrated pose is, where its steps have errors in common.

    pose: (6, 6) its covariance; with_common: (6, 2) that of the pose with the two errors of
    `Common`, by which a step is too long as all steps before it were; with_pair: (6, 6) that of
    the pose with the part of the last pair's error that the next pair has too, in units of what
    pairs are unsure by.
    """

    pose: Array = field(default_factory=lambda: np.zeros((6, 6)))
    with_common: Array = field(default_factory=lambda: np.zeros((6, 2)))
    with_pair: Array = field(default_factory=lambda: np.zeros((6, 6)))

    def moved(self, pose: Array, motion: Array, covariance: Array,
              common: Common | None = None) -> PathCovariance:
        """
        Give that of ``pose @ motion``, both (4, 4), for a motion that errs by itself.

        covariance: (6, 6) of what errs in the motion alone; common: of its length, beside that.
        """
        lever = _lever(pose, motion)
        moved = PathCovariance(compose(pose, self.pose, motion, covariance),
                               lever @ self.with_common)
        return moved if common is None else moved._stretched(pose, motion, common)

    def moved_by_pair(self, pose: Array, motion: Array, covariance: Array,
                      common: Common | None = None) -> PathCovariance:
        """
        Give that of ``pose @ motion``, both (4, 4), for a motion that a pair alone has told.

        Pairs that follow one another see the same things, and err alike.
        """
        moved = self.moved(pose, motion, covariance, common)
        values, axes = np.linalg.eigh(rotated(pose[:3, :3], covariance))
        turn = both_turned(pose[:3, :3])
        # Along the camera's own axes errors stay what they are.
        root = (axes * np.sqrt(np.maximum(values, 0.0))) @ axes.T @ turn
        before = _PASSED_ON * _lever(pose, motion) @ self.with_pair
        both = before @ root.T
        return replace(moved, pose=symmetric(moved.pose + both + both.T),
                       with_pair=before + _ALIKE * root)

    def _stretched(self, pose: Array, motion: Array, common: Common) -> PathCovariance:
        """Add what the errors do that lengths have in common."""
        along = np.zeros(6)
        along[:3] = pose[:3, :3] @ motion[:3, 3]
        crossed = self.with_common * common.kept
        both = np.outer(crossed.sum(1), along)
        return PathCovariance(
            symmetric(self.pose + both + both.T
                      + common.variances.sum() * np.outer(along, along)),
            crossed + np.outer(along, common.variances))


def in_a_chain(covariance: Array) -> Array:
    """
    Covariance (6, 6) of a pair's motion for a graph, whose edges err independently.

    What neighbours err alike adds up along a chain as if each were that much less sure. Loops
    close long chains; a few pairs by themselves are surer than that.
    """
    return covariance * (1 + 2 * _ALIKE * _PASSED_ON / (1 - _PASSED_ON))


def _lever(pose: Array, motion: Array) -> Array:
    """(6, 6) what an error of a pose (4, 4) becomes at the end of the next motion (4, 4)."""
    lever = np.eye(6)
    lever[:3, 3:] = -skew(pose[:3, :3] @ motion[:3, 3])
    return lever


def rotated(R: Array, covariance: Array) -> Array:
    """Express a covariance (6, 6) along the axes of another frame."""
    turn = both_turned(R)
    return np.asarray(turn @ covariance @ turn.T)


def both_turned(R: Array) -> Array:
    """Matrix (6, 6) that turns a translation and a rotation vector, one below the other, by R."""
    # np.kron takes twenty times as long, and a frame has a dozen of these.
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = R
    return turn


def symmetric(covariance: Array) -> Array:
    """Take off what rounding leaves a covariance that is not symmetric."""
    return np.asarray((covariance + covariance.T) / 2)
