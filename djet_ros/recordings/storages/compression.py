"""Decompression that gives at most as many bytes as were announced."""

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
    Decompress to ``size`` bytes, or to fewer where the data is cut short.

    BrokenFile where the data is no such stream, would give more, or announces too much.
    """
    if size > LARGEST_PIECE:
        raise BrokenFile(f'it announces {size} bytes in one piece, at most {LARGEST_PIECE} are '
                         'unpacked')
    if method in ('', 'none'):
        return memoryview(data)[:size]
    if method not in DECOMPRESSORS:
        raise BrokenFile(f"its compression '{method[:40]}' is not known")
    stream = DECOMPRESSORS[method]()
    try:
        unpacked = stream.decompress(bytes(data), max_length=size + 1)
    except (zstd.ZstdError, RuntimeError, OSError, EOFError, ValueError) as error:
        raise BrokenFile(f'its {method} data is damaged ({error})') from error
    if len(unpacked) > size:
        raise BrokenFile(f'a piece of {method} data gives more than the {size} bytes announced')
    return memoryview(unpacked)


def decompress_message(data: memoryview) -> memoryview:
    """Unpack a message that was compressed on its own (rosbag2's compression mode 'message')."""
    stream = zstd.ZstdDecompressor()
    try:
        unpacked = stream.decompress(bytes(data), max_length=LARGEST_PIECE + 1)
    except zstd.ZstdError as error:
        raise BrokenFile(f'a zstd message is damaged ({error})') from error
    if not stream.eof:
        raise BrokenFile('a zstd message is cut short or too large')
    return memoryview(unpacked)


def decompress_file(path: Path, folder: Path) -> None:
    """
    Unpack a .zstd file into a folder, which must be removed later, under the old name.

    At most half of the free space there is taken. A file that is cut short
    gives what is there; one that can't be unpacked leaves nothing.
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
                    raise BrokenFile('it takes unpacked more than half of the free space in '
                                     f'{folder.parent}; set TMPDIR to a larger disk')
    except BaseException as error:
        unpacked.unlink(missing_ok=True)
        if isinstance(error, zstd.ZstdError):
            raise BrokenFile(f'its zstd data is damaged ({error})') from error
        raise
