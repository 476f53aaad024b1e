"""
A slow camera: as most are that send thirty or sixty images in a second.

From image to image it moves by little more than the noise; what single pairs do not tell, longer
steps and landmarks do.
"""

from __future__ import annotations

from collections.abc import Iterator

from djet_ros.core.geometry import direction_angle, rotation_angle
from djet_ros.core.types import Array, Status
from djet_ros.lab.scenes.catalogue import make_scene
from djet_ros.odometry.frame import Frame
from djet_ros.odometry.result import OdometryResult
from djet_ros.odometry.visual_odometry import VisualOdometry
import numpy as np
import pytest

PERIOD_NS = 33_000_000


def seen_slowly(name: str, seed: int, factor: int, frames: range
                ) -> Iterator[tuple[OdometryResult, Array, Array]]:
    """Replay some frames of a slowed path; yield results, true motions, and true poses (4, 4)."""
    scene, odometry = make_scene(name, seed, slower=factor), VisualOdometry()
    path = scene.trajectory(frames.stop)
    for index in frames:
        result = odometry.process(Frame(scene.render(path[index], index), scene.K,
                                        index * PERIOD_NS))
        before = index if result.previous_stamp_ns is None else round(
            result.previous_stamp_ns / PERIOD_NS)
        yield (result, np.linalg.inv(path[before]) @ path[index],
               np.linalg.inv(path[frames.start]) @ path[index])


def direction_error(result: OdometryResult, motion: Array) -> float:
    """Return the error in degrees of the direction of an estimated motion (4, 4)."""
    return float(np.degrees(direction_angle(result.motion[:3, 3], motion[:3, 3])))


@pytest.mark.slow
def test_over_a_seafloor_it_is_not_led_to_the_other_motion_of_a_plane() -> None:
    """With a quarter of the usual step the floor is flat, to within the noise of a pair."""
    statuses = []
    for result, motion, _ in seen_slowly('underwater', 20, 4, range(50, 57)):
        statuses.append(result.status)
        if result.status is Status.OK:
            assert direction_error(result, motion) < 2
    assert statuses[-1] is Status.OK


@pytest.mark.slow
def test_over_a_plane_it_waits_until_two_motions_can_be_told_apart() -> None:
    """With an eighth of the usual step neither depths nor chirality tell them apart at once."""
    waited = 0
    for result, motion, pose in seen_slowly('flight', 20, 8, range(60)):
        if result.status is Status.OK:
            assert direction_error(result, motion) < 3
        waited += result.status is Status.AMBIGUOUS
        turned = np.degrees(rotation_angle(result.pose[:3, :3], pose[:3, :3]))
    assert waited > 5 and turned < 0.5


@pytest.mark.slow
def test_in_a_slow_hand_new_landmarks_replace_those_that_leave_the_view() -> None:
    """Each pair is a rotation to within its noise, which differs from the true one by 0.08."""
    lengths = []
    for result, _, pose in seen_slowly('handheld', 21, 8, range(100)):
        assert result.status in (Status.FIRST_FRAME, Status.OK, Status.NO_PARALLAX)
        assert np.degrees(rotation_angle(result.pose[:3, :3], pose[:3, :3])) < 0.15
        lengths.append((np.linalg.norm(result.pose[:3, 3]), np.linalg.norm(pose[:3, 3])))
    estimated, true = np.array(lengths[10:]).T
    scale = estimated / true
    assert scale.max() / scale.min() < 1.06


@pytest.mark.slow
def test_on_a_street_its_first_step_counts() -> None:
    """Nothing tells at first that it does not stand, but that points move by any amount."""
    for result, motion, _ in seen_slowly('road', 20, 16, range(16, 20)):
        if result.status is not Status.FIRST_FRAME:
            assert result.status is Status.OK and direction_error(result, motion) < 1


@pytest.mark.slow
def test_along_a_desk_a_rotation_does_not_absorb_a_centimetre() -> None:
    """
    It moves all points by as much, but for half a pixel: too little for a direction.

    The pair's rotation is that of its pose, not the 0.3 degrees of a rotation alone; landmarks
    tell how far the camera went.
    """
    steps = list(seen_slowly('handheld', 1, 1, range(6)))
    unit = np.linalg.norm(steps[1][1][:3, 3])
    result, motion, _ = steps[5]
    assert result.status is Status.NO_PARALLAX
    assert np.degrees(rotation_angle(result.motion[:3, :3], motion[:3, :3])) < 0.03
    before, after = (result.pose for result, _, _ in steps[4:])
    assert np.linalg.inv(before)[:3] @ after[:, 3] == pytest.approx(motion[:3, 3] / unit, abs=0.05)
