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
from djet_ros.core.geometry import inverses
from djet_ros.core.hamming import gather_patches, Image
from djet_ros.core.paraboloid import times
from djet_ros.core.parallel import each
from djet_ros.core.types import Array
import numpy as np
from numpy.typing import NDArray

Gray = NDArray[Any]

# Pixels from the middle of a patch to its side.
_RADIUS = 5

# The side of a patch with what its slopes take beside it, and the offsets (2, P) of all of that.
_SIDE = 2 * _RADIUS + 3
_SQUARE = np.mgrid[:_SIDE, :_SIDE][::-1].reshape(2, -1).astype(np.float32) - (_RADIUS + 1)

# Steps, and pixels that they come to at most: farther off is something else.
_STEPS, _FARTHEST = 2, 1

# Square gray levels; where a patch has no more slope than this, nothing tells where it is.
_LEAST_SLOPE = 1e-3

# Patches per pass: bounds the memory that they take (3 MB).
_BLOCK = 1024


def place_exactly(there: Gray, here: Image, x: Array, y: Array, warp: Array) -> Array:
    """
    Give where patches around x (N, 2) of one gray image are in another, next to y (N, 2), (N, 2).

    there: (H, W), as float32 it need not be converted; here: (H, W) uint8;
    warp: (N, 3, 2) how they are seen there, see `geometry.patch_warp`; so small a patch needs but
    the derivatives dy/dx, its first two rows, which must not be singular. By Gauss-Newton steps on
    the differences of gray levels under the slopes of the warped patch ("inverse compositional",
    Baker and Matthews, IJCV 2004), whose brightness and contrast are free: haze and clouds change
    them. What would go far, or lies at the border, stays at y.
    """
    places, floating = y.copy(), there.astype(np.float32, copy=False)

    def refine(start: int) -> None:
        block = slice(start, start + _BLOCK)
        places[block] = expect(floating, x[block], warp[block]).place(here, y[block])

    each(refine, range(0, len(y), _BLOCK))
    return places


class Expected(NamedTuple):
    """
    N patches of P pixels as they are expected: what tells where they are.

    slopes: (2, P, N) float32 along x and y, but for what a brighter patch or one of more contrast
    would look like; inverse: (N, 2, 2) of the sums of their products.
    """

    slopes: Gray
    inverse: Array

    @classmethod
    def together(cls, parts: Sequence[Expected]) -> Expected:
        """Put patches of several images together."""
        return cls(np.concatenate([one.slopes for one in parts], axis=2),
                   np.concatenate([one.inverse for one in parts]))

    def place(self, here: Image, y: Array) -> Array:
        """Give where they are (N, 2) in an image, next to y (N, 2), see ``place_exactly``."""
        margin = _RADIUS + 1 + _FARTHEST
        inside = within(y, here.shape, margin)
        # Those at the border are looked for elsewhere, to no end.
        began = np.where(inside[:, None], y, margin)
        places = began
        for _ in range(_STEPS):
            gray = _between_pixels(here, places, _RADIUS).reshape(self.slopes.shape[1:])
            step = -times(self.inverse, (self.slopes * gray).sum(1).T.astype(float))
            places = np.clip(places + step, began - _FARTHEST, began + _FARTHEST)
        near = inside & (np.abs(places - began).max(1, initial=0) < _FARTHEST)
        return np.where(near[:, None], places, y)


def expect(image: Gray, points: Array, warp: Array) -> Expected:
    """Tell how patches around points (N, 2) of a float32 image look through a warp (N, 3, 2)."""
    back = inverses(warp[:, :2]).astype(np.float32)
    x, y = (points[:, axis, None].astype(np.float32) + back[:, axis] @ _SQUARE for axis in (0, 1))
    # Points first: what is near one another in the image comes one after the other.
    by_point = cv2.remap(image, x, y, cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)
    wide = np.asarray(cv2.transpose(by_point)).reshape(_SIDE, _SIDE, -1)
    gray = _without_mean(wide[1:-1, 1:-1])
    contrast = (gray * gray).sum(0) + _LEAST_SLOPE
    gx, gy = (slope - (slope * gray).sum(0) / contrast * gray for slope in (
        _without_mean((wide[1:-1, 2:] - wide[1:-1, :-2]) / 2),
        _without_mean((wide[2:, 1:-1] - wide[:-2, 1:-1]) / 2)))
    xx, xy, yy = (products.sum(0).astype(float) for products in (gx * gx, gx * gy, gy * gy))
    G = np.stack([xx + _LEAST_SLOPE, xy, xy, yy + _LEAST_SLOPE], axis=1).reshape(-1, 2, 2)
    return Expected(np.stack([gx, gy]), inverses(G))


def _between_pixels(image: Image, points: Array, radius: int) -> Gray:
    """Interpolate patches (S, S, N) around points (N, 2), all of them within the image."""
    whole = np.floor(points).astype(np.int64)
    x, y = (points - whole).T.astype(np.float32)
    # One row and column more than is wanted, on the far side.
    patches = gather_patches(image, whole, radius + 1)[1:, 1:].astype(np.float32)
    rows = patches[:-1] + y * (patches[1:] - patches[:-1])
    return np.asarray(rows[:, :-1] + x * (rows[:, 1:] - rows[:, :-1]))


def within(points: Array, shape: tuple[int, ...], margin: float) -> NDArray[np.bool_]:
    """(N,) bool mask of the points (N, 2) at least so far from the border of an image."""
    upper = np.array([shape[1], shape[0]]) - 1 - margin
    return np.asarray(((points >= margin) & (points <= upper)).all(1))


def _without_mean(patches: Gray) -> Gray:
    """Take patches (S, S, N), as (P, N), less their means."""
    patches = patches.reshape(-1, patches.shape[2])
    return np.asarray(patches - patches.mean(0))
