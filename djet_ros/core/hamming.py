"""
Dense unrotated descriptors on pyramid level 0, and the Hamming match residual Q_k around a point.

Paper: sections "Locally differentiable descriptor residual" and "Descriptor". Descriptors are
computed at whole pixels of the smoothed image, exactly as ``cv2.ORB.compute`` does for angle 0;
only patches seen through a warp are tested between pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import cv2
from djet_ros import compiled
from djet_ros.core.geometry import inverses
from djet_ros.core.orb_pattern import reach, TESTS
from djet_ros.core.parallel import map_parallel
from djet_ros.core.types import Array
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Pixels = NDArray[np.int64]
Tests = NDArray[np.int64]
# An image, and the number of points in it, of points that are ordered by image.
ImagePoints = tuple[NDArray[Any], int]

# Points per pass of the 256 tests, which bounds the memory of their patches (2 MB).
_BLOCK = 2048

# Points per pass over warped patches, each with up to 512 sample positions (2 MB); and per pass of
# loops over patches one by one, small enough to share passes between two threads.
_WARPED_BLOCK, _PASS = 256, 512

# Pixels of error at the outermost test points up to which a warp is taken as affine. On average
# over the patch the error is a seventh of that, a twentieth of the noise of a match.
_AFFINE_TOLERANCE = 0.02

# chosen: limit of the depth ratio between a part of a patch and its centre.
MAX_DEPTH_RATIO = 2.0

# Tests times points below which indexing each test point is faster than gathering patches.
_GATHER_FROM = 20_000

# Most tests per pass over the points: enough to save calls, few enough to stay in the cache.
_TESTS_AT_ONCE = 16


def smooth(gray: Image, scale: float = 1.0) -> Image:
    """
    Smooth an (H, W) image the way ORB does before its binary tests, bit for bit.

    scale: of the tests, which also scales the smoothing. ``cv2.GaussianBlur`` rounds differently
    and flips 0.07 % of the descriptor bits.
    """
    kernel = cv2.getGaussianKernel(7, 2 * scale)
    return np.asarray(cv2.sepFilter2D(gray, -1, kernel, kernel), np.uint8)


def describable(points: Pixels, shape: tuple[int, ...], radius: int = 0,
                tests: Tests = TESTS) -> NDArray[np.bool_]:
    """Return a mask (N,) of the points with a descriptor at every pixel within `radius`."""
    margin = reach(tests) + radius
    height, width = shape[:2]
    return np.asarray((points[:, 0] >= margin) & (points[:, 0] < width - margin)
                      & (points[:, 1] >= margin) & (points[:, 1] < height - margin))


def descriptor_bits(smoothed: Image, points: Pixels) -> NDArray[np.bool_]:
    """
    Return unrotated descriptors d(x), as (256, N) bits, at (N, 2) whole pixels (x, y).

    Raises ValueError if a point is too close to the border for a descriptor.
    """
    p, q = intensities(smoothed, points)
    return p < q


def intensities(smoothed: NDArray[Any], points: Pixels,
                tests: Tests = TESTS) -> tuple[NDArray[Any], NDArray[Any]]:
    """
    Sample both ends p and q of T tests around whole pixels (N, 2); each (T, N).

    Raises ValueError if a point is too close to the border for a descriptor.
    """
    require_describable(points, smoothed, 0, tests)
    if len(points) * len(tests) < _GATHER_FROM:
        width, pixels = smoothed.shape[1], np.ravel(smoothed)
        first, (px, py, qx, qy) = points[:, 1] * width + points[:, 0], tests.T[:, :, None]
        return pixels.take(py * width + px + first), pixels.take(qy * width + qx + first)
    patches = gather_patches(smoothed, points, reach(tests))
    px, py, qx, qy = tests.T + reach(tests)
    return patches[py, px], patches[qy, qx]


def warped_intensities(warp: Array, images: Sequence[ImagePoints], points: Array,
                       tests: Tests = TESTS
                       ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """
    Return intensities (T, N) float32 at both ends of T tests, on patches seen through warps.

    warp: (N, 3, 2) W and c of `geometry.patch_warp`, W not singular; images: of the points, in
    their order; points: (N, 2) pixels. A test point dy of the other image is sampled at the offset
    dx that the warp dy = W dx / (1 + c^T dx) takes to it: dx = u / (1 - c^T u) with u = W^-1 dy.
    Beyond the image, border pixels are replicated.
    """
    inverse, nearer, is_bent = invert_warps(warp, tests)
    ends, of_tests = endpoints_of(tests)
    places = points.astype(np.float32)
    values = np.empty((len(points), ends.shape[1]), np.float32)

    def sample(task: tuple[NDArray[np.float32], slice]) -> None:
        # Points first, so that neighbours in the image are neighbours in memory.
        image, block = task
        away = [inverse[block, axis] @ ends for axis in (0, 1)]
        bent = np.flatnonzero(is_bent[block])
        if len(bent):
            depths = (1 - nearer[block][bent] @ ends).clip(1 / MAX_DEPTH_RATIO, MAX_DEPTH_RATIO)
            for along in away:
                along[bent] /= depths
        x, y = (places[block, axis, None] + along for axis, along in enumerate(away))
        cv2.remap(image, x, y, cv2.INTER_LINEAR, values[block], cv2.BORDER_REPLICATE)

    map_parallel(sample, blocks(floating(images)))
    by_end = np.asarray(cv2.transpose(values)) if len(points) else values.T
    return by_end[of_tests[0]], by_end[of_tests[1]]


def invert_warps(warp: Array, tests: Tests
                 ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """
    Invert warps (N, 3, 2): return W^-1 (N, 2, 2), c^T W^-1 (N, 2), and a mask (N,).

    The mask selects the warps whose projective part matters.
    """
    inverse = inverses(warp[:, :2])
    nearer = np.einsum('ni,nij->nj', warp[:, 2], inverse)
    # Test points are up to sqrt(2) times their reach from the centre.
    bend = 2 * reach(tests)**2 * np.sqrt(np.einsum('nij,nij->n', inverse, inverse)
                                         * np.einsum('nj,nj->n', nearer, nearer))
    return inverse.astype(np.float32), nearer.astype(np.float32), bend > _AFFINE_TOLERANCE


def blocks(images: Sequence[ImagePoints], most: int = _WARPED_BLOCK
           ) -> list[tuple[NDArray[Any], slice]]:
    """Split the points of images into passes: tuples of an image and a slice of its points."""
    parts, end = [], 0
    for image, count in images:
        begin, end = end, end + count
        parts += [(image, slice(start, min(start + most, end)))
                  for start in range(begin, end, most)]
    return parts


def floating(images: Sequence[ImagePoints]) -> list[ImagePoints]:
    """Return images in float32, which OpenCV interpolates three times as fast."""
    return [(image.astype(np.float32, copy=False), count) for image, count in images]


def passes(images: Sequence[ImagePoints]) -> list[tuple[list[ImagePoints], slice]]:
    """Split points into passes, each over one or more images of the same size."""
    grouped: list[tuple[list[ImagePoints], slice]] = []
    for image, block in blocks(images, _PASS):
        part = image, block.stop - block.start
        group, first = grouped[-1] if grouped else ([], block)
        if group and group[0][0].shape == image.shape and block.stop - first.start <= _PASS:
            grouped[-1] = [*group, part], slice(first.start, block.stop)
        else:
            grouped.append(([part], block))
    return grouped


def have_neighbours(images: Sequence[ImagePoints]) -> bool:
    """Return whether images have two rows and columns, as compiled loops need."""
    return all(min(image.shape) > 1 for image, _ in images)


def endpoints_of(tests: Tests) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return the distinct points (2, E) of tests (T, 4), and the indices (2, T) of their ends."""
    return _ends(tests.tobytes())


@lru_cache(maxsize=8)
def _ends(tests: bytes) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    ends = np.frombuffer(tests, np.int64).reshape(-1, 2, 2).transpose(1, 0, 2)
    places, indices = np.unique(ends.reshape(-1, 2), axis=0, return_inverse=True)
    return places.T.astype(np.float32), indices.reshape(2, -1)


def dense_descriptors(smoothed: Image, points: Pixels) -> Image:
    """Return unrotated descriptors, packed as (N, 32) uint8 like those of ``cv2.ORB.compute``."""
    if not len(points):
        return np.empty((0, 32), np.uint8)
    if compiled.library is not None:
        require_describable(points, smoothed, 0)
        return compiled.describe(smoothed, points, TESTS)
    # Packing is three times as fast with points first.
    bits = np.asarray(cv2.transpose(descriptor_bits(smoothed, points).view(np.uint8)), np.uint8)
    return np.packbits(bits, axis=1, bitorder='little')


def hamming_surfaces(bits: NDArray[np.bool_], smoothed: Image, centres: Pixels,
                     radius: int, tests: Tests = TESTS) -> NDArray[np.uint16]:
    """
    Return Hamming residuals Q_k(v) = H(d(x_k), d(y_k + v)) for all |v_x|, |v_y| <= radius.

    bits: (T, N) reference descriptors d(x_k) by T tests; centres: (N, 2) whole pixels y_k in the
    smoothed image B. Returns (P, P, N) with P = 2 radius + 1, indexed [v_y + radius, v_x + radius,
    k]. Raises ValueError if a window does not fit into the image.
    """
    def differ(outcomes: NDArray[Any], reference: NDArray[Any]) -> NDArray[np.uint8]:
        np.not_equal(outcomes, reference, out=outcomes)
        return outcomes.view(np.uint8)

    sums = sum_over_tests(bits, smoothed, centres, radius, tests, np.less, differ, most=1)
    return sums.astype(np.uint16)


def sum_over_tests(reference: NDArray[Any], image: NDArray[Any], centres: Pixels, radius: int,
                   tests: Tests, outcome: np.ufunc, differ: Callable[..., NDArray[Any]],
                   most: int) -> NDArray[np.uint32]:
    """
    Sum the differences of all tests from a reference, at every pixel of a window.

    reference: (T, N) of T tests; image: (H, W); centres: (N, 2) whole pixels in it. outcome(I(p),
    I(q)) is a test, of the dtype of the reference; differ(outcomes, reference), which may
    overwrite the outcomes, is unsigned, of the same width, and at most `most`. Returns (P, P, N)
    with P = 2 radius + 1, indexed [v_y + radius, v_x + radius, k]. Raises ValueError if a window
    does not fit into the image.
    """
    require_describable(centres, image, radius, tests)
    sums = np.empty((2 * radius + 1, 2 * radius + 1, len(centres)), np.uint32)
    # As many tests at once as can be summed without overflow.
    at_once = min(_TESTS_AT_ONCE, np.iinfo(f'u{reference.itemsize}').max // most)
    for start in range(0, len(centres), _BLOCK):
        block = slice(start, start + _BLOCK)
        patches = gather_patches(image, centres[block], reach(tests) + radius)
        # Masking returns arrays with points first, which are three times slower to compare.
        chosen = np.ascontiguousarray(reference[:, block])
        sums[:, :, block] = _summed(chosen, patches, radius, tests, outcome, differ, at_once)
    return sums


def _summed(reference: NDArray[Any], patches: NDArray[Any], radius: int, tests: Tests,
            outcome: np.ufunc, differ: Callable[..., NDArray[Any]],
            at_once: int) -> NDArray[np.uint32]:
    side = 2 * radius + 1
    total = np.zeros((side, side, patches.shape[2]), np.uint32)
    buffer = np.empty((at_once, *total.shape), reference.dtype)
    places = (tests + reach(tests)).tolist()
    for first in range(0, len(places), at_once):
        chunk = slice(first, first + at_once)
        outcomes = buffer[:len(places[chunk])]
        for result, (px, py, qx, qy) in zip(outcomes, places[chunk]):
            outcome(patches[py:py + side, px:px + side], patches[qy:qy + side, qx:qx + side],
                    out=result)
        differences = differ(outcomes, reference[chunk, None, None])
        total += np.add.reduce(differences, axis=0, dtype=differences.dtype)
    return total


def match_distances(smoothed_a: Image, x: Array, smoothed_b: Image, y: Array,
                    known: tuple[Array, Array] | None = None) -> Array:
    """
    Return Hamming distances H(d(x), d(y)), (N,) bits, at the whole pixels nearest to x, y (N, 2).

    known: earlier places y' (N, 2) and their distances, reused if y has the same pixel. NaN if one
    of the two is too close to the border for a descriptor.
    """
    if known is not None:
        stale = ~(np.rint(known[0]) == np.rint(y)).all(1)
        distances = known[1].copy()
        distances[stale] = match_distances(smoothed_a, x.compress(stale, axis=0), smoothed_b,
                                           y.compress(stale, axis=0))
        return distances
    if compiled.library is not None and smoothed_a.shape == smoothed_b.shape:
        return compiled.match_distances(smoothed_a, x, smoothed_b, y, TESTS, reach(TESTS))
    x_pixels, y_pixels = np.rint(x).astype(np.int64), np.rint(y).astype(np.int64)
    wanted = describable(x_pixels, smoothed_a.shape) & describable(y_pixels, smoothed_b.shape)
    distances = np.full(len(x), np.nan)
    differing = (descriptor_bits(smoothed_a, x_pixels.compress(wanted, axis=0))
                 != descriptor_bits(smoothed_b, y_pixels.compress(wanted, axis=0)))
    distances[wanted] = differing.view(np.uint8).sum(0, dtype=np.uint16)
    return distances


def gather_patches(image: NDArray[Any], centres: Pixels, reach: int) -> NDArray[Any]:
    """Return square patches (S, S, N), points last: each test runs over contiguous memory."""
    side = 2 * reach + 1
    if not len(centres):
        # The image may be smaller than a window.
        return np.empty((side, side, 0), image.dtype)
    # A view of all patches, by their first pixels. A row as one item is copied in half the time.
    image, (height, width) = np.ascontiguousarray(image), image.shape
    down, right = image.strides
    windows = np.ndarray((height - side + 1, width - side + 1, side),
                         f'V{side * image.itemsize}', image, strides=(down, right, down))
    patches = windows[centres[:, 1] - reach, centres[:, 0] - reach].view(image.dtype)
    # OpenCV transposes bytes ten times as fast as NumPy.
    points_last = np.asarray(cv2.transpose(patches.reshape(len(centres), side * side)))
    return points_last.reshape(side, side, len(centres))


def require_describable(points: Pixels, image: NDArray[Any], radius: int,
                        tests: Tests = TESTS) -> None:
    """Raise ValueError unless all (N, 2) points are `describable`."""
    inside = describable(points, image.shape, radius, tests)
    if not inside.all():
        raise ValueError(f'{int((~inside).sum())} points, the first at {points[~inside][0]}, are '
                         f'within {reach(tests) + radius} pixels of the image border')
