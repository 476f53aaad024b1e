"""A street along a route: ground, road, houses, trees, hedges, parked cars, lamps and sky."""

from __future__ import annotations

from collections.abc import Callable

from djet_ros.core.types import Array
from djet_ros.lab.scenes import street_objects as things, street_textures as paint
from djet_ros.lab.scenes.panel import Panel, placed, tiled
from djet_ros.lab.scenes.route import level_pose, Route
from djet_ros.lab.scenes.texture import Texture
import numpy as np

# How near a house may come to the middle of the road.
_CLEARANCE = 7.3


def street(route: Route, palette: things.Palette,
           rng: np.random.Generator) -> tuple[Panel, ...]:
    """Panels of a street along the whole route; trees and cars only where it is varied."""
    panels = [*country(route, palette, 4), *_horizon(route, palette), *_surface(route, palette)]
    for side in (-1, 1):
        panels += _houses(route, rng, palette, side)
        panels += along(route, side, _gaps(rng, 28, 28), 5.4, lambda: things.lamp(palette))
        if not palette.varied:
            panels += along(route, side, _gaps(rng, 6, 6), 7.3, lambda: things.fence(palette))
            continue
        panels += along(route, side, _gaps(rng, 6, 6), 7.3, lambda: things.border(rng, palette))
        panels += along(route, side, _gaps(rng, 7, 15), 6.1, lambda: things.tree(rng, palette))
        panels += along(route, side, _gaps(rng, 5.2, 16), 4.05,
                        lambda: things.car(rng, palette))
    return tuple(panels)


def _gaps(rng: np.random.Generator, least: float, most: float) -> Array:
    """More distances between things, in metres, than the longest street needs."""
    return rng.uniform(least, most, 1000)


def country(route: Route, palette: things.Palette, reach: int) -> list[Panel]:
    """Ground in squares of 64 m, ``reach`` of them to each side of the route, and a sky."""
    size = 64.0
    cells = np.unique(np.round(route.points[::100] / size).astype(int), axis=0)
    steps = np.arange(-reach, reach + 1)
    around = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    cells = np.unique((cells[:, None] + around).reshape(-1, 2), axis=0)
    panels = [tiled((x * size, 0, z * size), (size, 0, 0), (0, 0, size), palette.ground)
              for x, z in cells]
    low, high = route.points.min(0), route.points.max(0)
    corner, extent = low - 6000, high - low + 12000
    panels.append(tiled((corner[0], -500, corner[1]), (extent[0], 0, 0), (0, 0, extent[1]),
                        palette.sky))
    return panels


def _horizon(route: Route, palette: things.Palette) -> list[Panel]:
    """Rows of trees 70 m around the route, which close the view."""
    low, high = route.points.min(0) - 70, route.points.max(0) + 70
    (x0, z0), (x1, z1) = low, high
    corners = [(x0, z0), (x1, z0), (x1, z1), (x0, z1)]
    return [tiled((x, -14, z), (x_next - x, 0, z_next - z), (0, 14, 0), palette.treeline)
            for (x, z), (x_next, z_next) in zip(corners, corners[1:] + corners[:1])]


def _surface(route: Route, palette: things.Palette) -> list[Panel]:
    """Road in straight pieces, short where it turns; overlaps are settled by layers."""
    panels = []
    s, piece = 0.0, 0
    while s < route.length - 0.5:
        curvature = abs(route.curvature[int(s / route.length * len(route.curvature))])
        length = min(1.0 if curvature > 0.02 else 4.0, route.length - s)
        panels.append(strip(route, s, length, 1 + 0.4 * curvature * paint.ROAD_WIDTH,
                            palette.roads[int(s / 24) % len(palette.roads)], 1 + piece % 5))
        s, piece = s + length, piece + 1
    return panels


def strip(route: Route, s: float, length: float, stretch: float, texture: Texture,
          layer: int) -> Panel:
    """Straight piece of a road as wide as its texture, from arc length s; it may overlap."""
    points, _ = route.at(np.array([s, s + length]))
    along = points[1] - points[0]
    along *= stretch
    right = np.array([along[1], -along[0]]) / np.linalg.norm(along) * texture.metres[0]
    corner = points[0] - right / 2
    return tiled((corner[0], 0, corner[1]), (right[0], 0, right[1]), (along[0], 0, along[1]),
                 texture, start=(0.0, s), layer=layer)


def along(route: Route, side: int, gaps: Array, offset: float,
          make: Callable[[], list[Panel]]) -> list[Panel]:
    """Things on one side of the route, ``gaps`` (N,) apart, where they keep clear of all of it."""
    stations = np.cumsum(gaps)
    points, headings = route.at(stations[stations < route.length], side * offset)
    clear = route.distance(points) > offset - 0.4
    return [panel for point, heading in zip(points[clear], headings[clear])
            for panel in placed(make(), level_pose(point[0], point[1], heading))]


def _houses(route: Route, rng: np.random.Generator, palette: things.Palette,
            side: int) -> list[Panel]:
    """Rows of houses that look at the street and do not stand in one another or on the road."""
    panels: list[Panel] = []
    occupied = np.full((1, 2), np.inf)
    s = 0.0
    while s < route.length:
        width, gap, front = (rng.uniform((9, 0.6, 8.8), (15, 6, 11.5)) if palette.varied
                             else (12, 0, 9.5))
        point, heading = route.at(np.array(s + width / 2), side * front)
        pose = level_pose(point[0], point[1], float(heading) + side * np.pi / 2)
        corners = (_footprint(width) @ pose.T)[:, ::2]
        centre = corners.mean(0)
        free = (np.linalg.norm(occupied - centre, axis=1).min() > 0.8 * width
                and route.distance(corners).min() > _CLEARANCE)
        if free:
            panels += placed(things.house(rng, palette, width), pose)
            occupied = np.concatenate([occupied, centre[None]])
        s += width + gap if free else 3.0
    return panels


def _footprint(width: float) -> Array:
    """Points (6, 4) round a house, homogeneous, in its own axes."""
    return np.array([(x, 0, z, 1) for x in (-width / 2, 0, width / 2)
                     for z in (0, things.HOUSE_DEPTH)])
