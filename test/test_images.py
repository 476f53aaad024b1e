"""Images of every encoding give the same gray image; broken ones give a reason."""

from array import array
import contextlib
import struct
import zlib

import cv2
from djet_ros.odometry.images import BadMessage, ENCODINGS, few_levels, gray_image
from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
from ros_messages import compressed, image

rng = np.random.default_rng(3)
SCENE = cv2.GaussianBlur(rng.integers(0, 256, (36, 52, 3), dtype=np.uint8), (0, 0), 2)
GRAY = cv2.cvtColor(SCENE, cv2.COLOR_BGR2GRAY)


def wide(pixels, big_endian=False):
    """Return 16 bits whose upper byte is the pixel and whose lower byte is random."""
    noise = rng.integers(0, 256, pixels.shape).astype(np.uint16)
    return (pixels.astype(np.uint16) * 256 + noise).astype('>u2' if big_endian else '<u2')


def mosaic(pattern):
    """Return the Bayer mosaic of a scene (BGR), named by its first row."""
    channel = {'b': 0, 'g': 1, 'r': 2}
    result = np.empty(SCENE.shape[:2], np.uint8)
    for k, colour in enumerate(pattern):
        result[k // 2::2, k % 2::2] = SCENE[k // 2::2, k % 2::2, channel[colour]]
    return result


def with_alpha(pixels):
    return np.dstack([pixels, rng.integers(0, 256, pixels.shape[:2], dtype=np.uint8)])


def yuv(luma_first):
    chroma = rng.integers(0, 256, GRAY.shape, dtype=np.uint8)
    return np.dstack([GRAY, chroma] if luma_first else [chroma, GRAY])


def planes(extra_rows):
    chroma = rng.integers(0, 256, (extra_rows, GRAY.shape[1]), dtype=np.uint8)
    return np.vstack([GRAY, chroma])


RGB = SCENE[..., ::-1]
EXACT = {
    'mono8': GRAY, '8UC1': GRAY, 'mono16': wide(GRAY), '16UC1': wide(GRAY),
    'bgr8': SCENE, '8UC3': SCENE, 'rgb8': RGB, 'bgra8': with_alpha(SCENE),
    '8UC4': with_alpha(SCENE), 'rgba8': with_alpha(RGB),
    'bgr16': wide(SCENE), 'rgb16': wide(RGB), 'bgra16': wide(with_alpha(SCENE)),
    'rgba16': wide(with_alpha(RGB)),
    'yuv422': yuv(False), 'uyvy': yuv(False), 'yuv422_yuy2': yuv(True), 'yuyv': yuv(True),
}
MOSAICS = ('rggb', 'bggr', 'gbrg', 'grbg')


def reason(message):
    with pytest.raises(BadMessage) as caught:
        gray_image(message)
    assert '\n' not in str(caught.value)
    return caught.value.reason


@pytest.mark.parametrize('padding', [0, 5])
@pytest.mark.parametrize('encoding', EXACT)
def test_every_encoding_gives_the_same_gray(encoding, padding):
    assert np.array_equal(gray_image(image(EXACT[encoding], encoding, padding=padding)), GRAY)


@pytest.mark.parametrize('bits', [8, 16])
@pytest.mark.parametrize('pattern', MOSAICS)
def test_a_mosaic_gives_nearly_the_same_gray_and_its_neighbours_do_not(pattern, bits):
    # Blue and red far apart, so that a wrong pattern shows.
    pixels = mosaic(pattern)
    pixels = pixels if bits == 8 else wide(pixels)
    errors = {name: np.abs(gray_image(image(pixels, f'bayer_{name}{bits}')).astype(float)
                           - GRAY)[2:-2, 2:-2].mean() for name in MOSAICS}
    assert min(errors, key=errors.get) == pattern
    assert errors[pattern] < 3


@pytest.mark.parametrize('encoding, chroma_rows', [('nv12', 18), ('nv21', 18), ('nv24', 72)])
def test_the_first_of_several_planes_is_the_gray_one(encoding, chroma_rows):
    message = image(planes(chroma_rows), encoding, height=GRAY.shape[0])
    assert np.array_equal(gray_image(message), GRAY)


def test_all_encodings_are_tested():
    tested = {*EXACT, *(f'bayer_{p}{b}' for p in MOSAICS for b in (8, 16)),
              'nv12', 'nv21', 'nv24'}
    assert tested == set(ENCODINGS)


@pytest.mark.parametrize('encoding', ['mono16', '16UC1', 'rgb16', 'bayer_rggb16'])
def test_big_endian_numbers_are_read_as_such(encoding):
    pixels = {'rgb16': RGB, 'bayer_rggb16': mosaic('rggb')}.get(encoding, GRAY)
    little = gray_image(image(wide(pixels), encoding))
    assert np.array_equal(
        gray_image(image(wide(pixels, big_endian=True), encoding, is_bigendian=1)), little)


def small(pixels, gain=16, offset=0):
    """Return few of 16 bits: gain times the gray level, plus an offset."""
    return (pixels.astype(np.uint16) * gain + offset).astype('<u2')


@pytest.mark.parametrize('gain, offset', [(16, 0), (4, 0), (1, 0), (5, 8000), (256, 0)])
@pytest.mark.parametrize('pixels, encoding', [(GRAY, 'mono16'), (RGB, 'rgb16')])
def test_a_range_of_16_bits_gives_the_gray_of_all_that_it_has(pixels, encoding, gain, offset):
    limits = offset, offset + 256 * gain - 1
    for big in (False, True):
        values = small(pixels, gain, offset).astype('>u2' if big else '<u2')
        message = image(values, encoding, is_bigendian=int(big), padding=2)
        assert np.array_equal(gray_image(message, limits), GRAY)
    png = compressed(encoded('.png', small(GRAY, gain, offset)), 'png')
    assert np.array_equal(gray_image(png, limits), GRAY)


def test_what_is_outside_the_range_is_black_or_white_and_all_else_in_equal_steps():
    values = np.tile(np.array([0, 999, 1000, 1001, 1999, 2000, 2001, 65535], '<u2'), (16, 4))
    found = gray_image(image(values, 'mono16'), (1000, 2000))[0, :8]
    assert found.tolist() == [0, 0, 0, 0, 255, 255, 255, 255]
    every = np.arange(65536, dtype='<u2').reshape(256, 256)
    levels = np.bincount(gray_image(image(every, 'mono16'), (0, 4095)).ravel())
    assert levels[:255].tolist() == [16] * 255


def test_a_range_changes_no_image_of_8_bits():
    for message in (image(GRAY), compressed(encoded('.png'), 'png')):
        assert np.array_equal(gray_image(message, (0, 4095)), GRAY)
        assert few_levels(message, gray_image(message, (0, 4095)) // 128) is None


@pytest.mark.parametrize('message', [
    lambda pixels: image(pixels, 'mono16'),
    lambda pixels: image(pixels.byteswap(), 'mono16', is_bigendian=1),
    lambda pixels: compressed(encoded('.png', pixels), 'png')])
def test_few_levels_of_16_bits_are_reported_with_their_range(message):
    dark = message(small(GRAY, 2, 8000))
    levels, low, high = few_levels(dark, gray_image(dark))
    assert levels <= 3
    assert 8000 <= low < high <= 8510
    assert few_levels(dark, gray_image(dark, (8000, 8511))) is None


def test_broken_pixels_do_not_hide_few_gray_levels():
    values = np.full((480, 640), 100, '<u2')
    values.ravel()[:40_000:1000] = np.arange(40) * 1600
    message = image(values, 'mono16')
    assert few_levels(message, gray_image(message)) == (1, 100, 100)


@pytest.mark.parametrize('kind', [lambda d: array('B', d.tobytes()), lambda d: d.tobytes(),
                                  lambda d: memoryview(d.tobytes()), lambda d: d.copy()])
def test_data_may_be_of_any_type_of_the_middleware(kind):
    message = image(GRAY, padding=3)
    message.data = kind(message.data)
    assert np.array_equal(gray_image(message), GRAY)


def test_an_unpadded_gray_image_is_not_copied():
    message = image(GRAY)
    assert np.shares_memory(gray_image(message), message.data)


@pytest.mark.parametrize('changes, expected', [
    ({'encoding': 'sepia'}, 'unknown_encoding'),
    ({'encoding': ''}, 'unknown_encoding'),
    ({'encoding': '32FC1'}, 'unknown_encoding'),
    ({'height': 37}, 'short_data'),
    ({'data': np.empty(0, np.uint8)}, 'short_data'),
    ({'data': [1, 2, 3]}, 'short_data'),
    ({'step': 51}, 'short_step'),
    ({'step': 0}, 'short_step'),
    ({'encoding': 'bgr8'}, 'short_step'),
    ({'height': 0}, 'empty'),
    ({'width': 0}, 'empty'),
    ({'width': 15}, 'too_small'),
    ({'height': 2**31}, 'too_large'),
    ({'width': 2**32 - 1, 'height': 2**32 - 1, 'step': 2**32 - 1}, 'too_large'),
    ({'step': 2**32 - 1}, 'short_data'),
])
def test_a_broken_image_has_a_reason(changes, expected):
    assert reason(image(GRAY, **changes)) == expected


@pytest.mark.parametrize('changes', [{'height': 37}, {'step': 51}])
def test_an_image_that_contradicts_itself_has_a_remedy(changes):
    with pytest.raises(BadMessage, match='in the node that publishes it, or choose another image'):
        gray_image(image(GRAY, **changes))


@settings(max_examples=200, deadline=None)
@given(encoding=st.one_of(st.sampled_from(ENCODINGS), st.text(max_size=5)),
       size=st.tuples(*[st.integers(0, 40) | st.integers(0, 2**32 - 1)] * 3),
       data=st.binary(max_size=2000), big=st.integers(0, 255))
def test_no_image_raises_anything_but_a_reason(encoding, size, data, big):
    message = image(GRAY, encoding, height=size[0], width=size[1], step=size[2],
                    is_bigendian=big, data=np.frombuffer(data, np.uint8))
    try:
        gray = gray_image(message)
    except BadMessage:
        return
    assert gray.dtype == np.uint8
    assert gray.shape == size[:2]
    assert gray.flags.c_contiguous


def encoded(extension, pixels=GRAY):
    return cv2.imencode(extension, pixels)[1].tobytes()


def test_a_compressed_image_is_decoded():
    assert np.array_equal(gray_image(compressed(encoded('.png'), 'png')), GRAY)
    assert np.abs(gray_image(compressed(encoded('.jpg'))).astype(int) - GRAY).max() < 20
    color = gray_image(compressed(encoded('.png', SCENE), 'bgr8; png compressed bgr8'))
    assert np.abs(color.astype(int) - GRAY).max() <= 1
    sixteen = gray_image(compressed(encoded('.png', wide(GRAY).astype(np.uint16)), 'png'))
    assert np.abs(sixteen.astype(int) - GRAY).max() <= 1


@pytest.mark.parametrize('bits', [8, 16])
@pytest.mark.parametrize('pattern', MOSAICS)
def test_a_compressed_mosaic_gives_the_gray_of_the_raw_one(pattern, bits):
    encoding = f'bayer_{pattern}{bits}'
    pixels = mosaic(pattern) if bits == 8 else wide(mosaic(pattern))
    data = encoded('.png', pixels.astype(f'u{bits // 8}'))
    expected = gray_image(image(pixels, encoding))
    # formats of compressed_image_transport for PNG, and for JPEG of mosaics
    for declared in (f'{encoding}; png compressed ', f'{encoding}; jpeg compressed {encoding}'):
        assert np.array_equal(gray_image(compressed(data, declared)), expected)


def test_a_mosaic_converted_before_compression_is_gray():
    for declared in ('bayer_rggb8; jpeg compressed mono8', 'bayer_rggb8; jpeg compressed bgr8',
                     'bayer_rggb8; jpeg', 'mono8; png compressed ',
                     'bayer_of_none; png compressed '):
        assert np.array_equal(gray_image(compressed(encoded('.png'), declared)), GRAY)


def test_trailing_zeros_after_a_jpeg_are_usual():
    assert gray_image(compressed(encoded('.jpg') + bytes(900))).shape == GRAY.shape


def with_segment(data, kind, body):
    return data[:2] + kind + struct.pack('>H', len(body) + 2) + body + data[2:]


def test_a_video_after_a_jpeg_does_not_matter():
    # A motion photo; bytes of a video look like any marker now and then.
    video = bytes(5000) + b'\xff\xda' * 100 + bytes(5000)
    assert np.array_equal(gray_image(compressed(encoded('.jpg') + video)),
                          gray_image(compressed(encoded('.jpg'))))


def test_the_end_of_a_thumbnail_is_not_that_of_the_image():
    data, thumbnail = encoded('.jpg'), cv2.imencode('.jpg', GRAY[::2, ::2])[1].tobytes()
    cut = with_segment(data[:-20], b'\xff\xe1', b'Exif\0\0' + thumbnail) + bytes(500)
    assert reason(compressed(cut)) == 'undecodable'


def test_an_orientation_tag_does_not_rotate_the_image():
    data = encoded('.jpg')
    # EXIF with one entry: orientation 6, a rotation by 90 degrees.
    exif = (b'Exif\0\0MM\0*\0\0\0\x08\0\x01' + struct.pack('>HHIHH', 0x112, 3, 1, 6, 0)
            + bytes(4))
    assert gray_image(compressed(with_segment(data, b'\xff\xe1', exif))).shape == GRAY.shape


def huge_png():
    header = struct.pack('>IIBBBBB', 60000, 60000, 8, 0, 0, 0, 0)
    chunks = b''.join(struct.pack('>I', len(body)) + kind + body
                      + struct.pack('>I', zlib.crc32(kind + body))
                      for kind, body in ((b'IHDR', header), (b'IDAT', b''), (b'IEND', b'')))
    return b'\x89PNG\r\n\x1a\n' + chunks


def huge_jpeg():
    data = encoded('.jpg')
    at = data.index(b'\xff\xc0')
    return data[:at + 5] + struct.pack('>HH', 65500, 65500) + data[at + 9:]


@pytest.mark.parametrize('data, expected', [
    (b'', 'undecodable'),
    (b'\xff', 'undecodable'),
    (encoded('.png')[:5], 'undecodable'),
    (encoded('.png')[:20], 'undecodable'),
    (b'GIF89a' + bytes(40), 'unknown_encoding'),
    (encoded('.bmp'), 'unknown_encoding'),
    (encoded('.png')[:-300], 'undecodable'),
    (encoded('.jpg')[:-300], 'undecodable'),
    (b'\xff\xd8\xff\xd9', 'undecodable'),
    (huge_png(), 'too_large'),
    (huge_jpeg(), 'too_large'),
    (encoded('.png')[:60] + bytes(300) + encoded('.png')[360:], 'undecodable'),
])
def test_a_broken_compressed_image_has_a_reason(data, expected):
    assert reason(compressed(data)) == expected


def test_compressed_depth_is_no_image():
    message = compressed(bytes(12) + encoded('.png'), '16UC1; compressedDepth png')
    assert reason(message) == 'unknown_encoding'


@settings(max_examples=150, deadline=None)
@given(extension=st.sampled_from(['.jpg', '.png']), at=st.integers(0, 2000),
       put=st.binary(min_size=1, max_size=4))
def test_flipped_bytes_raise_nothing_but_a_reason(extension, at, put):
    data = bytearray(encoded(extension))
    at %= len(data)
    data[at:at + len(put)] = put
    with contextlib.suppress(BadMessage):
        gray_image(compressed(bytes(data)))


def with_png_chunk_length(kind, length):
    data = encoded('.png')
    at = data.index(kind)
    return data[:at - 4] + struct.pack('>I', length) + data[at:]


@pytest.mark.parametrize('kind', [b'IDAT', b'IEND'])
@pytest.mark.parametrize('length', [2**32 - 1, 2**31 - 1, 400_000_000])
def test_a_png_chunk_that_declares_more_than_there_is_is_not_decoded(kind, length):
    # OpenCV would first allocate gigabytes, for seconds.
    assert reason(compressed(with_png_chunk_length(kind, length))) == 'undecodable'


def test_a_jpeg_of_very_many_scans_is_not_decoded():
    data = cv2.imencode('.jpg', GRAY, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    last = data[data.rindex(b'\xff\xda'):-2]
    assert gray_image(compressed(data)).shape == GRAY.shape
    assert reason(compressed(data[:-2] + last * 100 + data[-2:])) == 'undecodable'
