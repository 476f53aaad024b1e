"""How the programs use threads and memory; to be called before NumPy and OpenCV are imported."""

from __future__ import annotations

import ctypes
import os

# Parameters of glibc's mallopt: M_MMAP_THRESHOLD and M_TRIM_THRESHOLD, in bytes.
_LARGEST_KEPT, _MOST_KEPT = -3, -1

# Rounds in which OpenCV's threads look for work, or for the end of it, before they sleep.
_LOOKING = ('OPENCV_THREAD_POOL_ACTIVE_WAIT_MAIN', 'OPENCV_THREAD_POOL_ACTIVE_WAIT_WORKER')

VARIABLES = ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS')


def one_blas_thread() -> None:
    """
    Have NumPy's matrix library work in the calling thread, unless the environment says otherwise.

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


def keep_freed_memory() -> None:
    """
    Have the C library keep what one frame has freed for the next, where it is glibc.

    It gives arrays of some size back to the system at once, and fresh pages for the same arrays of
    each frame took a fifteenth of the time. Programs hold up to 64 MB more for it.
    """
    mallopt = getattr(ctypes.CDLL(None), 'mallopt', None)
    if mallopt is not None:
        mallopt(_LARGEST_KEPT, 1 << 26)
        mallopt(_MOST_KEPT, 1 << 26)
