"""Places of two views that are the same: found again by descriptors, or followed by the flow."""

from __future__ import annotations

from dataclasses import replace

import cv2
from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.geometry import rotation_exp
from djet_ros.core.matching import match_widely
from djet_ros.core.starts import Known
from djet_ros.core.types import Array, View
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
    """Pixels (N,) by which y are off where x are seen."""
    return np.asarray(np.linalg.norm(cv2.perspectiveTransform(x[None], H)[0] - y, axis=1))


def test_corners_that_are_not_found_again_are_followed_where_few_are():
    previous, current, H = turned_views(200)
    there = cv2.perspectiveTransform(previous.features.points[None], H)[0]
    seen = ((there > 20) & (there < np.array(SIZE) - 20)).all(1)
    lost = replace(current, features=some(
        current.features, np.arange(len(current.features)) % 2 == 0))
    x, y = match_widely(previous, lost, None, Known(), 0.15)
    found = (y[:, None] == lost.features.points).all(2).any(1)
    assert not found[found.argmin():].any()  # the surest, by their descriptors, come first
    assert (~found).sum() > 0.3 * seen.sum()
    assert len(x) > 0.9 * seen.sum()
    assert np.quantile(misses(H, x[~found], y[~found]), 0.95) < 0.3


def test_where_many_are_found_again_none_is_followed():
    previous, current, _ = turned_views(3000)
    x, y = match_widely(previous, current, None, Known(), 0.15)
    assert len(x) > 600
    assert (y[:, None] == current.features.points).all(2).any(1).all()


@pytest.mark.parametrize('what', ['black', 'noise'])
def test_nothing_is_followed_into_another_picture(what: str):
    previous, current, _ = turned_views(200)
    rng = np.random.default_rng(92)
    other = (np.zeros_like(current.gray) if what == 'black'
             else rng.integers(0, 256, current.gray.shape).astype(np.uint8))
    none = some(current.features, np.zeros(len(current.features), bool))
    view = replace(TwoViewEstimator().view(other, K), features=none)
    x, _ = match_widely(previous, view, None, Known(), 0.15)
    assert len(x) < 0.05 * len(previous.features)


def test_no_feature_at_all_is_no_match():
    previous, current, _ = turned_views(200)
    none = replace(previous, features=some(
        previous.features, np.zeros(len(previous.features), bool)))
    x, y = match_widely(none, current, None, Known(), 0.15)
    assert x.shape == y.shape == (0, 2)
