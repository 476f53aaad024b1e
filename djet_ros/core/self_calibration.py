"""
What a window of frames tells of the distortion that its images still have.

A calibration may leave some radial distortion, rectification too: points u = (X/Z, Y/Z) are seen
at u (1 + k1 |u|^2). On a straight road the poses and depths take it up, but for little; in a turn
they do not, and as long as it is unknown, lengths of steps come out ever longer or shorter.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from djet_ros.core.geometry import rays
from djet_ros.core.types import Array
import numpy as np

# chosen: share of its distance from the middle by which a calibration may leave the farthest
# corner off, as a standard deviation.
_LEFT_AT_THE_CORNER = 0.01

# Pixels; chosen: what else may look like a distortion, in all windows alike.
_ALIKE = 0.01

# chosen: no lens is off by k1 alone, so one pattern of points tells another k1 than the next one;
# as a share of how unsure k1 is at first.
_ANOTHER = 0.3

# Standard errors, more than usual: it is asked again and again.
_CERTAIN = 4.0

# chosen: how much more probable it is beforehand that nothing was left.
_RIGHT = 20.0


@dataclass(frozen=True)
class SelfCalibration:
    """
    What is known of k1.

    mean, covariance: (2,) and (2, 2) of k1, if there is any, and of what looks like it in all
    windows, in pixels; first: standard deviation of k1 before anything was told; undone: k1 that
    images are seen without by now, and unsure: how unsure it was when that was chosen.
    """

    mean: Array
    covariance: Array
    first: float
    undone: float = 0.0
    unsure: float = np.inf

    @classmethod
    def unknown(cls, K: Array, shape: tuple[int, ...]) -> SelfCalibration:
        """Begin with a camera matrix (3, 3) and the shape (H, W) of its images."""
        height, width = shape
        corners = rays(K, np.array([[0, 0], [width, 0], [0, height], [width, height]]))[:, :2]
        first = _LEFT_AT_THE_CORNER / float((corners**2).sum(1).max())
        return cls(np.zeros(2), np.diag([first, _ALIKE])**2, first)

    @property
    def sigma(self) -> float:
        """Tell how unsure k1 is, if there is any."""
        return float(np.sqrt(self.covariance[0, 0]))

    @property
    def certain(self) -> bool:
        """Whether there is a distortion, for certain."""
        return abs(float(self.mean[0])) > _CERTAIN * self.sigma

    @property
    def k1(self) -> float:
        """
        Give the coefficient that is to be expected: next to none until it is told for certain.

        That there is none has become as much more probable as the density there has grown by what
        was told (Dickey, Annals of Mathematical Statistics 1971). A k1 that wanders costs more
        than one that is never known: with each change lengths come out otherwise.
        """
        off = float(self.mean[0]) / self.sigma
        none = _RIGHT * self.first / self.sigma * np.exp(-off**2 / 2)
        return float(self.mean[0] / (1 + none))

    @property
    def left(self) -> float:
        """Give the k1 to be expected in images as they are seen by now."""
        return self.k1 - self.undone

    @property
    def due(self) -> bool:
        """
        Whether images are to be seen without another k1 from now on.

        First where there is one for certain, and then each time that twice as much is known of it:
        a few times in all, and never back and forth, as it becomes no less sure.
        """
        if np.isinf(self.unsure):
            return self.certain
        return 2 * self.sigma**2 < self.unsure**2

    def straightened(self) -> SelfCalibration:
        """Give the same where images are seen without the k1 that is to be expected."""
        return replace(self, undone=self.k1, unsure=self.sigma)

    def told(self, k1: float, variance: float, left: float) -> SelfCalibration:
        """
        Take in what a window tells, by a Kalman filter.

        k1: that suits it best in images as they are seen, variance: by the noise of its
        observations; left: pixels that a k1 of one leaves of itself, in the root mean square,
        once poses and depths have taken up what they can. Where that is little, as on a straight
        road, it takes little else to look the same: that is told from k1 by its being larger
        there than in turns.
        """
        row = np.array([1.0, 1 / left])
        noise = variance + (_ANOTHER * self.first)**2
        gain = self.covariance @ row / (row @ self.covariance @ row + noise)
        covariance = self.covariance - np.outer(gain, row @ self.covariance)
        off = self.undone + k1 - row @ self.mean
        return replace(self, mean=self.mean + gain * off,
                       covariance=(covariance + covariance.T) / 2)
