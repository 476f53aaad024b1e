"""Fusion of a pose with an independently measured rotation, by both covariances."""

from __future__ import annotations

from dataclasses import dataclass, replace

from djet_ros.core.covariance import lifted_covariance
from djet_ros.core.geometry import rotation_exp, rotation_log, sphere_tangents, unit
from djet_ros.core.types import Array, RelativePose
import numpy as np

# Radians; tolerance of two rotations beyond their covariances.
_SLACK = np.radians(0.02)

# Normalised squared difference (expected value 3) that noise exceeds once in 10^6.
_SURPRISE = 31.0

# Difference of normalised squares at which one rotation is a thousand times likelier than another.
_DECIDED = 2 * np.log(1000)


@dataclass(frozen=True)
class MeasuredRotation:
    """
    A rotation between two views measured without them, as by a gyro.

    R: (3, 3) as in RelativePose; covariance: (3, 3) of a rotation vector from the left, in rad
    squared.
    """

    R: Array
    covariance: Array

    def correction(self, R: Array) -> Array:
        """Return the rotation vectors (…, 3) that correct R, (3, 3) or (N, 3, 3), to this one."""
        return rotation_log(self.R @ R.swapaxes(-1, -2))

    def compatible_with(self, R: Array) -> bool:
        """Return whether a rotation (3, 3) is compatible: not a thousand times less likely."""
        return bool(self._square(R) <= _DECIDED)

    def prefers(self, R: Array, other: Array) -> bool:
        """Return whether the measurement favours one estimated rotation (3, 3) over another."""
        return bool(self._square(other) - self._square(R) > _DECIDED)

    def _square(self, R: Array) -> float:
        z = self.correction(R)
        return float(z @ np.linalg.solve(self.covariance + _SLACK**2 * np.eye(3), z))


def agrees(measured: MeasuredRotation, relative: RelativePose) -> bool:
    """Return whether the rotation of a pair is consistent with the measured one."""
    z = measured.correction(relative.R)
    S = relative.covariance_6[:3, :3] + measured.covariance + _SLACK**2 * np.eye(3)
    return bool(np.isfinite(S).all() and z @ np.linalg.solve(S, z) < _SURPRISE)


def fused(relative: RelativePose, measured: MeasuredRotation) -> RelativePose:
    """
    Update the rotation and direction of a pair by a measured rotation.

    A Kalman update of the pair's rotation and direction with a measurement of the rotation. The
    errors of both have to be independent.
    """
    covariance, t = relative.covariance_5, relative.t
    gain = covariance[:, :3] @ np.linalg.inv(covariance[:3, :3] + measured.covariance)
    step = gain @ measured.correction(relative.R)
    keep = np.eye(5) - gain @ np.eye(3, 5)
    updated = keep @ covariance @ keep.T + gain @ measured.covariance @ gain.T
    R = rotation_exp(step[:3]) @ relative.R
    if not t.any():
        # The direction is not determined; the basis of its covariance stays unchanged.
        return replace(relative, R=R, covariance_5=updated,
                       covariance_6=_with_rotation(relative.covariance_6, updated[:3, :3]))
    turned = unit(t + sphere_tangents(t) @ step[3:])
    change = np.eye(5)
    change[3:, 3:] = sphere_tangents(turned).T @ sphere_tangents(t)
    updated = change @ updated @ change.T
    return replace(relative, R=R, t=turned, covariance_5=updated,
                   covariance_6=lifted_covariance(updated, turned))


def _with_rotation(covariance: Array, rotation: Array) -> Array:
    """Replace the rotation block of a covariance (6, 6), without cross-covariances."""
    result = covariance.copy()
    result[:3], result[:, :3] = 0.0, 0.0
    result[:3, :3] = rotation
    return result
