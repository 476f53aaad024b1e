"""Kills, full disks, folders that can't be written: what was written stays, nothing is lost."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import csv
import json
import os
from pathlib import Path
import shutil
import signal
import subprocess
import time

from cards import filmed, pose
from commands import contents, DJET, djet
from conftest import write_small_kitti
from djet_ros.cli.main import main
from djet_ros.errors import DjetError
from djet_ros.recordings.bags import Bag
from djet_ros.recordings.recording import IMAGE_TOPIC
from djet_ros.recordings.trajectories import read_tum
from djet_ros.replay.results import UNFINISHED
import numpy as np
import pytest
from rosbags.highlevel import AnyReader

pytestmark = pytest.mark.slow

STEP = pose(x=0.25, z=0.15, yaw=0.01)
ONE_THREAD = {**os.environ, 'OMP_NUM_THREADS': '1', 'OPENBLAS_NUM_THREADS': '1'}
POSE_TOPIC = '/vo_node/odometry'


@pytest.fixture(scope='module')
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a drive to and fro of 3000 frames, which takes far longer than any test waits."""
    return filmed(tmp_path_factory.mktemp('drive') / 'sequences' / '00',
                  [np.linalg.matrix_power(STEP, i) for i in range(6)], 3000)


def read_back(results: Path) -> tuple[int, int, int]:
    """How many poses, rows and messages a results folder holds; all of them have to be whole."""
    stamps, poses = read_tum(results / 'trajectory_tum.txt')
    assert np.isfinite(poses).all()
    rows = list(csv.DictReader((results / 'frames.csv').open()))
    assert [int(row['stamp_ns']) for row in rows][:len(stamps)] == stamps.tolist()[:len(rows)]
    delivered: list[int] = []
    with Bag(results / 'bag') as bag:
        try:
            # Item by item: those before the break stay.
            delivered.extend(message.stamp_ns for message in bag.messages({POSE_TOPIC}))
        except DjetError as error:
            assert 'everything before that was read' in str(error)
    # The bag has the first poses without a hole.
    assert delivered == stamps.tolist()[:len(delivered)]
    return len(stamps), len(rows), len(delivered)


def wait_for(ready: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60
    while not ready():
        assert time.monotonic() < deadline
        time.sleep(0.005)


@pytest.mark.slow
@pytest.mark.parametrize('seed', range(4))
def test_data_written_before_a_kill_is_readable(drive, tmp_path, seed):
    results = tmp_path / 'results'
    process = subprocess.Popen([*DJET, 'replay', drive, '--output', results], env=ONE_THREAD,
                               stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    rng = np.random.default_rng(seed)
    trajectory = results / 'trajectory_tum.txt'
    lines = int(rng.integers(1, 25))
    wait_for(lambda: trajectory.exists() and trajectory.read_bytes().count(b'\n') >= lines)
    time.sleep(rng.uniform(0, 0.1))
    process.send_signal(signal.SIGKILL)
    assert process.wait(30) == -signal.SIGKILL
    poses, rows, delivered = read_back(results)
    assert poses >= lines
    assert abs(rows - poses) <= 1
    # The bag holds back the newest stamp, and a kill may fall between two files.
    assert delivered >= poses - 2
    summary = json.loads((results / 'summary.json').read_text())
    assert summary == {'source': str(drive), 'image_topic': IMAGE_TOPIC, 'method': 'djet',
                       'preset': 'best', 'scale': 'structure', **UNFINISHED}
    before = contents(results)
    again = djet('replay', drive, '--output', results)
    assert again.returncode == 2
    assert again.stderr == (f'djet: error: {results} holds earlier results; choose another '
                            '--output, or replace them with --overwrite\n')
    assert before == contents(results)


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Callable[[str], Path]]:
    """Return a function that mounts a small disk in memory, again with other options."""
    place = tmp_path / 'disk'
    place.mkdir()
    mounted = []

    def mount(options: str) -> Path:
        done = subprocess.run(['mount', '-t', 'tmpfs', '-o', options, 'tmpfs', str(place)],
                              capture_output=True, text=True, check=False)
        if done.returncode:
            pytest.skip(f'no disk can be mounted here: {done.stderr.strip()}')
        mounted.append(place)
        return place

    if shutil.which('mount') is None:
        pytest.skip('there is no mount command here')
    yield mount
    for _ in mounted:
        subprocess.run(['umount', str(place)], check=True)


def test_results_on_a_full_disk_are_readable_and_the_reason_is_one_line(drive, disk):
    place = disk('size=120k')
    done = djet('replay', drive, '--output', place / 'results')
    assert done.returncode == 2
    assert done.stderr.count('\n') == 1
    assert 'could not be written' in done.stderr
    assert 'No space left on device' in done.stderr
    assert 'readable' in done.stderr or 'whole' in done.stderr
    poses, _, delivered = read_back(place / 'results')
    assert poses > 20
    assert delivered > 20
    assert json.loads((place / 'results' / 'summary.json').read_text())['complete'] is False


def test_a_bag_on_a_full_disk_leaves_nothing(drive, disk):
    place = disk('size=2m')
    done = djet('kitti-to-bag', drive, place / 'bag')
    assert done.returncode == 2
    assert 'No space left on device; nothing was left behind' in done.stderr
    assert list(place.iterdir()) == []


@pytest.mark.parametrize('free', [0, 4, 8, 12, 16, 20])
def test_a_disk_that_is_full_from_the_start_is_named_and_bars_no_retry(drive, disk, free):
    place = disk('size=64k')
    (place / 'ballast').write_bytes(bytes((64 - free) << 10))
    done = djet('replay', drive, '--output', place / 'results')
    assert done.returncode == 2
    assert done.stderr.count('\n') == 1
    assert 'No space left on device' in done.stderr
    assert str(place / 'results') in done.stderr
    (place / 'ballast').unlink()
    djet('replay', drive, '--output', place / 'results', '--overwrite')
    assert read_back(place / 'results')[0] > 5


@pytest.mark.parametrize('command', [
    ['replay', 'DRIVE', '--output', 'DISK/results'], ['kitti-to-bag', 'DRIVE', 'DISK/bag'],
    ['lab', 'soak', '--output', 'DISK/deep/soak.json', '--frames', '100'],
    ['lab', 'render', 'road', 'DISK/road', '--frames', '1', '--size', '160x120']])
def test_a_disk_that_is_read_only_is_named(drive, disk, command):
    # Modes do not hold root back; this does.
    place = disk('size=1m,ro')
    done = djet(*(word.replace('DRIVE', str(drive)).replace('DISK', str(place))
                  for word in command))
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].startswith('djet: error: ')
    assert str(place) in done.stderr
    assert 'Read-only file system' in done.stderr
    assert list(place.iterdir()) == []


# Existing output


COMMANDS = {
    'replay': ['replay', 'SEQUENCE', '--output', 'OUT'],
    'kitti-to-bag': ['kitti-to-bag', 'SEQUENCE', 'OUT'],
    'render': ['lab', 'render', 'road', 'OUT', '--frames', '1', '--size', '160x120'],
    'similarity': ['lab', 'similarity', 'IMAGE', '--output', 'OUT.png', '--points', '80,60'],
}


@pytest.mark.parametrize('name', COMMANDS)
def test_a_second_run_changes_nothing_and_names_the_option_to_replace(tmp_path, capsys, name):
    sequence = write_small_kitti(tmp_path / 'data', frames=2, size=(160, 120))
    arguments = [word.replace('SEQUENCE', str(sequence)).replace('OUT', str(tmp_path / 'out'))
                 .replace('IMAGE', str(sequence / 'image_0' / '000000.png'))
                 for word in COMMANDS[name]]
    assert main(arguments) == 0
    before = contents(tmp_path)
    capsys.readouterr()
    assert main(arguments) == 2
    printed = capsys.readouterr().err.splitlines()[-1]
    assert printed.startswith('djet: error: ')
    assert '--overwrite' in printed
    assert contents(tmp_path) == before
    assert main([*arguments, '--overwrite']) == 0


def test_sigterm_leaves_nothing_of_a_bag_that_is_half_made(drive, tmp_path):
    place = tmp_path / 'place'
    process = subprocess.Popen([*DJET, 'kitti-to-bag', drive, place / 'bag'], env=ONE_THREAD,
                               stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    wait_for(lambda: any(place.rglob('*.mcap')))
    process.send_signal(signal.SIGTERM)
    _, printed = process.communicate(timeout=60)
    assert (process.returncode, printed) == (143, 'djet: terminated\n')
    assert list(place.iterdir()) == []


def test_other_programs_read_the_bag_of_an_interrupted_run(drive, tmp_path):
    results = tmp_path / 'results'
    process = subprocess.Popen([*DJET, 'replay', drive, '--output', results], env=ONE_THREAD,
                               stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    trajectory = results / 'trajectory_tum.txt'
    wait_for(lambda: trajectory.exists() and trajectory.read_bytes().count(b'\n') >= 5)
    process.send_signal(signal.SIGINT)
    assert process.wait(60) == 130
    with AnyReader([results / 'bag']) as reader:
        odometry = [c for c in reader.connections if c.topic == POSE_TOPIC]
        messages = sum(1 for _ in reader.messages(odometry))
    # The interrupt may fall between the two files of one image.
    assert abs(messages - len(read_tum(trajectory)[0])) <= 1
