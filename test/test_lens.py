"""Estimation of lens distortion: determined by turns, and no estimate otherwise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
from djet_ros.cli.main import main
from djet_ros.config.sections import Config, OdometryConfig
from djet_ros.core.covariance import LARGE_CELLS
from djet_ros.core.geometry import rotation_exp, rotation_log, unit
from djet_ros.core.lens import (
    by_radius,
    fit_lens,
    LensFit,
    linearise,
    MatchedPair,
    MOST_MATCHES,
    SHIFT,
)
from djet_ros.core.types import Array, Pose, RelativePose, Status
from djet_ros.errors import DjetError
from djet_ros.lab import lens
from djet_ros.lab.scenes.sequence import render_sequence
from djet_ros.odometry.camera import Camera
from djet_ros.odometry.tracker import Tracker
from djet_ros.recordings.bag_writers import write_kitti_bag
from djet_ros.recordings.datasets import open_sequence
from djet_ros.recordings.decoding import MAKE, message_type
from djet_ros.recordings.kitti import KittiSequence
from djet_ros.recordings.recording import SequenceRecording
import numpy as np
import pytest
import yaml

SIZE = (640, 480)
K = np.array([[520.0, 0, 318], [0, 520.0, 243], [0, 0, 1]])
NOISE = 0.1


CAMERA = Camera(K, np.empty(0), SIZE)


def undistorted(pixels: Array, k1: float) -> Array:
    """Return the points X/Z, Y/Z seen at pixels: r (1 + k1 r^2) is solved by Newton's steps."""
    seen = (pixels - K[:2, 2]) / K[0, 0]
    radii = np.linalg.norm(seen, axis=1)
    r = radii.copy()
    for _ in range(60):
        r -= (r * (1 + k1 * r * r) - radii) / (1 + 3 * k1 * r * r)
    assert np.abs(r * (1 + k1 * r * r) - radii).max() < 1e-9
    return seen * (r / radii)[:, None]


def seen_pair(rng: np.random.Generator, turn: float, k1: float) -> MatchedPair:
    """Points 4 to 40 units away, from a camera that goes one ahead and turns, with a lens k1."""
    pixels = rng.uniform((60, 60), (580, 420), (250, 2))
    R, t = rotation_exp(np.array([0.1, 1, 0.05]) * turn), unit(np.array([0.05, 0.02, 1]))
    depth = 1 / rng.uniform(1 / 40, 1 / 4, len(pixels))
    x = undistorted(pixels, k1)
    there = depth[:, None] * np.column_stack([x, np.ones(len(x))]) @ R.T + t
    y = CAMERA.pixels(there[:, :2] / there[:, 2:], k1)[0] + rng.normal(0, NOISE, pixels.shape)
    return MatchedPair(*((one - K[:2, 2]) / K[0, 0] for one in (pixels, y)), Pose(R, t))


def seen_pairs(seed: int, turns: Sequence[float], k1: float) -> list[MatchedPair]:
    rng = np.random.default_rng(seed)
    return [seen_pair(rng, turn, k1) for turn in turns]


def fitted(pairs: Sequence[MatchedPair]) -> LensFit:
    fit = fit_lens(pairs, CAMERA)
    assert fit is not None
    return fit


TURNS = np.linspace(0.02, 0.06, 20)


@pytest.mark.parametrize(('matches', 'kept'), [(0, 0), (7, 7), (300, 300), (301, 151)])
def test_the_matches_of_a_pair_are_limited(matches: int, kept: int) -> None:
    places = np.random.default_rng(1).uniform((0, 0), SIZE, (matches, 2))
    seen = RelativePose(Status.OK, x=places, placed=places, voting=np.ones(matches, bool))
    pair = MatchedPair.of(seen, K)
    assert len(pair.x) == len(pair.y) == kept <= MOST_MATCHES


@pytest.mark.parametrize('k1', [0.0, 0.015, -0.02, 0.05])
def test_turns_determine_k1_and_its_standard_error(k1: float) -> None:
    fits = [fitted(seen_pairs(seed, TURNS, k1)) for seed in range(4)]
    errors = np.array([(fit.k1 - k1) / fit.sigma for fit in fits])
    # With ten groups each, errors follow a Student distribution with nine degrees of freedom.
    assert np.abs(errors).max() < 4 and abs(errors.mean()) < 2
    assert all(1e-3 < fit.sigma < 5e-3 for fit in fits)
    noise = np.median([one.noise for one in fits[0].linearised])
    assert noise == pytest.approx(NOISE, rel=0.2)
    assert max(fit.disagreement for fit in fits) < 4


@pytest.mark.parametrize('k1', [-0.35, -0.33, -0.3, -0.1, 0.2])
def test_a_wide_lens_is_estimated_without_any_calibration(k1: float) -> None:
    # At the outermost matches, -0.35 leaves a third of the radial derivative, and -0.393 none.
    fit = lens.trusted_fit(seen_pairs(0, np.linspace(0.02, 0.06, 24), k1), CAMERA)
    assert abs(fit.k1 - k1) < 4 * fit.sigma and fit.sigma < 6e-3


@pytest.mark.slow
def test_near_a_fold_of_the_image_there_is_no_estimate() -> None:
    with pytest.raises(DjetError, match='no k1 was found'):
        lens.trusted_fit(seen_pairs(0, TURNS, -0.389), CAMERA)


def test_systematic_displacements_of_cells_are_within_the_standard_error() -> None:
    rng, pairs = np.random.default_rng(0), seen_pairs(0, TURNS, 0.0)
    fit = fitted(pairs)
    side = np.sqrt(520 * 360 / LARGE_CELLS) / K[0, 0]
    moves = []
    for _ in range(4):
        shifts = rng.normal(0, SHIFT * NOISE / K[0, 0], (6, 5, 2))
        cells = [((pair.y + np.array([0.6, 0.5])) / side).astype(int) for pair in pairs]
        shifted = [replace(pair, y=pair.y + shifts[tuple(cell.clip(0, (5, 4)).T)])
                   for pair, cell in zip(pairs, cells)]
        moves.append(fitted(shifted).k1 - fit.k1)
    assert 0 < np.sqrt(np.mean(np.square(moves))) < fit.sigma


def test_noise_on_a_straight_path_is_not_taken_for_distortion() -> None:
    # Distances between undistorted points would give 0.1 here, as they shrink with the image.
    for fit in (fitted(seen_pairs(seed, [0.0] * 20, 0.0)) for seed in range(3)):
        assert abs(fit.k1) < 4 * fit.sigma


def test_the_pose_absorbs_less_distortion_in_a_turn_than_on_a_straight_path() -> None:
    straight, turned = (linearise(pair, CAMERA, 0.0).share
                        for pair in seen_pairs(0, [0.0, 0.05], 0.0))
    assert turned > 3 * straight


def test_rings_around_the_centre_agree() -> None:
    fit = fitted(seen_pairs(0, TURNS, 0.02))
    k1, sigma = by_radius(fit, np.array([0.2, 0.3, 0.4, 0.5, 5.0, 9.0]))
    assert (np.abs(k1 - 0.02) < 4 * sigma)[:4].all()
    assert np.isnan(k1[4])


@pytest.fixture(scope='module')
def whip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render_sequence('whip', tmp_path_factory.mktemp('whip'), 30, size=(480, 360))


def like(sequence: Path, folder: Path, row: str = '') -> Path:
    """Make a sequence with the files of another, but for the images, and a row in calib.txt."""
    folder = folder / 'sequences' / '09'
    (folder / 'image_0').mkdir(parents=True)
    (folder / 'times.txt').write_text((sequence / 'times.txt').read_text())
    (folder / 'calib.txt').write_text((sequence / 'calib.txt').read_text() + row)
    return folder


def with_row(sequence: Path, folder: Path, row: str) -> Path:
    folder = like(sequence, folder, f'{row}\n')
    (folder / 'image_0').rmdir()
    (folder / 'image_0').symlink_to(sequence / 'image_0')
    return folder


def through_a_lens(original: Path, place: Path) -> Path:
    """Show the same frames through a lens with k1 = -0.02, which the calibration leaves out."""
    sequence = open_sequence(original)
    folder = like(original, place)
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


@pytest.fixture(scope='module')
def distorted(whip: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return through_a_lens(whip, tmp_path_factory.mktemp('distorted'))


def examined(sequence: Path, config: Config | None = None) -> lens.LensReport:
    recording = SequenceRecording(open_sequence(sequence))
    return lens.examine(recording, config or Config(), lambda: None)


def row_of(printed: str) -> str:
    return next(line for line in printed.splitlines() if line.startswith('D: '))


@pytest.mark.slow
def test_a_correct_calibration_is_kept(
        whip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / 'lens.yaml').write_text('of an earlier run')
    assert main(['lens', str(whip), '--output', str(tmp_path), '--overwrite']) == 0
    printed = capsys.readouterr().out
    assert 'not worth correcting' in printed and 'D:' not in printed
    assert [path.name for path in tmp_path.iterdir()] == ['lens.png']


@pytest.mark.slow
def test_a_wrong_calibration_is_detected_and_corrected(
        distorted: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / 'lens'
    assert main(['lens', str(distorted), '--output', str(output)]) == 0
    printed = capsys.readouterr().out
    flag, k1 = printed.splitlines()[-1 - printed.count('plot: ')].split()
    assert float(k1) == pytest.approx(-0.02, abs=1e-3)
    assert 'recalibrating on the raw images' in printed and 'odometry.residual_k1' in printed
    # With that flag next to nothing remains.
    assert main(['lens', str(distorted), flag, k1]) == 0
    again = capsys.readouterr().out
    assert f'(calibrated: {float(k1):.4g})' in again and 'not worth correcting' in again
    # A driver's images are raw, and these are not.
    assert [path.name for path in output.iterdir()] == ['lens.png']
    assert (output / 'lens.png').read_bytes().startswith(b'\x89PNG')


@pytest.mark.slow
def test_a_wrong_row_of_a_calib_txt_is_recognised_by_the_right_one(
        distorted: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wrong = with_row(distorted, tmp_path, 'D: 0.01 0 0 0 0')
    assert main(['lens', str(wrong)]) == 0
    printed = capsys.readouterr().out
    assert 'row of its calib.txt' in printed and '--residual-k1' not in printed
    assert float(row_of(printed).split()[1]) == pytest.approx(-0.02, abs=1e-3)
    # The parameter is for images without distortion by their calibration.
    assert main(['lens', str(wrong), '--residual-k1', '0.01']) == 2
    assert 'odometry.residual_k1 is 0.01, but' in capsys.readouterr().err


def tracked(sequence: Path, k1: float = 0.0) -> Array:
    """Poses (N, 4, 4) that the odometry estimates in a sequence."""
    recording = SequenceRecording(open_sequence(sequence))
    tracker = Tracker(Config(odometry=OdometryConfig(residual_k1=k1)), message_type,
                      image_topic=recording.image_topic)
    poses = []
    for topic, _, message in recording.messages():
        if topic == recording.info_topic:
            tracker.camera_info(message)
        elif topic == recording.image_topic:
            tracker.image(message)
            assert tracker.last is not None
            poses.append(tracker.last.pose)
    return np.array(poses)


@pytest.mark.slow
def test_without_residual_distortion_poses_are_right_and_keep_their_scale(
        tmp_path: Path) -> None:
    walk = render_sequence('handheld', tmp_path, 16, size=(480, 360))
    seen = through_a_lens(walk, tmp_path / 'seen')
    truth = open_sequence(walk).poses
    assert truth is not None
    turned, grown = {}, {}
    for name, poses in (('plain', tracked(walk)), ('seen', tracked(seen)),
                        ('undone', tracked(seen, -0.02))):
        off = np.linalg.inv(truth) @ poses
        turned[name] = np.degrees(np.linalg.norm(rotation_log(off[:, :3, :3]), axis=1).max())
        lengths, steps = (np.linalg.norm(np.diff(some[:, :3, 3], axis=0), axis=1)
                          for some in (poses, truth))
        grown[name] = abs(np.log((lengths / steps)[-4:].mean() / (lengths / steps)[:4].mean()))
    assert max(turned['plain'], turned['undone']) < 0.05 and turned['seen'] > 0.1
    assert max(grown['plain'], grown['undone']) < 0.01 and grown['seen'] > 0.02


@pytest.fixture(scope='module')
def raw_bag(distorted: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record the distorted frames as raw images whose CameraInfo has another k1."""
    folder = tmp_path_factory.mktemp('raw')
    bag = folder / 'bag'
    write_kitti_bag(open_sequence(with_row(distorted, folder, 'D: 0.01 0 0 0 0')), bag)
    return bag


@pytest.mark.slow
def test_raw_images_give_a_calibration_file_for_the_driver(
        raw_bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['lens', str(raw_bag), '--output', str(tmp_path / 'out')]) == 0
    printed = capsys.readouterr().out
    assert '(calibrated: 0.01)' in printed
    assert 'camera_info_manager' in printed and 'calib.txt' not in printed
    written = yaml.safe_load((tmp_path / 'out' / 'lens.yaml').read_text())
    D = written['distortion_coefficients']['data']
    assert D[0] == pytest.approx(-0.02, abs=1e-3)
    assert not any(D[1:])
    assert row_of(printed) == f'D: {D[0]:.4g} 0 0 0 0'


def test_rectified_images_give_no_calibration_file(
        raw_bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # As if rectified with an unknown calibration.
    assert main(['lens', str(raw_bag), '--rectified', 'true', '--output', str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert '--residual-k1 -0.0' in printed and 'lens.yaml' not in printed
    assert [path.name for path in tmp_path.iterdir()] == ['lens.png']


def test_a_file_for_a_driver_differs_in_the_distortion_alone() -> None:
    # The right camera of a stereo pair, which bins 2x2 pixels of a part of its sensor.
    info = MAKE.camera_info(0, 'right', K * [[2], [2], [1]], (1400, 1000),
                            np.array([0.1, 0.02, 0.003, 0.004, 0.5]))
    info.binning_x = info.binning_y = 2
    info.roi.x_offset, info.roi.y_offset, info.roi.width, info.roi.height = 60, 20, 1280, 960
    info.r = rotation_exp(np.array([0.0, 0.02, 0.0])).ravel()
    info.p = np.array([1000, 0, 630, -120.0, 0, 1000, 480, 0, 0, 0, 1, 0])
    fit = LensFit(0.12, 0.001, 0.12, (), 0.0)
    report = lens.LensReport(Camera.from_info(info, rectified=False), info, False, 40, fit)
    written = yaml.safe_load(lens.calibration(report))
    assert (written['image_width'], written['image_height']) == (1400, 1000)
    assert written['distortion_model'] == 'plumb_bob'
    assert written['distortion_coefficients']['data'] == [0.12, 0.02, 0.003, 0.004, 0.5]
    for name, values, columns in (('camera_matrix', info.k, 3), ('projection_matrix', info.p, 4),
                                  ('rectification_matrix', info.r, 3)):
        assert written[name] == {'rows': 3, 'cols': columns, 'data': values.tolist()}


def test_only_part_of_a_long_recording_is_held_in_memory(
        whip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lens, 'MOST_PAIRS', 14)
    monkeypatch.setattr(lens, 'LEAST_PAIRS', 10)
    report = examined(whip)
    assert 10 <= len(report.fit.linearised) <= 14 < report.pairs


def test_a_correct_calibration_is_kept_with_fast_rotation_and_blur(
        whip: Path, tmp_path: Path) -> None:
    # 15 degrees from frame to frame, and streaks of nine pixels.
    folder = like(whip, tmp_path)
    for path in sorted((whip / 'image_0').iterdir()):
        gray = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(str(folder / 'image_0' / path.name), cv2.blur(gray, (9, 1)))
    report = examined(folder)
    assert report.turned_deg > 300
    assert not report.worth_correcting


def test_without_rotation_there_is_no_estimate(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    road = render_sequence('road', tmp_path, 5, size=(480, 144))
    assert main(['lens', str(road), '--output', str(tmp_path / 'out')]) == 2
    printed = capsys.readouterr()
    assert 'forward motion does not determine k1' in printed.err and printed.err.count('\n') == 1
    assert not printed.out
    assert not (tmp_path / 'out').exists()


def test_a_short_recording_is_reported_as_too_short(whip: Path) -> None:
    recording = SequenceRecording(KittiSequence(whip, end=9))
    with pytest.raises(DjetError, match='8 of 8 pairs .* record for longer'):
        lens.examine(recording, Config(), lambda: None)


def test_objects_that_move_with_the_camera_can_be_masked(whip: Path, tmp_path: Path) -> None:
    bonnet = np.full((360, 480), 255, np.uint8)
    bonnet[240:] = 0
    cv2.imwrite(str(tmp_path / 'bonnet.png'), bonnet)
    report = examined(whip, Config(odometry=OdometryConfig(
        mask_file=str(tmp_path / 'bonnet.png'))))
    rows = np.concatenate([report.camera.pixels(one.pair.y, 0.0)[0][:, 1]
                           for one in report.fit.linearised])
    # The aligned position of a match may be a pixel from its corner.
    assert rows.max() < 242 and not report.worth_correcting


def test_parameters_are_those_of_a_replay(
        whip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cv2.imwrite(str(tmp_path / 'small.png'), np.full((36, 48), 255, np.uint8))
    assert main(['lens', str(whip), '--mask-file', str(tmp_path / 'small.png')]) == 2
    assert 'odometry.mask_file has 48x36 pixels' in capsys.readouterr().err
    (tmp_path / 'my.yaml').write_text('odometry:\n  mask: true\n')
    assert main(['lens', str(whip), '--config', str(tmp_path / 'my.yaml')]) == 2
    assert 'odometry.mask is true' in capsys.readouterr().err


def test_results_of_others_are_not_replaced(
        whip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / 'lens.yaml').write_text('mine')
    assert main(['lens', str(whip), '--output', str(tmp_path)]) == 2
    assert '--overwrite' in capsys.readouterr().err
    assert (tmp_path / 'lens.yaml').read_text() == 'mine'


@pytest.mark.slow
def test_the_slow_turn_of_kitti_03_determines_the_remaining_distortion(kitti: Path) -> None:
    sequence = KittiSequence(kitti / 'sequences' / '03', start=50, end=116)
    report = lens.examine(SequenceRecording(sequence), Config(), lambda: None)
    assert report.worth_correcting
    assert 0.0125 < report.fit.k1 < 0.0186
    assert 0 < report.fit.sigma < 0.003


def test_the_straight_street_of_kitti_06_does_not_determine_k1(kitti: Path) -> None:
    sequence = KittiSequence(kitti / 'sequences' / '06', end=12)
    with pytest.raises(DjetError, match='0 of 11 pairs are informative .* record turns'):
        lens.examine(SequenceRecording(sequence), Config(), lambda: None)


def test_an_estimate_that_is_not_of_distortion_is_refused() -> None:
    pairs = seen_pairs(0, TURNS, 0.0)
    assert abs(lens.trusted_fit(pairs, CAMERA).k1) < 0.02
    farther = [replace(pair, pose=Pose(pair.pose.R @ pair.pose.R, pair.pose.t)) for pair in pairs]
    with pytest.raises(DjetError, match='the total rotation would be .* degrees instead of'):
        lens.trusted_fit(farther, CAMERA)
    # The lens does not change where the camera rotates more.
    uneven = seen_pairs(1, [0.03] * 80, 0.05) + seen_pairs(2, [0.06] * 20, -0.05)
    with pytest.raises(DjetError, match='standard errors'):
        lens.trusted_fit(uneven, CAMERA)
