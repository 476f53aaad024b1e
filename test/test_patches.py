"""Patch alignment: accurate under any warp and any change of brightness."""

from __future__ import annotations

import cv2
from djet_ros.core.patches import align_patches, templates
import numpy as np
import pytest

SIZE = 400, 300
MIDDLE = np.array([200.0, 150.0])


def texture(points: np.ndarray) -> np.ndarray:
    """Gray levels of a smooth pattern at any places (..., 2): a sum of waves."""
    rng = np.random.default_rng(0)
    directions, phases = rng.normal(size=(40, 2)) * 0.35, rng.uniform(0, 7, 40)
    return 128 + 14 * np.sin(points @ directions.T + phases).sum(-1)


def image(warp: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Return what `texture` looks like where each place x is seen at W (x - middle) + shift."""
    y = np.stack(np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1])), axis=-1).astype(float)
    x = (y - MIDDLE - shift) @ np.linalg.inv(warp).T + MIDDLE
    return np.clip(np.rint(texture(x)), 0, 255).astype(np.uint8)


def seen(warp: np.ndarray, shift: np.ndarray, x: np.ndarray) -> np.ndarray:
    return (x - MIDDLE) @ warp.T + MIDDLE + shift


def as_seen(warp: np.ndarray, count: int) -> np.ndarray:
    """Return the same warp (3, 2) for all points, of depths that are all alike."""
    return np.tile(np.vstack([warp, [0, 0]]), (count, 1, 1))


@pytest.fixture
def points() -> np.ndarray:
    return np.random.default_rng(1).uniform((80, 80), (320, 220), (300, 2))


WARPS = {'none': np.eye(2), 'larger': 1.08 * np.eye(2),
         'a road': np.array([[1.05, 0.1], [0, 1.15]]),
         'a roll': np.array([[0.99, -0.12], [0.12, 0.99]])}


@pytest.mark.parametrize('name', WARPS)
def test_warped_patches_are_aligned_to_a_fiftieth_of_a_pixel(
        points: np.ndarray, name: str) -> None:
    warp, shift = WARPS[name], np.array([3.3, -1.7])
    there, here = image(np.eye(2), np.zeros(2)), image(warp, shift)
    true = seen(warp, shift, points)
    near = true + np.random.default_rng(2).uniform(-0.3, 0.3, true.shape)
    found = align_patches(there, here, points, near, as_seen(warp, len(points))).places
    off = np.linalg.norm(found - true, axis=1)
    assert np.median(off) < 0.02
    assert np.quantile(off, 0.95) < 0.06


def test_templates_of_two_images_in_one_pass_equal_those_of_each(
        points: np.ndarray) -> None:
    images = [image(warp, np.zeros(2)).astype(np.float32)
              for warp in (WARPS['none'], WARPS['a roll'])]
    warps = as_seen(WARPS['larger'], len(points))
    together = templates([(images[0], 100), (images[1], len(points) - 100)], points, warps)
    for there, some in zip(images, (slice(100), slice(100, None))):
        alone = templates([(there, len(points[some]))], points[some], warps[some])
        np.testing.assert_allclose(together.gray[:, some], alone.gray, atol=1e-3)
        np.testing.assert_allclose(together.inverses[some], alone.inverses, rtol=1e-3)


def test_the_flow_is_biased_where_the_image_grows(points: np.ndarray) -> None:
    """What the warp is good for: the same patches, taken to shift as a whole."""
    warp = WARPS['a road']
    there, here = image(np.eye(2), np.zeros(2)), image(warp, np.zeros(2))
    true = seen(warp, np.zeros(2), points)
    as_a_whole = align_patches(there, here, points, true, as_seen(np.eye(2), len(points))).places
    assert np.median(np.linalg.norm(as_a_whole - true, axis=1)) > 0.1


def test_haze_does_not_bias_the_alignment(points: np.ndarray) -> None:
    there = image(np.eye(2), np.zeros(2))
    hazy = (there * 0.8 + 40).astype(np.uint8)
    found = align_patches(there, hazy, points, points, as_seen(np.eye(2), len(points))).places
    assert np.median(np.linalg.norm(found - points, axis=1)) < 0.02


def test_patches_that_would_move_far_or_are_at_the_border_stay(points: np.ndarray) -> None:
    there, here = image(np.eye(2), np.zeros(2)), image(np.eye(2), np.array([4.0, 0.0]))
    eye = as_seen(np.eye(2), len(points))
    found = align_patches(there, here, points, points, eye).places
    assert (np.abs(found - points).max(1) < 1).all()
    border = points * 0 + [3.0, 150.0]
    assert (align_patches(there, here, border, border, eye).places == border).all()
    flat = np.full_like(there, 90)
    assert (align_patches(flat, flat, points, points, eye).places == points).all()


def test_errors_are_proportional_to_covariances_over_the_image(points: np.ndarray) -> None:
    """Where there is more noise, and along which way a patch has slopes, they tell themselves."""
    # Noise grows from left to right; beyond x = 200 the pattern has only horizontal gradients.
    there = image(np.eye(2), np.zeros(2)).astype(float)
    there[:, 200:] = there[120, 200:] + 0.2 * (there[:, 200:] - there[120, 200:])
    here = there + np.random.default_rng(3).normal(size=there.shape) * np.linspace(1, 6, SIZE[0])
    there, here = (np.clip(np.rint(one), 0, 255).astype(np.uint8) for one in (there, here))
    found, covariances = align_patches(there, here, points, points,
                                       as_seen(np.eye(2), len(points)))
    determined = (found != points).any(1) & (np.abs(points[:, 0] - 200) > 10)
    assert determined.mean() > 0.9
    off, sigma = (found - points)[determined], np.sqrt(covariances[determined][:, [0, 1], [0, 1]])
    across = points[determined, 0] - 200
    parts = [np.median(np.abs(off[part] / sigma[part]), axis=0) / 0.6745
             for part in (across < -60, (across > -60) & (across < 0), across > 0)]
    # Larger than stated, since interpolation smooths.
    assert np.min(parts) > 0.7 and np.max(parts) < 2
    # The sizes differ by far more.
    sizes = [np.median(np.abs(off[part, 1])) for part in (across < -60, across > 0)]
    assert sizes[1] > 4 * sizes[0]


def test_a_patch_without_gradient_is_undetermined(points: np.ndarray) -> None:
    flat = np.full(SIZE[::-1], 90, np.uint8)
    there = image(np.eye(2), np.zeros(2))
    eye = as_seen(np.eye(2), len(points))
    determined, undetermined = (align_patches(one, one, points, points, eye).covariances[:, 0, 0]
                                for one in (there, flat))
    assert undetermined.min() > 1e3 * determined.max()


def test_threads_change_nothing(points: np.ndarray) -> None:
    there, here = image(np.eye(2), np.zeros(2)), image(WARPS['larger'], np.zeros(2))
    many = np.tile(points, (8, 1))
    warp = as_seen(WARPS['larger'], len(many))
    true = seen(WARPS['larger'], np.zeros(2), many)
    before = cv2.getNumThreads()
    results = []
    for threads in (1, 2):
        cv2.setNumThreads(threads)
        results.append(align_patches(there, here, many, true, warp).places)
    cv2.setNumThreads(before)
    assert (results[0] == results[1]).all()
