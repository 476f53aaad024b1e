"""
The length of a translation, which two views of one camera cannot tell.

A scale source answers for a stretch of time. Where it knows nothing, its answer is marked so, and
the covariance of the motion says it.
"""

from __future__ import annotations

from abc import abstractmethod
from bisect import bisect_left, bisect_right
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum, unique
from itertools import pairwise
from typing import Protocol

from djet_ros.config.sections import OdometryConfig
from djet_ros.core.ground import Ground, GroundMotion, SIGHT, turned
from djet_ros.core.types import Array, RelativePose, View
from djet_ros.errors import DjetError
from djet_ros.odometry.guess import Guess
from djet_ros.odometry.interpolation import positions_at
from djet_ros.odometry.stamped import Stamped
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

# Standard deviation, in units of the trajectory, of a length that is not known: huge for every
# filter that weighs by it, and far from where squares lose their precision.
UNKNOWN_LENGTH_SIGMA = 1e3

# A speed or a position older than this says nothing any more.
_LONGEST_HOLD_NS = 500_000_000

# Metres per second that no camera goes; squares of what a broken sensor sends may be infinite.
_FASTEST = 1e5

# Speeds kept for intervals that are still to come.
_KEPT_SPEEDS = 10_000

# How speed (m/s) wanders in a second, and the camera's pitch and roll against the ground (rad)
# where no rotation tells what they do.
_WANDERING = np.array([1.0, np.radians(0.5), np.radians(0.5)])

# How ground in sight of a car tilts as the way goes on, in rad after a metre; chosen. The heights
# of a road of class C (ISO 8608) make 0.07 degrees, to which its bends are added.
_BENDING = np.radians(0.1)

# What nobody knows before the first pair: speed, and how well the camera is mounted.
_AT_FIRST = np.array([1e3, np.radians(2.0), np.radians(2.0)])

# By how much a plane through that ground, eight metres of it, leans otherwise than the road;
# chosen: heights of class B make 0.08 degrees, those of class C 0.16.
_UNEVEN = np.radians(0.1)

# Lengths that a scale can't do without: their parameter, the smallest in metres, their meaning.
_WANTED = {'constant': ('scale_value', 1e-6, 'the metres of each translation'),
           'camera_height': ('camera_height', 0.01, 'the metres from the ground to the camera')}

# Normalised squared error (1 or 2 expected) beyond which something is not what it was taken for.
_SURPRISE = 20.0


@unique
class Scale(StrEnum):
    """What lengths are in: metres, the one unit of the track, or nothing that lasts."""

    METRIC = 'metric'
    RELATIVE = 'relative'
    UNKNOWN = 'unknown'


@dataclass(frozen=True)
class Common:
    """
    Errors that a length has in common with the lengths before and after it, as shares of it.

    variances: (2,) of that of the track's factor, as it has wandered by now, and of that which all
    metric lengths have for good; kept: (2,) how much of either was in the length before.
    """

    variances: Array
    kept: Array


@dataclass(frozen=True)
class Length:
    """
    How long a translation is.

    known: whether value and sigma mean anything, in metres if `metric`, otherwise in the unit
    that all lengths of the track have in common; measured: whether its source measured it; common:
    what of its error is in its neighbours too, None where that is not known. In sigma that is of
    metres alone.
    """

    value: float
    sigma: float
    known: bool
    metric: bool = True
    measured: bool = True
    common: Common | None = None

    @property
    def own(self) -> Length:
        """Take what it has in common with its neighbours from its sigma."""
        if not self.metric or self.common is None:
            return self
        variance = self.sigma**2 - self.value**2 * float(self.common.variances.sum())
        return replace(self, sigma=float(np.sqrt(max(variance, 0.0))))

    @property
    def scale(self) -> Scale:
        """Tell what the length is in."""
        return (Scale.UNKNOWN if not self.known else
                Scale.METRIC if self.metric else Scale.RELATIVE)


class ScaleSource(Protocol):
    """
    Something that knows how far the camera went.

    What it does not use of what it is shown, and what it does not measure, it leaves as it is.

    carried: whether the landmarks that frames share carry its scale from step to step, and on
    where it falls silent; exact: whether each length that it knows is right as it is; alike: of
    how many metres in a row lengths err by the same share.
    """

    carried: bool = True
    exact: bool = False
    alike: float = 0.0

    def observe(self, start_ns: int, end_ns: int, previous: View, current: View,
                relative: RelativePose) -> None:
        """Look at a pair of views and the motion between them, before its length is asked for."""
        return

    def add_speed(self, stamp_ns: int, metres_per_second: float) -> None:
        """Take a measured speed."""
        return

    def why_unknown(self, stamp_ns: int) -> str:
        """Say what is seen of the reason why a length up to a stamp is not known."""
        return 'nothing is measured'

    @abstractmethod
    def between(self, start_ns: int, end_ns: int) -> Length:
        """Length of the translation between two stamps."""

    def reset(self) -> None:
        """Forget what was measured."""
        return

    def go_back(self, stamp_ns: int) -> None:
        """
        Hear that time begins anew with the image of a stamp.

        What was measured before that time did is forgotten; what comes on a topic of its own may
        have told of the new time already, and that stays.
        """
        self.reset()


class UnitScale(ScaleSource):
    """Every translation has length one, and nothing is known."""

    carried = False

    def between(self, start_ns: int, end_ns: int) -> Length:
        """Give one, unknown."""
        return unknown(1.0)


class Unmeasured(ScaleSource):
    """Nothing measures metres; landmarks carry one unit, the length of the first step."""

    def between(self, start_ns: int, end_ns: int) -> Length:
        """Give one, unknown."""
        return unknown(1.0)


class ConstantScale(ScaleSource):
    """Every translation has the same known length in metres; uncertainty is a share of it."""

    carried, exact = False, True

    def __init__(self, metres: float, uncertainty: float = 0.05) -> None:
        self._length = Length(metres, metres * uncertainty, True)

    def between(self, start_ns: int, end_ns: int) -> Length:
        """Give the constant length."""
        return self._length


class SpeedScale(ScaleSource):
    """
    Speed times time, from stamped speeds that come in as the camera moves.

    The speed between two stamps is their linear interpolation, and that of the outermost ones
    holds beyond them. Where the nearest one is more than half a second away, the length is
    unknown, and what that makes is the guess.
    """

    def __init__(self, uncertainty: float = 0.05) -> None:
        self._uncertainty = uncertainty
        self.reset()

    def why_unknown(self, stamp_ns: int) -> str:
        """Say how far the newest speed is off."""
        if not self._speeds:
            return 'no speed has come'
        off = (self._speeds.stamps[-1] - stamp_ns) * 1e-9
        return (f'the newest speed is stamped {abs(off):.1f} s '
                f'{"after" if off > 0 else "before"} the newest image')

    def add_speed(self, stamp_ns: int, metres_per_second: float) -> None:
        """Take a measured speed; one beyond any sense, or of a stamp that has one, is ignored."""
        if not abs(metres_per_second) <= _FASTEST or stamp_ns in self._speeds:
            return
        self.go_back(stamp_ns)
        self._speeds.add(stamp_ns, abs(float(metres_per_second)))

    def between(self, start_ns: int, end_ns: int) -> Length:
        """Integrate the speed from start to end."""
        if not self._speeds:
            return unknown(1.0)
        stamps = self._speeds.stamps
        first, last = bisect_right(stamps, start_ns), bisect_left(stamps, end_ns)
        times = np.array([start_ns, *stamps[first:last], end_ns])
        known = stamps[max(first - 1, 0):last + 1]
        # Seconds from the start: absolute ones would lose digits.
        speeds = np.interp((times - start_ns) * 1e-9,
                           [(stamp - start_ns) * 1e-9 for stamp in known],
                           [self._speeds[stamp] for stamp in known])
        metres = float(np.sum((speeds[1:] + speeds[:-1]) / 2 * np.diff(times) * 1e-9))
        middles = [(one + next_one) // 2 for one, next_one in pairwise(known)]
        asked = [start_ns, end_ns, *(time for time in middles if start_ns < time < end_ns)]
        if any(min(abs(time - stamp) for stamp in known) > _LONGEST_HOLD_NS for time in asked):
            return unknown(metres)
        return Length(metres, max(metres * self._uncertainty, 1e-3), True)

    def reset(self) -> None:
        """Forget all speeds."""
        self._speeds = Stamped[float](_KEPT_SPEEDS)

    def go_back(self, stamp_ns: int) -> None:
        """Forget the speeds unless the last ones are of the new time: then all of them are."""
        if self._speeds.goes_back(stamp_ns):
            self.reset()


class CameraHeightScale(ScaleSource):
    """
    Translations over level ground in heights of the camera, which is known in metres.

    Each pair of views gives the translation between them and the camera's pitch and roll, with an
    uncertainty; one is often sure only against the other. A Kalman filter over (speed, pitch,
    roll) brings together what pairs say. Speed changes as vehicles can. Pitch and roll change with
    the turn of each pair, as ground keeps still: so a vehicle that nods is told from ground that
    bends. What bends more than roads do is none. While no ground is seen they stay as they were:
    on a hill the road turns with the vehicle.

    The ground must be seen to fill the lower part of the image, and the camera must not roll.
    Where no ground was seen for half a second, the length is unknown, and the last speed remains
    the guess.

    uncertainty: standard deviation of the height as a share of it, all bumps of the road included.
    """

    def __init__(self, height: float, pitch: float, uncertainty: float = 0.05) -> None:
        """Take the camera's height in metres and its pitch in rad, looking down is positive."""
        self._height, self._pitch, self._uncertainty = height, pitch, uncertainty
        # A kerb, a lawn or a bump is seen from where it comes into sight until it leaves it.
        self.alike = height * SIGHT
        self._ground: tuple[Array, tuple[int, ...], Ground] | None = None
        self._seen_ns: int | None = None
        self.reset()

    def observe(self, start_ns: int, end_ns: int, previous: View, current: View,
                relative: RelativePose) -> None:
        """Take from a pair of views how far the ground moved."""
        seconds = (end_ns - start_ns) * 1e-9
        x, P = self._predicted(start_ns, end_ns)
        # Lengths that the filter expects, in heights; four deviations to both sides.
        expected = (x[0] + np.array([-4, 4]) * np.sqrt(P[0, 0])) * seconds / self._height
        seen = self._ground_of(current).motion(
            previous, current, relative, (float(expected[0]), float(expected[1])))
        if seen is not None and self._update(*self._measured(seen, seconds), x, P):
            self._seen_ns = end_ns
            self._turn(relative, seconds)

    def between(self, start_ns: int, end_ns: int) -> Length:
        """Speed over the ground times time."""
        if self._seen_ns is None:
            return unknown(1.0)
        x, P = self._predicted(start_ns, end_ns)
        seconds = (end_ns - start_ns) * 1e-9
        metres = max(float(x[0]), 0.0) * seconds
        if end_ns - self._seen_ns > _LONGEST_HOLD_NS:
            return unknown(metres)
        sigma = np.hypot(np.sqrt(P[0, 0]) * seconds, self._uncertainty * metres)
        return Length(metres, max(float(sigma), 1e-3), True)

    def why_unknown(self, stamp_ns: int) -> str:
        """Say that no ground was seen."""
        return 'the images show no level ground as far below as it should be'

    def reset(self) -> None:
        """Forget speed, pitch and roll."""
        self._x, self._P = np.array([0.0, self._pitch, 0.0]), np.diag(_AT_FIRST**2)
        self._seen_ns = None

    def _ground_of(self, view: View) -> Ground:
        """Ground of the camera, which seldom changes."""
        if self._ground is None or self._ground[1] != view.gray.shape \
                or not np.array_equal(self._ground[0], view.K):
            self._ground = view.K, view.gray.shape, Ground(view.K, view.gray.shape, self._pitch)
        return self._ground[2]

    def _predicted(self, start_ns: int, end_ns: int) -> tuple[Array, Array]:
        """State (3,) in a pair, speed to its end and lean at its start, and covariance (3, 3)."""
        gaps = np.zeros(3)
        if self._seen_ns is not None:
            gaps[0] = max(end_ns - self._seen_ns, 0)
            gaps[1:] = abs(start_ns - self._seen_ns)
        return self._x, self._P + np.diag(_WANDERING**2 * gaps * 1e-9)

    def _measured(self, seen: GroundMotion, seconds: float) -> tuple[Array, Array]:
        """Speed, pitch and roll (3,) and their covariance, with how uneven ground is."""
        scale = np.array([self._height / seconds, 1.0, 1.0])
        return seen.value * scale, seen.covariance * np.outer(scale, scale) + np.diag(
            [0.0, _UNEVEN**2, _UNEVEN**2])

    def _update(self, z: Array, R: Array, x: Array, P: Array) -> bool:
        """Take a measurement z (3,) with its covariance into what was predicted, if it is one."""
        off, S = z - x, P + R
        if off[1:] @ np.linalg.solve(S[1:, 1:], off[1:]) > _SURPRISE:
            # No ground leans like this.
            return False
        if off[0]**2 > _SURPRISE * S[0, 0]:
            # What is seen counts more than how vehicles speed up.
            P = P.copy()
            P[0] = P[:, 0] = 0.0
            P[0, 0] = _AT_FIRST[0]**2
        gain = P @ np.linalg.inv(P + R)
        keep = np.eye(3) - gain
        self._x = x + gain @ (z - x)
        self._P = keep @ P @ keep.T + gain @ R @ gain.T
        return True

    def _turn(self, relative: RelativePose, seconds: float) -> None:
        """Take the lean from the start of a pair to its end."""
        covariance = relative.covariance_5[:3, :3]
        if not np.isfinite(covariance).all():
            self._P = self._P + np.diag([0.0, *_WANDERING[1:]**2 * seconds])
            return
        lean, by_lean, by_turn = turned(self._x[1:], relative.R, covariance)
        way = max(float(self._x[0]), 0.0) * seconds
        J = block_diag(1.0, by_lean)
        self._x = np.array([self._x[0], *lean])
        self._P = J @ self._P @ J.T + block_diag(0.0, by_turn + _BENDING**2 * way * np.eye(2))


class GuessScale(ScaleSource):
    """How far another odometry says that the camera went."""

    def __init__(self, uncertainty: float = 0.05) -> None:
        self._uncertainty = uncertainty
        # Replaced by the one that hears something.
        self.guess = Guess()

    def why_unknown(self, stamp_ns: int) -> str:
        """Say what is missing of the guess."""
        return ('nobody says where the camera is in the frame of the guess'
                if self.guess.mounting is None else 'no guess covers the time of the newest image')

    def between(self, start_ns: int, end_ns: int) -> Length:
        """Give the way of the guess, unknown where it has none."""
        motion = self.guess.motion(start_ns, end_ns)
        if motion is None:
            return unknown(1.0)
        metres = float(np.linalg.norm(motion[:3, 3]))
        return Length(metres, max(metres * self._uncertainty, 1e-3), True)

    def reset(self) -> None:
        """Forget all poses."""
        self.guess.reset()

    def go_back(self, stamp_ns: int) -> None:
        """Forget the poses, but not those of the new time."""
        self.guess.go_back(stamp_ns)


class GroundTruthScale(ScaleSource):
    """Distances between known positions (N, 3) in metres at increasing stamps (N,)."""

    exact = True

    def __init__(self, stamps_ns: NDArray[np.int64], positions: Array,
                 uncertainty: float = 0.05) -> None:
        known = np.isfinite(positions).all(axis=1)
        self._stamps, self._positions = stamps_ns[known], positions[known]
        self._uncertainty = uncertainty

    def why_unknown(self, stamp_ns: int) -> str:
        """Say that this time is not covered."""
        return 'the ground truth does not cover the time of the newest image'

    def between(self, start_ns: int, end_ns: int) -> Length:
        """Give the distance, unknown outside the stretch and wherever a gap is too wide."""
        start, end = positions_at(self._stamps, self._positions, np.array([start_ns, end_ns]),
                                  _LONGEST_HOLD_NS)
        metres = float(np.linalg.norm(end - start))
        if not np.isfinite(metres):
            return unknown(1.0)
        return Length(metres, max(metres * self._uncertainty, 1e-3), True)


def unknown(guess: float) -> Length:
    """Make a length that is only a guess."""
    return Length(guess, UNKNOWN_LENGTH_SIGMA, False)


def same_scale(before: OdometryConfig, after: OdometryConfig) -> bool:
    """Tell whether two configurations ask for the same source."""
    return _made_of(before) == _made_of(after)


def scale_source(config: OdometryConfig,
                 ground_truth: tuple[NDArray[np.int64], Array] | None = None) -> ScaleSource:
    """
    Make the source that the configuration asks for.

    ground_truth: stamps (N,) and positions (N, 3), needed for scale 'ground_truth'; without them
    DjetError, as where ``check_scale`` raises it.
    """
    check_scale(config)
    kind, parameters = _made_of(config)
    if kind is not GroundTruthScale:
        return kind(*parameters)
    if ground_truth is None:
        raise DjetError("odometry.scale is 'ground_truth', and there is no ground truth; "
                        'give poses, or choose structure, constant or speed')
    return kind(*ground_truth, *parameters)


def check_scale(config: OdometryConfig) -> None:
    """Raise DjetError where a scale wants a length that nobody gave."""
    if config.scale not in _WANTED:
        return
    name, least, meaning = _WANTED[config.scale]
    if (metres := getattr(config, name)) < least:
        raise DjetError(f"odometry.scale is '{config.scale}', and odometry.{name} is {metres:g}; "
                        f'give {meaning} (odometry.{name}, --{name.replace("_", "-")}), '
                        f'at least {least:g}')


def _made_of(config: OdometryConfig) -> tuple[Callable[..., ScaleSource], tuple[float, ...]]:
    """Class of the source, and the parameters that it is made of."""
    share = config.scale_uncertainty
    kinds: dict[str, tuple[Callable[..., ScaleSource], tuple[float, ...]]] = {
        'none': (UnitScale, ()),
        'structure': (Unmeasured, ()),
        'constant': (ConstantScale, (config.scale_value, share)),
        'speed': (SpeedScale, (share,)),
        'camera_height': (CameraHeightScale, (
            config.camera_height, np.radians(config.camera_pitch), share)),
        'guess': (GuessScale, (share,)),
        'ground_truth': (GroundTruthScale, (share,))}
    return kinds[config.scale]
