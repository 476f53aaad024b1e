"""A corridor as in a hospital or school: white walls, doors, pictures, windows, a tiled floor."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

from djet_ros.lab.scenes import indoor_textures as paint
from djet_ros.lab.scenes.cuboid import cuboid, frame
from djet_ros.lab.scenes.panel import fitted, Panel, placed, tiled
from djet_ros.lab.scenes.route import level_pose, Route, route_of
from djet_ros.lab.scenes.texture import one_of, Texture
import numpy as np

CELL = 3.0
HEIGHT = 2.7
_DOOR = (1.0, 2.1)
_BEND = (CELL * np.pi / 4, 2 / CELL)
# Headings of the four sides of a cell in quarter turns, and where the next cell lies.
_SIDES = ((0, 1), (1, 0), (0, -1), (-1, 0))

Cell = tuple[int, int]


@dataclass(frozen=True)
class Plan:
    """
    Where a corridor goes, in cells of CELL metres.

    runs: cells from one corner to the next; turns: +1 or -1, to the right or left, one fewer.
    """

    runs: tuple[int, ...]
    turns: tuple[int, ...]

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Plan:
        """Bend to and fro, so that the corridor never meets itself."""
        first = int(rng.choice([-1, 1]))
        runs = (2, *(int(n) for n in rng.integers(3, 5, 3)), 6)
        return cls(runs, tuple(first * (-1) ** k for k in range(len(runs) - 1)))

    @cached_property
    def cells(self) -> tuple[Cell, ...]:
        """Return the cells in order, from one before the start to the end."""
        side, cells = 0, [(0, -1), (0, 0)]
        for run, turn in zip(self.runs, (*self.turns, 0)):
            for _ in range(run):
                (x, z), (right, ahead) = cells[-1], _SIDES[side]
                cells.append((x + right, z + ahead))
            side = (side + turn) % 4
        return tuple(cells)

    def route(self) -> Route:
        """Return the way through the middle, up to 4 m before the end."""
        # How long before its corner an eased bend begins, beyond what a sharp one would take.
        eased = route_of([(CELL, 0), _BEND, (CELL, 0)]).points[-1, 1] - CELL
        pieces: list[tuple[float, float]] = []
        for k, run in enumerate(self.runs):
            bends = (k > 0) + (k < len(self.turns))
            length = run * CELL - bends * eased - (4.0 if k == len(self.turns) else 0.0)
            pieces.append((length, 0.0))
            if k < len(self.turns):
                pieces.append((_BEND[0], self.turns[k] * _BEND[1]))
        return route_of(pieces)


@dataclass(frozen=True)
class Palette:
    """The textures of a corridor."""

    wall: Texture
    plaster: Texture
    floor: Texture
    ceiling: Texture
    lamp: Texture
    trim: Texture
    dark: Texture
    leaf: Texture
    sky: Texture
    pictures: list[Texture] = field(default_factory=list)
    notes: list[Texture] = field(default_factory=list)


def make_palette(rng: np.random.Generator) -> Palette:
    """Paint the textures of a corridor."""
    return Palette(
        wall=paint.panelled(rng, rng.uniform(226, 238), HEIGHT),
        plaster=paint.pale(rng, 228), floor=paint.tiles(rng, rng.uniform(150, 185), 0.5),
        ceiling=paint.ceiling(rng), lamp=paint.flat(250), trim=paint.flat(rng.uniform(130, 175)),
        dark=paint.flat(62), leaf=paint.pale(rng, rng.uniform(165, 205), 0.9),
        sky=paint.pale(rng, 250, 1.5), pictures=[paint.painting(rng) for _ in range(3)],
        notes=[paint.page(rng) for _ in range(3)])


def floor(plan: Plan, palette: Palette) -> list[Panel]:
    """Floor under the corridor and the rooms beside it; tiles run through."""
    low = np.min(plan.cells, axis=0) - 2.5
    extent = np.max(plan.cells, axis=0) + 2.5 - low
    (x, z), (width, depth) = low * CELL, extent * CELL
    return [tiled((x, 0, z), (width, 0, 0), (0, 0, depth), palette.floor)]


def corridor(plan: Plan, palette: Palette, rng: np.random.Generator) -> list[Panel]:
    """Everything above the floor."""
    cells = set(plan.cells)
    occupied = set(cells)
    panels: list[Panel] = []
    for cell in plan.cells:
        middle = level_pose(cell[0] * CELL, cell[1] * CELL, 0.0)
        panels += placed(_ceiling(palette), middle)
        for quarter, (right, ahead) in enumerate(_SIDES):
            beyond = cell[0] + right, cell[1] + ahead
            if beyond in cells:
                continue
            open_ = beyond not in occupied and rng.random() < 0.25
            occupied |= {beyond} if open_ else set()
            side = _doorway(palette, rng) if open_ else _wall(palette, rng)
            panels += placed(side, _wall_pose(cell, quarter))
    return panels


def _wall_pose(cell: Cell, quarter: int) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Pose of a side of a cell: x along the wall, z out of the cell."""
    right, ahead = _SIDES[quarter]
    return level_pose((cell[0] + right / 2) * CELL, (cell[1] + ahead / 2) * CELL,
                      quarter * np.pi / 2)


def _ceiling(palette: Palette) -> list[Panel]:
    half = CELL / 2
    boards = tiled((-half, -HEIGHT, -half), (CELL, 0, 0), (0, 0, CELL), palette.ceiling)
    lamps = [fitted((x - 0.15, -HEIGHT, -0.6), (0.3, 0, 0), (0, 0, 1.2), palette.lamp, gain=4.5,
                    layer=1) for x in (-0.6, 0.6)]
    return [boards, *lamps]


def _wall(palette: Palette, rng: np.random.Generator) -> list[Panel]:
    """Make a closed side of a cell at z = 0, looking to -z, with one thing or another on it."""
    half = CELL / 2
    furnishings = (_door, _pictures, _window, _board, _bench, _nothing)
    kind = furnishings[int(rng.choice(len(furnishings), p=(0.3, 0.2, 0.15, 0.1, 0.1, 0.15)))]
    wall = fitted((-half, -HEIGHT, 0), (CELL, 0, 0), (0, HEIGHT, 0), palette.wall,
                  gain=rng.uniform(0.95, 1.06))
    rails = [(-half, half)] if kind is not _door else [(-half, -0.7), (0.7, half)]
    return [wall, *kind(palette, rng), *_rails(palette, rails)]


def _rails(palette: Palette, spans: list[tuple[float, float]]) -> list[Panel]:
    """Handrail and skirting along parts of a wall."""
    return [panel for left, right in spans for panel in (
        *cuboid((left, -0.92, -0.07), (right, -0.84, -0.03), palette.trim),
        *cuboid((left, -0.1, -0.015), (right, 0, 0), palette.trim, gain=0.7))]


def _nothing(palette: Palette, rng: np.random.Generator) -> list[Panel]:
    return []


def _door(palette: Palette, rng: np.random.Generator) -> list[Panel]:
    """Make a closed door: leaf, thin frame, handle, a small window or a sign beside it."""
    half, height = _DOOR[0] / 2, _DOOR[1]
    leaf = tiled((-half, -height, -0.01), (2 * half, 0, 0), (0, height, 0), palette.leaf)
    panels = [leaf, *_door_frame(palette),
              *cuboid((0.3, -1.06, -0.06), (0.43, -1.03, -0.03), palette.dark)]
    if rng.random() < 0.5:
        panels += frame((0.05, -1.9, -0.025), (0.25, -1.3, -0.01), 0.02, palette.trim)
        panels.append(fitted((0.05, -1.9, -0.02), (0.2, 0, 0), (0, 0.6, 0), palette.dark))
    note = one_of(palette.notes, rng)
    panels.append(fitted((0.72, -1.6, -0.01), (0.16, 0, 0), (0, 0.16, 0), note))
    return panels


def _door_frame(palette: Palette) -> list[Panel]:
    half, height = _DOOR[0] / 2, _DOOR[1]
    return [panel for low, high in (
        ((-half - 0.06, -height, -0.04), (-half, 0, 0.12)),
        ((half, -height, -0.04), (half + 0.06, 0, 0.12)),
        ((-half - 0.06, -height - 0.06, -0.04), (half + 0.06, -height, 0.12)))
        for panel in cuboid(low, high, palette.trim, gain=0.8)]


def _pictures(palette: Palette, rng: np.random.Generator) -> list[Panel]:
    """One or two pictures in thin frames."""
    panels: list[Panel] = []
    for x in rng.choice([-0.95, -0.1, 0.55], int(rng.integers(1, 3)), replace=False):
        width, height = rng.uniform((0.4, 0.4), (0.65, 0.8))
        top = -1.5 - height / 2 + rng.normal(0, 0.04)
        image = one_of(palette.pictures, rng)
        panels += frame((x, top, -0.03), (x + width, top + height, 0), 0.025, palette.dark)
        panels.append(fitted((x, top, -0.01), (width, 0, 0), (0, height, 0), image,
                             mirror=bool(rng.integers(2))))
    return panels


def _window(palette: Palette, rng: np.random.Generator) -> list[Panel]:
    """Window into bright daylight with thin bars."""
    low, high = (-0.9, -2.2), (0.9, -1.1)
    panels = frame((*low, -0.03), (*high, 0), 0.05, palette.plaster, gain=0.8)
    panels.append(fitted((*low, -0.005), (1.8, 0, 0), (0, 1.1, 0), palette.sky, gain=1.5))
    panels += cuboid((low[0], -1.52, -0.03), (high[0], -1.48, 0), palette.plaster, gain=0.7)
    for x in (-0.3, 0.3):
        panels += cuboid((x - 0.02, low[1], -0.03), (x + 0.02, high[1], 0), palette.plaster,
                         gain=0.7)
    return panels


def _board(palette: Palette, rng: np.random.Generator) -> list[Panel]:
    """Notice board with a few sheets."""
    panels = frame((-0.7, -2.0, -0.03), (0.7, -1.15, 0), 0.02, palette.trim)
    panels.append(fitted((-0.7, -2.0, -0.01), (1.4, 0, 0), (0, 0.85, 0), palette.leaf, gain=0.75))
    for x in np.arange(-0.62, 0.5, 0.28):
        if rng.random() < 0.75:
            note = one_of(palette.notes, rng)
            panels.append(fitted((x, -1.92 + rng.uniform(0, 0.35), -0.012), (0.21, 0, 0),
                                 (0, 0.3, 0), note))
    return panels


def _bench(palette: Palette, rng: np.random.Generator) -> list[Panel]:
    """Bench on thin legs."""
    panels = cuboid((-0.8, -0.47, -0.5), (0.8, -0.43, -0.1), palette.leaf)
    for x in (-0.75, 0.72):
        for z in (-0.48, -0.15):
            panels += cuboid((x, -0.43, z), (x + 0.03, 0, z + 0.03), palette.dark)
    return panels


def _doorway(palette: Palette, rng: np.random.Generator) -> list[Panel]:
    """Open side of a cell: a wall round an opening, and the room behind it."""
    half, (width, height) = CELL / 2, _DOOR
    side = half - width / 2
    panels = [tiled((x, -HEIGHT, 0), (side, 0, 0), (0, HEIGHT, 0), palette.wall, start=(x, 0))
              for x in (-half, width / 2)]
    panels.append(tiled((-width / 2, -HEIGHT, 0), (width, 0, 0), (0, HEIGHT - height, 0),
                        palette.wall, start=(-width / 2, 0)))
    panels += _rails(palette, [(-half, -0.56), (0.56, half)])
    return [*panels, *_door_frame(palette), *_room(palette, rng)]


def _room(palette: Palette, rng: np.random.Generator) -> list[Panel]:
    """Small room from z = 0 on: walls, a ceiling with a lamp, a cupboard and a table."""
    half = CELL / 2 - 0.06
    deep = CELL - 0.12
    panels = [tiled((x, -HEIGHT, 0.02), (0, 0, deep), (0, HEIGHT, 0), palette.plaster, gain=gain)
              for x, gain in ((-half, 0.85), (half, 0.92))]
    panels += [tiled((-half, -HEIGHT, deep), (2 * half, 0, 0), (0, HEIGHT, 0), palette.plaster),
               tiled((-half, -HEIGHT, 0.02), (2 * half, 0, 0), (0, 0, deep), palette.ceiling),
               fitted((-0.6, -HEIGHT, 1.2), (1.2, 0, 0), (0, 0, 0.3), palette.lamp, gain=4.5,
                      layer=1)]
    x = float(rng.uniform(-1.2, 0.4))
    panels += cuboid((x, -rng.uniform(0.9, 1.9), deep - 0.45), (x + 0.8, 0, deep - 0.01),
                     palette.leaf, gain=0.85)
    panels += placed(_pictures(palette, rng), level_pose(0, deep, 0))
    return panels
