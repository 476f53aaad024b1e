"""The bench writes the documented figures, and refuses what it can't measure."""

from __future__ import annotations

import json
from pathlib import Path
import subprocess
import sys

from commands import djet
from djet_ros.lab.bench import interleaved_minima
from djet_ros.lab.corrected_images import corrected_images
from djet_ros.lab.scenes.sequence import render_sequence
from djet_ros.recordings.bag_writers import write_kitti_bag
from djet_ros.recordings.kitti import KittiSequence
from djet_ros.recordings.recording import open_recording
import pytest

pytestmark = pytest.mark.slow


@pytest.fixture(scope='module')
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp('bench')
    render_sequence('road', out, 3, size=(620, 188))
    return next((out / 'sequences').iterdir())


def bench(*arguments: object) -> subprocess.CompletedProcess[str]:
    code = 'import sys; from djet_ros.cli.main import main; sys.exit(main())'
    return subprocess.run([sys.executable, '-c', code, 'lab', 'bench', *map(str, arguments)],
                          capture_output=True, text=True, timeout=300)


@pytest.fixture(scope='module')
def output(sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the figures of the folder, measured once."""
    path = tmp_path_factory.mktemp('figures') / 'bench.json'
    run = bench(sequence, '--output', path, '--pairs', 2)
    assert run.returncode == 0, run.stderr
    return path


def test_figures_are_positive_ratios_and_times_and_the_plot_exists(output):
    figures = json.loads(output.read_text())
    for name in ('pipeline_over_opencv', 'pairs_per_second', 'djet_stage_ms',
                 'kernel_speedup_over_cv2', 'bytes_per_frame'):
        assert figures[name] > 0, name
    assert figures['pairs'] == figures['all_cores']['pairs'] == 2
    assert output.with_suffix('.png').read_bytes().startswith(b'\x89PNG')


def test_repeats_alternate_and_the_least_time_of_each_counts():
    order, times = [], iter(range(100, 0, -1))

    def noted(name):
        def measurement():
            order.append(name)
            return float(next(times))
        return measurement

    least = interleaved_minima({name: noted(name) for name in 'abc'})
    assert order == ['a', 'b', 'c'] * (len(order) // 3) and len(order) > 3
    assert least == {'a': 103.0 - len(order), 'b': 102.0 - len(order), 'c': 101.0 - len(order)}


def test_stages_are_positive_and_add_up_to_the_time_of_a_pair(output):
    figures = json.loads(output.read_text())
    for run in (figures, figures['all_cores']):
        # "reading + features" is what the others leave, which they must not exceed.
        assert run['stages_ms'].keys() >= {'reading + features', 'matching', 'jet', 'result'}
        assert all(ms >= 0 for ms in run['stages_ms'].values())
        assert 0.9 < sum(run['stages_ms'].values()) * run['pairs_per_second'] / 1e3 < 1


def test_a_bag_is_measured_like_the_folder_that_it_was_made_of(sequence, output, tmp_path):
    write_kitti_bag(KittiSequence(sequence), tmp_path / 'bag')
    run = bench(tmp_path / 'bag', '--output', tmp_path / 'bag.json', '--pairs', 2)
    assert run.returncode == 0, run.stderr
    folder, bag = (json.loads(path.read_text()) for path in (output, tmp_path / 'bag.json'))
    assert bag.keys() == folder.keys()
    assert bag['bytes_per_frame'] == folder['bytes_per_frame']
    assert bag['djet_ms_by_points'].keys() == folder['djet_ms_by_points'].keys()


def test_images_of_a_bag_and_of_its_folder_are_the_same(sequence, tmp_path):
    folder = KittiSequence(sequence)
    write_kitti_bag(folder, tmp_path / 'bag')
    seen = []
    for path in (sequence, tmp_path / 'bag'):
        with open_recording(path) as recording:
            seen.append(list(corrected_images(recording)))
    assert len(seen[0]) == len(seen[1]) == len(folder)
    for index, (one, other) in enumerate(zip(*seen)):
        assert (one.gray == other.gray).all() and (one.gray == folder.image(index)).all()
        assert (one.camera.K == other.camera.K).all()


@pytest.mark.parametrize(('arguments', 'message'), [
    (('missing', '--output', 'a.json'), 'missing'),
    (('.', '--output', 'a.json', '--pairs', 0), '--pairs is 0')])
def test_user_errors_are_one_line_and_exit_code_2(tmp_path, arguments, message, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = djet('lab', 'bench', *arguments)
    assert run.returncode == 2
    assert message in run.stderr
    assert run.stderr.count('\n') == 1


def test_figures_are_not_overwritten_silently(sequence, tmp_path):
    output = tmp_path / 'bench.json'
    output.write_text('{}')
    run = djet('lab', 'bench', sequence, '--output', output)
    assert run.returncode == 2
    assert '--overwrite' in run.stderr
    assert output.read_text() == '{}'
