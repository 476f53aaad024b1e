"""Estimation of the time offset and the rotation between an IMU and a camera."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from djet_ros.config.sections import Config
from djet_ros.core.geometry import rotation_log
from djet_ros.core.types import Array, TRACKED
from djet_ros.errors import DjetError
from djet_ros.lab.processed import processed
from djet_ros.odometry.messages import stamp_ns
from djet_ros.odometry.tracker import Tracker
from djet_ros.recordings.decoding import message_type
from djet_ros.recordings.recording import Recording, refuse, Warn
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation, Slerp

# Step in seconds of the initial search for the offset.
_COARSE = 0.005

# Fewest pairs, and smallest standard deviation of their rates in rad/s, to determine an offset.
_LEAST_PAIRS, _LEAST_CHANGE = 20, 0.02

# Units of the unknowns in the optimisation: rotation (rad), bias (rad/s) and offset (s).
_UNITS = np.array([0.01] * 6 + [0.002])

# Condition number of the information above which the problem counts as degenerate.
_DEGENERATE = 1e12


@dataclass(frozen=True)
class VisualRotations:
    """Rotations R (N, 3, 3) of RelativePose, between images at start_ns and end_ns (N,)."""

    start_ns: NDArray[np.int64]
    end_ns: NDArray[np.int64]
    R: Array

    def rates(self) -> Array:
        """Return mean angular velocities (N, 3) in rad/s, in the camera's axes."""
        seconds = (self.end_ns - self.start_ns) * 1e-9
        return np.asarray(rotation_log(self.R.transpose(0, 2, 1)) / seconds[:, None])


@dataclass(frozen=True)
class ImuFit:
    """
    Estimate of time offset, rotation and gyro bias.

    offset, offset_sigma: seconds by which the IMU's clock is ahead; to_camera: (3, 3) rotation
    from the IMU's axes to those of the camera; bias: (3,) rad/s; residual: robust standard
    deviation of the residual rates in rad/s; pairs: number of pairs used.
    """

    offset: float
    offset_sigma: float
    to_camera: Array
    bias: Array
    residual: float
    pairs: int

    def quaternion(self) -> list[float]:
        """Return to_camera as quaternion x, y, z, w."""
        return [float(value) for value in Rotation.from_matrix(self.to_camera).as_quat(
            canonical=True)]


def rotations_and_rates(recording: Recording, config: Config, advance: Callable[[], None],
                        warn: Warn = refuse
                        ) -> tuple[VisualRotations, NDArray[np.int64], Array]:
    """
    Return the rotations between images, and stamps (M,) in ns and rates (M, 3) of the gyro.

    Raises DjetError, see ``processed``.
    """
    tracker = Tracker(config, message_type, image_topic=recording.image_topic)
    ends: list[tuple[int, int]] = []
    rotations, stamps, rates = [], [], []

    def take(topic: str, message: Any) -> None:
        if topic == recording.auxiliary['imu']:
            rate = message.angular_velocity
            stamps.append(stamp_ns(message.header))
            rates.append((rate.x, rate.y, rate.z))

    for result in processed(recording, tracker, advance, take, warn):
        if result.status in TRACKED and result.since_ns is not None:
            ends.append((result.since_ns, result.stamp_ns))
            rotations.append(result.motion[:3, :3].T)
    start, end = np.array(ends, np.int64).reshape(-1, 2).T
    return (VisualRotations(start, end, np.array(rotations).reshape(-1, 3, 3)),
            np.array(stamps, np.int64), np.array(rates, np.float64).reshape(-1, 3))


def fit_imu(rotations: VisualRotations, stamps_ns: NDArray[np.int64], rates: Array,
            widest: float = 0.5) -> ImuFit:
    """
    Estimate offset, rotation and bias of an IMU with stamps (M,) and rates (M, 3) in rad/s.

    A search within ``widest`` seconds, which does not depend on the rotation, gives the initial
    offset; robust least squares on the rotations of the pairs then estimate all three. Raises
    DjetError if there are too few pairs, or their rotations do not determine the offset.
    """
    visual = rotations.rates()
    change = float(visual.std(0).max()) if len(visual) else 0.0
    if len(visual) < _LEAST_PAIRS or change < _LEAST_CHANGE:
        raise DjetError(f'{len(visual)} pairs whose angular rates vary by '
                        f'{change:.3f} rad/s do not determine an offset; record at '
                        f'least {_LEAST_PAIRS}, and rotate the camera back and forth about all '
                        'axes')
    gyro = _orientations(stamps_ns, rates)
    R, bias, offset, known = _initial_fit(rotations, visual, gyro, widest)
    initial = np.array([0, 0, 0, *bias, offset])

    def residuals(z: Array) -> Array:
        # Unknowns are scaled and start at one, so that relative steps suit all of them.
        x = initial + _UNITS * (z - 1)
        measured, covered = _gyro_rates(rotations, gyro, x[6])
        differences = visual - (Rotation.from_rotvec(x[:3]) * R).apply(measured - x[3:6])
        return np.asarray(np.where((covered & known)[:, None], differences, 0.0).ravel())

    first = residuals(np.ones(7))
    scale = max(1.4826 * float(np.median(np.abs(first[first != 0]))), 1e-5)
    solution = least_squares(residuals, np.ones(7), loss='cauchy', f_scale=2 * scale,
                             diff_step=0.01)
    x = initial + _UNITS * (solution.x - 1)
    sigma = 1.4826 * float(np.median(np.abs(solution.fun[solution.fun != 0])))
    information = solution.jac.T @ solution.jac
    if np.linalg.cond(information) > _DEGENERATE:
        raise DjetError('the rotations do not determine the offset; rotate the camera back and '
                        'forth about all axes')
    spread = sigma * float(np.sqrt(np.linalg.inv(information)[6, 6])) * _UNITS[6]
    return ImuFit(float(x[6]), spread, (Rotation.from_rotvec(x[:3]) * R).as_matrix(), x[3:6],
                  sigma, int(known.sum()))


def _initial_fit(rotations: VisualRotations, visual: Array, gyro: Slerp, widest: float
                 ) -> tuple[Rotation, Array, float, NDArray[np.bool_]]:
    """Return rotation, bias, offset, and which pairs (N,) the IMU covers at that offset."""
    candidates = np.arange(-widest, widest + _COARSE / 2, _COARSE)
    misfits = [_misfit(rotations, visual, gyro, one) for one in candidates]
    offset = float(candidates[np.argmin(misfits)])
    measured, known = _gyro_rates(rotations, gyro, offset)
    if known.sum() < _LEAST_PAIRS:
        raise DjetError(f'the IMU covers {known.sum()} of {len(visual)} pairs, at least '
                        f'{_LEAST_PAIRS} are needed; check that images and IMU are stamped by '
                        'synchronised clocks, or raise --widest')
    R, _ = Rotation.align_vectors(visual[known] - np.median(visual[known], axis=0),
                                  measured[known] - np.median(measured[known], axis=0))
    bias = np.median(measured[known] - R.inv().apply(visual[known]), axis=0)
    return R, bias, offset, known


def _orientations(stamps_ns: NDArray[np.int64], rates: Array) -> Slerp:
    """Integrate rates (M, 3), linear between samples, to orientations over time in seconds."""
    stamps, first = np.unique(stamps_ns, return_index=True)
    rates = rates[first]
    if len(stamps) < _LEAST_PAIRS or not np.isfinite(rates).all():
        raise DjetError(f'the IMU has {len(stamps)} samples, at least {_LEAST_PAIRS} are needed, '
                        'all of them finite; name a recording with complete IMU data')
    h = np.diff(stamps)[:, None] * 1e-9
    steps = Rotation.from_rotvec(h * (rates[:-1] + rates[1:]) / 2).as_matrix()
    orientations = np.empty((len(stamps), 3, 3))
    orientations[0] = np.eye(3)
    for i, step in enumerate(steps):
        orientations[i + 1] = orientations[i] @ step
    return Slerp(stamps * 1e-9, Rotation.from_matrix(orientations))


def _gyro_rates(rotations: VisualRotations, gyro: Slerp, offset: float
                ) -> tuple[Array, NDArray[np.bool_]]:
    """Return the gyro's mean rates (N, 3) over the pairs, and (N,) bool, which pairs it covers."""
    start, end = rotations.start_ns * 1e-9 + offset, rotations.end_ns * 1e-9 + offset
    known = np.asarray((start >= gyro.times[0]) & (end <= gyro.times[-1]))
    rates = np.zeros((len(start), 3))
    if known.any():
        rotation = gyro(start[known]).inv() * gyro(end[known])
        rates[known] = rotation.as_rotvec() / (end - start)[known, None]
    return rates, known


def _misfit(rotations: VisualRotations, visual: Array, gyro: Slerp, offset: float) -> float:
    """Return the median difference of the rates, infinite without overlap of the recordings."""
    measured, known = _gyro_rates(rotations, gyro, offset)
    if known.sum() < _LEAST_PAIRS:
        return np.inf
    # After a linear map, which absorbs rotation and bias.
    A = np.column_stack([measured[known], np.ones(known.sum())])
    left = visual[known] - A @ np.linalg.lstsq(A, visual[known], rcond=None)[0]
    return float(np.median(np.linalg.norm(left, axis=1)))
