"""
The three residual surfaces: descriptor (D-JET), photometric (P-JET), re-projection (RP-E).

They differ only in the paraboloid that they put around a point of the current image; the joint
optimiser does not know which one it is given.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Protocol

import cv2
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.graded import graded_surfaces, grades, smooth_finely
from djet_ros.core.hamming import (
    describable,
    hamming_surfaces,
    intensities,
    intensities_through,
    Pixels,
)
from djet_ros.core.paraboloid import (
    fit_paraboloids,
    indefinite,
    Paraboloids,
    project_to_positive,
)
from djet_ros.core.types import Array, View
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

# The outermost of a descriptor's tests is 13 pixels off, and moves by a quarter of a pixel.
_WARP_STEP = 0.02


class ResidualSurface(Protocol):
    """
    What the joint optimiser asks of a match residual.

    x: (N, 2) pixels of the reference points in the previous image.
    """

    x: Array

    def around(self, y: Array, warp: Array | None = None) -> Paraboloids:
        """
        Paraboloids of the residual, valid in the neighbourhood of y (N, 2).

        warp: (N, 2, 2) how the surroundings of x are seen around y, the derivatives dy/dx; None
        where that is not known, and for surfaces that are to be as the paper has them.
        """
        ...


class DescriptorSurface:
    """
    Match residual of descriptors, H(d(x_k), d(y_k + v)), sampled on whole pixels (D-JET).

    H is the Hamming distance, or that of graded tests.
    """

    def __init__(self, previous: View, current: View, x: Array, config: EstimatorConfig) -> None:
        pixels = np.rint(x).astype(np.int64)
        self._distances = DescriptorDistances(config)
        self._previous, self._current = (self._distances.seen(v) for v in (previous, current))
        self._has_reference = describable(pixels, self._previous.shape)
        self._reference = np.zeros((config.binary_tests, len(x)), self._distances.dtype)
        self._reference[:, self._has_reference] = self._distances.reference(
            self._previous, pixels[self._has_reference])
        self._pixels, self._warp = pixels, np.repeat(np.eye(2)[None], len(x), axis=0)
        self._radius = config.window // 2
        self._sigma = config.window_sigma
        self._latest = _no_paraboloids(len(x))
        self.x = pixels.astype(float) if config.snap_reference else x

    def around(self, y: Array, warp: Array | None = None) -> Paraboloids:
        """Fit paraboloids to the surfaces around the whole pixels next to y."""
        anew = np.zeros(len(y), bool) if warp is None else self._see_through(warp)
        centres = np.rint(y).astype(np.int64)
        usable = self._has_reference & describable(centres, self._current.shape, self._radius)
        # Most windows stay on their pixel from one round to the next, and so does their fit.
        stale = usable & (anew | (centres != self._latest.centres).any(1))
        surfaces = self._distances.surfaces(self._reference[:, stale], self._current,
                                            centres[stale], self._radius)
        fitted = fit_paraboloids(surfaces, centres[stale].astype(float), self._sigma)
        self._latest = replace(_put(self._latest, fitted, stale), usable=usable)
        # A match that never had a surface stays where it is.
        latest = self._latest.centres
        return replace(self._latest, centres=np.where(np.isnan(latest), y, latest))

    def _see_through(self, warp: Array) -> NDArray[np.bool_]:
        """Sample reference descriptors through a warp; (N,) bool mask of those that it changed."""
        anew: NDArray[np.bool_] = self._has_reference & (
            np.abs(warp - self._warp).max((1, 2)) > _WARP_STEP)
        self._reference[:, anew] = self._distances.reference(
            self._previous, self._pixels[anew], warp[anew])
        self._warp = np.where(anew[:, None, None], warp, self._warp)
        return anew


class DescriptorDistances:
    """The distance between descriptors that a configuration asks for: graded, or Hamming's."""

    def __init__(self, config: EstimatorConfig) -> None:
        self._grading, self._count = config.grading, config.binary_tests
        self.dtype: type[np.generic] = np.int16 if self._grading else np.bool_

    def seen(self, view: View) -> NDArray[Any]:
        """Image (H, W) of a view as the tests see it, that `reference` and `surfaces` take."""
        return smooth_finely(view.gray) if self._grading else view.smoothed

    def reference(self, seen: NDArray[Any], points: Pixels,
                  warp: Array | None = None) -> NDArray[Any]:
        """
        Descriptors (T, N) at (N, 2) whole pixels, perhaps seen through a warp (N, 2, 2).

        Raises ValueError where a point is too close to the border for a descriptor, and there is
        no warp.
        """
        p, q = (intensities(seen, points, self._count) if warp is None else
                intensities_through(warp, seen, points, self._count))
        return grades(p, q, self._grading) if self._grading else p < q

    def surfaces(self, reference: NDArray[Any], seen: NDArray[Any], centres: Pixels,
                 radius: int) -> NDArray[Any]:
        """Distances (P, P, N) in bits between references (T, N) and all pixels of windows."""
        if self._grading:
            return graded_surfaces(reference, seen, centres, radius, self._grading)
        return hamming_surfaces(reference, seen, centres, radius)


class PhotometricSurface:
    """Lucas-Kanade residual with structure tensor A' and a weight window (P-JET)."""

    def __init__(self, previous: View, current: View, x: Array, config: EstimatorConfig) -> None:
        radius = config.window // 2
        steps = np.arange(-radius, radius + 1, dtype=np.float32)
        offsets = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        self._radius, self._offsets = radius, offsets
        self._weights = _weight_window(offsets, config.window_sigma)
        self._image = current.smoothed.astype(np.float32)
        self._gradient = [
            np.asarray(cv2.Scharr(self._image, cv2.CV_32F, *order, scale=1 / 32), np.float32)
            for order in ((1, 0), (0, 1))]
        self._previous = previous.smoothed.astype(np.float32)
        self._reference = self._sample(self._previous, x)
        self._has_reference = self._inside(x, previous.smoothed.shape)
        self.x = x

    def around(self, y: Array, warp: Array | None = None) -> Paraboloids:
        """Second-order expansion of the intensity residual at the sub-pixel positions y."""
        if warp is not None:
            self._reference = self._sample(self._previous, self.x, warp)
        difference = self._reference - self._sample(self._image, y)
        gx, gy = (self._sample(component, y) for component in self._gradient)
        W = self._weights
        a11, a12, a22 = (((gx * gx) @ W), ((gx * gy) @ W), ((gy * gy) @ W))
        A = np.stack([a11, a12, a12, a22], axis=1).reshape(-1, 2, 2).astype(float)
        b = -np.stack([(gx * difference) @ W, (gy * difference) @ W], axis=1).astype(float)
        c = (difference**2 @ W).astype(float)
        usable = self._has_reference & self._inside(y, self._image.shape)
        return Paraboloids(np.array(y, float), A, b, c, usable)

    def _sample(self, image: NDArray[np.float32], points: Array,
                warp: Array | None = None) -> NDArray[np.float32]:
        """
        Bilinear samples (N, P^2) of the window around each point, as it looks through a warp.

        Before OpenCV 5, ``cv2.remap`` rounds positions to a 32nd of a pixel.
        """
        offsets = self._offsets.T if warp is None else np.linalg.inv(warp) @ self._offsets.T
        places = np.moveaxis(points[:, :, None] + offsets, 1, 0)
        return np.asarray(map_coordinates(image, places[::-1], order=1, mode='nearest'))

    def _inside(self, points: Array, shape: tuple[int, ...]) -> NDArray[np.bool_]:
        margin = self._radius + 1
        upper = np.array([shape[1], shape[0]]) - 1 - margin
        return np.asarray(((points >= margin) & (points <= upper)).all(1))


class ReprojectionSurface:
    """Squared distance to the observed point: A' = I, b = 0, c = 0 at the original y (RP-E)."""

    def __init__(self, x: Array, y: Array) -> None:
        self.x = x
        self._y = y

    def around(self, y: Array, warp: Array | None = None) -> Paraboloids:
        """Give the same circular paraboloid wherever the keypoint has moved."""
        n = len(y)
        return Paraboloids(self._y, np.repeat(np.eye(2)[None], n, axis=0), np.zeros((n, 2)),
                           np.zeros(n), np.ones(n, bool))


def with_minimum(paraboloids: Paraboloids, policy: str) -> tuple[Paraboloids, int]:
    """
    Decide what becomes of indefinite surfaces, and count them.

    policy: 'project' gives them the nearest bowl, 'drop' marks them unusable, 'keep' leaves them
    as the paper prints them.
    """
    bad = indefinite(paraboloids) & paraboloids.usable
    if policy == 'project':
        paraboloids = project_to_positive(paraboloids)
    elif policy == 'drop':
        paraboloids = replace(paraboloids, usable=paraboloids.usable & ~bad)
    return paraboloids, int(bad.sum())


def _weight_window(offsets: NDArray[np.float32], sigma: float) -> NDArray[np.float32]:
    if sigma <= 0:
        return np.ones(len(offsets), np.float32)
    return np.asarray(np.exp(-(offsets**2).sum(1) / (2 * sigma**2)), np.float32)


def _no_paraboloids(n: int) -> Paraboloids:
    return Paraboloids(np.full((n, 2), np.nan), np.repeat(np.eye(2)[None], n, axis=0),
                       np.zeros((n, 2)), np.zeros(n), np.zeros(n, bool))


def _put(paraboloids: Paraboloids, fitted: Paraboloids,
         places: NDArray[np.bool_]) -> Paraboloids:
    """Give the paraboloids with those at some places (N,) bool replaced by fitted ones."""
    arrays = {name: getattr(paraboloids, name).copy() for name in ('centres', 'A', 'b', 'c')}
    for name, array in arrays.items():
        array[places] = getattr(fitted, name)
    return replace(paraboloids, **arrays)
