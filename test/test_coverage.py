"""Covariances compared with errors: the shares within bounds, and the command."""

from __future__ import annotations

from dataclasses import asdict
from importlib.util import module_from_spec, spec_from_file_location
import json
from pathlib import Path
from subprocess import CompletedProcess
from types import ModuleType
import warnings

import commands
from djet_ros.cli.options import write_json
from djet_ros.core.covariance import pose_difference, widened_to_span
from djet_ros.core.geometry import rotation_exp, sphere_tangents, unit
from djet_ros.core.types import Pose, RelativePose, Status
from djet_ros.lab.coverage import (
    Coverage,
    coverage_rows,
    draw_reliability,
    IN_A_ROW,
    LEVELS,
    normalised_square,
    share_with_bounds,
)
from djet_ros.lab.scenes import render_sequence
from djet_ros.odometry.result import camera_motion
from djet_ros.odometry.visual_odometry import VisualOdometry
from djet_ros.recordings.datasets import open_sequence
import numpy as np
import pytest
from scipy.stats import binom

pytestmark = pytest.mark.slow


def djet(*arguments: object) -> CompletedProcess[str]:
    return commands.djet('lab', 'coverage', *arguments)


def record(square: float = 1.0, failed: bool = False, claims: tuple[float, float] = (0.1, 1.0),
           status: Status = Status.OK, scene: str = 'road', stood: bool = False,
           rotation: float = 0.2) -> Coverage:
    return Coverage(scene, f'{scene}-1', 'alone', 4, 5, status.value, failed, rotation, 20.0,
                    *claims, square, 100, 90, stood)


def test_errors_drawn_from_the_covariance_lie_inside_as_often_as_claimed() -> None:
    rng = np.random.default_rng(0)
    R, t = rotation_exp(rng.normal(size=3)), unit(rng.normal(size=3))
    true_motion = camera_motion(RelativePose(Status.OK, R, t), 3.0)
    A = rng.normal(size=(5, 5)) * 1e-3
    squares = []
    for error in rng.multivariate_normal(np.zeros(5), A @ A.T, 2000):
        pose = RelativePose(Status.OK, rotation_exp(error[:3]) @ R,
                            unit(t + sphere_tangents(t) @ error[3:]), covariance_5=A @ A.T)
        squares.append(normalised_square(pose, true_motion))
    row, = coverage_rows([record(square) for square in squares])
    for level, (_, least, most) in zip(LEVELS, row.inside):
        # 95 % bounds, five times: wider by half is enough for all of them
        assert least - (most - least) / 4 < level < most + (most - least) / 4
    assert row.median == pytest.approx(1, abs=0.1)


def off_by(degrees: float, claimed: float = 0.05) -> float:
    """Square of a pose whose direction alone is off, with a claim in degrees of each axis."""
    true_motion = camera_motion(RelativePose(Status.OK, np.eye(3), np.array([0, 0, -1.0])))
    angle = np.radians(degrees)
    return normalised_square(RelativePose(
        Status.OK, np.eye(3), np.array([0.0, np.sin(angle), -np.cos(angle)]),
        np.eye(5) * np.radians(claimed)**2), true_motion)


@pytest.mark.parametrize('degrees', [0.05, 1.0, 45.0, 90.0, 135.0, 179.9, 180.0])
def test_the_error_of_a_direction_is_its_angle(degrees: float) -> None:
    assert off_by(degrees) == pytest.approx((degrees / 0.05)**2, rel=1e-6)


@pytest.mark.parametrize('seed', range(5))
def test_a_rival_that_is_true_is_inside_the_covariance_that_spans_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    R, t = rotation_exp(rng.normal(size=3)), unit(rng.normal(size=3))
    aside = rng.uniform(0.2, 0.5) * unit(np.cross(t, rng.normal(size=3)))
    true = Pose(rotation_exp(rng.normal(scale=0.01, size=3)) @ R, rotation_exp(aside) @ t)
    spanning = widened_to_span(1e-10 * np.eye(5), pose_difference(R, t, true), 0.3)
    square = normalised_square(RelativePose(Status.OK, R, t, spanning),
                               camera_motion(RelativePose(Status.OK, true.R, true.t), 2.0))
    assert square == pytest.approx(1 / 0.3, rel=1e-3)


def test_a_certain_direction_that_points_backwards_is_outside_its_ellipsoid() -> None:
    flipped = record(square=off_by(180.0), failed=True)
    row, = coverage_rows([flipped])
    assert flipped.overconfident and row.failed == 1
    assert all(share == 0 for share, _, _ in row.inside)


def test_the_bounds_of_a_share_contain_it_with_the_claimed_confidence() -> None:
    tries = 60
    for true in (0.02, 0.5, 0.95):
        hits = np.arange(tries + 1)
        bounds = [share_with_bounds(int(one), tries) for one in hits]
        held = [least <= true <= most for _, least, most in bounds]
        assert binom.pmf(hits, tries, true)[held].sum() >= 0.95


def test_only_a_wrong_pose_that_claims_to_be_exact_is_wrong_and_certain() -> None:
    assert record(failed=True).overconfident
    for humble in (record(failed=False), record(failed=True, claims=(0.5, 1.0)),
                   record(failed=True, claims=(0.1, 5.0)),
                   record(failed=True, status=Status.DEGENERATE),
                   record(failed=True, status=Status.NO_PARALLAX)):
        assert not humble.overconfident


def test_pairs_are_summed_up_by_scene() -> None:
    rows = coverage_rows([record(), record(scene='indoor', square=30.0, failed=True),
                          record(scene='indoor', status=Status.DEGENERATE),
                          record(scene='indoor', status=Status.NO_PARALLAX)])
    assert [(row.scene, row.pairs, row.told, row.given_up, row.needlessly, row.wrong_and_sure)
            for row in rows] == [('road', 1, 1, 0, 0, 0), ('indoor', 3, 1, 1, 1, 1)]
    assert rows[1].inside[-1][0] == 0


def test_a_motion_taken_for_a_standstill_is_counted() -> None:
    nan = float('nan')
    stood = record(square=nan, status=Status.NO_PARALLAX)
    moved = record(square=nan, status=Status.NO_PARALLAX, failed=True)
    row, = coverage_rows([record(failed=True), stood, moved,
                          record(square=nan, status=Status.DEGENERATE, failed=True)])
    assert (row.pairs, row.told, row.failed, row.untold, row.given_up) == (4, 1, 1, 1, 1)


def test_a_motion_invented_of_a_standstill_is_wrong_and_sure() -> None:
    nan = float('nan')
    invented = record(square=nan, stood=True)
    assert invented.overconfident
    humble = record(square=nan, stood=True, claims=(0.1, 50.0))
    held = record(square=nan, stood=True, status=Status.TWO_MOTIONS)
    row, = coverage_rows([invented, humble, held, record(square=nan, claims=(0.1, 50.0))])
    assert (row.told, row.failed, row.given_up, row.needlessly, row.wrong_and_sure) == (
        0, 1, 1, 0, 1)


@pytest.mark.parametrize('status', [Status.OK, Status.NO_PARALLAX])
@pytest.mark.parametrize('stood', [False, True])
def test_a_wrong_rotation_is_counted_where_no_direction_can_be_compared(
        status: Status, stood: bool) -> None:
    wrong, humble = (record(square=float('nan'), status=status, failed=True, stood=stood,
                            rotation=5.0, claims=(claim, 50.0)) for claim in (0.01, 4.0))
    row, = coverage_rows([wrong, humble])
    assert (row.failed, row.untold, row.wrong_and_sure) == (2, 0, 1)


def test_a_scene_without_motion_has_an_empty_plot_and_no_warning(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        draw_reliability([record(square=float('nan'), stood=True)], tmp_path / 'plot.png')
    assert (tmp_path / 'plot.png').stat().st_size > 0


def test_a_recorded_table_shows_unreported_errors_or_a_dash_if_they_were_not_counted(
        tmp_path: Path) -> None:
    nan = float('nan')
    rows = [asdict(row) for row in coverage_rows([
        record(), record(scene='rotation', square=nan, status=Status.NO_PARALLAX),
        record(scene='whip', square=nan, status=Status.NO_PARALLAX, failed=True)])]
    del rows[0]['untold']
    write_json(tmp_path / 'coverage.json', {'levels': LEVELS, 'rows': rows})
    road, whip = recorder().covered(tmp_path)
    assert road[:5] == ['road', '1', '1', '0', '–']
    assert whip == ['whip', '1', '0', '0', '1', '0 (0)', '–', '–', '–']


def recorder() -> ModuleType:
    path = Path(__file__).parents[1] / 'doc' / 'record.py'
    spec = spec_from_file_location('record', path)
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_command_renders_measures_and_resumes(tmp_path: Path) -> None:
    command = ('--scenes', 'road', '--seeds', '1', '--frames', 4, '--output', tmp_path,
               '--workers', 1)
    answer = djet(*command)
    assert answer.returncode == 0, answer.stderr
    alone, in_a_row = json.loads((tmp_path / 'coverage.json').read_text())['rows']
    assert (alone['start'], in_a_row['start']) == ('alone', 'in a row')
    assert alone['pairs'] == in_a_row['pairs'] == 3
    assert alone['told'] == 3 and alone['wrong_and_sure'] == 0
    assert (tmp_path / 'reliability.png').read_bytes().startswith(b'\x89PNG')
    records = (tmp_path / 'records.jsonl').read_bytes()
    image = next(tmp_path.glob('scenes/*/sequences/*/image_0/000001.png'))
    before = image.stat().st_mtime_ns
    assert djet(*command).stdout == answer.stdout
    assert (tmp_path / 'records.jsonl').read_bytes() == records
    assert image.stat().st_mtime_ns == before


def test_in_a_row_a_sequence_is_measured_as_the_odometry_sees_it(tmp_path: Path) -> None:
    # Longer than what is estimated together of independent pairs.
    render_sequence('moving_object', tmp_path / 'scene', 24, 0, (320, 96))
    source = next(tmp_path.glob('scene/sequences/*'))
    answer = djet(source, '--output', tmp_path / 'found', '--workers', 1)
    assert answer.returncode == 0, answer.stderr
    chunks = map(json.loads, (tmp_path / 'found' / 'records.jsonl').read_text().splitlines())
    found = [one for chunk in chunks for one in chunk.get('records', ())
             if one['start'] == IN_A_ROW]
    assert [one['current'] for one in found] == list(range(1, 24))
    odometry, sequence = VisualOdometry(), open_sequence(source)
    assert sequence is not None
    expected = [odometry.process(sequence.frame(index)).relative for index in range(24)][1:]
    assert [(one['status'], one['inliers']) for one in found] == [
        (pair.status.value, pair.inliers.sum()) for pair in expected if pair is not None]


@pytest.mark.parametrize(('arguments', 'message'), [
    ((), 'nothing to measure'), (('--scenes', 'moon'), "'moon'"),
    (('--scenes', 'road', '--seeds', 'x'), "'x'"),
    (('--scenes', 'road', '--seeds', '5-3'), "'5-3'"),
    (('--scenes', 'road', '--seeds', '1-2-3'), "'1-2-3'"),
    (('--scenes', 'road', '--seeds', '0-3,2'), "'0-3,2' is not a list of different seeds"),
    (('--scenes', 'road', '--seeds', '0-99999999999'), "'0-99999999999' has more than"),
    (('--scenes', 'road', '--seeds', '0-20000,20000-0'), "'0-20000,20000-0' has more than"),
    (('--scenes', 'road,blur,road'), "scene 'road' is given twice"),
    (('--scenes', 'road', '--frames', 1), '--frames is 1'), (('nowhere',), 'nowhere')])
def test_user_errors_are_one_line_and_exit_code_2(
        tmp_path: Path, arguments: tuple[object, ...], message: str) -> None:
    answer = djet(*arguments, '--output', tmp_path)
    assert answer.returncode == 2
    assert message in answer.stderr and answer.stderr.count('\n') == 1
