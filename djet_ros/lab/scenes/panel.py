"""
Textured planar panels, the only thing a world is made of.

World axes are level: x right, y down (the ground at y = 0), z forward, in metres.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

from djet_ros.core.types import Array
from djet_ros.lab.scenes.texture import Texture
import numpy as np
from numpy.typing import NDArray

Vector = Sequence[float] | Array


@dataclass(frozen=True)
class Panel:
    """
    A parallelogram ``origin + s a + t b`` with s, t in [0, 1], or its lower triangle s + t <= 1.

    uv: (3, 2) texture position in periods of the origin and its change along a and along b;
    gain multiplies the texture's brightness; of panels in one plane that of higher layer is seen.
    """

    origin: Array
    a: Array
    b: Array
    texture: Texture
    uv: Array
    gain: float = 1.0
    layer: int = 0
    triangle: bool = False


def fitted(origin: Vector, a: Vector, b: Vector, texture: Texture, *, gain: float = 1.0,
           layer: int = 0, mirror: bool = False) -> Panel:
    """Panel that shows one whole period of the texture, stretched to its size."""
    along = -1.0 if mirror else 1.0
    uv = np.array([[float(mirror), 0.0], [along, 0.0], [0.0, 1.0]])
    return Panel(np.asarray(origin, float), np.asarray(a, float), np.asarray(b, float), texture,
                 uv, gain, layer)


def tiled(origin: Vector, a: Vector, b: Vector, texture: Texture, *,
          start: tuple[float, float] = (0.0, 0.0), gain: float = 1.0, layer: int = 0,
          triangle: bool = False) -> Panel:
    """Panel that shows the texture at its own size, repeated; start: offset in metres."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    width, height = texture.metres
    uv = np.array([[start[0] / width, start[1] / height],
                   [np.linalg.norm(a) / width, 0.0],
                   [0.0, np.linalg.norm(b) / height]])
    return Panel(np.asarray(origin, float), a, b, texture, uv, gain, layer, triangle)


def draped(origin: Array, a: Array, b: Array, texture: Texture) -> Panel:
    """Triangle whose texture is laid over it from above, so that neighbours join."""
    uv = np.stack([origin, a, b])[:, ::2] / texture.metres
    uv[0] %= 1
    return Panel(origin, a, b, texture, uv, triangle=True)


def placed(panels: Iterable[Panel], pose: Array) -> list[Panel]:
    """Carry panels by a (4, 4) pose."""
    R, t = pose[:3, :3], pose[:3, 3]
    return [replace(p, origin=R @ p.origin + t, a=R @ p.a, b=R @ p.b) for p in panels]


@dataclass(frozen=True)
class PanelArrays:
    """Panels column by column: corners (N, 3) each, texture maps (N, 3, 3), and the rest (N,)."""

    origin: Array
    a: Array
    b: Array
    uv: Array
    gain: Array
    layer: Array
    triangle: NDArray[np.bool_]
    textures: tuple[Texture, ...]

    @classmethod
    def of(cls, panels: Sequence[Panel]) -> PanelArrays:
        """Stack panels."""
        uv = np.zeros((len(panels), 3, 3))
        uv[:, 2, 2] = 1.0
        uv[:, :2] = np.array([p.uv for p in panels])[:, [1, 2, 0]].transpose(0, 2, 1)
        return cls(origin=np.array([p.origin for p in panels]), a=np.array([p.a for p in panels]),
                   b=np.array([p.b for p in panels]), uv=uv,
                   gain=np.array([p.gain for p in panels]),
                   layer=np.array([float(p.layer) for p in panels]),
                   triangle=np.array([p.triangle for p in panels]),
                   textures=tuple(p.texture for p in panels))

    def joined(self, other: PanelArrays) -> PanelArrays:
        """Put the panels of another set after these."""
        columns = {f.name: np.concatenate([getattr(self, f.name), getattr(other, f.name)])
                   for f in fields(self) if f.name != 'textures'}
        return PanelArrays(**columns, textures=self.textures + other.textures)


@dataclass(frozen=True)
class Mover:
    """A rigid body of panels in its own axes, and its pose (4, 4) in the world frame by frame."""

    panels: tuple[Panel, ...]
    pose: Callable[[int], Array]


@dataclass(frozen=True)
class World:
    """What stands still and what moves."""

    panels: tuple[Panel, ...]
    movers: tuple[Mover, ...] = ()

    @cached_property
    def _still(self) -> PanelArrays:
        return PanelArrays.of(self.panels)

    def at(self, index: int) -> PanelArrays:
        """All panels at a frame index."""
        arrays = self._still
        for mover in self.movers:
            arrays = arrays.joined(PanelArrays.of(placed(mover.panels, mover.pose(index))))
        return arrays
