"""
Graded binary tests: by how much, and not only which of, two places is the brighter one.

A bit of a descriptor flips where its two places are equally bright, so most of what a Hamming
surface says hangs on tests that a little noise would turn. A graded test passes by degrees from
one outcome to the other, g = clip(I(p) - I(q), -s, s) with s the grading. The distance of two
graded descriptors, the sum of |g - g'| / 2s, is the Hamming distance where all tests are decided.
"""

from __future__ import annotations

from djet_ros.core.hamming import Image, Pixels, sum_over_tests
import numpy as np
from numpy.typing import NDArray

Grades = NDArray[np.int8]


def grades(p: Image, q: Image, grading: float) -> Grades:
    """Grades of tests with intensities p and q, both (T, N), in steps of two gray levels."""
    reach = _reach(grading)
    return np.asarray(np.clip(_halved(p) - _halved(q), -reach, reach), np.int8)


def graded_surfaces(reference: Grades, smoothed: Image, centres: Pixels, radius: int,
                    grading: float) -> NDArray[np.float32]:
    """
    Graded match residual, in bits, for all |v_x|, |v_y| <= radius around centres y_k.

    reference: (T, N) grades at x_k, of the first T tests; centres: (N, 2) whole pixels in the
    smoothed image B; grading in gray levels. Gives (P, P, N) with P = 2 radius + 1, indexed
    [v_y + radius, v_x + radius, k]. Raises ValueError where a window does not fit into the image.
    """
    reach = _reach(grading)

    def differ(outcomes: Grades, reference: Grades) -> NDArray[np.uint8]:
        np.clip(outcomes, np.int8(-reach), np.int8(reach), out=outcomes)
        np.subtract(outcomes, reference, out=outcomes)
        np.abs(outcomes, out=outcomes)
        return outcomes.view(np.uint8)

    sums = sum_over_tests(reference, _halved(smoothed), centres, radius, np.subtract, differ,
                          most=2 * reach)
    return np.divide(sums, 2 * reach, dtype=np.float32)


def _halved(intensities: Image) -> Grades:
    """Half of intensities, whose differences fit into bytes."""
    return np.asarray(intensities >> 1, np.int8)


def _reach(grading: float) -> int:
    """Largest grade: the grading in steps of two gray levels."""
    return max(1, round(grading / 2))
