"""What PNG data declares about itself, before a decoder believes it."""

from __future__ import annotations

import struct

# 8192 x 8192: beyond any camera we know, and far below what would exhaust memory.
LARGEST_IMAGE_PIXELS = 1 << 26


PNG_START = b'\x89PNG\r\n\x1a\n'


def whole_png(data: bytes) -> bool:
    """
    Tell whether a PNG file has all of its chunks.

    Decoders make room for whatever length a chunk declares, and libpng reports a file that is cut
    short on stderr by itself.
    """
    at = len(PNG_START)
    while at + 12 <= len(data):
        length, kind = struct.unpack_from('>I4s', data, at)
        at += 12 + length
        if kind == b'IEND':
            return bool(at <= len(data))
    return False
