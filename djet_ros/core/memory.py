"""Reuse of memory from pair to pair."""

from __future__ import annotations

import numpy as np

# Bytes; chosen: larger than any array of an image of two megapixels.
_BLOCK_SIZE = 2**24


def keep_freed_memory() -> None:
    """
    Make the GNU C library keep freed blocks up to the size of a large image.

    It returns large blocks to the system, which clears each page when it is requested again: a
    twelfth of a pair's time. Its threshold for large blocks grows with the blocks that are freed
    (mallopt(3), M_MMAP_THRESHOLD). The block that is freed here is never written, so it occupies
    no memory. Other C libraries are not affected.
    """
    np.empty(_BLOCK_SIZE, np.uint8)
