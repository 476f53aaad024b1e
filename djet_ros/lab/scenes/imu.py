"""Simulated IMU on a rendered camera: exact rates of the trajectory, plus errors of a MEMS."""

from __future__ import annotations

from dataclasses import dataclass

from djet_ros.core.types import Array
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

# m/s², downwards in level axes, which have y down.
_GRAVITY = 9.81


@dataclass(frozen=True)
class Mems:
    """
    Errors of an IMU, by default those of a good one in a telephone.

    gyro: (rad/s/√Hz) and accelerometer (m/s²/√Hz): densities of white noise; gyro_walk
    (rad/s²/√Hz) and accelerometer_walk (m/s³/√Hz): random walks of the biases; gyro_bias (rad/s)
    and accelerometer_bias (m/s²): standard deviations of the biases at the start; rate in Hz.
    """

    rate: float = 200.0
    gyro: float = 2e-4
    gyro_walk: float = 2e-5
    gyro_bias: float = 0.01
    accelerometer: float = 2e-3
    accelerometer_walk: float = 3e-4
    accelerometer_bias: float = 0.05


@dataclass(frozen=True)
class FeltMotion:
    """
    Measured samples at stamps_ns (M,) in the IMU's axes, and the true biases (M, 3).

    to_camera: (3, 3) rotation from the IMU's axes to those of the camera.
    """

    stamps_ns: NDArray[np.int64]
    rates: Array
    accelerations: Array
    rate_biases: Array
    to_camera: Array


# The IMU's axes in the camera: x forward, y left, z up (REP 103).
TO_CAMERA = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])


def feel(poses: Array, period: float, mems: Mems, seed: int, level: Array | None = None
         ) -> FeltMotion:
    """
    Simulate an IMU on a camera with poses (N, 4, 4) every ``period`` seconds, from stamp 0 on.

    Poses are interpolated by cubic splines, and the rates between two poses integrate to exactly
    the rotation between them. level: (3, 3) rotation from the poses' axes to level ones, by
    default the identity.
    """
    times: Array = np.arange(len(poses)) * np.float64(period)
    samples = np.arange(round(float(times[-1]) * mems.rate) + 1) / mems.rate
    turning, moving = _splines(times, poses)
    rates = turning(samples, 1) @ TO_CAMERA
    down = (np.eye(3) if level is None else level.T) @ (0.0, _GRAVITY, 0.0)
    forces = turning(samples).inv().apply(moving(samples, 2) - down) @ TO_CAMERA
    rng = np.random.default_rng([seed, 31])
    rate_biases = _bias(rng, len(samples), mems.gyro_bias, mems.gyro_walk, mems.rate)
    force_biases = _bias(rng, len(samples), mems.accelerometer_bias, mems.accelerometer_walk,
                         mems.rate)
    white = rng.standard_normal((2, len(samples), 3)) * np.sqrt(mems.rate)
    return FeltMotion(
        np.rint(samples * 1e9).astype(np.int64), rates + rate_biases + mems.gyro * white[0],
        forces + force_biases + mems.accelerometer * white[1], rate_biases, TO_CAMERA)


def _splines(times: Array, poses: Array) -> tuple[RotationSpline, CubicSpline]:
    if len(times) < 3:
        raise ValueError(f'{len(times)} poses are too few for what lies between them')
    return (RotationSpline(times, Rotation.from_matrix(poses[:, :3, :3])),
            CubicSpline(times, poses[:, :3, 3]))


def _bias(rng: np.random.Generator, count: int, at_first: float, walk: float, rate: float
          ) -> Array:
    steps = rng.standard_normal((count, 3)) * walk / np.sqrt(rate)
    steps[0] = rng.standard_normal(3) * at_first
    return np.cumsum(steps, axis=0)
