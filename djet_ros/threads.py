"""How many threads the programs take; to be called before NumPy is imported."""

from __future__ import annotations

import os

VARIABLES = ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS')


def one_blas_thread() -> None:
    """
    Have NumPy's matrix library work in the calling thread, unless the environment says otherwise.

    The matrices of an odometry are small: on a busy machine further threads cost many times what
    they gain, because each product waits for the slowest of them.
    """
    for variable in VARIABLES:
        os.environ.setdefault(variable, '1')
