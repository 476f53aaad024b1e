"""How the programs use threads; to be called before NumPy and OpenCV are imported."""

from __future__ import annotations

import os

# Rounds in which OpenCV's threads look for work, or for the end of it, before they sleep.
_LOOKING = ('OPENCV_THREAD_POOL_ACTIVE_WAIT_MAIN', 'OPENCV_THREAD_POOL_ACTIVE_WAIT_WORKER')

VARIABLES = ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS')


def one_blas_thread() -> None:
    """
    Have NumPy's matrix library work in the calling thread, unless its own variable says otherwise.

    The matrices of an odometry are small: on a busy machine further threads cost many times what
    they gain, because each product waits for the slowest of them.
    """
    for variable in VARIABLES:
        os.environ.setdefault(variable, '1')


def sleep_while_waiting() -> None:
    """
    Have OpenCV's own threads sleep while they wait, unless the environment says otherwise.

    Otherwise each call that they share ends with up to a millisecond in which they look for
    another: a sixth of a live node's CPU time, and more where others want the cores as well.
    """
    for variable in _LOOKING:
        os.environ.setdefault(variable, '0')
