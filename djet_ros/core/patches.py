"""
Where patches are, as they are seen through their warps (Lucas and Kanade, with a known shape).

The flow of the image takes it to shift as a whole within a window. Where it grows or leans too,
the flow says where the slopes of the window went, and not its middle: a tenth of a pixel beside
that ahead of a car. Once depths are known, so is the shape.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
from djet_ros import compiled
from djet_ros.core.geometry import inverses
from djet_ros.core.hamming import blocks, floating, gather_patches, Image, passes, Shown
from djet_ros.core.paraboloid import times
from djet_ros.core.parallel import each
from djet_ros.core.types import Array
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

Gray = NDArray[Any]

# Pixels from the middle of a patch to its side.
_RADIUS = 5

# The side of a patch with what its slopes take beside it, and the offsets of all of that with a
# one, (3, P).
_SIDE = 2 * _RADIUS + 3
_SQUARE = np.concatenate([np.mgrid[:_SIDE, :_SIDE][::-1].reshape(2, -1) - (_RADIUS + 1),
                          np.ones((1, _SIDE**2))]).astype(np.float32)

# Steps, which cost little after the first, and pixels that they come to at most: farther off is
# something else.
_STEPS, _FARTHEST = 3, 1

# Pixels from the border of an image where a patch has room for that.
_MARGIN = _RADIUS + 1 + _FARTHEST

# Square gray levels; where a patch has no more slope than this, nothing tells where it is.
_LEAST_SLOPE = 1e-3

# Square gray levels: two images are rounded to whole ones.
_LEAST_NOISE = 2 / 12

# Pixels; chosen: what interpolation between pixels and the shape of a warp err, however sharp a
# patch is. Landmarks, which are looked at many times, would be taken for far surer than they are.
_LEAST_ERROR = 0.01

# What is fitted to a patch: its place, brightness and contrast.
_FITTED = 4

# Patches per pass, where NumPy takes them side by side: bounds their memory (4 MB).
_BLOCK = 1024


class Placed(NamedTuple):
    """
    Where N patches are: places (N, 2), and the covariances (N, 2, 2) of these in square pixels.

    By what is left over of each patch and by its slopes, as in any least squares. They tell how
    matches differ, and little of their common size: what a patch does not look like differs in
    whole regions, so that errors are up to three times as large, alike in all of a pair.
    """

    places: Array
    covariances: Array


def as_matched(y: Array) -> Placed:
    """Take places (N, 2) as they were matched, all alike."""
    return Placed(y.copy(), np.tile(np.eye(2), (len(y), 1, 1)))


def place_exactly(there: Image, here: Image, x: Array, y: Array, warp: Array) -> Placed:
    """
    Give where patches around x (N, 2) of one gray image are in another, next to y (N, 2).

    there, here: (H, W) uint8;
    warp: (N, 3, 2) how they are seen there, see `geometry.patch_warp`; so small a patch needs but
    the derivatives dy/dx, its first two rows, which must not be singular. By Gauss-Newton steps on
    the differences of gray levels under the slopes of the warped patch ("inverse compositional",
    Baker and Matthews, IJCV 2004), whose brightness and contrast are free: haze and clouds change
    them. What would go far, or lies at the border, stays at y.
    """
    if compiled.library is not None and len(y):
        return place_all([(there, len(x))], x, warp, here, y)
    places, covariances = y.copy(), np.empty((len(y), 2, 2))

    def refine(start: int) -> None:
        block = slice(start, start + _BLOCK)
        places[block], covariances[block] = place_all(
            [(there, len(x[block]))], x[block], warp[block], here, y[block])

    each(refine, range(0, len(y), _BLOCK))
    return Placed(places, covariances)


def place_all(images: Sequence[Shown], x: Array, warp: Array, here: Image, y: Array) -> Placed:
    """Do the same with patches around x (N, 2) of several gray images, in whose order x are."""
    inside = within(y, here.shape, _MARGIN)
    # Those at the border are looked for elsewhere, to no end.
    began = np.where(inside[:, None], y, _MARGIN)
    if compiled.library is None or min(here.shape) <= 2 * _MARGIN or not len(x):
        places, noise, spread = expect(images, x, warp).stepped(here, began, inside)
    else:
        places, noise, spread = _stepped(images, x, warp, here, began, inside)
    return Placed(np.where(inside[:, None], places, y),
                  noise[:, None, None] * spread + _LEAST_ERROR**2 * np.eye(2))


def _stepped(images: Sequence[Shown], x: Array, warp: Array, here: Image, began: Array,
             inside: NDArray[np.bool_]) -> tuple[Array, Array, Array]:
    """Take the steps of `Expected.stepped`, compiled."""
    points, inverse = x.astype(np.float32), inverses(warp[:, :2]).astype(np.float32)
    tuning = np.array([_LEAST_SLOPE, _LEAST_NOISE, _STEPS, _FARTHEST], float)

    def step(task: tuple[list[Shown], slice]) -> tuple[Array, Array, Array]:
        seen, some = task
        return compiled.place(seen, here, points[some], inverse[some], began[some], inside[some],
                              tuning)

    places, noise, spread = (np.concatenate(values)
                             for values in zip(*each(step, passes(images))))
    return places, noise, spread


class Expected(NamedTuple):
    """
    N patches of P pixels as they are expected: what tells where they are.

    slopes: (2, P, N) float32 along x and y, but for what a brighter patch or one of more contrast
    would look like; inverses: (N, 2, 2) of the sums of their products; gray: (P, N) float32 their
    gray levels about the mean; contrasts: (N,) the sums of the squares of these.
    """

    slopes: Gray
    inverses: Array
    gray: Gray
    contrasts: Array

    def stepped(self, here: Image, began: Array, inside: NDArray[np.bool_]
                ) -> tuple[Array, Array, Array]:
        """
        Give where they are in an image, next to where they began (N, 2).

        inside: (N,) those that may move. Gives places (N, 2), the variances (N,) of a pixel, and
        the covariances (N, 2, 2) of places by such noise.
        """
        seen, places = _Seen(self, here, began), began
        for _ in range(_STEPS):
            step = -times(self.inverses, seen.along_slopes(places).T)
            places = np.clip(places + step, began - _FARTHEST, began + _FARTHEST)
        near = inside & (np.abs(places - began).max(1, initial=0) < _FARTHEST)
        places = np.where(near[:, None], places, began)
        return places, seen.noise(places), self.inverses


class _Seen:
    """What is seen of an image around places that move a little, beside what is expected."""

    def __init__(self, expected: Expected, image: Image, places: Array) -> None:
        self._expected, self._image, self._whole = expected, image, np.floor(places)
        self._patches = _around(image, self._whole)
        self._products = _products(expected.slopes, self._patches)

    def along_slopes(self, places: Array) -> Array:
        """Sum up products (2, N) of slopes and patches around places (N, 2)."""
        return _between(self._products, self._parts(places))

    def noise(self, places: Array) -> Array:
        """Variances (N,) of a pixel: what is left of patches around places (N, 2), once fitted."""
        gray, parts = self._expected.gray, self._parts(places)
        patches = _between(_at_four(self._patches), parts.astype(np.float32))
        patches -= patches.mean((0, 1))
        patches = patches.reshape(gray.shape)
        left = (np.einsum('pn,pn->n', patches, patches)
                - np.einsum('pn,pn->n', patches, gray)**2 / self._expected.contrasts)
        return np.asarray(np.maximum(left / (len(gray) - _FITTED), _LEAST_NOISE))

    def _parts(self, places: Array) -> Array:
        """Give how far places (N, 2) are from whole pixels, the patches around which are known."""
        # Few cross over to other pixels.
        across = np.flatnonzero((np.floor(places) != self._whole).any(1))
        if len(across):
            self._whole[across] = np.floor(places[across])
            patches = _around(self._image, self._whole[across])
            self._patches[..., across] = patches
            # Points last in memory too, which indexing does not give.
            slopes = self._expected.slopes.take(across, axis=2)
            self._products[..., across] = _products(slopes, patches)
        return places - self._whole


def expect(images: Sequence[Shown], points: Array, warp: Array) -> Expected:
    """
    Tell how patches around points (N, 2) look through a warp (N, 3, 2).

    images: in whose order the points are.
    """
    back = np.concatenate([inverses(warp[:, :2]), points[:, :, None]], axis=2, dtype=np.float32)
    x, y = (back[:, axis] @ _SQUARE for axis in (0, 1))
    # Points first: what is near one another in the image comes one after the other.
    by_point = np.empty_like(x)
    for image, these in blocks(floating(images)):
        cv2.remap(image, x[these], y[these], cv2.INTER_LINEAR, by_point[these],
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
    return Expected(slopes, inverses(G), gray, contrast)


def _around(image: Image, whole: Array) -> Gray:
    """Patches (S + 1, S + 1, N) of an image around pixels (N, 2), and the next row and column."""
    return gather_patches(image, whole.astype(np.int64), _RADIUS + 1)[1:, 1:].astype(np.float32)


def _at_four(patches: Gray) -> Gray:
    """Patches (2, 2, S, S, N) at four pixels, rows first, of those that hold them."""
    side = len(patches) - 1
    four = sliding_window_view(patches, (side, side), axis=(0, 1))
    return np.moveaxis(four, 2, 4)


def _products(slopes: Gray, patches: Gray) -> Gray:
    """
    Sum up products (2, 2, 2, N) of slopes (2, P, N) and of patches at four pixels, rows first.

    What lies between pixels is as linear in them as the image is.
    """
    four = _at_four(patches)
    return np.asarray(np.einsum('kyxn,ijyxn->ijkn', slopes.reshape(2, *four.shape[2:]), four))


def _between(products: Gray, part: Array) -> Array:
    """Interpolate (2, 2, ..., N) at pixels, rows first, by parts (N, 2) of the way; (..., N)."""
    x, y = part.T
    rows = products[0] + y * (products[1] - products[0])
    return np.asarray(rows[0] + x * (rows[1] - rows[0]))


def within(points: Array, shape: tuple[int, ...], margin: float) -> NDArray[np.bool_]:
    """(N,) bool mask of the points (N, 2) at least so far from the border of an image."""
    upper = np.array([shape[1], shape[0]]) - 1 - margin
    return np.asarray(((points >= margin) & (points <= upper)).all(1))
