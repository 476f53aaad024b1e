"""A dim sea floor: uneven sand with ripples, pebbles and boulders, along a route."""

from __future__ import annotations

from functools import cache

import cv2
from djet_ros.core.geometry import rotation_exp, unit
from djet_ros.core.types import Array
from djet_ros.lab.scenes.panel import draped, Panel, placed, tiled
from djet_ros.lab.scenes.route import level_pose, Route
from djet_ros.lab.scenes.texture import fractal, make_texture, soft, Texture
import numpy as np

_CELL = 0.8
# How far from the route the floor goes on: farther than one sees.
_MARGIN = 20.0
_BOULDERS_PER_CELL = 0.22


def seafloor(route: Route, rng: np.random.Generator) -> tuple[Panel, ...]:
    """Panels of the floor along the whole route."""
    corners = _relief(route, rng)
    rows, columns = corners.shape[0] - 1, corners.shape[1] - 1
    distance = route.distance(corners[:-1, :-1, ::2].reshape(-1, 2)).reshape(rows, columns)
    sand, rocks = _sand(rng), [_rock(rng) for _ in range(2)]
    panels = []
    for row, column in np.argwhere(distance < _MARGIN):
        a, b = corners[row, column], corners[row + 1, column + 1]
        for c in (corners[row, column + 1], corners[row + 1, column]):
            panels.append(draped(c, a - c, b - c, sand))
    boulder = rng.random(distance.shape) < _BOULDERS_PER_CELL
    for row, column in np.argwhere((distance < _MARGIN) & boulder):
        # Low rocks below the vehicle, high ones aside.
        size = min(0.35 * rng.pareto(1.2) + 0.2, 0.5 + 0.4 * distance[row, column], 2.0)
        panels += _boulder(rng, rocks[int(rng.integers(2))], corners[row, column], size)
    return tuple(panels)


def _relief(route: Route, rng: np.random.Generator) -> Array:
    """Corners (rows, columns, 3) of the cells of uneven ground round the route."""
    low = np.floor((route.points.min(0) - _MARGIN) / _CELL).astype(int)
    high = np.ceil((route.points.max(0) + _MARGIN) / _CELL).astype(int)
    x, z = (np.arange(first, last + 1) * _CELL for first, last in zip(low, high))
    size = 1 << max(len(x), len(z)).bit_length()
    hills = 0.35 * fractal(rng, (size, size), 1.5, coarsest=1 / 30)
    return np.stack(np.broadcast_arrays(x, hills[:len(z), :len(x)], z[:, None]), axis=-1)


def _sand(rng: np.random.Generator) -> Texture:
    """Sand with ripples that come and go, and a few pebbles and shells."""
    shape, metres = (1024, 1024), (8.0, 8.0)
    y = np.linspace(0, 2 * np.pi, shape[0], endpoint=False)[:, None]
    phase = 45 * y + 9 * fractal(rng, shape, 2.0)
    ripples = np.sin(phase) * np.clip(0.4 + fractal(rng, shape, 1.7), 0, 1.4)
    image = 128 + 10 * ripples + 9 * fractal(rng, shape, 1.3) + 13 * fractal(rng, shape, 0.4)
    image = np.asarray(image, np.float32)
    for x, z in rng.uniform(0, shape[0], (1500, 2)):
        axes = (int(rng.integers(1, 5)), int(rng.integers(1, 4)))
        cv2.ellipse(image, (int(x), int(z)), axes, float(rng.uniform(0, 180)), 0, 360,
                    float(rng.choice([55.0, 90.0, 185.0, 215.0])), -1)
    return make_texture(soft(image), metres)


def _rock(rng: np.random.Generator) -> Texture:
    """Overgrown stone."""
    shape = (512, 512)
    image = 92 + 19 * fractal(rng, shape, 1.4) + 20 * fractal(rng, shape, 0.6)
    return make_texture(image, (3.0, 3.0))


def _boulder(rng: np.random.Generator, texture: Texture,
             place: Array, size: float) -> list[Panel]:
    """Icosahedron with every corner pulled in or out, half sunk into the floor."""
    corners, faces = _icosahedron()
    corners = corners * rng.uniform(0.75, 1.2, (12, 1)) * size * (1.2, 0.8, 1.0)
    pose = level_pose(place[0], place[2], rng.uniform(0, 6), -place[1])
    pose[:3, :3] = pose[:3, :3] @ rotation_exp(rng.normal(0, 0.4, 3))
    start = (rng.uniform(0, 3), rng.uniform(0, 3))
    p, q, r = corners[faces].transpose(1, 0, 2)
    gains = 0.85 + 0.3 * np.abs(unit(np.cross(q - p, r - p)) @ (0.3, -0.9, -0.3))
    return placed([tiled(origin, a, b, texture, start=start, gain=gain, triangle=True)
                   for origin, a, b, gain in zip(p, q - p, r - p, gains)], pose)


@cache
def _icosahedron() -> tuple[Array, Array]:
    """Corners (12, 3) on the unit sphere and faces (20, 3)."""
    golden = (1 + 5 ** 0.5) / 2
    plane = np.array([(0, y, z * golden) for y in (-1, 1) for z in (-1, 1)], float)
    corners = unit(np.concatenate([plane, plane[:, [1, 2, 0]], plane[:, [2, 0, 1]]]))
    near = np.linalg.norm(corners[:, None] - corners[None], axis=2) < 1.1
    faces = [(i, j, k) for i in range(12) for j in range(i + 1, 12) for k in range(j + 1, 12)
             if near[i, j] and near[j, k] and near[i, k]]
    return corners, np.array(faces)
