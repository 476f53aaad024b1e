"""Two images of a scene with ground truth."""

from __future__ import annotations

from dataclasses import dataclass

from djet_ros.core.types import Array
from djet_ros.lab.scenes.catalogue import make_scene
from djet_ros.lab.scenes.texture import Gray
import numpy as np
from numpy.typing import NDArray

# Relative depth difference below which a point is on the visible surface, and relative second
# difference of inverse depth below which a surface is flat.
_SAME_SURFACE = 2e-3
_FLATNESS = 1e-5


@dataclass(frozen=True)
class ScenePair:
    """
    Two frames: gray images (H, W), exact depths (H, W) in metres, camera K (3, 3), and motion.

    R, t: ``x_current = R x_previous + t``, t (3,) in metres.
    """

    previous: NDArray[np.uint8]
    current: NDArray[np.uint8]
    depth_previous: Gray
    depth_current: Gray
    K: Array
    R: Array
    t: Array

    def project(self, points: Array) -> tuple[Array, NDArray[np.bool_]]:
        """
        Return positions (N, 2) of static points (N, 2) in the current image, and their visibility.

        A point is visible if it is well inside one surface and inside the current image, and not
        occluded there. Positions of the others are invalid.
        """
        depth, inside = _depth_at(self.depth_previous, points)
        rays = np.concatenate([points, np.ones((len(points), 1))], 1) @ np.linalg.inv(self.K).T
        moved = (depth[:, None] * rays) @ self.R.T + self.t
        with np.errstate(divide='ignore', invalid='ignore'):
            pixels = (moved @ self.K.T)[:, :2] / moved[:, 2:]
        pixels = np.where(np.isfinite(pixels), pixels, -1.0)
        depth_current, inside_current = _depth_at(self.depth_current, pixels)
        hidden = np.abs(depth_current / moved[:, 2] - 1) > _SAME_SURFACE
        return pixels, inside & inside_current & ~hidden & (moved[:, 2] > 0)


def _depth_at(depth: Gray, points: Array) -> tuple[Array, NDArray[np.bool_]]:
    """
    Return depth (N,) at sub-pixel points (N, 2), and whether they are well inside a plane.

    On a plane inverse depth is affine in the pixel, so that its interpolation is exact.
    """
    inverse = 1 / depth.astype(float)
    height, width = depth.shape
    corner = np.floor(points).astype(int)
    valid = np.asarray(((corner >= 1) & (corner < (width - 2, height - 2))).all(axis=1))
    corner = np.where(valid[:, None], corner, 1)
    x, y = np.where(valid[:, None], points - corner, 0.0).T
    columns, rows = corner[:, :1] + (0, 1, 0, 1), corner[:, 1:] + (0, 0, 1, 1)
    weights = np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], axis=1)
    value = (inverse[rows, columns] * weights).sum(1)
    valid &= (value > 0) & ~_bent(inverse)[rows, columns].any(1)
    return 1 / np.where(valid, value, 1.0), valid


def _bent(inverse: Array) -> NDArray[np.bool_]:
    """Return the pixels (H, W) at which inverse depth (H, W) is not affine."""
    bend = np.zeros_like(inverse)
    bend[:, 1:-1] += np.abs(inverse[:, :-2] - 2 * inverse[:, 1:-1] + inverse[:, 2:])
    bend[1:-1] += np.abs(inverse[:-2] - 2 * inverse[1:-1] + inverse[2:])
    return np.asarray(bend > _FLATNESS * inverse)


def render_pair(name: str, first: int = 0, step: int = 1, seed: int = 0,
                size: tuple[int, int] | None = None) -> ScenePair:
    """Render frames ``first`` and ``first + step`` of a named scene."""
    scene = make_scene(name, seed, size)
    last = first + step
    poses = scene.trajectory(max(first, last) + 1)
    motion = np.linalg.inv(poses[last]) @ poses[first]
    return ScenePair(scene.render(poses[first], first), scene.render(poses[last], last),
                     scene.depth(poses[first], first), scene.depth(poses[last], last),
                     scene.K, motion[:3, :3], motion[:3, 3])
