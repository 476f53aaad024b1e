"""A cluttered study: a desk under shelves, walls with posters, boxes and books everywhere."""

from __future__ import annotations

from dataclasses import dataclass

from djet_ros.lab.scenes import indoor_textures as paint
from djet_ros.lab.scenes.cuboid import cuboid
from djet_ros.lab.scenes.panel import fitted, Panel, placed, tiled
from djet_ros.lab.scenes.route import level_pose
from djet_ros.lab.scenes.texture import one_of, Texture
import numpy as np

# The room in metres about the camera's usual place: left, right, behind, ahead; and its height.
_LEFT, _RIGHT, _BACK, _FRONT, _HEIGHT = -2.0, 2.2, -2.5, 2.1, 2.6
_DESK = 0.74


@dataclass(frozen=True)
class _Palette:
    """The textures of a study."""

    wall: Texture
    carpet: Texture
    ceiling: Texture
    woods: list[Texture]
    pages: list[Texture]
    posters: list[Texture]
    books: list[Texture]
    cartons: list[Texture]
    screen: Texture
    keys: Texture
    dark: Texture


def study(rng: np.random.Generator) -> tuple[Panel, ...]:
    """Panels of the whole room; the camera's usual place is at the origin, looking along z."""
    palette = _Palette(
        wall=paint.pale(rng, rng.uniform(150, 200), 2.5),
        carpet=paint.fabric(rng, rng.uniform(75, 120)), ceiling=paint.ceiling(rng),
        woods=[paint.wood(rng, tone) for tone in rng.uniform(80, 165, 2)],
        pages=[paint.page(rng) for _ in range(3)],
        posters=[paint.painting(rng) for _ in range(4)],
        books=[paint.books(rng) for _ in range(3)],
        cartons=[paint.carton(rng, tone) for tone in (60, 110, 150, 190, 215)],
        screen=paint.screen(rng), keys=paint.keyboard(rng), dark=paint.flat(40))
    return (*_shell(palette), *_posters(palette, rng), *_desk(palette, rng),
            *_shelf(palette, rng, _FRONT, -1.65), *_bookcase(palette, rng),
            *_floor_boxes(palette, rng))


def _shell(palette: _Palette) -> list[Panel]:
    """Floor, ceiling and four walls."""
    width, depth = _RIGHT - _LEFT, _FRONT - _BACK
    across, along, down = (width, 0, 0), (0, 0, depth), (0, _HEIGHT, 0)
    panels = [tiled((_LEFT, y, _BACK), across, along, texture)
              for y, texture in ((0, palette.carpet), (-_HEIGHT, palette.ceiling))]
    panels += [tiled((_LEFT, -_HEIGHT, z), across, down, palette.wall, gain=gain)
               for z, gain in ((_FRONT, 1.0), (_BACK, 0.8))]
    return panels + [tiled((x, -_HEIGHT, _BACK), along, down, palette.wall, gain=gain)
                     for x, gain in ((_LEFT, 0.9), (_RIGHT, 0.75))]


def _posters(palette: _Palette, rng: np.random.Generator) -> list[Panel]:
    """Posters and sheets on the walls ahead and aside."""
    panels = []
    for x, z, heading, places in ((0.0, _FRONT, 0.0, (-1.5, -0.85, 0.35, 0.85, 1.45)),
                                  (_LEFT, 0.6, -np.pi / 2, (-1.6, -0.8)),
                                  (_RIGHT, 0.4, np.pi / 2, (-1.2, -0.4, 0.5, 1.2))):
        flat: list[Panel] = []
        for layer, left in enumerate(places):
            width, height = rng.uniform((0.35, 0.4), (0.6, 0.75))
            image = one_of(palette.posters + palette.pages, rng)
            flat.append(fitted((left, rng.uniform(-1.62, -1.45), -0.004), (width, 0, 0),
                               (0, height, 0), image, gain=rng.uniform(0.75, 1.1),
                               layer=layer))
        panels += placed(flat, level_pose(x, z, heading))
    return panels


def _desk(palette: _Palette, rng: np.random.Generator) -> list[Panel]:
    """Desk along the wall ahead with a monitor, a keyboard, papers, books and boxes."""
    wood = palette.woods[0]
    near = _FRONT - 0.9
    panels = cuboid((-1.2, -_DESK, near), (1.2, -_DESK + 0.04, _FRONT - 0.02), wood)
    for x in (-1.15, 1.1):
        for z in (near + 0.03, _FRONT - 0.1):
            panels += cuboid((x, -_DESK + 0.04, z), (x + 0.05, 0, z + 0.05), palette.dark)
    panels += cuboid((-0.75, -_DESK + 0.04, near + 0.1), (-0.3, 0, _FRONT - 0.1), wood, gain=0.8)
    panels += placed(_monitor(palette), _on_desk(rng.uniform(-0.35, 0.2), _FRONT - 0.35,
                                                 rng.normal(0, 0.2)))
    panels += placed([fitted((-0.22, -0.02, 0.08), (0.44, 0, 0), (0, 0.012, -0.15),
                             palette.keys)], _on_desk(0.0, near + 0.15, rng.normal(0, 0.1)))
    for layer, x in enumerate(rng.uniform(-1.05, 0.9, 7)):
        sheet = fitted((-0.1, -0.001 - 0.001 * layer, 0.14), (0.21, 0, 0), (0, 0, -0.29),
                       one_of(palette.pages, rng))
        panels += placed([sheet], _on_desk(x, near + rng.uniform(0.17, 0.5), rng.normal(0, 0.5)))
    for x in np.concatenate([rng.uniform(-1.1, -0.5, 5), rng.uniform(0.35, 1.1, 6)]):
        panels += placed(_clutter(palette, rng, 0.24), _on_desk(
            x, near + rng.uniform(0.12, 0.75), rng.uniform(0, 6)))
    return panels


def _on_desk(x: float, z: float, heading: float
             ) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return level_pose(x, z, heading, _DESK)


def _monitor(palette: _Palette) -> list[Panel]:
    picture = fitted((-0.27, -0.45, -0.031), (0.54, 0, 0), (0, 0.33, 0), palette.screen)
    return [picture, *cuboid((-0.29, -0.47, -0.03), (0.29, -0.1, 0.01), palette.dark),
            *cuboid((-0.03, -0.1, -0.02), (0.03, 0, 0.0), palette.dark),
            *cuboid((-0.13, -0.015, -0.1), (0.13, 0, 0.1), palette.dark)]


def _clutter(palette: _Palette, rng: np.random.Generator, most: float) -> list[Panel]:
    """Box or pile of books that stands at the origin, up to so many metres high."""
    width, height, depth = rng.uniform((0.05, 0.05, 0.05), (0.2, most, 0.22))
    texture = one_of(palette.cartons + palette.books, rng)
    start = (float(rng.uniform(0, 1)), float(rng.uniform(0, 1)))
    return cuboid((-width / 2, -height, -depth / 2), (width / 2, 0, depth / 2), texture,
                  gain=rng.uniform(0.6, 1.15), start=start, lids=one_of(palette.cartons, rng))


def _shelf(palette: _Palette, rng: np.random.Generator, wall: float, y: float) -> list[Panel]:
    """Board on the wall ahead with books and boxes on it."""
    panels = cuboid((-1.3, y, wall - 0.26), (0.7, y + 0.03, wall), palette.woods[1])
    x = -1.25
    while x < 0.45:
        width, height = rng.uniform((0.1, 0.2), (0.35, 0.32))
        start = (float(rng.uniform(0, 1)), 0.3 - height)
        panels += cuboid((x, y - height, wall - rng.uniform(0.16, 0.24)), (x + width, y, wall),
                         one_of(palette.books, rng), start=start, gain=rng.uniform(0.7, 1.1),
                         lids=palette.dark)
        x += width + rng.uniform(0.0, 0.12)
    return panels


def _bookcase(palette: _Palette, rng: np.random.Generator) -> list[Panel]:
    """Case full of books at the left wall."""
    low, high, depth = -0.2, 1.2, 0.32
    panels: list[Panel] = []
    for y in (-1.8, -1.42, -1.04, -0.66, -0.28):
        panels += cuboid((_LEFT, y, low), (_LEFT + depth, y + 0.025, high), palette.woods[1])
        z = low + 0.03
        while z < high - 0.3:
            width, height = rng.uniform((0.1, 0.2), (0.4, 0.3))
            start = (float(rng.uniform(0, 1)), 0.3 - height)
            corner = (_LEFT + rng.uniform(0.16, 0.3), y, z + width)
            panels += cuboid((_LEFT, y - height, z), corner, one_of(palette.books, rng),
                             start=start, gain=rng.uniform(0.6, 1.0), lids=palette.dark)
            z += width + rng.uniform(0.0, 0.08)
    for z in (low, high):
        panels += cuboid((_LEFT, -2.15, z), (_LEFT + depth, 0, z + 0.025), palette.woods[1])
    return panels


def _floor_boxes(palette: _Palette, rng: np.random.Generator) -> list[Panel]:
    """Boxes on the floor, in piles along the right wall."""
    panels: list[Panel] = []
    for z in np.arange(-0.6, _FRONT - 0.3, 0.5):
        y, size = 0.0, 0.5
        for _ in range(int(rng.integers(1, 4))):
            height = rng.uniform(0.2, 0.4)
            texture = one_of(palette.cartons, rng)
            box = cuboid((-size / 2, -height, -size / 2), (size / 2, 0, size / 2), texture,
                         gain=rng.uniform(0.6, 1.0))
            panels += placed(box, level_pose(1.6, z, rng.normal(0, 0.12), y))
            y, size = y + height, size * 0.85
    return panels
