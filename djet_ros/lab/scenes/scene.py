"""A scene: a world, a trajectory through it, and a camera."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

from djet_ros.core.types import Array
from djet_ros.errors import DjetError
from djet_ros.lab.scenes.camera import Effect, Shot
from djet_ros.lab.scenes.panel import World
from djet_ros.lab.scenes.raster import PanelsInView, project_panels, Raster, reduce, shade, visible
from djet_ros.lab.scenes.route import Trajectory
from djet_ros.lab.scenes.texture import Gray
import numpy as np
from numpy.typing import NDArray

_SUPERSAMPLING = 2


@dataclass(frozen=True)
class Scene:
    """
    Everything that determines its images, which are the same bytes in every rendering.

    K: (3, 3) pixels, pixel centres at integers; size: (width, height); background: gray value of
    empty pixels; effects: of the camera, in order of application; reach: metres beyond which
    nothing is drawn; samples: per pixel and direction, 2 for antialiased edges, 1 for aliased
    ones. Poses are camera to first camera, so the first is the identity.
    """

    name: str
    world: World
    path: Trajectory
    K: Array
    size: tuple[int, int]
    seed: int
    background: float = 0.0
    effects: tuple[Effect, ...] = ()
    reach: float = np.inf
    samples: int = _SUPERSAMPLING

    def trajectory(self, frames: int) -> Array:
        """Return poses (frames, 4, 4), camera to first camera, in metres. Raises DjetError."""
        if not 1 <= frames <= self.path.limit:
            raise DjetError(f"--frames is {frames}; scene '{self.name}' has 1 to "
                            f'{self.path.limit} frames')
        return np.stack([self._from_level @ self.path.pose(i) for i in range(frames)])

    def render(self, pose: Array, index: int = 0) -> NDArray[np.uint8]:
        """
        Render the image (H, W) from a pose (4, 4), camera to first camera.

        index: frame number, which determines moving objects, particles and noise.
        """
        shot = self._expose(pose, index)
        for effect in self.effects:
            shot = replace(shot, radiance=effect(shot))
        return np.asarray(np.clip(np.rint(shot.radiance), 0, 255), np.uint8)

    def depth(self, pose: Array, index: int = 0) -> Gray:
        """Return the exact depth z (H, W) in metres at the pixel centres, infinite if empty."""
        _, inverse = visible(*self._look(self._to_level @ pose, index, 1))
        with np.errstate(divide='ignore'):
            return np.asarray(1 / inverse, np.float32)

    @property
    def level(self) -> Array:
        """Return the rotation (3, 3), first camera to level axes (x right, y down, z ahead)."""
        return np.asarray(self._to_level[:3, :3])

    @cached_property
    def _to_level(self) -> Array:
        return self.path.pose(0)

    @cached_property
    def _from_level(self) -> Array:
        return np.asarray(np.linalg.inv(self._to_level))

    def _look(self, level: Array, index: int, factor: int) -> tuple[PanelsInView, Raster]:
        raster = Raster(self.size, factor)
        return project_panels(self.world.at(index), level, self.K, raster, self.reach), raster

    def _expose(self, pose: Array, index: int) -> Shot:
        """Return the radiance at the camera before all effects."""
        level = self._to_level @ pose
        view, raster = self._look(level, index, self.samples)
        ids, inverse = visible(view, raster)
        radiance = reduce(shade(view, ids, raster, self.background), self.samples)
        return Shot(radiance, reduce(inverse, self.samples), self.K, level, index, self.seed)
