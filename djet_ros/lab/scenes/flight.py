"""A drone over flat fields: all that it sees is one plane."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from djet_ros.core.types import Array
from djet_ros.lab.scenes import street_textures as paint
from djet_ros.lab.scenes.panel import Panel, tiled
from djet_ros.lab.scenes.route import pose_at
from djet_ros.lab.scenes.texture import fractal, Gray, make_texture, one_of, Texture
import numpy as np
from scipy.ndimage import gaussian_filter1d

_FIELD = 24.0
_FIELDS = 24
# Frames over which the drone changes its mind: standard deviation of the smoothing of its speed
# and of its rates of rotation.
_STEADINESS = 6.0


def fields(rng: np.random.Generator) -> tuple[Panel, ...]:
    """Square fields of grass, earth and crops, in all 580 m by 580 m, the first in the middle."""
    kinds = [paint.ground(rng), _earth(rng), _crop(rng), _earth(rng), _crop(rng)]
    start = -_FIELDS * _FIELD / 2
    return tuple(
        tiled((start + column * _FIELD, 0, start + row * _FIELD), (_FIELD, 0, 0), (0, 0, _FIELD),
              one_of(kinds, rng), start=tuple(rng.uniform(0, 12, 2)),
              gain=rng.uniform(0.75, 1.25))
        for row in range(_FIELDS) for column in range(_FIELDS))


def _earth(rng: np.random.Generator) -> Texture:
    """Bare earth with stones and faint furrows."""
    shape, metres = (1024, 1024), (16.0, 16.0)
    furrows = np.sin(2 * np.pi * np.arange(shape[1]) / shape[1] * 32)
    image = (100 + 24 * fractal(rng, shape, 0.8) + 12 * fractal(rng, shape, 1.6)
             + 7 * furrows[None] * (1 + 0.4 * fractal(rng, shape, 1.0)))
    return make_texture(np.asarray(image, np.float32), metres)


def _crop(rng: np.random.Generator) -> Texture:
    """Rows of plants that are not quite alike."""
    shape, metres = (1024, 1024), (12.0, 12.0)
    rows = np.cos(2 * np.pi * np.arange(shape[1]) / shape[1] * 16)
    image: Gray = np.asarray(95 + 26 * fractal(rng, shape, 0.6) + 10 * fractal(rng, shape, 1.6)
                             + 18 * np.maximum(rows, 0)[None] * (1 + fractal(rng, shape, 0.5)),
                             np.float32)
    return make_texture(image, metres)


@dataclass(frozen=True)
class Flight:
    """
    A drone that flies irregularly over level ground and looks down.

    speed: m per frame, on average; height: m, at the start; tilt: mean of how far the camera looks
    down, in radians; seed: of its manoeuvres.
    """

    speed: float
    height: float
    tilt: float
    seed: int = 0
    limit: int = 200

    def pose(self, index: int) -> Array:
        """Pose (4, 4), camera to level axes."""
        yaw, pitch, roll = self._angles[index]
        return pose_at(self._places[index], yaw, pitch - self.tilt, roll)

    @cached_property
    def _angles(self) -> Array:
        """Yaw, pitch and roll (limit, 3)."""
        rates = self._smooth(1) * np.deg2rad((1.2, 0.5, 0.5))
        angles = np.cumsum(rates, axis=0)
        # It rights itself.
        angles[:, 1:] = np.deg2rad((9, 5)) * np.tanh(angles[:, 1:] / np.deg2rad((9, 5)))
        return angles

    @cached_property
    def _places(self) -> Array:
        """Places (limit, 3) in level axes."""
        horizontal = np.cumsum(self._smooth(2) * self.speed / np.sqrt(2), axis=0)[:, :2]
        # It keeps within a fifth of its height.
        most = 0.2 * self.height
        climb = most * np.tanh(np.cumsum(self._smooth(3)[:, 0]) * self.speed / (2.5 * most))
        return np.column_stack([horizontal[:, 0], -self.height - climb, horizontal[:, 1]])

    def _smooth(self, number: int) -> Array:
        """Smooth random sequences (limit, 3) of standard deviation 1."""
        noise = np.random.default_rng([self.seed, 30 + number]).standard_normal(
            (self.limit + 100, 3))
        smooth = gaussian_filter1d(noise, _STEADINESS, axis=0)[50:-50]
        return np.asarray(smooth * np.sqrt(2 * np.sqrt(np.pi) * _STEADINESS))
