"""The figures of the pages: measured by commands, kept as they come, and shown as they are."""

from __future__ import annotations

from importlib.util import module_from_spec, spec_from_file_location
import json
import os
from pathlib import Path
import subprocess
import sys
from types import ModuleType
from typing import Any

from djet_ros.core.types import Status
from djet_ros.lab.pairs import PairRecord
from djet_ros.lab.sequences import open_datasets, Selection
from djet_ros.recordings.kitti import KittiSequence
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
import yaml

ROOT = Path(__file__).parents[1]
BOUNDS = ROOT / 'doc' / 'bounds.yaml'
SCENE = 'standstill'


def script(name: str) -> ModuleType:
    """Import a script of the pages."""
    spec = spec_from_file_location(name, ROOT / 'doc' / f'{name}.py')
    sys.modules[name] = module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


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


@pytest.mark.slow
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


@pytest.mark.slow
def test_what_was_measured_is_taken_over_and_other_settings_begin_anew(output, tmp_path):
    begun = tmp_path / 'results.json'
    begun.write_text(output.read_text())
    assert measure(begun) == []
    assert begun.read_text() == output.read_text()
    assert measure(begun, '--frames', '4') == [SCENE]
    assert json.loads(begun.read_text())['settings']['frames'] == 4


def test_pairs_that_each_turn_too_far_drift_by_that_over_a_long_way(small_kitti, tmp_path):
    folder, turned = small_kitti(frames=250), Rotation.from_rotvec([0, 1e-4, 0])
    truth = KittiSequence(folder).poses
    records = [record(i, turned * Rotation.from_matrix(motion[:3, :3]), motion[:3, 3])
               for i, motion in enumerate(np.linalg.inv(truth[:-1]) @ truth[1:])]
    datasets = open_datasets([folder], Selection(), tmp_path)
    found = script('measure').drifts(datasets, records)
    # Half a metre to a frame, and segments that begin at every tenth.
    assert (found['drift']['segments'], found['drift']['longest']) == (5, 100)
    assert found['drift']['rotation_deg_per_100m'] == pytest.approx(np.degrees(0.02), rel=0.01)
    # A step of 0.5 m after k turns of 1e-4 lies 5e-5 k m off: 1 m after 200 of them.
    assert found['drift']['translation_percent'] == pytest.approx(1.0, rel=0.02)
    assert script('measure').drifts(datasets, records[:190]) == {}
    page = script('pages').drift({'parts': {'drive kitti 07': {
        'frames': 250, 'length': 125.0, 'chained': [{'method': 'rpe', **found}],
        'replays': {}}}})
    figures = ' | '.join(f"{found['drift'][name]:.3f}"
                         for name in ('translation_percent', 'rotation_deg_per_100m'))
    assert f'| KITTI 07 | RP-E | {figures} |' in page


def record(pair: int, rotation: Rotation, way: np.ndarray) -> PairRecord:
    """Give what a method made of a pair of sequence 07."""
    return PairRecord('07', pair, pair, pair + 1, 'rpe', 'best', '', Status.OK.value, 99, 90,
                      False, 0.1, 0.1, 20.0, tuple(rotation.as_rotvec().tolist()),
                      tuple((way / np.linalg.norm(way)).tolist()), 50.0)
