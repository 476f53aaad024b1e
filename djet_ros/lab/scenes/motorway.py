"""A motorway: wide lanes, guard rails, open country, and traffic at the speed of the camera."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from djet_ros.core.types import Array
from djet_ros.lab.scenes import street_objects as things, street_textures as paint
from djet_ros.lab.scenes.panel import fitted, Mover, Panel, placed, tiled
from djet_ros.lab.scenes.route import level_pose, Route
from djet_ros.lab.scenes.street import along, country, strip
from djet_ros.lab.scenes.texture import fractal, make_texture, soft, Texture
import numpy as np

# Middles of lanes in metres to the right of the central reservation: that of the camera, that of
# the lorries that it overtakes, and that of oncoming traffic.
OWN_LANE = 5.0
_SLOW_LANE, _ONCOMING_LANE = 8.75, -5.0

# Metres of guard rails from the middle, and of the length of a straight piece of road.
_RAILS = (1.6, 12.5)
_PIECE = 8.0


def motorway(route: Route, rng: np.random.Generator) -> tuple[Panel, ...]:
    """Panels of a motorway along the whole route."""
    palette = things.make_palette(rng, True)
    asphalt, rail, sign = _asphalt(rng), _rail(rng), paint.lettering(rng, 3)
    panels = [*country(route, palette, 3), *_roadway(route, asphalt)]
    for side in (-1, 1):
        for offset in _RAILS:
            panels += along(route, side, np.full(2000, 4.0), offset, lambda: [
                tiled((0, -0.8, -2), (0, 0, 4), (0, 0.8, 0), rail)])
        panels += along(route, side, rng.uniform(25, 90, 200), 30.0,
                        partial(_copse, palette, rng))
        panels += along(route, side, rng.uniform(60, 61, 200), 75.0, lambda: [
            tiled((0, -12, -30), (0, 0, 60), (0, 12, 0), palette.treeline)])
        panels += along(route, side, rng.uniform(150, 300, 40), 14.0,
                        partial(_signpost, sign, palette.metal))
    return tuple(panels)


def _roadway(route: Route, asphalt: Texture) -> list[Panel]:
    """Both carriageways in straight pieces."""
    return [strip(route, s, _PIECE, 1.02, asphalt, 1 + number % 5)
            for number, s in enumerate(np.arange(0, route.length - _PIECE, _PIECE).tolist())]


def _copse(palette: things.Palette, rng: np.random.Generator) -> list[Panel]:
    """Three trees close together."""
    return [panel for x, z in rng.normal(0, 5, (3, 2))
            for panel in placed(things.tree(rng, palette), level_pose(x, z, 0.0))]


def _signpost(sign: Texture, metal: Texture) -> list[Panel]:
    """Board on two posts."""
    return [fitted((-1.8, -4.5, 0), (3.6, 0, 0), (0, 2.6, 0), sign),
            *(tiled((x, -1.9, 0.05), (0.15, 0, 0), (0, 1.9, 0), metal) for x in (-1.2, 1.05))]


def _asphalt(rng: np.random.Generator) -> Texture:
    """Two carriageways of two lanes and a shoulder, even and little worn, with dashes of 4 m."""
    shape, metres = (2048, 1024), (25.6, 48.0)
    image = 112 + 5 * fractal(rng, shape, 0.5) + 6 * fractal(rng, shape, 1.5)
    x = np.abs((np.arange(shape[1]) + 0.5) * metres[0] / shape[1] - metres[0] / 2)
    z = (np.arange(shape[0]) + 0.5) * metres[1] / shape[0]
    worn = fractal(rng, shape, 0.8) > -1.0
    edges = (np.abs(x - 2.9) < 0.08) | (np.abs(x - 10.6) < 0.08)
    dashes = (z % 12 < 4)[:, None] & (np.abs(x - 6.9) < 0.08)
    image[(dashes | edges) & worn] += 90
    reservation = x < 2.4
    grass = (shape[0], int(reservation.sum()))
    image[:, reservation] = 92 + 22 * fractal(rng, grass, 0.8)
    return make_texture(soft(image), metres)


def _rail(rng: np.random.Generator) -> Texture:
    """Steel rail on posts 2 m apart."""
    shape, metres = (128, 512), (4.0, 0.8)
    image = 165 + 5 * fractal(rng, shape, 1.2)
    solid = np.zeros(shape, np.float32)
    solid[10:60] = 255
    image[30:40] -= 40
    image[10:14] += 30
    for left in (20, 276):
        solid[:, left:left + 14] = 255
        image[60:, left:left + 14] = 100
    return make_texture(np.asarray(image, np.float32), metres, solid)


def traffic(route: Route, rng: np.random.Generator, station: Callable[[int], float]
            ) -> tuple[Mover, ...]:
    """
    Vehicles to overtake, one ahead at the speed of the camera, and others that come towards it.

    station: of the camera, by the frame.
    """
    palette = things.make_palette(rng, True)

    def mover(begin: float, speed: float, lane: float, lorries: float) -> Mover:
        body = things.truck(rng) if rng.random() < lorries else tuple(things.car(rng, palette))
        return Mover(body, partial(_pose_in_traffic, route, station, begin, speed, lane))

    return (*(mover(begin, float(rng.uniform(0.62, 0.75)), _SLOW_LANE, 0.6)
              for begin in np.cumsum(rng.uniform(25, 60, 8))),
            mover(float(rng.uniform(18, 40)), 1.0, OWN_LANE, 0.0),
            *(mover(begin, -1.0, _ONCOMING_LANE, 0.3)
              for begin in np.cumsum(rng.uniform(40, 120, 12))))


def _pose_in_traffic(route: Route, station: Callable[[int], float], begin: float, speed: float,
                     lane: float, index: int) -> Array:
    """Return the pose (4, 4) of a vehicle at a multiple of the speed of the camera."""
    place = np.clip(station(0) + begin + speed * (station(index) - station(0)), 0, route.length)
    (x, z), heading = route.at(np.array(place), lane)
    return level_pose(float(x), float(z), float(heading) + (np.pi if speed < 0 else 0.0))
