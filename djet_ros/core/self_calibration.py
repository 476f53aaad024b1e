"""
Online estimation of what a calibration gets wrong, from windows of frames.

A calibration, and rectification, may be off by some radial distortion, focal length or principal
point: see `core.correction`. On straight roads poses and depths absorb nearly all of it; in turns
they do not, and uncorrected it makes lengths of steps drift, and turns directions of motion.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

from djet_ros.core.correction import AS_CALIBRATED, Correction, OF_CAMERA
from djet_ros.core.geometry import rays
from djet_ros.core.types import Array
import numpy as np
from scipy.special import softmax

# chosen: prior standard deviation of the distortion, as displacement of the farthest corner
# relative to its distance from the principal point; and those of the focal length and of the
# principal point, which a calibration determines better, as a share of the focal length.
_CORNER_DISPLACEMENT, _SHARE = 0.01, 0.005

# Pixels; chosen: standard deviation of a systematic error that looks like a parameter in all
# windows.
_SYSTEMATIC_ERROR = 0.01

# chosen: no camera deviates by these parameters alone, so each set of points prefers others:
# standard deviation of that, relative to the prior one.
_MODEL_ERROR = 0.2

# Which parameters may be right: none of them, at last all.
_SUBSETS = np.array(list(np.ndindex(*[2] * OF_CAMERA)), bool)

# chosen: prior odds that a parameter is right, and probability below which it is beyond doubt that
# not all are.
_PRIOR_ODDS, _DOUBT = 5.0, 0.01

# chosen: standard deviation of what windows miss of a deviation, relative to what they find.
_MISSED = 0.4

# Least share of the largest sensitivity: directions below are not measured.
_LEAST_SENSITIVITY = 1e-9


@dataclass(frozen=True)
class SelfCalibration:
    """
    Estimate of a camera's deviation from its calibration.

    mean, covariance: (8,) and (8, 8) of the fields of a `Correction`, if the calibration is wrong,
    relative to prior_sigmas (4,), and of systematic errors in pixels that look like them; focal:
    calibrated focal lengths in pixels (2,); corrected: what images are already corrected for.
    """

    mean: Array
    covariance: Array
    prior_sigmas: Array
    focal: Array
    corrected: Correction = AS_CALIBRATED

    @classmethod
    def unknown(cls, K: Array, shape: tuple[int, ...]) -> SelfCalibration:
        """Return the prior for a camera matrix (3, 3) and the shape (H, W) of its images."""
        height, width = shape
        corners = rays(K, np.array([[0, 0], [width, 0], [0, height], [width, height]]))[:, :2]
        farthest = float(np.linalg.norm(corners, axis=1).max())
        prior = np.repeat([1.0, _SYSTEMATIC_ERROR], OF_CAMERA)**2
        return cls(np.zeros(2 * OF_CAMERA), np.diag(prior),
                   np.array([_CORNER_DISPLACEMENT / farthest**2, _SHARE, _SHARE, _SHARE]),
                   np.diag(K)[:2])

    @property
    def deviation(self) -> Correction:
        """Return the deviation, if there is any."""
        return Correction(*(self.mean[:OF_CAMERA] * self.prior_sigmas).tolist())

    @property
    def sigmas(self) -> Correction:
        """Return its standard deviations."""
        return Correction(
            *(np.sqrt(np.diag(self.covariance)[:OF_CAMERA]) * self.prior_sigmas).tolist())

    @property
    def _of_fields(self) -> Array:
        return self.covariance[:OF_CAMERA, :OF_CAMERA]

    @cached_property
    def _right(self) -> float:
        """
        Return the probability that the calibration is right.

        Each parameter may be right by itself: few of them may explain what all windows have shown.
        The odds that some are right grow by the ratio of posterior to prior density where they are
        zero (Dickey, Annals of Mathematical Statistics 1971).
        """
        mean = np.where(_SUBSETS, self.mean[:OF_CAMERA], 0.0)
        blocks = np.where(_SUBSETS[:, :, None] & _SUBSETS[:, None], self._of_fields,
                          np.eye(OF_CAMERA))
        squared = (mean * np.linalg.solve(blocks, mean[:, :, None])[:, :, 0]).sum(1)
        logs = (_SUBSETS.sum(1) * np.log(_PRIOR_ODDS)
                - (np.linalg.slogdet(blocks)[1] + squared) / 2)
        return float(softmax(logs)[-1])

    @property
    def significant(self) -> bool:
        """Return whether the calibration is wrong beyond doubt."""
        return self._right < _DOUBT

    @property
    def needs_update(self) -> bool:
        """
        Return whether images should be corrected anew.

        If the deviation is significant, or was, and differs from what is corrected by more than
        the uncertainty, a standard deviation for each parameter. That is so when it becomes
        significant, and about each time that its variance has halved: a few times in all. With
        each correction the lengths of steps change, so one that fluctuates would cost more than
        one that is never made.
        """
        if not (self.significant or any(self.corrected)):
            return False
        change = np.subtract(self.deviation, self.corrected) / self.prior_sigmas
        return bool(change @ np.linalg.solve(self._of_fields, change) > OF_CAMERA)

    def after_correction(self) -> SelfCalibration:
        """
        Return the same after images have been corrected for the deviation.

        Windows before saw only part of it, for landmarks that disagreed most were outliers: from
        now on it is less certain along what was corrected.
        """
        covariance = self.covariance.copy()
        missed = _MISSED * np.subtract(self.deviation, self.corrected) / self.prior_sigmas
        covariance[:OF_CAMERA, :OF_CAMERA] += np.outer(missed, missed)
        return replace(self, corrected=self.deviation, covariance=covariance)

    def update(self, sensitivity: Array, gradient: Array, noise: float) -> SelfCalibration:
        """
        Update the estimate with the result of one window, by a Kalman filter.

        sensitivity: (4, 4) mean square, in pixels, of the residuals that a deviation leaves after
        poses and depths have adapted, as a quadratic form; gradient: (4,) half the derivative of
        the mean square residual in images as they are corrected; noise: variance, in pixels^2, of
        the mean residual along any axis of the sensitivity. Where the sensitivity is small, as on
        a straight road, a small systematic error has the same effect as a large deviation;
        comparing with turns, where it is not, separates the two.
        """
        scale = self.prior_sigmas
        squares, axes = np.linalg.eigh(scale[:, None] * sensitivity * scale)
        measured = squares > _LEAST_SENSITIVITY * squares[-1]
        by_axis = np.sqrt(squares[measured])[:, None] * axes[:, measured].T
        rows = np.concatenate([by_axis, axes[:, measured].T], axis=1)
        seen = (by_axis @ (np.array(self.corrected) / scale)
                - by_axis @ (scale * gradient) / squares[measured])
        spread = rows @ self.covariance @ rows.T + noise * np.eye(len(rows)) + (
            _MODEL_ERROR**2 * by_axis @ by_axis.T)
        gain = np.linalg.solve(spread, rows @ self.covariance).T
        covariance = self.covariance - gain @ rows @ self.covariance
        return replace(self, mean=self.mean + gain @ (seen - rows @ self.mean),
                       covariance=(covariance + covariance.T) / 2)
