"""Prediction of features by the camera's rotation and by constant motion."""

from dataclasses import replace

import cv2
from djet_ros.core.corners import detect_corners
from djet_ros.core.fusion import MeasuredRotation
from djet_ros.core.geometry import rotation_angle, rotation_exp, unit
from djet_ros.core.prediction import likely_rotation, predict_at_infinity, predict_constant_motion
from djet_ros.core.starts import KnownMotion
from djet_ros.core.types import Pose, RelativePose, Status
import numpy as np
import pytest
from two_view import some, textured

K = np.array([[400.0, 0, 199.5], [0, 400.0, 149.5], [0, 0, 1]])


def turned_pair(degrees):
    image = textured(np.random.default_rng(81), (400, 300))
    R = rotation_exp(np.deg2rad(np.asarray(degrees, float)))
    H = K @ R @ np.linalg.inv(K)
    turned = cv2.warpPerspective(image, H, (400, 300))
    return R, H, detect_corners(image, 1000, 1.0), detect_corners(turned, 1000, 1.0)


@pytest.mark.parametrize('degrees', [(0, 0, 0), (0, 4, 0), (2, -12, 1), (0, 0, 6), (-8, 3, 0)])
def test_large_rotations_are_estimated_without_a_prior(degrees):
    R, H, previous, current = turned_pair(degrees)
    found = likely_rotation(previous, current, K, [], 30.0)
    assert np.rad2deg(rotation_angle(R, found)) < 2
    there = predict_at_infinity(previous, current, K, [], 30.0)
    truth = cv2.perspectiveTransform(previous.points[None], H)[0]
    assert np.median(np.linalg.norm(there - truth, axis=1)) < 15


def test_a_wrong_prior_does_no_harm():
    R, _, previous, current = turned_pair((0, 5, 0))
    wrong = rotation_exp(np.deg2rad([0.0, -20.0, 0.0]))
    assert np.rad2deg(rotation_angle(R, likely_rotation(previous, current, K, [wrong], 30.0))) < 2


def test_without_matches_the_rotation_is_identity():
    _, _, previous, _ = turned_pair((0, 0, 0))
    none = detect_corners(np.zeros((300, 400), np.uint8), 100, 1.0)
    assert (likely_rotation(previous, none, K, [], 30.0) == np.eye(3)).all()
    assert predict_at_infinity(none, previous, K, [], 30.0).shape == (0, 2)


def test_points_rotated_behind_the_camera_are_far_outside_the_image():
    _, _, previous, _ = turned_pair((0, 0, 0))
    none = some(previous, slice(0, 0))
    R = rotation_exp(np.array([0.0, 3.0, 0.0]))
    behind = predict_at_infinity(previous, none, K, [R], 30.0)
    assert np.isfinite(behind).all()


def driven_through(depths):
    """Return features of the second of three views, the motion of each step, and the third."""
    rng = np.random.default_rng(5)
    n = len(depths)
    places = np.stack([rng.uniform(-0.4, 0.4, n), rng.uniform(-0.3, 0.3, n), np.ones(n)]).T
    places *= depths[:, None]
    R, t = rotation_exp(np.array([0.01, -0.03, 0.005])), unit(np.array([0.2, 0.1, -1.0]))
    seen = []
    for _ in range(3):
        image = places @ K.T
        seen.append(image[:, :2] / image[:, 2:])
        places = places @ R.T + t
    prior = RelativePose(Status.OK, R, t, x=seen[0], y=seen[1], y_opt=seen[1],
                         inliers=np.ones(n, bool))
    none = detect_corners(np.zeros((300, 400), np.uint8), 100, 1.0)
    return replace(none, points=seen[1]), prior, seen[2]


def test_prediction_is_exact_for_constant_motion():
    features, prior, truth = driven_through(np.random.default_rng(6).uniform(5, 50, 200))
    foreseen = predict_constant_motion(features, K, prior.R, prior)
    assert np.abs(foreseen - truth).max() < 1e-6
    # The rotation alone predicts other places.
    turned = predict_at_infinity(features, features, K, [prior.R], 30.0, measured=True)
    assert np.median(np.linalg.norm(turned - truth, axis=1)) > 3


def test_new_features_are_predicted_by_their_nearest_inlier():
    features, prior, truth = driven_through(np.full(200, 20.0))
    known = np.arange(200) % 4 > 0
    foreseen = predict_constant_motion(features, K, prior.R, replace(prior, inliers=known))
    assert np.abs(foreseen - truth)[known].max() < 1e-6
    assert 1e-6 < np.linalg.norm(foreseen - truth, axis=1)[~known].max() < 2


def test_prediction_after_a_pure_rotation():
    features, prior, _ = driven_through(np.full(50, 1e9))
    still = replace(prior, t=np.zeros(3))
    turned = predict_at_infinity(features, features, K, [prior.R], 30.0, measured=True)
    assert np.allclose(predict_constant_motion(features, K, prior.R, still), turned)
    assert np.abs(predict_constant_motion(features, K, prior.R, prior) - turned).max() < 1e-3


def test_a_camera_that_stood_is_likelier_not_to_have_turned_than_a_guess_says() -> None:
    turned, guessed = (rotation_exp(np.array([0, angle, 0])) for angle in (0.01, 0.02))
    gyro = MeasuredRotation(turned, np.eye(3) * 1e-6)
    known = KnownMotion(gyro, Pose(guessed, np.array([0, 0, -1.0])), stood=True)
    for one, rotations in ((known, (turned, np.eye(3), guessed)),
                           (replace(known, rotation=None), (np.eye(3), guessed)),
                           (replace(known, stood=False), (turned, guessed))):
        assert np.array_equal(one.rotations(), rotations)
