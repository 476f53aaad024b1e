"""Threads that have nothing to do take no CPU time."""

from __future__ import annotations

import os
import subprocess
import sys

import cv2
import pytest

# What OpenCV shares among two threads, and a pause that is longer than any of them would look for
# more to do; gives the least CPU time of both, in ms.
SHARED = """
from djet_ros.threads import sleep_while_waiting
{call}
import time
import cv2
import numpy as np
cv2.setNumThreads(2)
image, still, spent = np.zeros((512, 512), np.uint8), np.eye(2, 3), []
for _ in range(40):
    before = time.process_time()
    cv2.warpAffine(image, still, (512, 512))
    time.sleep(0.01)
    spent.append(1e3 * (time.process_time() - before))
print(min(spent))
"""


def spent(call: str) -> float:
    environment = {name: value for name, value in os.environ.items()
                   if not name.startswith('OPENCV_THREAD_POOL')}
    done = subprocess.run([sys.executable, '-c', SHARED.format(call=call)], check=True,
                          capture_output=True, text=True, env=environment)
    return float(done.stdout)


@pytest.mark.skipif('pthreads' not in cv2.getBuildInformation() or cv2.getNumberOfCPUs() < 2,
                    reason='of threads of its own alone')
def test_opencv_sleeps_while_it_waits():
    assert spent('sleep_while_waiting()') < 0.75 * spent('')
