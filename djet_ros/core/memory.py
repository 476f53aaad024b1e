"""Memory that is kept from pair to pair, in place of being asked for anew."""

from __future__ import annotations

import numpy as np

# Bytes; chosen: above all arrays of an image of two megapixels.
_KEPT = 2**24


def keep_freed_memory() -> None:
    """
    Have the GNU C library keep blocks that are freed, up to those of a large image.

    It gives large blocks back to the system, which clears each page when it is asked for it again:
    a twelfth of a pair's time. What it takes for large grows with the blocks that are freed, and
    so does what it keeps (mallopt(3), M_MMAP_THRESHOLD); nobody writes to this one, so that it
    takes no memory. Other libraries are not changed by it.
    """
    np.empty(_KEPT, np.uint8)
