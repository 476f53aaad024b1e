"""
Graded binary tests: by how much, and not only which of, two places is the brighter one.

A bit of a descriptor flips where its two places are equally bright, so most of what a Hamming
surface says hangs on tests that a little noise would turn. A graded test passes by degrees from
one outcome to the other, g = clip(I(q) - I(p), -s, s) with s the grading. The distance of two
graded descriptors, the sum of |g - g'| / 2s, is the Hamming distance where all tests are decided.
"""

from __future__ import annotations

from djet_ros.core.hamming import gather_patches, Image, Pixels, require_describable
from djet_ros.core.orb_pattern import REACH, TESTS
import numpy as np
from numpy.typing import NDArray

Grades = NDArray[np.int8]

# Points per pass of the tests: bounds the memory that their patches take (2 MB).
_BLOCK = 2048


def grades(p: Image, q: Image, grading: float) -> Grades:
    """Grades of tests with intensities p and q, both (T, N), in steps of two gray levels."""
    reach = _reach(grading)
    return np.asarray(np.clip(_halved(q) - _halved(p), -reach, reach), np.int8)


def graded_surfaces(reference: Grades, smoothed: Image, centres: Pixels, radius: int,
                    grading: float) -> NDArray[np.float32]:
    """
    Graded match residual, in bits, for all |v_x|, |v_y| <= radius around centres y_k.

    reference: (T, N) grades at x_k, of the first T tests; centres: (N, 2) whole pixels in the
    smoothed image B; grading in gray levels. Gives (P, P, N) with P = 2 radius + 1, indexed
    [v_y + radius, v_x + radius, k]. Raises ValueError where a window does not fit into the image.
    """
    require_describable(centres, smoothed, radius)
    reach, halved = _reach(grading), np.asarray(smoothed >> 1, np.uint8)
    surfaces = np.empty((2 * radius + 1, 2 * radius + 1, len(centres)), np.float32)
    for start in range(0, len(centres), _BLOCK):
        block = slice(start, start + _BLOCK)
        patches = gather_patches(halved, centres[block], REACH + radius).view(np.int8)
        # Grades chosen by a mask come points first, which is slower to subtract.
        total = _summed_differences(np.ascontiguousarray(reference[:, block]), patches, radius,
                                    reach)
        np.divide(total, 2 * reach, out=surfaces[:, :, block], dtype=np.float32)
    return surfaces


def _summed_differences(reference: Grades, patches: Grades, radius: int,
                        reach: int) -> NDArray[np.uint16]:
    side = 2 * radius + 1
    total = np.zeros((side, side, patches.shape[2]), np.uint16)
    # As many tests at once as can be summed in bytes, and stay in the cache.
    at_once = min(255 // (2 * reach), 32)
    buffer = np.empty((at_once, *total.shape), np.int8)
    tests = (TESTS[:len(reference)] + REACH).tolist()
    for first in range(0, len(tests), at_once):
        some = slice(first, first + at_once)
        grade = buffer[:len(tests[some])]
        for one, (px, py, qx, qy) in zip(grade, tests[some]):
            np.subtract(patches[qy:qy + side, qx:qx + side], patches[py:py + side, px:px + side],
                        out=one)
        np.clip(grade, np.int8(-reach), np.int8(reach), out=grade)
        np.subtract(grade, reference[some, None, None], out=grade)
        np.abs(grade, out=grade)
        total += np.add.reduce(grade.view(np.uint8), axis=0, dtype=np.uint8)
    return total


def _halved(intensities: Image) -> Grades:
    """Half of intensities, whose differences fit into bytes."""
    return np.asarray(intensities >> 1, np.int8)


def _reach(grading: float) -> int:
    """Largest grade: the grading in steps of two gray levels."""
    return max(1, round(grading / 2))
