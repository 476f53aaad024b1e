"""ORB detection, and matching by rotated descriptors (paper, "Descriptor")."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from djet_ros.core.types import Features


def detect_orb(gray: NDArray[np.uint8], max_features: int, fast_threshold: int = 20) -> Features:
    """
    Detect ORB features in a gray image (H, W) uint8; images too small for one give none.

    The descriptors are the usual rotated ones: the initial matching needs their robustness, the
    residual surfaces use unrotated ones (`djet_ros.core.hamming`).
    """
    orb = cv2.ORB_create(nfeatures=max_features, fastThreshold=fast_threshold)
    keypoints, descriptors = orb.detectAndCompute(gray, None)
    if descriptors is None:
        descriptors = np.empty((0, 32), np.uint8)
    return Features(
        points=np.array([k.pt for k in keypoints], np.float64).reshape(-1, 2),
        octaves=np.array([k.octave for k in keypoints], np.int32),
        angles=np.array([k.angle for k in keypoints], np.float32),
        responses=np.array([k.response for k in keypoints], np.float32),
        descriptors=np.asarray(descriptors, np.uint8))


def match_features(previous: Features, current: Features) -> NDArray[np.int64]:
    """
    Match by Hamming distance, brute force with cross-check.

    Gives (M, 2) indices into the previous and the current features, in the order of the former.
    """
    if not len(previous) or not len(current):
        return np.empty((0, 2), np.int64)
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
    matches = matcher.match(previous.descriptors, current.descriptors)
    return np.array([(m.queryIdx, m.trainIdx) for m in matches], np.int64).reshape(-1, 2)
