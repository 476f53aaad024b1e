"""What windows tell of a distortion: nothing at first, and in the end what turns say."""

from __future__ import annotations

import cv2
from djet_ros.config.sections import Config
from djet_ros.core.self_calibration import SelfCalibration
from djet_ros.lab.scenes import make_scene
from djet_ros.odometry.tracker import Tracker
import numpy as np
import pytest
from ros_messages import camera_info, image, message_type

K = np.array([[700.0, 0, 620], [0, 700, 180], [0, 0, 1]])

# Pixels that a k1 of one leaves of itself in a window: see SelfCalibration.told.
STRAIGHT, TURN = 0.5, 8.0


def heard(windows: list[tuple[float, float, float]]) -> SelfCalibration:
    lens = SelfCalibration.unknown(K, (376, 1241))
    for window in windows:
        lens = lens.told(*window)
    return lens


def test_before_anything_is_told_the_calibration_is_right() -> None:
    lens = SelfCalibration.unknown(K, (376, 1241))
    assert lens.k1 == 0
    # It may be off by a hundredth of where the corner is.
    corner = np.array([1241 - 620, 376 - 180]) / 700
    assert lens.sigma * (corner @ corner) == pytest.approx(0.01)


def test_what_straight_roads_tell_alike_is_not_taken_for_a_distortion() -> None:
    lens = heard([(0.02, 0.005**2, STRAIGHT)] * 500)
    assert abs(lens.k1) < 0.005
    assert lens.sigma > 0.5 * lens.first


def test_turns_tell_it_from_what_looks_like_it_on_straight_roads() -> None:
    roads = [(0.02, 0.005**2, STRAIGHT)] * 50
    lens = heard(roads + [(0.01, 0.001**2, TURN)] * 20)
    assert lens.k1 == pytest.approx(0.01, abs=2 * lens.sigma)
    # 0.01 too much, where a k1 of one leaves half a pixel.
    assert lens.mean[1] == pytest.approx(0.005, abs=2 * np.sqrt(lens.covariance[1, 1]))


def test_noise_makes_no_distortion() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        lens = heard([(0.004 * rng.normal(), 0.004**2, TURN) for _ in range(30)])
        assert abs(lens.k1) < 0.2 * lens.sigma


def test_windows_without_any_noise_do_not_make_it_sure() -> None:
    # No lens is off by k1 alone.
    exact = heard([(0.01, 0.0, TURN)] * 2)
    assert exact.sigma > 0.1 * exact.first
    assert np.linalg.eigvalsh(exact.covariance)[0] > 0


def test_images_are_straightened_when_it_is_certain_and_again_when_twice_as_much_is_known() -> None:
    rng, lens, undone = np.random.default_rng(1), SelfCalibration.unknown(K, (376, 1241)), []
    for _ in range(300):
        # Of what is undone by now, windows see no more.
        lens = lens.told(0.01 - lens.undone + 0.004 * rng.normal(), 0.004**2, TURN)
        if lens.due:
            lens = lens.straightened()
            undone.append((lens.undone, lens.sigma))
            assert not lens.due
    sigmas = np.array([sigma for _, sigma in undone])
    assert 2 <= len(undone) <= 6
    assert undone[0][0] > 3 * sigmas[0]
    assert (2 * sigmas[1:]**2 < sigmas[:-1]**2).all()
    assert all(abs(k1 - 0.01) < 3 * sigma for k1, sigma in undone)
    assert lens.left == pytest.approx(0.01 - lens.undone, abs=3 * lens.sigma)
    assert lens.k1 == pytest.approx(0.01, abs=2.5 * lens.sigma)


def test_a_lens_that_is_right_is_never_straightened() -> None:
    rng = np.random.default_rng(2)
    for _ in range(20):
        lens = SelfCalibration.unknown(K, (376, 1241))
        for _ in range(100):
            lens = lens.told(0.004 * rng.normal(), 0.004**2, TURN)
            assert not lens.due


def turned(k1: float, frames: int = 75) -> Tracker:
    """Track a rendered turn that is seen through a lens of which the calibration knows nothing."""
    scene = make_scene('sharp_turn', 0, (620, 188))
    width, height = scene.size
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1, dtype=float)
    where = cv2.undistortPoints(grid.reshape(-1, 2), scene.K, np.array([k1, 0, 0, 0]), P=scene.K)
    where = where.reshape(height, width, 2).astype(np.float32)
    tracker = Tracker(Config(), message_type, image_topic='image')
    tracker.camera_info(camera_info(scene.K, scene.size))
    for number, pose in enumerate(scene.trajectory(frames)):
        seen = cv2.remap(scene.render(pose, number), where[..., 0], where[..., 1],
                         cv2.INTER_CUBIC)
        tracker.image(image(seen, stamp_ns=(number + 1) * 10**8))
    return tracker


def test_images_of_a_turn_tell_what_the_calibration_leaves_and_that_is_said() -> None:
    tracker = turned(0.015)
    found, sigma = map(float, tracker.diagnosis().values['distortion left (k1)'].split(' +- '))
    assert found == pytest.approx(0.015, abs=2.5 * sigma)
    assert sigma < 0.003
    assert [one.name for one in tracker.complaints_of_content] == ['distortion left']


def test_of_a_good_calibration_nothing_is_said() -> None:
    tracker = turned(0.0)
    assert 'distortion left (k1)' not in tracker.diagnosis().values
    assert tracker.complaints_of_content == []
