"""
Seeing panels through a pinhole camera: exact visibility, then shading.

The inverse depth of a plane, and its panel coordinates times the inverse depth, are affine in the
pixel: with A = [a b o] in camera axes, ``(s, t, 1) / z = (K A)^-1 (u, v, 1)``. So everything below
is one 3x3 matrix per panel, evaluated at the sample positions; nothing is interpolated between
vertices.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from djet_ros.core.types import Array
from djet_ros.lab.scenes.panel import PanelArrays
from djet_ros.lab.scenes.texture import Gray, RipMap
import numpy as np
from numpy.typing import NDArray

_NEAR = 0.1
# Relative advantage in inverse depth of one layer over the one below in the same plane.
_LAYER_STEP = 2e-5
# Panels that share an edge overlap by this part of their size, so that no ray slips through.
_EDGE = 1e-6
# Samples shaded at once: as many as keep the temporaries in the processor's cache.
_CHUNK = 32_000

NOTHING = -1


@dataclass(frozen=True)
class Raster:
    """Sample positions: (width, height) pixels with ``factor`` x ``factor`` samples in each."""

    size: tuple[int, int]
    factor: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of samples."""
        return self.size[1] * self.factor, self.size[0] * self.factor

    def position(self, index: NDArray[np.intp]) -> Gray:
        """Pixel coordinate of sample indices; a pixel's samples lie evenly round its centre."""
        shift = np.float32(0.5 / self.factor - 0.5)
        return np.asarray(index.astype(np.float32) * np.float32(1 / self.factor) + shift)


@dataclass(frozen=True)
class PanelsInView:
    """
    The panels in front of a camera, nearest first.

    to_panel: (N, 3, 3) pixel (u, v, 1) to (s, t, 1) / z; boxes: (N, 4) first and one-past-last
    column and row of the samples that may see the panel; nearest: (N,) largest inverse depth.
    """

    panels: PanelArrays
    index: NDArray[np.intp]
    to_panel: Array
    boxes: NDArray[np.intp]
    nearest: Array


def project_panels(panels: PanelArrays, pose: Array, K: Array, raster: Raster,
                   reach: float = np.inf) -> PanelsInView:
    """
    Project panels into the camera of pose (4, 4), camera to world, and sort them by depth.

    Panels entirely beyond ``reach`` metres are omitted.
    """
    R, c = pose[:3, :3], pose[:3, 3]
    origin, a, b = (panels.origin - c) @ R, panels.a @ R, panels.b @ R
    boxes, nearest = _boxes(_outline(origin, a, b, panels.triangle), K, raster)
    normal = np.cross(a, b)
    volume = (normal * origin).sum(1)
    # A camera in the plane of a panel sees an edge without width.
    visible_panels = np.abs(volume) > 1e-9 * np.linalg.norm(normal, axis=1)
    visible_panels &= (boxes[:, 0] < boxes[:, 1]) & (boxes[:, 2] < boxes[:, 3])
    visible_panels &= nearest > 1 / reach
    index = np.flatnonzero(visible_panels)
    if len(index) > np.iinfo(np.int16).max:
        raise ValueError(f'{len(index)} panels are in view; at most 32767 can be told apart')
    inverse = np.stack([np.cross(b, origin), np.cross(origin, a), normal], axis=1)[index]
    to_panel = inverse / volume[index, None, None] @ np.linalg.inv(K)
    nearest = np.minimum(nearest[index], _corner_maximum(to_panel[:, 2], boxes[index], raster))
    order = np.argsort(-nearest, kind='stable')
    return PanelsInView(panels, index[order], to_panel[order], boxes[index][order], nearest[order])


def _outline(origin: Array, a: Array, b: Array, triangle: NDArray[np.bool_]) -> Array:
    """Corners (N, 4, 3) in order round the panel; a triangle repeats one."""
    far = np.where(triangle[:, None], origin + b, origin + a + b)
    return np.stack([origin, origin + a, far, origin + b], axis=1)


def _boxes(corners: Array, K: Array, raster: Raster) -> tuple[NDArray[np.intp], Array]:
    """Sample boxes (N, 4) and largest inverse depth (N,) of outlines, cut at the near plane."""
    following = np.roll(corners, -1, axis=1)
    z, z_next = corners[..., 2], following[..., 2]
    with np.errstate(divide='ignore', invalid='ignore'):
        part = (_NEAR - z) / (z_next - z)
        crossings = corners + part[..., None] * (following - corners)
    points = np.concatenate([corners, crossings], axis=1)
    valid = np.concatenate([z >= _NEAR, (z < _NEAR) != (z_next < _NEAR)], axis=1)
    points[~valid] = (0.0, 0.0, 1.0)
    pixels = (points @ K.T)[..., :2] / points[..., 2:]
    low = np.where(valid[..., None], pixels, np.inf).min(1)
    high = np.where(valid[..., None], pixels, -np.inf).max(1)
    limit = np.array(raster.size) * raster.factor
    first = np.clip(np.floor((low + 0.5) * raster.factor - 0.5), 0, limit)
    last = np.clip(np.ceil((high + 0.5) * raster.factor + 0.5), 0, limit)
    nearest = np.where(valid, 1 / points[..., 2], 0.0).max(1)
    return np.stack([first[:, 0], last[:, 0], first[:, 1], last[:, 1]], 1).astype(int), nearest


def _corner_maximum(inverse_depth: Array, boxes: NDArray[np.intp], raster: Raster) -> Array:
    """Largest value (N,) that affine functions (N, 3) of the pixel take in sample boxes."""
    bounds = (boxes - (0, 1, 0, 1) + 0.5) / raster.factor - 0.5
    u, v = inverse_depth[:, :1] * bounds[:, :2], inverse_depth[:, 1:2] * bounds[:, 2:]
    return np.asarray(u.max(1) + v.max(1) + inverse_depth[:, 2])


def visible(view: PanelsInView, raster: Raster) -> tuple[NDArray[np.int16], Gray]:
    """Which panel (position in the view, or NOTHING) every sample sees, and its inverse depth."""
    ids = np.full(raster.shape, NOTHING, np.int16)
    closest = np.zeros(raster.shape, np.float32)
    for k, advantage in enumerate(_advantage(view)):
        for box in _bands(view.boxes[k]):
            if view.nearest[k] * advantage > closest[box].min():
                depth, inside = _cover(view, k, raster, box, closest[box], advantage)
                np.copyto(closest[box], depth, where=inside)
                np.copyto(ids[box], np.int16(k), where=inside)
    return ids, closest / np.append(_advantage(view), np.float32(1))[ids]


def _advantage(view: PanelsInView) -> Gray:
    """Factors (N,) by which layers seem nearer than the plane they lie in."""
    return np.asarray(1 + _LAYER_STEP * view.panels.layer[view.index], np.float32)


def _bands(box: NDArray[np.intp]) -> Iterator[tuple[slice, slice]]:
    """Cut a sample box into bands of rows that fit into the processor's cache."""
    left, right, top, bottom = box
    height = max(1, _CHUNK // (right - left))
    for first in range(top, bottom, height):
        yield slice(first, min(first + height, bottom)), slice(left, right)


def _cover(view: PanelsInView, k: int, raster: Raster, box: tuple[slice, slice], closest: Gray,
           advantage: np.float32) -> tuple[Gray, NDArray[np.bool_]]:
    """Inverse depth of panel k over a box, and where it hides what is there already."""
    top, left = box[0].start, box[1].start
    u = raster.position(np.arange(left, box[1].stop))[None]
    v = raster.position(np.arange(top, box[0].stop))[:, None]
    sw, tw, w = ((row[0] * u).astype(np.float32) + (row[1] * v + row[2]).astype(np.float32)
                 for row in view.to_panel[k])
    slack = w * np.float32(_EDGE)
    biased = w * advantage
    inside = (biased > closest) & (sw >= -slack) & (tw >= -slack)
    limit = w + slack
    if view.panels.triangle[view.index[k]]:
        inside &= sw + tw <= limit
    else:
        inside &= (sw <= limit) & (tw <= limit)
    texture = view.panels.textures[view.index[k]]
    if texture.opacity is not None and inside.any():
        rows, columns = np.nonzero(inside)
        # An outline is sharp on any level.
        open_ = _look_up(view, k, raster, rows + top, columns + left, texture.opacity,
                         blend=False) <= 127.5
        inside[rows[open_], columns[open_]] = False
    return biased, inside


def shade(view: PanelsInView, ids: NDArray[np.int16], raster: Raster, background: float) -> Gray:
    """Brightness of the panel that each sample sees."""
    radiance = np.full(raster.shape, background, np.float32)
    flat = ids.ravel()
    order = np.argsort(flat, kind='stable')
    bounds = np.searchsorted(flat[order], np.arange(len(view.index) + 1))
    for k, panel in enumerate(view.index):
        ripmap, gain = view.panels.textures[panel].brightness, float(view.panels.gain[panel])
        for start in range(bounds[k], bounds[k + 1], _CHUNK):
            samples = order[start:min(start + _CHUNK, bounds[k + 1])]
            rows, columns = np.divmod(samples, raster.shape[1])
            value = _look_up(view, k, raster, rows, columns, ripmap, blend=True)
            radiance.ravel()[samples] = gain * value
    return radiance


def _look_up(view: PanelsInView, k: int, raster: Raster, rows: NDArray[np.intp],
             columns: NDArray[np.intp], ripmap: RipMap, blend: bool) -> Gray:
    """
    Values (N,) of panel k at samples, filtered for the distance between samples.

    blend: between the two nearest levels; without, it takes a quarter of the time.
    """
    to_texture = (view.panels.uv[view.index[k]] @ view.to_panel[k]).astype(np.float32)
    u, v = raster.position(columns), raster.position(rows)
    across, down, w = (row[0] * u + row[1] * v + row[2] for row in to_texture)
    z = 1 / w
    across *= z
    down *= z
    height, width = ripmap.shape
    levels = [_level(row, to_texture[2], value, z, texels / raster.factor)
              for row, value, texels in zip(to_texture, (across, down), (width, height))]
    if not blend:
        levels = [np.rint(level) for level in levels]
    return ripmap.sample(across, down, *levels)


def _level(row: Gray, last: Gray, value: Gray, z: Gray, texels: float) -> Gray:
    """Binary logarithm of the texels that one coordinate moves by between samples."""
    along_u = (row[0] - last[0] * value) * z
    along_v = (row[1] - last[1] * value) * z
    speed = along_u * along_u + along_v * along_v
    return np.asarray(0.5 * np.log2(speed * np.float32(texels ** 2) + np.float32(1e-12)))


def reduce(radiance: Gray, factor: int) -> Gray:
    """Average samples to pixels with a filter a little wider than the pixel, as a lens has."""
    if factor == 1:
        return radiance
    if factor != 2:
        raise ValueError(f'supersampling factor is {factor}; it must be 1 or 2')
    rows = np.pad(radiance, 1, mode='edge')
    rows = rows[0:-2:2] + rows[3::2] + 3 * (rows[1:-1:2] + rows[2::2])
    columns = rows[:, 0:-2:2] + rows[:, 3::2] + 3 * (rows[:, 1:-1:2] + rows[:, 2::2])
    return np.asarray(columns / 64, np.float32)
