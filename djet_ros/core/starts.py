"""Starting poses for the joint optimisation."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
from djet_ros.core.fusion import Turn
from djet_ros.core.geometry import in_front, nearest_rotation, rays, unit
from djet_ros.core.types import Array, Pose
import numpy as np
from numpy.typing import NDArray

# Translation X_B = X_A + t of a camera that drives straight ahead.
FORWARD = np.array([0.0, 0.0, -1.0])

# Matches that directions are sought by, pairs of them that are tried, and how many are found.
_MATCHES_FOR_DIRECTIONS, _PAIRS, _DIRECTIONS = 600, 500, 3

# Pixels that a match has to move beyond the turn to have a say, that it may be off the epipolar
# line of a direction, and beyond which it does not belong to it.
_MOVED, _OFF, _BEYOND = 0.5, 1.0, 2.0

# As many matches, the most similar ones, tell a motion from the false ones; all of them are for
# the optimisation.
_RANSAC_MATCHES = 300


def five_point(K: Array, x: Array, y: Array, threshold: float,
               robust: bool) -> tuple[Pose, NDArray[np.bool_]] | None:
    """
    Start from the 5-point algorithm inside RANSAC (paper, Algorithm 1's p_0), with its inliers.

    x, y: (N, 2) pixels; threshold in pixels. `robust` takes MAGSAC++ instead of plain RANSAC.
    None where no essential matrix was found.
    """
    if K[0, 1]:
        # OpenCV's RANSAC knows of no skew: it gets pixels of the same camera without any.
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
    Collect all starting poses of the preset ``best``.

    x, y: (N, 2) pixels, the surest matches first; threshold in pixels; prior: the previous
    motion, if there is one.
    """
    x, y = x[:_RANSAC_MATCHES], y[:_RANSAC_MATCHES]
    found = five_point(K, x, y, threshold, robust=True)
    return [*several(found[0] if found else None, prior), *planar(K, x, y, threshold)]


@dataclass(frozen=True)
class Known:
    """
    What others than the images tell of a motion.

    turn: its rotation, and how sure that is; guess: a pose that it may be near, as another
    odometry has it.
    """

    turn: Turn | None = None
    guess: Pose | None = None

    def rotations(self) -> list[Array]:
        """Give what is known of the rotation, (3, 3) each, the surest first."""
        return [one.R for one in (self.turn, self.guess) if one is not None]


def known_starts(K: Array, x: Array, y: Array, known: Known) -> list[Pose]:
    """
    Collect the guess, and the directions that matches have under the turn.

    x, y: (N, 2) pixels, the surest matches first.
    """
    starts = [] if known.guess is None else [known.guess]
    if known.turn is not None:
        some = thinned(len(x), _MATCHES_FOR_DIRECTIONS)
        starts += [Pose(known.turn.R, t) for t in directions(K, x[some], y[some], known.turn.R)]
        if known.guess is not None:
            starts.append(Pose(known.turn.R, known.guess.t))
        starts.append(Pose(known.turn.R, FORWARD))
    return starts


def directions(K: Array, x: Array, y: Array, R: Array) -> list[Array]:
    """
    Find directions of translation (3,) under a rotation R (3, 3), the one of most matches first.

    Each match leaves a plane that t lies in; two of them leave t. The best of random pairs comes
    first, and after it the best that those matches leave which are not its own: something may
    move by itself. x, y: (N, 2) pixels.
    """
    focal = float(K[0, 0])
    normals = np.cross(rays(K, x) @ R.T, rays(K, y)) * focal
    # A match that hardly moves beyond the turn leaves no plane.
    normals = normals[np.linalg.norm(normals, axis=1) > _MOVED]
    found: list[Array] = []
    while len(found) < _DIRECTIONS and len(normals) > 2:
        one, other = np.random.default_rng(0).integers(0, len(normals), (2, _PAIRS))
        tried = unit(np.cross(normals[one], normals[other]))
        off = np.abs(tried @ normals.T)
        # A match paired with itself leaves nothing, which everything would agree with.
        agreement = np.maximum(1 - (off / _OFF)**2, 0).sum(1) * tried.any(1)
        best = int(agreement.argmax())
        if not agreement[best]:
            break
        found.append(tried[best])
        normals = normals[off[best] > _BEYOND]
    return found


def thinned(count: int, most: int) -> slice:
    """Choose at most so many of a count of matches, evenly from their order."""
    return slice(None, None, max(1, -(-count // most)))


def all_round(R: Array, count: int) -> list[Pose]:
    """Give poses of one rotation with directions evenly over half a sphere, on a spiral."""
    return [Pose(R, t) for t in _half_sphere(count)]


@lru_cache(maxsize=8)
def _half_sphere(count: int) -> Array:
    z = (np.arange(count) + 0.5) / count
    turn = np.pi * (1 + np.sqrt(5)) * (np.arange(count) + 0.5)
    ring = np.sqrt(1 - z**2)
    directions = np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)
    directions.setflags(write=False)
    return directions


def around(pose: Pose, count: int) -> list[Pose]:
    """
    Give a pose, and others of its rotation: straight ahead, and in directions all round.

    Without itself, where its t is zeros, as its direction is not known.
    """
    itself = [pose] if pose.t.any() else []
    return [*itself, Pose(pose.R, FORWARD), *all_round(pose.R, count)]


def planar(K: Array, x: Array, y: Array, threshold: float) -> list[Pose]:
    """
    Start from the motions of a plane that many matches may lie on (at most four).

    A plane is seen alike under two motions (its twin); RANSAC may take the wrong one of them.
    x, y: (N, 2) pixels; threshold in pixels.
    """
    H, _ = cv2.findHomography(x, y, cv2.USAC_MAGSAC, 2 * threshold)
    if H is None or not np.isfinite(H).all():
        return []
    _, rotations, translations, _ = cv2.decomposeHomographyMat(H, np.ascontiguousarray(K))
    # OpenCV's rotations are off by as much as 1e-8.
    return [Pose(nearest_rotation(np.asarray(R, float)), unit(np.ravel(np.asarray(t, float))))
            for R, t in zip(rotations, translations)
            if np.isfinite(R).all() and np.linalg.norm(t) > 1e-6]


def several(robust: Pose | None, prior: Pose | None) -> list[Pose]:
    """
    Collect starting poses that between them reach the right basin.

    RANSAC alone can land in a wrong one (sideways for forward translation); the previous motion
    and driving straight ahead are the likely alternatives.
    """
    known = [pose for pose in (robust, prior) if pose is not None]
    straight = [Pose(R, FORWARD) for R in [*(pose.R for pose in known), np.eye(3)]]
    return known + straight
