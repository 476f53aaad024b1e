"""Weighing a rotation that something else has measured into a pose, by both covariances."""

from __future__ import annotations

from dataclasses import dataclass, replace

from djet_ros.core.covariance import lift
from djet_ros.core.geometry import rotation_exp, rotation_log, sphere_tangents, unit
from djet_ros.core.types import Array, RelativePose
import numpy as np

# Radians by which two rotations may differ beyond what they say of themselves.
_SLACK = np.radians(0.02)

# Normalised squared difference (3 expected) that hardly ever comes by chance: 1 in 10^6.
_SURPRISE = 31.0

# Difference of normalised squares from which on one of two rotations is a thousand times likelier.
_DECIDED = 2 * np.log(1000)


@dataclass(frozen=True)
class Turn:
    """
    A rotation between two views that was not taken from them, as a gyro tells it.

    R: (3, 3) as that of a RelativePose; covariance: (3, 3) of a rotation vector from the left, in
    rad squared.
    """

    R: Array
    covariance: Array

    def off(self, R: Array) -> Array:
        """Rotation vectors (…, 3) from the left that take R, (3, 3) or (N, 3, 3), to this."""
        return rotation_log(self.R @ R.swapaxes(-1, -2))

    def may_be(self, R: Array) -> bool:
        """Tell whether no rotation (3, 3) is a thousand times likelier than this one."""
        return bool(self._square(R) <= _DECIDED)

    def prefers(self, R: Array, other: Array) -> bool:
        """Tell whether this decides for one rotation (3, 3), found in images, and against one."""
        return bool(self._square(other) - self._square(R) > _DECIDED)

    def _square(self, R: Array) -> float:
        z = self.off(R)
        return float(z @ np.linalg.solve(self.covariance + _SLACK**2 * np.eye(3), z))


def agrees(turn: Turn, relative: RelativePose) -> bool:
    """Tell whether the rotation of a pair is the turn's, as far as both claim to know it."""
    z = turn.off(relative.R)
    S = relative.covariance_6[:3, :3] + turn.covariance + _SLACK**2 * np.eye(3)
    return bool(np.isfinite(S).all() and z @ np.linalg.solve(S, z) < _SURPRISE)


def fused(relative: RelativePose, turn: Turn) -> RelativePose:
    """
    Give the pair with the turn weighed into its rotation, and so into its direction too.

    The update of a Kalman filter whose state is the pair's rotation and direction, and which
    measures the rotation. Errors of the two have to be independent, and both covariances known, as
    those of rotations that agree are.
    """
    covariance, t = relative.covariance_5, relative.t
    gain = covariance[:, :3] @ np.linalg.inv(covariance[:3, :3] + turn.covariance)
    step = gain @ turn.off(relative.R)
    keep = np.eye(5) - gain @ np.eye(3, 5)
    updated = keep @ covariance @ keep.T + gain @ turn.covariance @ gain.T
    R = rotation_exp(step[:3]) @ relative.R
    if not t.any():
        # Nobody knows the direction; the basis of its covariance stays what it was.
        return replace(relative, R=R, covariance_5=updated,
                       covariance_6=_with_rotation(relative.covariance_6, updated[:3, :3]))
    turned = unit(t + sphere_tangents(t) @ step[3:])
    change = np.eye(5)
    change[3:, 3:] = sphere_tangents(turned).T @ sphere_tangents(t)
    updated = change @ updated @ change.T
    basis = lift(sphere_tangents(turned))
    return replace(relative, R=R, t=turned, covariance_5=updated,
                   covariance_6=basis @ updated @ basis.T)


def _with_rotation(covariance: Array, rotation: Array) -> Array:
    """Covariance (6, 6) with that of the rotation (3, 3) in place of its own, and no other."""
    result = covariance.copy()
    result[:3], result[:, :3] = 0.0, 0.0
    result[:3, :3] = rotation
    return result
