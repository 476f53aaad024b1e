"""Decompression with a limit on the size of the output."""

from __future__ import annotations

import bz2
from pathlib import Path
import shutil
import sys

from djet_ros.recordings.storages.base import BrokenFile, LARGEST_PIECE
import lz4.frame

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
BLOCK = 1 << 20

DECOMPRESSORS = {
    'zstd': zstd.ZstdDecompressor,
    'lz4': lz4.frame.LZ4FrameDecompressor,
    'bz2': bz2.BZ2Decompressor,
}


def decompress(data: bytes | memoryview, method: str, size: int) -> memoryview:
    """
    Decompress to ``size`` bytes, or fewer if the data is truncated.

    Raises BrokenFile if the data is damaged, gives more bytes, or declares too many.
    """
    if size > LARGEST_PIECE:
        raise BrokenFile(f'it declares {size} bytes in one piece, at most {LARGEST_PIECE} are '
                         'decompressed')
    if method in ('', 'none'):
        return memoryview(data)[:size]
    if method not in DECOMPRESSORS:
        raise BrokenFile(f"its compression '{method[:40]}' is not supported; it must be one of "
                         f"{', '.join(DECOMPRESSORS)}")
    stream = DECOMPRESSORS[method]()
    try:
        unpacked = stream.decompress(bytes(data), max_length=size + 1)
    except (zstd.ZstdError, RuntimeError, OSError, EOFError, ValueError) as error:
        raise BrokenFile(f'its {method} data is damaged ({error})') from error
    if len(unpacked) > size:
        raise BrokenFile(f'a piece of {method} data gives more than the {size} bytes declared')
    return memoryview(unpacked)


def decompress_message(data: memoryview) -> memoryview:
    """Decompress a single message (rosbag2's compression mode 'message')."""
    stream = zstd.ZstdDecompressor()
    try:
        unpacked = stream.decompress(bytes(data), max_length=LARGEST_PIECE + 1)
    except zstd.ZstdError as error:
        raise BrokenFile(f'a zstd message is damaged ({error})') from error
    if not stream.eof:
        raise BrokenFile('a zstd message is truncated or too large')
    return memoryview(unpacked)


def decompress_file(path: Path, folder: Path) -> None:
    """
    Decompress a .zstd file into a folder, under the same name; the caller removes it.

    It takes at most half of the free space. A truncated file is decompressed as far as it goes; a
    damaged one leaves nothing.
    """
    unpacked = folder / path.name
    room = shutil.disk_usage(folder).free // 2
    stream = zstd.ZstdDecompressor()
    try:
        with path.open('rb') as source, unpacked.open('wb') as target:
            while not stream.eof:
                block = source.read(BLOCK) if stream.needs_input else b''
                if stream.needs_input and not block:
                    break
                room -= target.write(stream.decompress(block, max_length=BLOCK))
                if room < 0:
                    raise BrokenFile('decompressed, it takes more than half of the free space in '
                                     f'{folder.parent}; set TMPDIR to a larger disk')
    except BaseException as error:
        unpacked.unlink(missing_ok=True)
        if isinstance(error, zstd.ZstdError):
            raise BrokenFile(f'its zstd data is damaged ({error})') from error
        raise
