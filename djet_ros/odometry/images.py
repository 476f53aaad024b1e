"""
Conversion of sensor_msgs Image and CompressedImage, of any encoding, to gray images.

Sizes are checked against the data before anything is allocated or decoded. An unusable message
raises BadMessage, with a reason to count it by.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
import struct
from typing import Any, NamedTuple

import cv2
from djet_ros.errors import DjetError
from djet_ros.odometry.png import is_complete_png, LARGEST_IMAGE_PIXELS, PNG_START
import numpy as np
from numpy.typing import NDArray

Gray = NDArray[np.uint8]

# Values of 16-bit images that become black and white by default.
WHOLE_RANGE = (0, 65535)

# Number below which a 16-bit image has few gray levels, and the least share of the pixels of a
# level that counts: broken pixels have any value.
_FEW_LEVELS, _LEAST_SHARE = 32, 1e-4

# Features need a neighbourhood; OpenCV fails on slivers.
_SMALLEST_SIDE = 16

# Remedy for an image that contradicts itself.
_PUBLISHER = ('correct height, width, step and encoding in the node that publishes it, or choose '
              'another image topic')

JPEG_START = b'\xff\xd8'

# Scans of a progressive JPEG: encoders write about ten.
_MOST_SCANS = 64


class BadMessage(DjetError):
    """An unusable message: ``reason`` is a word to count by, the text is for the user."""

    def __init__(self, reason: str, text: str) -> None:
        """Store reason and text."""
        super().__init__(text)
        self.reason = reason


@dataclass(frozen=True)
class _Pixels:
    """
    An encoding.

    size: channels of a pixel; to_gray: from uint8 (H, W, size) to (H, W); wide: whether they have
    16 bits.
    """

    size: int
    to_gray: Callable[[NDArray[np.uint8]], NDArray[np.uint8]]
    wide: bool = False


def _one_byte(index: int) -> Callable[[NDArray[np.uint8]], NDArray[np.uint8]]:
    return lambda pixels: pixels[..., index]


def _converted(code: int) -> Callable[[NDArray[np.uint8]], NDArray[np.uint8]]:
    return lambda pixels: np.asarray(
        cv2.cvtColor(np.ascontiguousarray(pixels), code), dtype=np.uint8)


def _mosaic(code: int) -> Callable[[NDArray[np.uint8]], NDArray[np.uint8]]:
    return lambda pixels: np.asarray(
        cv2.cvtColor(np.ascontiguousarray(pixels[..., 0]), code), dtype=np.uint8)


_COLOURS = {
    'bgr': (3, cv2.COLOR_BGR2GRAY), 'rgb': (3, cv2.COLOR_RGB2GRAY),
    'bgra': (4, cv2.COLOR_BGRA2GRAY), 'rgba': (4, cv2.COLOR_RGBA2GRAY),
}

# OpenCV names a Bayer pattern by its second row, ROS by its first.
_MOSAICS = {
    'rggb': cv2.COLOR_BayerBG2GRAY, 'bggr': cv2.COLOR_BayerRG2GRAY,
    'gbrg': cv2.COLOR_BayerGR2GRAY, 'grbg': cv2.COLOR_BayerGB2GRAY,
}

_ENCODINGS = {
    'mono8': _Pixels(1, _one_byte(0)),
    '8UC1': _Pixels(1, _one_byte(0)),
    'mono16': _Pixels(1, _one_byte(0), wide=True),
    '16UC1': _Pixels(1, _one_byte(0), wide=True),
    '8UC3': _Pixels(3, _converted(cv2.COLOR_BGR2GRAY)),
    '8UC4': _Pixels(4, _converted(cv2.COLOR_BGRA2GRAY)),
    # Interleaved: U Y V Y, and Y U Y V.
    **dict.fromkeys(('yuv422', 'uyvy'), _Pixels(2, _one_byte(1))),
    **dict.fromkeys(('yuv422_yuy2', 'yuyv'), _Pixels(2, _one_byte(0))),
    # Planar: Y first.
    **dict.fromkeys(('nv12', 'nv21', 'nv24'), _Pixels(1, _one_byte(0))),
    **{f'{name}{bits}': _Pixels(channels, _converted(code), wide=bits == 16)
       for name, (channels, code) in _COLOURS.items() for bits in (8, 16)},
    **{f'bayer_{name}{bits}': _Pixels(1, _mosaic(code), wide=bits == 16)
       for name, code in _MOSAICS.items() for bits in (8, 16)},
}

ENCODINGS = tuple(_ENCODINGS)


def gray_image(message: Any, limits: tuple[int, int] = WHOLE_RANGE) -> Gray:
    """
    Return the gray image (H, W) uint8 of an Image or a CompressedImage; raises BadMessage.

    limits: values of 16 bits that become 0 and 255, with equal steps in between; for the whole
    range these are the upper 8 bits. The result may share memory with the message.
    """
    if not hasattr(message, 'encoding'):
        return _demosaiced(to_8_bits(_compressed(message), limits), message.format)
    pixels, values = _raw(message)
    # No copy without padding, as most cameras send it.
    return np.ascontiguousarray(pixels.to_gray(to_8_bits(values, limits)))


def to_8_bits(values: NDArray[Any], limits: tuple[int, int] = WHOLE_RANGE) -> NDArray[np.uint8]:
    """Return values of 16 bits as 8-bit gray levels by limits; 8-bit values are unchanged."""
    return values if values.dtype == np.uint8 else _levels_of_values(limits).take(values)


@lru_cache
def _levels_of_values(limits: tuple[int, int]) -> NDArray[np.uint8]:
    """Return a lookup table (65536,) from values to gray levels."""
    low, high = limits
    return np.clip((np.arange(65536) - low) * 256 // (high - low + 1), 0, 255).astype(np.uint8)


class FewLevels(NamedTuple):
    """A 16-bit image with few gray levels: their number, and the range of its values."""

    levels: int
    low: int
    high: int


def few_levels(message: Any, gray: Gray) -> FewLevels | None:
    """
    Return the number of gray levels of a 16-bit image if it is small; otherwise None.

    gray: result of ``gray_image``. The range is that of quantiles 0.001 and 0.999.
    """
    if not _is_wide(message):
        return None
    levels = int((np.bincount(gray.ravel()) > _LEAST_SHARE * gray.size).sum())
    if levels >= _FEW_LEVELS:
        return None
    values = _raw(message)[1] if hasattr(message, 'encoding') else _compressed(message)
    low, high = np.quantile(values, (0.001, 0.999), method='nearest')
    return FewLevels(levels, int(low), int(high))


def _is_wide(message: Any) -> bool:
    if hasattr(message, 'encoding'):
        return _ENCODINGS[message.encoding].wide
    # Of the formats that are decoded only PNG has 16 bits; its bit depth follows its size.
    return bytes(message.data[:8]) == PNG_START and bytes(message.data[24:25]) == bytes([16])


def _raw(message: Any) -> tuple[_Pixels, NDArray[Any]]:
    """Return the encoding of an Image, and its values (H, W, size) of 8 or 16 bits."""
    pixels = _ENCODINGS.get(message.encoding)
    if pixels is None:
        raise BadMessage('unknown_encoding', f"image encoding '{message.encoding:.40}' is not "
                         f'known; publish one of {", ".join(ENCODINGS)}')
    height, width, step = int(message.height), int(message.width), int(message.step)
    _check_size(width, height)
    depth = 2 if pixels.wide else 1
    row = width * pixels.size * depth
    data = _bytes(message.data)
    if step < row:
        raise BadMessage('short_step', f'image step is {step} bytes, a row of {width} pixels '
                         f'{message.encoding} has {row}; {_PUBLISHER}')
    if len(data) < height * step:
        raise BadMessage('short_data', f'image data has {len(data)} bytes, {height} rows of '
                         f'{step} have {height * step}; {_PUBLISHER}')
    values: NDArray[Any] = data[:height * step].reshape(height, step)[:, :row]
    if pixels.wide:
        values = values.view('>u2' if message.is_bigendian else '<u2')
    return pixels, values.reshape(height, width, pixels.size)


def _compressed(message: Any) -> NDArray[Any]:
    if 'compressedDepth' in message.format:
        raise BadMessage('unknown_encoding', f"image format '{message.format:.40}' holds depths, "
                         'not brightness')
    return decoded(_bytes(message.data))


def _demosaiced(gray: Gray, said: str) -> Gray:
    """
    Return the gray image of a Bayer mosaic (H, W) that was compressed as such, by its format.

    compressed_image_transport does so with PNG ('bayer_rggb8; png compressed ') and, if so
    configured, with JPEG ('bayer_rggb8; jpeg compressed bayer_rggb8'), not for 'compressed mono8'.
    """
    encoding, _, how = said.partition('; ')
    _, whole, became = how.partition(' compressed')
    if not encoding.startswith('bayer_') or encoding not in _ENCODINGS \
            or not whole or became.strip() not in ('', encoding):
        return gray
    return _ENCODINGS[encoding].to_gray(gray[..., None])


def decoded(data: NDArray[np.uint8]) -> NDArray[Any]:
    """Return the gray image (H, W), uint8 or uint16, of PNG or JPEG bytes; raises BadMessage."""
    width, height = _declared_size(data.tobytes())
    _check_size(width, height)
    try:
        # The EXIF orientation must not rotate the image against its calibration.
        gray = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH
                            | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        gray = None
    if gray is None or gray.shape != (height, width):
        raise BadMessage('undecodable', f'compressed image of {len(data)} bytes is damaged')
    return np.asarray(gray)


def _bytes(data: Any) -> NDArray[np.uint8]:
    """Return message data (array.array, bytes or array) as bytes, without a copy."""
    try:
        return np.frombuffer(data, np.uint8) if len(data) else np.empty(0, np.uint8)
    except (TypeError, ValueError, BufferError) as error:
        raise BadMessage('short_data', f'image data is no row of bytes: {error}') from None


def _check_size(width: int, height: int) -> None:
    if width <= 0 or height <= 0:
        raise BadMessage('empty', f'image is {width}x{height} pixels')
    if min(width, height) < _SMALLEST_SIDE:
        raise BadMessage('too_small', f'image is {width}x{height} pixels, at least '
                         f'{_SMALLEST_SIDE}x{_SMALLEST_SIDE} are needed')
    if width * height > LARGEST_IMAGE_PIXELS:
        raise BadMessage('too_large', f'image is {width}x{height} pixels, at most '
                         f'{LARGEST_IMAGE_PIXELS} are taken')


def _declared_size(raw: bytes) -> tuple[int, int]:
    """Return (width, height) that a PNG or JPEG declares, without decoding it."""
    if not raw:
        raise BadMessage('undecodable', 'compressed image is empty')
    if PNG_START.startswith(raw[:8]):
        if not is_complete_png(raw):
            raise BadMessage('undecodable', f'PNG image of {len(raw)} bytes is cut short')
        if raw[12:16] == b'IHDR' and len(raw) >= 24:
            width, height = struct.unpack('>II', raw[16:24])
            return width, height
    if JPEG_START.startswith(raw[:2]):
        size = jpeg_size(raw)
        _check_scans(raw)
        return size
    raise BadMessage('unknown_encoding', 'compressed image is neither JPEG nor PNG')


_START_OF_SCAN, _END_OF_IMAGE = 0xda, 0xd9

# Start-of-frame markers of JPEG, which are followed by its size.
_START_OF_FRAME = set(range(0xc0, 0xd0)) - {0xc4, 0xc8, 0xcc}


def _jpeg_segments(raw: bytes) -> Iterator[tuple[int, int]]:
    """Yield marker and position (of its 0xff) of the segments of a JPEG file before its pixels."""
    at = 2
    while at + 9 <= len(raw) and raw[at] == 0xff:
        marker = raw[at + 1]
        if marker == 0xff:
            at += 1
            continue
        yield marker, at
        if marker == _START_OF_SCAN:
            return
        at += 2 + max(int.from_bytes(raw[at + 2:at + 4], 'big'), 2)


def jpeg_size(raw: bytes) -> tuple[int, int]:
    """Return (width, height) that the header of a JPEG file declares; raises BadMessage."""
    for marker, at in _jpeg_segments(raw):
        if marker in _START_OF_FRAME:
            height, width = struct.unpack('>HH', raw[at + 5:at + 9])
            return width, height
    raise BadMessage('undecodable', 'JPEG image has no header with its size')


def _check_scans(raw: bytes) -> None:
    """
    Raise BadMessage unless the pixels of a JPEG file have an end, and a usual number of scans.

    Neither the end of a thumbnail in the header counts, nor what follows the image: zeros of a
    camera, or the video of a motion photo. Pixels never contain a marker.
    """
    pixels = next((_bytes(raw[at:]) for marker, at in _jpeg_segments(raw)
                   if marker == _START_OF_SCAN), np.empty(0, np.uint8))
    markers = pixels[1:][pixels[:-1] == 0xff]
    ends = np.flatnonzero(markers == _END_OF_IMAGE)
    if not len(ends):
        # Decoders fill what is missing with gray.
        raise BadMessage('undecodable', f'JPEG image of {len(raw)} bytes is cut short')
    # Each scan costs a pass over the whole image, and may have a few bytes only.
    scans = np.count_nonzero(markers[:ends[0]] == _START_OF_SCAN)
    if scans > _MOST_SCANS:
        raise BadMessage('undecodable', f'JPEG image has {scans} scans, at most {_MOST_SCANS} '
                         'are decoded')
