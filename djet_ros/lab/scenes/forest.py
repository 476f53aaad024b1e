"""A path through a forest: uneven ground under leaves, trunks, shrubs, grass and a canopy."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
from djet_ros.core.geometry import rotation_exp
from djet_ros.core.types import Array
from djet_ros.lab.scenes.panel import draped, fitted, Panel, placed, tiled
from djet_ros.lab.scenes.route import level_pose, Route
from djet_ros.lab.scenes.texture import fractal, Gray, make_texture, one_of, soft, Texture
import numpy as np

_CELL = 1.5
# How far from the path trees stand, and beyond which distance there are none.
_NEAREST, _MARGIN = 1.3, 25.0
_TREES, _TUFTS, _SHRUBS = 0.055, 0.8, 0.035
# Shrubs and grass are drawn this far from the path.
_LOW_MARGIN = 13.0


@dataclass(frozen=True)
class _Palette:
    """The textures of a wood."""

    litter: Texture
    barks: list[Texture]
    leaves: list[Texture]
    tufts: list[Texture]
    shrubs: list[Texture]
    backdrop: Texture


def forest(route: Route, rng: np.random.Generator) -> tuple[Panel, ...]:
    """Panels of the wood along the whole route."""
    palette = _Palette(_litter(rng), [_bark(rng) for _ in range(3)],
                       [_foliage(rng, 0.42) for _ in range(3)], [_tuft(rng) for _ in range(3)],
                       [_foliage(rng, 0.62) for _ in range(2)], _backdrop(rng))
    ground = _Ground.along(route, rng)
    return (*ground.panels(route, palette.litter), *_trees(route, ground, palette, rng),
            *_undergrowth(route, ground, palette, rng), *_surroundings(route, palette))


@dataclass(frozen=True)
class _Ground:
    """Heights y (rows, columns) of the corners of square cells, and the first corner (x, z)."""

    corner: Array
    heights: Array

    @classmethod
    def along(cls, route: Route, rng: np.random.Generator) -> _Ground:
        """Uneven ground round a route, which itself is nearly even."""
        low = np.floor((route.points.min(0) - _MARGIN - 3) / _CELL)
        high = np.ceil((route.points.max(0) + _MARGIN + 3) / _CELL)
        columns, rows = (high - low).astype(int) + 1
        side = 1 << int(max(rows, columns)).bit_length()
        hills = fractal(rng, (side, side), 1.6, coarsest=1 / 24)[:rows, :columns].astype(float)
        z, x = np.mgrid[:rows, :columns] * _CELL
        places = np.stack([x + low[0] * _CELL, z + low[1] * _CELL], axis=-1).reshape(-1, 2)
        distance = route.distance(places).reshape(rows, columns)
        return cls(low * _CELL, -hills * (0.06 + 0.5 * np.clip(distance / 12, 0, 1)))

    def at(self, x: float, z: float) -> float:
        """Height y at a place, between the corners of its cell."""
        column, row = ((x, z) - self.corner) / _CELL
        i, j = int(row), int(column)
        v, u = row - i, column - j
        near, far = self.heights[i, j:j + 2], self.heights[i + 1, j:j + 2]
        # The cell is two triangles, split along the diagonal from its near right corner.
        if u + v <= 1:
            return float(near[0] + u * (near[1] - near[0]) + v * (far[0] - near[0]))
        return float(far[1] + (1 - u) * (far[0] - far[1]) + (1 - v) * (near[1] - far[1]))

    def panels(self, route: Route, texture: Texture) -> list[Panel]:
        """Two triangles for each cell that is not too far from the route."""
        rows, columns = self.heights.shape
        z, x = np.mgrid[:rows, :columns] * _CELL
        corners = np.stack([x + self.corner[0], self.heights, z + self.corner[1]], axis=-1)
        middles = corners[:-1, :-1, ::2].reshape(-1, 2) + _CELL / 2
        close = (route.distance(middles) < _MARGIN).reshape(rows - 1, columns - 1)
        panels = []
        for i, j in np.argwhere(close):
            right, far = corners[i, j + 1], corners[i + 1, j]
            panels += [draped(corner, a - corner, b - corner, texture) for corner, a, b in (
                (corners[i, j], right, far), (corners[i + 1, j + 1], far, right))]
        return panels


def _trees(route: Route, ground: _Ground, palette: _Palette,
           rng: np.random.Generator) -> list[Panel]:
    """Trunks with some twigs low down, and crowns above them."""
    panels = []
    for x, z in _places(route, rng, _TREES, _NEAREST, _MARGIN):
        radius, height = rng.uniform((0.08, 12), (0.26, 17))
        lean = rotation_exp(rng.normal(0, 0.05, 3) * (1, 0, 1))
        pose = level_pose(x, z, rng.uniform(0, 6), -ground.at(x, z) - 0.1)
        pose[:3, :3] = pose[:3, :3] @ lean
        bark = one_of(palette.barks, rng)
        tree = _trunk(radius, height, bark, rng.uniform(0.6, 1.2))
        for _ in range(6):
            tree += _spray(rng, palette, height * rng.uniform(0.2, 0.95), rng.uniform(1.8, 4.2))
        panels += placed(tree, pose)
    return panels


def _trunk(radius: float, height: float, bark: Texture, gain: float) -> list[Panel]:
    """Prism of seven sides, a little darker on one side."""
    angles = np.arange(8) * 2 * np.pi / 7
    foot = radius * np.stack([np.cos(angles), np.zeros(8), np.sin(angles)], axis=1)
    top = (0, -height, 0)
    return [tiled(foot[k] + top, foot[k + 1] - foot[k], (0, height, 0), bark,
                  start=(k * 2 * radius * np.sin(np.pi / 7), 0),
                  gain=gain * (0.85 + 0.25 * np.cos(angles[k]))) for k in range(7)]


def _spray(rng: np.random.Generator, palette: _Palette, height: float,
           size: float) -> list[Panel]:
    """Twigs with leaves: one picture of them at some height and slant."""
    pose = level_pose(0, 0, rng.uniform(0, 6), height)
    pose[:3, :3] = pose[:3, :3] @ rotation_exp(np.array([rng.uniform(-1.2, 1.2), 0, 0]))
    leaves = one_of(palette.leaves, rng)
    return placed([fitted((-size / 2, -size / 2, 0), (size, 0, 0), (0, size, 0), leaves,
                          gain=rng.uniform(0.7, 1.4), mirror=bool(rng.integers(2)))], pose)


def _undergrowth(route: Route, ground: _Ground, palette: _Palette,
                 rng: np.random.Generator) -> list[Panel]:
    """Tufts of grass and shrubs, each two or three pictures that cross."""
    panels = []
    for textures, density, near, (least, most) in (
            (palette.tufts, _TUFTS, 0.45, (0.15, 0.45)),
            (palette.shrubs, _SHRUBS, 1.5, (0.7, 1.6))):
        for x, z in _places(route, rng, density, near, _LOW_MARGIN):
            size, turn = rng.uniform(least, most), rng.uniform(0, np.pi)
            texture = one_of(textures, rng)
            foot = np.array([x, ground.at(x, z) + 0.06 * size, z])
            for angle in (turn, turn + np.pi / 2):
                horizontal = size * np.array([np.cos(angle), 0, np.sin(angle)])
                panels.append(fitted(foot - horizontal / 2 - (0, size, 0), horizontal,
                                     (0, size, 0), texture, gain=rng.uniform(0.7, 1.25)))
    return panels


def _surroundings(route: Route, palette: _Palette) -> list[Panel]:
    """Blurred wood on the four sides that closes the view."""
    (x0, z0), (x1, z1) = (route.points.min(0) - _MARGIN - 6, route.points.max(0) + _MARGIN + 6)
    corners = [(x0, z0), (x1, z0), (x1, z1), (x0, z1)]
    return [tiled((x, -16, z), (x_next - x, 0, z_next - z), (0, 18, 0), palette.backdrop)
            for (x, z), (x_next, z_next) in zip(corners, corners[1:] + corners[:1])]


def _places(route: Route, rng: np.random.Generator, density: float, near: float,
            far: float) -> Array:
    """Places (N, 2), so many per square metre, between two distances from the route."""
    low, high = route.points.min(0) - far, route.points.max(0) + far
    count = int(density * np.prod(high - low))
    places = rng.uniform(low, high, (count, 2))
    distance = route.distance(places)
    return np.asarray(places[(distance > near) & (distance < far)])


def _litter(rng: np.random.Generator) -> Texture:
    """Fallen leaves, moss and earth: weak noise at every scale, and leaves like one another."""
    shape, metres = (2048, 2048), (7.0, 7.0)
    image = 92 + 7 * fractal(rng, shape, 0.35) + 8 * fractal(rng, shape, 0.9)
    image = np.asarray(image + 12 * fractal(rng, shape, 1.5), np.float32)
    for (x, y), tone in zip(rng.uniform(0, 2048, (14_000, 2)), rng.normal(0, 13, 14_000)):
        axes = (int(rng.integers(3, 11)), int(rng.integers(2, 6)))
        cv2.ellipse(image, (int(x), int(y)), axes, float(rng.uniform(0, 180)), 0, 360,
                    float(image[int(y), int(x)] + tone), -1)
    # Light that comes through the canopy in patches.
    image *= 1 + 0.25 * np.clip(2 * fractal(rng, shape, 1.5) - 0.8, 0, 1)
    return make_texture(soft(image), metres)


def _bark(rng: np.random.Generator) -> Texture:
    """Furrows along the trunk, and lichen."""
    furrows = cv2.resize(fractal(rng, (64, 256), 0.8), (256, 512), interpolation=cv2.INTER_CUBIC)
    image = 68 + 15 * furrows + 8 * fractal(rng, (512, 256), 0.6)
    image += 26 * np.clip(fractal(rng, (512, 256), 1.4) - 0.9, 0, 1)
    return make_texture(np.asarray(image, np.float32), (0.9, 2.2))


def _foliage(rng: np.random.Generator, density: float) -> Texture:
    """Cloud of small leaves, dense in its middle, open between."""
    shape = (512, 512)
    image = np.full(shape, 70, np.float32)
    solid = np.zeros(shape, np.float32)
    clouds = fractal(rng, shape, 1.3)
    y, x = np.mgrid[-1:1:512j, -1:1:512j]
    likely = np.clip(density + 0.35 * clouds - 1.1 * (x ** 2 + y ** 2) ** 1.5, 0, 1)
    places = rng.uniform(4, 508, (9000, 2))
    rows, columns = places[:, 1].astype(int), places[:, 0].astype(int)
    kept = rng.random(len(places)) < likely[rows, columns]
    _draw(image, solid, rng, places[kept], 88)
    return make_texture(soft(image), (2.0, 2.0), soft(solid))


def _draw(image: Gray, solid: Gray, rng: np.random.Generator, places: Array,
          tone: float) -> None:
    """Draw leaves at places (N, 2), the later over the earlier and lighter than they."""
    tones = rng.normal(tone, 15, len(places)) + np.linspace(-22, 22, len(places))
    for (x, y), value in zip(places, tones):
        axes = (int(rng.integers(4, 10)), int(rng.integers(2, 5)))
        angle = float(rng.uniform(0, 180))
        for target, ink in ((image, float(value)), (solid, 255.0)):
            cv2.ellipse(target, (int(x), int(y)), axes, angle, 0, 360, ink, -1)


def _tuft(rng: np.random.Generator) -> Texture:
    """Blades of grass that rise from one foot."""
    image = np.full((256, 256), 85, np.float32)
    solid = np.zeros((256, 256), np.float32)
    for tone in rng.normal(105, 17, 60):
        foot, tip = rng.normal(128, 16), rng.uniform(15, 241)
        top = rng.uniform(15, 170)
        t = np.linspace(0, 1, 9)
        blade = np.stack([foot + (tip - foot) * t ** 1.8, 255 + (top - 255) * t], axis=1)
        for target, ink in ((image, float(tone)), (solid, 255.0)):
            cv2.polylines(target, [blade.astype(np.int32)], False, ink, int(rng.integers(2, 5)))
    return make_texture(soft(image), (0.4, 0.4), soft(solid))


def _backdrop(rng: np.random.Generator) -> Texture:
    """Far trunks and leaves, out of which the sky shines."""
    shape = (512, 1024)
    image = 88 + 16 * fractal(rng, shape, 1.0) + 14 * fractal(rng, shape, 1.7)
    for x, width in zip(rng.integers(0, 1000, 70), rng.integers(2, 9, 70)):
        image[100:, x:x + width] -= 28
    image += 60 * np.clip(np.linspace(1.2, -1.2, 512)[:, None] + fractal(rng, shape, 0.8), 0, 1)
    return make_texture(soft(image), (40.0, 18.0))
