"""Two views with exact geometry: points seen by a camera in two places, and plain images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.geometry import (
    epipolar_lines,
    fundamental,
    line_distances,
    rotation_exp,
    sphere_tangents,
    unit,
)
from djet_ros.core.types import Features, View
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

# KITTI's gray camera, and one whose pixels are neither square nor upright.
K = np.array([[718.856, 0.0, 607.1928], [0.0, 718.856, 185.2157], [0.0, 0.0, 1.0]])
SKEWED = np.array([[700.0, 35.0, 590.0], [0.0, 560.0, 210.0], [0.0, 0.0, 1.0]])
SIZE = (1241, 376)

SIDEWAYS, FORWARD, BACKWARD = (1.0, 0.0, 0.1), (0.0, 0.02, -1.0), (0.05, 0.0, 1.0)
TURN = (0.01, 0.03, -0.005)


@dataclass(frozen=True)
class TwoViews:
    """
    Points (N, 3) in the previous camera, and their exact pixels x and y (N, 2).

    ``X_B = R X_A + t`` with t of unit length: one baseline is the unit of all lengths.
    """

    K: np.ndarray
    R: np.ndarray
    t: np.ndarray
    points: np.ndarray
    x: np.ndarray
    y: np.ndarray


def two_views(rng: np.random.Generator, count: int = 200, t: Sequence[float] = SIDEWAYS,
              turn: Sequence[float] = TURN, K: np.ndarray = K, near: float = 4.0,
              far: float = 40.0) -> TwoViews:
    """Points at depths between near and far baselines, all in both images; turn is in radians."""
    R, direction = Rotation.from_rotvec(turn).as_matrix(), unit(np.asarray(t, float))
    x = rng.uniform((0, 0), SIZE, (20 * count, 2))
    rays = np.column_stack([x, np.ones(len(x))]) @ np.linalg.inv(K).T
    points = rays * rng.uniform(near, far, (len(x), 1))
    y, depth = project(K, points @ R.T + direction)
    both = np.flatnonzero((depth > 0.5) & (y >= 0).all(1) & (y < SIZE).all(1))[:count]
    assert len(both) == count, 'too few of the points are in both images'
    return TwoViews(K, R, direction, points[both], x[both], y[both])


def project(K: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (N, 2) and depths (N,) of points (N, 3) in the camera."""
    pixels = points @ K.T
    return pixels[:, :2] / pixels[:, 2:], points[:, 2]


def moved_pose(R: np.ndarray, t: np.ndarray, by: float,
               rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Rotate a pose and its direction by an angle in radians, each about a random axis."""
    axes = unit(rng.normal(size=(2, 3)))
    axes[1] = unit(np.cross(axes[1], t))
    return (Rotation.from_rotvec(by * axes[0]).as_matrix() @ R,
            Rotation.from_rotvec(by * axes[1]).as_matrix() @ t)


def textured(rng: np.random.Generator, size: tuple[int, int]) -> np.ndarray:
    """Image (H, W) uint8 like that of a camera: soft shades, sharp edges and fine grain."""
    width, height = size
    shades = cv2.GaussianBlur(rng.normal(0, 900, (height, width)), (0, 0), 12)
    image = 128 + shades + cv2.GaussianBlur(rng.normal(0, 60, (height, width)), (0, 0), 1.5)
    for _ in range(width * height // 700):
        corner, extent = rng.uniform((0, 0), size), rng.uniform(4, 30, 2)
        box = [(round(v), round(v + e)) for v, e in zip(corner, extent)]
        image[slice(*box[1]), slice(*box[0])] += rng.uniform(-60, 60)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def some(features: Features, chosen: np.ndarray | slice) -> Features:
    """Return a subset of the features, by index or slice."""
    return Features.with_descriptors(
        features.points[chosen], features.octaves[chosen], features.angles[chosen],
        features.responses[chosen], features.descriptors[chosen])


def uniform_view(K: np.ndarray = K, size: tuple[int, int] = SIZE, gray: int = 90) -> View:
    """View of a textureless wall."""
    return TwoViewEstimator().view(np.full(size[::-1], gray, np.uint8), K)


# A wide camera, near to what it sees.
CLOSE_UP, SMALL = np.array([[268.0, 0, 319.5], [0, 268.0, 170], [0, 0, 1]]), (640, 360)


def pictures_of_a_plane(rng: np.random.Generator
                        ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return R (3, 3), t (3,) and both pictures (H, W) of one textured plane, on some motion."""
    texture = _texture(rng)
    turned = Rotation.from_euler('xy', rng.uniform(-40, 40, 2), degrees=True).as_matrix()
    R = Rotation.from_euler('xyz', rng.normal(0, 2, 3), degrees=True).as_matrix()
    t = rng.choice([0.1, 0.4]) * unit(rng.normal(size=3))
    one, other = (_view_of_a_plane(rng, texture, turned, *motion)
                  for motion in ((np.eye(3), np.zeros(3)), (R, t)))
    return R, t, one, other


def pictures_towards_a_wall(rng: np.random.Generator, t: np.ndarray, count: int
                            ) -> list[np.ndarray]:
    """Return pictures (H, W) of a wall that a camera faces, each a step t (3,) after another."""
    texture = _texture(rng)
    return [_view_of_a_plane(rng, texture, np.eye(3), np.eye(3), i * t) for i in range(count)]


def _texture(rng: np.random.Generator) -> np.ndarray:
    return 128 + 28 * sum(cv2.resize(rng.normal(size=(2048 // side, 2048 // side)),
                                     (2048, 2048), interpolation=cv2.INTER_CUBIC)
                          for side in (8, 16, 64))


def _view_of_a_plane(rng: np.random.Generator, texture: np.ndarray, turned: np.ndarray,
                     R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Picture (H, W) of a plane that stands 8 before the first camera, turned (3, 3) from that."""
    middle, finer = len(texture) / 2, np.array([[2, 0, 0.5], [0, 2, 0.5], [0, 0, 1.0]])
    on_plane = np.column_stack([turned[:, :2] / 80, 8 * turned[:, 2]]) @ np.array(
        [[1, 0, -middle], [0, 1, -middle], [0, 0, 1]])
    H = finer @ CLOSE_UP @ (R @ on_plane + np.outer(t, [0, 0, 1]))
    seen = cv2.resize(cv2.warpPerspective(texture, H, (2 * SMALL[0], 2 * SMALL[1])), SMALL,
                      interpolation=cv2.INTER_AREA)
    return np.clip(np.rint(seen + rng.normal(0, 1.5, seen.shape)), 0, 255).astype(np.uint8)


def flight_over_a_plane(rng: np.random.Generator, count: int
                        ) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray]]:
    """
    Return the K (3, 3), pictures (H, W) and poses (4, 4) of a camera over flat ground.

    It is one unit above it, looks down by 45 degrees or more through a narrow lens, and flies
    irregularly, by about a twentieth of that height per picture.
    """
    lens = np.array([[400.0, 0, 159.5], [0, 400.0, 119.5], [0, 0, 1]])
    ground = textured(rng, (2000, 2000))
    on_ground = np.linalg.inv([[200.0, 0, 1000], [0, 200, 1000], [0, 0, 1]])
    R = Rotation.from_euler('zx', (rng.uniform(-np.pi, np.pi), rng.uniform(0, np.pi / 4)))
    place, turn = np.array([0, 0, -1.0]), rng.normal(size=3)
    step = 0.06 * unit(rng.normal(size=3) * (1, 1, 0.3))
    pictures, poses = [], []
    for _ in range(count):
        poses.append(np.block([[R.as_matrix(), place[:, None]], [np.zeros(3), 1]]))
        into = np.linalg.inv(poses[-1])
        seen = cv2.warpPerspective(ground, lens @ into[:3, [0, 1, 3]] @ on_ground, (320, 240),
                                   flags=cv2.INTER_AREA) + rng.normal(0, 1.5, (240, 320))
        pictures.append(np.clip(np.rint(seen), 0, 255).astype(np.uint8))
        step, turn = step + rng.normal(0, 0.01, 3), turn + rng.normal(0, 0.2, 3)
        place, R = place + step, R * Rotation.from_rotvec(0.01 * turn)
    return lens, pictures, poses


def fitted(K, R, t, x, y):
    """
    Return the motion near (R, t) with the least distances from epipolar lines, as pairs find it.

    x, y: (N, 2) matched pixels.
    """
    def moved(step):
        return rotation_exp(step[:3]) @ R, unit(t + sphere_tangents(t) @ step[3:])

    return moved(least_squares(lambda step: line_distances(
        epipolar_lines(fundamental(K, *moved(step)), x), y), np.zeros(5)).x)
