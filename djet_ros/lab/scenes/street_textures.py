"""What the things in a street look like: road, facades, foliage, cars, drawn from noise."""

from __future__ import annotations

import cv2
from djet_ros.core.types import Array
from djet_ros.lab.scenes.texture import fractal, Gray, make_texture, soft, Texture
import numpy as np

ROAD_WIDTH = 14.4
HALF_LANE = 5.0


def road(rng: np.random.Generator) -> Texture:
    """Asphalt with worn wheel tracks, cracks, patches, edge lines, kerbs and paved sidewalks."""
    shape, metres = (1024, 1024), (ROAD_WIDTH, 12.0)
    image = 105 + 16 * fractal(rng, shape, 0.45) + 12 * fractal(rng, shape, 1.4)
    _scatter(image, rng, 90, (0.1, 0.5), (-25, 25), metres)
    _cracks(image, rng, 16)
    texels = shape[1] / metres[0]
    x = (np.arange(shape[1]) + 0.5) / texels - metres[0] / 2
    image += 8 * np.cos(2 * np.pi * (x - 1.4) / 1.6) * (np.abs(x) < 3)
    _edge_lines(image, rng, x, metres)
    walk = 150 + 14 * fractal(rng, shape, 0.8) + _paving(rng, shape, metres)
    beyond_lane = np.abs(x) > HALF_LANE
    image[:, beyond_lane] = walk[:, beyond_lane]
    image[:, np.abs(np.abs(x) - HALF_LANE) < 0.1] += 45
    image[:, np.abs(np.abs(x) - HALF_LANE + 0.2) < 0.1] -= 45
    image -= 55 * _shade(fractal(rng, shape, 1.6))
    return make_texture(soft(image), metres)


def _edge_lines(image: Gray, rng: np.random.Generator, x: Gray,
                metres: tuple[float, float]) -> None:
    """Paint dashed middle line and the dashed borders of the parking lanes, worn."""
    z = (np.arange(image.shape[0]) + 0.5) * metres[1] / image.shape[0]
    dashes = (z % 6 < 3)[:, None] & (np.abs(x) < 0.07)
    parking = (z % 6 < 0.12)[:, None] & (np.abs(np.abs(x) - 4.0) < 0.9)
    border = np.broadcast_to(np.abs(np.abs(x) - 3.0) < 0.06, image.shape)
    worn = fractal(rng, (image.shape[0], image.shape[1]), 0.8) > -0.7
    image[(dashes | parking | border) & worn] += 85


def _paving(rng: np.random.Generator, shape: tuple[int, int],
            metres: tuple[float, float]) -> Gray:
    """Slabs of 0.4 m by 0.4 m, each of its own brightness, with dark joints."""
    rows, columns = round(metres[1] / 0.4), round(metres[0] / 0.4)
    tone = rng.normal(0, 14, (rows, columns)).astype(np.float32)
    image = np.asarray(cv2.resize(tone, shape[::-1], interpolation=cv2.INTER_NEAREST), np.float32)
    for axis, count in ((0, rows), (1, columns)):
        place = np.arange(shape[axis]) * count / shape[axis] % 1
        joint = np.where(place < 0.06, -45, 0).astype(np.float32)
        image += joint[:, None] if axis == 0 else joint[None]
    return image


def ground(rng: np.random.Generator) -> Texture:
    """Grass and gravel beside the road."""
    shape = (1024, 1024)
    image = 88 + 26 * fractal(rng, shape, 0.7) + 16 * fractal(rng, shape, 1.6)
    _scatter(image, rng, 2500, (0.03, 0.1), (-35, 50), (16.0, 16.0))
    return make_texture(soft(image), (16.0, 16.0))


def facade(rng: np.random.Generator, storeys: int, varied: bool = True) -> Texture:
    """
    House front with ``storeys`` rows of windows, a door, a plinth and a gutter's shadow.

    Windows differ from one another (blinds, curtains, reflections) unless not ``varied``.
    """
    shape, metres = (512 if storeys < 3 else 1024, 1024), (12.0, 3.0 * storeys)
    tone = rng.uniform(140, 225)
    image = tone + 5 * fractal(rng, shape, 0.6) + 7 * fractal(rng, shape, 1.5)
    if rng.random() < 0.35:
        image += _bricks(rng, shape, metres)
    columns = int(rng.integers(4, 6)) if varied else 5
    door = int(rng.integers(columns)) if varied else -1
    for storey in range(storeys):
        for column in range(columns):
            _opening(image, rng, (column + 0.5) / columns, storey / storeys, metres,
                     door=storey == storeys - 1 and column == door, varied=varied)
    height = shape[0] / metres[1]
    image[-int(0.5 * height):] *= 0.62
    image[:int(0.35 * height)] *= np.linspace(0.45, 1.0, int(0.35 * height))[:, None]
    if varied:
        image *= 1 - 0.5 * _shade(fractal(rng, shape, 1.7) - 0.5)
    return make_texture(soft(image), metres)


def _opening(image: Gray, rng: np.random.Generator, place: float, top: float,
             metres: tuple[float, float], *, door: bool, varied: bool) -> None:
    """Draw a window or door: reveal, frame, glass with blind or reflection, sill."""
    x_scale, y_scale = image.shape[1] / metres[0], image.shape[0] / metres[1]
    width, height = (1.1, 2.2) if door else (1.15, 1.5)
    left = round(place * image.shape[1] - width / 2 * x_scale)
    upper_edge = round(top * image.shape[0] + (0.8 if door else 0.75) * y_scale)

    def box(x0: float, y0: float, x1: float, y1: float, value: float) -> None:
        corners = [(left + round(x * x_scale), upper_edge + round(y * y_scale))
                   for x, y in ((x0, y0), (x1, y1))]
        cv2.rectangle(image, corners[0], corners[1], float(value), -1)

    random = rng if varied else np.random.default_rng(5)
    box(-0.12, -0.12, width + 0.12, height + 0.1, random.uniform(90, 245))
    box(0, 0, width, height, random.uniform(190, 250) if not door else 60)
    panes = 1 if door else 2
    for pane in range(panes):
        x0, x1 = (0.07 + pane * width / panes, (pane + 1) * width / panes - 0.07)
        box(x0, 0.07, x1, height - 0.07, random.uniform(20, 75))
        blind = random.uniform(-0.6, 0.8) * height
        if blind > 0.1 and not door:
            box(x0, 0.07, x1, blind, random.uniform(110, 210))
        box(x0, height * 0.62, x0 + random.uniform(0.1, 0.4), height * 0.8,
            random.uniform(60, 150))
    if not door:
        box(-0.2, height, width + 0.2, height + 0.09, 235)
        box(-0.2, height + 0.1, width + 0.2, height + 0.2, 70)


def _bricks(rng: np.random.Generator, shape: tuple[int, int],
            metres: tuple[float, float]) -> Gray:
    """Courses of bricks 25 cm by 8 cm, every second one shifted by half."""
    rows, columns = round(metres[1] / 0.083), round(metres[0] / 0.25)
    y = np.arange(shape[0]) * rows / shape[0]
    x = np.arange(shape[1]) * columns / shape[1]
    shifted = x[None] + 0.5 * (y[:, None].astype(int) % 2)
    tone = rng.normal(-40, 14, (rows, columns))
    image = tone[y[:, None].astype(int), shifted.astype(int) % columns]
    image[(shifted % 1 < 0.06) | (y[:, None] % 1 < 0.16)] = 5
    return np.asarray(image, np.float32)


def roof(rng: np.random.Generator) -> Texture:
    """Rows of tiles."""
    shape, metres = (512, 512), (6.0, 6.0)
    y = np.linspace(0, 20, shape[0], endpoint=False) % 1
    x = np.linspace(0, 28, shape[1], endpoint=False) % 1
    relief = 22 * y[:, None] + 14 * np.sin(2 * np.pi * x)[None]
    tiles = cv2.resize(rng.normal(0, 12, (20, 28)).astype(np.float32), (512, 512),
                       interpolation=cv2.INTER_NEAREST)
    image = 78 + relief + tiles + 8 * fractal(rng, shape, 1.2)
    return make_texture(soft(np.asarray(image, np.float32)), metres)


def tree(rng: np.random.Generator) -> Texture:
    """Crown of leaves over a trunk with branches, seen from the side; the rest is open."""
    shape, metres = (512, 512), (6.0, 7.0)
    image = np.full(shape, 60, np.float32)
    solid = np.zeros(shape, np.float32)
    _trunk(image, solid, rng)
    lumps = rng.normal((256, 190), (70, 55), (26, 2))
    lumps = lumps[np.hypot((lumps[:, 0] - 256) / 190, (lumps[:, 1] - 190) / 165) < 0.85]
    for depth in np.linspace(0, 1, 9):
        for centre in lumps:
            leaves = rng.normal(centre, 26, (30, 2))
            _leaves(image, solid, rng, leaves, 45 + 85 * depth, (2, 6))
    return make_texture(soft(image + 5 * fractal(rng, shape, 0.7)), metres, soft(solid))


def _trunk(image: Gray, solid: Gray, rng: np.random.Generator) -> None:
    bark = 62 + 26 * fractal(rng, (512, 512), 0.6)
    mask = np.zeros(image.shape, np.uint8)
    cv2.line(mask, (256, 511), (256, 230), 1, 22)
    for tip in rng.uniform((90, 60), (420, 230), (9, 2)):
        start = (256, int(rng.uniform(230, 330)))
        cv2.line(mask, start, (int(tip[0]), int(tip[1])), 1, int(rng.integers(4, 9)))
    image[mask > 0] = bark[mask > 0]
    solid[mask > 0] = 255


def hedge(rng: np.random.Generator) -> Texture:
    """Dense leaves without gaps."""
    shape, metres = (256, 1024), (6.0, 1.5)
    image = np.full(shape, 40, np.float32)
    cover = np.empty(shape, np.float32)
    for depth in np.linspace(0, 1, 6):
        places = rng.uniform((0, 0), (1024, 256), (900, 2))
        _leaves(image, cover, rng, places, 30 + 90 * depth, (3, 8))
    return make_texture(soft(image + 6 * fractal(rng, shape, 0.7)), metres)


def fence(rng: np.random.Generator) -> Texture:
    """Wooden pickets on two rails."""
    shape, metres = (256, 512), (3.0, 1.2)
    image = rng.uniform(120, 215) + 14 * fractal(rng, shape, 0.8)
    solid = np.zeros(shape, np.float32)
    for picket in range(20):
        left = round((picket + 0.15) * 512 / 20)
        image[:, left:left + 18] += rng.normal(0, 14)
        solid[int(rng.uniform(0, 18)):, left:left + 18] = 255
    for rail in (60, 190):
        solid[rail:rail + 20] = 255
        image[rail:rail + 20] -= 35
    return make_texture(soft(image), metres, soft(solid))


def car_side(rng: np.random.Generator, profile: Array, metres: tuple[float, float],
             paint: float) -> Texture:
    """Side of a car with the outline ``profile`` (N, 2) in metres from the rear bottom corner."""
    shape = (256, 512)
    scale = np.array([shape[1] / metres[0], shape[0] / metres[1]])
    outline = ((profile * (1, -1) + (0, metres[1])) * scale).astype(np.int32)
    solid = np.zeros(shape, np.float32)
    cv2.fillPoly(solid, [outline], 255)
    image = paint + 5 * fractal(rng, shape, 1.2) + np.linspace(25, -25, shape[0])[:, None]
    image = np.asarray(image, np.float32)
    glass = np.array([(0.75, 0.86), (1.15, 1.3), (2.35, 1.3), (2.95, 0.86)])
    corners = ((glass * (1, -1) + (0, metres[1])) * scale).astype(np.int32)
    cv2.fillPoly(image, [corners], 38)
    for x in (1.3, 2.05):
        cv2.line(image, _pixel((x, 1.3), metres, scale), _pixel((x, 0.35), metres, scale),
                 paint * 0.55, 3)
    for x in (0.8, 3.3):
        wheel = _pixel((x, 0.31), metres, scale)
        for radius, value in ((0.36, 18), (0.31, 30), (0.2, 165), (0.06, 60)):
            axes = (int(radius * scale[0]), int(radius * scale[1]))
            cv2.ellipse(image, wheel, axes, 0, 0, 360, value, -1)
            cv2.ellipse(solid, wheel, axes, 0, 0, 360, 255, -1)
    return make_texture(soft(image), metres, soft(solid))


def _pixel(place: tuple[float, float], metres: tuple[float, float],
           scale: Array) -> tuple[int, int]:
    return int(place[0] * scale[0]), int((metres[1] - place[1]) * scale[1])


def plain(rng: np.random.Generator, tone: float, roughness: float) -> Texture:
    """Surface of one tone with 1/f stains."""
    image = tone + roughness * (fractal(rng, (256, 256), 0.8) + fractal(rng, (256, 256), 1.6))
    return make_texture(soft(image), (4.0, 4.0))


def car_end(rng: np.random.Generator, paint: float) -> Texture:
    """Tail or nose of a car: lamps, number plate, bumper."""
    shape = (128, 256)
    image = np.asarray(paint + 5 * fractal(rng, shape, 1.2), np.float32)
    image[90:] = 45
    for left in (8, 204):
        cv2.rectangle(image, (left, 25), (left + 44, 60), 215, -1)
        cv2.rectangle(image, (left + 6, 33), (left + 30, 52), 90, -1)
    cv2.rectangle(image, (92, 60), (164, 82), 240, -1)
    for x in range(98, 158, 10):
        cv2.line(image, (x, 65), (x + int(rng.integers(-4, 5)), 77), 30, 3)
    return make_texture(soft(image), (1.7, 0.6))


def shadow(rng: np.random.Generator) -> Texture:
    """Dark patch with a ragged outline, as under a car."""
    shape = (128, 64)
    y, x = (np.linspace(-1, 1, n) for n in shape)
    edge = 1 - (y ** 6)[:, None] - (x ** 6)[None]
    solid = np.clip(127 + 500 * edge + 40 * fractal(rng, shape, 1.0), 0, 255)
    image = 24 + 4 * fractal(rng, shape, 0.8)
    return make_texture(image, (2.3, 4.8), np.asarray(solid, np.float32))


def lettering(rng: np.random.Generator, columns: int) -> Texture:
    """Wall of a lorry: dirt, ribs and rows of big strokes."""
    shape, metres = (512, 512 if columns < 4 else 1024), (1.2 * columns, 2.8)
    image = np.asarray(190 + 10 * fractal(rng, shape, 0.8) + 8 * fractal(rng, shape, 1.6))
    image[:, ::shape[1] // (4 * columns)] -= 45
    for _ in range(50 * columns):
        start = rng.uniform((0, 60), (shape[1], 450))
        stop = start + rng.normal(0, 25, 2)
        cv2.line(image, (int(start[0]), int(start[1])), (int(stop[0]), int(stop[1])),
                 float(rng.choice([20.0, 70.0, 130.0, 250.0])), int(rng.integers(2, 9)))
    return make_texture(soft(image), metres)


def sky(rng: np.random.Generator) -> Texture:
    """Thin clouds."""
    image = 205 + 12 * fractal(rng, (256, 256), 1.9)
    return make_texture(soft(image), (3000.0, 3000.0))


def treeline(rng: np.random.Generator) -> Texture:
    """Row of distant trees with an uneven upper edge."""
    shape, metres = (256, 1024), (60.0, 14.0)
    image = 70 + 20 * fractal(rng, shape, 0.8) + 14 * fractal(rng, shape, 1.5)
    edge = 70 + 28 * fractal(rng, (4, 1024), 1.0)[:1]
    solid = np.clip((np.arange(256)[:, None] - edge) * 60 + 127 + 60 * fractal(rng, shape, 0.9),
                    0, 255)
    return make_texture(soft(image), metres, np.asarray(solid, np.float32))


def _leaves(image: Gray, solid: Gray, rng: np.random.Generator, places: Array, tone: float,
            radii: tuple[int, int]) -> None:
    """Draw elliptic leaves over what is there."""
    for (x, y), shade in zip(places, rng.normal(tone, 26, len(places))):
        axes = (int(rng.integers(*radii)), int(rng.integers(2, 5)))
        angle = float(rng.uniform(0, 180))
        centre = (int(x), int(y))
        cv2.ellipse(image, centre, axes, angle, 0, 360, float(shade), -1)
        cv2.ellipse(solid, centre, axes, angle, 0, 360, 255.0, -1)


def _scatter(image: Gray, rng: np.random.Generator, count: int, sizes: tuple[float, float],
             tones: tuple[float, float], metres: tuple[float, float]) -> None:
    """Add pebbles and patches: ellipses of ``sizes`` metres, lighter or darker by ``tones``."""
    change = np.zeros_like(image)
    texels = image.shape[1] / metres[0]
    for x, y in rng.uniform((0, 0), image.shape[::-1], (count, 2)):
        axes = tuple(max(1, int(a * texels / 2)) for a in rng.uniform(*sizes, 2))
        cv2.ellipse(change, (int(x), int(y)), axes, float(rng.uniform(0, 180)), 0, 360,
                    float(rng.uniform(*tones)), -1)
    image += change


def _cracks(image: Gray, rng: np.random.Generator, count: int) -> None:
    """Draw dark random walks, as filled with tar."""
    for _ in range(count):
        heading = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0, 0.35, 40))
        steps = 9 * np.stack([np.cos(heading), np.sin(heading)], axis=1)
        walk = rng.uniform(0, image.shape[1], 2) + np.cumsum(steps, axis=0)
        cv2.polylines(image, [walk.astype(np.int32)], False, 55.0, int(rng.integers(1, 5)))


def _shade(noise: Gray) -> Gray:
    """Dappled shadow, 0 to 1 with soft edges, where the noise is high."""
    return np.asarray(np.clip((noise - 0.35) * 4, 0, 1), np.float32)
