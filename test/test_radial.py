"""What radial distortion does to points and images, held against OpenCV."""

from __future__ import annotations

import cv2
from djet_ros.core.radial import bending, bent, straightened
import numpy as np
import pytest

K = np.array([[500.0, 0, 320], [0, 480, 240], [0, 0, 1]])


@pytest.mark.parametrize('k1', [-0.05, 0.0, 0.05])
def test_a_pixel_is_straightened_to_where_a_pinhole_shows_it(k1: float) -> None:
    pixels = np.random.default_rng(16).uniform((0, 0), (640, 480), (100, 2))
    where = cv2.undistortPoints(pixels, K, np.array([k1, 0, 0, 0]), P=K)
    # Not to the last digit: a landmark's point begins there, and where it was found holds it.
    assert straightened(K, pixels, k1) == pytest.approx(where[:, 0], abs=0.05)


@pytest.mark.parametrize('k1', [-0.05, 0.0, 0.05])
def test_a_pixel_is_bent_as_a_lens_does_and_its_neighbours_with_it(k1: float) -> None:
    pixels = np.random.default_rng(17).uniform((0, 0), (640, 480), (100, 2))
    places = np.column_stack([(pixels - K[:2, 2]) / np.diag(K)[:2], np.ones(100)])
    where = cv2.projectPoints(places, np.zeros(3), np.zeros(3), K, np.array([k1, 0, 0, 0]))[0]
    assert bent(K, pixels, k1) == pytest.approx(where[:, 0], abs=1e-9)
    for axis, step in enumerate(np.eye(2) * 1e-4):
        moved = (bent(K, pixels + step, k1) - bent(K, pixels - step, k1)) / 2e-4
        assert bending(K, places[:, :2], k1)[:, :, axis] == pytest.approx(moved, abs=1e-6)
