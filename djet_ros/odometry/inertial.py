"""
Gyro preintegration: the camera's rotation between two images, and an estimate of the bias.

Rates are interpolated linearly and integrated on SO(3) (Magnus expansion to the fourth order;
Blanes et al., Physics Reports 2009), from the stamp of one image to that of the other. A Kalman
filter estimates the bias, a random walk, from rotations that the images measure.

The IMU's stamp is the image's stamp plus an offset, as Kalibr's timeshift_cam_imu.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import Counter, deque
from dataclasses import dataclass
from itertools import pairwise

from djet_ros.core.fusion import MeasuredRotation
from djet_ros.core.geometry import rotation_log
from djet_ros.core.types import Array
from djet_ros.odometry.stamped import Stamped
import numpy as np
from scipy.spatial.transform import Rotation

# Samples that are kept: more than a minute of the fastest IMUs.
_KEPT = 200_000

# Longest gap between two samples over which rates are interpolated.
_LONGEST_GAP_NS = 250_000_000

# rad/s beyond every gyro's range, and from which on equal values in a row mean saturation: the
# smallest range of MEMS gyros is 125 degrees per second.
_FASTEST, _FAST = 200.0, 2.0
_EQUAL_IN_A_ROW = 3

# Standard deviation of the initial bias in rad/s: cheap gyros, warming up, rarely exceed 0.05.
_BIAS_AT_FIRST = 0.05 / 3

# Standard deviation of a rotation as a share of it, by the scale factor and the axes of the gyro:
# data sheets of MEMS gyros allow up to 3 % for either, and mountings are known to a degree or so.
_SCALE_FACTOR = 0.01

# Standard deviation of an interpolated rate, as a share of the change between its samples.
_INTERPOLATION = 1 / 6

# At rest: largest rotation in standard deviations, and largest spread of the rates as a multiple
# of their white noise.
_AT_REST, _NOISE_AT_REST = 4.0, 3.0

# Newest pairs by which a gyro is judged, and the number below which it is not.
_JUDGED, _FEW = 50, 20

# rad: largest standard deviation of a rotation from which rest can be concluded.
_SIGMA_AT_REST = np.radians(0.1)


@dataclass(frozen=True)
class GyroNoise:
    """
    Noise parameters of a gyro's data sheet.

    density: of white noise, rad/s/√Hz; walk: random walk of the bias, rad/s²/√Hz.
    """

    density: float
    walk: float


@dataclass(frozen=True)
class _Integral:
    """
    Integrated rates between two stamps, without the bias, along the IMU's axes.

    turn: (3, 3) the IMU at the end in the IMU at the start; by_bias: (3, 3) Jacobian of its error,
    a rotation vector from the right, by the bias; seconds: duration; interpolation: variance in
    rad squared; spread: (3,) standard deviation of the rates; samples: their number.
    """

    turn: Array
    by_bias: Array
    seconds: float
    interpolation: float
    spread: Array
    samples: int


class Gyro:
    """
    Measures rotations of the camera, once its mounting is known.

    noise: of its data sheet; offset_ns: from stamps of images to its own; to_camera: (3, 3)
    rotation of the IMU's axes to the camera's, or None; bias: (3,) rad/s, with bias_covariance
    (3, 3); refused: counts of unusable samples.
    """

    def __init__(self, noise: GyroNoise, offset_ns: int = 0) -> None:
        self.configure(noise, offset_ns)
        self.to_camera: Array | None = None
        self.bias: Array = np.zeros(3)
        self._bias_ns: int | None = None
        self._reset_bias()
        self._verdicts: deque[bool] = deque(maxlen=_JUDGED)
        self.reset()

    def configure(self, noise: GyroNoise, offset_ns: int) -> None:
        """Change the parameters; samples and the estimated bias are kept."""
        self.noise, self.offset_ns = noise, offset_ns

    def reset(self) -> None:
        """Forget all samples; the estimated bias is kept."""
        self._rates = Stamped[Array](_KEPT)
        self._saturated: list[int] = []
        self._equal = 0
        self._latest: tuple[tuple[object, ...], _Integral | None] | None = None
        self.refused: Counter[str] = Counter()

    def mount(self, to_camera: Array | None) -> None:
        """Set the rotation (3, 3) of the IMU's axes to those of the camera; None: not known."""
        self.to_camera = to_camera

    def add(self, stamp_ns: int, rate: Array) -> None:
        """Take a rate (3,) in rad/s; unusable ones are counted in ``refused``."""
        if not (np.abs(rate) < _FASTEST).all():
            self.refused['not a rate'] += 1
            return
        if self._rates.goes_back(stamp_ns):
            refused = self.refused
            self.reset()
            self.refused = refused + Counter({'stamps went back': 1})
        if stamp_ns in self._rates:
            self.refused['equal stamp'] += 1
            return
        if self._rates and stamp_ns < self._rates.stamps[-1]:
            # It is used, but not tested for saturation, which needs samples in order.
            self.refused['out of order'] += 1
        else:
            self._note_saturation(stamp_ns, rate)
        self._rates.add(stamp_ns, rate)

    def forget_before(self, stamp_ns: int) -> None:
        """Drop samples that are not needed after the stamp of an image."""
        self._rates.forget_before(stamp_ns + self.offset_ns)

    def covers(self, stamp_ns: int) -> bool:
        """Return whether there is a sample at the stamp of an image, or after it."""
        return self._rates.covers(stamp_ns + self.offset_ns)

    def turn(self, start_ns: int, end_ns: int) -> MeasuredRotation | None:
        """Return the camera's rotation between two images; None if it was not measured."""
        if self.to_camera is None or (integral := self._integral(start_ns, end_ns)) is None:
            return None
        C, by_bias = self.to_camera, self.to_camera @ integral.by_bias
        R = C @ integral.turn.T @ C.T
        measured = (self.noise.density**2 * integral.seconds + integral.interpolation
                    + self.noise.walk**2 * integral.seconds**3 / 3
                    + _SCALE_FACTOR**2 * float(np.square(rotation_log(R)).sum()))
        covariance = measured * np.eye(3) + by_bias @ self._bias_at(end_ns) @ by_bias.T
        return MeasuredRotation(R, covariance)

    def learn(self, start_ns: int, end_ns: int, R: Array, covariance: Array) -> None:
        """
        Estimate the bias from a rotation R (3, 3) with covariance (3, 3) by the images.

        Both are as in a RelativePose.
        """
        turn = self.turn(start_ns, end_ns)
        integral = self._integral(start_ns, end_ns)
        if turn is None or integral is None or self.to_camera is None \
                or not np.isfinite(covariance).all():
            return
        # R_true = exp(J db) R_measured, where db is the true bias minus the assumed one.
        J, P = self.to_camera @ integral.by_bias, self._bias_at(end_ns)
        noise = turn.covariance - J @ P @ J.T + covariance
        gain = P @ J.T @ np.linalg.inv(J @ P @ J.T + noise)
        keep = np.eye(3) - gain @ J
        self.bias = self.bias - gain @ turn.correction(R)
        self.bias_covariance = keep @ P @ keep.T + gain @ noise @ gain.T
        self._bias_ns = end_ns

    def at_rest(self, start_ns: int, end_ns: int) -> bool | None:
        """Return whether the rotation between two images is insignificant, if well measured."""
        turn, integral = self.turn(start_ns, end_ns), self._integral(start_ns, end_ns)
        if turn is None or integral is None or integral.samples < _EQUAL_IN_A_ROW:
            return None
        sigma = float(np.sqrt(np.linalg.eigvalsh(turn.covariance)[-1]))
        if sigma >= _SIGMA_AT_REST:
            return None
        white = self.noise.density * np.sqrt(integral.samples / integral.seconds)
        angle = float(np.linalg.norm(turn.correction(np.eye(3))))
        return bool(angle < _AT_REST * sigma
                    and (integral.spread < _NOISE_AT_REST * white).all())

    def judge(self, agreed: bool) -> None:
        """Note whether the rotation of a pair agreed with the gyro's, by both covariances."""
        fitted = self.trusted
        self._verdicts.append(agreed)
        if fitted and not self.trusted:
            # The bias may have been estimated from an object that moved by itself.
            self._reset_bias()

    @property
    def trusted(self) -> bool:
        """Return whether most of the newest rotations agreed with the images."""
        return len(self._verdicts) < _FEW or sum(self._verdicts) > len(self._verdicts) / 2

    @property
    def ever_agreed(self) -> bool:
        """Return whether any of the newest rotations agreed with the images."""
        return any(self._verdicts)

    @property
    def trusted_alone(self) -> bool:
        """Return whether it may be used without images: at least half of the pairs agreed."""
        return self.trusted and 2 * sum(self._verdicts) >= len(self._verdicts)

    def _reset_bias(self) -> None:
        """Reset the bias."""
        self.bias, self.bias_covariance = np.zeros(3), np.eye(3) * _BIAS_AT_FIRST**2
        self._bias_ns = None

    def _bias_at(self, end_ns: int) -> Array:
        """Return the covariance (3, 3) of the bias, by its random walk since it was estimated."""
        seconds = 0.0 if self._bias_ns is None else abs(end_ns - self._bias_ns) * 1e-9
        return self.bias_covariance + self.noise.walk**2 * seconds * np.eye(3)

    def _integral(self, start_ns: int, end_ns: int) -> _Integral | None:
        """Return the integrated rates; the last result is cached."""
        asked = start_ns, end_ns, self.offset_ns, self.bias.tobytes(), len(self._rates)
        if self._latest is None or self._latest[0] != asked:
            self._latest = asked, self._integrated(start_ns, end_ns)
        return self._latest[1]

    def _integrated(self, start_ns: int, end_ns: int) -> _Integral | None:
        """Integrate the rates; None if samples are missing or saturated."""
        start, end = start_ns + self.offset_ns, end_ns + self.offset_ns
        known = self._rates.stamps
        first, last = bisect_right(known, start) - 1, bisect_left(known, end)
        if first < 0 or last >= len(known) or end <= start:
            return None
        stamps = known[first:last + 1]
        if max(b - a for a, b in pairwise(stamps)) > _LONGEST_GAP_NS \
                or self._is_saturated(stamps[0], stamps[-1]):
            return None
        # Seconds from the start, as absolute ones lose precision.
        seconds = np.array([(stamp - start) * 1e-9 for stamp in stamps])
        rates = np.array([self._rates[stamp] for stamp in stamps]) - self.bias
        inside = (seconds > 0) & (seconds < (end - start) * 1e-9)
        times = np.array([0.0, *seconds[inside], (end - start) * 1e-9])
        knots = np.stack([np.interp(times, seconds, axis) for axis in rates.T], axis=1)
        return _integrate(times, knots, rates)

    def _note_saturation(self, stamp_ns: int, rate: Array) -> None:
        """
        Note the newest sample as saturated if a high rate stays exactly the same.

        Only the newest one, so that the stamps stay sorted.
        """
        before = self._rates[self._rates.stamps[-1]] if self._rates else np.zeros(3)
        same = bool(((rate == before) & (np.abs(rate) > _FAST)).any())
        self._equal = self._equal + 1 if same else 0
        if self._equal + 1 >= _EQUAL_IN_A_ROW:
            self.refused['end of its range'] += 1
            del self._saturated[:bisect_left(self._saturated, self._rates.stamps[0])]
            self._saturated.append(stamp_ns)

    def _is_saturated(self, start: int, end: int) -> bool:
        place = bisect_left(self._saturated, start)
        return place < len(self._saturated) and self._saturated[place] <= end


def _integrate(times: Array, knots: Array, rates: Array) -> _Integral:
    """Integrate knots (M, 3), rates at times (M,), linear in between; rates (N, 3): measured."""
    h = np.diff(times)[:, None]
    before, after = knots[:-1], knots[1:]
    steps = Rotation.from_rotvec(
        h * (before + after) / 2 + h**2 / 12 * np.cross(before, after)).as_matrix()
    turn, by_bias = np.eye(3), np.zeros((3, 3))
    for step, seconds in zip(steps, h.ravel().tolist()):
        turn, by_bias = turn @ step, step.T @ by_bias + seconds * np.eye(3)
    off = _INTERPOLATION * h * np.linalg.norm(after - before, axis=1, keepdims=True)
    return _Integral(turn, by_bias, float(times[-1]), float((off**2).sum()), rates.std(0),
                     len(rates))
