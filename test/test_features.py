"""Detection and matching of ORB features, against OpenCV's own matcher."""

from __future__ import annotations

from dataclasses import replace

import cv2
from djet_ros.core.features import detect_orb, match_everywhere, match_nearby
from djet_ros.core.types import Features
import numpy as np
import pytest
from two_view import some, textured

SIZE = (320, 240)


@pytest.fixture(scope='module')
def pair():
    """Features of two images of the same wall, the second rotated a little and brighter."""
    image = textured(np.random.default_rng(21), SIZE)
    turned = cv2.warpAffine(image, cv2.getRotationMatrix2D((160, 120), 4, 1.02), SIZE,
                            borderMode=cv2.BORDER_REFLECT)
    return detect_orb(image, 700), detect_orb(cv2.convertScaleAbs(turned, alpha=1.1), 700)


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


def test_matching_everywhere_gives_mutual_nearest_neighbours(pair):
    rows, columns = match_everywhere(*pair).T
    apart = distances(*pair)
    assert (apart[rows, columns] == apart[rows].min(1)).all()
    assert (apart[rows, columns] == apart[:, columns].min(0)).all()
    assert len(rows) > 200


def scores(previous, current, radius):
    """Return descriptor distances (N, M), higher with the displacement, inf across octaves."""
    shifts = np.linalg.norm(previous.points[:, None] - current.points, axis=2)
    apart = distances(previous, current) + 32 * (shifts / radius)**2
    octaves = np.abs(previous.octaves[:, None].astype(int) - current.octaves)
    return np.where(octaves <= 1, apart, np.inf), shifts


@pytest.mark.parametrize('radius', [0.5, 15.0, 60.0, 400.0])
def test_nearby_matches_are_mutual_best_within_the_search_radius(pair, radius):
    score, shifts = scores(*pair, radius)
    rows, columns = match_nearby(*pair, radius).T
    assert (shifts[rows, columns] <= radius).all()
    near = np.where(shifts <= radius, score, np.inf)
    assert (near[rows, columns] <= near[rows].min(1) + 1e-3).all()
    assert (near[rows, columns] <= near[:, columns].min(0) + 1e-3).all()


@pytest.mark.parametrize('radius', [15.0, 60.0, 400.0])
def test_no_mutual_best_match_is_missing(pair, radius):
    score, shifts = scores(*pair, radius)
    best, back = score.argmin(1), score.argmin(0)
    second = np.partition(score, 1, axis=1)[:, 1], np.partition(score, 1, axis=0)[1]
    expected = {(i, j) for i, j in enumerate(best.tolist())
                if back[j] == i and shifts[i, j] <= radius
                # rounding may decide where two are equally good
                and second[0][i] > score[i, j] + 1e-3 and second[1][j] > score[i, j] + 1e-3}
    assert len(expected) > 50
    assert expected <= {(i, j) for i, j in match_nearby(*pair, radius).tolist()}


def test_the_nearer_of_two_similar_features_is_matched(pair):
    wall = pair[0]
    twice = Features.with_descriptors(*(np.concatenate([getattr(wall, name)] * 2) for name in (
        'points', 'octaves', 'angles', 'responses', 'descriptors')))
    twice.points[len(wall):] += (0.0, 20.0)
    _, columns = match_nearby(wall, twice, 60.0).T
    assert (columns < len(wall)).mean() > 0.95


def test_identical_descriptors_do_not_match_the_same_feature(pair):
    one = some(pair[0], slice(0, 1))
    twins = some(pair[0], [0, 0, 0])
    assert len(match_nearby(twins, one, 60.0)) == len(match_nearby(one, twins, 60.0)) == 1


def test_matches_are_one_to_one_and_the_most_similar_come_first(pair):
    rows, columns = match_nearby(*pair, 50.0).T
    score, _ = scores(*pair, 50.0)
    assert (np.diff(score[rows, columns]) > -1e-3).all()
    assert len(set(rows.tolist())) == len(set(columns.tolist())) == len(columns) > 100


def test_every_feature_finds_itself(pair):
    rows, columns = match_nearby(pair[0], pair[0], search_radius=1.0).T
    assert np.array_equal(pair[0].descriptors[rows], pair[0].descriptors[columns])
    assert len(rows) > 0.95 * len(pair[0])


@pytest.mark.parametrize('ours', [slice(0, 0), slice(0, 1), slice(None)])
@pytest.mark.parametrize('theirs', [slice(0, 0), slice(0, 1), slice(None)])
def test_few_or_no_features_give_few_or_no_matches(pair, ours, theirs):
    previous, current = some(pair[0], ours), some(pair[1], theirs)
    assert len(match_nearby(previous, current, 1e4)) <= min(len(previous), len(current))
    matches = match_everywhere(previous, current)
    assert matches.shape[1:] == (2,)
    assert len(matches) <= min(len(previous), len(current))
    assert (len(matches) == 0) == (len(previous) == 0 or len(current) == 0)
    too_far = replace(current, points=current.points + 1e5)
    assert len(match_nearby(previous, too_far, search_radius=100.0)) == 0
