"""
Textures that can be looked up at any scale without aliasing, and the noise they are made of.

A texture is kept prefiltered along each of its two axes separately (a "ripmap"): a road or a
facade seen at a grazing angle is compressed along one axis only, and filtering both alike would
blur it away.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
import scipy.fft

Gray = NDArray[np.float32]
Kind = TypeVar('Kind')

# cv2.remap takes no destination wider than a signed 16-bit integer.
_LONGEST_ROW = 32_000


class RipMap:
    """
    A periodic image with all its half-resolution versions, axis by axis.

    image: (H, W), values 0 to 255, H and W powers of two. Versions lie in one atlas, each with
    a wrapped border of one texel, so that a single bilinear look-up serves any mixture of levels.
    """

    def __init__(self, image: Gray) -> None:
        for length in image.shape:
            if length & (length - 1):
                raise ValueError(f'texture side is {length}; it must be a power of two')
        self._sizes = tuple(_level_sizes(length) for length in image.shape)
        self._starts = tuple(_level_starts(sizes) for sizes in self._sizes)
        # one below the other, so that all are halved along their rows at once
        rows = np.concatenate([np.pad(level, ((1, 1), (0, 0)), mode='wrap')
                               for level in _halvings(image.astype(np.float32), axis=0)])
        self._atlas = np.concatenate([
            np.pad(np.clip(np.rint(level), 0, 255).astype(np.uint8), ((0, 0), (1, 1)), mode='wrap')
            for level in _halvings(rows, axis=1)], axis=1)

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of the finest version in texels."""
        return int(self._sizes[0][0]), int(self._sizes[1][0])

    def sample(self, u: Gray, v: Gray, level_u: Gray, level_v: Gray) -> Gray:
        """
        Look up points (N,), blending linearly between texels and between levels.

        u, v: position along width and height in periods (texel i has its centre at
        (i + 0.5) / size); level_u, level_v: binary logarithm of the texels between samples.
        """
        columns = self._neighbours(u, level_u, axis=1)
        rows = self._neighbours(v, level_v, axis=0)
        value = np.zeros(len(u), np.float32)
        for x, weight_x in columns:
            for y, weight_y in rows:
                value += _bilinear(self._atlas, x, y) * (weight_x * weight_y)
        return value

    def _neighbours(self, position: Gray, level: Gray, axis: int) -> list[tuple[Gray, Gray]]:
        """Atlas coordinates in the two levels around the wanted ones, with blending weights."""
        sizes, offsets = self._sizes[axis], self._starts[axis] - np.float32(0.5)
        level = np.clip(level, 0.0, len(sizes) - 1)
        fine = level.astype(np.intp)
        blend = level - fine.astype(np.float32)
        fraction = position - np.floor(position)
        near = fraction * sizes.take(fine) + offsets.take(fine)
        if not blend.any():
            return [(near, np.ones_like(blend))]
        coarse = np.minimum(fine + 1, len(sizes) - 1)
        return [(near, 1 - blend), (fraction * sizes.take(coarse) + offsets.take(coarse), blend)]


@dataclass(frozen=True)
class Texture:
    """Brightness and, where it has holes, opacity (over 127.5 is solid), and its size."""

    brightness: RipMap
    metres: tuple[float, float]
    opacity: RipMap | None = None


def make_texture(image: Gray, metres: tuple[float, float],
                 opacity: Gray | None = None) -> Texture:
    """Texture from images (H, W) of 0 to 255; metres: (width, height) of one period."""
    return Texture(RipMap(image), metres, None if opacity is None else RipMap(opacity))


def soft(image: NDArray[np.floating[Any]]) -> Gray:
    """Limit the bandwidth of drawn edges (H, W) to what texels can carry."""
    return np.asarray(cv2.GaussianBlur(np.asarray(image, np.float32), (0, 0), 0.7), np.float32)


def one_of(kinds: Sequence[Kind], rng: np.random.Generator) -> Kind:
    """Draw one of several kinds of a thing, mostly textures."""
    return kinds[int(rng.integers(len(kinds)))]


def fractal(rng: np.random.Generator, shape: tuple[int, int], slope: float,
            coarsest: float = 0.0) -> Gray:
    """
    Periodic 1/f^slope noise (H, W) with zero mean and unit deviation.

    Frequencies near the sampling limit are damped, so that magnified texels do not show;
    those below ``coarsest`` cycles per texel are cut.
    """
    gain = _gain(shape, slope, coarsest)
    spectrum = rng.standard_normal((*gain.shape, 2), np.float32).view(np.complex64)[..., 0]
    noise = scipy.fft.irfft2(spectrum * gain, s=shape)
    return np.asarray(noise / noise.std(), np.float32)


@lru_cache(maxsize=16)
def _gain(shape: tuple[int, int], slope: float, coarsest: float) -> Gray:
    """Amplitudes (H, W / 2 + 1) of the frequencies of such noise, of which scenes draw many."""
    height, width = shape
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None])
    frequency = np.asarray(frequency, np.float32)
    frequency[0, 0] = np.inf
    gain = frequency ** -slope * np.exp(-(frequency / 0.33) ** 4)
    gain[frequency < coarsest] = 0.0
    return np.asarray(gain)


def _level_sizes(length: int) -> Gray:
    return np.array([length >> k for k in range(length.bit_length())], np.float32)


def _level_starts(sizes: Gray) -> Gray:
    return np.concatenate([[0], np.cumsum(sizes + 2)[:-1]]).astype(np.float32) + 1


def _halvings(image: Gray, axis: int) -> list[Gray]:
    """Halve along an axis again and again with the binomial filter 1 3 3 1, down to one texel."""
    levels = [image]
    while levels[-1].shape[axis] > 1:
        texels = np.moveaxis(levels[-1], axis, 0)
        even, odd = texels[0::2], texels[1::2]
        outer = np.roll(odd, 1, axis=0) + np.roll(even, -1, axis=0)
        halved = np.asarray((3 * (even + odd) + outer) / 8, np.float32)
        levels.append(np.moveaxis(halved, 0, axis))
    return levels


def _bilinear(image: NDArray[np.uint8], x: Gray, y: Gray) -> Gray:
    value = np.empty(len(x), np.float32)
    for k in range(0, len(x), _LONGEST_ROW):
        part = slice(k, k + _LONGEST_ROW)
        looked_up = cv2.remap(image, x[None, part], y[None, part], cv2.INTER_LINEAR)
        value[part] = looked_up[0]
    return value
