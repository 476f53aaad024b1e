"""
The length of a translation, which two views of one camera cannot tell.

A scale source answers for a stretch of time. Where it knows nothing, its answer is marked so, and
the covariance of the motion says it.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from dataclasses import dataclass
from typing import Protocol

from djet_ros.config import OdometryConfig
from djet_ros.core.types import Array
from djet_ros.errors import DjetError
import numpy as np
from numpy.typing import NDArray

# Standard deviation, in units of the trajectory, of a length that is not known: huge for every
# filter that weighs by it, and far from where squares lose their precision.
UNKNOWN_LENGTH_SIGMA = 1e3

# A speed or a position older than this says nothing any more.
_LONGEST_HOLD_NS = 500_000_000

# Speeds kept for intervals that are still to come.
_KEPT_SPEEDS = 10_000


@dataclass(frozen=True)
class Length:
    """How long a translation is, in metres where it is known and in units where it is not."""

    value: float
    sigma: float
    known: bool


class ScaleSource(Protocol):
    """Something that knows how far the camera went."""

    def between(self, start_ns: int, end_ns: int) -> Length:
        """Length of the straight way between two stamps."""

    def reset(self) -> None:
        """Forget what was measured."""


class UnitScale:
    """Every translation has length one, and nothing is known."""

    def between(self, start_ns: int, end_ns: int) -> Length:
        """Give one, unknown."""
        return unknown(1.0)

    def reset(self) -> None:
        """Nothing is kept."""


class ConstantScale:
    """Every translation has the same known length in metres; uncertainty is a share of it."""

    def __init__(self, metres: float, uncertainty: float = 0.05) -> None:
        self._length = Length(metres, metres * uncertainty, True)

    def between(self, start_ns: int, end_ns: int) -> Length:
        """Give the constant length."""
        return self._length

    def reset(self) -> None:
        """Nothing is kept."""


class SpeedScale:
    """
    Speed times time, from stamped speeds that come in as the camera moves.

    The speed between two stamps is their linear interpolation, and the nearest one is held for
    at most half a second beyond the last; after that the length is unknown, and the last known
    speed remains the guess.
    """

    def __init__(self, uncertainty: float = 0.05) -> None:
        self._uncertainty = uncertainty
        self.reset()

    def add(self, stamp_ns: int, metres_per_second: float) -> None:
        """Take a measured speed; one that isn't finite or is earlier than the last is ignored."""
        if not np.isfinite(metres_per_second) or (self._stamps and stamp_ns <= self._stamps[-1]):
            return
        self._stamps.append(stamp_ns)
        self._speeds.append(abs(float(metres_per_second)))
        if len(self._stamps) > 2 * _KEPT_SPEEDS:
            del self._stamps[:_KEPT_SPEEDS], self._speeds[:_KEPT_SPEEDS]

    def between(self, start_ns: int, end_ns: int) -> Length:
        """Integrate the speed from start to end."""
        if not self._stamps:
            return unknown(1.0)
        inside = slice(bisect_right(self._stamps, start_ns), bisect_left(self._stamps, end_ns))
        stamps = np.array([start_ns, *self._stamps[inside], end_ns])
        # Seconds from the start: absolute ones would lose digits.
        speeds = np.interp((stamps - start_ns) * 1e-9,
                           [(stamp - start_ns) * 1e-9 for stamp in self._stamps], self._speeds)
        metres = float(np.sum((speeds[1:] + speeds[:-1]) / 2 * np.diff(stamps) * 1e-9))
        nearest = self._stamps[max(bisect_right(self._stamps, end_ns) - 1, 0)]
        if abs(end_ns - nearest) > _LONGEST_HOLD_NS:
            return unknown(metres)
        return Length(metres, max(metres * self._uncertainty, 1e-3), True)

    def reset(self) -> None:
        """Forget all speeds."""
        self._stamps: list[int] = []
        self._speeds: list[float] = []


class GroundTruthScale:
    """Distances between known positions (N, 3) in metres at increasing stamps (N,)."""

    def __init__(self, stamps_ns: NDArray[np.int64], positions: Array,
                 uncertainty: float = 0.05) -> None:
        known = np.isfinite(positions).all(axis=1)
        self._stamps, self._positions = stamps_ns[known], positions[known]
        self._uncertainty = uncertainty

    def between(self, start_ns: int, end_ns: int) -> Length:
        """Give the distance, unknown outside the stretch and wherever a gap is too wide."""
        if not (self._covers(start_ns) and self._covers(end_ns)):
            return unknown(1.0)
        metres = float(np.linalg.norm(self._at(end_ns) - self._at(start_ns)))
        return Length(metres, max(metres * self._uncertainty, 1e-3), True)

    def reset(self) -> None:
        """Keep the ground truth: it is given, not measured on the way."""

    def _covers(self, stamp_ns: int) -> bool:
        after = int(np.searchsorted(self._stamps, stamp_ns))
        if after < len(self._stamps) and self._stamps[after] == stamp_ns:
            return True
        inside = 0 < after < len(self._stamps)
        return inside and bool(
            self._stamps[after] - self._stamps[after - 1] <= _LONGEST_HOLD_NS)

    def _at(self, stamp_ns: int) -> Array:
        seconds = (self._stamps - stamp_ns) * 1e-9
        return np.array([np.interp(0.0, seconds, axis) for axis in self._positions.T])


def unknown(guess: float) -> Length:
    """Make a length that is only a guess."""
    return Length(guess, UNKNOWN_LENGTH_SIGMA, False)


def scale_source(config: OdometryConfig,
                 ground_truth: tuple[NDArray[np.int64], Array] | None = None) -> ScaleSource:
    """
    Make the source that the configuration asks for.

    ground_truth: stamps (N,) and positions (N, 3), needed for scale 'ground_truth'; without them
    DjetError.
    """
    if config.scale == 'constant':
        return ConstantScale(config.scale_value, config.scale_uncertainty)
    if config.scale == 'speed':
        return SpeedScale(config.scale_uncertainty)
    if config.scale == 'ground_truth':
        if ground_truth is None:
            raise DjetError("odometry.scale is 'ground_truth', and there is no ground truth; "
                            'give poses, or choose none, constant or speed')
        return GroundTruthScale(*ground_truth, config.scale_uncertainty)
    return UnitScale()
