"""Boxes of panels: the shape of furniture, frames, rails and most other things indoors."""

from __future__ import annotations

from djet_ros.core.types import Array
from djet_ros.lab.scenes.panel import Panel, tiled, Vector
from djet_ros.lab.scenes.texture import Texture
import numpy as np

# How bright the faces of a box are that look right, left, up, down, forward and back.
_SHADES = (0.78, 0.86, 1.1, 0.5, 0.7, 1.0)


def cuboid(low: Vector, high: Vector, texture: Texture, *, gain: float = 1.0,
           start: tuple[float, float] = (0.0, 0.0), lids: Texture | None = None) -> list[Panel]:
    """
    Six faces of the box between two corners (3,), the texture tiled over each.

    lids: another texture for the faces that look up and down; start: offset of it all in metres.
    """
    corner, extent = np.asarray(low, float), np.asarray(high, float) - np.asarray(low, float)
    x, y, z = np.diag(extent)
    lids = texture if lids is None else lids
    faces: list[tuple[Array, Array, Array, Texture]] = [
        (corner + x, z, y, texture), (corner, z, y, texture), (corner, x, z, lids),
        (corner + y, x, z, lids), (corner + z, x, y, texture), (corner, x, y, texture)]
    return [tiled(origin, a, b, paint, gain=gain * shade, start=start)
            for (origin, a, b, paint), shade in zip(faces, _SHADES)]


def frame(low: Vector, high: Vector, bar: float, texture: Texture, *,
          gain: float = 1.0) -> list[Panel]:
    """Four bars, ``bar`` metres wide, round the opening between two corners (3,) in x and y."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    bars = [((x0 - bar, y0 - bar), (x1 + bar, y0)), ((x0 - bar, y1), (x1 + bar, y1 + bar)),
            ((x0 - bar, y0), (x0, y1)), ((x1, y0), (x1 + bar, y1))]
    return [panel for (left, top), (right, bottom) in bars
            for panel in cuboid((left, top, z0), (right, bottom, z1), texture, gain=gain)]
