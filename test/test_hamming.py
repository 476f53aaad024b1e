"""Dense descriptors and Hamming surfaces, against cv2.ORB and a count of bits pixel by pixel."""

from __future__ import annotations

from pathlib import Path

import cv2
from djet_ros.core.hamming import (
    dense_descriptors,
    describable,
    descriptor_bits,
    hamming_surfaces,
    intensities,
    match_distances,
    smooth,
    warped_intensities,
)
from djet_ros.core.orb_pattern import REACH, TESTS
import numpy as np
import pytest
from two_view import textured

SIZE = (160, 120)


def pictures():
    """Noise, something like a photograph, and the extremes of contrast."""
    rng = np.random.default_rng(11)
    noise = rng.integers(0, 256, SIZE[::-1], dtype=np.uint8)
    return {'noise': noise, 'textured': textured(rng, SIZE), 'dim': noise // 100,
            'black and white': np.where(textured(rng, SIZE) > 128, 255, 0).astype(np.uint8)}


def all_describable(shape):
    height, width = shape
    rows, columns = np.mgrid[REACH:height - REACH, REACH:width - REACH].reshape(2, -1)
    return np.stack([columns, rows], axis=1)


def orb_descriptors(image, points):
    """cv2.ORB's own descriptors at whole pixels, unrotated and on pyramid level 0."""
    orb = cv2.ORB.create(nlevels=1, edgeThreshold=REACH)
    keypoints = [cv2.KeyPoint(float(x), float(y), 31.0, 0.0) for x, y in points]
    kept, descriptors = orb.compute(image, keypoints)
    assert len(kept) == len(points)
    return descriptors


def bits_apart(a, b):
    """Hamming distance of two packed descriptors by Python's own integers."""
    return (int.from_bytes(a.tobytes(), 'big') ^ int.from_bytes(b.tobytes(), 'big')).bit_count()


@pytest.mark.parametrize('name', pictures())
def test_dense_descriptors_are_those_of_orb_with_angle_zero_bit_for_bit(name):
    image = pictures()[name]
    points = all_describable(image.shape)
    assert np.array_equal(dense_descriptors(smooth(image), points), orb_descriptors(image, points))


def test_dense_descriptors_of_a_real_frame_are_those_of_orb_bit_for_bit(kitti: Path):
    image = cv2.imread(str(kitti / 'sequences/06/image_0/000000.png'), cv2.IMREAD_GRAYSCALE)
    points = all_describable(image.shape)[::23]
    assert np.array_equal(dense_descriptors(smooth(image), points), orb_descriptors(image, points))


def test_bits_are_packed_lowest_first():
    smoothed = smooth(pictures()['textured'])
    points = np.array([[40, 50], [90, 60]])
    bits, packed = descriptor_bits(smoothed, points), dense_descriptors(smoothed, points)
    for i in (0, 1, 7, 8, 255):
        assert np.array_equal(bits[i], packed[:, i // 8] >> (i % 8) & 1)


@pytest.mark.parametrize('radius', [1, 2, 3, 7])
def test_hamming_surfaces_count_the_bits_that_differ_pixel_by_pixel(radius):
    rng = np.random.default_rng(12)
    image_a, image_b = smooth(textured(rng, SIZE)), smooth(textured(rng, SIZE))
    margin = REACH + radius
    x = rng.integers(REACH, np.subtract(SIZE, REACH), (15, 2))
    y = rng.integers(margin, np.subtract(SIZE, margin), (15, 2))
    y[0], y[1] = (margin, margin), np.subtract(SIZE, margin + 1)
    surfaces = hamming_surfaces(descriptor_bits(image_a, x), image_b, y, radius)
    assert surfaces.shape == (2 * radius + 1, 2 * radius + 1, 15)
    reference = dense_descriptors(image_a, x)
    for v_y in range(-radius, radius + 1):
        for v_x in range(-radius, radius + 1):
            there = dense_descriptors(image_b, y + np.array([v_x, v_y]))
            expected = [bits_apart(a, b) for a, b in zip(reference, there)]
            assert surfaces[v_y + radius, v_x + radius].tolist() == expected


def test_a_descriptor_has_distance_zero_to_itself_also_in_a_shifted_image():
    image = textured(np.random.default_rng(13), SIZE)
    moved = np.roll(image, (2, -1), axis=(0, 1))  # two down, one to the left
    points = np.array([[60, 50], [80, 70], [100, 40]])
    surfaces = hamming_surfaces(descriptor_bits(smooth(image), points), smooth(moved), points, 3)
    assert (surfaces[3 + 2, 3 - 1] == 0).all()
    assert ((surfaces == 0).sum((0, 1)) == 1).all()


def test_the_greatest_distance_of_256_does_not_overflow():
    # a ramp on which the two pixels of every test differ, and its negative: so does every bit
    rows, columns = np.mgrid[:41, :41]
    ramp = (2 * columns + 3 * rows).astype(np.uint8)
    assert ((TESTS[:, :2] - TESTS[:, 2:]) @ (2, 3) != 0).all()
    centre = np.array([[20, 20]])
    surfaces = hamming_surfaces(descriptor_bits(ramp, centre), 255 - ramp, centre, 7)
    assert (surfaces == 256).all()


def test_many_points_give_the_same_as_one_at_a_time():
    rng = np.random.default_rng(14)
    image_a, image_b = smooth(textured(rng, SIZE)), smooth(textured(rng, SIZE))
    points = rng.integers(REACH + 2, np.subtract(SIZE, REACH + 2), (5000, 2))
    bits = descriptor_bits(image_a, points)
    together = hamming_surfaces(bits, image_b, points, 2)
    for k in (0, 2047, 2048, 4095, 4096, 4999):
        alone = hamming_surfaces(bits[:, k:k + 1], image_b, points[k:k + 1], 2)
        assert np.array_equal(together[:, :, k], alone[:, :, 0])


def test_few_points_give_the_same_as_many():
    rng = np.random.default_rng(3)
    image = rng.integers(0, 256, (120, 160), np.uint8)
    points = rng.integers(20, 100, (200, 2))
    for one, other in zip(intensities(image, points[:9]), intensities(image, points)):
        assert np.array_equal(one, other[:, :9])


def test_warped_patches_of_two_images_in_one_pass_equal_those_of_each():
    rng = np.random.default_rng(5)
    images = rng.integers(0, 256, (2, 120, 160), np.uint8)
    points, warps = rng.uniform(20, 100, (700, 2)), np.tile(1.1 * np.eye(3, 2), (700, 1, 1))
    together = warped_intensities(warps, [(images[0], 300), (images[1], 400)], points)
    for image, some in zip(images, (slice(0, 300), slice(300, 700))):
        alone = warped_intensities(warps[some], [(image, len(points[some]))], points[some])
        for one, other in zip(alone, together):
            np.testing.assert_allclose(other[:, some], one, atol=1e-3)


def test_a_warped_patch_is_sampled_at_the_inverse_warp():
    smoothed = smooth(pictures()['textured'])
    points = np.array([[60, 50], [90, 60], [70, 70], [80, 66]])
    warps = np.array([np.eye(3, 2), 1.25 * np.eye(3, 2), [[0.9, 0.2], [-0.1, 1.1], [0, 0]],
                      [[0.9, 0.2], [-0.1, 1.1], [0.01, -0.006]]])
    bits = np.less(*warped_intensities(warps, [(smoothed, len(points))], points))
    assert np.array_equal(bits[:, :1], descriptor_bits(smoothed, points[:1]))

    def between(x, y):
        column, row = int(np.floor(x)), int(np.floor(y))
        corner = smoothed[row:row + 2, column:column + 2].astype(float)
        return np.array([1 - (y - row), y - row]) @ corner @ np.array([1 - (x - column),
                                                                      x - column])

    def back(warp, dy):
        dx = np.linalg.solve(warp[:2] - np.outer(dy, warp[2]), dy)
        assert np.allclose(warp[:2] @ dx / (1 + warp[2] @ dx), dy)
        return dx

    for k in (1, 2, 3):
        for test, bit in zip(TESTS, bits[:, k]):
            p, q = (between(*(points[k] + back(warps[k], test[i:i + 2]))) for i in (0, 2))
            # OpenCV rounds intensities to whole gray levels
            assert bit == (p < q) or abs(p - q) < 1.5


def test_no_points_have_no_descriptors():
    smoothed, nowhere = smooth(pictures()['noise']), np.empty((0, 2), np.int64)
    assert dense_descriptors(smoothed, nowhere).shape == (0, 32)
    surfaces = hamming_surfaces(descriptor_bits(smoothed, nowhere), smoothed, nowhere, 2)
    assert surfaces.shape == (5, 5, 0)


@pytest.mark.parametrize('radius', [0, 3])
def test_describable_means_that_every_test_in_the_window_reads_inside_the_image(radius):
    rows, columns = np.mgrid[-5:65, -5:75].reshape(2, -1)
    points, size = np.stack([columns, rows], axis=1), (70, 60)
    ends = np.concatenate([TESTS[:, :2], TESTS[:, 2:]])

    def inside(spare):
        low, high = points + ends.min(0) - radius - spare, points + ends.max(0) + radius + spare
        return ((low >= 0) & (high < size)).all(1)

    described = describable(points, size[::-1], radius)
    assert (inside(0) | ~described).all()
    assert (described | ~inside(1)).all()  # and no more than a pixel is given away


@pytest.mark.parametrize('point', [(REACH - 1, 60), (60, REACH - 1), (SIZE[0] - REACH, 60),
                                   (60, SIZE[1] - REACH), (-30, 60), (60, 10**6)])
def test_a_point_too_near_to_the_border_is_refused_by_name(point):
    smoothed = smooth(pictures()['noise'])
    points = np.array([(80, 60), point])
    with pytest.raises(ValueError, match=rf'1 points, the first at \[\s*{point[0]}\s+{point[1]}'):
        descriptor_bits(smoothed, points)
    with pytest.raises(ValueError, match='border'):
        hamming_surfaces(np.zeros((256, 2), bool), smoothed, points, 0)


def test_match_distances_are_taken_at_the_nearest_pixels_and_unknown_near_the_border():
    rng = np.random.default_rng(15)
    image_a, image_b = smooth(textured(rng, SIZE)), smooth(textured(rng, SIZE))
    x = np.array([[50.4, 60.6], [99.7, 40.2], [80.0, 60.0], [REACH - 0.6, 60], [70.0, 70.0]])
    y = np.array([[70.2, 55.1], [30.4, 80.0], [2.0, 60.0], [80.0, 60.0], [1e6, -1e6]])
    distances = match_distances(image_a, x, image_b, y)
    a = dense_descriptors(image_a, np.array([[50, 61], [100, 40]]))
    b = dense_descriptors(image_b, np.array([[70, 55], [30, 80]]))
    assert distances[:2].tolist() == [bits_apart(*pair) for pair in zip(a, b)]
    assert np.isnan(distances[2:]).all()
