"""
Kalman filter over the scale of a track: metres per unit, from lengths that a source measures.

The state is the logarithm of that factor, and that of the camera's usual speed. The factor hardly
changes from step to step, so measurements may be coarse or missing; without any, the last factor
is kept and its variance grows. Where landmarks do not hold the scale, the usual speed bounds its
drift: a camera seldom moves twice as fast as before for long, but without a bound lengths may
become any number of times too long. Where they hold it, speeds have no weight beside them.
"""

from __future__ import annotations

from dataclasses import replace

from djet_ros.core.types import Array
from djet_ros.odometry.scale import Common, Length
import numpy as np

# Standard deviation of the log factor from which on it is no longer taken for metres.
_NOT_METRIC = 0.35

# Single metric lengths differ from one another by at least this share (bumps, time stamps).
_LEAST_NOISE = 0.02

# Normalised squared innovation (1 expected) beyond which a length is an outlier, and the number of
# outliers in a row beyond which the factor has changed.
_OUTLIER, _IN_A_ROW = 16.0, 8

# Outliers must also last for so many correlation lengths of the source: a lawn as long as the
# visible ground causes outliers for twice its length.
_CORRELATION_LENGTHS = 2.0

# Seconds; chosen: short lengths that are not significant by themselves are summed over this time.
_SUMMED_OVER = 1.0

# Seconds over which a speed is a mean; chosen: standard deviation of its logarithm from that of
# the usual speed, and variance that the latter gains in a second: a factor of two in ten seconds.
# With half that deviation or a third of that gain a scale that drifts does so less, but follows a
# change of the speed more.
_SPEED_OVER, _SPEED_SIGMA, _USUAL_CHANGES = 1.0, 1.0, 0.5 / 10

# Standard deviation of a logarithm that is not known.
_UNKNOWN = 1e3

# The factor, and the speed in units of the track, as sums over the state: a speed in units is the
# usual one over the factor.
_FACTOR, _SPEED_IN_UNITS = np.array([1.0, 0.0]), np.array([-1.0, 1.0])


class ScaleFilter:
    """
    Scale of a track.

    metric: whether it is known in metres.
    """

    def __init__(self) -> None:
        self._share = 0.0
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        # Logarithms of the factor, and of the usual speed in units of that.
        self._mean, self._covariance = np.zeros(2), np.diag([0.0, _UNKNOWN**2])
        self.metric = False
        # Outliers in a row: their number and their metres.
        self._outliers = np.zeros(2)
        # Whether the track ever was metric; what is left in the errors of the state of that of the
        # factor of the last length, as a share of it; and of the error of the source.
        self._was_metric = False
        self._left, self._left_of_source = _FACTOR, 1.0
        self.restart_sum()

    def configure(self, share: float) -> None:
        """Set the standard deviation that all metric lengths have in common, as a share."""
        if share != self._share:
            self._left_of_source = 0.0
        self._share = share
        self.restart_sum()

    def restart_sum(self) -> None:
        """Forget the sum of short lengths, as those that follow are not comparable."""
        # Metres, their variance, units, their variance, seconds.
        self._sum = np.zeros(5)
        # Units, seconds with parallax, all seconds.
        self._moved = np.zeros(3)

    @property
    def log(self) -> float:
        """Return the logarithm of the factor."""
        return float(self._mean[0])

    @property
    def variance(self) -> float:
        """Return its variance."""
        return float(self._covariance[0, 0])

    @property
    def factor(self) -> float:
        """Return the metres of a unit."""
        return float(np.exp(self.log))

    def add_noise(self, variance: float) -> None:
        """Increase the variance of the log factor."""
        self._covariance[0, 0] += variance
        self.metric = bool(self.metric and self.variance < _NOT_METRIC**2)

    def unit_changed(self, ratio: float) -> None:
        """Take lengths in units of the track that are longer by a ratio than those before."""
        # Without metres lengths become longer, and the usual speed with them.
        self._mean += [-np.log(ratio), 0.0] if self._was_metric else [0.0, np.log(ratio)]

    def scaled(self, units: float, sigma: float, measured: bool) -> Length:
        """
        Return a length in units of the track in metres, as far as the factor is known.

        sigma: own standard deviation of the length as a share of it; measured: whether the source
        measured it as well.
        """
        value = units * self.factor
        # A relative scale has one factor for the whole track, which is no error of a step.
        common = np.hypot(np.sqrt(self.variance), self._share) if self.metric else 0.0
        return Length(value, value * float(np.hypot(sigma, common)), True, self.metric, measured,
                      self._common(self.variance, self.metric))

    def as_measured(self, measured: Length) -> Length:
        """Return a length as its source measured it, with the common error of all of these."""
        return replace(measured, common=self._common(0.0, True)) if measured.known else measured

    def _common(self, variance: float, metric: bool) -> Common:
        """
        Return the errors that a length has in common with those before and after it.

        variance: of the logarithm of its factor; metric: whether it is in metres.
        """
        self._was_metric = self._was_metric or metric
        share = self._share if self._was_metric else 0.0
        common = Common(np.array([variance, share**2]),
                        np.array([self._left[0], self._left_of_source]))
        self._left = self._covariance[:, 0] / self.variance if self.variance else _FACTOR
        self._left_of_source = 1.0
        return common

    def update(self, measured: Length, units: float, sigma: float, seconds: float,
               correlation: float = 0.0, exact: bool = False) -> None:
        """
        Update the factor by a measured length, unless that is not significant yet.

        units, sigma: the same length in units of the track, and its standard deviation as a share
        of it; correlation: metres over which measured lengths have the same error; exact: whether
        they have none.
        """
        observation = self._observation(measured, units, sigma, seconds)
        if observation is None:
            return
        observed, noise, metres = observation
        if exact:
            self._set(observed, 0.0)
        else:
            self._observe(observed, noise, metres, correlation)

    def moved(self, units: float, seconds: float, parallax: bool) -> None:
        """Take a step of the track: its length, its duration, and whether it is significant."""
        self._covariance[1, 1] += _USUAL_CHANGES * seconds
        self._moved += [units, seconds * parallax, seconds]
        units, significant, seconds = self._moved.tolist()
        if seconds < _SPEED_OVER:
            return
        self._moved = np.zeros(3)
        if significant > seconds / 2:
            self._correct(_SPEED_IN_UNITS, float(np.log(units / seconds)), _SPEED_SIGMA**2)

    def _correct(self, row: Array, observed: float, noise: float) -> None:
        """Correct the state by an observation of row @ state (2,), with its variance."""
        spread = self._covariance @ row
        gain = spread / (row @ spread + noise)
        self._mean = self._mean + gain * (observed - row @ self._mean)
        self._covariance = self._covariance - np.outer(gain, spread)
        self._left = self._left - gain * (row @ self._left)

    def _observation(self, measured: Length, units: float, sigma: float, seconds: float
                     ) -> tuple[float, float, float] | None:
        """
        Return (log factor, its variance, metres) if the length is significant, None otherwise.

        A length that may be noise about zero is that of a camera that stands still. A significant
        one has an error e of at most a quarter of it, by _OUTLIER, so what the first order leaves
        out of log(1 + e) = e - e^2 / 2 + ... is less than an eighth of e. The higher the frame
        rate, the shorter the steps; those of a second are significant together if their errors
        are independent: the sum of n has n times the length, and sqrt(n) times the error.
        """
        # The common error does not average out.
        variance = max(measured.sigma**2 - (self._share * measured.value)**2, 0.0)
        step = np.array([measured.value, variance, units, (sigma * units)**2, seconds])
        taken = step if _significant(step) else self._sum + step
        significant = _significant(taken)
        self._sum = taken if not significant and taken[4] < _SUMMED_OVER else np.zeros(5)
        if not significant:
            return None
        metres, variance, units, units_variance, _ = taken.tolist()
        noise = max(variance / metres**2, _LEAST_NOISE**2) + units_variance / units**2
        return float(np.log(metres / units)), noise, metres

    def _observe(self, observed: float, noise: float, metres: float, correlation: float) -> None:
        """Take an observation of the log factor, with its variance, over some metres."""
        if not self.metric:
            self._set(observed, noise)
            return
        innovation = observed - self.log
        if innovation**2 > _OUTLIER * (self.variance + noise):
            self._outliers += [1, metres]
            if (self._outliers < [_IN_A_ROW, _CORRELATION_LENGTHS * correlation]).any():
                return
            self._covariance[0, 0] += innovation**2
        self._outliers = np.zeros(2)
        # n lengths with one error in common are as sure as one: each has n times the noise.
        noise *= max(correlation / metres, 1.0)
        self._correct(_FACTOR, observed, noise)

    def _set(self, log: float, variance: float) -> None:
        """Set the factor; the usual speed in units of the track stays as known as it was."""
        speed = _SPEED_IN_UNITS @ self._mean
        spread = _SPEED_IN_UNITS @ self._covariance @ _SPEED_IN_UNITS
        self._mean = np.array([log, speed + log])
        self._covariance = np.full((2, 2), variance) + np.diag([0.0, spread])
        self._left = np.array([0.0, _SPEED_IN_UNITS @ self._left])
        self.metric = True


def _significant(lengths: Array) -> bool:
    """Return whether a length (metres, variance, ...) is more than noise about zero."""
    return bool(lengths[0]**2 > _OUTLIER * lengths[1])
