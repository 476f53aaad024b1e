"""Detection and matching of ORB features, against OpenCV's own matcher."""

from __future__ import annotations

import cv2
from djet_ros.core.features import detect_orb, match_features
from djet_ros.core.types import Features
import numpy as np
import pytest
from two_view import textured

SIZE = (320, 240)


@pytest.fixture(scope='module')
def pair():
    """Features of two pictures of the same wall, the second a little turned and brighter."""
    image = textured(np.random.default_rng(21), SIZE)
    turned = cv2.warpAffine(image, cv2.getRotationMatrix2D((160, 120), 4, 1.02), SIZE,
                            borderMode=cv2.BORDER_REFLECT)
    return detect_orb(image, 700), detect_orb(cv2.convertScaleAbs(turned, alpha=1.1), 700)


def some(features, chosen):
    """Give some of the features, by index or slice."""
    return Features(features.points[chosen], features.octaves[chosen], features.angles[chosen],
                    features.responses[chosen], features.descriptors[chosen])


def distances(previous, current):
    """Count the bits (N, M) in which the descriptors differ."""
    apart = previous.descriptors[:, None] ^ current.descriptors
    return np.unpackbits(apart, axis=2).sum(2, dtype=int)


def test_features_are_those_of_opencv_and_lie_in_the_image():
    image = textured(np.random.default_rng(22), SIZE)
    features = detect_orb(image, 300, fast_threshold=10)
    keypoints, descriptors = cv2.ORB.create(300, fastThreshold=10).detectAndCompute(image, None)
    assert 0 < len(features) == len(keypoints) <= 300
    assert np.allclose(features.points, [k.pt for k in keypoints])
    assert np.array_equal(features.octaves, [k.octave for k in keypoints])
    assert np.array_equal(features.descriptors, descriptors)
    assert ((features.points >= 0) & (features.points < SIZE)).all()


@pytest.mark.parametrize('image', [np.zeros((240, 320), np.uint8), np.zeros((1, 1), np.uint8)])
def test_an_image_without_corners_has_no_features(image):
    features = detect_orb(image, 300)
    assert len(features) == 0
    assert features.points.shape == (0, 2) and features.descriptors.shape == (0, 32)


def test_searching_everywhere_gives_mutual_nearest_neighbours_as_opencv_finds_them(pair):
    found = match_features(*pair, search_radius=1e4)
    apart = distances(*pair)
    rows, columns = found.T
    assert (apart[rows, columns] == apart[rows].min(1)).all()
    assert (apart[rows, columns] == apart[:, columns].min(0)).all()
    # OpenCV may choose otherwise only where a descriptor has two equally near neighbours
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
    theirs = {(m.queryIdx, m.trainIdx)
              for m in matcher.match(pair[0].descriptors, pair[1].descriptors)}
    for i, j in theirs ^ {(i, j) for i, j in found.tolist()}:
        assert ((apart[i] == apart[i].min()).sum() > 1
                or (apart[:, j] == apart[:, j].min()).sum() > 1)
    assert len(theirs & {(i, j) for i, j in found.tolist()}) > 200


@pytest.mark.parametrize('radius', [0.5, 15.0, 60.0])
def test_only_features_within_the_search_radius_compete(pair, radius):
    previous, current = pair
    apart = distances(previous, current).astype(float)
    offsets = np.linalg.norm(previous.points[:, None] - current.points, axis=2)
    apart[offsets > radius] = np.inf
    rows, columns = match_features(previous, current, radius).T
    assert np.isfinite(apart[rows, columns]).all()
    assert (apart[rows, columns] == apart[rows].min(1)).all()
    assert (apart[rows, columns] == apart[:, columns].min(0)).all()
    # and none is missing: each pair that are each other's only nearest is there
    only = (((apart == apart.min(1, keepdims=True)) & np.isfinite(apart)).sum(1) == 1)
    nearest, back = apart.argmin(1), apart.argmin(0)
    unique_back = (apart == apart.min(0)).sum(0) == 1
    expected = [(i, nearest[i]) for i in np.flatnonzero(only)
                if back[nearest[i]] == i and unique_back[nearest[i]]]
    assert set(expected) <= set(zip(rows.tolist(), columns.tolist()))


def test_matches_are_one_to_one_and_in_the_order_of_the_previous_features(pair):
    rows, columns = match_features(*pair, search_radius=50.0).T
    assert (np.diff(rows) > 0).all()
    assert len(set(columns.tolist())) == len(columns) > 100


def test_every_feature_finds_itself(pair):
    rows, columns = match_features(pair[0], pair[0], search_radius=1.0).T
    assert np.array_equal(pair[0].descriptors[rows], pair[0].descriptors[columns])
    assert len(rows) > 0.95 * len(pair[0])


@pytest.mark.parametrize('ours', [slice(0, 0), slice(0, 1), slice(None)])
@pytest.mark.parametrize('theirs', [slice(0, 0), slice(0, 1), slice(None)])
def test_few_or_no_features_give_few_or_no_matches(pair, ours, theirs):
    previous, current = some(pair[0], ours), some(pair[1], theirs)
    matches = match_features(previous, current, search_radius=1e4)
    assert matches.shape[1:] == (2,)
    assert len(matches) <= min(len(previous), len(current))
    assert (len(matches) == 0) == (len(previous) == 0 or len(current) == 0)
    too_far = Features(current.points + 1e5, current.octaves, current.angles, current.responses,
                       current.descriptors)
    assert len(match_features(previous, too_far, search_radius=100.0)) == 0
