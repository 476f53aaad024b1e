"""Trajectory files: exact, and never lost."""

import os
import signal
import subprocess
import sys

from commands import full_disk
from djet_ros.errors import DjetError
from djet_ros.recordings.kitti import read_poses
from djet_ros.recordings.trajectories import KittiWriter, read_tum, TumWriter
from hypothesis import given, strategies as st
import numpy as np
import pytest
from scipy.spatial.transform import Rotation


def some_poses(count=20):
    rng = np.random.default_rng(1)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(rng.normal(size=(count, 3))).as_matrix()
    poses[:, :3, 3] = rng.normal(scale=100, size=(count, 3))
    return poses


def written(writer, path, stamps, poses):
    with writer(path) as file:
        for stamp, pose in zip(stamps, poses, strict=True):
            file.write(int(stamp), pose)
    return path


def test_a_tum_file_gives_back_stamps_exactly_and_poses_to_the_last_digits(tmp_path):
    poses = some_poses()
    stamps = 1_403_636_579_763_555_584 + np.arange(20) * 33_333_333
    read_stamps, read = read_tum(written(TumWriter, tmp_path / 'a.tum', stamps, poses))
    assert (read_stamps == stamps).all()
    assert (read[:, :3, 3] == poses[:, :3, 3]).all()
    assert np.abs(read - poses).max() < 1e-14


def test_stamps_before_zero_are_written_with_their_sign_and_read_back(tmp_path):
    stamps = [-1_000_000_001, -1_000_000_000, -900_000_000, -1, 0, 1]
    path = written(TumWriter, tmp_path / 'a.tum', stamps, some_poses(6))
    assert [line.partition(' ')[0] for line in path.read_text().splitlines()] == [
        '-1.000000001', '-1.000000000', '-0.900000000', '-0.000000001', '0.000000000',
        '0.000000001']
    assert read_tum(path)[0].tolist() == stamps
    path.write_text('--1 0 0 0 0 0 0 1\n')
    with pytest.raises(DjetError, match='is not a number'):
        read_tum(path)


def test_a_kitti_file_gives_back_the_same_doubles(tmp_path):
    poses = some_poses()
    assert (read_poses(written(KittiWriter, tmp_path / 'a.txt', range(20), poses)) == poses).all()


def test_equal_poses_give_equal_bytes_and_zero_has_no_sign(tmp_path):
    pose = np.eye(4)
    pose[0, 3] = -0.0
    path = written(TumWriter, tmp_path / 'a.tum', [1_000_000_005], [pose])
    assert path.read_text() == '1.000000005 0.0 0.0 0.0 0.0 0.0 0.0 1.0\n'
    path = written(KittiWriter, tmp_path / 'a.txt', [0], [pose])
    assert path.read_text() == '1.0 0.0 0.0 0.0 0.0 1.0 0.0 0.0 0.0 0.0 1.0 0.0\n'


@given(st.lists(st.floats(-4, 4), min_size=3, max_size=3))
def test_the_quaternion_has_no_negative_real_part(vector):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(vector).as_matrix()
    line = TumWriter.line(0, pose)
    assert float(line.split()[-1]) >= 0


def test_a_killed_process_leaves_every_line_it_has_written(tmp_path):
    path = tmp_path / 'killed.tum'
    script = ('import sys, pathlib, numpy\n'
              'from djet_ros.recordings.trajectories import TumWriter\n'
              'file = TumWriter(pathlib.Path(sys.argv[1]))\n'
              'for i in range(500): file.write(i * 10**8, numpy.eye(4))\n'
              'print("written", flush=True)\n'
              'import time; time.sleep(60)\n')
    process = subprocess.Popen([sys.executable, '-c', script, str(path)], stdout=subprocess.PIPE)
    process.stdout.readline()
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    stamps, _ = read_tum(path)
    assert stamps.tolist() == [i * 10**8 for i in range(500)]


def test_an_existing_file_is_kept(tmp_path):
    (tmp_path / 'a.tum').write_text('mine')
    with pytest.raises(DjetError, match=r'a\.tum could not be created: File exists'):
        TumWriter(tmp_path / 'a.tum')
    assert (tmp_path / 'a.tum').read_text() == 'mine'


@pytest.mark.parametrize(('line', 'message'), [
    ('1.0 0 0 0 0 0 0', 'has 7 numbers; it must have 8'),
    ('x 0 0 0 0 0 0 1', "'x' is not a number"),
    ('-3e9 0 0 0 0 0 0 1', "'-3e9' is not a stamp"),
    ('1.0 0 0 inf 0 0 0 1', "'inf' is not a finite number"),
    ('1.0 0 0 0 0 0 0 0', 'quaternion of pose 0 has length 0'),
])
def test_a_wrong_tum_line_is_named(tmp_path, line, message):
    (tmp_path / 'a.tum').write_text(f'# stamp pose\n{line}\n')
    with pytest.raises(DjetError, match=message):
        read_tum(tmp_path / 'a.tum')


def test_a_line_without_room_on_the_disk_is_removed(tmp_path):
    with TumWriter(tmp_path / 'full.txt') as writer:
        for i in range(20):
            writer.write(i, np.eye(4))
        whole = (tmp_path / 'full.txt').read_bytes()
        with full_disk(len(whole) + 7):
            for _ in range(2):
                with pytest.raises(DjetError, match='the poses written so far are complete'):
                    writer.write(20, np.eye(4))
                assert (tmp_path / 'full.txt').read_bytes() == whole
        writer.write(20, np.eye(4))
    assert len(read_tum(tmp_path / 'full.txt')[0]) == 21
