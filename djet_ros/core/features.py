"""ORB detection, and matching by rotated descriptors (paper, "Descriptor")."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
from djet_ros.core.types import Array, Features
import numpy as np
from numpy.typing import NDArray

# Features of the previous image that are compared at once; bounds the memory of a comparison.
_STRIP = 128

# Taken off the similarity (within +-256) of features that are too far apart; subtracting is many
# times faster than assigning by mask.
_FAR = np.float32(1000.0)


def detect_orb(gray: NDArray[np.uint8], max_features: int, fast_threshold: int = 20) -> Features:
    """
    Detect ORB features in a gray image (H, W) uint8; images too small for one give none.

    The descriptors are the usual rotated ones: the initial matching needs their robustness, the
    residual surfaces use unrotated ones (`djet_ros.core.hamming`).
    """
    orb = cv2.ORB.create(nfeatures=max_features, fastThreshold=fast_threshold)
    keypoints: Sequence[cv2.KeyPoint] = ()
    descriptors = None
    if min(gray.shape) > orb.getEdgeThreshold():  # the pyramid fails on images of a pixel or two
        keypoints, descriptors = orb.detectAndCompute(gray, None)
    if descriptors is None:
        descriptors = np.empty((0, 32), np.uint8)
    return Features(
        points=np.array([k.pt for k in keypoints], np.float64).reshape(-1, 2),
        octaves=np.array([k.octave for k in keypoints], np.int32),
        angles=np.array([k.angle for k in keypoints], np.float32),
        responses=np.array([k.response for k in keypoints], np.float32),
        descriptors=np.asarray(descriptors, np.uint8))


def match_features(previous: Features, current: Features,
                   search_radius: float) -> NDArray[np.int64]:
    """
    Match by Hamming distance with cross-check, among features at most search_radius pixels apart.

    Gives (M, 2) indices into the previous and the current features, in the order of the former.
    Distances are taken as matrix products of +-1 descriptors, exactly, in vertical strips:
    several times faster than brute force over all pairs, and with fewer chances to be wrong.
    """
    if not len(previous) or not len(current):
        return np.empty((0, 2), np.int64)
    rows, columns = _from_left_to_right(previous), _from_left_to_right(current)
    there, here = previous.points[rows], current.points[columns]
    signs_there, signs_here = previous.signs[rows], current.signs[columns]
    forward = np.full(len(rows), -1, np.int64)
    backward = np.full(len(columns), -1, np.int64)
    best = np.full(len(columns), -_FAR, np.float32)
    for start in range(0, len(rows), _STRIP):
        strip = slice(start, start + _STRIP)
        left, right = there[strip][[0, -1], 0] + (-search_radius, search_radius)
        near = slice(np.searchsorted(here[:, 0], left), np.searchsorted(here[:, 0], right))
        if near.start == near.stop:
            continue
        similarity = signs_there[strip] @ signs_here[near].T
        apart = _squared_distances(there[strip], here[near]) > search_radius**2
        similarity -= apart * _FAR
        nearest = similarity.argmax(1)
        found = np.take_along_axis(similarity, nearest[:, None], 1)[:, 0] > -_FAR / 2
        forward[strip] = np.where(found, nearest + near.start, -1)
        # A current feature keeps the best claim of all strips.
        claimant = similarity.argmax(0)
        claim = np.take_along_axis(similarity, claimant[None], 0)[0]
        backward[near] = np.where(claim > best[near], claimant + start, backward[near])
        best[near] = np.maximum(claim, best[near])
    mutual = np.flatnonzero((forward >= 0) & (backward[forward] == np.arange(len(forward))))
    matches = np.stack([rows[mutual], columns[forward[mutual]]], axis=1)
    return matches[np.argsort(matches[:, 0])]


def _from_left_to_right(features: Features) -> NDArray[np.int64]:
    return np.argsort(features.points[:, 0], kind='stable')


def _squared_distances(a: Array, b: Array) -> NDArray[np.float32]:
    """Squared distances (N, M) between points (N, 2) and (M, 2), as one small matrix product."""
    centre = a.mean(0)  # keeps the terms small, so that single precision is enough
    a, b = a - centre, b - centre
    left = np.column_stack([-2 * a, (a * a).sum(1), np.ones(len(a))]).astype(np.float32)
    right = np.column_stack([b, np.ones(len(b)), (b * b).sum(1)]).astype(np.float32)
    return np.asarray(left @ right.T)
