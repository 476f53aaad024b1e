"""
Effects of medium, light and camera: haze, lamps, particles, blur, noise.

An effect maps a shot to its new radiance; a camera is a list of effects.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import cv2
from djet_ros.core.geometry import unit
from djet_ros.core.types import Array
from djet_ros.lab.scenes.texture import Gray
import numpy as np


@dataclass(frozen=True)
class Shot:
    """
    An image in the simulated camera.

    radiance: (H, W) gray values, not yet clipped to 0..255; inverse_depth: (H, W) in 1/m, zero at
    infinity; pose: (4, 4) camera to level axes; index: frame number; seed: of everything random.
    """

    radiance: Gray
    inverse_depth: Gray
    K: Array
    pose: Array
    index: int
    seed: int

    @cached_property
    def rays(self) -> Gray:
        """Return the viewing directions (H, W, 3) of the pixels, with z = 1."""
        height, width = self.radiance.shape
        K_inv = np.linalg.inv(self.K)
        rays = np.empty((height, width, 3), np.float32)
        rays[..., 0] = K_inv[0, 0] * np.arange(width) + K_inv[0, 2]
        rays[..., 1] = (K_inv[1, 1] * np.arange(height) + K_inv[1, 2])[:, None]
        rays[..., 2] = 1.0
        return rays


class Effect(Protocol):
    """A change of the image."""

    def __call__(self, shot: Shot) -> Gray:
        """Return the new radiance (H, W)."""


@dataclass(frozen=True)
class Haze:
    """Attenuation towards the tone ``air``; clear: attenuation length in metres (63 % lost)."""

    clear: float
    air: float

    def __call__(self, shot: Shot) -> Gray:
        """Blend with the tone of the air by depth."""
        depth = 1 / np.maximum(shot.inverse_depth, np.float32(1e-6))
        left = np.exp(-depth / np.float32(self.clear))
        return np.asarray(self.air + (shot.radiance - self.air) * left)


@dataclass(frozen=True)
class Headlight:
    """
    A lamp on a camera in murky water.

    place: (3,) position of the lamp and aim: (3,) direction of its cone, both in camera axes;
    spread: half angle of the cone in radians; power: radiance of a white surface at 1 m; ambient:
    the same of the daylight; clear: attenuation length in metres; glow: brightness of the lit
    water; sway: amplitude in radians of the aim's oscillation.
    """

    place: tuple[float, float, float]
    aim: tuple[float, float, float]
    spread: float
    power: float
    ambient: float
    clear: float
    glow: float
    sway: float = 0.0

    def __call__(self, shot: Shot) -> Gray:
        """Light the scene; the input radiance is the albedo times 255."""
        depth = 1 / np.maximum(shot.inverse_depth, np.float32(1 / 60))
        points = shot.rays * depth[..., None] - np.array(self.place, np.float32)
        distance = np.sqrt(np.einsum('ijk,ijk->ij', points, points))
        along = np.asarray(points @ self._aim(shot.index), np.float32)
        beam = self._beam(along, distance)
        lit = self.power * beam / np.maximum(distance, 1.0) ** 2
        lit *= np.exp(-distance / np.float32(self.clear))
        left = np.exp(-depth / np.float32(self.clear))
        water = (self.ambient * 0.35 + self.glow * beam) * (1 - left)
        return np.asarray(shot.radiance / 255 * (self.ambient + lit) * left + water, np.float32)

    def _aim(self, index: int) -> Gray:
        swing = self.sway * np.sin(2 * np.pi * index * np.array([0.021, 0.034, 0.0]))
        return np.asarray(unit(np.array(self.aim) + swing), np.float32)

    def _beam(self, along: Gray, distance: Gray) -> Gray:
        """Return the brightness of the cone, 1 on its axis, with a soft border."""
        cosine = np.clip(along / np.maximum(distance, np.float32(1e-3)), -1, 1)
        return np.asarray(1 / (1 + (np.arccos(cosine) / np.float32(self.spread)) ** 4))


@dataclass(frozen=True)
class MarineSnow:
    """
    Bright particles that drift in a box of water around the camera.

    count: number of particles in a cube of ``reach`` metres; drift: (3,) m per frame in level
    axes; tone: brightness of a particle at 1 m.
    """

    count: int
    reach: float
    drift: tuple[float, float, float]
    tone: float

    def __call__(self, shot: Shot) -> Gray:
        """Add the particles that are nearer than the scene."""
        pixels, depth = self._seen(shot)
        radius = np.clip(0.004 * shot.K[0, 0] / depth, 0.6, 3.0)
        light = self.tone / np.maximum(depth, 0.4) ** 1.5
        return _with_spots(shot.radiance, pixels, radius, light)

    def _seen(self, shot: Shot) -> tuple[Array, Array]:
        """Return pixels (M, 2) and depths (M,) of the visible particles."""
        rng = np.random.default_rng([shot.seed, 77])
        home = rng.uniform(0, self.reach, (self.count, 3))
        whirl = rng.normal(0, 0.004, (self.count, 3)) * np.sin(
            0.31 * shot.index + rng.uniform(0, 6, (self.count, 3)))
        place = home + shot.index * np.array(self.drift) + 6 * whirl
        relative = (place - shot.pose[:3, 3] + self.reach / 2) % self.reach - self.reach / 2
        local = relative @ shot.pose[:3, :3]
        local = local[local[:, 2] > 0.25]
        pixels = (local @ shot.K.T)[:, :2] / local[:, 2:]
        height, width = shot.radiance.shape
        nearest = np.rint(pixels).astype(int)
        inside = ((nearest >= 0) & (nearest < (width, height))).all(1)
        pixels, nearest, depth = pixels[inside], nearest[inside], local[inside, 2]
        before = depth * shot.inverse_depth[nearest[:, 1], nearest[:, 0]] < 1
        return pixels[before], depth[before]


def _with_spots(radiance: Gray, pixels: Array, radius: Array, light: Array) -> Gray:
    """Add Gaussian spots at sub-pixel positions (M, 2); sigma = radius (M,) pixels."""
    reach = 8
    offsets = np.arange(-reach, reach + 1)
    centre = np.rint(pixels).astype(int)
    x = centre[:, :1] + offsets - pixels[:, :1]
    y = centre[:, 1:] + offsets - pixels[:, 1:]
    scale = -0.5 / radius[:, None] ** 2
    spots = (light[:, None, None] * np.exp(scale * y ** 2)[:, :, None]
             * np.exp(scale * x ** 2)[:, None, :])
    padded = np.pad(radiance, reach)
    rows = centre[:, 1, None, None] + offsets[:, None] + reach
    columns = centre[:, 0, None, None] + offsets[None, :] + reach
    np.add.at(padded, (rows, columns), spots.astype(np.float32))
    return np.asarray(padded[reach:-reach, reach:-reach])


@dataclass(frozen=True)
class Defocus:
    """Gaussian blur of ``sigma`` pixels in the first ``length`` of every ``period`` frames."""

    sigma: float
    length: int
    period: int

    def __call__(self, shot: Shot) -> Gray:
        """Blur the frames of each period that are out of focus."""
        if shot.index % self.period >= self.length:
            return shot.radiance
        return np.asarray(cv2.GaussianBlur(shot.radiance, (0, 0), self.sigma), np.float32)


@dataclass(frozen=True)
class Exposure:
    """Gain that cycles through ``gains``, each for ``hold`` frames."""

    gains: tuple[float, ...]
    hold: int

    def __call__(self, shot: Shot) -> Gray:
        """Apply the gain of this frame."""
        return np.asarray(shot.radiance * self.gains[shot.index // self.hold % len(self.gains)])


@dataclass(frozen=True)
class SensorNoise:
    """Gaussian noise: ``read`` gray levels, plus ``photon`` times the root of the brightness."""

    read: float
    photon: float = 0.0

    def __call__(self, shot: Shot) -> Gray:
        """Add noise, reproducible by frame number."""
        rng = np.random.default_rng([shot.seed, 78, shot.index])
        noise = rng.standard_normal(shot.radiance.shape, np.float32)
        variance = self.read ** 2 + self.photon ** 2 * np.maximum(shot.radiance, 0)
        return np.asarray(shot.radiance + noise * np.sqrt(variance), np.float32)
