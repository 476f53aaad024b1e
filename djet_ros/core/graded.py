"""
Graded binary tests: soft comparisons of two intensities in place of descriptor bits.

A descriptor bit flips where its two intensities are equal, so most of a Hamming surface depends on
tests that a little noise decides. A graded test saturates instead of jumping: g = clip(I(p) -
I(q), -s, s), with s the grading. The distance of two graded descriptors, the sum of |g - g'| / 2s,
equals the Hamming distance where all tests are saturated.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
from djet_ros import compiled
from djet_ros.core.hamming import (
    endpoints_of,
    have_neighbours,
    Image,
    ImagePoints,
    invert_warps,
    MAX_DEPTH_RATIO,
    passes,
    Pixels,
    require_describable,
    sum_over_tests,
    Tests,
    warped_intensities,
)
from djet_ros.core.orb_pattern import reach as reach_of, TESTS
from djet_ros.core.parallel import map_parallel
from djet_ros.core.types import Array
import numpy as np
from numpy.typing import NDArray

Grades = NDArray[np.int16]

# Quantisation steps per gray level: whole gray levels would bias the minima of weak surfaces
# towards whole pixels.
_PER_LEVEL = 4


def smooth_finely(gray: Image, scale: float = 1.0) -> Grades:
    """Smooth an (H, W) uint8 image as `smooth` does, to quarters of a gray level."""
    kernel = cv2.getGaussianKernel(7, 2 * scale)
    return np.asarray(cv2.sepFilter2D(gray, cv2.CV_16S, _PER_LEVEL * kernel, kernel), np.int16)


def grades(p: NDArray[Any], q: NDArray[Any], grading: float,
           contrast: float | Array = 1.0) -> Grades:
    """
    Return the grades of tests from fine intensities p and q (T, N), in quarters of a gray level.

    contrast: ratio of the contrast of the image to compare with over that of their own, one for
    all or (N,). Between pixels p and q are float32.
    """
    reach = _largest_grade(grading)
    differences = p - q
    if differences.dtype != np.int16 or np.any(contrast != 1):
        differences = np.rint(differences * np.asarray(contrast, np.float32))
    return np.asarray(np.clip(differences, -reach, reach), np.int16)


def warped_grades(warp: Array, images: Sequence[ImagePoints], points: Array, grading: float,
                  contrast: float | Array, tests: Tests = TESTS) -> Grades:
    """
    Return grades (T, N) of tests on patches seen through warps, see `hamming.warped_intensities`.

    contrast: as in `grades`.
    """
    if compiled.library is None or not have_neighbours(images):
        return grades(*warped_intensities(warp, images, points, tests), grading, contrast)
    inverse, nearer, is_bent = invert_warps(warp, tests)
    nearer[~is_bent] = 0
    places, ends = points.astype(np.float32), endpoints_of(tests)
    of_each = np.broadcast_to(np.float32(contrast), len(points))

    def sample(task: tuple[list[ImagePoints], slice]) -> Grades:
        part, block = task
        return compiled.warped_grades(
            part, (inverse[block], nearer[block]), places[block], of_each[block], ends,
            _largest_grade(grading), MAX_DEPTH_RATIO)

    none = np.empty((len(tests), 0), np.int16)
    return np.concatenate([none, *map_parallel(sample, passes(images))], axis=1)


def graded_surfaces(reference: Grades, fine: Grades, centres: Pixels, radius: int,
                    grading: float, tests: Tests = TESTS) -> NDArray[np.float32]:
    """
    Return the graded match residual, in bits, for all |v_x|, |v_y| <= radius around centres y_k.

    reference: (T, N) grades at x_k by T tests; centres: (N, 2) whole pixels in the finely smoothed
    image B; grading in gray levels. Returns (P, P, N) with P = 2 radius + 1, indexed [v_y +
    radius, v_x + radius, k]. Raises ValueError if a window does not fit into the image.
    """
    reach = _largest_grade(grading)
    if compiled.library is not None and radius <= compiled.MOST_RADIUS:
        require_describable(centres, fine, radius, tests)
        return compiled.graded_surfaces(reference, fine, centres, radius, tests, reach_of(tests),
                                        reach)

    def differ(outcomes: Grades, reference: Grades) -> NDArray[np.uint16]:
        np.clip(outcomes, np.int16(-reach), np.int16(reach), out=outcomes)
        np.subtract(outcomes, reference, out=outcomes)
        np.abs(outcomes, out=outcomes)
        return outcomes.view(np.uint16)

    sums = sum_over_tests(reference, fine, centres, radius, tests, np.subtract, differ,
                          most=2 * reach)
    return np.divide(sums, 2 * reach, dtype=np.float32)


def _largest_grade(grading: float) -> int:
    """Return the largest grade: the grading in quarters of a gray level."""
    return max(1, round(_PER_LEVEL * grading))
