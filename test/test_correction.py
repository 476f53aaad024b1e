"""A camera that deviates from its calibration: its matrix, and what it does to a pair."""

from __future__ import annotations

import cv2
from djet_ros.core.correction import (
    AS_CALIBRATED,
    Correction,
    displacements,
    motion_shift,
    turn_of_deviating_camera,
)
from djet_ros.core.geometry import fit_rotation, rays, rotation_exp, rotation_log, sphere_log, unit
from djet_ros.core.types import RelativePose, Status
import numpy as np
from numpy.typing import NDArray
import pytest
from two_view import fitted

Numbers = NDArray[np.float64]

K = np.array([[700.0, 0, 600], [0, 710, 180], [0, 0, 1]])


def seen(places: Numbers, correction: Correction) -> Numbers:
    """Pixels (N, 2) at which a camera that deviates from K shows points (N, 3), by OpenCV."""
    pixels, _ = cv2.projectPoints(places, np.zeros(3), np.zeros(3), correction.camera_matrix(K),
                                  np.array([correction.k1, 0, 0, 0]))
    return np.asarray(pixels[:, 0])


def test_a_camera_as_calibrated_has_the_calibrated_matrix() -> None:
    assert np.array_equal(AS_CALIBRATED.camera_matrix(K), K)
    assert AS_CALIBRATED.camera_matrix(K) is not K


def test_focal_length_and_principal_point_deviate_by_shares_of_the_focal_length() -> None:
    corrected = Correction(focal=0.01, cx=0.002, cy=-0.003).camera_matrix(K)
    assert corrected == pytest.approx(np.array([[707, 0, 601.4], [0, 717.1, 177.87], [0, 0, 1]]))


@pytest.mark.parametrize('field', range(4))
def test_points_are_displaced_as_by_that_camera(field: int) -> None:
    rng, wrong = np.random.default_rng(0), 1e-6 * np.eye(4)[field]
    u = rng.uniform(-0.8, 0.8, (50, 2))
    places = np.column_stack([u, np.ones(50)])
    moved = (seen(places, Correction(*wrong)) - seen(places, AS_CALIBRATED)) / np.diag(K)[:2]
    assert displacements(u) @ wrong == pytest.approx(moved, rel=1e-4, abs=1e-12)


@pytest.mark.parametrize('field', range(4))
def test_a_pair_is_off_by_what_least_squares_makes_of_a_wrong_camera(field: int) -> None:
    rng, wrong = np.random.default_rng(1), 1e-3 * np.eye(4)[field]
    R, t = rotation_exp(np.array([0.01, -0.05, 0.004])), unit(np.array([0.3, -0.05, -0.9]))
    places = rng.uniform(6, 40, (400, 1)) * rays(K, rng.uniform((20, 20), (1200, 340), (400, 2)))
    x, y = (seen(points, Correction(*wrong)) for points in (places, places @ R.T + t))
    found, direction = fitted(K, R, t, x, y)
    off = np.concatenate([rotation_log(found @ R.T), sphere_log(t, direction)])
    pair = RelativePose(Status.OK, R, t, np.eye(5), x=x, y=y, y_opt=y, inliers=np.ones(400, bool))
    # A correction of the camera would take that back.
    assert motion_shift(pair, K) @ wrong == pytest.approx(-off, rel=0.05,
                                                          abs=0.03 * np.abs(off).max())


@pytest.mark.parametrize('wrong', [Correction(k1=0.01), Correction(focal=0.01),
                                   Correction(-0.004, 0.005, -0.003, 0.002)])
def test_a_rotation_is_right_though_the_camera_is_not(wrong: Correction) -> None:
    places = rays(K, np.random.default_rng(2).uniform((20, 20), (1200, 340), (400, 2)))
    R = rotation_exp(np.array([0.01, -0.05, 0.004]))
    x, y = (rays(K, seen(points, wrong)) for points in (places, places @ R.T))
    found, left = turn_of_deviating_camera(x, y, np.full(4, 0.01))
    assert left.max() * 700 < 0.02
    off, off_alone = (np.linalg.norm(rotation_log(one @ R.T)) for one in
                      (found, fit_rotation(x, y)))
    assert off < 0.1 * off_alone


def test_what_parallax_displaces_is_left_of_it() -> None:
    """Points in a room, and a step that moves them all by ten pixels to the left, more or less."""
    rng = np.random.default_rng(3)
    depths = rng.uniform(0.7, 1.4, (400, 1))
    places = depths * rays(K, rng.uniform((20, 20), (1200, 340), (400, 2)))
    x, y = (rays(K, seen(points, AS_CALIBRATED)) for points in (places, places - [0.014, 0, 0]))
    _, left = turn_of_deviating_camera(x, y, np.full(4, 0.01))
    assert np.median(left) * 700 > 1
