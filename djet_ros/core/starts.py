"""Starting poses for the joint optimisation."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
from djet_ros.core.fusion import MeasuredRotation
from djet_ros.core.geometry import in_front, nearest_rotation, norms, rays, unit
from djet_ros.core.types import Array, Pose
import numpy as np
from numpy.typing import NDArray

# Translation X_B = X_A + t of a camera that moves along its optical axis.
FORWARD = np.array([0.0, 0.0, -1.0])

# Search for translation directions: matches used, random pairs of them, and number of directions.
_MAX_MATCHES, _PAIRS, _DIRECTIONS = 600, 500, 3

# Pixels: minimum parallax of a match, scale of its score by the distance from the epipolar line of
# a direction, and distance from which on it is an outlier of it.
_MIN_PARALLAX, _TOLERANCE, _OUTLIER = 0.5, 1.0, 2.0

# Number of matches for RANSAC, the most similar ones; the optimisation uses all.
_RANSAC_MATCHES = 300


def five_point(K: Array, x: Array, y: Array, threshold: float,
               robust: bool) -> tuple[Pose, NDArray[np.bool_]] | None:
    """
    Estimate a pose and its inliers by the 5-point algorithm with RANSAC.

    The p_0 of Algorithm 1 in the paper. x, y: (N, 2) pixels; threshold in pixels; robust: MAGSAC++
    in place of plain RANSAC. None if no essential matrix was found.
    """
    if K[0, 1]:
        # OpenCV ignores skew, so the pixels are converted to a camera without it.
        upright = K * [[1, 0, 1], [1, 1, 1], [1, 1, 1]]
        x, y = (rays(K, places) @ upright[:2].T for places in (x, y))
        K = upright
    method = cv2.USAC_MAGSAC if robust else cv2.RANSAC
    E, mask = cv2.findEssentialMat(x, y, np.ascontiguousarray(K), method=method, prob=0.999,
                                   threshold=threshold)  # a view of a 3x4 matrix finds nothing
    if E is None or E.shape[0] < 3 or not np.isfinite(E).all():
        return None
    inliers = mask.ravel() > 0
    R1, R2, t = (np.asarray(part, float) for part in cv2.decomposeEssentialMat(E[:3]))
    candidates = [Pose(R, sign * t.ravel()) for R in (R1, R2) for sign in (1.0, -1.0)]
    rays_x, rays_y = rays(K, x[inliers]), rays(K, y[inliers])
    best = max(candidates, key=lambda p: int(in_front(p.R, p.t, rays_x, rays_y).sum()))
    return best, inliers


def starting_poses(K: Array, x: Array, y: Array, threshold: float,
                   prior: Pose | None) -> list[Pose]:
    """
    Collect the starting poses of the preset ``best``.

    x, y: (N, 2) pixels, the most reliable matches first; threshold in pixels; prior: the previous
    motion, if any.
    """
    x, y = x[:_RANSAC_MATCHES], y[:_RANSAC_MATCHES]
    estimate = five_point(K, x, y, threshold, robust=True)
    return [*likely_starts(estimate[0] if estimate else None, prior),
            *planar_starts(K, x, y, threshold)]


@dataclass(frozen=True)
class KnownMotion:
    """
    Knowledge of a motion from other sources than the two images.

    rotation: its rotation with covariance, as from a gyro; guess: an approximate pose, as from
    another odometry; stood: whether the camera stood still before. What stays in place is then
    the static world, and not attached to the camera.
    """

    rotation: MeasuredRotation | None = None
    guess: Pose | None = None
    stood: bool = False

    def rotations(self) -> list[Array]:
        """Return the known rotations, (3, 3) each, the most certain first."""
        measured = [] if self.rotation is None else [self.rotation.R]
        still = [np.eye(3)] if self.stood else []
        return [*measured, *still, *([] if self.guess is None else [self.guess.R])]


def external_starts(K: Array, x: Array, y: Array, known: KnownMotion) -> list[Pose]:
    """
    Collect starts from external measurements: the guess, and the rotation with directions.

    The directions are those of matches under the measured rotation, of the guess, and forward. x,
    y: (N, 2) pixels, the most reliable matches first.
    """
    starts = [] if known.guess is None else [known.guess]
    if known.rotation is not None:
        subset = subsampled(len(x), _MAX_MATCHES)
        starts += [Pose(known.rotation.R, t)
                   for t in translation_directions(K, x[subset], y[subset], known.rotation.R)]
        if known.guess is not None:
            starts.append(Pose(known.rotation.R, known.guess.t))
        starts.append(Pose(known.rotation.R, FORWARD))
    return starts


def translation_directions(K: Array, x: Array, y: Array, R: Array) -> list[Array]:
    """
    Estimate translation directions (3,) for a known rotation R (3, 3), the best supported first.

    Each match constrains t to a plane; two of them determine it. The best hypothesis from random
    pairs is taken, its inliers are removed, and so on, as there may be moving objects. x, y:
    (N, 2) pixels.
    """
    focal = float(K[0, 0])
    normals = np.cross(rays(K, x) @ R.T, rays(K, y)) * focal
    # A match with hardly any parallax does not constrain t.
    normals = normals[norms(normals) > _MIN_PARALLAX]
    directions: list[Array] = []
    while len(directions) < _DIRECTIONS and len(normals) > 2:
        one, other = np.random.default_rng(0).integers(0, len(normals), (2, _PAIRS))
        tried = unit(np.cross(normals[one], normals[other]))
        distances = np.abs(tried @ normals.T)
        # A match paired with itself gives a zero vector, which fits everything.
        agreement = np.maximum(1 - (distances / _TOLERANCE)**2, 0).sum(1) * tried.any(1)
        best = int(agreement.argmax())
        if not agreement[best]:
            break
        directions.append(tried[best])
        normals = normals[distances[best] > _OUTLIER]
    return directions


def subsampled(count: int, most: int) -> slice:
    """Return a slice that takes at most so many of a count of matches, evenly spaced."""
    return slice(None, None, max(1, -(-count // most)))


def hemisphere_starts(R: Array, count: int) -> list[Pose]:
    """Return poses of one rotation with directions evenly over a hemisphere, on a spiral."""
    return [Pose(R, t) for t in _hemisphere(count)]


@lru_cache(maxsize=8)
def _hemisphere(count: int) -> Array:
    z = (np.arange(count) + 0.5) / count
    angle = np.pi * (1 + np.sqrt(5)) * (np.arange(count) + 0.5)
    ring = np.sqrt(1 - z**2)
    directions = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)
    directions.setflags(write=False)
    return directions


def starts_around(pose: Pose, count: int) -> list[Pose]:
    """
    Return a pose and its rotation with the forward and hemisphere directions, as starts.

    Without the pose itself if its t is zeros, as then its direction is unknown.
    """
    itself = [pose] if pose.t.any() else []
    return [*itself, Pose(pose.R, FORWARD), *hemisphere_starts(pose.R, count)]


def planar_starts(K: Array, x: Array, y: Array, threshold: float) -> list[Pose]:
    """
    Estimate up to four motions from a homography, as many matches may be of one plane.

    Two motions explain the same plane, and RANSAC may take the wrong one. x, y: (N, 2) pixels;
    threshold in pixels.
    """
    H, _ = cv2.findHomography(x, y, cv2.USAC_MAGSAC, 2 * threshold)
    if H is None or not np.isfinite(H).all():
        return []
    _, rotations, translations, _ = cv2.decomposeHomographyMat(H, np.ascontiguousarray(K))
    # OpenCV's rotation matrices have errors up to 1e-8.
    return [Pose(nearest_rotation(np.asarray(R, float)), unit(np.ravel(np.asarray(t, float))))
            for R, t in zip(rotations, translations)
            if np.isfinite(R).all() and np.linalg.norm(t) > 1e-6]


def likely_starts(robust: Pose | None, prior: Pose | None) -> list[Pose]:
    """
    Collect starts that cover the likely basins.

    RANSAC alone can end in a wrong one (sideways in place of forward translation); the previous
    motion and pure forward motion are the likely alternatives.
    """
    known = [pose for pose in (robust, prior) if pose is not None]
    straight = [Pose(R, FORWARD) for R in [*(pose.R for pose in known), np.eye(3)]]
    return known + straight
