"""Polished floors."""

from __future__ import annotations

from dataclasses import dataclass, replace

from djet_ros.lab.scenes.camera import Shot
from djet_ros.lab.scenes.panel import PanelArrays, World
from djet_ros.lab.scenes.raster import project_panels, Raster, shade, visible
from djet_ros.lab.scenes.texture import Gray
import numpy as np

# Relative tolerance of depth for points on the floor.
_ON_FLOOR = 1e-3


@dataclass(frozen=True)
class Gloss:
    """
    A floor at y = 0 that mirrors what is above it.

    The mirror image is the world upside down, seen through the floor: it moves as what stands
    that far below would, not as the floor does. above: the world without its floor; polish: the
    part of the light that is mirrored straight down; more is towards the horizon (Schlick's
    approximation of Fresnel's equations).
    """

    above: World
    polish: float

    def __call__(self, shot: Shot) -> Gray:
        """Add the mirror image to the visible floor."""
        height = -shot.pose[1, 3]
        down = np.asarray(shot.rays @ shot.pose[1, :3].astype(np.float32), np.float32)
        floor = np.abs(shot.inverse_depth * np.float32(height) - down) < _ON_FLOOR * down
        cosine = down / np.linalg.norm(shot.rays, axis=2)
        share = self.polish + (1 - self.polish) * (1 - np.clip(cosine, 0, 1)) ** 5
        light = np.where(floor, share, 0) * (self._mirrored(shot) - shot.radiance)
        return np.asarray(shot.radiance + light, np.float32)

    def _mirrored(self, shot: Shot) -> Gray:
        """Return the radiance (H, W) of the mirrored world."""
        rows, columns = shot.radiance.shape
        raster = Raster((columns, rows), 1)
        view = project_panels(upside_down(self.above.at(shot.index)), shot.pose, shot.K, raster)
        return shade(view, visible(view, raster)[0], raster, 0.0)


def upside_down(panels: PanelArrays) -> PanelArrays:
    """Mirror panels in the plane y = 0."""
    flip = np.array([1.0, -1.0, 1.0])
    return replace(panels, origin=panels.origin * flip, a=panels.a * flip, b=panels.b * flip)
