"""Radial distortion of points and images, compared with OpenCV."""

from __future__ import annotations

import cv2
from djet_ros.core.radial import distort, distortion_jacobian, undistort, undistort_image
import numpy as np
from numpy.typing import NDArray
import pytest

K = np.array([[500.0, 0, 320], [0, 480, 240], [0, 0, 1]])


@pytest.mark.parametrize('k1', [-0.05, 0.0, 0.05])
def test_undistorted_pixels_are_those_of_a_pinhole(k1: float) -> None:
    pixels = np.random.default_rng(16).uniform((0, 0), (640, 480), (100, 2))
    where = cv2.undistortPoints(pixels, K, np.array([k1, 0, 0, 0]), P=K)
    # Not exactly: a landmark's point only starts there, and its residual in the anchor holds it.
    assert undistort(K, pixels, k1) == pytest.approx(where[:, 0], abs=0.05)


@pytest.mark.parametrize('k1', [-0.05, 0.0, 0.05])
def test_distorted_pixels_and_their_jacobians_are_those_of_the_lens(k1: float) -> None:
    pixels = np.random.default_rng(17).uniform((0, 0), (640, 480), (100, 2))
    places = np.column_stack([(pixels - K[:2, 2]) / np.diag(K)[:2], np.ones(100)])
    where = cv2.projectPoints(places, np.zeros(3), np.zeros(3), K, np.array([k1, 0, 0, 0]))[0]
    assert distort(K, pixels, k1) == pytest.approx(where[:, 0], abs=1e-9)
    for axis, step in enumerate(np.eye(2) * 1e-4):
        moved = (distort(K, pixels + step, k1) - distort(K, pixels - step, k1)) / 2e-4
        found = distortion_jacobian(K, places[:, :2], k1)[:, :, axis]
        assert found == pytest.approx(moved, abs=1e-6)


def clouds() -> NDArray[np.uint8]:
    """Return a smooth image (480, 640), which interpolation hardly changes."""
    noise = np.random.default_rng(18).uniform(0, 255, (480, 640)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 6)
    return np.asarray(cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX), np.uint8)


@pytest.mark.parametrize('k1', [-0.05, 0.05])
def test_an_image_is_undistorted_as_by_opencv(k1: float) -> None:
    gray = clouds()
    straight, unseen = undistort_image(gray, K, k1)
    expected, whole = (cv2.undistort(image, K, np.array([k1, 0, 0, 0]))
                       for image in (gray, np.full_like(gray, 255)))
    # Beyond the border OpenCV fills with black.
    assert np.abs(straight.astype(int) - expected)[whole == 255].max() <= 2
    # A lens that moves the border outwards shows less of the world, and no unseen pixels.
    seen = np.ones(gray.shape, bool) if unseen is None else ~unseen
    assert (unseen is not None) == (k1 > 0)
    assert (seen != (whole > 0)).mean() < 0.01


def test_undistortion_in_steps_equals_one_step() -> None:
    gray = clouds()
    once, _ = undistort_image(gray, K, 0.03)
    partly, _ = undistort_image(gray, K, 0.02)
    twice, _ = undistort_image(partly, K, 0.03, before=(K, 0.02))
    inner = np.s_[40:-40, 40:-40]
    assert np.abs(once.astype(int) - twice)[inner].max() <= 3


def test_the_mask_is_undistorted_with_the_image() -> None:
    left_out = np.zeros((480, 640), bool)
    left_out[30:90, 40:120] = True
    _, hidden = undistort_image(clouds(), K, -0.05, left_out)
    assert hidden is not None
    corners = undistort(K, np.array([[40.0, 30], [119, 89]]), -0.05)
    rows, columns = np.nonzero(hidden)
    found = np.array([[columns.min(), rows.min()], [columns.max(), rows.max()]])
    assert np.abs(found - corners).max() < 3
