"""The consistency of lengths with their sigmas is measured right, and the command reports it."""

from __future__ import annotations

from dataclasses import asdict, replace
import json
from pathlib import Path

from djet_ros.cli.main import main
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.types import Status
from djet_ros.lab.lengths import (
    Drive,
    drive_results,
    DriveChunk,
    run_drive,
    segment_squares,
    step_squares,
)
from djet_ros.lab.store import RecordStore
from djet_ros.odometry.result import OdometryResult
from djet_ros.odometry.scale import Common
import numpy as np
from numpy.typing import NDArray
import pytest
from scipy.stats import chi2

pytestmark = pytest.mark.slow

Poses = NDArray[np.float64]


def straight(values: NDArray[np.float64]) -> Poses:
    poses = np.tile(np.eye(4), (len(values) + 1, 1, 1))
    poses[1:, 2, 3] = np.cumsum(values)
    return poses


def results_of(values: NDArray[np.float64], sigmas: NDArray[np.float64],
               wandered: NDArray[np.float64] | None = None) -> list[OdometryResult]:
    """
    Go straight ahead by these ways, each that sure of its length, and 0.1 mrad of all else.

    wandered: variances of their scale since the start.
    """
    poses, results = straight(values), []
    for index, pose in enumerate(poses):
        motion, covariance = np.eye(4), np.eye(6) * 1e-8
        if index:
            motion[2, 3], covariance[2, 2] = values[index - 1], sigmas[index - 1]**2
        results.append(OdometryResult(
            index, 'camera', Status.OK if index else Status.FIRST_FRAME, index - 1, None, motion,
            pose, covariance, np.eye(6), float(values[index - 1]) if index else 0.0, True,
            common=None if wandered is None or not index else Common(
                np.array([wandered[index - 1], 0.0]), np.ones(2))))
    return results


def test_lengths_with_the_claimed_errors_have_the_expected_squares() -> None:
    rng = np.random.default_rng(0)
    true = rng.uniform(0.5, 2, 4000)
    drifting = true * np.exp(np.cumsum(rng.normal(0, 1e-4, 4000)))  # which is no step's error
    for claimed in (1.0, 0.5):
        sigmas = 0.01 * drifting
        estimated = drifting * (1 + rng.normal(0, 0.01, 4000))
        squares = step_squares(straight(true), results_of(estimated, claimed * sigmas))
        assert np.median(squares) / chi2.median(1) == pytest.approx(1 / claimed**2, rel=0.1)


@pytest.mark.parametrize('stays', [0.3, 0.6])
def test_the_lasting_part_of_an_error_is_in_neighbours_too(stays: float) -> None:
    rng = np.random.default_rng(2)
    errors = rng.normal(0, 0.001, 4000)
    estimated = np.exp(errors + stays * np.append(0.0, np.cumsum(errors)[:-1]))
    results = results_of(estimated, 0.001 * estimated,
                         (stays * 0.001)**2 * np.arange(1, len(estimated) + 1))
    squares = step_squares(straight(np.ones(len(estimated))), results)
    assert np.median(squares) / chi2.median(1) == pytest.approx(1, rel=0.1)


@pytest.mark.parametrize('claimed', [1.0, 0.5])
def test_segments_with_the_claimed_drift_have_the_expected_squares(claimed: float) -> None:
    rng = np.random.default_rng(1)
    walk = np.cumsum(rng.normal(0, 0.004, 3000))
    own = np.full(len(walk), 1e-3)
    estimated = 7 * np.exp(walk + rng.normal(0, own))
    results = results_of(estimated, own * estimated,
                         (claimed * 0.004)**2 * np.arange(1, len(walk) + 1))
    turns, poses = segment_squares(straight(np.ones(len(walk))), results, 20)
    assert len(turns) == len(poses) == 298
    assert np.median(turns) < 1e-6
    # Nothing errs but the length.
    assert np.median(poses) / chi2.median(1) == pytest.approx(1 / claimed**2, rel=0.2)


def test_a_path_is_compared_with_the_truth_in_any_unit() -> None:
    true, chunk = np.full(300, 1.0), DriveChunk('road', 0, None, 301, 100)
    estimated = 5 * np.exp(1e-3 * np.arange(300))
    metric = true * np.where((np.arange(300) >= 60) & (np.arange(300) < 160), 0.98, 1.0)
    drive = drive_results(chunk, straight(true),
                          results_of(estimated, 0.01 * estimated, np.zeros(300)),
                          results_of(metric, 0.01 * metric))
    assert drive.tracked == 300
    assert drive.scale_change == pytest.approx(np.exp(0.27), rel=0.01)
    assert drive.hidden_length == pytest.approx(0.98)
    assert drive.rotation_deg_per_100m == pytest.approx(0, abs=1e-6)
    assert drive.turn_square_100 < 1e-6
    # After n metres of 1 % each, steps claim a per cent of the root of n; while in truth
    # the unit wanders by 0.1 % a metre.
    for metres, square in ((25, drive.pose_square_25), (100, drive.pose_square_100)):
        off = 1e-3 * metres * (metres / 2 + 5)
        claimed = 0.01 * np.sqrt(metres + metres**2 / 10)
        assert square == pytest.approx((off / claimed)**2 / chi2.median(6), rel=0.15)
    lost = [replace(one, status=Status.AMBIGUOUS) for one in results_of(estimated, estimated)]
    assert drive_results(chunk, straight(true), lost, lost).tracked == 0


def test_the_command_reports_the_lengths_of_a_path(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config, chunk = EstimatorConfig(), DriveChunk('road', 0, (620, 188), 3, 0)
    values = run_drive(chunk, config)
    assert values[0].tracked == 2
    assert values[0].scale_change == pytest.approx(1, abs=0.05)
    settings = {'frames': 3, 'hidden': 0, 'half': True, 'estimator': asdict(config)}
    with RecordStore(tmp_path, Drive, settings) as store:
        store.add(chunk.name, values)
    assert main(['lab', 'lengths', '--seeds', '0', '--frames', '3', '--hidden', '0', '--half',
                 '--workers', '1', '--output', str(tmp_path)]) == 0
    assert 'road 0' in capsys.readouterr().out
    estimated, = json.loads((tmp_path / 'lengths.json').read_text())
    assert estimated['scale_change'] == values[0].scale_change
    # The path is too short for it; JSON has no NaN.
    assert estimated['pose_square_25'] is None


@pytest.mark.parametrize(('arguments', 'message'), [
    (('--frames', '2'), '--frames is 2'), (('--hidden', '-1'), '--hidden is -1'),
    (('--workers', '0'), 'workers is 0')])
def test_user_errors_are_one_line_and_exit_code_2(
        tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...],
        message: str) -> None:
    assert main(['lab', 'lengths', *arguments, '--output', str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count('\n') == 1
