"""Online calibration: a camera is undetermined on straight roads, and determined in turns."""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
from djet_ros.config.sections import Config, OdometryConfig
from djet_ros.core.correction import Correction
from djet_ros.core.geometry import rotation_log
from djet_ros.core.self_calibration import SelfCalibration
from djet_ros.core.types import Status, TRACKED
from djet_ros.lab.scenes import make_scene, Scene
from djet_ros.odometry.frame import Frame
from djet_ros.odometry.messages import correction_of, correction_values, Messages
from djet_ros.odometry.result import OdometryResult
from djet_ros.odometry.tracker import Outgoing, Tracker
from djet_ros.odometry.visual_odometry import VisualOdometry
from djet_ros.posegraph.step_messages import StepMessages
from djet_ros.recordings.datasets import tum_rgbd
from djet_ros.recordings.frame_sequence import FrameSequence
from djet_ros.recordings.kitti import KittiSequence
from djet_ros.replay.graph_of_results import read_steps
from djet_ros.replay.results import ResultsFolder
import numpy as np
from numpy.typing import NDArray
import pytest
from ros_messages import camera_info, image, message_type

Numbers = NDArray[np.float64]

K = np.array([[700.0, 0, 620], [0, 700, 180], [0, 0, 1]])

# Sensitivities of windows, see SelfCalibration.update: on a straight road, and in a turn.
STRAIGHT = np.diag([0.5, 1.0, 0.5, 0.5])**2
_MIX = np.random.default_rng(0).normal(size=(4, 4))
TURN = np.diag([8.0, 6.0, 8.0, 8.0]) @ (_MIX @ _MIX.T / 16 + np.eye(4)) @ np.diag(
    [8.0, 6.0, 8.0, 8.0])

WRONG = np.array([0.01, -0.005, 0.004, -0.003])


def unknown() -> SelfCalibration:
    return SelfCalibration.unknown(K, (376, 1241))


def after(found: SelfCalibration, seen: Numbers, sensitivity: Numbers, noise: float
          ) -> SelfCalibration:
    """Return an estimate after a window whose residuals are least at a deviation seen (4,)."""
    return found.update(sensitivity, -sensitivity @ (seen - np.array(found.corrected)), noise**2)


def noisy(rng: np.random.Generator, sensitivity: Numbers, noise: float) -> Numbers:
    """Error (4,) of a window whose residuals have some noise along each axis."""
    return np.asarray(noise * np.linalg.solve(np.linalg.cholesky(sensitivity).T,
                                              rng.normal(size=4)))


def test_a_priori_the_calibration_is_right() -> None:
    found = unknown()
    assert not any(found.deviation) and not found.significant
    # A priori the distortion may displace the corner by one percent, and the camera matrix may be
    # off by half a percent of the focal length.
    corner = np.array([1241 - 620, 376 - 180]) / 700
    assert found.sigmas.k1 * (corner @ corner) == pytest.approx(0.01)
    assert found.sigmas[1:] == pytest.approx([0.005] * 3)


def test_a_systematic_error_on_straight_roads_is_not_taken_for_a_wrong_calibration() -> None:
    found = unknown()
    for _ in range(500):
        found = after(found, np.array([0.02, 0, 0, 0.01]), STRAIGHT, 0.002)
        assert not found.significant
    assert found.sigmas.k1 > 0.5 * found.prior_sigmas[0]


def test_turns_separate_a_wrong_calibration_from_systematic_errors() -> None:
    found = unknown()
    for _ in range(50):
        found = after(found, WRONG + np.array([0.01, 0, 0, 0]), STRAIGHT, 0.002)
    for _ in range(20):
        found = after(found, WRONG, TURN, 0.008)
    errors = (np.array(found.deviation) - WRONG) / found.sigmas
    assert np.abs(errors).max() < 2
    # 0.01 too much, where a k1 of one leaves half a pixel.
    assert found.mean[4] == pytest.approx(0.005, abs=2 * np.sqrt(found.covariance[4, 4]))


def test_the_estimate_is_as_uncertain_as_it_is_wrong() -> None:
    rng, squares = np.random.default_rng(3), []
    for _ in range(60):
        wrong = unknown().prior_sigmas * rng.normal(size=4)
        systematic = 0.01 * rng.normal(size=4)
        found = unknown()
        for sensitivity in (STRAIGHT, TURN, TURN):
            scale = found.prior_sigmas
            squares_of, axes = np.linalg.eigh(scale[:, None] * sensitivity * scale)
            apparent = scale * (axes @ (axes.T @ systematic / np.sqrt(squares_of)))
            # No camera deviates by these parameters alone: to each window another one is best.
            other = 0.2 * scale * rng.normal(size=4)
            found = after(found, wrong + other + apparent + noisy(rng, sensitivity, 0.01),
                          sensitivity, 0.01)
        error = (np.array(found.deviation) - wrong) / scale
        squares.append(error @ np.linalg.solve(found.covariance[:4, :4], error))
    # Chi^2 of four numbers, by 60 samples.
    assert np.mean(squares) == pytest.approx(4, abs=3 * np.sqrt(8 / 60))


def test_noise_free_windows_do_not_make_the_estimate_certain() -> None:
    found = unknown()
    for _ in range(2):
        found = after(found, WRONG, TURN, 0.0)
    assert (np.array(found.sigmas) > 0.05 * found.prior_sigmas).all()
    assert np.linalg.eigvalsh(found.covariance)[0] > 0


def test_a_direction_that_leaves_no_residual_stays_unknown() -> None:
    turned = np.diag([8.0, 0.0, 8.0, 8.0])**2
    found = after(unknown(), WRONG, turned, 0.01)
    assert found.deviation.focal == 0 and found.sigmas.focal == pytest.approx(0.005)
    assert found.covariance[5, 5] == pytest.approx(0.01**2)


def test_images_are_corrected_for_what_is_significant_a_few_times_in_all() -> None:
    rng, found, corrected = np.random.default_rng(1), unknown(), []
    for _ in range(300):
        found = after(found, WRONG + noisy(rng, TURN, 0.03), TURN, 0.03)
        if found.needs_update:
            found = found.after_correction()
            corrected.append(found)
            assert not found.needs_update
    assert 2 <= len(corrected) <= 8
    for one in corrected:
        error = (np.array(one.corrected) - WRONG) / one.prior_sigmas
        assert error @ np.linalg.solve(one.covariance[:4, :4], error) < 18
    assert np.abs((np.array(found.deviation) - WRONG) / found.sigmas).max() < 2.5


def test_what_windows_missed_before_a_correction_is_found_after_it() -> None:
    """Landmarks that disagree most are outliers until images are corrected."""
    rng, found = np.random.default_rng(4), unknown()
    while not found.needs_update:
        found = after(found, 0.65 * WRONG + noisy(rng, TURN, 0.03), TURN, 0.03)
    found = found.after_correction()
    for _ in range(60):
        found = after(found, WRONG + noisy(rng, TURN, 0.03), TURN, 0.03)
        if found.needs_update:
            found = found.after_correction()
    error = np.array(found.deviation) - WRONG
    assert np.abs(error / found.sigmas).max() < 2.5
    assert np.abs(error).max() < 0.1 * np.abs(WRONG).max()


def test_noise_is_not_taken_for_a_wrong_calibration() -> None:
    rng = np.random.default_rng(2)
    for _ in range(20):
        found = unknown()
        for _ in range(100):
            found = after(found, noisy(rng, TURN, 0.03), TURN, 0.03)
            assert not found.needs_update


# Image at which the first of the rendered turns begins.
FIRST_TURN = 13


@cache
def rendered_turn(frames: int = 75) -> tuple[Scene, Numbers, list[NDArray[np.uint8]]]:
    """Return a turn, its poses and its images, of which all lenses are made."""
    scene = make_scene('sharp_turn', 0, (620, 188))
    poses = scene.trajectory(frames)
    return scene, poses, [scene.render(pose, number) for number, pose in enumerate(poses)]


class Bent:
    """A rendered turn, seen through a lens with distortion that is not calibrated."""

    def __init__(self, k1: float) -> None:
        scene, self.poses, images = rendered_turn()
        (width, height), self.K, self.size = scene.size, scene.K, scene.size
        grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1, dtype=float)
        where = cv2.undistortPoints(grid.reshape(-1, 2), self.K, np.array([k1, 0, 0, 0]), P=self.K)
        where = where.reshape(height, width, 2).astype(np.float32)
        self.images = [cv2.remap(one, where[..., 0], where[..., 1], cv2.INTER_CUBIC)
                       for one in images]

    def tracked(self, **odometry: Any) -> tuple[Tracker, list[OdometryResult]]:
        """Track it with some parameters."""
        tracker = Tracker(Config(odometry=OdometryConfig(**odometry)), message_type,
                          image_topic='image')
        tracker.camera_info(camera_info(self.K, self.size))
        results = []
        for number, one in enumerate(self.images):
            tracker.image(image(one, stamp_ns=(number + 1) * 10**8))
            assert tracker.last is not None
            results.append(tracker.last)
        return tracker, results

    def off(self, results: list[OdometryResult]) -> Numbers:
        """Radians (N - 1,) by which the turns of pairs are off."""
        return np.array([np.linalg.norm(rotation_log(
            (np.linalg.inv(before) @ after)[:3, :3].T @ result.motion[:3, :3]))
            for (before, after), result in zip(pairwise(self.poses), results[1:])])


@pytest.fixture(scope='module')
def bent() -> Bent:
    return Bent(0.015)


@pytest.fixture(scope='module')
def tracked_bent(bent: Bent) -> tuple[Tracker, list[OdometryResult]]:
    return bent.tracked()


@pytest.mark.slow
def test_what_is_wrong_is_estimated_in_a_turn_and_reported(
        bent: Bent, tracked_bent: tuple[Tracker, list[OdometryResult]]) -> None:
    tracker, results = tracked_bent
    text = tracker.diagnosis().values['calibration off by']
    found, sigma = map(float, text.split(',')[0].removeprefix('k1 = ').split(' +- '))
    assert found == pytest.approx(0.015, abs=2.5 * sigma)
    assert sigma < 0.003
    focal, of_focal = map(float, text.split(', ')[1].removeprefix('focal length ').removesuffix(
        ' %').split(' +- '))
    assert focal == pytest.approx(0, abs=2.5 * of_focal)
    assert [one.name for one in tracker.complaints_of_content] == ['calibration off']
    # Poses of pairs are unchanged until it is significant, and better from then on, as images are
    # corrected; without a scale by landmarks it is not estimated.
    _, unknowing = bent.tracked(scale='none')
    apart = np.array([np.abs(one.motion[:3, :3] - other.motion[:3, :3]).max()
                      for one, other in zip(results, unknowing)])
    first = int(np.flatnonzero(apart)[0])
    assert FIRST_TURN < first < 60
    with_it, without = (bent.off(some)[first:] for some in (results, unknowing))
    gained = without - with_it
    assert gained.mean() > 2 * gained.std() / np.sqrt(len(gained))


@pytest.mark.slow
def test_the_back_end_gets_the_correction_of_each_image(
        tracked_bent: tuple[Tracker, list[OdometryResult]], tmp_path: Path) -> None:
    """Loops are the same live, by messages, and later, by results."""
    _, results = tracked_bent
    corrections = [one.camera_correction for one in results]
    assert not any(map(any, corrections[:FIRST_TURN]))
    # The significant part of it.
    assert 0 < corrections[-1].k1 < 0.018
    make, estimate, live = Messages(message_type, OdometryConfig()), StepMessages('body'), []
    with ResultsFolder(tmp_path / 'results', Config()) as folder:
        for number, one in enumerate(results):
            folder.add_frame(number, one, 0.0)
            live += [*estimate.status(make.status(one)), *estimate.odometry(make.odometry(one))]
            if one.status in TRACKED:
                message = make.relative_pose_cov(one)
                folder.publish(Outgoing('relative_pose_cov', message), one.stamp_ns)
                live += estimate.relative_pose(message)
    assert [step.camera_correction for step in live] == corrections
    assert [step.camera_correction for step in read_steps(
        tmp_path / 'results')] == corrections


@pytest.mark.parametrize('field', Correction._fields)
def test_a_correction_comes_back_from_its_texts_or_is_refused(field: str) -> None:
    correction = Correction(*WRONG.tolist())
    assert correction_of(correction_values(correction)) == correction
    # Results of an earlier version have a k1 alone, or nothing.
    assert correction_of({'k1': '0.02', 'focal': None}) == Correction(0.02)
    for word in ('nan', 'inf', '1e300', '-5e3', 'wide'):
        with pytest.raises(ValueError, match='correction of the camera|could not convert'):
            correction_of({**correction_values(correction), field: word})


@pytest.mark.slow
def test_the_estimate_is_reset_with_another_camera(bent: Bent) -> None:
    tracker, _ = bent.tracked()
    assert 'calibration off by' in tracker.diagnosis().values
    # The same camera sends it again, as drivers do.
    tracker.camera_info(camera_info(bent.K, bent.size))
    assert 'calibration off by' in tracker.diagnosis().values
    other = camera_info(bent.K, bent.size)
    other.d = [0.001, 0.0, 0.0, 0.0, 0.0]
    tracker.camera_info(other)
    assert 'calibration off by' not in tracker.diagnosis().values
    tracker.image(image(bent.images[-1], stamp_ns=10**10))
    assert tracker.last is not None and tracker.last.status in (Status.OK, Status.TIME_JUMP)


@pytest.mark.slow
def test_corrected_images_are_reproducible_to_the_last_bit(
        bent: Bent, tracked_bent: tuple[Tracker, list[OdometryResult]]) -> None:
    (_, first), (one, second) = tracked_bent, bent.tracked()
    assert all(np.array_equal(a.pose, b.pose) for a, b in zip(first, second))
    # After a reset the lens is unknown.
    one.reset()
    for number, picture in enumerate(bent.images[:5]):
        one.image(image(picture, stamp_ns=(number + 1) * 10**8))
    assert one.last is not None and np.array_equal(one.last.pose, first[4].pose)


@pytest.mark.slow
def test_a_good_calibration_is_not_reported() -> None:
    tracker, _ = Bent(0.0).tracked()
    assert 'calibration off by' not in tracker.diagnosis().values
    assert tracker.complaints_of_content == []


def through(sequence: FrameSequence, **odometry: Any
            ) -> tuple[VisualOdometry, list[OdometryResult]]:
    one = VisualOdometry(odometry=OdometryConfig(**odometry))
    return one, [one.process(Frame(sequence.image(i), sequence.K, (i + 1) * 10**8))
                 for i in range(len(sequence))]


def aside(motion: Numbers) -> float:
    """Degrees by which a motion (4, 4) goes to the right."""
    return float(np.degrees(motion[0, 3] / np.linalg.norm(motion[:3, 3])))


@pytest.mark.slow
def test_in_a_real_turn_the_calibration_is_corrected_and_motion_is_as_the_vehicle_has_it(
        kitti: Path) -> None:
    """Directions of the vehicle are those of its GPS and inertial sensors, not of images."""
    sequence = KittiSequence(kitti / 'sequences' / '03', start=60, end=230)
    (odometry, corrected), (_, calibrated) = through(sequence), through(sequence, scale='none')
    assert odometry.calibration is not None
    first = next(i for i, one in enumerate(corrected) if any(one.camera_correction))
    assert first < 60
    assert sequence.poses is not None
    true = [np.linalg.inv(before) @ after for before, after in pairwise(sequence.poses)]
    off, unknowing = (np.median([aside(one.motion) - aside(motion)
                                 for one, motion in zip(results[1:], true, strict=True)][first:])
                      for results in (corrected, calibrated))
    assert abs(off) < abs(unknowing) / 2


@pytest.mark.slow
def test_exact_and_trembling_cameras_are_not_corrected(corridor: Path, freiburg1_rpy: Path
                                                       ) -> None:
    """Of TartanAir the calibration is exact; TUM's has a rolling shutter, which is no lens."""
    for sequence in (KittiSequence(corridor), tum_rgbd(freiburg1_rpy)):
        odometry, results = through(sequence)
        assert odometry.calibration is None
        assert not any(any(one.camera_correction) for one in results)
