"""
What the calibration of a camera gets wrong.

Points u = (X/Z, Y/Z) appear at the pixels K' (1 + k1 |u|^2) u, where a calibration has K and no
distortion left. K' has another focal length and principal point.
"""

from __future__ import annotations

from typing import NamedTuple

from djet_ros.core.geometry import (
    displaced_by_turn,
    fit_rotation,
    norms,
    rays,
    rotation_exp,
    skew,
    sphere_tangents,
)
from djet_ros.core.medians import median
from djet_ros.core.types import Array, RelativePose
import numpy as np

# Matches by which a pair is taken to depend on the camera, evenly sampled.
_MATCHES = 300

# Least information in any direction of a motion, relative to that of all.
_LEAST = 1e-12

# Least square of a distance in units of the focal length, against division by zero.
_LEAST_SQUARE = 1e-18


class Correction(NamedTuple):
    """
    Deviation of a camera from its calibration.

    k1: radial distortion; focal: relative change of the focal length; cx, cy: shift of the
    principal point, as a share of the focal length. All zero: the calibration is right.
    """

    k1: float = 0.0
    focal: float = 0.0
    cx: float = 0.0
    cy: float = 0.0

    def camera_matrix(self, K: Array) -> Array:
        """Return the corrected one of a calibrated camera matrix (3, 3)."""
        corrected = np.array(K, np.float64)
        corrected[:2, 2] += corrected[:2, :2] @ self[2:]
        corrected[:2, :2] *= 1 + self.focal
        return corrected


AS_CALIBRATED = Correction()

# Number of parameters of a camera: the fields of a Correction.
OF_CAMERA = len(Correction._fields)


def motion_shift(pair: RelativePose, K: Array) -> Array:
    """
    Return how a correction of the camera would change the motion of a pair, (5, 4) by its fields.

    K: (3, 3) of the pair, which needs a direction; the motion is in the parameters of its
    covariance. It has the least squares of the inliers' distances from their epipolar lines, so it
    adapts as their viewing rays are corrected.
    """
    inliers = np.flatnonzero(pair.inliers)
    chosen = inliers[::max(len(inliers) // _MATCHES, 1)]
    x, y = (rays(K, points[chosen]) for points in (pair.x, pair.y_opt))
    turned, T = x @ pair.R.T, skew(pair.t)
    normals, across = turned @ T.T, y @ T
    by_motion = np.concatenate([np.cross(turned, across),
                                np.cross(turned, y) @ sphere_tangents(pair.t)], axis=1)
    by_camera = -(np.einsum('ni,nia->na', across @ pair.R[:, :2], displacements(x[:, :2]))
                  + np.einsum('ni,nia->na', normals[:, :2], displacements(y[:, :2])))
    weights = 1 / (normals[:, :2]**2).sum(1, keepdims=True)
    weighted = (weights * by_motion).T
    H = weighted @ by_motion
    # What the matches leave undetermined stays.
    return np.asarray(-np.linalg.solve(H + _LEAST * np.trace(H) * np.eye(5),
                                       weighted @ by_camera))


def displacements(u: Array) -> Array:
    """Return how a deviation displaces points X/Z, Y/Z (N, 2): (N, 2, 4) by its fields."""
    by_field = np.empty((len(u), 2, OF_CAMERA))
    by_field[:, :, 0], by_field[:, :, 1] = u * (u * u).sum(1, keepdims=True), u
    by_field[:, :, 2:] = np.eye(2)
    return by_field


def turn_of_deviating_camera(rays_x: Array, rays_y: Array, sigmas: Array, rounds: int = 5
                             ) -> tuple[Array, Array]:
    """
    Fit a rotation R (3, 3) of a camera that may deviate from its calibration, robustly.

    sigmas: (4,) prior standard deviations of the fields of a `Correction`; rays_x, rays_y: (N, 3).
    Returns R, and the distances (N,) of y from where it brings x, in units of the focal length.
    Robust as `fit_rotation`.
    """
    x, y = (one[:, :2] / one[:, 2:] for one in (rays_x, rays_y))
    R, deviation, by_x = fit_rotation(rays_x, rays_y), np.zeros(OF_CAMERA), displacements(x)
    prior = np.diag(np.append(np.zeros(3), 1 / sigmas**2))
    for _ in range(rounds):
        residuals, J = _turned(R, deviation, x, y, by_x)
        squared = (residuals**2).sum(1)
        weights = 1 / (max(median(squared), _LEAST_SQUARE) + squared)
        weighted = np.einsum('n,nia->nia', weights, J).reshape(-1, 3 + OF_CAMERA).T
        step = np.linalg.solve(weighted @ J.reshape(-1, 3 + OF_CAMERA) + prior,
                               weighted @ residuals.ravel() - prior[:, 3:] @ deviation)
        R, deviation = rotation_exp(step[:3]) @ R, deviation + step[3:]
    return R, norms(_turned(R, deviation, x, y, by_x)[0])


def _turned(R: Array, deviation: Array, x: Array, y: Array, by_x: Array) -> tuple[Array, Array]:
    """
    Return the residuals (N, 2) of y after a rotation of x, and what they take from (N, 2, 7).

    Those are the derivatives of what is subtracted from y, by a step of the rotation from the left
    and by the deviation (4,); by_x: (N, 2, 4) `displacements` at x.
    """
    turned = x @ R[:, :2].T + R[:, 2]
    places = turned[:, :2] / turned[:, 2:]
    by_turn = np.array(displaced_by_turn(*places.T)).transpose(2, 0, 1)
    by_place = (R[:2, :2] - places[:, :, None] * R[2, :2]) / turned[:, 2:, None]
    # Both places are seen displaced: y where the true one of x would be brought.
    by_camera = displacements(places) - by_place @ by_x
    return (y - places - by_camera @ deviation,
            np.concatenate([by_turn, by_camera], axis=2))
