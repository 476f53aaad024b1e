"""ORB detection (paper, "Descriptor"), and descriptor matching of any features."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import cv2
from djet_ros import compiled
from djet_ros.core.geometry import norms
from djet_ros.core.masks import Mask
from djet_ros.core.parallel import map_parallel, run_both
from djet_ros.core.types import Array, Features
import numpy as np
from numpy.typing import NDArray

# Number of features of the previous image that are compared at once, which bounds the memory.
_STRIP = 64

# Maximum change of the octave of a feature: one is a factor of 1.2 in size.
_MAX_OCTAVE_CHANGE = 1

# Bits by which a feature at the search radius has to be more similar than one at the predicted
# place.
_DISTANCE_BITS = 32


def detect_orb(gray: NDArray[np.uint8], max_features: int, fast_threshold: int = 20,
               mask: Mask | None = None) -> Features:
    """
    Detect ORB features in a gray image (H, W) uint8; none in images too small for a descriptor.

    The descriptors are the usual rotated ones, for robust initial matching; the residual surfaces
    use unrotated ones (`djet_ros.core.hamming`). mask: (H, W) bool, True where no feature may be.
    """
    orb = cv2.ORB.create(nfeatures=max_features, fastThreshold=fast_threshold)
    keypoints: Sequence[cv2.KeyPoint] = ()
    descriptors = None
    if min(gray.shape) > orb.getEdgeThreshold():  # the pyramid fails on images of a pixel or two
        keypoints, descriptors = orb.detectAndCompute(
            gray, None if mask is None else np.where(mask, 0, 255).astype(np.uint8))
    if descriptors is None:
        descriptors = np.empty((0, 32), np.uint8)
    return Features.with_descriptors(
        points=np.array(cv2.KeyPoint.convert(keypoints), np.float64).reshape(-1, 2),
        octaves=np.array([k.octave for k in keypoints], np.int32),
        angles=np.array([k.angle for k in keypoints], np.float32),
        responses=np.array([k.response for k in keypoints], np.float32),
        descriptors=np.asarray(descriptors, np.uint8))


def match_everywhere(previous: Features, current: Features) -> NDArray[np.int64]:
    """
    Match all features with all by Hamming distance, with cross-check.

    For the preset ``paper``; the paper does not say how it matches. Returns (M, 2) indices into
    the previous and the current features, in the order of the former.
    """
    if not len(previous) or not len(current):
        return np.empty((0, 2), np.int64)
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(
        previous.descriptors, current.descriptors)
    return np.array([(m.queryIdx, m.trainIdx) for m in matches], np.int64).reshape(-1, 2)


def match_nearby(previous: Features, current: Features,
                 search_radius: float) -> NDArray[np.int64]:
    """
    Match features within search_radius pixels by Hamming distance, with cross-check.

    Returns (M, 2) indices into the previous and the current features, the most similar first. Only
    features of similar octave are compared, and of two similar ones the nearer is preferred. The
    comparison runs over strips of the image: several times faster than brute force over all pairs,
    and with fewer false matches.
    """
    if not len(previous) or not len(current):
        return np.empty((0, 2), np.int64)
    rows, columns = _octave_column_order(previous), _octave_column_order(current)
    x, y = previous.points[rows], current.points[columns]
    strips = _search_strips(previous.octaves[rows], x[:, 0], current.octaves[columns],
                            y[:, 0], search_radius)
    # Small numbers: single precision suffices.
    centre, weight = x.mean(0), np.sqrt(_DISTANCE_BITS / 2) / search_radius
    claim, best_previous, best_current = most_similar(
        strips, (previous.descriptors[rows], (x - centre) * weight),
        (current.descriptors[columns], (y - centre) * weight))
    distances = norms(y[claim] - x)
    mutual = (claim >= 0) & (best_previous == best_current[claim]) & (distances <= search_radius)
    best = np.flatnonzero(mutual)[np.argsort(-best_previous[mutual], kind='stable')]
    return _one_to_one(np.stack([rows[best], columns[claim[best]]], axis=1))


def most_similar(strips: NDArray[np.int64], previous: tuple[NDArray[np.uint8], Array],
                 current: tuple[NDArray[np.uint8], Array]
                 ) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32]]:
    """
    Find the most similar features in strips of two images.

    previous, current: descriptors (N, 32) and positions (N, 2) of N and of M features; strips: (S,
    4), each the range [first, after) of previous features, and the range of current ones to
    compare with. Similarity is 64 - Hamming distance / 2 - distance of positions^2. Returns the
    index of the most similar current feature for each previous one (N,), -1 if it is compared with
    none, its similarity (N,), and the highest similarity of each current feature (M,).
    """
    if compiled.library is not None:
        return compiled.most_similar(strips, previous, current)
    claim = np.full(len(previous[0]), -1)
    best_previous = np.full(len(previous[0]), -np.inf, np.float32)
    best_current = np.full(len(current[0]), -np.inf, np.float32)
    left, right = _similarity_factors(previous, current)
    bounds = [(slice(*strip[:2]), slice(*strip[2:])) for strip in strips.tolist()]
    compared = map_parallel(lambda two: _best_matches(left[two[0]], right[two[1]]), bounds)
    for (strip, candidates), (nearest, highest, highest_current) in zip(bounds, compared):
        claim[strip] = np.where(highest > best_previous[strip], nearest + candidates.start,
                                claim[strip])
        np.maximum(best_previous[strip], highest, out=best_previous[strip])
        np.maximum(best_current[candidates], highest_current, out=best_current[candidates])
    return claim, best_previous, best_current


def _one_to_one(matches: NDArray[np.int64]) -> NDArray[np.int64]:
    """Keep the first of matches (M, 2) that share a feature, as identical descriptors do."""
    for side in (0, 1):
        first = np.full(matches[:, side].max(initial=-1) + 1, len(matches))
        np.minimum.at(first, matches[:, side], np.arange(len(matches)))
        matches = matches[first[matches[:, side]] == np.arange(len(matches))]
    return matches


def _best_matches(left: NDArray[np.float32], right: NDArray[np.float32],
                  ) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32]]:
    """Return the best of `right` for each of `left`, its similarity, and the reverse."""
    similarity = left @ right.T
    nearest = similarity.argmax(1)
    return nearest, similarity[np.arange(len(nearest)), nearest], similarity.max(0)


def _octave_column_order(features: Features) -> NDArray[np.int64]:
    return np.lexsort((features.points[:, 0], features.octaves))


def _similarity_factors(previous: tuple[NDArray[np.uint8], Array],
                        current: tuple[NDArray[np.uint8], Array]
                        ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return factors (N, 260) and (M, 260) whose product is the similarity of features."""
    (one, a), (other, b) = previous, current
    one_a, one_b = np.ones((len(a), 1)), np.ones((len(b), 1))
    square_a, square_b = ((p * p).sum(1, keepdims=True) for p in (a, b))
    return run_both(lambda: signed_bits(one, 2 * a, -square_a, -one_a),
                    lambda: signed_bits(other, b, one_b, square_b))


def signed_bits(descriptors: NDArray[np.uint8], *places: Array) -> NDArray[np.float32]:
    """
    Return descriptor bits (N, 256) as +-1/2, with further columns appended.

    The product of two of them is 64 - Hamming distance / 2.
    """
    columns = 256 + sum(place.shape[1] for place in places)
    signed = np.empty((len(descriptors), columns), np.float32)
    np.subtract(np.unpackbits(descriptors, axis=1), np.float32(0.5), out=signed[:, :256])
    if places:
        np.concatenate(places, axis=1, out=signed[:, 256:], casting='same_kind')
    return signed


def _search_strips(octaves_previous: NDArray[np.int32], x_previous: Array,
                   octaves_current: NDArray[np.int32], x_current: Array,
                   search_radius: float) -> NDArray[np.int64]:
    """
    Return strips (S, 4) of features of one octave with the range of candidates in the other image.

    As in `most_similar`. Features are sorted by octave, and by column x within these.
    """
    parts = [np.empty((0, 4), np.int64)]
    for octave in np.unique(octaves_previous).tolist():
        start, end = octaves_previous.searchsorted([octave, octave + 1])
        first = np.arange(start, end, _STRIP)
        last = np.minimum(first + _STRIP, end)
        reach = x_previous[first] - search_radius, x_previous[last - 1] + search_radius
        octaves = np.arange(octave - _MAX_OCTAVE_CHANGE, octave + _MAX_OCTAVE_CHANGE + 2)
        bounds = octaves_current.searchsorted(octaves)
        # Ordered by strip, then by octave.
        strips = np.stack([np.stack([first, last, *(
            lower + x_current[lower:upper].searchsorted(x) for x in reach)], axis=1)
            for lower, upper in pairwise(bounds)], axis=1).reshape(-1, 4)
        parts.append(strips[strips[:, 2] < strips[:, 3]])
    return np.concatenate(parts)
