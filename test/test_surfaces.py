"""The three residual surfaces, compared with the paper's formulas, summed point by point."""

from __future__ import annotations

import cv2
from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.estimator_config import EstimatorConfig, preset
from djet_ros.core.geometry import patch_warp
from djet_ros.core.hamming import dense_descriptors, smooth
from djet_ros.core.orb_pattern import REACH
from djet_ros.core.paraboloid import indefinite, Paraboloids
from djet_ros.core.surfaces import (
    contrast_ratio,
    contrast_ratios,
    DescriptorSurface,
    PhotometricSurface,
    ReprojectionSurface,
    resolve_indefinite,
)
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from two_view import K, textured

SIZE = (160, 120)


def view(gray, config=None):
    return TwoViewEstimator(config).view(gray, K)


def hills(shift=(0.0, 0.0), size=SIZE):
    """Smooth image (H, W) uint8 of soft hills, moved by a sub-pixel shift (x, y)."""
    rng = np.random.default_rng(31)
    rows, columns = np.mgrid[:size[1], :size[0]].astype(float)
    image = np.full((size[1], size[0]), 128.0)
    for _ in range(12):
        wave, phase = rng.normal(0, 0.16, 2), rng.uniform(0, 2 * np.pi)
        image += 10 * np.sin(wave[0] * (columns - shift[0]) + wave[1] * (rows - shift[1]) + phase)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


@pytest.fixture(scope='module')
def pair():
    rng = np.random.default_rng(32)
    return view(textured(rng, SIZE)), view(textured(rng, SIZE))


@pytest.mark.parametrize(('side', 'sigma'), [(3, 0.0), (5, 1.0), (7, 0.0), (7, 2.0)])
def test_the_descriptor_surface_is_fitted_to_the_hamming_distances_around_the_nearest_pixel(
        pair, side, sigma):
    config = preset('paper', window=side, window_sigma=sigma)
    previous, current = (view(one.gray, config) for one in pair)
    x, y = np.array([[60.4, 50.0], [90.0, 70.6]]), np.array([[64.2, 48.7], [88.0, 66.4]])
    surface = DescriptorSurface(previous, current, x, config)
    fitted = surface.fit_around(y)
    assert fitted.usable.all()
    assert np.array_equal(fitted.centres, [[64, 49], [88, 66]])
    radius = side // 2
    for k, (x_k, y_k) in enumerate([((60, 50), (64, 49)), ((90, 71), (88, 66))]):
        reference = dense_descriptors(previous.smoothed, np.array([x_k]))
        rows, z, roots = [], [], []
        for v2 in range(-radius, radius + 1):
            for v1 in range(-radius, radius + 1):
                there = dense_descriptors(current.smoothed, np.array([y_k]) + np.array([v1, v2]))
                z.append(cv2.norm(reference, there, cv2.NORM_HAMMING))
                rows.append([v1 * v1, v2 * v2, 2 * v1 * v2, 2 * v1, 2 * v2, 1])
                roots.append(np.exp(-(v1 * v1 + v2 * v2) / (4 * sigma**2)) if sigma else 1.0)
        D, root = np.array(rows, float), np.array(roots)
        a11, a22, a12, b1, b2, c = np.linalg.lstsq(D * root[:, None], z * root, rcond=None)[0]
        assert np.allclose(fitted.A[k], [[a11, a12], [a12, a22]], atol=1e-8)
        assert np.allclose(fitted.b[k], [b1, b2], atol=1e-8)
        assert fitted.c[k] == pytest.approx(c, abs=1e-8)


def test_the_reference_point_stays_sub_pixel_though_its_descriptor_is_of_a_whole_pixel(pair):
    x = np.array([[60.4, 50.0], [90.0, 70.6]])
    image = textured(np.random.default_rng(33), SIZE)
    for config, ahead in ((EstimatorConfig(), x - np.rint(x)), (preset('paper'), 0.0)):
        surface = DescriptorSurface(view(image, config), view(image, config), x, config)
        assert np.array_equal(surface.x, x)
        # As in the paper, the sub-pixel part is discarded.
        assert np.allclose(surface.fit_around(x).centres, np.rint(x) + ahead)


def test_references_between_pixels_reduce_the_bias_of_the_minimum():
    """By fractions of a pixel, from which a fit around whole pixels is biased."""
    # Without interpolation, which does not shift with the image.
    still = cv2.GaussianBlur(textured(np.random.default_rng(39), (320, 240)), (0, 0), 1.0)
    shift = np.array([3.375, -1.75])
    moved = cv2.warpAffine(still, np.column_stack([np.eye(2), shift]), (320, 240),
                           flags=cv2.INTER_LANCZOS4)
    before, after = view(still), view(moved)
    x = before.features.points
    x = x[(np.abs(x - (160, 120)) < (110, 70)).all(1)]
    surface = DescriptorSurface(before, after, x, EstimatorConfig())
    errors, y, as_it_was = [], x + np.rint(shift), np.repeat(np.eye(3, 2)[None], len(x), axis=0)
    for warp in (None, as_it_was, as_it_was):
        fitted, _ = resolve_indefinite(surface.fit_around(y, warp), 'project')
        y = np.clip(fitted.minima(), y - 1, y + 1)
        errors.append(np.median(np.linalg.norm(y - x - shift, axis=1)))
    assert errors[2] < 0.7 * errors[0]


def test_a_descriptor_surface_has_its_minimum_at_the_image_shift():
    image = textured(np.random.default_rng(33), SIZE)
    moved = np.roll(image, (1, -2), axis=(0, 1))  # one down, two to the left
    grid = np.stack(np.meshgrid(np.arange(30, 130, 10), np.arange(30, 90, 10)), -1)
    x = grid.reshape(-1, 2).astype(float)
    shift = np.array([-2, 1])
    surface = DescriptorSurface(view(image), view(moved), x, EstimatorConfig())
    y = x + shift + (1, -1)  # started next to the minimum, the window follows it
    for _ in range(3):
        fitted, _ = resolve_indefinite(surface.fit_around(y), 'project')
        y = np.clip(fitted.minima(), y - 1, y + 1)
    assert np.median(np.linalg.norm(y - x - shift, axis=1)) < 0.25


@pytest.mark.parametrize('warped', [False, True])
def test_a_reused_descriptor_surface_equals_a_new_one(pair, warped):
    rng = np.random.default_rng(34)
    x = rng.uniform((40, 40), np.subtract(SIZE, 40), (30, 2))
    warp = np.repeat([np.diag([1.1, 0.95, 0])[:, :2]], 30, axis=0) if warped else None
    surface = DescriptorSurface(*pair, x, EstimatorConfig())
    y = x.copy()
    surface.fit_around(y)
    for _ in range(4):
        y = y + rng.normal(0, 1.0, y.shape) * (rng.uniform(size=(30, 1)) < 0.5)
        asked = surface.fit_around(y, warp)
        new = DescriptorSurface(*pair, x, EstimatorConfig())
        new.fit_around(x)  # the contrast is measured where matches are first seen
        fresh = new.fit_around(y, warp)
        for name in ('centres', 'A', 'b', 'c', 'usable'):
            assert np.allclose(getattr(asked, name), getattr(fresh, name), 1e-9), name


@pytest.mark.parametrize('warp', [np.diag([1.1, 0.95, 0])[:, :2], np.eye(3, 2)],
                         ids=['stretched', 'as it is'])
@pytest.mark.parametrize('kind', [DescriptorSurface, PhotometricSurface])
def test_a_surface_without_a_warp_ignores_earlier_warps(
        pair, kind, warp):
    x = np.random.default_rng(37).uniform((40, 40), np.subtract(SIZE, 40), (30, 2))
    asked, new = (kind(*pair, x, EstimatorConfig()) for _ in range(2))
    asked.fit_around(x, np.repeat(warp[None], len(x), axis=0))
    again, first = asked.fit_around(x), new.fit_around(x)
    for name in ('centres', 'A', 'b', 'c', 'usable'):
        assert np.array_equal(getattr(again, name), getattr(first, name)), name


WARPS = {'smaller': 0.85 * np.eye(2), 'larger': 1.2 * np.eye(2),
         'turned': Rotation.from_euler('z', 8, degrees=True).as_matrix()[:2, :2],
         'seen aslant': np.array([[1.15, 0.05], [0.0, 0.95]])}


def warped(warp):
    """Return a wall, the wall seen through a warp, and where its points (N, 2) went."""
    image = textured(np.random.default_rng(38), (320, 240))
    middle = np.array([160.0, 120.0])
    M = np.column_stack([warp, middle - warp @ middle])
    grid = np.stack(np.meshgrid(np.arange(70, 250, 9), np.arange(70, 170, 9)), -1)
    x = grid.reshape(-1, 2).astype(float)
    seen = cv2.warpAffine(image, M, (320, 240), flags=cv2.INTER_CUBIC)
    warps = np.repeat([np.vstack([warp, np.zeros(2)])], len(x), axis=0)
    return view(image), view(seen), x, ((x - middle) @ warp.T + middle, warps)


@pytest.mark.parametrize('name', WARPS)
def test_warped_references_reduce_the_error_of_minima(name):
    previous, current, x, (y, warps) = warped(WARPS[name])
    errors = {}
    for warp in (None, warps):
        surface = DescriptorSurface(previous, current, x, EstimatorConfig())
        fitted, _ = resolve_indefinite(surface.fit_around(y, warp), 'project')
        errors[warp is None] = np.median(np.linalg.norm(fitted.minima() - y, axis=1))
    assert errors[False] < 0.7 * errors[True]


@pytest.mark.parametrize('kind', [DescriptorSurface, PhotometricSurface])
@pytest.mark.parametrize('name', WARPS)
def test_warped_references_reduce_the_residual(kind, name):
    previous, current, x, (y, warps) = warped(WARPS[name])
    plain, seen = (np.median(kind(previous, current, x, EstimatorConfig()).fit_around(y, warp).c)
                   for warp in (None, warps))
    assert seen < plain


@pytest.mark.parametrize('turn', [(0.0, 0.3, 0.0), (0.2, -0.2, 0.1)])
def test_after_a_large_rotation_minima_are_biased_unless_warps_are_projective(turn):
    camera = np.array([[400.0, 0, 320], [0, 400, 240], [0, 0, 1]])
    R = Rotation.from_rotvec(turn).as_matrix()
    H = camera @ R @ np.linalg.inv(camera)
    off = {'perspective': [], 'derivatives alone': []}
    for seed in range(4):
        image = textured(np.random.default_rng(seed), (640, 480))
        turned = cv2.warpPerspective(image, H, (640, 480), flags=cv2.INTER_CUBIC)
        there = np.random.default_rng(seed).uniform((40, 40), (600, 440), (2000, 2))
        here = cv2.perspectiveTransform(there[None], H)[0]
        both = ((here > 40) & (here < (600, 440))).all(1)
        x, y = there[both], here[both]
        # Far points: their depth changes by rotation alone.
        grown = 1 / (np.column_stack([x, np.ones(len(x))]) @ H[2])
        for name, rows in zip(off, (1, 0)):
            warp = patch_warp(camera, R, y, grown) * [[1], [1], [rows]]
            fits = DescriptorSurface(view(image), view(turned), x, EstimatorConfig()).fit_around(
                y, warp)
            off[name].append(np.median((fits.minima() - y)[fits.usable], axis=0))
    together = {name: np.linalg.norm(np.mean(means, axis=0)) for name, means in off.items()}
    assert together['perspective'] < 0.25 * together['derivatives alone']


def test_the_identity_warp_changes_nothing_on_whole_pixels(pair):
    x = np.array([[60.0, 50.0], [90.0, 71.0]])
    config = EstimatorConfig(window=3, grading=0.0)
    pair = [view(one.gray, config) for one in pair]
    plain, same = (DescriptorSurface(*pair, x, config).fit_around(x + 2.0, warp)
                   for warp in (None, np.repeat(np.eye(3, 2)[None], 2, axis=0)))
    assert np.array_equal(plain.A, same.A) and np.array_equal(plain.c, same.c)


@pytest.mark.parametrize('side', [3, 7])
def test_points_without_descriptors_at_the_border_have_no_surface(pair, side):
    margin, (width, height) = REACH + side // 2, SIZE  # of the whole pattern
    x, y = np.full((8, 2), 60.0), np.full((8, 2), 60.0)
    y[1], y[2] = (margin, margin), (margin - 1, 60)
    y[3], y[4] = (width - 1 - margin, height - 1 - margin), (60, height - margin)
    y[5] = (-1e4, 1e4)
    x[6], x[7] = (REACH, height - 1 - REACH), (REACH - 1, 60)
    config = EstimatorConfig(window=side, patch_scale=1.0)
    surface = DescriptorSurface(*(view(one.gray, config) for one in pair), x, config)
    fitted = surface.fit_around(y)
    assert fitted.usable.tolist() == [True, True, False, True, False, False, True, False]
    assert np.array_equal(fitted.centres, y)


def bilinear(image, x, y):
    column, row = int(np.floor(x)), int(np.floor(y))
    f, g = x - column, y - row
    return ((1 - f) * (1 - g) * image[row, column] + f * (1 - g) * image[row, column + 1]
            + (1 - f) * g * image[row + 1, column] + f * g * image[row + 1, column + 1])


def gradient(image, x, y):
    """Evaluate Scharr's derivatives per pixel, between pixels by interpolation."""
    smooth_3, slope = np.array([3, 10, 3]) / 16, np.array([-1, 0, 1]) / 2
    gx = cv2.filter2D(image, -1, np.outer(smooth_3, slope), borderType=cv2.BORDER_REFLECT_101)
    gy = cv2.filter2D(image, -1, np.outer(slope, smooth_3), borderType=cv2.BORDER_REFLECT_101)
    return np.array([bilinear(gx, x, y), bilinear(gy, x, y)])


@pytest.mark.parametrize(('side', 'sigma'), [(5, 0.0), (7, 1.5)])
def test_the_photometric_surface_is_the_papers_lucas_kanade_sums(pair, side, sigma):
    """Of the intensities that ORB's tests see, too: the smoothed image."""
    previous, current = pair
    x = np.array([[60.0, 50.0], [90.3, 70.62], [33.141, 88.007]])
    y = np.array([[64.0, 49.0], [88.47, 66.81], [41.99, 77.53]])
    config = EstimatorConfig(method='pjet', window=side, window_sigma=sigma)
    fitted = PhotometricSurface(previous, current, x, config).fit_around(y)
    assert fitted.usable.all() and np.array_equal(fitted.centres, y)
    I_A, I_B = previous.smoothed.astype(float), current.smoothed.astype(float)
    radius = side // 2
    for k in range(3):
        A, b, c = np.zeros((2, 2)), np.zeros(2), 0.0
        for v2 in range(-radius, radius + 1):
            for v1 in range(-radius, radius + 1):
                W = np.exp(-(v1 * v1 + v2 * v2) / (2 * sigma**2)) if sigma else 1.0
                difference = (bilinear(I_A, x[k, 0] + v1, x[k, 1] + v2)
                              - bilinear(I_B, y[k, 0] + v1, y[k, 1] + v2))
                slope = gradient(I_B, y[k, 0] + v1, y[k, 1] + v2)
                A += W * np.outer(slope, slope)
                b -= W * slope * difference
                c += W * difference**2
        assert np.allclose(fitted.A[k], A, rtol=1e-3)
        assert np.allclose(fitted.b[k], b, rtol=1e-3, atol=1e-3 * np.abs(b).max())
        assert fitted.c[k] == pytest.approx(c, rel=1e-3)


@pytest.mark.parametrize('shift', [(0.3, -0.2), (-0.85, 0.6), (1.4, 1.1)])
def test_the_minimum_of_the_photometric_surface_is_the_shift_of_a_smooth_image(shift):
    x = np.random.default_rng(35).uniform(25, 90, (40, 2))
    surface = PhotometricSurface(view(hills()), view(hills(shift)), x,
                                 EstimatorConfig(method='pjet', window=15, window_sigma=0.0))
    y = x
    for _ in range(4):
        y = surface.fit_around(y).minima()
    errors = np.linalg.norm(y - x - shift, axis=1)
    assert np.median(errors) < 0.02
    assert errors.max() < 0.15


def test_the_photometric_surface_needs_its_windows_inside_both_images(pair):
    width, height = SIZE
    inside = [(5, 5), (width - 6, height - 6), (60, 60)]
    outside = [(2, 60), (60, height - 3), (width - 4.5, 60), (-3, -3)]
    config = EstimatorConfig(method='pjet', window=7)
    places = np.array(inside + outside, float)
    middle = np.full_like(places, 60.0)
    expected = [True] * 3 + [False] * 4
    assert PhotometricSurface(*pair, middle, config).fit_around(places).usable.tolist() == expected
    assert PhotometricSurface(*pair, places, config).fit_around(middle).usable.tolist() == expected


def test_the_reprojection_surface_is_the_squared_distance_to_the_observed_point():
    rng = np.random.default_rng(36)
    x, y, keypoints, places = rng.uniform(0, 500, (4, 25, 2))
    surface = ReprojectionSurface(x, y)
    for fitted in (surface.fit_around(y), surface.fit_around(keypoints)):
        assert np.allclose(fitted.values(places), ((places - y)**2).sum(1))
        assert np.allclose(fitted.minima(), y)
        assert fitted.usable.all()
    assert np.array_equal(surface.x, x)


@pytest.mark.parametrize('policy', ['project', 'drop', 'keep'])
def test_surfaces_without_a_minimum_are_counted_and_treated_by_policy(policy):
    A = np.array([np.eye(2), -np.eye(2), np.diag([2.0, -1.0]), np.diag([3.0, 1.0]),
                  np.diag([1.0, -1.0])])
    usable = np.array([True, True, True, True, False])  # the last one is out already
    before = Paraboloids(np.zeros((5, 2)), A, np.ones((5, 2)), np.arange(5.0), usable)
    after, count = resolve_indefinite(before, policy)
    assert count == 2
    assert np.array_equal(after.b, before.b) and np.array_equal(after.c, before.c)
    if policy == 'project':
        assert not indefinite(after).any()
        assert np.allclose(after.A[[0, 3]], A[[0, 3]])
    else:
        assert np.array_equal(after.A, A)
    dropped = [True, False, False, True, False] if policy == 'drop' else usable.tolist()
    assert after.usable.tolist() == dropped


def test_views_carry_the_smoothed_image_that_orb_tests():
    gray = textured(np.random.default_rng(37), SIZE)
    assert np.array_equal(view(gray).smoothed, smooth(gray))


@pytest.mark.parametrize('kind', [DescriptorSurface, PhotometricSurface])
def test_in_an_image_smaller_than_a_window_no_point_has_a_surface(pair, kind):
    tiny = view(np.full((9, 9), 7, np.uint8))
    points = np.array([[4.0, 4.0], [70.0, 60.0]])
    for previous, current in ((tiny, tiny), (pair[0], tiny), (tiny, pair[0])):
        surface = kind(previous, current, points, EstimatorConfig(window=15))
        assert not surface.fit_around(points).usable.any()


def test_contrast_ratios_of_several_images_are_those_of_each():
    here, there = np.random.default_rng(2).lognormal(sigma=2, size=(2, 18))
    counts = np.array([1, 4, 2, 11])
    parts = zip(*(np.split(strengths, np.cumsum(counts)[:-1]) for strengths in (here, there)))
    each = [contrast_ratio(*part) for part in parts]
    np.testing.assert_array_equal(contrast_ratios(here, there, counts), np.repeat(each, counts))
