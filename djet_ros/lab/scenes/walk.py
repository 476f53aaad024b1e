"""How people carry cameras: walking along a route, with a jerky hand, and to and fro at speed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from djet_ros.core.geometry import rotation_exp
from djet_ros.core.types import Array
from djet_ros.lab.scenes.route import Drive, level_pose, pose_at, Route
import numpy as np
from scipy.spatial.transform import Rotation

_PITCH, _YAW, _ROLL = np.eye(3)


@dataclass(frozen=True)
class Walk:
    """
    A camera that somebody carries along a route, bobbing with the steps and looking about.

    speed: m per frame; height: of the camera in m; tilt: how far it looks down, and glance: how
    far to the sides and up and down, in radians; seed: of the moments at which it does.
    """

    route: Route
    speed: float
    height: float
    tilt: float
    glance: float
    seed: int = 0

    @property
    def limit(self) -> int:
        """Frames until the end of the route."""
        return self._drive.limit

    def pose(self, index: int) -> Array:
        """Pose (4, 4), camera to level axes."""
        step = 2 * np.pi * 0.19 * index
        (x, z), heading = self.route.at(np.asarray(self._drive.station(index)),
                                        0.02 * np.sin(step / 2))
        pose = level_pose(float(x), float(z), float(heading), self.height + 0.02 * np.sin(step))
        yaw, pitch, roll = self.glance * np.sin(self._phases + index * self._paces) @ (
            (1.0, 0, 0), (0, 0.7, 0), (0, 0, 0.4))
        pose[:3, :3] = pose[:3, :3] @ rotation_exp(yaw * _YAW) @ rotation_exp(
            (-self.tilt + pitch + 0.004 * np.sin(step)) * _PITCH) @ rotation_exp(roll * _ROLL)
        return pose

    @cached_property
    def _drive(self) -> Drive:
        return Drive(self.route, self.speed, turning=np.deg2rad(3.0))

    @cached_property
    def _phases(self) -> Array:
        return np.random.default_rng([self.seed, 21]).uniform(0, 2 * np.pi, 3)

    @cached_property
    def _paces(self) -> Array:
        return 2 * np.pi * np.random.default_rng([self.seed, 22]).uniform(0.012, 0.026, 3)


# The hand turns at one rate for so many frames, and then abruptly at another.
_HOLD = (2, 7)
# It goes along for so many frames, and then it only turns for about half as many.
_GO = (9, 18)
_FASTEST = np.deg2rad(4.6)


@dataclass(frozen=True)
class HandHeld:
    """
    A camera in a hand that looks round in jerks, moves a little, and at times only turns.

    Rotation changes from frame to frame by up to 4.6 degrees, abruptly; the way is 1 to 3 cm a
    frame, and below half a millimetre in the stretches of rotation. place: (3,) in level axes and
    tilt: how far down it looks on average, in radians; seed: of all movements.
    """

    place: tuple[float, float, float]
    tilt: float
    seed: int = 0
    limit: int = 400

    def pose(self, index: int) -> Array:
        """Pose (4, 4), camera to level axes."""
        pitch, yaw, roll = self._angles[index]
        return pose_at(self.place + self._offsets[index], yaw, pitch - self.tilt, roll)

    def turning(self, index: int) -> Array:
        """Rotation vector (3,) in camera axes by which it turns per frame about this one."""
        first, last = max(index - 1, 0), min(index + 1, self.limit - 1)
        turn = self.pose(first)[:3, :3].T @ self.pose(last)[:3, :3]
        return np.asarray(Rotation.from_matrix(turn).as_rotvec() / (last - first))

    @cached_property
    def _angles(self) -> Array:
        """Pitch, yaw and roll (limit, 3), drawn back towards zero."""
        rng = np.random.default_rng([self.seed, 23])
        angles = np.zeros((self.limit, 3))
        left = 0
        rate = np.zeros(3)
        for i in range(1, self.limit):
            if left == 0:
                left = int(rng.integers(*_HOLD))
                rate = np.deg2rad(rng.normal(0, (1.3, 2.6, 1.0))) - 0.06 * angles[i - 1]
            tremor = np.deg2rad(rng.normal(0, 0.2, 3))
            angles[i] = angles[i - 1] + _limited(rate + tremor, _FASTEST)
            left -= 1
        return angles

    @cached_property
    def _offsets(self) -> Array:
        """Offsets (limit, 3) in metres from the place, drawn back towards it."""
        rng = np.random.default_rng([self.seed, 24])
        offsets = np.zeros((self.limit, 3))
        i, going = 1, True
        while i < self.limit:
            count = int(rng.integers(*_GO)) // (1 if going else 2)
            direction = rng.normal(0, (1.0, 0.5, 0.8)) - 4 * offsets[i - 1]
            step = direction / np.linalg.norm(direction) * rng.uniform(0.01, 0.028) * going
            for j in range(i, min(i + count, self.limit)):
                shake = 1e-3 if going else 1e-4
                offsets[j] = offsets[j - 1] + step + rng.normal(0, shake, 3)
            i, going = i + count, not going
        return offsets


def _limited(vector: Array, most: float) -> Array:
    length = float(np.linalg.norm(vector))
    return vector * min(1.0, most / length) if length else vector


@dataclass(frozen=True)
class Whip:
    """
    A camera that is swung to the right and to the left, by the same angle from frame to frame.

    place: (3,) in level axes, about which it also sways by up to 6 cm a frame; turn: radians per
    frame; reach: radians to either side, a multiple of turn; tilt: how far down it looks; seed: of
    the phases.
    """

    place: tuple[float, float, float]
    turn: float
    reach: float
    tilt: float
    seed: int = 0
    limit: int = 10_000

    def pose(self, index: int) -> Array:
        """Pose (4, 4), camera to level axes."""
        steps = round(self.reach / self.turn)
        yaw = (abs((index + steps) % (4 * steps) - 2 * steps) - steps) * self.turn
        sway = np.sin(self._phases + index * np.array([0.37, 0.53, 0.29, 0.47, 0.31]))
        return pose_at(self.place + sway[2:] * (0.12, 0.05, 0.1), -yaw,
                       0.1 * sway[0] - self.tilt, 0.08 * sway[1])

    @cached_property
    def _phases(self) -> Array:
        return np.random.default_rng([self.seed, 25]).uniform(0, 2 * np.pi, 5)
