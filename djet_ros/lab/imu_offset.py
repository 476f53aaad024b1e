"""By how much the clock of an IMU is ahead of a camera's, and how the IMU is turned against it."""

from __future__ import annotations

from dataclasses import dataclass

from djet_ros.core.geometry import rotation_log
from djet_ros.core.types import Array
from djet_ros.errors import DjetError
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation, Slerp

# Seconds between the offsets that are tried first, by how fast it turns alone.
_COARSE = 0.005

# Pairs that are needed, and rad per second: their rates must differ by so much to tell an offset.
_LEAST_PAIRS, _LEAST_CHANGE = 20, 0.02

# rad, rad/s and s by which mounting, bias and offset are varied.
_UNITS = np.array([0.01] * 6 + [0.002])

# Condition from which on something is not to be told.
_EVEN = 1e12


@dataclass(frozen=True)
class VisualTurns:
    """Rotations (N, 3, 3) from images at start_ns to those at end_ns (N,), as a RelativePose's."""

    start_ns: NDArray[np.int64]
    end_ns: NDArray[np.int64]
    R: Array

    def rates(self) -> Array:
        """Tell how fast it turned on average: (N, 3) in rad/s, along the camera's axes."""
        seconds = (self.end_ns - self.start_ns) * 1e-9
        return np.asarray(rotation_log(self.R.transpose(0, 2, 1)) / seconds[:, None])


@dataclass(frozen=True)
class ImuFit:
    """
    What suits the turns of the images best.

    offset, offset_sigma: seconds by which the IMU's clock is ahead; to_camera: (3, 3) rotation of
    the IMU's axes to those of the camera; bias: (3,) rad/s; residual: rad/s, robust standard
    deviation of what is left of the rates; pairs: how many were used.
    """

    offset: float
    offset_sigma: float
    to_camera: Array
    bias: Array
    residual: float
    pairs: int

    def quaternion(self) -> list[float]:
        """Give to_camera as x y z w."""
        return [float(value) for value in Rotation.from_matrix(self.to_camera).as_quat(
            canonical=True)]


def fit_imu(turns: VisualTurns, stamps_ns: NDArray[np.int64], rates: Array,
            widest: float = 0.5) -> ImuFit:
    """
    Find the offset, the mounting and the bias of an IMU with samples (M,), rates (M, 3) in rad/s.

    How fast both turn tells the offset roughly, within ``widest`` seconds, whatever the mounting;
    the rotations themselves tell all three, by robust least squares. DjetError where the turns
    are too few or too even to tell.
    """
    seen = turns.rates()
    if len(seen) < _LEAST_PAIRS or seen.std(0).max() < _LEAST_CHANGE:
        raise DjetError(f'{len(seen)} pairs whose rates differ by {seen.std(0).max():.3f} rad/s '
                        f'tell no offset; record at least {_LEAST_PAIRS}, and turn the camera to '
                        'and fro about all axes')
    gyro = _orientations(stamps_ns, rates)
    tried = np.arange(-widest, widest + _COARSE / 2, _COARSE)
    offset = float(tried[np.argmin([_misfit(turns, seen, gyro, one) for one in tried])])
    felt, known = _felt(turns, gyro, offset)
    if known.sum() < _LEAST_PAIRS:
        raise DjetError(f'the IMU covers {known.sum()} of {len(seen)} pairs; are both stamped by '
                        'clocks that are near one another?')
    R, _ = Rotation.align_vectors(seen[known] - np.median(seen[known], axis=0),
                                  felt[known] - np.median(felt[known], axis=0))
    bias = np.median(felt[known] - R.inv().apply(seen[known]), axis=0)

    at_first = np.array([0, 0, 0, *bias, offset])

    def residuals(z: Array) -> Array:
        # Unknowns begin at one, in units in which they may change by about as much.
        x = at_first + _UNITS * (z - 1)
        there, covered = _felt(turns, gyro, x[6])
        off = seen - (Rotation.from_rotvec(x[:3]) * R).apply(there - x[3:6])
        return np.asarray(np.where((covered & known)[:, None], off, 0.0).ravel())

    first = residuals(np.ones(7))
    scale = max(1.4826 * float(np.median(np.abs(first[first != 0]))), 1e-5)
    found = least_squares(residuals, np.ones(7), loss='cauchy', f_scale=2 * scale, diff_step=0.01)
    x = at_first + _UNITS * (found.x - 1)
    sigma = 1.4826 * float(np.median(np.abs(found.fun[found.fun != 0])))
    information = found.jac.T @ found.jac
    if np.linalg.cond(information) > _EVEN:
        raise DjetError('the camera turned too evenly to tell the offset; turn it to and fro '
                        'about all axes')
    spread = sigma * float(np.sqrt(np.linalg.inv(information)[6, 6])) * _UNITS[6]
    return ImuFit(float(x[6]), spread, (Rotation.from_rotvec(x[:3]) * R).as_matrix(), x[3:6],
                  sigma, int(known.sum()))


def _orientations(stamps_ns: NDArray[np.int64], rates: Array) -> Slerp:
    """Integrate rates (M, 3), as if they were linear between the samples, by seconds."""
    stamps, first = np.unique(stamps_ns, return_index=True)
    rates = rates[first]
    if len(stamps) < _LEAST_PAIRS or not np.isfinite(rates).all():
        raise DjetError(f'{len(stamps)} samples of the IMU, or some that are no rates, tell no '
                        'offset; give a recording with a whole IMU')
    h = np.diff(stamps)[:, None] * 1e-9
    steps = Rotation.from_rotvec(h * (rates[:-1] + rates[1:]) / 2).as_matrix()
    turned = np.empty((len(stamps), 3, 3))
    turned[0] = np.eye(3)
    for i, step in enumerate(steps):
        turned[i + 1] = turned[i] @ step
    return Slerp(stamps * 1e-9, Rotation.from_matrix(turned))


def _felt(turns: VisualTurns, gyro: Slerp, offset: float) -> tuple[Array, NDArray[np.bool_]]:
    """Mean rates (N, 3) that the gyro felt, and (N,) bool where it covers the pair."""
    start, end = turns.start_ns * 1e-9 + offset, turns.end_ns * 1e-9 + offset
    known = np.asarray((start >= gyro.times[0]) & (end <= gyro.times[-1]))
    felt = np.zeros((len(start), 3))
    if known.any():
        turn = gyro(start[known]).inv() * gyro(end[known])
        felt[known] = turn.as_rotvec() / (end - start)[known, None]
    return felt, known


def _misfit(turns: VisualTurns, seen: Array, gyro: Slerp, offset: float) -> float:
    """Tell how differently fast the two turn, whatever their axes; infinite without an overlap."""
    felt, known = _felt(turns, gyro, offset)
    if known.sum() < _LEAST_PAIRS:
        return np.inf
    # By a linear map, which takes in the mounting and the bias.
    A = np.column_stack([felt[known], np.ones(known.sum())])
    left = seen[known] - A @ np.linalg.lstsq(A, seen[known], rcond=None)[0]
    return float(np.median(np.linalg.norm(left, axis=1)))
