"""Scenes of a hand-held camera: a corridor, a study, a forest."""

from __future__ import annotations

from functools import cache, lru_cache

from djet_ros.core.types import Array
from djet_ros.lab.scenes import corridor as inside
from djet_ros.lab.scenes.camera import Haze, SensorNoise
from djet_ros.lab.scenes.flight import fields, Flight
from djet_ros.lab.scenes.forest import forest
from djet_ros.lab.scenes.panel import Panel, World
from djet_ros.lab.scenes.reflection import Gloss
from djet_ros.lab.scenes.route import Route, winding
from djet_ros.lab.scenes.scene import Scene
from djet_ros.lab.scenes.shutter import Shutter
from djet_ros.lab.scenes.study import study
from djet_ros.lab.scenes.walk import HandHeld, Walk, Whip
import numpy as np


def centred_camera(size: tuple[int, int], focal: float) -> Array:
    """Return K (3, 3) of a focal length in image widths, with a central principal point."""
    width, height = size
    return np.array([[focal * width, 0, (width - 1) / 2], [0, focal * width, (height - 1) / 2],
                     [0, 0, 1]])


@lru_cache(maxsize=2)
def _corridor(seed: int) -> tuple[inside.Plan, tuple[Panel, ...], tuple[Panel, ...]]:
    """Plan, floor, and everything above it."""
    rng = np.random.default_rng([seed, 10])
    plan, palette = inside.Plan.draw(rng), inside.make_palette(rng)
    return (plan, tuple(inside.floor(plan, palette)),
            tuple(inside.corridor(plan, palette, rng)))


def build_indoor(seed: int, size: tuple[int, int]) -> Scene:
    """Walk along a corridor with a reflecting floor, with a camera without antialiasing."""
    plan, floor, above = _corridor(seed)
    path = Walk(plan.route(), speed=0.11, height=1.5, tilt=0.18, glance=0.16, seed=seed)
    return Scene('indoor', World((*floor, *above)), path, centred_camera(size, 0.6), size, seed,
                 effects=(Gloss(World(above), polish=0.09), SensorNoise(0.5, 0.03)), samples=1)


@lru_cache(maxsize=2)
def _study(seed: int) -> World:
    return World(study(np.random.default_rng([seed, 11])))


def build_handheld(seed: int, size: tuple[int, int]) -> Scene:
    """Move a jerky hand-held camera in a cluttered study."""
    path = HandHeld((0.0, -1.3, 0.0), np.deg2rad(14), seed)
    return Scene('handheld', _study(seed), path, centred_camera(size, 0.82), size, seed,
                 effects=(Shutter(0.12, path.turning), SensorNoise(1.2, 0.1)))


def build_whip(seed: int, size: tuple[int, int]) -> Scene:
    """Swing a camera back and forth in the study, so fast that a fifth of each image is new."""
    path = Whip((0.0, -1.3, 0.0), np.deg2rad(15), np.deg2rad(45), np.deg2rad(14), seed)
    return Scene('whip', _study(seed), path, centred_camera(size, 0.82), size, seed,
                 effects=(SensorNoise(1.2, 0.1),))


@cache
def _path() -> Route:
    return winding(30, 0.35, (23, 37))


@lru_cache(maxsize=2)
def _forest(seed: int) -> World:
    return World(forest(_path(), np.random.default_rng([seed, 12])))


def build_forest(seed: int, size: tuple[int, int]) -> Scene:
    """Walk along a path through a forest."""
    path = Walk(_path(), speed=0.22, height=1.4, tilt=0.1, glance=0.08, seed=seed)
    return Scene('forest', _forest(seed), path, centred_camera(size, 0.7), size, seed,
                 background=225.0, effects=(Haze(70, 190), SensorNoise(1.0, 0.08)))


@lru_cache(maxsize=2)
def _fields(seed: int) -> World:
    return World(fields(np.random.default_rng([seed, 13])))


def build_flight(seed: int, size: tuple[int, int]) -> Scene:
    """Fly over flat fields and look down through a narrow lens."""
    path = Flight(speed=1.5, height=30.0, tilt=np.deg2rad(60), seed=seed)
    return Scene('flight', _fields(seed), path, centred_camera(size, 1.25), size, seed,
                 background=200.0, effects=(SensorNoise(1.0, 0.08),))
