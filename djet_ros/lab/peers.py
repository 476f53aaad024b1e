"""
Relative pose by other libraries, as documented by them, on the same matches as our methods.

Defaults that would put one of them at a disadvantage are changed here; what was tried is told in
``chains``.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
from djet_ros.core.geometry import epipolar_lines, fundamental, line_distances, unit
from djet_ros.core.types import Array, RelativePose, Status
import numpy as np
from numpy.typing import NDArray

# R (3, 3), t (3,) and the inliers (N,) bool, or None if no pose was found.
Found = tuple[Array, Array, NDArray[np.bool_]] | None

# Confidence of OpenCV's RANSAC, as in its examples, and threshold in pixels. Our matches are
# accurate to a tenth of a pixel, and this RANSAC does not refine: with the usual 1 px its errors
# are twice as large; with 0.1 px they are smaller still, at several times the cost.
CONFIDENCE, RANSAC_THRESHOLD = 0.999, 0.25
# Depth in baselines beyond which points are ignored in the chirality check of recoverPose. Its
# default of 50 excludes all points if a hand-held camera moves by a millimetre or two.
FARTHEST = 1e6
# PoseLib: its own default threshold in pixels; the scale in pixels of the Cauchy loss in its
# refinement, instead of half the threshold; and the fewest iterations, instead of 1000, which take
# six times as long for errors that are the same within 3 %.
POSELIB_THRESHOLD, LOSS_SCALE, MIN_ITERATIONS = 1.0, 0.1, 100


def opencv_ransac(K: Array, x: Array, y: Array) -> Found:
    """Estimate the pose by findEssentialMat with plain RANSAC, and recoverPose."""
    return _opencv(cv2.RANSAC, K, x, y)


def usac_magsac(K: Array, x: Array, y: Array) -> Found:
    """Estimate the pose by findEssentialMat with MAGSAC++, and recoverPose."""
    return _opencv(cv2.USAC_MAGSAC, K, x, y)


def poselib(K: Array, x: Array, y: Array) -> Found:
    """Estimate the pose by PoseLib's LO-RANSAC, refined."""
    import poselib as library

    # PoseLib's cameras have an image size, which this estimate does not use.
    camera = {'model': 'PINHOLE', 'width': int(2 * K[0, 2]), 'height': int(2 * K[1, 2]),
              'params': [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]}
    pose, info = library.estimate_relative_pose(
        x, y, camera, camera,
        {'max_epipolar_error': POSELIB_THRESHOLD, 'min_iterations': MIN_ITERATIONS},
        {'loss_scale': LOSS_SCALE})
    return np.asarray(pose.R), np.asarray(pose.t), np.asarray(info['inliers'], dtype=bool)


ESTIMATORS: dict[str, Callable[[Array, Array, Array], Found]] = {
    'opencv_ransac': opencv_ransac, 'usac_magsac': usac_magsac, 'poselib': poselib}


def estimate(name: str, K: Array, x: Array, y: Array, min_matches: int) -> RelativePose:
    """
    Estimate the pose of matches x, y (N, 2) in pixels by the named method.

    y_opt is the point of the epipolar line nearest to y, as with re-projection error.
    """
    if len(x) < min_matches:
        return RelativePose(Status.TOO_FEW_MATCHES, x=x, y=y)
    return as_relative_pose(ESTIMATORS[name](K, x, y), K, x, y)


def as_relative_pose(found: Found, K: Array, x: Array, y: Array) -> RelativePose:
    """Convert a result for matches x, y (N, 2) to a RelativePose without Hamming distances."""
    if found is None or not (np.isfinite(found[0]).all() and found[1].any()):
        return RelativePose(Status.DEGENERATE, x=x, y=y)
    R, t, inliers = found[0], unit(found[1]), found[2]
    lines = epipolar_lines(fundamental(K, R, t), x)
    residuals = line_distances(lines, y)
    return RelativePose(Status.OK, R, t, x=x, y=y,
                        y_opt=y - residuals[:, None] * unit(lines[:, :2]),
                        inliers=inliers, residuals=residuals)


def _opencv(method: int, K: Array, x: Array, y: Array) -> Found:
    E, mask = cv2.findEssentialMat(x, y, K, method=method, prob=CONFIDENCE,
                                   threshold=RANSAC_THRESHOLD)
    if E is None or E.shape != (3, 3):
        return None
    inliers = mask.ravel() > 0
    _, R, t, _, _ = cv2.recoverPose(E, x, y, K, distanceThresh=FARTHEST, mask=mask.copy())
    return np.asarray(R, np.float64), np.asarray(t, np.float64).ravel(), inliers
