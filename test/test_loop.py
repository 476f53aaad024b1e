"""A rendered block, driven twice: what closing the loop is good for."""

import json
import os
import subprocess
import sys

from djet_ros.lab.scenes.sequence import render_sequence
import pytest

DJET = [sys.executable, '-c', 'import sys; from djet_ros.cli.main import main; sys.exit(main())']


@pytest.fixture(scope='module')
def block(tmp_path_factory):
    """Folder of the sequence, in KITTI's layout."""
    pytest.importorskip('gtsam', reason='GTSAM is not installed: the extra slam')
    return render_sequence('loop', tmp_path_factory.mktemp('dataset'), size=(620, 188))


def test_closing_the_loop_leaves_less_than_a_third_of_the_trajectory_error(block, tmp_path):
    done = subprocess.run(
        [*DJET, 'slam', block, '--output', tmp_path / 'slam',
         '--scale', 'ground_truth', '--scale-uncertainty', '0.01'],
        capture_output=True, text=True, timeout=600, check=False,
        env={**os.environ, 'OMP_NUM_THREADS': '1'})
    assert done.returncode == 0, done.stderr
    said = json.loads((tmp_path / 'slam' / 'slam.json').read_text())
    before, after = said['errors']['before'], said['errors']['after']
    assert said['frames'] == 427
    assert said['edges']['loop'] > 100
    assert said['rejected']['loop'] < 0.2 * said['edges']['loop']
    assert before['ape_m'] > 0.03  # 1 in 10,000 of the way: there is something to be closed
    assert after['ape_m'] < before['ape_m'] / 3
    if 'evo_ape_m' in before:
        assert after['evo_ape_m'] < before['evo_ape_m'] / 3
        # Loops mend the way as a whole; from frame to frame it stays what it was, to a millimetre.
        assert after['evo_rpe_m'] == pytest.approx(before['evo_rpe_m'], abs=0.001)
