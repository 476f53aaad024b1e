"""
Patch alignment: sub-pixel positions of patches seen through known warps (Lucas and Kanade).

Optical flow assumes that a window only translates. Where the image of a surface also grows or
slants, the flow is biased: by a tenth of a pixel ahead of a car. Once depths are known, the warp
is too.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
from djet_ros import compiled
from djet_ros.core.geometry import inverses
from djet_ros.core.hamming import (
    blocks,
    floating,
    gather_patches,
    have_neighbours,
    Image,
    ImagePoints,
    passes,
)
from djet_ros.core.paraboloid import times
from djet_ros.core.parallel import map_parallel
from djet_ros.core.types import Array
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

Gray = NDArray[Any]

# Pixels from the centre of a patch to its side.
_RADIUS = 5

# Side of a patch with the border that its gradients need, and the homogeneous offsets of its
# pixels (3, P).
_SIDE = 2 * _RADIUS + 3
_SQUARE = np.concatenate([np.mgrid[:_SIDE, :_SIDE][::-1].reshape(2, -1) - (_RADIUS + 1),
                          np.ones((1, _SIDE**2))]).astype(np.float32)

# Gauss-Newton steps, cheap after the first, and their limit in pixels: a larger displacement is a
# false alignment.
_STEPS, _MAX_SHIFT = 3, 1

# Pixels from the image border that a patch and its steps need.
_MARGIN = _RADIUS + 1 + _MAX_SHIFT

# Regularisation of the gradients' normal matrix, in square gray levels: without gradient a
# position is undetermined.
_LEAST_SLOPE = 1e-3

# Variance of the quantisation to whole gray levels in two images.
_LEAST_NOISE = 2 / 12

# Pixels; chosen: error of interpolation and of the warp's shape, however sharp a patch is.
# Landmarks, which are observed many times, would otherwise be far overconfident.
_LEAST_ERROR = 0.01

# Parameters fitted to a patch: its position (2), brightness and contrast.
_PARAMETERS = 4

# Patches per pass of the NumPy implementation, which bounds its memory (4 MB).
_BLOCK = 1024


class Aligned(NamedTuple):
    """
    Positions (N, 2) of patches, and their covariances (N, 2, 2) in square pixels.

    Covariances follow from the residual and the gradients of each patch, as in any least squares.
    They compare matches well, but not their absolute size: model errors are correlated over whole
    regions, so that errors are up to three times as large, with one common factor in a pair.
    """

    places: Array
    covariances: Array


def unaligned(y: Array) -> Aligned:
    """Return positions y (N, 2) as they are, with unit covariances."""
    return Aligned(y.copy(), np.tile(np.eye(2), (len(y), 1, 1)))


def align_patches(previous: Image, current: Image, x: Array, y: Array, warp: Array) -> Aligned:
    """
    Align patches around x (N, 2) of one gray image with another, starting from y (N, 2).

    previous, current: (H, W) uint8; warp: (N, 3, 2) from the former to the latter, see
    `geometry.patch_warp`; only the derivatives dy/dx, the first two rows, are used for so small a
    patch, and must not be singular. Gauss-Newton on gray levels with the gradients of the warped
    patch ("inverse compositional", Baker and Matthews, IJCV 2004), with free brightness and
    contrast: haze and clouds change them. Patches that would move far, or are near the border,
    stay at y.
    """
    if compiled.library is not None and len(y):
        return align_all([(previous, len(x))], x, warp, current, y)
    places, covariances = y.copy(), np.empty((len(y), 2, 2))

    def refine(start: int) -> None:
        block = slice(start, start + _BLOCK)
        places[block], covariances[block] = align_all(
            [(previous, len(x[block]))], x[block], warp[block], current, y[block])

    map_parallel(refine, range(0, len(y), _BLOCK))
    return Aligned(places, covariances)


def align_all(images: Sequence[ImagePoints], x: Array, warp: Array, current: Image, y: Array
              ) -> Aligned:
    """Align patches as `align_patches`, with x (N, 2) ordered by several gray images."""
    inside = within(y, current.shape, _MARGIN)
    # Patches near the border are aligned elsewhere, and their result is discarded.
    start = np.where(inside[:, None], y, _MARGIN)
    if (compiled.library is None or min(current.shape) <= 2 * _MARGIN or not len(x)
            or not have_neighbours(images)):
        places, noise, spread = templates(images, x, warp).align(current, start, inside)
    else:
        places, noise, spread = _stepped(images, x, warp, current, start, inside)
    return Aligned(np.where(inside[:, None], places, y),
                   noise[:, None, None] * spread + _LEAST_ERROR**2 * np.eye(2))


def _stepped(images: Sequence[ImagePoints], x: Array, warp: Array, current: Image, start: Array,
             inside: NDArray[np.bool_]) -> tuple[Array, Array, Array]:
    """Run `Templates.align` compiled."""
    points, inverse = x.astype(np.float32), inverses(warp[:, :2]).astype(np.float32)
    tuning = np.array([_LEAST_SLOPE, _LEAST_NOISE, _STEPS, _MAX_SHIFT], float)

    def step(task: tuple[list[ImagePoints], slice]) -> tuple[Array, Array, Array]:
        part, block = task
        return compiled.align(part, current, points[block], inverse[block], start[block],
                              inside[block], tuning)

    places, noise, spread = (np.concatenate(values)
                             for values in zip(*map_parallel(step, passes(images))))
    return places, noise, spread


class Templates(NamedTuple):
    """
    N templates of P pixels: patches warped into the current image.

    slopes: (2, P, N) float32 gradients along x and y, orthogonal to a change of brightness and
    contrast; inverses: (N, 2, 2) of their normal matrices; gray: (P, N) float32 gray levels minus
    their mean; contrasts: (N,) sums of their squares.
    """

    slopes: Gray
    inverses: Array
    gray: Gray
    contrasts: Array

    def align(self, image: Image, start: Array, inside: NDArray[np.bool_]
              ) -> tuple[Array, Array, Array]:
        """
        Align the templates with an image by Gauss-Newton, starting from `start` (N, 2).

        inside: (N,) those that may move. Returns positions (N, 2), the variances (N,) of a pixel,
        and the covariances (N, 2, 2) of positions for unit variance.
        """
        patches, places = _CurrentPatches(self, image, start), start
        for _ in range(_STEPS):
            step = -times(self.inverses, patches.along_slopes(places).T)
            places = np.clip(places + step, start - _MAX_SHIFT, start + _MAX_SHIFT)
        near = inside & (np.abs(places - start).max(1, initial=0) < _MAX_SHIFT)
        places = np.where(near[:, None], places, start)
        return places, patches.noise(places), self.inverses


class _CurrentPatches:
    """Patches of the current image around moving positions, and products with templates."""

    def __init__(self, expected: Templates, image: Image, places: Array) -> None:
        self._expected, self._image, self._whole = expected, image, np.floor(places)
        self._patches = _around(image, self._whole)
        self._products = _products(expected.slopes, self._patches)

    def along_slopes(self, places: Array) -> Array:
        """Return the sums of products (2, N) of gradients and patches at positions (N, 2)."""
        return _between(self._products, self._fractions(places))

    def noise(self, places: Array) -> Array:
        """Return the variances (N,) of a pixel: the residuals of templates at positions (N, 2)."""
        gray, parts = self._expected.gray, self._fractions(places)
        patches = _between(_at_four_pixels(self._patches), parts.astype(np.float32))
        patches -= patches.mean((0, 1))
        patches = patches.reshape(gray.shape)
        left = (np.einsum('pn,pn->n', patches, patches)
                - np.einsum('pn,pn->n', patches, gray)**2 / self._expected.contrasts)
        return np.asarray(np.maximum(left / (len(gray) - _PARAMETERS), _LEAST_NOISE))

    def _fractions(self, places: Array) -> Array:
        """Return the fractions of positions (N, 2), and update patches that changed pixel."""
        # Few move to another pixel.
        changed = np.flatnonzero((np.floor(places) != self._whole).any(1))
        if len(changed):
            self._whole[changed] = np.floor(places[changed])
            patches = _around(self._image, self._whole[changed])
            self._patches[..., changed] = patches
            # Points last in memory too, unlike after fancy indexing.
            slopes = self._expected.slopes.take(changed, axis=2)
            self._products[..., changed] = _products(slopes, patches)
        return places - self._whole


def templates(images: Sequence[ImagePoints], points: Array, warp: Array) -> Templates:
    """
    Return templates: the patches around points (N, 2) as they look through warps (N, 3, 2).

    images: of the points, in their order.
    """
    to_image = np.concatenate([inverses(warp[:, :2]), points[:, :, None]], axis=2,
                              dtype=np.float32)
    x, y = (to_image[:, axis] @ _SQUARE for axis in (0, 1))
    # Points first, so that neighbours in the image are neighbours in memory.
    by_point = np.empty_like(x)
    for image, block in blocks(floating(images)):
        cv2.remap(image, x[block], y[block], cv2.INTER_LINEAR, by_point[block],
                  cv2.BORDER_REPLICATE)
    wide = np.asarray(cv2.transpose(by_point)).reshape(_SIDE, _SIDE, -1)
    middle = wide[1:-1, 1:-1]
    gray = (middle - middle.mean((0, 1))).reshape(-1, len(points))
    slopes = np.empty((2, *middle.shape), np.float32)
    np.subtract(wide[1:-1, 2:], wide[1:-1, :-2], out=slopes[0])
    np.subtract(wide[2:, 1:-1], wide[:-2, 1:-1], out=slopes[1])
    slopes = slopes.reshape(2, *gray.shape)
    slopes *= np.float32(0.5)
    contrast = np.einsum('pn,pn->n', gray, gray) + _LEAST_SLOPE
    slopes -= (np.einsum('kpn,pn->kn', slopes, gray) / contrast)[:, None] * gray
    slopes -= slopes.mean(1, keepdims=True)
    xx, xy, yy = (np.einsum('pn,pn->n', slopes[one], slopes[other]).astype(float)
                  for one, other in ((0, 0), (0, 1), (1, 1)))
    G = np.stack([xx + _LEAST_SLOPE, xy, xy, yy + _LEAST_SLOPE], axis=1).reshape(-1, 2, 2)
    return Templates(slopes, inverses(G), gray, contrast)


def _around(image: Image, whole: Array) -> Gray:
    """Return patches (S + 1, S + 1, N) around pixels (N, 2), with the next row and column."""
    return gather_patches(image, whole.astype(np.int64), _RADIUS + 1)[1:, 1:].astype(np.float32)


def _at_four_pixels(patches: Gray) -> Gray:
    """Return patches (2, 2, S, S, N) at four neighbouring pixels, rows first."""
    side = len(patches) - 1
    four = sliding_window_view(patches, (side, side), axis=(0, 1))
    return np.moveaxis(four, 2, 4)


def _products(slopes: Gray, patches: Gray) -> Gray:
    """
    Return the sums of products (2, 2, 2, N) of gradients (2, P, N) and patches at four pixels.

    Bilinear interpolation of the image is the same interpolation of these products.
    """
    four = _at_four_pixels(patches)
    return np.asarray(np.einsum('kyxn,ijyxn->ijkn', slopes.reshape(2, *four.shape[2:]), four))


def _between(products: Gray, part: Array) -> Array:
    """Interpolate (2, 2, ..., N) bilinearly, rows first, by fractions (N, 2); returns (..., N)."""
    x, y = part.T
    rows = products[0] + y * (products[1] - products[0])
    return np.asarray(rows[0] + x * (rows[1] - rows[0]))


def within(points: Array, shape: tuple[int, ...], margin: float) -> NDArray[np.bool_]:
    """Return a mask (N,) of the points (N, 2) at least `margin` from the image border."""
    upper = np.array([shape[1], shape[0]]) - 1 - margin
    return np.asarray(((points >= margin) & (points <= upper)).all(1))
