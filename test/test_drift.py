"""Drift per 100 m is KITTI's, whatever way it is computed."""

from __future__ import annotations

from itertools import pairwise
import math

from djet_ros.core.geometry import rotation_exp
from djet_ros.replay.drift import Drift, drift, path_length, path_scale
import numpy as np
from numpy.typing import NDArray
import pytest

Poses = NDArray[np.float64]


def travelled(steps: list[tuple[NDArray[np.float64], NDArray[np.float64]]]) -> Poses:
    """Chain rotation vectors and ways in camera axes to poses of the camera in its first frame."""
    poses = [np.eye(4)]
    for turn, way in steps:
        step = np.eye(4)
        step[:3, :3], step[:3, 3] = rotation_exp(np.asarray(turn, float)), way
        poses.append(poses[-1] @ step)
    return np.array(poses)


def straight(metres: float, speed: float = 1.0, yaw: float = 0.0, stretch: float = 1.0) -> Poses:
    """Drive ahead, turning by ``yaw`` radians with each step that takes ``speed`` metres."""
    return travelled([(np.array([0, yaw, 0]), np.array([0, 0, speed * stretch]))]
                     * round(metres / speed))


def winding(seed: int, frames: int) -> tuple[Poses, Poses]:
    """Return a path of changing speed and direction, and an estimate with all kinds of errors."""
    rng = np.random.default_rng(seed)
    turns = rng.normal(0, (0.003, 0.03, 0.003), (frames, 3))
    translations = np.pad(rng.uniform(0, 2.2, (frames, 1)), ((0, 0), (2, 0)))
    wrong = turns + rng.normal(2e-4, 1e-3, (frames, 3)), translations * 1.02 + rng.normal(
        0, 0.02, (frames, 3))
    return travelled(list(zip(turns, translations))), travelled(list(zip(*wrong)))


def by_the_book(truth: Poses, estimate: Poses) -> tuple[float, float, int]:
    """Follow the benchmark's own words, segment by segment, in plain numbers."""
    path = [0.0]
    for before, after in pairwise(truth):
        path.append(path[-1] + math.dist(before[:3, 3], after[:3, 3]))
    shifts, turns = [], []
    for first in range(0, len(truth), 10):
        for length in range(100, 801, 100):
            beyond = [i for i in range(first, len(truth)) if path[i] > path[first] + length]
            if not beyond:
                continue
            last = beyond[0]
            true_motion = np.linalg.solve(truth[first], truth[last])
            motion = np.linalg.solve(estimate[first], estimate[last])
            left = np.linalg.solve(motion, true_motion)
            cosine = min(max((left[0, 0] + left[1, 1] + left[2, 2] - 1) / 2, -1.0), 1.0)
            turns.append(math.acos(cosine) / length)
            shifts.append(math.hypot(*left[:3, 3]) / length)
    return (100 * sum(shifts) / len(shifts), 100 * math.degrees(sum(turns) / len(turns)),
            len(shifts))


@pytest.mark.parametrize(('seed', 'frames'), [(0, 150), (1, 400), (2, 1200)])
def test_drift_equals_a_direct_implementation_of_the_benchmark(seed: int, frames: int) -> None:
    truth, estimate = winding(seed, frames)
    found = drift(truth, estimate)
    percent, degrees, segments = by_the_book(truth, estimate)
    assert found.segments == segments
    assert found.translation_percent == pytest.approx(percent, rel=1e-6)
    assert found.rotation_deg_per_100m == pytest.approx(degrees, rel=1e-6)


def test_scale_error_is_the_translation_drift() -> None:
    found = drift(straight(450), straight(450, stretch=1.03))
    # Segments end with the first frame beyond their length: 101 m instead of 100.
    assert found.translation_percent == pytest.approx(3.03, abs=0.02)
    assert found.rotation_deg_per_100m == pytest.approx(0, abs=1e-6)
    assert found.longest == 400


def test_constant_yaw_error_is_the_rotation_drift() -> None:
    found = drift(straight(950), straight(950, yaw=math.radians(0.004)))
    assert found.rotation_deg_per_100m == pytest.approx(0.4, rel=0.01)
    assert found.longest == 800


def test_drift_is_zero_without_errors_in_any_axes() -> None:
    truth, _ = winding(4, 400)
    elsewhere = np.eye(4)
    elsewhere[:3, :3], elsewhere[:3, 3] = rotation_exp(np.array([0.3, -1.0, 0.5])), (5, -3, 80)
    found = drift(truth, elsewhere @ truth)
    assert found.translation_percent == pytest.approx(0, abs=1e-8)
    assert found.rotation_deg_per_100m == pytest.approx(0, abs=1e-5)


def test_rotation_drift_does_not_depend_on_scale() -> None:
    truth, estimate = winding(5, 400)
    shrunk = estimate.copy()
    shrunk[:, :3, 3] *= 0.1
    one, other = drift(truth, estimate), drift(truth, shrunk)
    assert one.rotation_deg_per_100m == pytest.approx(other.rotation_deg_per_100m)
    assert other.translation_percent > 80


def test_a_path_in_another_unit_and_axes_has_the_scale_of_its_spread() -> None:
    truth = winding(6, 400)[0][:, :3, 3]
    elsewhere = truth @ rotation_exp(np.array([0.3, -1.0, 0.5])).T + (5, -3, 80)
    assert path_scale(0.2 * elsewhere, truth) == pytest.approx(5)
    assert path_scale(truth, truth[::-1]) == pytest.approx(1)
    # Lost where the true path is known, and not at the origin.
    assert path_scale(np.tile(truth[3], (len(truth), 1)), truth) == 1


def test_a_path_is_as_long_as_its_steps_together() -> None:
    assert path_length(np.array([[1.0, 0, 0], [1, 3, 4], [1, 3, 4], [3, 2, 2]])) == 5 + 0 + 3
    assert path_length(np.ones((1, 3))) == 0


def test_no_drift_below_100_metres() -> None:
    assert drift(straight(100), straight(100)) is None
    assert drift(straight(101), straight(101)) == Drift(0.0, 0.0, 1, 100)
    still = np.tile(np.eye(4), (500, 1, 1))
    assert drift(still, still) is None


@pytest.mark.parametrize(('truth', 'estimate', 'message'), [
    (straight(10), straight(11), r'are \(11, 4, 4\) and \(12, 4, 4\)'),
    (straight(10)[:, :3], straight(10)[:, :3], r'\(11, 3, 4\); both must be \(N, 4, 4\)'),
    (straight(10), straight(10) * np.nan, 'not finite'),
    (straight(10) * np.nan, straight(10), 'not finite'),
])
def test_incomparable_trajectories_are_refused(
        truth: Poses, estimate: Poses, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        drift(truth, estimate)
