"""Threads that have nothing to do take no CPU time."""

from __future__ import annotations

import os
import subprocess
import sys

VARIABLES = 'OPENCV_THREAD_POOL_ACTIVE_WAIT_MAIN', 'OPENCV_THREAD_POOL_ACTIVE_WAIT_WORKER'
TOLD = f'import os; print(*(os.environ[name] for name in {VARIABLES}))'


def told(**others: str) -> list[str]:
    """Give what a program tells OpenCV's threads before it is imported."""
    environment = {name: value for name, value in os.environ.items() if name not in VARIABLES}
    done = subprocess.run(
        [sys.executable, '-c', 'import sys; from djet_ros.threads import sleep_while_waiting; '
         f'sleep_while_waiting(); assert "cv2" not in sys.modules; {TOLD}'],
        check=True, capture_output=True, text=True, env={**environment, **others})
    return done.stdout.split()


def test_opencv_sleeps_while_it_waits_unless_the_environment_says_otherwise() -> None:
    # What that spares is CPU time; a test of that fails where others want the cores as well.
    assert told() == ['0', '0']
    assert told(**{VARIABLES[1]: '2000'}) == ['0', '2000']
