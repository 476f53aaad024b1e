"""
Online estimation of radial distortion that remains in the images, from windows of frames.

A calibration, and rectification, may leave some radial distortion: points u = (X/Z, Y/Z) appear at
u (1 + k1 |u|^2). On straight roads poses and depths absorb nearly all of it; in turns they do not,
and uncorrected it makes lengths of steps drift.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from djet_ros.core.geometry import rays
from djet_ros.core.types import Array
import numpy as np

# chosen: prior standard deviation of the distortion, as relative displacement of the farthest
# corner.
_CORNER_DISPLACEMENT = 0.01

# Pixels; chosen: standard deviation of a systematic error that looks like distortion in all
# windows.
_SYSTEMATIC_ERROR = 0.01

# chosen: no lens deviates by k1 alone, so each set of points prefers another k1: standard
# deviation of that, relative to the prior one.
_MODEL_ERROR = 0.3

# Standard errors; more than usual, since the test is repeated over and over.
_SIGNIFICANT = 4.0

# chosen: prior odds that there is no distortion.
_PRIOR_ODDS = 20.0


@dataclass(frozen=True)
class SelfCalibration:
    """
    Estimate of k1.

    mean, covariance: (2,) and (2, 2) of k1, if there is any, and of the systematic error that
    looks like it, in pixels; prior_sigma: prior standard deviation of k1; corrected_k1: k1 that
    images are already corrected for, and corrected_sigma: its standard deviation when that was
    chosen.
    """

    mean: Array
    covariance: Array
    prior_sigma: float
    corrected_k1: float = 0.0
    corrected_sigma: float = np.inf

    @classmethod
    def unknown(cls, K: Array, shape: tuple[int, ...]) -> SelfCalibration:
        """Return the prior for a camera matrix (3, 3) and the shape (H, W) of its images."""
        height, width = shape
        corners = rays(K, np.array([[0, 0], [width, 0], [0, height], [width, height]]))[:, :2]
        prior_sigma = _CORNER_DISPLACEMENT / float((corners**2).sum(1).max())
        return cls(np.zeros(2), np.diag([prior_sigma, _SYSTEMATIC_ERROR])**2, prior_sigma)

    @property
    def sigma(self) -> float:
        """Return the standard deviation of k1, if there is any distortion."""
        return float(np.sqrt(self.covariance[0, 0]))

    @property
    def significant(self) -> bool:
        """Return whether the distortion is significant."""
        return abs(float(self.mean[0])) > _SIGNIFICANT * self.sigma

    @property
    def k1(self) -> float:
        """
        Return the expected coefficient: next to zero until it is significant.

        The odds of no distortion grow by the ratio of posterior to prior density at zero (Dickey,
        Annals of Mathematical Statistics 1971). A k1 that fluctuates costs more than one that is
        never estimated: with each change the lengths of steps change.
        """
        z = float(self.mean[0]) / self.sigma
        none = _PRIOR_ODDS * self.prior_sigma / self.sigma * np.exp(-z**2 / 2)
        return float(self.mean[0] / (1 + none))

    @property
    def residual_k1(self) -> float:
        """Return the expected k1 that remains in images as they are corrected now."""
        return self.k1 - self.corrected_k1

    @property
    def needs_update(self) -> bool:
        """
        Return whether images should be corrected with a new k1.

        First when it becomes significant, then each time its variance has halved: a few times in
        all, and never back and forth, as the variance never grows.
        """
        if np.isinf(self.corrected_sigma):
            return self.significant
        return 2 * self.sigma**2 < self.corrected_sigma**2

    def corrected(self) -> SelfCalibration:
        """Return the same after images have been corrected for the expected k1."""
        return replace(self, corrected_k1=self.k1, corrected_sigma=self.sigma)

    def update(self, k1: float, variance: float, sensitivity: float) -> SelfCalibration:
        """
        Update the estimate with the result of one window, by a Kalman filter.

        k1: best for the window in images as they are corrected, variance: from the noise of its
        observations; sensitivity: root mean square, in pixels, of the residuals that a k1 of one
        leaves after poses and depths have adapted. Where it is small, as on a straight road, a
        small systematic error has the same effect as a large k1; comparing with turns, where it is
        not, separates the two.
        """
        row = np.array([1.0, 1 / sensitivity])
        noise = variance + (_MODEL_ERROR * self.prior_sigma)**2
        gain = self.covariance @ row / (row @ self.covariance @ row + noise)
        covariance = self.covariance - np.outer(gain, row @ self.covariance)
        innovation = self.corrected_k1 + k1 - row @ self.mean
        return replace(self, mean=self.mean + gain * innovation,
                       covariance=(covariance + covariance.T) / 2)
