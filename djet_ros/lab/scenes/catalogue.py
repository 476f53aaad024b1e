"""Catalogue of the named scenes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial

from djet_ros.core.types import Array
from djet_ros.errors import DjetError
from djet_ros.lab.scenes.camera import (
    Defocus,
    Effect,
    Exposure,
    Haze,
    Headlight,
    MarineSnow,
    SensorNoise,
)
from djet_ros.lab.scenes.excursions import (
    build_flight,
    build_forest,
    build_handheld,
    build_indoor,
    build_whip,
    centred_camera,
)
from djet_ros.lab.scenes.motorway import motorway, OWN_LANE, traffic
from djet_ros.lab.scenes.panel import Mover, Panel, World
from djet_ros.lab.scenes.route import (
    Dive,
    Drive,
    level_pose,
    Route,
    route_of,
    Trajectory,
    Turntable,
    winding,
)
from djet_ros.lab.scenes.scene import Scene
from djet_ros.lab.scenes.seafloor import seafloor
from djet_ros.lab.scenes.slow import Slower
from djet_ros.lab.scenes.street import street
from djet_ros.lab.scenes.street_objects import make_palette, Palette, truck
import numpy as np

_CAR_SIZE = (1241, 376)
_DIVE_SIZE = (960, 540)
_HAND_SIZE = (640, 480)
_SMALLEST, _LARGEST = 64, 4096
# Length in metres of the road beyond the last frame, to fill its view.
_OUTLOOK = 100.0
_LANE = 1.4


@dataclass(frozen=True)
class Entry:
    """
    A named scene.

    number: NN of its folder; frames (None: to the end of the route), size: defaults of a
    rendering; build: function of seed and size (width, height); text: description; parallax:
    whether the camera translates, so that translation directions are defined.
    """

    number: int
    frames: int | None
    size: tuple[int, int]
    build: Callable[[int, tuple[int, int]], Scene]
    text: str
    parallax: bool = True


def make_scene(name: str, seed: int = 0, size: tuple[int, int] | None = None,
               slower: int = 1) -> Scene:
    """
    Return the scene of a name; raise DjetError for an unknown name or invalid size or seed.

    slower: number of steps of the camera in place of each usual one.
    """
    entry = find(name)
    width, height = size = size or entry.size
    if not (_SMALLEST <= width <= _LARGEST and _SMALLEST <= height <= _LARGEST):
        raise DjetError(f'--size is {width}x{height}; width and height must be between '
                        f'{_SMALLEST} and {_LARGEST} pixels')
    if seed < 0:
        raise DjetError(f'--seed is {seed}; it must not be negative')
    if slower < 1:
        raise DjetError(f'--slower is {slower}; it must be at least 1')
    scene = entry.build(seed, size)
    return scene if slower == 1 else replace(scene, path=Slower(scene.path, slower))


def find(name: str) -> Entry:
    """Return the catalogue entry of a name; raise DjetError with all names if it is unknown."""
    if name not in SCENES:
        raise DjetError(f"there is no scene '{name}'; choose from {', '.join(SCENES)}")
    return SCENES[name]


def suggested_frames(scene: Scene) -> int:
    """Return the default number of frames of a scene; None in the catalogue means all."""
    return find(scene.name).frames or scene.path.limit


def car_camera(size: tuple[int, int]) -> Array:
    """Return K (3, 3) of KITTI's gray camera, scaled to a size (width, height)."""
    scale, scale_y = size[0] / 1241, size[1] / 376
    return np.array([[718.856 * scale, 0, (607.1928 + 0.5) * scale - 0.5],
                     [0, 718.856 * scale, (185.2157 + 0.5) * scale_y - 0.5],
                     [0, 0, 1]])


@cache
def _road() -> Route:
    return winding(1000 + _OUTLOOK, 0.25, (170, 90))


# Cached: several scenes share textures and streets, which take a second to make.
@lru_cache(maxsize=2)
def _palette(seed: int, varied: bool) -> Palette:
    return make_palette(np.random.default_rng([seed, 0]), varied)


@lru_cache(maxsize=2)
def _road_world(seed: int, varied: bool) -> World:
    return World(street(_road(), _palette(seed, varied), np.random.default_rng([seed, 1])))


def _street_scene(name: str, seed: int, size: tuple[int, int], path: Trajectory | None = None,
                  world: World | None = None, effects: tuple[Effect, ...] = ()) -> Scene:
    """Return a scene with the car's camera, by default a drive along the road."""
    return Scene(name, world or _road_world(seed, True), path or _drive(), car_camera(size), size,
                 seed, background=200.0,
                 effects=(Haze(450, 205), *effects, SensorNoise(0.8, 0.06)))


def _drive() -> Drive:
    return Drive(_without_outlook(_road()), speed=1.0, lane=_LANE)


def _without_outlook(route: Route) -> Route:
    end = int(len(route.curvature) * (1 - _OUTLOOK / route.length))
    return Route(route.curvature[:end])


def _on_the_spot(rate: float) -> Turntable:
    (x, z), heading = _road().at(np.array(60.0), _LANE)
    return Turntable((float(x), float(z)), float(heading), rate)


def _build_road(seed: int, size: tuple[int, int]) -> Scene:
    return _street_scene('road', seed, size)


def _build_rotation(seed: int, size: tuple[int, int]) -> Scene:
    return _street_scene('rotation', seed, size, _on_the_spot(np.deg2rad(1.0)))


def _build_standstill(seed: int, size: tuple[int, int]) -> Scene:
    return _street_scene('standstill', seed, size, _on_the_spot(0.0))


def _build_exposure(seed: int, size: tuple[int, int]) -> Scene:
    return _street_scene('exposure_jump', seed, size,
                         effects=(Exposure((1.0, 0.4, 1.5), hold=5),))


def _build_blur(seed: int, size: tuple[int, int]) -> Scene:
    sigma = 2.5 * size[0] / _CAR_SIZE[0]
    return _street_scene('blur', seed, size, effects=(Defocus(sigma, length=3, period=8),))


def _build_repeated(seed: int, size: tuple[int, int]) -> Scene:
    return _street_scene('repeated_texture', seed, size, world=_road_world(seed, False))


def _build_moving(seed: int, size: tuple[int, int]) -> Scene:
    """Drive behind a lorry of varying distance."""
    drive = _drive()

    def lorry(index: int) -> Array:
        ahead = 2.9 - 0.6 * np.cos(2 * np.pi * index / 20)
        (x, z), heading = drive.route.at(np.array(drive.station(index) + ahead), -0.45)
        return level_pose(float(x), float(z), float(heading))

    still = _road_world(seed, True)
    panels = truck(np.random.default_rng([seed, 4]))
    return _street_scene('moving_object', seed, size, drive,
                         World(still.panels, (Mover(panels, lorry),)))


# Crossing lines of lorries: metres ahead of the camera, metres per frame to the right, and metres
# between two lorries.
_CROSSINGS = ((6.0, 0.9, 17.0), (11.0, -0.7, 23.0))
_ABREAST = 3


def _build_traffic(seed: int, size: tuple[int, int]) -> Scene:
    """Stand at a street with lorries from both sides."""
    spot, rng = _on_the_spot(0.0), np.random.default_rng([seed, 6])
    panels, camera = truck(rng), spot.pose(0)
    begins = rng.uniform(0, 20, len(_CROSSINGS))
    movers = tuple(
        Mover(panels, partial(_crossing, camera, ahead, speed, gap, begin + index * gap))
        for (ahead, speed, gap), begin in zip(_CROSSINGS, begins) for index in range(_ABREAST))
    return _street_scene('traffic', seed, size, spot,
                         World(_road_world(seed, True).panels, movers))


def _crossing(camera: Array, ahead: float, speed: float, gap: float, begin: float, index: int
              ) -> Array:
    """Return the pose (4, 4) of a lorry of a line that wraps around out of sight."""
    length = _ABREAST * gap
    sideways = (begin + abs(speed) * index) % length - length / 2
    lorry = level_pose(sideways if speed > 0 else -sideways, ahead, np.copysign(np.pi / 2, speed))
    ground = camera.copy()
    ground[1, 3] = 0.0
    return np.asarray(ground @ lorry)


@lru_cache(maxsize=1)
def _loop_world(seed: int) -> World:
    return World(street(_lap(1), _palette(seed, True), np.random.default_rng([seed, 2])))


def _lap(rounds: int) -> Route:
    """Return the route around a block, clockwise from the middle of one side."""
    corner = (8 * np.pi / 2, 1 / 8)
    once = [(20, 0), corner, (30, 0), corner, (40, 0), corner, (30, 0), corner, (20, 0)]
    return route_of(once * rounds)


def _build_loop(seed: int, size: tuple[int, int]) -> Scene:
    path = Drive(_lap(2), speed=1.2, turning=np.deg2rad(3.5), lane=_LANE)
    return _street_scene('loop', seed, size, path, _loop_world(seed))


# A right and a left turn, as (length, curvature).
_BENDS = ((12, 0), (7 * np.pi / 2, 1 / 7), (16, 0), (7 * np.pi / 2, -1 / 7), (20, 0))


@lru_cache(maxsize=1)
def _bends_world(seed: int) -> World:
    route = route_of([*_BENDS, (_OUTLOOK, 0)])
    return World(street(route, _palette(seed, True), np.random.default_rng([seed, 3])))


def _build_sharp_turn(seed: int, size: tuple[int, int]) -> Scene:
    path = Drive(route_of(_BENDS), speed=0.8, turning=np.deg2rad(4.0), lane=_LANE)
    return _street_scene('sharp_turn', seed, size, path, _bends_world(seed))


@cache
def _motorway_route() -> Route:
    return winding(600 + _OUTLOOK, 0.12, (420, 310))


@lru_cache(maxsize=1)
def _motorway_panels(seed: int) -> tuple[Panel, ...]:
    return motorway(_motorway_route(), np.random.default_rng([seed, 14]))


def _build_motorway(seed: int, size: tuple[int, int]) -> Scene:
    route = _motorway_route()
    path = Drive(_without_outlook(route), speed=3.0, lane=OWN_LANE)
    movers = traffic(route, np.random.default_rng([seed, 15]), path.station)
    return _street_scene('motorway', seed, size, path, World(_motorway_panels(seed), movers))


@cache
def _dive_route() -> Route:
    return winding(80, 0.5, (47, 31))


@lru_cache(maxsize=1)
def _seafloor_world(seed: int) -> World:
    return World(seafloor(_dive_route(), np.random.default_rng([seed, 5])))


def _build_underwater(seed: int, size: tuple[int, int]) -> Scene:
    path = Dive(_dive_route(), speed=0.15, height=2.2, tilt=np.deg2rad(23))
    lamp = Headlight(place=(0.5, -0.4, 0.0), aim=(-0.1, 0.12, 1.0), spread=0.42, power=5500,
                     ambient=70, clear=7.5, glow=45, sway=0.08)
    snow = MarineSnow(count=900, reach=6.0, drift=(0.004, 0.006, 0.0), tone=30)
    return Scene('underwater', _seafloor_world(seed), path, centred_camera(size, 0.75), size, seed,
                 effects=(lamp, snow, SensorNoise(1.3, 0.12)), reach=18.0)


SCENES: dict[str, Entry] = {
    'road': Entry(0, 60, _CAR_SIZE, _build_road, 'street with slight curves, 1 m per frame'),
    'underwater': Entry(1, 60, _DIVE_SIZE, _build_underwater,
                        'dim, hazy sea floor lit by a lamp, with drifting particles'),
    'loop': Entry(2, None, _CAR_SIZE, _build_loop, 'two laps around a block'),
    'rotation': Entry(3, 40, _CAR_SIZE, _build_rotation, 'pure rotation, 1 deg per frame',
                      parallax=False),
    'standstill': Entry(4, 20, _CAR_SIZE, _build_standstill,
                        'stationary camera; only the noise changes', parallax=False),
    'sharp_turn': Entry(5, 80, _CAR_SIZE, _build_sharp_turn, 'slow turns of 4 deg per frame'),
    'moving_object': Entry(6, 40, _CAR_SIZE, _build_moving,
                           'behind a moving lorry that fills half of the image'),
    'repeated_texture': Entry(7, 40, _CAR_SIZE, _build_repeated,
                              'street of identical houses'),
    'exposure_jump': Entry(8, 40, _CAR_SIZE, _build_exposure,
                           'exposure that jumps every 5 frames'),
    'blur': Entry(9, 40, _CAR_SIZE, _build_blur, '3 of every 8 frames out of focus'),
    'indoor': Entry(10, 60, _HAND_SIZE, build_indoor,
                    'white corridor with a reflecting floor, aliased edges'),
    'handheld': Entry(11, 60, _HAND_SIZE, build_handheld,
                      'jerky hand-held camera in a study, at times pure rotation'),
    'forest': Entry(12, 60, _DIVE_SIZE, build_forest,
                    'path through a forest: weak, random texture'),
    'whip': Entry(13, 60, _HAND_SIZE, build_whip,
                  'camera swung back and forth in the study, 15 deg per frame'),
    'traffic': Entry(14, 60, _CAR_SIZE, _build_traffic,
                     'stationary camera at a street with crossing lorries', parallax=False),
    'flight': Entry(15, 60, _HAND_SIZE, build_flight,
                    'drone over flat fields, through a narrow lens'),
    'motorway': Entry(16, 60, _CAR_SIZE, _build_motorway,
                      'motorway at 3 m per frame, among vehicles of about that speed'),
}
