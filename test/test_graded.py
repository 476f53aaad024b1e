"""Graded tests, compared with a sum over tests and pixels, and with the Hamming distance."""

from __future__ import annotations

from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.estimator_config import EstimatorConfig, preset
from djet_ros.core.graded import graded_surfaces, grades, smooth_finely
from djet_ros.core.hamming import descriptor_bits, hamming_surfaces, intensities, smooth
from djet_ros.core.orb_pattern import pattern, REACH, TESTS
from djet_ros.core.surfaces import DescriptorSurface, resolve_indefinite
import numpy as np
import pytest
from two_view import K, textured

SIZE = (160, 120)


def smoothed(seed):
    return smooth_finely(textured(np.random.default_rng(seed), SIZE))


@pytest.mark.parametrize('grading', [2.0, 24.0, 120.0])
@pytest.mark.parametrize(('count', 'scale'), [(16, 1.0), (100, 0.6), (256, 1.0)])
def test_surfaces_are_the_sum_over_tests_at_each_pixel(grading, count, scale):
    tests = pattern(count, scale)
    image_a, image_b = smoothed(70), smoothed(71)
    x, y = np.array([[60, 50], [90, 61]]), np.array([[62, 49], [88, 60]])
    reference = grades(*intensities(image_a, x, tests), grading)
    surfaces = graded_surfaces(reference, image_b, y, 2, grading, tests)

    def graded(image, place, test):
        levels = [image[place[1] + test[i + 1], place[0] + test[i]] / 4 for i in (0, 2)]
        return np.clip(levels[1] - levels[0], -grading, grading)

    for k in range(2):
        for v_y in range(-2, 3):
            for v_x in range(-2, 3):
                expected = sum(abs(graded(image_a, x[k], test)
                                   - graded(image_b, y[k] + (v_x, v_y), test))
                               for test in tests) / (2 * grading)
                assert surfaces[v_y + 2, v_x + 2, k] == pytest.approx(expected, rel=1e-6)


def test_with_saturated_tests_the_distance_is_the_hamming_distance():
    # With two levels a test is decided or undecided; undecided ones are 0 here and a bit there.
    rng = np.random.default_rng(72)
    image = np.where(rng.uniform(size=SIZE[::-1]) < 0.5, 0, 1020).astype(np.int16)
    x, y = np.array([[60, 50]]), np.array([[62, 49]])
    p, q = intensities(image, x)
    decided = (p != q)[:, 0]
    found = graded_surfaces(grades(p, q, 24.0), image, y, 0, 24.0)[0, 0, 0]
    there = intensities(image, y)
    both = decided & (there[0] != there[1])[:, 0]
    bits = np.abs((p < q)[:, 0].astype(int) - (there[0] < there[1])[:, 0])
    assert found == bits[both].sum() + 0.5 * (decided != (there[0] != there[1])[:, 0]).sum()


def test_many_points_give_the_same_as_one_at_a_time():
    rng = np.random.default_rng(73)
    image_a, image_b = smoothed(74), smoothed(75)
    points = rng.integers(REACH + 2, np.subtract(SIZE, REACH + 2), (5000, 2))
    reference = grades(*intensities(image_a, points, TESTS[:128]), 24.0)
    together = graded_surfaces(reference, image_b, points, 2, 24.0, TESTS[:128])
    for k in (0, 2047, 2048, 4999):
        alone = graded_surfaces(reference[:, k:k + 1], image_b, points[k:k + 1], 2, 24.0,
                                TESTS[:128])
        assert np.array_equal(together[:, :, k], alone[:, :, 0])
    assert graded_surfaces(reference[:, :0], image_b, points[:0], 2, 24.0,
                           TESTS[:128]).shape == (5, 5, 0)


def test_without_grading_all_of_orbs_bits_are_compared():
    image_a, image_b = (textured(np.random.default_rng(seed), SIZE) for seed in (76, 77))
    config = preset('paper', window=3)
    estimator = TwoViewEstimator(config)
    views = [estimator.view(image, K) for image in (image_a, image_b)]
    x = np.array([[60.0, 50.0], [90.0, 61.0]])
    fitted = DescriptorSurface(*views, x, config).fit_around(x)
    pixels = x.astype(int)
    samples = hamming_surfaces(descriptor_bits(views[0].smoothed, pixels), views[1].smoothed,
                               pixels, 1).reshape(9, 2)
    # The mean of a quadratic over 3x3 pixels is c plus two thirds of the trace of A'.
    means = fitted.c + 2 / 3 * np.trace(fitted.A, axis1=1, axis2=2)
    assert np.allclose(means, samples.mean(0))


@pytest.mark.parametrize('noise', [2.0, 6.0])
def test_graded_tests_are_more_accurate_in_noise_than_bits(noise):
    rng = np.random.default_rng(78)
    clean = textured(rng, (320, 240))
    images = [np.clip(clean + rng.normal(0, noise, clean.shape), 0, 255).astype(np.uint8)
              for _ in range(2)]
    grid = np.stack(np.meshgrid(np.arange(40, 280, 7), np.arange(40, 200, 7)), -1)
    x = grid.reshape(-1, 2).astype(float)
    errors = {}
    for grading, count in ((24.0, 128), (0.0, 256)):
        config = EstimatorConfig(grading=grading, binary_tests=count)
        views = [TwoViewEstimator(config).view(image, K) for image in images]
        surface = DescriptorSurface(*views, x, config)
        fitted, _ = resolve_indefinite(surface.fit_around(x), 'project')
        errors[grading] = np.median(np.linalg.norm(fitted.minima() - x, axis=1))
    assert errors[24.0] < 0.8 * errors[0.0]


@pytest.mark.parametrize('exposure', [0.4, 1.6])
def test_a_change_of_exposure_changes_neither_minima_nor_residuals(exposure):
    rng = np.random.default_rng(79)
    dim = 70 + 0.3 * (textured(rng, (320, 240)).astype(float) - 128)
    estimator = TwoViewEstimator()
    before, same, after = (estimator.view(np.clip(
        gain * dim + rng.normal(0, 0.5, dim.shape), 0, 255).astype(np.uint8), K)
        for gain in (1.0, 1.0, exposure))
    grid = np.stack(np.meshgrid(np.arange(40, 280, 7), np.arange(40, 200, 7)), -1)
    x = grid.reshape(-1, 2).astype(float)
    left, errors = {}, {}
    for name, view in (('same', same), ('after', after)):
        fitted, _ = resolve_indefinite(
            DescriptorSurface(before, view, x, EstimatorConfig()).fit_around(x), 'project')
        left[name] = np.median(fitted.c / np.maximum(np.trace(fitted.A, axis1=1, axis2=2), 1e-9))
        errors[name] = np.median(np.linalg.norm(fitted.minima() - x, axis=1))
    # Less light has fewer gray levels, so that noise has more effect.
    assert errors['after'] < 2.5 * errors['same']
    assert left['after'] < 2.5 * left['same']


def test_fine_smoothing_is_orbs_to_a_quarter_of_a_gray_level():
    image = textured(np.random.default_rng(76), SIZE)
    fine = smooth_finely(image)
    assert fine.dtype == np.int16 and fine.max() <= 4 * 255
    assert np.abs(fine / 4 - smooth(image)).max() <= 0.75
    assert len(np.unique(fine % 4)) == 4
