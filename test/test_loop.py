"""A rendered block, driven twice: what closing the loop is good for."""

import json
import os
import subprocess
import sys

import cv2
from djet_ros.scenes.catalogue import make_scene, suggested_frames
from djet_ros.scenes.sequence import FRAME_PERIOD
import numpy as np
import pytest

DJET = [sys.executable, '-c', 'import sys; from djet_ros.cli.main import main; sys.exit(main())']

SIZE = (620, 188)
# Every second frame: a camera of 5 Hz, which goes up to 2.4 m from one to the next.
STEP = 2


@pytest.fixture(scope='module')
def block(tmp_path_factory):
    """Folder of the sequence, in KITTI's layout."""
    pytest.importorskip('gtsam', reason='GTSAM is not installed: the extra slam')
    folder = tmp_path_factory.mktemp('dataset') / 'sequences' / '02'
    (folder / 'image_0').mkdir(parents=True)
    (folder.parents[1] / 'poses').mkdir()
    scene = make_scene('loop', size=SIZE)
    poses = scene.trajectory(suggested_frames(scene))[::STEP]
    for i, pose in enumerate(poses):
        cv2.imwrite(str(folder / 'image_0' / f'{i:06d}.png'), scene.render(pose, STEP * i))
    row = ' '.join(repr(float(v)) for v in np.hstack([scene.K, np.zeros((3, 1))]).ravel())
    (folder / 'calib.txt').write_text(f'P0: {row}\n')
    (folder / 'times.txt').write_text(''.join(
        f'{STEP * FRAME_PERIOD * i:.6e}\n' for i in range(len(poses))))
    (folder.parents[1] / 'poses' / '02.txt').write_text(''.join(
        ' '.join(repr(float(v)) for v in pose[:3].ravel()) + '\n' for pose in poses))
    return folder


def test_closing_the_loop_cuts_the_absolute_trajectory_error_at_least_five_fold(block, tmp_path):
    done = subprocess.run(
        [*DJET, 'slam', block, '--output', tmp_path / 'slam',
         '--scale', 'ground_truth', '--scale-uncertainty', '0.01'],
        capture_output=True, text=True, timeout=600, check=False,
        env={**os.environ, 'OMP_NUM_THREADS': '1'})
    assert done.returncode == 0, done.stderr
    said = json.loads((tmp_path / 'slam' / 'slam.json').read_text())
    before, after = said['errors']['before'], said['errors']['after']
    assert said['frames'] == 214
    assert said['edges']['loop'] > 100
    assert said['rejected']['loop'] < 0.2 * said['edges']['loop']
    assert before['ape_m'] > 0.2
    assert after['ape_m'] < before['ape_m'] / 5
    if 'evo_ape_m' in before:
        assert after['evo_ape_m'] < before['evo_ape_m'] / 5
        # Loops mend the way as a whole; from frame to frame it stays what it was.
        assert after['evo_rpe_m'] == pytest.approx(before['evo_rpe_m'], rel=0.2)
