"""The figures of the pages: measured by commands, kept as they come, and shown as they are."""

from __future__ import annotations

import json
import os
from pathlib import Path
import subprocess
import sys
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parents[1]
BOUNDS = ROOT / 'doc' / 'bounds.yaml'
SCENE = 'standstill'


def measure(output: Path, *words: str) -> list[str]:
    """Measure one scene; gives the parts that were measured and not taken over."""
    done = subprocess.run(
        [sys.executable, ROOT / 'doc' / 'measure.py', '--only', SCENE, '--frames', '3', '--seeds',
         '0', '--workers', '1', '--output', output, *words], capture_output=True, text=True,
        check=False, env={**os.environ, 'PYTHONPATH': str(ROOT), 'DJET_DATA': ''})
    assert done.returncode == 0, done.stderr
    return [line.partition(':')[0] for line in done.stdout.splitlines()]


@pytest.fixture(scope='module')
def output(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp('results') / 'results.json'
    assert measure(path) == [SCENE]
    return path


@pytest.fixture
def part(output: Path) -> Any:
    return json.loads(output.read_text())['parts'][SCENE]


def test_every_method_is_measured_on_every_pair(part):
    methods = {one['method'] for one in part['methods']}
    assert {'djet', 'rpe', 'pjet', 'five_point', 'opencv_ransac'} <= methods
    for one in part['methods']:
        assert one['pairs'] == 2
        assert one['sure'] <= one['failed'] <= one['pairs']
        assert one['ms'] > 0
        assert len(one['by_seed']) == 1


def test_standing_still_is_no_failure_and_has_no_direction(part):
    assert part['odometry']['failed'] == 0
    assert part['odometry']['direction']['mean'] is None
    bound, = (one['rotation'] for one in yaml.safe_load(BOUNDS.read_text())['hard_images']
              if one['images'] == SCENE)
    assert part['odometry']['rotation']['max'] < bound


def test_what_was_measured_is_taken_over_and_other_settings_begin_anew(output, tmp_path):
    begun = tmp_path / 'results.json'
    begun.write_text(output.read_text())
    assert measure(begun) == []
    assert begun.read_text() == output.read_text()
    assert measure(begun, '--frames', '4') == [SCENE]
    assert json.loads(begun.read_text())['settings']['frames'] == 4
