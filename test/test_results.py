"""The figures of the pages: how they are measured, stored and shown."""

from __future__ import annotations

from dataclasses import replace
from importlib.util import module_from_spec, spec_from_file_location
import json
import math
import os
from pathlib import Path
import subprocess
import sys
from types import ModuleType
from typing import Any

from djet_ros.core.types import Status
from djet_ros.errors import DjetError
from djet_ros.lab.pairs import PairRecord
from djet_ros.lab.scenes import render_sequence
from djet_ros.lab.sequences import open_datasets, Selection
from djet_ros.lab.summary import common_errors
from djet_ros.recordings.kitti import KittiSequence
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
import yaml

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
BOUNDS = ROOT / 'doc' / 'bounds.yaml'
SCENE = 'standstill'


def script(name: str) -> ModuleType:
    """Import a script of the pages."""
    spec = spec_from_file_location(name, ROOT / 'doc' / f'{name}.py')
    sys.modules[name] = module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def measure(output: Path, *arguments: str) -> list[str]:
    """Measure one scene; returns the parts that were newly measured."""
    done = subprocess.run(
        [sys.executable, ROOT / 'doc' / 'measure.py', '--only', SCENE, '--frames', '3', '--seeds',
         '0', '--workers', '1', '--output', output, *arguments], capture_output=True, text=True,
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
        assert one['rotation']['told'] <= one['pairs']
        assert one['hamming'] > 0
        assert one['ms'] > 0
        assert len(one['by_seed']) == 1


def test_standstill_is_no_failure_and_has_no_direction(part):
    assert part['odometry']['failed'] == 0
    assert part['odometry']['direction']['mean'] is None
    bound, = (one['rotation'] for one in yaml.safe_load(BOUNDS.read_text())['hard_images']
              if one['images'] == SCENE)
    assert part['odometry']['rotation']['max'] < bound


def test_measured_parts_are_reused_and_not_mixed_with_other_settings(output, tmp_path):
    begun = tmp_path / 'results.json'
    begun.write_text(output.read_text())
    assert measure(begun) == []
    assert begun.read_text() == output.read_text()
    with pytest.raises(AssertionError, match=r'holds results of other settings \(frames\)'):
        measure(begun, '--frames', '4')
    assert begun.read_text() == output.read_text()


def test_only_adds_a_part_to_complete_results_and_a_full_run_starts_empty(tmp_path):
    module, path = script('measure'), tmp_path / 'results.json'
    settings = {'frames': 7, 'seeds': [0], 'real_frames': None, 'code': 'abc'}
    whole = {**module.previous_results(path, settings), 'complete': True,
             'parts': {'road': {}, 'loop': {}}}
    path.write_text(json.dumps(whole))
    assert module.previous_results(path, settings, keep=True) == whole
    assert module.previous_results(path, settings)['parts'] == {}
    with pytest.raises(DjetError, match=r'other settings \(code\)') as raised:
        module.previous_results(path, {**settings, 'code': 'of yesterday'}, keep=True)
    assert '\n' not in str(raised.value)
    path.write_text(json.dumps({**whole, 'complete': False}))
    assert list(module.previous_results(path, settings)['parts']) == ['road', 'loop']
    assert module.previous_results(path, {**settings, 'frames': 8})['parts'] == {}


def test_common_errors_are_of_pairs_that_both_estimated_in_the_order_of_the_first():
    first, second = ([replace(record(i, Rotation.identity(), np.array([0, 0, 1.0])),
                              rotation_error_deg=rotation, translation_error_deg=direction)
                      for i, rotation, direction in rows] for rows in (
        [(3, 0.3, 3.0), (1, 0.1, math.nan), (2, 0.2, 2.0), (9, 0.9, 9.0)],
        [(1, 1.1, 11.0), (2, 1.2, 12.0), (3, 1.3, math.inf), (4, 1.4, 14.0)]))
    found = common_errors(first, second)
    assert found['rotation'].tolist() == [[0.3, 1.3], [0.1, 1.1], [0.2, 1.2]]
    assert found['direction'].tolist() == [[2.0, 12.0]]
    other = [replace(one, sequence='another') for one in second]
    assert [errors.shape for errors in common_errors(first, other).values()] == [(0, 2), (0, 2)]


def test_ratios_are_of_pairs_that_both_estimated():
    errors = {'djet': (0.0002, 0.0004, 9.0), 'rpe': (0.0010, 0.0030, math.nan)}
    records = [replace(record(i, Rotation.identity(), np.array([0, 0, 1.0])), method=method,
                       rotation_error_deg=error, translation_error_deg=math.nan)
               for method, own in errors.items() for i, error in enumerate(own)]
    found = script('measure').against(records, 'rpe', 'best')
    assert found['rotation'] == {'told': 2, 'mean': [0.0003, 0.002], 'median': [0.0003, 0.002]}
    assert found['direction']['mean'] == [None, None]
    pages = script('pages')
    part = {'methods': [{'method': method, 'preset': 'best', 'failed': 0} for method in errors],
            'against': [found]}
    # Errors below EQUAL count in the means.
    assert pages.compared_row('road', part, 'rpe', 'best') == (
        'road', 'best', '2 / 0', '0.15', '0.15', '–', '–', '0 / 0')
    del part['against']
    assert pages.compared_row('road', part, 'rpe', 'best')[2:7] == ('–',) * 5


@pytest.mark.parametrize(('ours', 'theirs', 'text'), [
    (0.002, 0.001, '**2.00**'), (0.0101, 0.01, '**1.01**'), (0.010001, 0.01, '1.00'),
    (0.0002, 0.0009, '–'), (None, None, '–'), (0.5, 0.0, '**> 100**')])
def test_a_ratio_is_bold_if_it_is_above_one_as_printed(ours, theirs, text):
    assert script('pages').ratio(ours, theirs) == text


def test_table_1_has_the_paper_next_to_the_preset_paper():
    def own(method: str) -> dict[str, Any]:
        return {'method': method, 'preset': 'paper', 'pairs': 60, 'hamming': 21.0,
                'rotation': {'mean': 0.0917}, 'direction': {'mean': 1.25}}
    page = script('pages').table_1({'parts': {'kitti 00': {
        'methods': [own(method) for method in ('djet', 'rpe', 'five_point')]}}})
    assert ('| KITTI 00 | here, 60 pairs | 0.092 | 0.092 | – | 0.092 | 1.250 | 1.250 | – | 1.250 '
            '| 21.00 | 21.00 | 21.00 |') in page
    assert ('| KITTI 00 | the paper | 0.094 | 0.074 | 0.096 | 0.119 | 0.075 | 0.070 | 6.749 '
            '| 0.044 | 19.42 | 20.46 | 20.98 |') in page
    assert '0.0917 / 1.250 here and 0.119 / 0.044 there' in ' '.join(page.split())


def test_few_triplets_have_no_95th_percentile():
    def page(triangles: int) -> str:
        figures = dict.fromkeys(('median_deg', 'claimed_median_deg', 'normalised_square_mean',
                                 'error_median_deg'), 0.5)
        return script('pages').closure({'parts': {'road': {'methods': [], 'closure': {'djet': {
            **figures, 'triangles': triangles, 'without': 0, 'p95_deg': 0.75}}}}})
    assert '| 0.500 | – |' in page(19)
    assert '| 0.500 | 0.750 |' in page(20)


def test_closure_is_over_all_seeds(tmp_path):
    datasets = open_datasets([render_sequence('road', tmp_path / str(seed), 3, seed, (480, 160))
                              for seed in (0, 1)], Selection(), tmp_path)
    for one in script('measure').closure_figures(datasets).values():
        assert one['triangles'] + one['without'] == 2


def test_a_constant_rotation_error_per_pair_gives_the_expected_drift(small_kitti, tmp_path):
    folder, turned = small_kitti(frames=250), Rotation.from_rotvec([0, 1e-4, 0])
    truth = KittiSequence(folder).poses
    records = [record(i, turned * Rotation.from_matrix(motion[:3, :3]), motion[:3, 3])
               for i, motion in enumerate(np.linalg.inv(truth[:-1]) @ truth[1:])]
    datasets = open_datasets([folder], Selection(), tmp_path)
    found = script('measure').drifts(datasets, records)
    # 0.5 m per frame; segments start at every tenth frame.
    assert (found['drift']['segments'], found['drift']['longest']) == (5, 100)
    assert found['drift']['rotation_deg_per_100m'] == pytest.approx(np.degrees(0.02), rel=0.01)
    # A step of 0.5 m after k rotations of 1e-4 is 5e-5 k m off: 1 m after 200 steps.
    assert found['drift']['translation_percent'] == pytest.approx(1.0, rel=0.02)
    assert script('measure').drifts(datasets, records[:190]) == {}
    page = script('pages').drift({'parts': {'drive kitti 07': {
        'frames': 250, 'length': 125.0, 'chained': [{'method': 'rpe', **found}],
        'replays': {}}}})
    figures = ' | '.join(f"{found['drift'][name]:.3f}"
                         for name in ('translation_percent', 'rotation_deg_per_100m'))
    assert f'| KITTI 07 | RP-E | {figures} |' in page


def test_a_drive_without_significant_distortion_has_no_corrected_replays(small_kitti):
    assert script('measure').lens(small_kitti(frames=3)) == {}


def test_the_page_compares_the_estimated_distortion_with_others():
    def some(off: float) -> list[dict[str, dict[str, float]]]:
        return [{'positions': {'rmse_m': value, 'scale_change': 1 + sign * value},
                 'drift': {'translation_percent': 0.5, 'rotation_deg_per_100m': 0.25}}
                for value, sign in ((off, 1), (off / 2, -1), (2 * off, -1))]
    part = {'frames': 9, 'length': 5.0, 'chained': [], 'replays': {'images alone': some(0.4)},
            'lens': {'k1': 0.02, 'sigma': 0.005, 'replays': {'images alone': some(0.1)},
                     'beside': {'-2': some(0.3), '1': some(0.2)}}}
    results = {'parts': {'drive kitti 07': part}}
    # Medians, and the worst: the scale farthest from one.
    figures = {0.4: '0.40 (0.80) | 0.800 (0.200)', 0.3: '0.30 (0.60) | 0.850 (0.400)',
               0.1: '0.10 (0.20) | 0.950 (0.800)', 0.2: '0.20 (0.40) | 0.900 (0.600)'}
    drift = ' | 0.50 (0.50) | 0.250 (0.250) |'
    rows = [line for line in script('pages').lens(results).splitlines() if drift in line]
    assert rows == [f'| {k1} | {figures[off]}{drift}' for k1, off in (
        ('0.0000', 0.4), ('0.0100', 0.3), ('0.0200', 0.1), ('0.0250', 0.2))]
    assert f'| KITTI 07, images alone, distortion corrected | {figures[0.1]}{drift}' in script(
        'pages').drift(results)


def record(pair: int, rotation: Rotation, translation: np.ndarray) -> PairRecord:
    """Return the record of a method for a pair of sequence 07."""
    return PairRecord('07', pair, pair, pair + 1, 'rpe', 'best', '', Status.OK.value, 99, 90,
                      False, 0.1, 0.1, 20.0, tuple(rotation.as_rotvec().tolist()),
                      tuple((translation / np.linalg.norm(translation)).tolist()), 50.0)
