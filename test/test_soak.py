"""The soak records its documented figures, and its exit code reports growth."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
import json
from mmap import mmap, PAGESIZE
import multiprocessing
from pathlib import Path
from typing import Any

from commands import alone, djet
from covariances import check_messages
from djet_ros.config.sections import OdometryConfig
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.types import Status
from djet_ros.lab import soak as module
from djet_ros.lab.soak import resident_mb, soak
from djet_ros.odometry.visual_odometry import VisualOdometry
import numpy as np
import pytest

pytestmark = pytest.mark.slow

FRAMES = 100


def test_memory_and_latency_are_recorded_and_memory_does_not_grow(tmp_path: Path) -> None:
    output = tmp_path / 'deep' / 'soak.json'
    run = alone('lab', 'soak', '--output', output, '--frames', FRAMES)
    assert run.returncode == 0, run.stderr
    assert 'passed' in run.stdout
    figures = json.loads(output.read_text())
    assert figures['held'] is True
    assert figures['growth_mb'] < 10
    assert figures['memory_mb'] > 50
    assert 0 < figures['latency_ms']['p50_ms'] <= figures['latency_ms']['p99_ms']
    assert [stretch['frames'] for stretch in figures['stretches']] == list(
        range(FRAMES // 20, FRAMES + 1, FRAMES // 20))
    # Small things do not pile up either: one kept result alone would be dozens for each frame.
    early, late = (figures['stretches'][i]['python_blocks'] for i in (4, -1))
    assert late - early < 5 * FRAMES
    assert sum(figures['status'].values()) == FRAMES
    assert {Status.OK, Status.TOO_FEW_MATCHES} <= figures['status'].keys()
    assert output.with_suffix('.png').read_bytes().startswith(b'\x89PNG')


def test_no_covariance_of_a_soak_is_zero_infinite_or_absurd(
        monkeypatch: pytest.MonkeyPatch) -> None:
    # With all that happens in a soak: darkness, a gap, and stamps that step back, here sooner.
    monkeypatch.setattr(module, '_BACK', 230)
    odometry = VisualOdometry(EstimatorConfig(max_features=module.FEATURES), OdometryConfig())
    statuses = set()
    for frame in module._drive(250):
        result = odometry.process(frame)
        statuses.add(result.status)
        check_messages(result)
    assert {Status.OK, Status.FIRST_FRAME, Status.TIME_JUMP, Status.TOO_FEW_MATCHES} <= statuses


class Leaking(VisualOdometry):
    """An odometry that keeps a megabyte of each frame."""

    kept: list[object]

    def process(self, frame):
        self.__dict__.setdefault('kept', []).append(np.ones(1 << 17))
        return super().process(frame)


def soak_leaking() -> dict[str, Any]:
    module.VisualOdometry, module.FEATURES = Leaking, 100
    return soak(100, most_growth_mb=10.0)


def test_a_leak_is_found() -> None:
    # In a process of its own: what earlier tests have freed here would be taken first, unseen.
    with ProcessPoolExecutor(1, multiprocessing.get_context('spawn')) as fresh:
        figures = fresh.submit(soak_leaking).result(timeout=300)
    assert figures['held'] is False
    assert figures['growth_mb'] == pytest.approx(0.8 * 100 * 1.05, rel=0.3)


def test_resident_memory_is_that_of_the_process() -> None:
    before = resident_mb()
    # Of the system itself: the process may have room for an array that it was given before.
    with mmap(-1, 10 << 23) as block:
        for page in range(0, len(block), PAGESIZE):
            block[page] = 1
        assert resident_mb() - before == pytest.approx(len(block) / 1e6, rel=0.1)


@pytest.mark.parametrize(('arguments', 'message'), [
    (('--frames', 3), '--frames is 3; it must be at least 100'),
    ((), 'exists already; choose another name')])
def test_user_errors_are_one_line_and_exit_code_2(
        tmp_path: Path, arguments: tuple[object, ...], message: str) -> None:
    output = tmp_path / 'soak.json'
    if not arguments:
        output.write_text('{}')
    run = djet('lab', 'soak', '--output', output, *arguments)
    assert run.returncode == 2
    assert message in run.stderr
    assert run.stderr.count('\n') == 1
