"""What things indoors look like: pale walls and tiles, paper, books, posters, wood, keys."""

from __future__ import annotations

import cv2
from djet_ros.lab.scenes.texture import fractal, make_texture, soft, Texture
import numpy as np


def pale(rng: np.random.Generator, tone: float, stains: float = 0.6) -> Texture:
    """Painted wall: one tone with the faintest of stains."""
    shape = (256, 256)
    return make_texture(tone + stains * (fractal(rng, shape, 0.6) + fractal(rng, shape, 1.6)),
                        (3.0, 3.0))


def panelled(rng: np.random.Generator, tone: float, height: float) -> Texture:
    """Wall of pale boards of 1 m by half the height, all alike, with thin seams; darker below."""
    shape = (1024, 1024)
    image = tone + 0.5 * fractal(rng, shape, 0.5) + 1.2 * fractal(rng, shape, 1.7)
    image += np.linspace(8, -16, shape[0])[:, None]
    for x in (0, 341, 683):
        image[:, x:x + 3] -= 26
    for y in (0, 512):
        image[y:y + 4] -= 22
    return make_texture(np.asarray(image, np.float32), (3.0, height))


def tiles(rng: np.random.Generator, tone: float, side: float) -> Texture:
    """Floor of eight by eight square tiles, ``side`` metres wide, that hardly differ."""
    shape, count = (1024, 1024), 8
    each = rng.normal(0, 1.2, (count, count)).astype(np.float32)
    image = tone + cv2.resize(each, shape, interpolation=cv2.INTER_NEAREST)
    image += 0.7 * fractal(rng, shape, 0.4) + 1.0 * fractal(rng, shape, 1.5)
    joint = np.arange(shape[0]) % (shape[0] // count) < 2
    image[joint] -= 55
    image[:, joint] -= 55
    return make_texture(np.asarray(image, np.float32), (side * count, side * count))


def ceiling(rng: np.random.Generator) -> Texture:
    """Boards of 0.6 m in a metal grid, with small holes."""
    shape, metres = (512, 512), (2.4, 2.4)
    image = 196 + 1.5 * fractal(rng, shape, 0.5)
    holes = rng.uniform(0, 512, (900, 2)).astype(int)
    image[holes[:, 1], holes[:, 0]] -= 22
    line = np.arange(512) % 128 < 3
    image[line] += 26
    image[:, line] += 26
    return make_texture(np.asarray(image, np.float32), metres)


def flat(tone: float) -> Texture:
    """One tone without anything: paint, metal, a lamp."""
    return make_texture(np.full((4, 4), tone, np.float32), (1.0, 1.0))


def painting(rng: np.random.Generator) -> Texture:
    """Soft picture of a few shapes."""
    image = rng.uniform(110, 190) + 30 * fractal(rng, (256, 256), 1.6)
    image = np.asarray(image + 6 * fractal(rng, (256, 256), 0.8), np.float32)
    for _ in range(7):
        centre = tuple(int(c) for c in rng.integers(0, 256, 2))
        axes = tuple(int(c) for c in rng.integers(8, 60, 2))
        cv2.ellipse(image, centre, axes, float(rng.uniform(0, 180)), 0, 360,
                    float(rng.uniform(60, 230)), -1)
    return make_texture(soft(image), (1.0, 1.0))


def page(rng: np.random.Generator) -> Texture:
    """Sheet of paper: a headline, lines of words, perhaps a figure."""
    image = np.full((512, 512), 226, np.float32)
    for row, y in enumerate(range(40, 480, 17)):
        x = 36
        end = rng.uniform(300, 480)
        while x < end:
            word = int(rng.integers(8, 44))
            cv2.rectangle(image, (x, y), (x + word, y + (12 if row == 0 else 6)),
                          float(rng.uniform(40, 110)), -1)
            x += word + 8
    if rng.random() < 0.6:
        left, top = (int(c) for c in rng.integers(60, 260, 2))
        figure = 150 + 35 * fractal(rng, (256, 256), 1.2)
        image[top:top + 130, left:left + 170] = figure[:130, :170]
    return make_texture(soft(image), (1.0, 1.0))


def books(rng: np.random.Generator) -> Texture:
    """Row of books seen from their spines, 1 m wide and as high as the shelf."""
    image = np.full((256, 1024), 25, np.float32)
    x = 0
    while x < 1010:
        width, top = int(rng.integers(14, 52)), int(rng.integers(4, 70))
        tone = rng.uniform(40, 220)
        cv2.rectangle(image, (x, top), (x + width - 2, 255), float(tone), -1)
        ink = float(tone - 90 if tone > 130 else tone + 90)
        for y in rng.integers(top + 10, 240, int(rng.integers(1, 4))).tolist():
            lower = y + int(rng.integers(3, 30))
            cv2.rectangle(image, (x + 4, y), (x + width - 6, lower), ink, -1)
        x += width
    return make_texture(soft(image + 3 * fractal(rng, (256, 1024), 0.6)), (1.0, 0.3))


def wood(rng: np.random.Generator, tone: float) -> Texture:
    """Boards with a grain."""
    grain = cv2.resize(fractal(rng, (512, 64), 0.9), (512, 512), interpolation=cv2.INTER_CUBIC)
    return make_texture(np.asarray(tone + 13 * grain + 4 * fractal(rng, (512, 512), 0.7),
                                   np.float32), (1.5, 0.8))


def fabric(rng: np.random.Generator, tone: float) -> Texture:
    """Carpet or cloth: noise at all scales."""
    shape = (512, 512)
    return make_texture(tone + 14 * fractal(rng, shape, 0.35) + 9 * fractal(rng, shape, 1.4),
                        (2.0, 2.0))


def keyboard(rng: np.random.Generator) -> Texture:
    """Rows of keys with their signs."""
    image = np.full((128, 512), 28, np.float32)
    for y in range(6, 118, 19):
        x = 6
        while x < 490:
            width = int(rng.choice([26, 26, 26, 26, 40, 60]))
            cv2.rectangle(image, (x, y), (min(x + width, 506), y + 14), 62.0, -1)
            sign = (x + 5 + int(rng.integers(3, 8)), y + 3 + int(rng.integers(2, 7)))
            cv2.rectangle(image, (x + 5, y + 3), sign, 190.0, -1)
            x += width + 5
    return make_texture(soft(image), (0.45, 0.15))


def screen(rng: np.random.Generator) -> Texture:
    """Monitor with windows full of lines."""
    image = 70 + 12 * fractal(rng, (512, 512), 1.5)
    image = np.asarray(image, np.float32)
    for _ in range(4):
        left, top = (int(c) for c in rng.integers(0, 300, 2))
        width, height = (int(c) for c in rng.integers(130, 210, 2))
        tone = float(rng.choice([30.0, 235.0]))
        cv2.rectangle(image, (left, top), (left + width, top + height), tone, -1)
        cv2.rectangle(image, (left, top), (left + width, top + 12), 120.0, -1)
        for y in range(top + 22, top + height - 8, 11):
            indent = int(rng.integers(6, 50))
            cv2.line(image, (left + indent, y), (left + int(rng.integers(60, width)), y),
                     150.0, 3)
    return make_texture(soft(image), (1.0, 1.0))


def carton(rng: np.random.Generator, tone: float) -> Texture:
    """Cardboard or a tin with a label and some print."""
    image = np.asarray(tone + 7 * fractal(rng, (256, 256), 1.2), np.float32)
    left, top = (int(c) for c in rng.integers(10, 110, 2))
    cv2.rectangle(image, (left, top), (left + 120, top + 90), float(rng.uniform(20, 240)), -1)
    for _ in range(22):
        x, y = (int(c) for c in rng.integers(4, 240, 2))
        cv2.rectangle(image, (x, y), (x + int(rng.integers(4, 40)), y + int(rng.integers(3, 12))),
                      float(rng.uniform(15, 245)), -1)
    return make_texture(soft(image), (0.35, 0.35))
