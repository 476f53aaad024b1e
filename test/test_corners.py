"""Corners are evenly distributed, real and sub-pixel, on any image."""

import cv2
from djet_ros.core.corners import (
    corner_slopes,
    detect_corners,
    detect_large_corners,
    image_noise,
    spread_out,
)
from djet_ros.core.hamming import describable
import numpy as np
import pytest
from two_view import textured


@pytest.fixture(scope='module')
def image():
    return textured(np.random.default_rng(80), (400, 300))


def squares(contrast):
    """Return an image of 6 x 4 squares and their 96 corners."""
    image = np.full((300, 400), 100, np.uint8)
    corners = []
    for left in range(40, 340, 50):
        for top in range(40, 240, 50):
            cv2.rectangle(image, (left, top), (left + 24, top + 24), 100 + contrast, -1)
            corners += [(left, top), (left + 24, top), (left, top + 24), (left + 24, top + 24)]
    return image, np.array(corners)


def test_exactly_the_corners_of_squares_are_detected():
    image, corners = squares(100)
    features = detect_corners(image, 2000, 1.0)
    distances = np.linalg.norm(features.points[:, None] - corners, axis=2)
    fine = features.octaves == 0
    assert distances[fine].min(0).max() <= 5
    assert distances.min(1).max() <= 10


def test_a_stair_stepped_edge_has_no_corners():
    image = np.full((300, 400), 60, np.uint8)
    rows, columns = np.mgrid[:300, :400]
    image[columns > 150 + rows // 4] = 180
    features = detect_corners(image, 2000, 1.0)
    # It has where it leaves the image.
    inside = (features.points[:, 1] > 60) & (features.points[:, 1] < 240)
    assert not inside.any()


def noisy(image, sigma):
    noise = np.random.default_rng(3).normal(0, sigma, image.shape)
    return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)


@pytest.mark.parametrize('sigma', [2, 5, 15])
def test_noise_alone_has_no_corners(sigma):
    assert len(detect_corners(noisy(np.full((480, 640), 128.0), sigma), 2000, 1.0)) < 10


def test_corners_are_detected_in_noise_without_false_ones():
    image, corners = squares(100)
    features = detect_corners(noisy(image, 8), 2000, 1.0)
    distances = np.linalg.norm(features.points[:, None] - corners, axis=2)
    assert distances.min(0).max() <= 10
    assert (distances.min(1) <= 10).mean() > 0.97


@pytest.mark.parametrize('sigma', [2, 5, 15])
def test_noise_is_estimated_from_flat_blocks(image, sigma):
    image = np.tile(image, (2, 2))
    image[:, :300] = 90
    assert image_noise(noisy(image, sigma)) == pytest.approx(sigma, rel=0.2)
    assert image_noise(image) == 0


def test_slopes_are_in_gray_levels_per_pixel():
    rows, columns = np.mgrid[:60, :60]
    # The gradient is 3 along x and 4 along y, in alternating quarters of the image.
    saw = np.where((rows // 2 + columns // 2) % 2 == 0, 3 * columns, 4 * rows) % 200
    assert corner_slopes(saw.astype(np.uint8))[0].max() > 1
    ramp = (3 * columns).astype(np.uint8)
    slopes, steepness = corner_slopes(ramp)
    assert slopes[5:25, 5:25].max() == 0
    np.testing.assert_allclose(steepness[5:25, 5:25], 3**2)


def test_points_have_room_for_a_descriptor(image):
    features = detect_corners(image, 2000, 1.0)
    assert len(features) > 200
    fine = np.rint(features.points[features.octaves == 0]).astype(int)
    assert describable(fine, image.shape).all()
    assert not features.angles.any()
    assert (features.responses >= 1.0).all()


def test_middle_octave_is_detected_on_demand(image):
    features = detect_corners(image, 100, 1.0)
    assert set(features.octaves) == {0, 2}
    every = features.with_additional
    assert np.bincount(every.octaves).tolist() == [70, 25, 18]
    assert every.descriptors.shape == (113, 32)
    assert np.array_equal(every.descriptors[:88], features.descriptors)


def test_all_octaves_are_detected_at_once_if_corners_are_few():
    features = detect_corners(squares(100)[0], 2000, 1.0)
    assert set(features.octaves) == {0, 1, 2}
    assert features.with_additional is features


def test_only_large_corners_are_detected_if_they_are_many(image):
    features = detect_large_corners(image, 50, 1.0)
    assert set(features.octaves) == {2}
    assert 0.6 * 50 <= len(features) <= 50
    assert np.array_equal(features.points, detect_large_corners(image, 50, 1.0).points)


def test_small_corners_are_added_if_large_ones_are_few():
    image, corners = squares(100)
    features = detect_large_corners(image, 400, 1.0)
    assert set(features.octaves) == {0, 2}
    distances = np.linalg.norm(features.points[:, None] - corners, axis=2)
    assert distances[features.octaves == 0].min(0).max() <= 5
    assert len(features) <= 400


def test_points_move_with_the_image_to_sub_pixel_accuracy(image):
    by = np.array([0.3, -0.4])
    moved = cv2.warpAffine(image, np.column_stack([np.eye(2), by]), image.shape[::-1],
                           flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    one, other = (detect_corners(seen, 2000, 1.0) for seen in (image, moved))
    here, there = (found.points[found.octaves == 0] for found in (one, other))

    def error(here, there):
        apart = there[None] - here[:, None] - by
        length = np.linalg.norm(apart, axis=2)
        nearest = length.argmin(1)
        follows = length.min(1) < 2
        return np.median(np.abs(apart[np.arange(len(here)), nearest][follows]))

    # Slopes are sampled at every second pixel.
    assert error(here, there) < 0.7 * error(*(2 * np.rint((p - 0.5) / 2) for p in (here, there)))


def test_a_weak_corner_is_used_only_without_a_stronger_one():
    image, _ = squares(100)
    image[:, 215:] = np.minimum(image[:, 215:], 112)
    every, some = detect_corners(image, 2000, 0.5), detect_corners(image, 60, 0.5)
    assert (every.points[:, 0] < 210).sum() > 60 >= len(some)
    weak = some.points[:, 0] > 220
    assert some.responses[weak].max() < some.responses[~weak].min()
    assert weak.any()


def test_each_cell_gives_its_strongest_before_any_second():
    points = np.array([(5, 5), (8, 8), (12, 12), (85, 5), (88, 30)])
    strengths = np.array([5, 9, 7, 1, 2], np.float32)
    alike = np.zeros(5, bool)
    assert spread_out(points, strengths, 2, alike).tolist() == [1, 4]
    assert spread_out(points, strengths, 3, alike).tolist() == [1, 2, 4]
    assert spread_out(points, strengths, 9, alike).tolist() == [0, 1, 2, 3, 4]


def test_priority_points_precede_the_strongest_others():
    points = np.array([(5, 5), (8, 8), (12, 12), (85, 5), (88, 30)])
    strengths = np.array([5, 9, 7, 1, 2], np.float32)
    first = np.array([True, False, True, False, False])
    assert spread_out(points, strengths, 1, first).tolist() == [2]
    assert spread_out(points, strengths, 3, first).tolist() == [0, 1, 2]


def test_flat_and_tiny_images_have_no_corners():
    for shape in ((200, 300), (1, 1), (20, 30), (36, 36)):
        features = detect_corners(np.full(shape, 90, np.uint8), 500, 1.0)
        assert len(features) == 0
        assert features.descriptors.shape == (0, 32)


def test_the_same_image_gives_the_same_bytes(image):
    one, other = (detect_corners(image, 500, 1.0) for _ in range(2))
    for name in ('points', 'octaves', 'responses', 'descriptors'):
        assert getattr(one, name).tobytes() == getattr(other, name).tobytes()


def test_slopes_do_not_depend_on_memory_alignment():
    """Some functions of OpenCV round differently for arrays of another alignment."""
    rng = np.random.default_rng(19)
    for _ in range(20):
        noise, seen, held = rng.integers(0, 256, (50, 70), dtype=np.uint8), set(), []
        for size in rng.integers(1, 2000, 20):
            seen.add(np.stack(corner_slopes(noise)).tobytes())
            held.append(np.empty(size))
        assert len(seen) == 1


@pytest.mark.parametrize('rows', [20, 52, 96])
def test_slopes_do_not_depend_on_distant_rows(image, rows):
    for whole, below in zip(corner_slopes(image), corner_slopes(image[2 * rows:])):
        # At a border, gradients use mirrored pixels.
        assert np.array_equal(whole[rows + 2:], below[2:])
        assert below[2:].any()


@pytest.mark.parametrize('quality', [60, 80, 95])
def test_ripples_of_compression_around_edges_are_no_corners(quality):
    """JPEG makes dozens along each side of a bright square, but its corners are found."""
    plain = cv2.GaussianBlur(np.full((400, 400), 110, np.uint8), (0, 0), 1)
    square = np.rint(cv2.boxPoints(((200, 200), (150, 150), 20))).astype(int)
    cv2.fillPoly(plain, [square], 200, cv2.LINE_AA)
    _, data = cv2.imencode('.jpg', plain, [cv2.IMWRITE_JPEG_QUALITY, quality])
    found = detect_corners(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), 500, 1.0)
    distances = np.linalg.norm(found.points[:, None] - square, axis=2)
    assert (distances.min(0) < 4).all()
    assert (distances.min(1) < 12).mean() > 0.8


def test_weak_corners_away_from_edges_are_found():
    """A faint texture covers the left side, a checkerboard a part of the right one."""
    rng = np.random.default_rng(0)
    faint = 110 + 4 * cv2.resize(rng.normal(size=(50, 60)), (600, 500)).clip(-2, 2)
    strong = faint.copy()
    strong[100:400, 330:570] = np.kron(np.indices((10, 8)).sum(0) % 2, np.full((30, 30), 200))
    for image in (faint, strong):
        points = detect_corners(np.rint(image).astype(np.uint8), 2000, 0.3).points
        assert (points[:, 0] < 300).sum() > 60
