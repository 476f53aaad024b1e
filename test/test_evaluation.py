"""``djet lab evaluate`` and ``djet lab ablate`` on rendered frames, with real workers."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
import csv
from dataclasses import replace
import json
import math
import os
from pathlib import Path
import re
import shutil
import signal
import subprocess
import sys
from time import monotonic, sleep

import commands
import cv2
from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.estimator_config import EstimatorConfig, preset
from djet_ros.core.masks import blocked
from djet_ros.core.types import Status
from djet_ros.errors import DjetError
from djet_ros.lab.ablation import ablation_methods
from djet_ros.lab.chains import CHAINS
from djet_ros.lab.evo import trajectory_metrics
from djet_ros.lab.integration import estimated_trajectory, true_trajectory
from djet_ros.lab.methods import default_methods, Method, TITLES
from djet_ros.lab.pairs import evaluate_chunk, has_failed, PairChunk, PairRecord
from djet_ros.lab.scenes import render_sequence
from djet_ros.lab.sequences import Dataset, open_datasets, readable_frames, Selection
from djet_ros.lab.store import RecordStore
from djet_ros.lab.summary import table_rows
from djet_ros.lab.tables import results_table
from djet_ros.odometry.camera import Camera
from djet_ros.recordings.bag_writers import write_kitti_bag
from djet_ros.recordings.frame_sequence import FrameSequence, ImageFiles, Intrinsics
from djet_ros.recordings.kitti import KittiSequence
from djet_ros.recordings.trajectories import read_tum
from djet_ros.replay.drift import drift
import numpy as np
import pytest

pytestmark = pytest.mark.slow

COLUMNS = ['sequence', 'method', 'preset', 'pairs', 'failures', 'rotation_told',
           'rotation_mean_deg', 'rotation_median_deg', 'rotation_p95_deg', 'translation_told',
           'translation_mean_deg', 'translation_median_deg', 'translation_p95_deg',
           'hamming_mean', 'ms_per_pair']
FRAMES = 8
# Enough work for a chunk to be interrupted.
RUN = ('--methods', 'djet,rpe', '--presets', 'paper')


@pytest.fixture(scope='module')
def road(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a rendered street: 7 pairs, which are two chunks."""
    return render_sequence('road', tmp_path_factory.mktemp('road'), FRAMES, size=(480, 160))


@pytest.fixture(scope='module')
def evaluated(road: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the results folder of all methods and both presets, by one worker."""
    folder = tmp_path_factory.mktemp('evaluated') / 'results'
    answer = djet('evaluate', road, '--output', folder, '--workers', '1')
    assert answer.returncode == 0, answer.stderr
    return folder


@pytest.fixture(scope='module')
def short(road: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the results folder of what RUN asks for, by one worker."""
    folder = tmp_path_factory.mktemp('short') / 'results'
    answer = djet('evaluate', road, '--output', folder, '--workers', '1', *RUN)
    assert answer.returncode == 0, answer.stderr
    return folder


def djet(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run the command to its end; its workers are processes of their own."""
    return commands.djet('lab', *arguments)


def djet_alone(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run the command in a process of its own: a client of Dask leaves threads behind."""
    return commands.alone('lab', *arguments)


def rows(path: Path) -> list[dict[str, str]]:
    """Rows of a CSV file."""
    return list(csv.DictReader(path.read_text().splitlines()))


def without_times(path: Path) -> list[dict[str, str]]:
    """Rows of table1.csv but for the one column that differs from run to run."""
    return [{name: value for name, value in row.items() if name != 'ms_per_pair'}
            for row in rows(path)]


# Tables and records

def test_the_table_has_a_row_for_each_method_and_preset(evaluated):
    table = rows(evaluated / 'table1.csv')
    assert list(table[0]) == COLUMNS
    assert [(row['sequence'], row['preset'], row['method']) for row in table] == [
        ('road', preset, method) for preset in ('best', 'paper') for method in default_methods()]
    assert all(int(row['pairs']) == FRAMES - 1 for row in table)


def test_the_preset_best_finds_exact_motion_to_a_hundredth_of_a_degree(evaluated):
    best, paper = ({row['method']: row for row in rows(evaluated / 'table1.csv')
                    if row['preset'] == preset} for preset in ('best', 'paper'))
    for method in ('djet', 'rpe', 'pjet'):
        # Twice what was measured, of the worst of them.
        assert float(best[method]['rotation_median_deg']) < 0.012
        assert float(best[method]['translation_median_deg']) < 0.2
    # Descriptors at whole pixels are what D-JET minimises, as the paper has it.
    assert float(paper['djet']['hamming_mean']) < float(paper['rpe']['hamming_mean'])


def test_all_methods_but_whole_chains_are_given_the_same_matches_of_a_preset(evaluated):
    records = rows(evaluated / 'pairs.csv')
    assert len(records) == 2 * len(default_methods()) * (FRAMES - 1)
    given = {(row['pair'], row['preset'], row['matches']) for row in records
             if row['method'] not in CHAINS}
    assert len(given) == 2 * (FRAMES - 1)


def test_records_hold_the_motion_from_which_the_errors_came(road, evaluated):
    truth = KittiSequence(road).poses
    for row in rows(evaluated / 'pairs.csv'):
        before, after = truth[int(row['previous'])], truth[int(row['current'])]
        motion = np.linalg.inv(before) @ after
        R, _ = cv2.Rodrigues(np.array([float(row[axis]) for axis in ('rx', 'ry', 'rz')]))
        angle = np.degrees(np.linalg.norm(cv2.Rodrigues(motion[:3, :3].T @ R)[0]))
        assert angle == pytest.approx(float(row['rotation_error_deg']), abs=1e-5)


def test_tables_in_other_markups_hold_the_same_figures(evaluated):
    mean = f"{float(rows(evaluated / 'table1.csv')[0]['rotation_mean_deg']):.3f}"
    for name in ('table1.md', 'table1.tex', 'index.html'):
        assert mean in (evaluated / name).read_text()


def test_a_rendered_sequence_is_not_compared_with_the_paper(evaluated):
    assert 'the paper' not in (evaluated / 'table1.md').read_text()


def test_kitti_sequences_are_compared_with_the_paper(kitti, tmp_path):
    answer = djet('evaluate', kitti / 'sequences' / '06', '--end', '3', '--methods', 'djet,rpe',
                  '--presets', 'best', '--workers', '1', '--output', tmp_path)
    assert answer.returncode == 0, answer.stderr
    assert '| *06* | *the paper* | *RP-E* |  | *0.049* |' in (tmp_path / 'table1.md').read_text()
    # The file for programs holds what was measured, and nothing else.
    assert {row['preset'] for row in rows(tmp_path / 'table1.csv')} == {'best'}


def test_trajectories_are_plotted_with_the_ground_truth(road, evaluated):
    folder = evaluated / 'trajectories' / 'road'
    stamps, truth = read_tum(folder / 'ground_truth.tum')
    assert np.allclose(truth, KittiSequence(road).poses, atol=1e-9)
    for name in ('best', 'paper'):
        for method in default_methods():
            its_stamps, poses = read_tum(folder / f'{method}_{name}.tum')
            assert np.array_equal(its_stamps, stamps)
            lengths = [np.linalg.norm(np.diff(way[:, :3, 3], axis=0), axis=1)
                       for way in (poses, truth)]
            assert np.allclose(*lengths, atol=1e-6) or method != 'djet'


def test_perfect_motions_make_the_true_trajectory(road, tmp_path):
    source, = open_datasets([road], Selection(), tmp_path)
    truth = KittiSequence(road).poses
    records = [record(pair=i, rotation=tuple(cv2.Rodrigues(motion[:3, :3])[0].ravel()),
                      translation=tuple(motion[:3, 3] / np.linalg.norm(motion[:3, 3])))
               for i, motion in enumerate(np.linalg.inv(truth[:-1]) @ truth[1:])]
    assert np.allclose(estimated_trajectory(source, records).poses, truth, atol=1e-6)
    # Of a record with a hole, the longer part counts.
    assert len(true_trajectory(source, records[:2] + records[3:]).poses) == 5


def test_drift_is_reported_for_paths_over_100_metres(road, tmp_path):
    far = tmp_path / 'sequences' / 'far'
    shutil.copytree(road, far)
    (tmp_path / 'poses').mkdir()
    write_stretched(KittiSequence(road).poses, 30, tmp_path / 'poses' / 'far.txt')
    output = tmp_path / 'results'
    answer = djet('evaluate', road, far, '--methods', 'djet,five_point', '--presets', 'best',
                  '--workers', '1', '--output', output)
    assert answer.returncode == 0, answer.stderr
    found = {row['method']: row for row in rows(output / 'drift.csv')}
    # Both have the name of the scene, and the second one gets a suffix.
    assert {row['sequence'] for row in found.values()} == {'road-2'}
    assert set(found) == {'djet', 'five_point'}
    way = np.linalg.norm(np.diff(KittiSequence(far).poses[:, :3, 3], axis=0), axis=1).sum()
    for method, row in found.items():
        _, truth = read_tum(output / 'trajectories' / 'road-2' / 'ground_truth.tum')
        _, estimate = read_tum(output / 'trajectories' / 'road-2' / f'{method}_best.tum')
        expected = drift(truth, estimate)
        assert int(row['longest']) == way // 100 * 100 > 0
        assert float(row['translation_percent']) == pytest.approx(
            expected.translation_percent, rel=1e-3)
        assert float(row['rotation_deg_per_100m']) == pytest.approx(
            expected.rotation_deg_per_100m, rel=1e-3)
    least = f"{float(found['djet']['rotation_deg_per_100m']):.3f}"
    assert f'<b>{least}</b>' in (output / 'index.html').read_text()
    for part in ('t_rel', 'Step lengths are those of the ground truth', least):
        assert part in ' '.join(answer.stdout.split())


def write_stretched(poses: np.ndarray, times: float, path: Path) -> None:
    """Write poses in KITTI's format, with steps so many times as long."""
    stretched = poses[:, :3].copy()
    stretched[:, :, 3] *= times
    np.savetxt(path, stretched.reshape(-1, 12))


def test_a_short_path_has_no_drift(evaluated):
    assert rows(evaluated / 'drift.csv') == []
    assert 't_rel' not in (evaluated / 'index.html').read_text()


def record(pair: int, rotation: tuple[float, ...] = (0, 0, 0),
           translation: tuple[float, ...] = (0, 0, 1), **values: object) -> PairRecord:
    """Return a record of a perfect pair, but for some values."""
    plain = {'sequence': 'road', 'previous': pair, 'current': pair + 1, 'method': 'djet',
             'preset': 'best', 'change': '', 'status': Status.OK.value, 'matches': 100,
             'inliers': 90, 'failed': False, 'rotation_error_deg': 0.0,
             'translation_error_deg': 0.0, 'hamming_mean': 20.0, 'milliseconds': 100.0}
    return PairRecord(pair=pair, rotation=rotation, translation=translation,
                      **{**plain, **values})


def test_rows_are_over_known_errors_and_count_the_failures():
    nothing = {'rotation_error_deg': math.nan, 'translation_error_deg': math.nan,
               'hamming_mean': math.nan, 'failed': True, 'status': 'DEGENERATE'}
    row, = table_rows([record(0, rotation_error_deg=0.1, translation_error_deg=2.0),
                       record(1, rotation_error_deg=0.3, translation_error_deg=4.0),
                       record(2, **nothing)])
    assert (row.pairs, row.failures, row.rotation_told, row.translation_told) == (3, 1, 2, 2)
    assert row.rotation_mean_deg == pytest.approx(0.2)
    assert row.translation_p95_deg == pytest.approx(3.9)
    assert row.hamming_mean == 20
    only, = table_rows([record(0, **nothing)])
    assert math.isnan(only.rotation_mean_deg)


@pytest.mark.parametrize(('given_up', 'stressed'), [(False, ['D-JET']), (True, [])])
def test_a_method_that_fails_on_hard_pairs_is_not_highlighted_for_its_mean(given_up, stressed):
    lost = {'rotation_error_deg': math.nan, 'failed': True} if given_up else {}
    table = results_table('', table_rows([
        record(0, rotation_error_deg=0.1), record(1, **{'rotation_error_deg': 0.2, **lost}),
        record(0, method='poselib', rotation_error_deg=0.2),
        record(1, method='poselib', rotation_error_deg=0.3)]), {})
    mean = table.header.index('rot. mean')
    assert [line.cells[2] for line in table.lines if mean in line.bold] == stressed
    assert [line.cells[mean - 1] for line in table.lines] == ['1' if given_up else '2', '2']


@pytest.mark.parametrize(('rotation', 'translation', 'way', 'failed'), [
    (0.5, 5.0, 1.0, False),
    (1.5, 5.0, 1.0, True),
    (0.5, 15.0, 1.0, True),
    (0.5, math.nan, 1.0, True),
    (math.nan, math.nan, 1.0, True),
    # A camera that stands has no direction to be missed.
    (0.5, math.nan, 0.0, False),
])
def test_a_failure_is_an_error_above_the_stated_limit(rotation, translation, way, failed):
    motion = np.eye(4)
    motion[2, 3] = way
    assert has_failed(rotation, translation, motion) is failed


def test_pairs_without_ground_truth_are_left_out(road, tmp_path):
    source, = open_datasets([road], Selection(), tmp_path)
    method = Method('five_point', 'best', EstimatorConfig(method='five_point'))
    assert len(evaluate_chunk(PairChunk(source, 0, 2), [method])) == 2
    other = Dataset('torn', '', torn_truth(road, tmp_path), range(4), '')
    assert [found.pair for found in evaluate_chunk(PairChunk(other, 0, 3), [method])] == [1]


def torn_truth(road: Path, folder: Path) -> Path:
    """Copy frames into TUM's layout, whose truth may begin late and end early."""
    (folder / 'tum' / 'rgb').mkdir(parents=True)
    for i in range(4):
        shutil.copy(road / 'image_0' / f'{i:06d}.png', folder / 'tum' / 'rgb' / f'{i}.png')
    (folder / 'tum' / 'rgb.txt').write_text(''.join(f'{i + 1}.0 rgb/{i}.png\n' for i in range(4)))
    (folder / 'tum' / 'calibration.txt').write_text('280 280 240 80\n')
    (folder / 'tum' / 'groundtruth.txt').write_text(
        ''.join(f'{2 + i / 20} 0 0 {i / 20} 0 0 0 1\n' for i in range(21)))
    return folder / 'tum'


# Sources

def test_no_method_has_features_where_the_lens_shows_nothing(road, tmp_path):
    """Neither in files nor in what is taken out of a bag."""
    D, rendered = [0.3, 0.1, 0.0, 0.0, 0.0], KittiSequence(road, end=3)
    files = FrameSequence('lens', ImageFiles(rendered.frame_paths), Intrinsics(rendered.K, D),
                          rendered.stamps_ns, None)
    write_kitti_bag(files, tmp_path / 'bag')
    bag = readable_frames(tmp_path / 'bag', tmp_path)
    unseen = Camera(files.K, np.array(D), files.size).unseen(files.size[::-1])
    assert unseen is not None and unseen.mean() > 0.1
    for frame in (files.frame(1), bag.frame(1)):
        assert np.array_equal(frame.left_out, unseen)
        views = (frame.view(TwoViewEstimator()).features.points,
                 *(chain.detect(frame.gray, blocked(unseen)).places for chain in CHAINS.values()))
        for points in views:
            x, y = points.round().astype(int).T
            assert len(points) > 50 and not unseen[y, x].any()


def test_a_bag_gives_the_errors_of_the_folder_that_it_was_made_of(road, tmp_path):
    write_kitti_bag(KittiSequence(road, end=4), tmp_path / 'bag')
    answer = djet('evaluate', tmp_path / 'bag', road, '--end', '4', '--methods', 'djet',
                  '--presets', 'best', '--workers', '1', '--output', tmp_path / 'results')
    assert answer.returncode == 0, answer.stderr
    bag, folder = rows(tmp_path / 'results' / 'table1.csv')
    assert (bag['sequence'], folder['sequence']) == ('bag', 'road')
    assert float(bag['rotation_mean_deg']) == pytest.approx(
        float(folder['rotation_mean_deg']), abs=1e-4)
    # The frames extracted from the bag are removed again.
    assert not list((tmp_path / 'results').glob('.frames*'))


def test_a_bag_cut_short_is_evaluated_up_to_the_cut(road, tmp_path):
    write_kitti_bag(KittiSequence(road, end=4), tmp_path / 'bag')
    file = tmp_path / 'bag' / 'bag.mcap'
    file.write_bytes(file.read_bytes()[:-file.stat().st_size // 3])
    answer = djet('evaluate', tmp_path / 'bag', '--methods', 'djet', '--presets', 'best',
                  '--workers', '1', '--output', tmp_path / 'results')
    assert answer.returncode == 0
    warned, = (line for line in answer.stderr.splitlines() if line.startswith('djet: warning'))
    assert 'cut short' in warned
    row, = rows(tmp_path / 'results' / 'table1.csv')
    assert 0 < int(row['pairs']) < 3


def test_frames_are_chosen_by_start_end_and_stride(road, tmp_path):
    source, = open_datasets([road], Selection(1, 8, 3), tmp_path)
    assert list(source.frames) == [1, 4, 7]


def test_a_folder_of_sequences_gives_all_of_them_with_distinct_names(road, tmp_path):
    for name in ('00', '01'):
        shutil.copytree(road, tmp_path / 'sequences' / name)
        (tmp_path / 'poses').mkdir(exist_ok=True)
        shutil.copy(road.parent.parent / 'poses' / '00.txt', tmp_path / 'poses' / f'{name}.txt')
    for folder in (tmp_path, tmp_path / 'sequences'):
        sources = open_datasets([folder], Selection(), tmp_path)
        assert [source.name for source in sources] == ['road', 'road-2']


# Running on workers

def test_one_and_two_workers_write_the_same_bytes(road, short, tmp_path):
    assert djet('evaluate', road, '--output', tmp_path, '--workers', '2', *RUN).returncode == 0
    assert (tmp_path / 'pairs.csv').read_bytes() == (short / 'pairs.csv').read_bytes()
    assert without_times(tmp_path / 'table1.csv') == without_times(short / 'table1.csv')


def test_a_dask_cluster_writes_the_same_bytes(road, short, tmp_path):
    distributed = pytest.importorskip('distributed')
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, host='127.0.0.1',
                                  dashboard_address=None) as cluster:
        answer = djet_alone('evaluate', road, '--output', tmp_path,
                            '--scheduler', cluster.scheduler_address, *RUN)
    assert answer.returncode == 0, answer.stderr
    assert (tmp_path / 'pairs.csv').read_bytes() == (short / 'pairs.csv').read_bytes()


@pytest.fixture
def running(road: Path, tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """Return a run with one worker whose first chunk is done and whose second is not."""
    process = subprocess.Popen(
        [*commands.DJET, 'lab', 'evaluate', road, '--output', tmp_path, '--workers', '1', *RUN],
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    wait_for(lambda: len(chunks(tmp_path)) == 1)
    yield process
    process.kill()
    process.communicate()


def wait_for(condition: Callable[[], bool]) -> None:
    """Wait until something has become true."""
    end = monotonic() + 120
    while not condition():
        assert monotonic() < end
        sleep(0.01)


def chunks(folder: Path) -> list[str]:
    """Lines of the chunks that are done."""
    store = folder / 'records.jsonl'
    return store.read_text().splitlines()[1:] if store.exists() else []


def workers_of(process: subprocess.Popen[str]) -> list[int]:
    """Process ids of the pool's workers."""
    children = Path(f'/proc/{process.pid}/task/{process.pid}/children').read_text().split()
    return [int(child) for child in children if b'spawn_main' in called(child)]


def called(process: str) -> bytes:
    """Words that a process was called with; none where it has ended meanwhile."""
    try:
        return Path(f'/proc/{process}/cmdline').read_bytes()
    except (FileNotFoundError, ProcessLookupError):
        return b''


def test_a_killed_run_is_resumed(road, short, running, tmp_path):
    children = workers_of(running)
    running.kill()
    running.wait()
    wait_for(lambda: not any(Path(f'/proc/{child}').exists() for child in children))
    first, = chunks(tmp_path)
    # As if the last line had been cut in the middle.
    with (tmp_path / 'records.jsonl').open('a') as store:
        store.write('{"chunk": "road:5')
    assert djet('evaluate', road, '--output', tmp_path, '--workers', '1', *RUN).returncode == 0
    assert len(chunks(tmp_path)) == 2
    # With its times, so it was not computed again.
    assert chunks(tmp_path)[0] == first
    assert (tmp_path / 'pairs.csv').read_bytes() == (short / 'pairs.csv').read_bytes()


def test_the_death_of_a_worker_is_reported_and_loses_only_its_chunk(
        road, short, running, tmp_path):
    for worker in workers_of(running):
        os.kill(worker, signal.SIGKILL)
    _, printed = running.communicate(timeout=60)
    assert running.returncode == 2
    assert printed.splitlines()[-1].startswith('djet: error: a worker died')
    assert len(chunks(tmp_path)) == 1
    assert djet('evaluate', road, '--output', tmp_path, *RUN).returncode == 0
    assert (tmp_path / 'pairs.csv').read_bytes() == (short / 'pairs.csv').read_bytes()


def test_an_interrupt_is_one_line_and_keeps_what_was_done(running, tmp_path):
    running.send_signal(signal.SIGINT)
    _, printed = running.communicate(timeout=60)
    assert running.returncode == 130
    assert 'Traceback' not in printed
    assert printed.splitlines()[-1] == 'djet: interrupted'
    assert chunks(tmp_path)


def cpu_seconds(process: int) -> float:
    """CPU time of a process so far."""
    user, system = Path(f'/proc/{process}/stat').read_text().rpartition(')')[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf('SC_CLK_TCK')


UNHEARD = """
from concurrent.futures import Future
from signal import pthread_kill, SIGINT
from threading import get_ident, Timer
from djet_ros.lab.runner import as_completed

Timer(0.5, lambda: pthread_kill(get_ident(), SIGINT)).start()
try:
    list(as_completed([Future()]))
except KeyboardInterrupt:
    print('heard')
"""


def test_ctrl_c_ends_the_run_whichever_thread_receives_it():
    answer = subprocess.run([sys.executable, '-c', UNHEARD], capture_output=True, text=True,
                            timeout=60)
    assert answer.stdout == 'heard\n', answer.stderr


# Each has work for a minute or more, on the fastest machine too.
LONG = {'evaluate': ('ROAD',) * 40, 'coverage': ('--scenes', 'road', '--frames', '200'),
        'lengths': ()}


@pytest.mark.parametrize('moment', ['while a worker starts', 'in the middle of a chunk'])
@pytest.mark.parametrize('verb', LONG)
def test_ctrl_c_in_a_terminal_ends_all_processes_at_once_in_one_line(verb, moment, road, tmp_path):
    call = [str(road) if word == 'ROAD' else word for word in LONG[verb]]
    process = subprocess.Popen([*commands.DJET, 'lab', verb, *call, '--output', tmp_path,
                                '--workers', '2'], stdout=subprocess.DEVNULL,
                               stderr=subprocess.PIPE, text=True, start_new_session=True)
    enough = 0.0 if moment == 'while a worker starts' else 2.5
    try:
        wait_for(lambda: any(cpu_seconds(one) >= enough for one in workers_of(process))
                 or process.poll() is not None)
        assert process.poll() is None
        workers, begin = workers_of(process), monotonic()
        # As a terminal does: to all of them.
        os.killpg(process.pid, signal.SIGINT)
        _, printed = process.communicate(timeout=60)
        assert monotonic() - begin < 3
        assert (process.returncode, printed) == (130, 'djet: interrupted\n')
        wait_for(lambda: not any(Path(f'/proc/{worker}').exists() for worker in workers))
    finally:
        # Where one of these fails, the others would work for a minute beside the next tests.
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def test_results_of_other_settings_are_not_mixed(road, tmp_path):
    run = ('evaluate', road, '--end', '3', '--presets', 'best', '--workers', '1', '--output',
           tmp_path)
    assert djet(*run, '--methods', 'djet').returncode == 0
    before = (tmp_path / 'records.jsonl').read_bytes()
    answer = djet(*run, '--methods', 'rpe')
    assert answer.returncode == 2
    assert 'other settings (methods); choose another --output, or pass' in answer.stderr
    assert (tmp_path / 'records.jsonl').read_bytes() == before
    assert djet(*run, '--methods', 'rpe', '--overwrite').returncode == 0
    assert {row['method'] for row in rows(tmp_path / 'table1.csv')} == {'rpe'}


@pytest.mark.parametrize('other', ['code', 'libraries'])
def test_results_of_other_code_or_libraries_are_not_mixed(other, tmp_path):
    with RecordStore(tmp_path, PairRecord, {'methods': ['djet']}) as store:
        store.add('road:0+1', [record(0)])
    with RecordStore(tmp_path, PairRecord, {'methods': ['djet']}) as store:
        assert store.chunks == {'road:0+1': [record(0)]}
    first, *rest = (tmp_path / 'records.jsonl').read_text().splitlines(keepends=True)
    settings = json.loads(first)
    assert {'numpy', 'opencv', 'poselib', 'scipy'} == set(settings['libraries'])
    earlier = json.dumps({**settings, other: 'of yesterday'}) + '\n'
    (tmp_path / 'records.jsonl').write_text(earlier + ''.join(rest))
    with pytest.raises(DjetError, match=f'other settings .{other}.; choose another --output'):
        RecordStore(tmp_path, PairRecord, {'methods': ['djet']})


def test_files_of_others_are_not_replaced(road, tmp_path):
    (tmp_path / 'index.html').write_text('a page of mine')
    run = ('evaluate', road, '--end', '3', '--presets', 'best', '--methods', 'five_point',
           '--workers', '1', '--output', tmp_path)
    answer = djet(*run)
    assert answer.returncode == 2
    assert 'holds earlier results; choose another --output, or replace them' in answer.stderr
    assert (tmp_path / 'index.html').read_text() == 'a page of mine'
    assert djet(*run, '--overwrite').returncode == 0
    assert (tmp_path / 'index.html').read_text() != 'a page of mine'


def test_a_damaged_image_is_named(small_kitti, tmp_path):
    sequence = small_kitti()
    cut = sequence / 'image_0' / '000001.png'
    cut.write_bytes(cut.read_bytes()[:500])
    answer = djet('evaluate', sequence, '--workers', '1', '--output', tmp_path / 'table', *RUN)
    assert answer.returncode == 2
    assert answer.stderr.splitlines()[-1] == (
        f'djet: error: {cut} is a damaged image (PNG image of 500 bytes is cut short); replace '
        'it, or exclude its frame')


def test_a_damaged_store_is_named(road, tmp_path):
    run = ('evaluate', road, '--end', '3', '--presets', 'best', '--methods', 'five_point',
           '--workers', '1', '--output', tmp_path)
    assert djet(*run).returncode == 0
    with (tmp_path / 'records.jsonl').open('a') as store:
        store.write('nonsense\n')
    answer = djet(*run)
    assert answer.returncode == 2
    assert 'records.jsonl line 3 is damaged; run again with --overwrite' in answer.stderr


# What the user can mend

@pytest.mark.parametrize(('arguments', 'printed'), [
    (['nowhere'], 'nowhere does not exist'),
    (['.'], 'is neither a bag nor a folder of KITTI'),
    (['road', '--methods', 'djet,orb'], "there is no method 'orb'; choose from djet, rpe, "),
    (['road', '--methods', 'djet,djet'], "method 'djet' is given twice"),
    (['road', '--presets', 'worst'], "there is no preset 'worst'; choose from best, fast, paper"),
    (['road', '--workers', '0'], '--workers is 0; it must be at least 1'),
    (['road', '--start', '7'], '8 frames, of which --start, --end and --stride select 1'),
    (['road', '--max-features', '3'], 'max_features is 3; it must lie between'),
    (['road', '--workers', '2', '--scheduler', 'tcp://x'], 'not allowed with argument'),
])
def test_an_invalid_call_is_one_line_and_exit_code_2(
        road, tmp_path, arguments, printed, monkeypatch):
    monkeypatch.chdir(tmp_path)
    called = [str(road) if word == 'road' else word for word in arguments]
    answer = djet('evaluate', *called, '--output', tmp_path / 'results')
    assert answer.returncode == 2
    assert answer.stderr.startswith('djet: error: ')
    assert answer.stderr.count('\n') == 1
    assert printed in answer.stderr
    assert not (tmp_path / 'results').exists()


def test_missing_poses_are_one_line_and_exit_code_2(small_kitti, tmp_path):
    folder = small_kitti()
    (folder.parent.parent / 'poses' / '07.txt').unlink()
    answer = djet('evaluate', folder, '--output', tmp_path / 'results')
    assert answer.returncode == 2
    assert answer.stderr.count('\n') == 1
    assert 'has no ground truth for two consecutive frames' in answer.stderr


def test_an_absent_scheduler_is_one_line_and_keeps_earlier_records(road, tmp_path):
    pytest.importorskip('distributed')
    (tmp_path / 'records.jsonl').write_text('of an earlier run\n')
    answer = djet_alone('evaluate', road, '--end', '3', '--output', tmp_path, '--overwrite',
                        '--scheduler', 'tcp://127.0.0.1:9')
    assert (tmp_path / 'records.jsonl').read_text() == 'of an earlier run\n'
    assert answer.returncode == 2
    assert "no Dask scheduler answers at 'tcp://127.0.0.1:9'" in answer.stderr.splitlines()[-1]


# The page

def test_all_files_that_the_page_refers_to_exist(evaluated):
    page = (evaluated / 'index.html').read_text()
    named = re.findall(r'(?:src|href)="([^"]+)"', page)
    assert len([name for name in named if name.endswith('.png')]) == 4
    assert all((evaluated / name).is_file() for name in named)
    assert all(title in page for title in (TITLES[method] for method in default_methods()))


def test_the_page_shows_its_plots_in_a_browser(evaluated, tmp_path):
    names = ('chromium', 'chromium-browser', 'google-chrome')
    browser = next(filter(None, map(shutil.which, names)), None)
    if browser is None:
        pytest.skip(f'no browser is installed ({", ".join(names)})')
    shot = tmp_path / 'page.png'
    subprocess.run([browser, '--headless', '--no-sandbox', '--disable-gpu', '--hide-scrollbars',
                    f'--user-data-dir={tmp_path}', '--window-size=1250,4000',
                    f'--screenshot={shot}', (evaluated / 'index.html').as_uri()],
                   capture_output=True, timeout=120, check=True)
    page = cv2.imread(str(shot))
    # The colour of the D-JET boxes (drawn at three quarters of opacity) is on the page.
    blue = np.abs(page.astype(int) - (197, 149, 64)).max(2) < 12
    assert blue.sum() > 500


def test_evo_finds_no_error_in_the_ground_truth(evaluated):
    if not shutil.which('evo_ape') and not (Path(sys.executable).parent / 'evo_ape').exists():
        pytest.skip('evo is not installed')
    truth = evaluated / 'trajectories' / 'road' / 'ground_truth.tum'
    metrics = trajectory_metrics(truth, truth)
    assert metrics.ape_m == pytest.approx(0, abs=1e-6)
    assert metrics.rpe_deg == pytest.approx(0, abs=1e-3)


# Ablation

def test_an_ablation_has_a_row_for_each_change(road, tmp_path):
    answer = djet('ablate', road, '--end', '4', '--workers', '1', '--output', tmp_path,
                  '--windows', '3,5', '--parts', 'window,recentring,starts', '--presets',
                  'best,paper')
    assert answer.returncode == 0, answer.stderr
    found = [(row['preset'], row['method'], row['change'])
             for row in rows(tmp_path / 'ablation.csv')]
    by_row = dict(zip(found, rows(tmp_path / 'ablation.csv')))
    for change in ('window 3×3', 'window not re-centred'):
        # A change changes what is found, and on whole frames of a street breaks nothing.
        assert (by_row['best', 'djet', change]['rotation_mean_deg']
                != by_row['best', 'djet', '']['rotation_mean_deg'])
        assert int(by_row['best', 'djet', change]['failures']) == 0
    assert found == [
        ('best', 'djet', ''), ('best', 'rpe', ''), ('best', 'five_point', ''),
        ('best', 'djet', 'window 3×3'),
        ('best', 'djet', 'window not re-centred'),
        ('best', 'djet', 'start: 5-point only'), ('best', 'rpe', 'start: 5-point only'),
        ('paper', 'djet', ''), ('paper', 'rpe', ''), ('paper', 'five_point', ''),
        ('paper', 'djet', 'window 3×3'), ('paper', 'djet', 'window 5×5'),
        ('paper', 'djet', 'window not re-centred'),
        ('paper', 'djet', 'starts: several'), ('paper', 'rpe', 'starts: several')]
    text = (tmp_path / 'ablation.md').read_text()
    # How rows compare with the preset stands below, each with an interval,
    assert re.search(r'best \| RP-E \| – (\| [0-9.]+ \([0-9.]+ to [0-9.]+\) ){4}\|', text)
    # and the paper's Table 2.
    assert '| *VAROS* | *D-JET* | *15×15* | *0.127* | *0.258* | *22.31* |' in text
    assert (tmp_path / 'plots' / 'road_ablation.png').stat().st_size > 10_000


def test_a_variant_has_the_same_results_with_others_as_alone(road, tmp_path):
    source, = open_datasets([road], Selection(), tmp_path)
    variants = [method for method in ablation_methods(['best'], ['patch', 'grading', 'tests'], (),
                                                      {}) if method.name == 'djet']
    together = evaluate_chunk(PairChunk(source, 0, 2), variants)
    alone = [record for method in variants
             for record in evaluate_chunk(PairChunk(source, 0, 2), [method])]
    assert len({one.rotation for one in alone}) == len(alone) == 2 * len(variants)
    assert ({(one.change, one.pair): one.rotation for one in together}
            == {(one.change, one.pair): one.rotation for one in alone})


def test_with_a_good_start_squares_do_not_fail(road, tmp_path):
    source, = open_datasets([road], Selection(), tmp_path)
    config = preset('paper', method='rpe')
    records = evaluate_chunk(PairChunk(source, 0, 5), [
        Method('rpe', 'paper', config),
        Method('rpe', 'paper', replace(config, starts='several'), good_start=True)])
    without, with_it = records[::2], records[1::2]
    assert all(a.matches > b.matches for a, b in zip(without, with_it))
    assert (np.mean([found.rotation_error_deg for found in with_it])
            < np.mean([found.rotation_error_deg for found in without]))
    assert not any(found.failed for found in with_it)


@pytest.mark.parametrize(('arguments', 'printed'), [
    (['--parts', 'colour'], "there is no part 'colour'; choose from window, "),
    (['--windows', '4'], 'window is 4; it must be odd'),
    (['--windows', 'five'], "--windows is 'five'; write odd integers such as 3,5,7"),
])
def test_a_wrong_ablation_is_one_line_and_exit_code_2(road, tmp_path, arguments, printed):
    answer = djet('ablate', road, *arguments, '--output', tmp_path / 'results')
    assert answer.returncode == 2
    assert answer.stderr.count('\n') == 1
    assert printed in answer.stderr


def test_the_store_is_plain_json(evaluated):
    first, *others = (evaluated / 'records.jsonl').read_text().splitlines()
    assert json.loads(first)['sequences'][0]['name'] == 'road'
    assert sorted(json.loads(line)['chunk'] for line in others) == ['road:0+5', 'road:5+2']
