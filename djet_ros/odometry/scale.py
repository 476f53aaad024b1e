"""
Scale sources: the length of a translation, which two views of one camera do not determine.

A source returns the length between two stamps. If it has none, the length is marked as unknown,
and the covariance of the motion is large accordingly.
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
from djet_ros.core.ground import Ground, GroundMotion, rotate_tilt, SIGHT
from djet_ros.core.types import Array, RelativePose, View
from djet_ros.errors import DjetError
from djet_ros.odometry.guess import Guess
from djet_ros.odometry.interpolation import positions_at
from djet_ros.odometry.stamped import Stamped
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

# Standard deviation of an unknown length, in units of the trajectory: large for every filter that
# weights by it, yet its square keeps its precision.
UNKNOWN_LENGTH_SIGMA = 1e3

# Nanoseconds for which a speed, a position or the ground's motion is held.
_LONGEST_HOLD_NS = 500_000_000

# Metres per second that no camera reaches; a broken sensor may send values with infinite squares.
_FASTEST = 1e5

# Speeds that are kept for later intervals.
_KEPT_SPEEDS = 10_000

# Random walk over a second of speed (m/s), and of the camera's pitch and roll against the ground
# (rad) if no rotation predicts them.
_WANDERING = np.array([1.0, np.radians(0.5), np.radians(0.5)])

# Random walk over a metre of the slope of the ground that a car sees, in rad; chosen. The heights
# of a road of class C (ISO 8608) make 0.07 degrees, to which its bends are added.
_BENDING = np.radians(0.1)

# Standard deviations before the first pair: of speed (m/s), and of pitch and roll (rad) by
# mounting.
_AT_FIRST = np.array([1e3, np.radians(2.0), np.radians(2.0)])

# Standard deviation in rad between a plane through eight metres of that ground and the road;
# chosen: heights of class B make 0.08 degrees, those of class C 0.16.
_UNEVEN = np.radians(0.1)

# Lengths that a scale requires: their parameter, the smallest value in metres, their meaning.
_WANTED = {'constant': ('scale_value', 1e-6, 'the metres of each translation'),
           'camera_height': ('camera_height', 0.01, 'the metres from the ground to the camera')}

# Normalised squared innovation (1 or 2 expected) of an outlier.
_OUTLIER = 20.0


@unique
class Scale(StrEnum):
    """Unit of a length: metres, the unit of the track, or an unknown one for each step."""

    METRIC = 'metric'
    RELATIVE = 'relative'
    UNKNOWN = 'unknown'


@dataclass(frozen=True)
class Common:
    """
    Errors that a length has in common with the lengths before and after it, as shares of it.

    variances: (2,) of the track's scale factor, which drifts, and of the error that all metric
    lengths have in common; kept: (2,) the share of either error that the previous length had too.
    """

    variances: Array
    kept: Array


@dataclass(frozen=True)
class Length:
    """
    Length of a translation, with its standard deviation sigma.

    known: whether both are meaningful, in metres if `metric`, otherwise in the unit of the track;
    measured: whether its source measured it; common: its error in common with other lengths, None
    if that is unknown; sigma includes it only if the length is metric.
    """

    value: float
    sigma: float
    known: bool
    metric: bool = True
    measured: bool = True
    common: Common | None = None

    @property
    def is_zero(self) -> bool:
        """Return whether it is not distinguishable from a standstill."""
        return self.value <= self.sigma

    @property
    def own(self) -> Length:
        """Return it with the standard deviation of its own error alone."""
        if not self.metric or self.common is None:
            return self
        variance = self.sigma**2 - self.value**2 * float(self.common.variances.sum())
        return replace(self, sigma=float(np.sqrt(max(variance, 0.0))))

    @property
    def scale(self) -> Scale:
        """Return its unit."""
        return (Scale.UNKNOWN if not self.known else
                Scale.METRIC if self.metric else Scale.RELATIVE)


class ScaleSource(Protocol):
    """
    Source of the lengths of translations.

    uses_landmarks: whether landmarks carry its scale from step to step, also while it has no
    measurements; exact: whether its lengths have no error of their own; correlation_length: metres
    over which its lengths have the same relative error.
    """

    uses_landmarks: bool = True
    exact: bool = False
    correlation_length: float = 0.0

    def observe(self, start_ns: int, end_ns: int, previous: View, current: View,
                relative: RelativePose) -> None:
        """Take a pair of views and their relative pose, before ``between`` is called for it."""
        return

    def add_speed(self, stamp_ns: int, metres_per_second: float) -> None:
        """Take a measured speed."""
        return

    def why_unknown(self, stamp_ns: int) -> str:
        """Return a text on why the length up to a stamp is unknown."""
        if self.between(stamp_ns - 1, stamp_ns).known:
            return 'it measures a standstill while the images show motion'
        return self.why_silent(stamp_ns)

    def why_silent(self, stamp_ns: int) -> str:
        """Return a text on why there is no measurement up to a stamp."""
        return 'nothing is measured'

    @abstractmethod
    def between(self, start_ns: int, end_ns: int) -> Length:
        """Return the length of the translation between two stamps."""

    def reset(self) -> None:
        """Forget all measurements."""
        return

    def go_back(self, stamp_ns: int) -> None:
        """
        Forget the measurements from before time went back to the stamp of an image.

        Those of other topics may already be of the new time, and are kept.
        """
        self.reset()


class UnitScale(ScaleSource):
    """Every translation has length one, of an unknown unit."""

    uses_landmarks = False

    def between(self, start_ns: int, end_ns: int) -> Length:
        """Return an unknown length of one."""
        return unknown(1.0)


class RelativeScale(ScaleSource):
    """No metric measurements: landmarks carry the unit, which is the length of the first step."""

    def between(self, start_ns: int, end_ns: int) -> Length:
        """Return an unknown length of one."""
        return unknown(1.0)


class ConstantScale(ScaleSource):
    """Every translation has the same known length in metres; uncertainty: sigma as its share."""

    uses_landmarks, exact = False, True

    def __init__(self, metres: float, uncertainty: float = 0.05) -> None:
        self._length = Length(metres, metres * uncertainty, True)

    def between(self, start_ns: int, end_ns: int) -> Length:
        """Return the constant length."""
        return self._length


class SpeedScale(ScaleSource):
    """
    Integral of measured speeds over time.

    Speeds are interpolated linearly, and held constant before the first and after the last one. If
    the nearest one is more than half a second away, the length is unknown, and the integral only a
    guess.
    """

    def __init__(self, uncertainty: float = 0.05) -> None:
        self._uncertainty = uncertainty
        self.reset()

    def why_silent(self, stamp_ns: int) -> str:
        """Return how far the stamp of the newest speed is off."""
        if not self._speeds:
            return 'no speed was received'
        off = (self._speeds.stamps[-1] - stamp_ns) * 1e-9
        return (f'the newest speed is stamped {abs(off):.1f} s '
                f'{"after" if off > 0 else "before"} the newest image')

    def add_speed(self, stamp_ns: int, metres_per_second: float) -> None:
        """Take a measured speed; an impossible one, or one with a known stamp, is ignored."""
        if not abs(metres_per_second) <= _FASTEST:
            return
        # First, as a bag that loops repeats its stamps.
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
        """Forget the speeds unless the newest ones are of the new time."""
        if self._speeds.goes_back(stamp_ns):
            self.reset()


class CameraHeightScale(ScaleSource):
    """
    Translation over level ground, from the known height of the camera above it.

    Each pair of views measures the translation in heights, and the camera's pitch and roll against
    the ground; their errors are strongly correlated. A Kalman filter over (speed, pitch, roll)
    fuses the pairs. Speed is a random walk. Pitch and roll are predicted by the rotation of each
    pair, as the ground is static: this separates a vehicle that nods from ground that bends.
    Measurements of more bend than roads have are outliers. While no ground is seen, pitch and roll
    are kept: on a hill the road turns with the vehicle.

    The ground must fill the lower part of the image, and the camera must not roll. If no ground
    was seen for half a second, the length is unknown, and the last speed gives the guess.

    uncertainty: standard deviation of the height as a share of it, bumps of the road included.
    """

    def __init__(self, height: float, pitch: float, uncertainty: float = 0.05) -> None:
        """Set the camera's height in metres and its pitch in rad, positive when looking down."""
        self._height, self._pitch, self._uncertainty = height, pitch, uncertainty
        # A kerb, a lawn or a bump falsifies lengths as long as it is in view.
        self.correlation_length = height * SIGHT
        self._ground: tuple[Array, tuple[int, ...], Ground] | None = None
        self._seen_ns: int | None = None
        self.reset()

    def observe(self, start_ns: int, end_ns: int, previous: View, current: View,
                relative: RelativePose) -> None:
        """Measure the ground's motion in a pair of views, and update the filter."""
        seconds = (end_ns - start_ns) * 1e-9
        x, P = self._predicted(start_ns, end_ns)
        # The interval of lengths that the filter predicts, in heights: four sigma to both sides.
        expected = (x[0] + np.array([-4, 4]) * np.sqrt(P[0, 0])) * seconds / self._height
        motion = self._ground_of(current).motion(
            previous, current, relative, (float(expected[0]), float(expected[1])))
        if motion is not None and self._update(*self._measured(motion, seconds), x, P):
            self._seen_ns = end_ns
            self._turn(relative, seconds)

    def between(self, start_ns: int, end_ns: int) -> Length:
        """Return the speed over the ground times time."""
        if self._seen_ns is None:
            return unknown(1.0)
        x, P = self._predicted(start_ns, end_ns)
        seconds = (end_ns - start_ns) * 1e-9
        metres = max(float(x[0]), 0.0) * seconds
        if end_ns - self._seen_ns > _LONGEST_HOLD_NS:
            return unknown(metres)
        sigma = np.hypot(np.sqrt(P[0, 0]) * seconds, self._uncertainty * metres)
        return Length(metres, max(float(sigma), 1e-3), True)

    def why_silent(self, stamp_ns: int) -> str:
        """Return that no ground was seen."""
        return 'the images show no level ground at this height below the camera'

    def reset(self) -> None:
        """Forget speed, pitch and roll."""
        self._x, self._P = np.array([0.0, self._pitch, 0.0]), np.diag(_AT_FIRST**2)
        self._seen_ns = None

    def _ground_of(self, view: View) -> Ground:
        """Return the ground detector of a view's camera; kept, as the camera rarely changes."""
        if self._ground is None or self._ground[1] != view.gray.shape \
                or not np.array_equal(self._ground[0], view.K):
            self._ground = view.K, view.gray.shape, Ground(view.K, view.gray.shape, self._pitch)
        return self._ground[2]

    def _predicted(self, start_ns: int, end_ns: int) -> tuple[Array, Array]:
        """Return (speed at the end, pitch and roll at the start) and their covariance."""
        gaps = np.zeros(3)
        if self._seen_ns is not None:
            gaps[0] = max(end_ns - self._seen_ns, 0)
            gaps[1:] = abs(start_ns - self._seen_ns)
        return self._x, self._P + np.diag(_WANDERING**2 * gaps * 1e-9)

    def _measured(self, motion: GroundMotion, seconds: float) -> tuple[Array, Array]:
        """Return speed, pitch and roll (3,) and their covariance, roughness of ground included."""
        scale = np.array([self._height / seconds, 1.0, 1.0])
        return motion.value * scale, motion.covariance * np.outer(scale, scale) + np.diag(
            [0.0, _UNEVEN**2, _UNEVEN**2])

    def _update(self, z: Array, R: Array, x: Array, P: Array) -> bool:
        """Update a prediction x, P by a measurement z, R; return whether it is no outlier."""
        innovation, S = z - x, P + R
        if innovation[1:] @ np.linalg.solve(S[1:, 1:], innovation[1:]) > _OUTLIER:
            # No road is tilted against the camera by that much.
            return False
        if innovation[0]**2 > _OUTLIER * S[0, 0]:
            # The measurement overrules the model of how speed changes.
            P = P.copy()
            P[0] = P[:, 0] = 0.0
            P[0, 0] = _AT_FIRST[0]**2
        gain = P @ np.linalg.inv(P + R)
        keep = np.eye(3) - gain
        self._x = x + gain @ (z - x)
        self._P = keep @ P @ keep.T + gain @ R @ gain.T
        return True

    def _turn(self, relative: RelativePose, seconds: float) -> None:
        """Predict pitch and roll at the end of a pair by its rotation."""
        covariance = relative.covariance_5[:3, :3]
        if not np.isfinite(covariance).all():
            self._P = self._P + np.diag([0.0, *_WANDERING[1:]**2 * seconds])
            return
        tilt, by_tilt, by_turn = rotate_tilt(self._x[1:], relative.R, covariance)
        metres = max(float(self._x[0]), 0.0) * seconds
        J = block_diag(1.0, by_tilt)
        self._x = np.array([self._x[0], *tilt])
        self._P = J @ self._P @ J.T + block_diag(0.0, by_turn + _BENDING**2 * metres * np.eye(2))


class GuessScale(ScaleSource):
    """Distances by another odometry."""

    def __init__(self, uncertainty: float = 0.05) -> None:
        self._uncertainty = uncertainty
        # To be replaced by the one that receives poses.
        self.guess = Guess()

    def why_silent(self, stamp_ns: int) -> str:
        """Return what is missing: a transform or poses."""
        return ('the camera has no transform to the frame of the guess'
                if self.guess.mounting is None else 'no guess covers the time of the newest image')

    def between(self, start_ns: int, end_ns: int) -> Length:
        """Return the distance, unknown if poses or the transform are missing."""
        motion = self.guess.motion(start_ns, end_ns)
        if motion is None:
            return unknown(1.0)
        metres = float(np.linalg.norm(motion[:3, 3]))
        return Length(metres, max(metres * self._uncertainty, 1e-3), True)

    def reset(self) -> None:
        """Forget all poses."""
        self.guess.reset()

    def go_back(self, stamp_ns: int) -> None:
        """Forget the poses unless the newest ones are of the new time."""
        self.guess.go_back(stamp_ns)


class GroundTruthScale(ScaleSource):
    """Distances between known positions (N, 3) in metres at increasing stamps (N,)."""

    exact = True

    def __init__(self, stamps_ns: NDArray[np.int64], positions: Array,
                 uncertainty: float = 0.05) -> None:
        known = np.isfinite(positions).all(axis=1)
        self._stamps, self._positions = stamps_ns[known], positions[known]
        self._uncertainty = uncertainty

    def why_silent(self, stamp_ns: int) -> str:
        """Return that this time is not covered."""
        return 'the ground truth does not cover the time of the newest image'

    def between(self, start_ns: int, end_ns: int) -> Length:
        """Return the distance, unknown outside the track and in gaps that are too long."""
        start, end = positions_at(self._stamps, self._positions, np.array([start_ns, end_ns]),
                                  _LONGEST_HOLD_NS)
        metres = float(np.linalg.norm(end - start))
        if not np.isfinite(metres):
            return unknown(1.0)
        return Length(metres, max(metres * self._uncertainty, 1e-3), True)


def unknown(guess: float) -> Length:
    """Return an unknown length, with a guess of it."""
    return Length(guess, UNKNOWN_LENGTH_SIGMA, False)


def same_scale(before: OdometryConfig, after: OdometryConfig) -> bool:
    """Return whether two configurations have the same source."""
    return _made_of(before) == _made_of(after)


def scale_source(config: OdometryConfig,
                 ground_truth: tuple[NDArray[np.int64], Array] | None = None) -> ScaleSource:
    """
    Return the source of a configuration; raises DjetError as ``check_scale`` does.

    ground_truth: stamps (N,) and positions (N, 3), required by scale 'ground_truth' (DjetError).
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
    """Raise DjetError if a scale requires a length that is not given."""
    if config.scale not in _WANTED:
        return
    name, least, meaning = _WANTED[config.scale]
    if (metres := getattr(config, name)) < least:
        raise DjetError(f"odometry.scale is '{config.scale}', and odometry.{name} is {metres:g}; "
                        f'give {meaning} (odometry.{name}, --{name.replace("_", "-")}), '
                        f'at least {least:g}')


def _made_of(config: OdometryConfig) -> tuple[Callable[..., ScaleSource], tuple[float, ...]]:
    """Return the class of the source, and its parameters."""
    share = config.scale_uncertainty
    kinds: dict[str, tuple[Callable[..., ScaleSource], tuple[float, ...]]] = {
        'none': (UnitScale, ()),
        'structure': (RelativeScale, ()),
        'constant': (ConstantScale, (config.scale_value, share)),
        'speed': (SpeedScale, (share,)),
        'camera_height': (CameraHeightScale, (
            config.camera_height, np.radians(config.camera_pitch), share)),
        'guess': (GuessScale, (share,)),
        'ground_truth': (GroundTruthScale, (share,))}
    return kinds[config.scale]
