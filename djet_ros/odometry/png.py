"""Checks of PNG data before it is decoded."""

from __future__ import annotations

import struct

# 8192 x 8192: larger than any known camera's image, and far below what exhausts memory.
LARGEST_IMAGE_PIXELS = 1 << 26


PNG_START = b'\x89PNG\r\n\x1a\n'


def is_complete_png(data: bytes) -> bool:
    """
    Return whether a PNG file has all of its chunks.

    Decoders allocate the length that a chunk declares, and libpng writes to stderr about a
    truncated file.
    """
    at = len(PNG_START)
    while at + 12 <= len(data):
        length, kind = struct.unpack_from('>I4s', data, at)
        at += 12 + length
        if kind == b'IEND':
            return bool(at <= len(data))
    return False
