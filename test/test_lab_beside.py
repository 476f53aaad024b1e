"""The command that shows what a gyro and masks are good for, and its scenes."""

from __future__ import annotations

from itertools import pairwise
import json
from pathlib import Path

from djet_ros.cli.main import main
from djet_ros.core.geometry import rotation_angle
from djet_ros.lab.beside import GYRO, is_wrong, MASK, Moment, NOTHING, trial_rows
from djet_ros.lab.scenes import make_scene
import numpy as np
import pytest


def moment(frame: int = 1, aid: str = GYRO, seed: int = 0, dark: bool = False,
           tracked: bool = True, failed: bool = False, off: float = 0.1, bias: float = 0.02
           ) -> Moment:
    return Moment('street', seed, aid, frame, 'OK', dark, tracked, False, failed,
                  off if tracked else np.nan, np.nan, off if dark else np.nan,
                  10 * off, bias)


def test_every_pair_of_the_whip_turns_by_fifteen_degrees_and_goes_on() -> None:
    poses = make_scene('whip', 3).trajectory(30)
    turns = [np.degrees(rotation_angle(a[:3, :3], b[:3, :3])) for a, b in pairwise(poses)]
    ways = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert min(turns) > 14 and max(turns) < 16
    assert ways.min() > 0.01


def test_traffic_passes_before_a_camera_that_stands() -> None:
    scene = make_scene('traffic', 0, (248, 76))
    assert np.allclose(scene.trajectory(20), np.eye(4), atol=1e-12)
    depths = np.array([scene.depth(np.eye(4), i) for i in range(0, 60, 4)])
    farthest = depths.max(0)
    hidden = (depths < farthest - 1).mean((1, 2))
    assert hidden.max() > 0.5  # large bodies
    assert hidden.min() < hidden.max() / 2  # which come and go


def test_moments_are_summed_up_and_the_dark_is_counted_by_itself() -> None:
    row, = trial_rows([moment(1), moment(2, off=0.3), moment(3, tracked=False, failed=True),
                       moment(4, failed=True, off=5.0), moment(5, dark=True, off=0.4),
                       moment(1, seed=1, bias=0.5)])
    assert (row.pairs, row.failed, row.wrong, row.stood) == (5, 2, 1, 0)
    assert row.rotation_deg == pytest.approx((5.5 / 4, 5.0))
    assert np.isnan(row.direction_deg).all()
    assert (row.dark_off_deg, row.dark_surprise) == (0.4, 4.0)
    assert row.bias_off == (0.02, 0.5)
    assert not is_wrong(moment(tracked=False, failed=True))


def test_the_command_runs_each_trial_with_all_aids_and_takes_up_where_it_ended(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ['lab', 'beside', '--trials', 'lorry', '--seeds', '0', '--frames', '4',
               '--workers', '1', '--output', str(tmp_path)]
    assert main(command) == 0
    rows = json.loads((tmp_path / 'beside.json').read_text())['rows']
    assert [(row['aid'], row['pairs']) for row in rows] == [(NOTHING, 3), (GYRO, 3), (MASK, 3)]
    _, with_gyro, masked = rows
    assert masked['failed'] == 0 and masked['direction_deg'][1] < 2
    # Whatever its bias may be, nobody takes the lorry for the world.
    assert with_gyro['wrong'] == 0 and with_gyro['bias_off'][0] < 1.05
    said, records = capsys.readouterr().out, (tmp_path / 'records.jsonl').read_bytes()
    assert main(command) == 0
    assert capsys.readouterr().out == said
    assert (tmp_path / 'records.jsonl').read_bytes() == records


@pytest.mark.parametrize(('arguments', 'said'), [
    (('--trials', 'moon'), "'moon'"), (('--frames', '2'), '--frames is 2'),
    (('--workers', '0'), '--workers 0')])
def test_what_can_be_mended_is_one_line_and_exit_code_2(
        tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...],
        said: str) -> None:
    assert main(['lab', 'beside', *arguments, '--output', str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count('\n') == 1
