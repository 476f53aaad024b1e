"""The command that shows what a gyro and masks are good for, and its scenes."""

from __future__ import annotations

from itertools import pairwise
import json
from pathlib import Path

import cv2
from djet_ros.cli.main import main
from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.fusion import MeasuredRotation
from djet_ros.core.geometry import rotation_angle
from djet_ros.core.starts import KnownMotion
from djet_ros.core.types import Array, Status, TRACKED
from djet_ros.lab.beside import GYRO, is_wrong, MASK, Moment, NOTHING, trial_rows
from djet_ros.lab.scenes import make_scene, Scene
from djet_ros.lab.scenes.imu import feel, Mems
from djet_ros.odometry.frame import Frame
from djet_ros.odometry.inertial import Gyro, GyroNoise
from djet_ros.odometry.result import camera_motion, OdometryResult
from djet_ros.odometry.visual_odometry import VisualOdometry
from djet_ros.replay.pair_errors import angle_errors
import numpy as np
import pytest

pytestmark = pytest.mark.slow


def moment(frame: int = 1, aid: str = GYRO, seed: int = 0, dark: bool = False,
           tracked: bool = True, failed: bool = False, off: float = 0.1, bias: float = 0.02
           ) -> Moment:
    return Moment('street', seed, aid, frame, 'OK', dark, tracked, False, failed,
                  off if tracked else np.nan, np.nan, off if dark else np.nan,
                  10 * off, bias)


def test_every_pair_of_the_fast_turn_rotates_by_15_degrees_and_translates() -> None:
    poses = make_scene('whip', 3).trajectory(30)
    turns = [np.degrees(rotation_angle(a[:3, :3], b[:3, :3])) for a, b in pairwise(poses)]
    lengths = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert min(turns) > 14 and max(turns) < 16
    assert lengths.min() > 0.01


def test_a_measured_rotation_corrects_a_misleading_previous_motion() -> None:
    scene, frame = make_scene('whip', 105), 37
    poses, estimator = scene.trajectory(61), TwoViewEstimator()
    before, previous, current = (
        estimator.view(scene.render(poses[i], i), scene.K) for i in range(frame - 2, frame + 1))
    prior = estimator.estimate(before, previous, known=felt_turn(poses[frame - 2:frame]))
    relative = estimator.estimate(
        previous, current, prior, felt_turn(poses[frame - 1:frame + 1]))
    true_motion = np.linalg.inv(poses[frame - 1]) @ poses[frame]
    rotation, direction = angle_errors(camera_motion(relative), true_motion)
    assert relative.status is Status.OK
    assert rotation < 0.1 and direction < 2


def test_both_bodies_that_may_have_the_measured_rotation_are_refined() -> None:
    scene, frame, estimator = make_scene('moving_object', 58), 12, TwoViewEstimator()
    poses = scene.trajectory(41)[frame - 1:frame + 1]
    views = [estimator.view(scene.render(pose, frame - 1 + i), scene.K)
             for i, pose in enumerate(poses)]
    relative = estimator.estimate(*views, known=felt_turn(poses))
    rotation, direction = angle_errors(camera_motion(relative), np.linalg.inv(poses[0]) @ poses[1])
    assert relative.status is Status.OK
    assert rotation < 0.05 and direction < 1


def felt_turn(poses: Array) -> KnownMotion:
    """Return the rotation between two poses (2, 4, 4) by a gyro, to a hundredth of a degree."""
    R = poses[1, :3, :3].T @ poses[0, :3, :3]
    return KnownMotion(MeasuredRotation(R, np.radians(0.01)**2 * np.eye(3)))


def test_traffic_passes_a_stationary_camera() -> None:
    scene = make_scene('traffic', 31, (248, 76))
    assert np.allclose(scene.trajectory(20), np.eye(4), atol=1e-12)
    depths = np.array([scene.depth(np.eye(4), i) for i in range(0, 60, 4)])
    farthest = depths.max(0)
    hidden = (depths < farthest - 1).mean((1, 2))
    assert hidden.max() > 0.5  # large bodies
    assert hidden.min() < hidden.max() / 2  # which come and go


def test_frames_are_summarised_and_dark_ones_counted_separately() -> None:
    row, = trial_rows([moment(1), moment(2, off=0.3), moment(3, tracked=False, failed=True),
                       moment(4, failed=True, off=5.0), moment(5, dark=True, off=0.4),
                       moment(1, seed=1, bias=0.5)])
    assert (row.pairs, row.failed, row.wrong, row.stood) == (5, 2, 1, 0)
    assert row.rotation_deg == pytest.approx((5.5 / 4, 5.0))
    assert np.isnan(row.direction_deg).all()
    assert (row.dark_off_deg, row.dark_surprise) == (0.4, 4.0)
    assert row.bias_off == (0.02, 0.5)
    assert not is_wrong(moment(tracked=False, failed=True))


def test_the_command_runs_each_trial_with_all_inputs_and_resumes(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ['lab', 'beside', '--trials', 'lorry', '--seeds', '0', '--frames', '3',
               '--workers', '1', '--output', str(tmp_path)]
    assert main(command) == 0
    rows = json.loads((tmp_path / 'beside.json').read_text())['rows']
    assert [(row['aid'], row['pairs']) for row in rows] == [(NOTHING, 2), (GYRO, 2), (MASK, 2)]
    _, with_gyro, masked = rows
    assert masked['failed'] == 0 and masked['direction_deg'][1] < 2
    # With any bias, the lorry is not taken for the static world.
    assert with_gyro['wrong'] == 0 and with_gyro['bias_off'][0] < 1.05
    output, records = capsys.readouterr().out, (tmp_path / 'records.jsonl').read_bytes()
    assert main(command) == 0
    assert capsys.readouterr().out == output
    assert (tmp_path / 'records.jsonl').read_bytes() == records


@pytest.mark.parametrize(('arguments', 'output'), [
    (('--trials', 'moon'), "'moon'"), (('--trials', 'whip,whip'), "'whip' is given twice"),
    (('--trials', ','), 'no trial is given'), (('--frames', '2'), '--frames is 2'),
    (('--workers', '0'), 'workers is 0')])
def test_user_errors_are_one_line_and_exit_code_2(
        tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...],
        output: str) -> None:
    assert main(['lab', 'beside', *arguments, '--output', str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert output in error and error.count('\n') == 1


def gone(scene: Scene, poses: Array, seed: int, period: float = 0.1, first: int = 0
         ) -> list[OdometryResult]:
    """Go a way with a gyro of the usual errors, from some moment of the scene on."""
    felt = feel(poses, period, Mems(), seed, scene.level)
    gyro = Gyro(GyroNoise(Mems.gyro, Mems.gyro_walk))
    gyro.mount(felt.to_camera)
    for stamp, rate in zip(felt.stamps_ns.tolist(), felt.rates, strict=True):
        gyro.add(stamp, rate)
    one = VisualOdometry(gyro=gyro)
    return [one.process(Frame(scene.render(pose, first + i), scene.K, round(i * period * 1e9)))
            for i, pose in enumerate(poses)]


def test_with_a_gyro_a_camera_is_stationary_while_lorries_fill_most_of_the_image() -> None:
    scene = make_scene('traffic', 31, (620, 188))
    results = gone(scene, scene.trajectory(12), 31)
    assert sum(result.stationary for result in results) > len(results) / 2
    for result in results:
        assert np.array_equal(result.pose[:3, 3], np.zeros(3))
        assert rotation_angle(result.pose[:3, :3], np.eye(3)) < np.radians(0.1)


@pytest.mark.parametrize('seed', [105, 106])
def test_static_features_prove_a_standstill_while_lorries_hide_nearly_all(seed: int) -> None:
    scene = make_scene('traffic', seed)
    results = gone(scene, scene.trajectory(10), seed)
    assert all(result.stationary for result in results[1:])


@pytest.mark.parametrize(('noise', 'least'), [(0, 20), (5, 15)])
@pytest.mark.parametrize('seed', range(105, 108))
def test_without_a_gyro_traffic_does_not_move_a_stationary_camera(
        seed: int, noise: int, least: int) -> None:
    """Lorries pass from both sides, by day and night: they hide nearly all that stands still."""
    scene, one = make_scene('traffic', seed), VisualOdometry()
    results = []
    for i, pose in enumerate(scene.trajectory(30)):
        grain = np.random.default_rng(i).normal(0, noise, scene.size[::-1])
        image = np.clip(np.rint(scene.render(pose, i) + grain), 0, 255).astype(np.uint8)
        results.append(one.process(Frame(image, scene.K, i * 10**8)))
    assert sum(result.stationary for result in results[1:]) > least
    for result in results[1:]:
        assert result.stationary or result.status not in TRACKED
        assert np.array_equal(result.pose[:3, 3], np.zeros(3))
        assert np.degrees(rotation_angle(result.pose[:3, :3], np.eye(3))) < 0.02


def test_without_a_gyro_a_camera_above_a_bonnet_starts_when_it_does() -> None:
    scene, one = make_scene('road', 31), VisualOdometry()
    poses = np.tile(np.eye(4), (12, 1, 1))
    poses[4:, 2, 3] = 0.05 * np.arange(1, 9)**2  # m, with 10 m/s^2 at 10 Hz
    bonnet = np.random.default_rng(0).integers(0, 255, (120, 1241), np.uint8)
    bonnet = cv2.GaussianBlur(bonnet, (0, 0), 2)
    results = []
    for i, pose in enumerate(poses):
        image = scene.render(pose, i)
        image[-120:] = bonnet
        results.append(one.process(Frame(image, scene.K, i * 10**8)))
    assert all(result.stationary for result in results[1:4])
    assert not any(result.stationary for result in results[5:])
    for result, before, pose in zip(results[6:], poses[5:], poses[6:], strict=False):
        assert result.status is Status.OK
        assert angle_errors(result.motion, np.linalg.inv(before) @ pose)[1] < 1


@pytest.mark.parametrize('seed', [102, 106])
def test_depths_of_a_lorry_do_not_contradict_a_motion_that_a_gyro_confirms(seed: int) -> None:
    scene = make_scene('moving_object', seed)
    poses = scene.trajectory(18)
    for result, (one, other) in zip(gone(scene, poses, seed)[1:], pairwise(poses), strict=True):
        assert result.status is Status.OK
        assert angle_errors(result.motion, np.linalg.inv(one) @ other)[1] < 2


def test_at_the_start_a_camera_moves_without_rotation_if_no_feature_is_static() -> None:
    scene = make_scene('road', 31, (620, 188))
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, 2, 3] = 0.5 * np.arange(6)
    results = gone(scene, poses, 31)
    assert [result.status for result in results[1:]] == [Status.OK] * 5


def test_a_lorry_that_hides_everything_does_not_move_a_stationary_camera() -> None:
    seen = set()
    # in the first it hides everything in the middle, in the others from the start
    for seed, frames in ((70, 16), (71, 8), (73, 8)):
        scene = make_scene('traffic', seed, (620, 188))
        results = gone(scene, scene.trajectory(frames), seed, first=22)
        assert all(result.stationary for result in results if result.status in TRACKED)
        seen |= {result.status for result in results}
    # In some image nothing was left to stand still for.
    assert Status.AMBIGUOUS in seen


@pytest.mark.parametrize(('axis', 'step'), [(0, 0.05), (2, 0.2)])
def test_a_camera_that_starts_without_rotation_is_not_stationary(axis: int, step: float) -> None:
    scene = make_scene('road', 31, (620, 188))
    poses = np.tile(np.eye(4), (8, 1, 1))
    poses[4:, axis, 3] = step * np.arange(1, 5)
    results = gone(scene, poses, 31)
    assert all(result.stationary for result in results[1:4])
    assert not any(result.stationary for result in results[4:])


def test_a_camera_that_keeps_moving_without_rotation_is_found_to_move() -> None:
    scene = make_scene('road', 31, (620, 188))
    poses = np.tile(np.eye(4), (12, 1, 1))
    poses[3:, 2, 3] = 0.3 * np.arange(1, 10)
    results = gone(scene, poses, 31, period=0.5)
    assert all(result.stationary for result in results[1:3])
    # Static features show the start at once.
    assert all(result.status is Status.OK for result in results[3:])
