"""What stands in a street: houses, trees, garden borders, lamps, cars, a lorry."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

from djet_ros.lab.scenes import street_textures as paint
from djet_ros.lab.scenes.panel import fitted, Panel, tiled
from djet_ros.lab.scenes.texture import one_of, Texture
import numpy as np

# Outline of a car in metres from its rear bottom corner, round the upper side.
_CAR = np.array([(0.0, 0.3), (0.0, 0.75), (0.15, 0.88), (0.7, 0.95), (1.05, 1.42), (2.3, 1.45),
                 (3.05, 0.95), (3.95, 0.8), (4.15, 0.6), (4.15, 0.3)])
_CAR_SIZE = (4.2, 1.5)
_CAR_WIDTH = 1.7
# Parts of the outline that are the rear window and the windscreen.
_CAR_GLASS = (3, 5)
HOUSE_DEPTH = 8.0


@dataclass(frozen=True)
class _Car:
    """The textures of cars of one paint."""

    side: Texture
    body: Texture
    end: Texture


@dataclass(frozen=True)
class Palette:
    """
    The textures of a street.

    varied: houses and gardens differ; otherwise everything is alike and keeps equal distances.
    """

    varied: bool
    roads: list[Texture]
    ground: Texture
    facades: list[Texture]
    roofs: list[Texture]
    trees: list[Texture]
    hedge: Texture
    fence: Texture
    cars: list[_Car]
    wall: Texture
    metal: Texture
    shadow: Texture
    sky: Texture
    treeline: Texture


def make_palette(rng: np.random.Generator, varied: bool) -> Palette:
    """Paint the textures of a street."""
    kinds = 8 if varied else 1
    return Palette(
        varied=varied,
        roads=[paint.road(rng) for _ in range(3 if varied else 1)],
        ground=paint.ground(rng),
        facades=[paint.facade(rng, 2 + k % 2, varied) for k in range(kinds)],
        roofs=[paint.roof(rng) for _ in range(2)],
        trees=[paint.tree(rng) for _ in range(3)],
        hedge=paint.hedge(rng), fence=paint.fence(rng),
        cars=[_car_textures(rng, tone) for tone in (40, 110, 175, 225)],
        wall=paint.plain(rng, 150, 9), metal=paint.plain(rng, 95, 5), shadow=paint.shadow(rng),
        sky=paint.sky(rng), treeline=paint.treeline(rng))


def house(rng: np.random.Generator, palette: Palette, width: float) -> list[Panel]:
    """House with its front at z = 0 looking to -z: front, two gable walls, two roof slopes."""
    kind = int(rng.integers(len(palette.facades)))
    front = palette.facades[kind]
    height, ridge, gain = front.metres[1], 3.0, 0.9
    wall = palette.wall
    if palette.varied:
        height *= rng.uniform(0.9, 1.1)
        ridge, gain = rng.uniform((2.0, 0.55), (4.0, 1.15))
        wall = palette.facades[(kind + 1) % len(palette.facades)]
    left = -width / 2
    panels = [fitted((left, -height, 0), (width, 0, 0), (0, height, 0), front, gain=gain,
                     mirror=palette.varied and bool(rng.integers(2)))]
    for x in (left, -left):
        panels.append(fitted((x, -height, 0), (0, 0, HOUSE_DEPTH), (0, height, 0), wall,
                             gain=0.62 * gain))
        panels += [tiled((x, -height, HOUSE_DEPTH / 2), (0, 0, half * HOUSE_DEPTH / 2),
                         (0, -ridge, 0), palette.wall, gain=0.75 * gain, triangle=True)
                   for half in (-1, 1)]
    tiles = one_of(palette.roofs, rng)
    for eaves, shade in ((-0.4, 0.9), (HOUSE_DEPTH, 0.7)):
        panels.append(tiled((left - 0.3, -height - ridge, HOUSE_DEPTH / 2), (width + 0.6, 0, 0),
                            (0, ridge + 0.15, eaves - HOUSE_DEPTH / 2), tiles, gain=shade))
    return panels


def tree(rng: np.random.Generator, palette: Palette) -> list[Panel]:
    """Three pictures of a tree that cross in its trunk."""
    texture = one_of(palette.trees, rng)
    width, height = np.array(texture.metres) * rng.uniform(0.75, 1.25)
    turn, gain = rng.uniform(0, np.pi), rng.uniform(0.7, 1.2)
    panels = []
    for angle in turn + np.arange(3) * np.pi / 3:
        horizontal = width * np.array([np.cos(angle), 0, np.sin(angle)])
        panels.append(fitted(-horizontal / 2 - (0, height, 0), horizontal, (0, height, 0), texture,
                             gain=gain * (0.85 + 0.15 * np.cos(angle))))
    return panels


def fence(palette: Palette) -> list[Panel]:
    """Six metres of fence."""
    return [tiled((0, -1.1, -3), (0, 0, 6), (0, 1.1, 0), palette.fence)]


def border(rng: np.random.Generator, palette: Palette) -> list[Panel]:
    """Six metres of garden border: open, a fence, or a hedge with a top."""
    kind = rng.random()
    if kind < 0.3:
        return []
    if kind < 0.6:
        return fence(palette)
    height, start = rng.uniform(0.7, 1.5), (rng.uniform(0, 6), 0.0)
    sides = [tiled((x, -height, -3), (0, 0, 6), (0, height, 0), palette.hedge, start=start)
             for x in (-0.35, 0.35)]
    ends = [tiled((-0.35, -height, z), (0.7, 0, 0), (0, height, 0), palette.hedge, start=start)
            for z in (-3, 3)]
    return [*sides, *ends, tiled((-0.35, -height, -3), (0, 0, 6), (0.7, 0, 0), palette.hedge,
                                 gain=1.3)]


def lamp(palette: Palette) -> list[Panel]:
    """Lamp post: a square mast and an arm."""
    half, height = 0.07, 5.5
    mast = [tiled((half * x, -height, half * z), (2 * half * dx, 0, 2 * half * dz), (0, height, 0),
                  palette.metal, gain=gain)
            for x, z, dx, dz, gain in ((-1, -1, 1, 0, 1.2), (1, -1, 0, 1, 0.8),
                                       (1, 1, -1, 0, 0.6), (-1, 1, 0, -1, 1.0))]
    arm = tiled((-0.7, -height, -0.06), (1.4, 0, 0), (0, 0.14, 0), palette.metal, gain=0.8)
    return [*mast, arm]


def _car_textures(rng: np.random.Generator, tone: float) -> _Car:
    return _Car(paint.car_side(rng, _CAR, _CAR_SIZE, tone), paint.plain(rng, tone, 4),
                paint.car_end(rng, tone))


def car(rng: np.random.Generator, palette: Palette) -> list[Panel]:
    """Car along z: its outline as two sides, and a strip from side to side along the outline."""
    textures = one_of(palette.cars, rng)
    length, height = _CAR_SIZE
    half = _CAR_WIDTH / 2
    panels = [fitted((x, -height, 0), (0, 0, length), (0, height, 0), textures.side, gain=gain)
              for x, gain in ((-half, 1.0), (half, 0.8))]
    for k, ((z0, y0), (z1, y1)) in enumerate(pairwise(_CAR)):
        (z_top, y_top), (z_low, y_low) = ((z0, y0), (z1, y1)) if y0 > y1 else ((z1, y1), (z0, y0))
        texture = textures.end if k in (0, len(_CAR) - 2) else textures.body
        panels.append(fitted((-half, -y_top, z_top), (2 * half, 0, 0),
                             (0, y_top - y_low, z_low - z_top), texture,
                             gain=0.35 if k in _CAR_GLASS else 1.0))
    panels.append(fitted((-half - 0.3, 0, -0.3), (2 * half + 0.6, 0, 0), (0, 0, length + 0.6),
                         palette.shadow, layer=9))
    return panels


def truck(rng: np.random.Generator) -> tuple[Panel, ...]:
    """Lorry with its rear at z = 0: a box with painted, lettered walls."""
    width, height, length, floor = 2.5, 3.4, 7.0, 0.6
    wall, side = paint.lettering(rng, 2), paint.lettering(rng, 6)
    left, body = -width / 2, height - floor
    return (fitted((left, -height, 0), (width, 0, 0), (0, body, 0), wall),
            fitted((left, -height, length), (width, 0, 0), (0, body, 0), wall, gain=0.8),
            fitted((left, -height, 0), (0, 0, length), (0, body, 0), side, gain=0.9),
            fitted((-left, -height, 0), (0, 0, length), (0, body, 0), side, gain=0.75),
            fitted((left, -floor, 0.2), (width, 0, 0), (0, floor, 0), wall, gain=0.2))
