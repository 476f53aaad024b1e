"""Threads that have nothing to do take no CPU time."""

from __future__ import annotations

import os
from pathlib import Path
import subprocess
import sys

from djet_ros.threads import VARIABLES as BLAS
import pytest

VARIABLES = 'OPENCV_THREAD_POOL_ACTIVE_WAIT_MAIN', 'OPENCV_THREAD_POOL_ACTIVE_WAIT_WORKER'
TOLD = f'import os; print(*(os.environ[name] for name in {VARIABLES}))'


def settings(**others: str) -> list[str]:
    """Return the settings of OpenCV's threads that a program makes before its import."""
    environment = {name: value for name, value in os.environ.items() if name not in VARIABLES}
    done = subprocess.run(
        [sys.executable, '-c', 'import sys; from djet_ros.threads import sleep_while_waiting; '
         f'sleep_while_waiting(); assert "cv2" not in sys.modules; {TOLD}'],
        check=True, capture_output=True, text=True, env={**environment, **others})
    return done.stdout.split()


def threads_of_a_product(**others: str) -> int:
    """Count the threads of a program that has multiplied matrices."""
    environment = {name: value for name, value in os.environ.items() if name not in BLAS}
    done = subprocess.run(
        [sys.executable, '-c', 'import os; from djet_ros.threads import one_blas_thread; '
         'one_blas_thread(); import numpy as np; np.eye(500) @ np.eye(500); '
         'print(len(os.listdir("/proc/self/task")))'],
        check=True, capture_output=True, text=True, env={**environment, **others})
    return int(done.stdout)


@pytest.mark.skipif(not Path('/proc/self/task').exists(), reason='no /proc that lists threads')
def test_matrices_are_multiplied_in_the_calling_thread_unless_the_environment_says_otherwise(
) -> None:
    assert threads_of_a_product() == 1
    if len(os.sched_getaffinity(0)) > 1:
        # Whichever library it is; else this would see none of its threads.
        assert threads_of_a_product(**dict.fromkeys(BLAS, '2')) == 2


def test_opencv_sleeps_while_it_waits_unless_the_environment_says_otherwise() -> None:
    # What that spares is CPU time; a test of that fails where others want the cores as well. Nor
    # does OpenCV tell what it has read, so that no more than this can be asked.
    assert settings() == ['0', '0']
    assert settings(**{VARIABLES[1]: '2000'}) == ['0', '2000']
