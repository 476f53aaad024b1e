"""
The three residual surfaces: descriptor (D-JET), photometric (P-JET), re-projection (RP-E).

They differ only in the paraboloid that they put around a point of the current image; the joint
optimiser does not know which one it is given.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Protocol

import cv2
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.geometry import inverses, stretches
from djet_ros.core.graded import graded_surfaces, grades, grades_through, smooth_finely
from djet_ros.core.hamming import (
    describable,
    hamming_surfaces,
    Image,
    intensities,
    intensities_through,
    Pixels,
    Shown,
    smooth,
)
from djet_ros.core.masks import at
from djet_ros.core.orb_pattern import pattern
from djet_ros.core.paraboloid import (
    fit_paraboloids,
    indefinite,
    largest,
    median,
    medians_of_parts,
    Paraboloids,
    project_to_positive,
    times,
)
from djet_ros.core.patches import as_matched, place_exactly, Placed, within
from djet_ros.core.starts import thinned
from djet_ros.core.types import Array, View
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

# The outermost of ORB's tests is 13 pixels off, and moves by a quarter of a pixel.
_WARP_STEP = 0.02

# chosen: a patch that would be stretched or shrunk by more is a false match, or no reference.
_MOST_STRETCH = 2.0

# Pixels between which a reference may stay as it was sampled.
_NEAR_ENOUGH = 0.05

# Side of the window around a place where the minimum is expected.
CLOSE = 3

# Matches and tests by which the contrast is measured, and how far it may change.
_MEASURED, _MEASURED_TESTS = 200, 32
_MOST_CONTRAST = 8.0


# Differences of tests grow by their absolute values, so that a surface is sharper at its minimum
# than the paraboloid through it, which is drawn to the pixel that it is fitted around ("pixel
# locking"): a small displacement is seen at 1 / 1.37 = 0.73 of its length, one of half a pixel as
# it is. A test measures what is left of that on rendered scenes.
_LOCKING = 0.37


class ResidualSurface(Protocol):
    """
    What the joint optimiser asks of a match residual.

    x: (N, 2) pixels of the reference points in the previous image.
    """

    x: Array

    def around(self, y: Array, warp: Array | None = None) -> Paraboloids:
        """
        Paraboloids of the residual, valid in the neighbourhood of y (N, 2).

        warp: (N, 3, 2) how the surroundings of x are seen around y, see `geometry.patch_warp`;
        None where that is not known, and for surfaces that are to be as the paper has them.
        """
        ...

    def placed(self, y: Array, warp: Array | None, chosen: NDArray[np.bool_]) -> Placed:
        """
        Places of chosen matches (N,) as found by another means than the surface, next to y.

        To be asked for matches that have a surface; warp: see ``around``.
        """
        ...


class _OfImages:
    """What surfaces of two images share: gray levels tell places too, in unsmoothed patches."""

    def __init__(self, previous: View, current: View, x: Array) -> None:
        self.x = x
        self._there, self._here = previous.gray, current.gray

    def placed(self, y: Array, warp: Array | None, chosen: NDArray[np.bool_]) -> Placed:
        """Places by gray levels, as they are seen through the warp; just y without one."""
        if warp is None:
            return as_matched(y[chosen])
        return place_exactly(self._there, self._here, *(
            values.compress(chosen, axis=0) for values in (self.x, y, warp)))


class DescriptorSurface(_OfImages):
    """
    Match residual of descriptors, H(d(x_k), d(y_k + v)), sampled on whole pixels (D-JET).

    H is the Hamming distance, or that of graded tests. References are first taken at the whole
    pixels next to x; where it is known how they look around y, they are taken between pixels, so
    that the minimum falls on a whole pixel: there a paraboloid fits without a bias, and a smaller
    window will do ("inverse compositional", Baker and Matthews, IJCV 2004).
    """

    def __init__(self, previous: View, current: View, x: Array, config: EstimatorConfig) -> None:
        super().__init__(previous, current, x)
        self._config = config
        self._distances = DescriptorDistances(config)
        self._previous, self._current = previous, current.tested
        self._has_reference = (self._distances.describable(x, previous.tested.shape)
                               & ~at(previous.mask, x))
        self._mask = current.mask
        self._latest = no_paraboloids(len(x))
        # How the reference of each match was seen last, if through a warp, and how far x is from
        # its pixel.
        self._warp = np.repeat(np.eye(3, 2)[None], len(x), axis=0)
        self._is_warped = np.zeros(len(x), bool)
        self._offset = x - np.rint(x) if config.warp_reference else np.zeros_like(x)
        self._contrast: float | None = None

    def around(self, y: Array, warp: Array | None = None) -> Paraboloids:
        """Fit paraboloids to the surfaces around the whole pixels next to y."""
        if warp is None:
            return self._around_pixels(y)
        moved = largest(self._latest.centres - y) > _NEAR_ENOUGH
        warped = largest(warp - self._warp) > _WARP_STEP
        usable = self._usable(np.rint(y), CLOSE // 2)
        # Most matches rest from one round to the next.
        anew = usable & (moved | warped | ~self._latest.usable)
        self._warp = np.where(anew[:, None, None], warp, self._warp)
        self._is_warped |= anew
        there, here, seen = (values.compress(anew, axis=0) for values in (self.x, y, warp))
        return self._kept(anew, usable, y, self._distances.between_pixels(
            self._previous.tested, there, self._current, here, seen,
            self._contrast_around(y, usable), CLOSE // 2))

    def _around_pixels(self, y: Array) -> Paraboloids:
        """Fit them with the references of whole pixels, as the paper does."""
        radius = self._config.window // 2
        centres = np.rint(y - self._offset).astype(np.int64)
        usable = self._usable(centres, radius)
        # Those seen through a warp may lie on the same place, and are of another run.
        elsewhere = (centres + self._offset != self._latest.centres).any(1)
        anew = usable & (elsewhere | self._is_warped)
        self._warp[anew], self._is_warped[anew] = np.eye(3, 2), False
        pixels = np.rint(self.x).astype(np.int64)
        references = self._distances.reference(
            self._previous.tested, pixels[anew], self._contrast_around(centres, usable))
        surfaces = self._distances.surfaces(references, self._current, centres[anew], radius)
        return self._kept(anew, usable, y, fit_paraboloids(
            surfaces, centres[anew] + self._offset[anew], self._config.window_sigma))

    def _contrast_around(self, y: NDArray[Any], usable: NDArray[np.bool_]) -> float:
        """Measure the contrast where matches are at first, and keep it."""
        if self._contrast is None:
            there = np.flatnonzero(usable)
            there = there[thinned(len(there), _MEASURED)]
            self._contrast = self._distances.contrast(
                self._previous.tested, np.rint(self.x[there]).astype(np.int64), self._current,
                np.rint(y[there]).astype(np.int64))
        return self._contrast

    def _kept(self, anew: NDArray[np.bool_], usable: NDArray[np.bool_], y: Array,
              fitted: Paraboloids) -> Paraboloids:
        """Take paraboloids that were fitted anew, for a mask (N,) of the matches, to the rest."""
        self._latest = replace(_put(self._latest, fitted, anew), usable=usable)
        # A match that never had a surface stays where it is.
        latest = self._latest.centres
        return replace(self._latest, centres=np.where(np.isnan(latest), y, latest))

    def _usable(self, centres: NDArray[Any], radius: int) -> NDArray[np.bool_]:
        return self._has_reference & ~at(self._mask, centres) & self._distances.describable(
            centres, self._current.shape, radius)


class DescriptorDistances:
    """The distance between descriptors that a configuration asks for: graded, or Hamming's."""

    def __init__(self, config: EstimatorConfig) -> None:
        self._grading, self._scale = config.grading, config.patch_scale
        self._sigma = config.window_sigma
        self._tests = pattern(config.binary_tests, config.patch_scale)

    def seen(self, gray: Image) -> NDArray[Any]:
        """Image (H, W) as the tests see it, that `reference` and `surfaces` take (View.tested)."""
        return (smooth_finely if self._grading else smooth)(gray, self._scale)

    def describable(self, points: NDArray[Any], shape: tuple[int, ...],
                    radius: int = 0) -> NDArray[np.bool_]:
        """(N,) bool mask of the points with a descriptor at every pixel within `radius`."""
        return describable(np.rint(points).astype(np.int64), shape, radius, self._tests)

    def contrast(self, there: NDArray[Any], x: Pixels, here: NDArray[Any], y: Pixels) -> float:
        """
        Contrast of an image around whole pixels y (N, 2), over that of another around x (N, 2).

        It is what a change of exposure makes it. Bits know of no contrast: 1.
        """
        some = thinned(len(x), _MEASURED)
        return contrast_of(self.strengths(here, y[some]), self.strengths(there, x[some]))

    def strengths(self, seen: NDArray[Any], points: Pixels) -> Array:
        """Tell how much (N,) an image differs around whole pixels (N, 2), see ``contrast_of``."""
        if not self._grading:
            return np.ones(len(points))
        p, q = intensities(seen, points, self._tests[:_MEASURED_TESTS])
        return np.asarray(np.abs(p - q).sum(0, dtype=float) + 1)

    def reference(self, seen: NDArray[Any], points: NDArray[Any], contrast: float = 1.0,
                  warp: Array | None = None) -> NDArray[Any]:
        """
        Descriptors (T, N) at whole pixels, or seen through a warp (N, 3, 2) at any points (N, 2).

        contrast: that of the image which they are to be compared with. Raises ValueError where a
        point is too close to the border for a descriptor, and there is no warp.
        """
        if warp is not None:
            return self._through(warp, [(seen, len(points))], points, contrast)
        p, q = intensities(seen, np.asarray(points, np.int64), self._tests)
        return grades(p, q, self._grading, contrast) if self._grading else p < q

    def _through(self, warp: Array, images: Sequence[Shown], points: Array,
                 contrast: float | Array) -> NDArray[Any]:
        if self._grading:
            return grades_through(warp, images, points, self._grading, contrast, self._tests)
        return np.less(*intensities_through(warp, images, points, self._tests))

    def surfaces(self, reference: NDArray[Any], seen: NDArray[Any], centres: Pixels,
                 radius: int) -> NDArray[Any]:
        """Distances (P, P, N) in bits between references (T, N) and all pixels of windows."""
        if self._grading:
            return graded_surfaces(reference, seen, centres, radius, self._grading, self._tests)
        return hamming_surfaces(reference, seen, centres, radius, self._tests)

    def between_pixels(self, there: NDArray[Any], x: Array, here: NDArray[Any], y: Array,
                       warp: Array, contrast: float, radius: int) -> Paraboloids:
        """
        Fit paraboloids to the distances in an image around y (N, 2), from references around x.

        References are taken between pixels, so that a minimum at y comes to lie on a whole pixel:
        there a paraboloid fits without a bias. warp: (N, 3, 2) how they are seen at y.
        """
        return self.around(self.shifted([(there, len(x))], x, y, warp, contrast), here, y, radius)

    def shifted(self, there: Sequence[Shown], x: Array, y: Array, warp: Array,
                contrast: float | Array) -> NDArray[Any]:
        """
        Descriptors (T, N) next to x whose minima at y come to lie on whole pixels.

        there: the images that x are in, one after the other; contrast: (N,) where they differ.
        """
        back = times(inverses(warp[:, :2]), y - np.rint(y))
        return self._through(warp, there, x - back, contrast)

    def around(self, references: NDArray[Any], here: NDArray[Any], y: Array,
               radius: int) -> Paraboloids:
        """Fit paraboloids to the distances in an image around y (N, 2), from `shifted` ones."""
        centres = np.rint(y).astype(np.int64)
        return _unlocked(
            fit_paraboloids(self.surfaces(references, here, centres, radius), y, self._sigma))


class PhotometricSurface(_OfImages):
    """Lucas-Kanade residual with structure tensor A' and a weight window (P-JET)."""

    def __init__(self, previous: View, current: View, x: Array, config: EstimatorConfig) -> None:
        super().__init__(previous, current, x)
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
        self._has_reference = self._inside(x, previous.smoothed.shape) & ~at(previous.mask, x)
        self._mask = current.mask

    def around(self, y: Array, warp: Array | None = None) -> Paraboloids:
        """Second-order expansion of the intensity residual at the sub-pixel positions y."""
        reference = (self._reference if warp is None
                     else self._sample(self._previous, self.x, warp))
        difference = reference - self._sample(self._image, y)
        gx, gy = (self._sample(component, y) for component in self._gradient)
        W = self._weights
        a11, a12, a22 = (((gx * gx) @ W), ((gx * gy) @ W), ((gy * gy) @ W))
        A = np.stack([a11, a12, a12, a22], axis=1).reshape(-1, 2, 2).astype(float)
        b = -np.stack([(gx * difference) @ W, (gy * difference) @ W], axis=1).astype(float)
        c = (difference**2 @ W).astype(float)
        usable = self._has_reference & self._inside(y, self._image.shape) & ~at(self._mask, y)
        return Paraboloids(np.array(y, float), A, b, c, usable)

    def _sample(self, image: NDArray[np.float32], points: Array,
                warp: Array | None = None) -> NDArray[np.float32]:
        """
        Bilinear samples (N, P^2) of the window around each point, as it looks through a warp.

        Of the warp the derivatives alone: over so small a window they hardly change.
        Before OpenCV 5, ``cv2.remap`` rounds positions to a 32nd of a pixel.
        """
        offsets = self._offsets.T if warp is None else inverses(warp[:, :2]) @ self._offsets.T
        places = np.moveaxis(points[:, :, None] + offsets, 1, 0)
        return np.asarray(map_coordinates(image, places[::-1], order=1, mode='nearest'))

    def _inside(self, points: Array, shape: tuple[int, ...]) -> NDArray[np.bool_]:
        return within(points, shape, self._radius + 1)


class ReprojectionSurface:
    """
    Squared distance to the observed point: A' = I, b = 0, c = 0 at the original y (RP-E).

    Where covariances (N, 2, 2) of y are told, A' is their inverses.
    """

    def __init__(self, x: Array, y: Array, covariances: Array | None = None) -> None:
        self.x = x
        self._y = y
        self._A = (np.repeat(np.eye(2)[None], len(y), axis=0) if covariances is None
                   else inverses(covariances))

    def around(self, y: Array, warp: Array | None = None) -> Paraboloids:
        """Give the same paraboloid wherever the keypoint has moved."""
        n = len(y)
        return Paraboloids(self._y, self._A, np.zeros((n, 2)), np.zeros(n), np.ones(n, bool))

    def placed(self, y: Array, warp: Array | None, chosen: NDArray[np.bool_]) -> Placed:
        """There is no other means."""
        return as_matched(y[chosen])


def contrast_of(here: Array, there: Array) -> float:
    """Contrast of an image over that of another, by strengths (N,) around the same points."""
    if not len(here):
        return 1.0
    return min(max(median(here / there), 1 / _MOST_CONTRAST), _MOST_CONTRAST)


def contrasts_of(here: Array, there: Array, counts: NDArray[np.int64]) -> Array:
    """Give the same (N,) for each of N points of several images, so many of each in turn."""
    ratios = medians_of_parts(here / there, counts)
    return np.repeat(np.clip(ratios, 1 / _MOST_CONTRAST, _MOST_CONTRAST), counts)


def comparable(warp: Array) -> NDArray[np.bool_]:
    """(N,) bool mask of warps (N, 3, 2) through which a patch is still like itself."""
    least, most = stretches(warp[:, :2])
    return np.asarray((least > 1 / _MOST_STRETCH) & (most < _MOST_STRETCH))


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


def _unlocked(fitted: Paraboloids) -> Paraboloids:
    """
    Move minima away from the pixel that paraboloids were fitted around, which draws them.

    A first-order inverse of d - k sin(2 pi d) / (2 pi), by which minima lie a share of d off.
    """
    drawn = _LOCKING / (2 * np.pi) * np.sin(2 * np.pi * fitted.ways)
    return replace(fitted, b=fitted.b - times(fitted.A, drawn))


def no_paraboloids(n: int) -> Paraboloids:
    """Give paraboloids of which none is usable."""
    return Paraboloids(np.full((n, 2), np.nan), np.repeat(np.eye(2)[None], n, axis=0),
                       np.zeros((n, 2)), np.zeros(n), np.zeros(n, bool))


def _put(paraboloids: Paraboloids, fitted: Paraboloids,
         places: NDArray[np.bool_]) -> Paraboloids:
    """Give the paraboloids with those at some places (N,) bool replaced by fitted ones."""
    # To take is several times as fast as to put in, of what has several axes.
    which = np.arange(len(places))
    which[places] = len(places) + np.arange(len(fitted.c))
    return replace(paraboloids, **{
        name: np.concatenate([getattr(paraboloids, name), getattr(fitted, name)]).take(
            which, axis=0) for name in ('centres', 'A', 'b', 'c')})
