"""Feature matching between two views: by optical flow and by descriptors."""

from __future__ import annotations

from dataclasses import replace

import cv2
from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.flow import NEAR_LEVELS, track_features
from djet_ros.core.geometry import rotation_exp
from djet_ros.core.hamming import match_distances
from djet_ros.core.matching import match_predicted, match_widely
from djet_ros.core.starts import KnownMotion
from djet_ros.core.types import Array, RelativePose, Status, View
import numpy as np
import pytest
from two_view import some, textured

SIZE = (400, 300)
K = np.array([[400.0, 0, 199.5], [0, 400.0, 149.5], [0, 0, 1]])
TURN = np.deg2rad([1.0, -3.0, 2.0])


def turned_views(max_features: int) -> tuple[View, View, Array]:
    """Two views of a far wall, and the homography (3, 3) between them."""
    image = textured(np.random.default_rng(91), SIZE)
    H = K @ rotation_exp(TURN) @ np.linalg.inv(K)
    turned = cv2.warpPerspective(image, H, SIZE, borderMode=cv2.BORDER_CONSTANT)
    estimator = TwoViewEstimator(EstimatorConfig(max_features=max_features))
    return estimator.view(image, K), estimator.view(turned, K), H


def misses(H: Array, x: Array, y: Array) -> Array:
    """Distances (N,) in pixels of y from the true places of x."""
    return np.asarray(np.linalg.norm(cv2.perspectiveTransform(x[None], H)[0] - y, axis=1))


def test_corners_are_tracked_to_a_tenth_of_a_pixel():
    previous, current, H = turned_views(600)
    there = cv2.perspectiveTransform(previous.features.points[None], H)[0]
    seen = ((there > 20) & (there < np.array(SIZE) - 20)).all(1)
    for view in (current, replace(current, features=some(current.features, slice(0, 0)))):
        x, y = match_widely(previous, view, None, KnownMotion(), 0.15)
        assert len(x) > 0.9 * seen.sum()
        assert np.median(misses(H, x, y)) < 0.1
        assert np.quantile(misses(H, x, y), 0.95) < 0.3


def test_the_most_similar_matches_come_first():
    previous, current, _ = turned_views(600)
    bits = match_distances(previous.smoothed, (matches := match_widely(
        previous, current, None, KnownMotion(), 0.15)).x, current.smoothed, matches.y)
    assert (np.diff(bits) >= 0).all()


def test_corners_are_matched_by_descriptors_if_the_lighting_changes():
    previous, current, H = turned_views(600)
    darker = TwoViewEstimator(EstimatorConfig(max_features=600)).view(
        cv2.convertScaleAbs(current.gray, alpha=0.5), K)
    x, y = match_widely(previous, darker, None, KnownMotion(), 0.15)
    assert len(x) > 0.25 * len(previous.features)
    # As accurate as the corners.
    assert np.median(misses(H, x, y)) < 0.7
    lost, _ = match_widely(previous, replace(darker, features=some(darker.features, slice(0, 0))),
                           None, KnownMotion(), 0.15)
    assert len(lost) < 0.5 * len(x)


def test_the_more_similar_of_two_places_is_kept():
    # A wall of identical tiles but for one in each row: the flow tracks to the next one.
    rng = np.random.default_rng(93)
    tile = textured(rng, (20, 20))
    wall = np.tile(tile, (15, 20))
    wall[:, 180:220] = textured(rng, (40, 300))
    estimator = TwoViewEstimator(EstimatorConfig(max_features=600))
    previous, current = estimator.view(wall, K), estimator.view(np.roll(wall, 16, axis=1), K)
    x, y = match_widely(previous, current, None, KnownMotion(), 0.15)
    special = np.abs(x[:, 0] - 200) < 15
    assert special.sum() > 20
    assert np.median(np.abs((y - x)[special] - (16, 0)).sum(1)) < 0.2


@pytest.mark.parametrize('what', ['black', 'noise'])
def test_nothing_is_tracked_into_an_unrelated_image(what: str):
    previous, current, _ = turned_views(200)
    rng = np.random.default_rng(92)
    other = (np.zeros_like(current.gray) if what == 'black'
             else rng.integers(0, 256, current.gray.shape).astype(np.uint8))
    none = some(current.features, np.zeros(len(current.features), bool))
    view = replace(TwoViewEstimator().view(other, K), features=none)
    x, _ = match_widely(previous, view, None, KnownMotion(), 0.15)
    assert len(x) < 0.05 * len(previous.features)


def test_no_features_give_no_matches():
    previous, current, _ = turned_views(200)
    none = replace(previous, features=some(
        previous.features, np.zeros(len(previous.features), bool)))
    x, y = match_widely(none, current, None, KnownMotion(), 0.15)
    assert x.shape == y.shape == (0, 2)


@pytest.mark.parametrize('more', [1, 3])
def test_the_required_number_of_matches_scales_with_the_features(more: int) -> None:
    """With as many features in the previous pair, or three times as many."""
    previous, current, _ = turned_views(600)
    count = len(previous.features)
    places = np.tile(previous.features.points, (more, 1))
    before = RelativePose(Status.OK, R=rotation_exp(TURN), x=places, y=places, y_opt=places,
                          inliers=np.ones(more * count, bool), sought=more * count)
    assert match_predicted(previous, current, before, KnownMotion(), 0.15) is not None
    # With a third as many features in the previous pair, three times as many are expected.
    assert match_predicted(previous, current, replace(before, sought=count // 3), KnownMotion(),
                           0.15) is None


@pytest.mark.parametrize(('gain', 'offset'), [(1.1, 0), (0.8, 0), (1.5, -20), (1.0, 12)])
def test_corners_are_tracked_if_the_exposure_changes(gain, offset):
    """From their old gray levels optical flow would lose most of them."""
    image = textured(np.random.default_rng(91), SIZE)
    shift = np.array([2.4, -1.3])
    moved = cv2.warpAffine(image, np.column_stack([np.eye(2), shift]), SIZE,
                           flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    estimator = TwoViewEstimator(EstimatorConfig(max_features=600))
    # So that nothing is saturated.
    previous, current = (estimator.view(np.clip(np.rint((60 + each / 4) * factor + more), 0, 255)
                                        .astype(np.uint8), K)
                         for each, factor, more in ((image, 1, 0), (moved, gain, offset)))
    points = previous.features.points
    y, bits = track_features(previous, current, points, 32.0, NEAR_LEVELS)
    found, inside = np.isfinite(bits), ((points > 40) & (points < np.array(SIZE) - 40)).all(1)
    assert found[inside].mean() > 0.95
    errors = np.linalg.norm(y - points - shift, axis=1)[found & inside]
    assert np.median(errors) < 0.1 and np.quantile(errors, 0.95) < 0.3
