"""
Relative pose by other libraries, as their manuals show it, on the matches that ours get.

Where a default would hold one of them back, it is set, and stands here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
from djet_ros.core.geometry import epipolar_lines, fundamental, line_distances, unit
from djet_ros.core.hamming import match_distances
from djet_ros.core.types import Array, RelativePose, Status, View
import numpy as np
from numpy.typing import NDArray

# R (3, 3), t (3,) and the inliers (N,) bool, or None where nothing was found.
Found = tuple[Array, Array, NDArray[np.bool_]] | None

# Of OpenCV's searches; that of all its examples.
CONFIDENCE = 0.999
# Baselines beyond which a point has no vote between the four poses of an essential matrix. By
# default 50, beyond which all points are where a hand moves a camera a millimetre or two.
FARTHEST = 1e6
# Pixels where PoseLib's refinement bends its Cauchy loss, instead of its own 0.5: see ``chains``.
LOSS_SCALE = 0.25


def opencv_ransac(K: Array, x: Array, y: Array, threshold: float) -> Found:
    """Find the pose by findEssentialMat with plain RANSAC, and recoverPose."""
    return _opencv(cv2.RANSAC, K, x, y, threshold)


def usac_magsac(K: Array, x: Array, y: Array, threshold: float) -> Found:
    """Find the pose by findEssentialMat with MAGSAC++, and recoverPose."""
    return _opencv(cv2.USAC_MAGSAC, K, x, y, threshold)


def poselib(K: Array, x: Array, y: Array, threshold: float) -> Found:
    """Find the pose by PoseLib's LO-RANSAC, refined; all but LOSS_SCALE is at its defaults."""
    import poselib as library

    # The image size is part of a camera there, but not of this estimate.
    camera = {'model': 'PINHOLE', 'width': int(2 * K[0, 2]), 'height': int(2 * K[1, 2]),
              'params': [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]}
    pose, info = library.estimate_relative_pose(
        x, y, camera, camera, {'max_epipolar_error': threshold}, {'loss_scale': LOSS_SCALE})
    return np.asarray(pose.R), np.asarray(pose.t), np.asarray(info['inliers'], dtype=bool)


ESTIMATORS: dict[str, Callable[[Array, Array, Array, float], Found]] = {
    'opencv_ransac': opencv_ransac, 'usac_magsac': usac_magsac, 'poselib': poselib}


def estimate(name: str, previous: View, current: View, x: Array, y: Array, threshold: float,
             min_matches: int) -> RelativePose:
    """
    Estimate the pose of matches x, y (N, 2) in pixels by the peer of that name.

    Matches end on their epipolar line at the place nearest to y, as with re-projection error.
    """
    if len(x) < min_matches:
        return RelativePose(Status.TOO_FEW_MATCHES, x=x, y=y)
    result = as_relative_pose(ESTIMATORS[name](current.K, x, y, threshold), current.K, x, y)
    if result.status is not Status.OK:
        return result
    return replace(result, hamming=match_distances(previous.smoothed, x, current.smoothed,
                                                   result.y_opt))


def as_relative_pose(found: Found, K: Array, x: Array, y: Array) -> RelativePose:
    """Say what was found for matches x, y (N, 2) in our words, without Hamming distances."""
    if found is None or not (np.isfinite(found[0]).all() and found[1].any()):
        return RelativePose(Status.DEGENERATE, x=x, y=y)
    R, t, inliers = found[0], unit(found[1]), found[2]
    lines = epipolar_lines(fundamental(K, R, t), x)
    residuals = line_distances(lines, y)
    return RelativePose(Status.OK, R, t, x=x, y=y,
                        y_opt=y - residuals[:, None] * unit(lines[:, :2]),
                        inliers=inliers, residuals=residuals)


def _opencv(method: int, K: Array, x: Array, y: Array, threshold: float) -> Found:
    E, mask = cv2.findEssentialMat(x, y, K, method=method, prob=CONFIDENCE,
                                   threshold=threshold)
    if E is None or E.shape != (3, 3):
        return None
    inliers = mask.ravel() > 0
    _, R, t, _, _ = cv2.recoverPose(E, x, y, K, distanceThresh=FARTHEST, mask=mask.copy())
    return np.asarray(R, np.float64), np.asarray(t, np.float64).ravel(), inliers
