"""Memory is reused from pair to pair."""

from __future__ import annotations

import platform
import subprocess
import sys

from djet_ros.lab.scenes import make_scene
import numpy as np
import pytest

pytestmark = pytest.mark.slow

# Page faults of twenty pairs, after as many that have allocated all memory. Single-threaded: on a
# busy machine another thread may start at any time, and allocate memory of its own.
ESTIMATES = """
from resource import getrusage, RUSAGE_SELF
import sys
import cv2
from djet_ros.core.estimator import TwoViewEstimator
import numpy as np

cv2.setNumThreads(1)
a, b, K = (np.load(path) for path in sys.argv[1:])
estimator = TwoViewEstimator()
for _ in range(2):
    before = getrusage(RUSAGE_SELF).ru_minflt
    for _ in range(20):
        estimator.estimate(estimator.view(a, K), estimator.view(b, K))
print(getrusage(RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != 'glibc', reason='of the GNU C library alone')
def test_pairs_reuse_their_memory(tmp_path):
    # Rendered elsewhere: rendering allocates and frees larger blocks.
    scene = make_scene('road')
    images = [scene.render(pose, i) for i, pose in enumerate(scene.trajectory(2))]
    paths = [str(tmp_path / f'{i}.npy') for i in range(3)]
    for path, array in zip(paths, (*images, scene.K)):
        np.save(path, array)
    faults = int(subprocess.run([sys.executable, '-c', ESTIMATES, *paths], check=True,
                                capture_output=True, text=True).stdout)
    # The pages of one image of floats; a pair writes a dozen of them.
    assert faults < 456
