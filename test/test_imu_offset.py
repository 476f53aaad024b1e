"""Finding the offset of an IMU's clock, and its mounting, from turns that are known exactly."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

from djet_ros.cli.main import main
from djet_ros.config.sections import Config
from djet_ros.core.geometry import rotation_angle, rotation_exp
from djet_ros.core.types import Array
from djet_ros.errors import DjetError
from djet_ros.lab.imu_offset import fit_imu, rotations_and_rates, VisualRotations
from djet_ros.lab.scenes.imu import feel, Mems, TO_CAMERA
from djet_ros.lab.scenes.sequence import render_sequence
from djet_ros.lab.scenes.walk import HandHeld
from djet_ros.recordings.bag_writers import ResultBag
from djet_ros.recordings.decoding import MAKE
from djet_ros.recordings.recording import BagRecording
import numpy as np
import pytest

PERIOD = 10**8


def seen(poses: Array, noise: float, seed: int = 0) -> VisualRotations:
    rng = np.random.default_rng(seed)
    R = np.stack([rotation_exp(rng.normal(0, noise, 3)) @ (a[:3, :3].T @ b[:3, :3]).T
                  for a, b in pairwise(poses)])
    start = 5 * 10**9 + np.arange(len(R), dtype=np.int64) * PERIOD
    return VisualRotations(start, start + PERIOD, R)


def trajectory(frames: int = 150, seed: int = 0) -> Array:
    hand = HandHeld((0.0, -1.3, 0.0), 0.2, seed, limit=frames)
    return np.stack([hand.pose(i) for i in range(frames)])


@pytest.mark.parametrize('offset', [0.0, 0.0123, -0.087, 0.31])
def test_offset_mounting_and_bias_are_found(offset: float) -> None:
    poses = trajectory()
    felt = feel(poses, 0.1, Mems(), 1)
    fit = fit_imu(seen(poses, np.radians(0.02)),
                  felt.stamps_ns + 5 * 10**9 + round(offset * 1e9), felt.rates)
    assert fit.offset == pytest.approx(offset, abs=5e-4)
    assert abs(fit.offset - offset) < 5 * fit.offset_sigma
    assert rotation_angle(fit.to_camera, TO_CAMERA) < np.radians(0.2)
    assert np.linalg.norm(fit.bias - felt.rate_biases.mean(0)) < 1e-3


def test_a_few_wrong_pairs_do_not_matter() -> None:
    poses = trajectory()
    felt, turns = feel(poses, 0.1, Mems(), 1), seen(poses, np.radians(0.02))
    turns.R[::6] = np.eye(3)
    fit = fit_imu(turns, felt.stamps_ns + 5 * 10**9 + 40_000_000, felt.rates)
    assert fit.offset == pytest.approx(0.04, abs=1e-3)


def test_a_camera_that_hardly_rotates_gives_no_estimate() -> None:
    poses = np.tile(np.eye(4), (60, 1, 1))
    felt = feel(poses, 0.1, Mems(), 1)
    with pytest.raises(DjetError, match='do not determine an offset; record at least 20'):
        fit_imu(seen(poses, 1e-5), felt.stamps_ns + 5 * 10**9, felt.rates)


def test_clocks_far_apart_are_reported() -> None:
    poses = trajectory()
    felt = feel(poses, 0.1, Mems(), 1)
    with pytest.raises(DjetError, match='the IMU covers 0 of 149 pairs'):
        fit_imu(seen(poses, 1e-5), felt.stamps_ns + 500 * 10**9, felt.rates)


@pytest.mark.slow
def test_the_command_prints_lines_for_a_parameter_file(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = render_sequence('handheld', tmp_path, 30, 0, (320, 240))
    assert main(['lab', 'imu-offset', str(folder)]) == 0
    lines = capsys.readouterr().out.splitlines()
    name, value = lines[0].split('#')[0].split(':')
    assert name == 'odometry.imu_offset'
    assert abs(float(value)) < 0.005
    x, y, z, w = map(float, lines[1].split('"')[1].split())
    assert abs(np.dot((x, y, z, w), (0.5, -0.5, 0.5, 0.5))) > np.cos(np.radians(1))


def still_bag(path: Path, focal: float, images: int) -> Path:
    """Record black images with an IMU at rest."""
    K = np.array([[focal, 0, focal], [0, focal, focal], [0, 0, focal > 0]])
    with ResultBag(path) as bag:
        for stamp in range(PERIOD, (images + 1) * PERIOD, PERIOD):
            for topic, message in (
                    ('/imu', MAKE.imu(stamp, 'imu', np.zeros(3), np.zeros(3))),
                    ('/camera_info', MAKE.camera_info(stamp, 'camera', K, (100, 100))),
                    ('/image_raw', MAKE.picture(stamp, 'camera', np.zeros((100, 100), np.uint8)))):
                bag.write(topic, message, stamp)
    return path


def test_a_recording_without_an_imu_is_named(
        small_kitti: object, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['lab', 'imu-offset', str(small_kitti())]) == 2  # type: ignore[operator]
    assert 'holds no IMU data' in capsys.readouterr().err


def test_a_recording_is_used_up_to_its_damage(tmp_path: Path) -> None:
    bag = still_bag(tmp_path / 'bag', 50.0, 40)
    file = tmp_path / 'bag' / 'bag.mcap'
    file.write_bytes(file.read_bytes()[:file.stat().st_size // 2])
    warned: list[str] = []
    with BagRecording(bag, auxiliary={'imu': None}) as recording:
        _, stamps, _ = rotations_and_rates(recording, Config(), lambda: None, warned.append)
    assert 10 < len(stamps) < 30
    assert len(warned) == 1 and 'cut short' in warned[0]
    with BagRecording(bag, auxiliary={'imu': None}) as recording, \
            pytest.raises(DjetError, match='cut short'):
        rotations_and_rates(recording, Config(), lambda: None)


@pytest.mark.parametrize(('focal', 'reason'), [
    (0.0, 'CameraInfo k is all zeros: the camera is not calibrated'),
    (50.0, '0 pairs whose angular rates vary by 0.000 rad/s')])
def test_a_recording_without_a_pair_is_told_the_reason(
        tmp_path: Path, capsys: pytest.CaptureFixture[str], focal: float, reason: str) -> None:
    assert main(['lab', 'imu-offset', str(still_bag(tmp_path / 'bag', focal, 3))]) == 2
    error = capsys.readouterr().err
    assert reason in error and error.count('\n') == 1
