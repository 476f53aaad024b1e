"""Triangles of rotations: their closure error, its claimed size, and the command."""

from __future__ import annotations

import json
from pathlib import Path
from subprocess import CompletedProcess

import commands
from djet_ros.core.types import RelativePose, Status
from djet_ros.lab.closure import closure_rotation, closures, summary
from djet_ros.lab.scenes.sequence import render_sequence
from djet_ros.recordings.datasets import open_sequence
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytestmark = pytest.mark.slow

FRAMES = 6


@pytest.fixture(scope='module')
def road(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render_sequence('road', tmp_path_factory.mktemp('road'), FRAMES, size=(620, 188))


def djet(*arguments: object) -> CompletedProcess[str]:
    return commands.djet('lab', 'closure', *arguments)


def motion(R: Rotation, sigma: float) -> RelativePose:
    return RelativePose(Status.OK, R.as_matrix(), covariance_5=sigma**2 * np.eye(5))


def test_the_closure_error_is_that_of_three_pairs_and_as_large_as_claimed() -> None:
    rng = np.random.default_rng(0)
    squares = []
    for _ in range(300):
        before, after = Rotation.random(2, random_state=rng)
        sigmas = rng.uniform(1e-4, 1e-3, 3)
        motions = [motion(Rotation.from_rotvec(rng.normal(0, sigma, 3)) * true, sigma)
                   for true, sigma in zip((before, after, after * before), sigmas)]
        remains, covariance = closure_rotation(*motions)
        squares.append(remains @ np.linalg.solve(covariance, remains))
    # 300 chi-squared of 3 degrees of freedom: within 4.5 of their standard deviations
    assert np.mean(squares) == pytest.approx(3, abs=4.5 * np.sqrt(6 / 300))


def test_consistent_rotations_have_no_closure_error() -> None:
    a, b = Rotation.from_euler('xyz', [[1, 2, 3], [-2, 1, 0.5]], degrees=True)
    assert np.allclose(closure_rotation(*(motion(R, 1e-3) for R in (a, b, b * a)))[0], 0)


def test_the_closure_error_on_a_street_is_thousandths_of_a_degree_as_claimed(road: Path) -> None:
    sequence = open_sequence(road)
    one = summary(closures(sequence, ['djet'], FRAMES)['djet'])
    assert one['triangles'] == FRAMES - 2 and one['without'] == 0
    # Twice what was measured. The pair over two frames errs more than those of neighbours.
    assert 0 < one['error_median_deg'] < 0.0045
    assert 0 < one['median_deg'] < 0.0105
    assert one['median_deg'] < one['claimed_median_deg']


def test_the_command_writes_triangles_and_a_plot(road: Path, tmp_path: Path) -> None:
    output = tmp_path / 'deep' / 'closure.json'
    answer = djet(road, '--output', output, '--methods', 'djet,rpe', '--frames', 4)
    assert answer.returncode == 0, answer.stderr
    written = json.loads(output.read_text())
    assert written['source'] == 'road'  # not KITTI, whose layout a rendered sequence has
    assert list(written['summary']) == ['djet', 'rpe']
    first, second = written['triangles']['rpe']
    assert (first['first'], second['first']) == (0, 1)
    assert first['angle'] > 0
    assert output.with_suffix('.png').read_bytes().startswith(b'\x89PNG')
    assert 'D-JET' in answer.stdout and 'RP-E' in answer.stdout


@pytest.mark.parametrize(('arguments', 'message'), [
    (('--frames', 2), '--frames is 2'), (('--methods', 'djet,poselib'), "'poselib'"),
    (('--output', '.'), 'is a folder')])
def test_user_errors_are_one_line_and_exit_code_2(
        road: Path, tmp_path: Path, arguments: tuple[object, ...], message: str) -> None:
    answer = djet(road, '--output', tmp_path / 'closure.json', *arguments)
    assert answer.returncode == 2
    assert message in answer.stderr and answer.stderr.count('\n') == 1


def test_two_frames_are_no_triangle(tmp_path: Path) -> None:
    pair = render_sequence('road', tmp_path, 2, size=(320, 96))
    answer = djet(pair, '--output', tmp_path / 'closure.json')
    assert answer.returncode == 2
    assert 'too few for a triplet' in answer.stderr
