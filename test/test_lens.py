"""What a calibration leaves of the lens: what turns tell of it, and what tells nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
from djet_ros.cli.main import main
from djet_ros.config.sections import Config
from djet_ros.core.geometry import rotation_exp, unit
from djet_ros.core.lens import by_radius, fit_lens, LensFit, linearise, MatchedPair
from djet_ros.core.types import Array, Pose
from djet_ros.errors import DjetError
from djet_ros.lab import lens
from djet_ros.lab.scenes.sequence import render_sequence
from djet_ros.odometry.camera import Camera
from djet_ros.recordings.datasets import open_sequence
from djet_ros.recordings.kitti import KittiSequence
from djet_ros.recordings.recording import SequenceRecording
import numpy as np
import pytest
import yaml

SIZE = (640, 480)
K = np.array([[520.0, 0, 318], [0, 520.0, 243], [0, 0, 1]])
NOISE = 0.1


def undistorted(camera: Camera, pixels: Array, k1: float) -> Array:
    D = np.append(k1, np.zeros(4))
    # Its five rounds leave a thousandth of a pixel in the corners; so it is told what that is.
    places = np.zeros_like(pixels)
    for _ in range(4):
        seen = camera.pixels(places, k1)[0]
        places = places + cv2.undistortPoints(pixels[:, None], K, D)[:, 0] \
            - cv2.undistortPoints(seen[:, None], K, D)[:, 0]
    return places


def seen_pair(rng: np.random.Generator, turn: float, k1: float) -> MatchedPair:
    """Points 4 to 40 units away, from a camera that goes one ahead and turns, with a lens k1."""
    camera = Camera(K, np.empty(0), SIZE)
    pixels = rng.uniform((60, 60), (580, 420), (250, 2))
    R, t = rotation_exp(np.array([0.1, 1, 0.05]) * turn), unit(np.array([0.05, 0.02, 1]))
    depth = 1 / rng.uniform(1 / 40, 1 / 4, len(pixels))
    x = undistorted(camera, pixels, k1)
    there = depth[:, None] * np.column_stack([x, np.ones(len(x))]) @ R.T + t
    y = camera.pixels(there[:, :2] / there[:, 2:], k1)[0] + rng.normal(0, NOISE, pixels.shape)
    return MatchedPair(*((one - K[:2, 2]) / K[0, 0] for one in (pixels, y)), Pose(R, t))


def fitted(seed: int, turns: Sequence[float], k1: float) -> LensFit:
    rng = np.random.default_rng(seed)
    return fit_lens([seen_pair(rng, turn, k1) for turn in turns], Camera(K, np.empty(0), SIZE))


@pytest.mark.parametrize('k1', [0.0, 0.015, -0.02, 0.05])
def test_turns_tell_the_coefficient_and_how_sure_it_is(k1: float) -> None:
    turns = np.linspace(0.02, 0.06, 20)
    fits = [fitted(seed, turns, k1) for seed in range(4)]
    errors = np.array([(fit.k1 - k1) / fit.sigma for fit in fits])
    # By ten groups each, errors are of a Student distribution with nine degrees of freedom.
    assert np.abs(errors).max() < 4 and abs(errors.mean()) < 2
    assert all(1e-3 < fit.sigma < 4e-3 for fit in fits)
    assert fits[0].noise == pytest.approx(NOISE, rel=0.2)
    assert max(fit.disagreement for fit in fits) < 4


def test_noise_alone_is_no_coefficient_on_a_straight_way() -> None:
    # Distances among undistorted points would say 0.1 here, as they shrink with the image.
    for fit in (fitted(seed, [0.0] * 20, 0.0) for seed in range(3)):
        assert abs(fit.k1) < 4 * fit.sigma


def test_of_a_distortion_a_turn_leaves_more_than_a_straight_way() -> None:
    rng, camera = np.random.default_rng(0), Camera(K, np.empty(0), SIZE)
    straight, turned = (tell(seen_pair(rng, turn, 0.0), camera, 0.0).share
                        for turn in (0.0, 0.05))
    assert turned > 3 * straight


def test_rings_around_the_middle_say_the_same() -> None:
    fit = fitted(0, np.linspace(0.02, 0.06, 20), 0.02)
    k1, sigma = by_radius(fit, np.array([0.2, 0.3, 0.4, 0.5, 5.0, 9.0]))
    assert (np.abs(k1 - 0.02) < 4 * sigma)[:4].all()
    assert np.isnan(k1[4])


@pytest.fixture(scope='module')
def whip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render_sequence('whip', tmp_path_factory.mktemp('whip'), 30, size=(480, 360))


@pytest.fixture(scope='module')
def distorted(whip: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Show the same frames through a lens with k1 = -0.02, which the calibration leaves out."""
    sequence = open_sequence(whip)
    folder = tmp_path_factory.mktemp('distorted') / 'sequences' / '09'
    (folder / 'image_0').mkdir(parents=True)
    for name in ('calib.txt', 'times.txt'):
        (folder / name).write_text((whip / name).read_text())
    width, height = sequence.size
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).reshape(-1, 2)
    D = np.array([-0.02, 0, 0, 0, 0])
    where = cv2.undistortPoints(pixels[:, None].astype(float), sequence.K, D, P=sequence.K)
    where = where.reshape(height, width, 2).astype(np.float32)
    for index, path in enumerate(sequence.frame_paths):
        seen = cv2.remap(sequence.raw(index), where[..., 0], where[..., 1], cv2.INTER_LANCZOS4,
                         borderMode=cv2.BORDER_REPLICATE)
        cv2.imwrite(str(folder / 'image_0' / path.name), seen)
    return folder


def test_a_right_calibration_is_left_as_it_is(
        whip: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['lens', str(whip)]) == 0
    said = capsys.readouterr().out
    assert 'not worth correcting' in said and 'D:' not in said


def test_a_wrong_calibration_is_told_and_corrected(
        distorted: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / 'lens'
    assert main(['lens', str(distorted), '--output', str(output)]) == 0
    said = capsys.readouterr().out
    row = next(line for line in said.splitlines() if line.startswith('D: '))
    k1 = float(row.split()[1])
    assert k1 == pytest.approx(-0.02, abs=1e-3)
    # The row is one of a calib.txt, with which next to nothing is left.
    calib = distorted / 'calib.txt'
    before = calib.read_text()
    calib.write_text(f'{before}{row}\n')
    corrected = open_sequence(distorted)
    assert corrected.distortion.tolist() == [k1, 0, 0, 0, 0]
    left = lens.examine(SequenceRecording(corrected), Config(), lambda: None)
    calib.write_text(before)
    assert not left.worth_correcting
    # Beside it, what ROS reads.
    written = yaml.safe_load((output / 'lens.yaml').read_text())
    assert written['distortion_coefficients']['data'] == [pytest.approx(k1, rel=1e-3), 0, 0, 0, 0]
    assert (written['image_width'], written['image_height']) == (480, 360)
    assert (output / 'lens.png').read_bytes().startswith(b'\x89PNG')


def test_a_long_recording_is_held_in_part(whip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lens, 'MOST_PAIRS', 14)
    monkeypatch.setattr(lens, 'LEAST_PAIRS', 10)
    report = lens.examine(SequenceRecording(open_sequence(whip)), Config(), lambda: None)
    assert 10 <= len(report.fit.told) <= 14 < report.pairs


def test_where_the_camera_does_not_turn_no_number_is_given(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    road = render_sequence('road', tmp_path, 5, size=(480, 144))
    assert main(['lens', str(road)]) == 2
    said = capsys.readouterr()
    assert 'straight ahead tells nothing' in said.err and said.err.count('\n') == 1
    assert not said.out


def test_results_of_others_are_not_replaced(
        whip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / 'lens.yaml').write_text('mine')
    assert main(['lens', str(whip), '--output', str(tmp_path)]) == 2
    assert '--overwrite' in capsys.readouterr().err
    assert (tmp_path / 'lens.yaml').read_text() == 'mine'


def test_the_slow_turn_of_kitti_03_tells_what_its_rectification_left(kitti: Path) -> None:
    sequence = KittiSequence(kitti / 'sequences' / '03', start=50, end=116)
    report = lens.examine(SequenceRecording(sequence), Config(), lambda: None)
    assert report.worth_correcting
    assert 0.0125 < report.fit.k1 < 0.0186
    assert 0 < report.fit.sigma < 0.003


def test_the_straight_street_of_kitti_06_tells_nothing(kitti: Path) -> None:
    sequence = KittiSequence(kitti / 'sequences' / '06', end=12)
    with pytest.raises(DjetError, match='0 of 11 pairs tell'):
        lens.examine(SequenceRecording(sequence), Config(), lambda: None)


def test_what_is_no_distortion_is_refused() -> None:
    fit = fitted(0, np.linspace(0.02, 0.06, 20), 0.0)
    pairs = [one.pair for one in fit.told]
    lens._check(fit, pairs)
    farther = [replace(pair, pose=Pose(pair.pose.R @ pair.pose.R, pair.pose.t)) for pair in pairs]
    with pytest.raises(DjetError, match='degrees, not'):
        lens._check(fit, farther)
    with pytest.raises(DjetError, match='4.0 standard errors'):
        lens._check(replace(fit, disagreement=4.0), pairs)
