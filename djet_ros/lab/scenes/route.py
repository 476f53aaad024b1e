"""
Where cameras and cars go: curves on level ground, and poses along them, over them or on the spot.

Level axes: x right, y down, z forward along the start of the curve, the ground at y = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

from djet_ros.core.geometry import rotation_exp
from djet_ros.core.types import Array
import numpy as np

_STEP = 0.05
# Curvature is averaged over this many metres, as a steering wheel takes time to turn.
_EASING = 3.0


@dataclass(frozen=True)
class Route:
    """A curve from the origin along z; curvature: (N,) in 1/m every 5 cm, right is positive."""

    curvature: Array

    @property
    def length(self) -> float:
        """Length in metres."""
        return len(self.curvature) * _STEP

    @cached_property
    def stations(self) -> Array:
        """Arc lengths (N + 1,) of the points that define the curve."""
        return np.arange(len(self.curvature) + 1.0) * _STEP

    @cached_property
    def headings(self) -> Array:
        """Headings (N + 1,) in radians at the stations, positive to the right."""
        return np.append(0.0, np.cumsum(self.curvature) * _STEP)

    @cached_property
    def points(self) -> Array:
        """Points (N + 1, 2) as (x, z) at the stations."""
        middle = (self.headings[:-1] + self.headings[1:]) / 2
        steps = np.stack([np.sin(middle), np.cos(middle)], axis=1) * _STEP
        return np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])

    def at(self, s: Array, offset: Array | float = 0.0) -> tuple[Array, Array]:
        """Points (M, 2) ``offset`` metres right of arc lengths s (M,), and headings (M,)."""
        heading = np.interp(s, self.stations, self.headings)
        x, z = (np.interp(s, self.stations, column) for column in self.points.T)
        right = np.stack([np.cos(heading), -np.sin(heading)], axis=-1)
        return np.stack([x, z], axis=-1) + right * np.asarray(offset)[..., None], heading

    def distance(self, points: Array) -> Array:
        """Distances (M,) of points (M, 2) to the curve, to a quarter of a metre or better."""
        coarse = self.points[::10]
        gap = np.linalg.norm(points[:, None] - coarse[None], axis=2)
        return np.asarray(gap.min(axis=1))


def route_of(pieces: Sequence[tuple[float, float]]) -> Route:
    """Join (length in m, curvature in 1/m) pieces, easing from one to the next."""
    steps = [np.full(round(length / _STEP), curvature) for length, curvature in pieces]
    window = round(_EASING / _STEP)
    padded = np.pad(np.concatenate(steps), (window // 2, window - 1 - window // 2), mode='edge')
    return Route(np.convolve(padded, np.full(window, 1 / window), mode='valid'))


def winding(length: float, swing: float, periods: Sequence[float]) -> Route:
    """Road of mild curves, its heading swinging by ``swing`` radians over each period in m."""
    s = np.arange(0.0, length, _STEP)
    turn = sum(np.sin(2 * np.pi * s / period) * 2 * np.pi / period for period in periods)
    return Route(np.asarray(swing * turn))


def level_pose(x: float, z: float, heading: float, height: float = 0.0) -> Array:
    """Pose (4, 4) at (x, z), ``height`` metres over the ground, looking along the heading."""
    pose = np.eye(4)
    pose[:3, :3] = rotation_exp(np.array([0.0, heading, 0.0]))
    pose[:3, 3] = x, -height, z
    return pose


def pose_at(place: Sequence[float] | Array, yaw: float, pitch: float, roll: float) -> Array:
    """Pose (4, 4) at a place (3,), turned by yaw, pitch and roll in radians in that order."""
    pose = np.eye(4)
    pose[:3, :3] = (rotation_exp(np.array([0.0, yaw, 0.0]))
                    @ rotation_exp(np.array([pitch, 0.0, 0.0]))
                    @ rotation_exp(np.array([0.0, 0.0, roll])))
    pose[:3, 3] = place
    return pose


class Trajectory(Protocol):
    """Camera poses in level axes, frame by frame."""

    @property
    def limit(self) -> int:
        """Return the maximum number of frames."""

    def pose(self, index: int) -> Array:
        """Pose (4, 4), camera to level axes, of one frame."""


@dataclass(frozen=True)
class Drive:
    """
    A car that follows a route.

    speed: m per frame; turning: at most so many radians per frame, so it brakes in sharp curves;
    lane: metres to the right of the route; height: of the camera; shake: of the body, 1 is normal.
    """

    route: Route
    speed: float
    turning: float = np.deg2rad(2.5)
    lane: float = 0.0
    height: float = 1.65
    shake: float = 1.0

    @cached_property
    def _frames(self) -> Array:
        """Return the (fractional) frames at which the car passes each station but the first."""
        curvature = np.maximum(np.abs(self.route.curvature), 1e-9)
        return np.cumsum(_STEP / np.minimum(self.speed, self.turning / curvature))

    @property
    def limit(self) -> int:
        """Frames until the end of the route."""
        return int(self._frames[-1]) + 1

    def station(self, index: int) -> float:
        """Arc length at a frame."""
        return float(np.interp(index, np.append(0.0, self._frames), self.route.stations))

    def pose(self, index: int) -> Array:
        """Pose (4, 4), camera to level axes."""
        (x, z), heading = self.route.at(np.asarray(self.station(index)), self.lane)
        pitch, roll, bounce = (
            self.shake * size * np.sin(2 * np.pi * pace * index)
            for size, pace in ((np.deg2rad(0.15), 0.13), (np.deg2rad(0.1), 0.083), (0.012, 0.21)))
        pose = level_pose(float(x), float(z), float(heading), self.height + bounce)
        pose[:3, :3] = pose[:3, :3] @ rotation_exp(np.array([pitch, 0.0, roll]))
        return pose


@dataclass(frozen=True)
class Turntable:
    """A camera at a fixed place (x, z) that turns by ``rate`` radians per frame, or stands."""

    place: tuple[float, float]
    heading: float
    rate: float = 0.0
    height: float = 1.65
    limit: int = 100_000

    def pose(self, index: int) -> Array:
        """Pose (4, 4), camera to level axes."""
        return level_pose(*self.place, self.heading + self.rate * index, self.height)


@dataclass(frozen=True)
class Dive:
    """
    An underwater vehicle over a route, its camera tilted down, swaying with the waves.

    speed: m per frame; height over the mean floor in m; tilt in radians.
    """

    route: Route
    speed: float
    height: float
    tilt: float

    @property
    def limit(self) -> int:
        """Frames until the end of the route."""
        return int(self.route.length / self.speed) + 1

    def pose(self, index: int) -> Array:
        """Pose (4, 4), camera to level axes."""
        phase = 2 * np.pi * index * np.array([0.011, 0.017, 0.007, 0.013])
        sideways, heave, pitch, roll = np.sin(phase) * (0.3, 0.2, 0.06, 0.07)
        (x, z), heading = self.route.at(np.asarray(index * self.speed), sideways)
        pose = level_pose(float(x), float(z), float(heading), self.height + heave)
        tilt = rotation_exp(np.array([-self.tilt - pitch, 0.0, 0.0]))
        pose[:3, :3] = pose[:3, :3] @ tilt @ rotation_exp(np.array([0.0, 0.0, roll]))
        return pose
