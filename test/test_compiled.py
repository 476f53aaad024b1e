"""Compiled functions agree with their NumPy implementations to rounding."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache, partial
from itertools import pairwise
import os
from pathlib import Path
import shutil
import subprocess
import sys
from types import SimpleNamespace
from typing import TypeVar

import cv2
from djet_ros import compiled
from djet_ros.core.bundle import eliminate, observe
from djet_ros.core.corners import (
    _exact_peaks,
    _peaks,
    corner_slopes,
    image_noise,
    spread_out,
)
from djet_ros.core.covariance import _morton_order, leave_one_out, sums_of_cells
from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.estimator_config import preset
from djet_ros.core.features import most_similar
from djet_ros.core.geometry import fit_rotation, rotation_exp, rotation_log
from djet_ros.core.graded import graded_surfaces, grades, smooth_finely, warped_grades
from djet_ros.core.hamming import dense_descriptors, intensities, match_distances
from djet_ros.core.jet import epipolar_residuals, jet_problem, JetProblem, Loss, minimise
from djet_ros.core.orb_pattern import pattern, reach
from djet_ros.core.paraboloid import Paraboloids
from djet_ros.core.patches import align_all, align_patches
from djet_ros.core.prediction import nearest
from djet_ros.core.sketch import losses_in_front, refine_all
from djet_ros.core.slants import planes_at
from djet_ros.core.starts import starts_around
from djet_ros.core.types import Pose, Status
from djet_ros.lab.scenes import make_scene
from djet_ros.lab.surface_steps import RADIUS
from djet_ros.odometry.frame import Frame
from djet_ros.odometry.result import OdometryResult
from djet_ros.odometry.visual_odometry import VisualOdometry
import numpy as np
import pytest
from test_bundle import K as BUNDLE_K, scene
from two_view import moved_pose, textured, two_views

pytestmark = pytest.mark.skipif(compiled.library is None, reason='it was built without a compiler')

Result = TypeVar('Result')

LOSSES = ('none', 'huber', 'cauchy', 'geman_mcclure')

# Before 5.0, OpenCV's interpolation, which NumPy uses, rounds positions to 1/32 pixel.
EXACT = int(cv2.__version__.split('.')[0]) >= 5
PIXELS = 1e-3 if EXACT else 0.02


@contextmanager
def by_numpy() -> Iterator[None]:
    """Use the NumPy implementations."""
    library, compiled.library = compiled.library, None
    try:
        yield
    finally:
        compiled.library = library


def both(work: Callable[[], Result]) -> tuple[Result, Result]:
    """Return the results of a function compiled, and by NumPy."""
    done = work()
    with by_numpy():
        return done, work()


def image(seed: int, size: tuple[int, int] = (320, 200)) -> np.ndarray:
    return textured(np.random.default_rng(seed), size)


def warps(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return the warps of a road that comes nearer, (N, 3, 2), half of them in perspective."""
    warp = np.tile(np.eye(3, 2), (count, 1, 1))
    warp[:, :2] += rng.normal(0, 0.06, (count, 2, 2))
    warp[::2, 2] = rng.normal(0, 0.004, (len(warp[::2]), 2))
    return warp


@pytest.fixture(params=LOSSES)
def loss(request: pytest.FixtureRequest) -> Loss:
    return Loss(request.param, 1.5)


def problem(rng: np.random.Generator, count: int, indefinite: bool) -> tuple[JetProblem, Pose]:
    """Return matches of two views, a fifth of them false, and a pose close to theirs."""
    views = two_views(rng, count)
    y = views.y + rng.normal(0, 0.2, views.y.shape)
    y[::5] += rng.normal(0, 9, (len(y[::5]), 2))
    half = rng.normal(size=(count, 2, 2))
    A = half @ half.transpose(0, 2, 1) + 0.3 * np.eye(2)
    if indefinite:
        A[::4] *= -1
    surfaces = Paraboloids(y, A, rng.normal(0, 0.1, (count, 2)), rng.uniform(1, 9, count),
                           np.ones(count, bool))
    return (jet_problem(views.K, views.x, surfaces, epipole_blur=5.0),
            Pose(*moved_pose(views.R, views.t, 0.02, rng)))


@pytest.mark.parametrize('count', [0, 1, 8, 9, 300])
def test_patch_alignment_equals_numpy(count: int) -> None:
    rng = np.random.default_rng(count)
    there, here = image(0), np.roll(image(0), 1, axis=1)
    # Some at the border, outside, and on flat ground.
    here[:40] = there[:40] = 90
    x = rng.uniform((-5, -5), (325, 205), (count, 2))
    y = x + rng.uniform((-0.5, -1.5), (2.5, 1.5), x.shape)
    warp = warps(rng, count)
    ours, numpys = both(lambda: align_patches(there, here, x, y, warp))
    moved = (numpys.places != y).any(1)
    assert ((ours.places != y).any(1) != moved).sum() <= 0.02 * count
    off = np.abs(ours.places - numpys.places).max(1)
    assert (off > PIXELS).sum() <= 0.05 * count
    sizes = (np.linalg.det(placed.covariances) for placed in (ours, numpys))
    np.testing.assert_allclose(np.log(next(sizes)), np.log(next(sizes)), atol=300 * PIXELS)


# Together in one pass, and in more than one.
@pytest.mark.parametrize('counts', [(3, 4, 9), (200, 90, 40)])
def test_patches_of_several_images_equal_those_of_each(counts: tuple[int, ...]) -> None:
    rng = np.random.default_rng(sum(counts))
    images, here = [image(seed) for seed in range(3)], image(3)
    x = rng.uniform(20, 180, (sum(counts), 2))
    warp, y, ends = warps(rng, len(x)), x + rng.uniform(-2, 2, x.shape), np.cumsum(counts)
    together = align_all(list(zip(images, counts)), x, warp, here, y)
    for there, count, end in zip(images, counts, ends):
        some = slice(end - count, end)
        alone = align_all([(there, count)], x[some], warp[some], here, y[some])
        for mine, others in zip(together, alone):
            np.testing.assert_array_equal(mine[some], others)


@pytest.mark.parametrize('count', [0, 1, 7, 16, 17, 400])
# The largest window of a configuration, and the window that is drawn.
@pytest.mark.parametrize('radius', [1, 2, 7, RADIUS])
@pytest.mark.parametrize(('tests', 'scale', 'grading'), [(96, 0.65, 48.0), (256, 1.0, 120.0),
                                                         (16, 0.3, 0.2)])
def test_surfaces_are_those_of_numpy_to_the_last_bit(
        count: int, radius: int, tests: int, scale: float, grading: float) -> None:
    rng, chosen = np.random.default_rng(1), pattern(tests, scale)
    fine, margin = smooth_finely(image(1), scale), reach(chosen) + radius
    # The outermost places with a descriptor are among them.
    centres = rng.integers(margin, (320 - margin, 200 - margin), (count, 2))
    centres[:1], centres[1:2] = margin, (319 - margin, 199 - margin)
    reference = rng.integers(-round(4 * grading) or -1, (round(4 * grading) or 1) + 1,
                             (tests, count)).astype(np.int16)
    ours, numpys = both(lambda: graded_surfaces(reference, fine, centres, radius, grading, chosen))
    np.testing.assert_array_equal(ours, numpys)


@pytest.mark.parametrize('size', [(320, 200), (321, 203), (5, 4)])
def test_slopes_of_corners_are_those_of_numpy_to_the_last_bit(size: tuple[int, int]) -> None:
    noise = np.random.default_rng(0).integers(0, 256, size[::-1]).astype(np.uint8)
    for gray in (noise, image(1, size)):
        for ours, numpys in zip(*both(partial(corner_slopes, gray))):
            np.testing.assert_array_equal(ours, numpys)


@pytest.mark.parametrize('size', [(320, 200), (321, 203), (36, 35), (30, 9)])
def test_corners_are_those_of_numpy(size: tuple[int, int]) -> None:
    noise = np.random.default_rng(0).integers(0, 256, size[::-1]).astype(np.uint8)
    # With few values, many slopes equal their neighbours.
    for gray, steps in ((noise, 1e-3), (image(1, size), 1e-3), (noise, 300.0)):
        slopes = np.rint(corner_slopes(gray)[0] / steps).astype(np.float32)
        for ours, numpys in zip(*both(partial(_peaks, slopes, 0.5, gray.shape))):
            np.testing.assert_array_equal(ours, numpys)
            assert len(ours) or min(size) < 40


@pytest.mark.parametrize('size', [(320, 200), (321, 107), (8, 10), (8, 9)])
def test_noise_and_places_of_corners_are_those_of_numpy(size: tuple[int, int]) -> None:
    for seed in range(2):
        gray = image(seed, size)
        ours, numpys = both(partial(image_noise, gray))
        assert ours == numpys
        slopes, _ = corner_slopes(gray)
        found, _ = _peaks(slopes, 0.5, gray.shape)
        np.testing.assert_array_equal(*both(partial(_exact_peaks, slopes, found)))


@pytest.mark.parametrize('count', [0, 1, 900])
@pytest.mark.parametrize('most', [0, 1, 300, 900])
def test_points_are_spread_out_as_numpy_does(count: int, most: int) -> None:
    rng = np.random.default_rng(count)
    points = rng.integers(0, (700, 300), (count, 2))
    # Some are equally strong.
    strengths = rng.integers(0, 99, count).astype(np.float32)
    first = rng.uniform(size=count) < 0.6
    np.testing.assert_array_equal(*both(partial(spread_out, points, strengths, most, first)))


@pytest.mark.parametrize('count', [1, 2, 700])
@pytest.mark.parametrize('spread', [(0, 0), (90, 0), (90, 30)])
def test_the_nearest_points_are_those_of_numpy(count: int, spread: tuple[int, int]) -> None:
    rng = np.random.default_rng(count)
    points = 7 + rng.uniform(0, 1, (count, 2)) * spread
    # Some of them in one place, and some others far from all.
    points[count // 2:] = 0.1 * points[count // 2:] + 60
    others = rng.uniform(-90, 180, (900, 2))
    off = [np.linalg.norm(points[index] - others, axis=1)
           for index in both(partial(nearest, points, others))]
    np.testing.assert_array_equal(*off)


@pytest.mark.parametrize('count', [3, 700])
def test_nothing_is_near_a_point_without_a_place(count: int) -> None:
    points = np.random.default_rng(count).uniform(0, 90, (count, 2))
    points[::2], points[2, 1] = np.inf, np.nan
    assert (nearest(points, points[1::2]) == np.arange(1, count, 2)).all()


def test_points_closer_than_numbers_can_square_are_all_near() -> None:
    points = np.random.default_rng(0).uniform(0, 1e-170, (700, 2))
    found = nearest(points, points)
    assert ((found >= 0) & (found < 700)).all()


# Of which many tests, slopes and neighbours are equal, or as different as can be.
DEGENERATE = {
    'flat': np.full((60, 70), 7, np.uint8),
    'white noise': 255 * np.random.default_rng(0).integers(0, 2, (60, 70)).astype(np.uint8),
    'stripes': np.tile(np.repeat([0, 255, 255], 7).astype(np.uint8), (61, 4)),
    'chequers': (255 * (np.indices((60, 71)) // 8).sum(0) % 510).astype(np.uint8),
    'a dot': np.pad(np.full((1, 1), 255, np.uint8), 30)}


@pytest.mark.parametrize('name', DEGENERATE)
def test_degenerate_images_are_seen_as_numpy_does(name: str) -> None:
    # Neither in order nor writable.
    gray = DEGENERATE[name].T
    gray.setflags(write=False)
    slopes, _ = corner_slopes(gray)
    peaks, _ = _peaks(slopes, 0.0, gray.shape)
    fine, chosen = smooth_finely(gray, 0.65), pattern(96, 0.65)
    pixels = np.array([[30, 28], [30, 30], [31, 29]])
    for work in (partial(corner_slopes, gray), partial(image_noise, gray),
                 partial(_peaks, slopes, 0.0, gray.shape), partial(_exact_peaks, slopes, peaks),
                 partial(dense_descriptors, gray, pixels),
                 partial(graded_surfaces, grades(*intensities(fine, pixels, chosen), 48.0), fine,
                         pixels[::-1], 2, 48.0, chosen)):
        np.testing.assert_equal(*both(work))


def test_images_of_one_row_are_seen_through_warps() -> None:
    fine, points = np.arange(40, dtype=np.int16)[None], np.array([[3.0, 0], [39, 1], [50, -9]])
    warp = warps(np.random.default_rng(0), 3)
    for strip in (fine, fine.T):
        np.testing.assert_array_equal(*both(partial(
            warped_grades, warp, [(strip, 3)], points, 48.0, 1.0, pattern(96, 0.65))))
        align_all([(strip.astype(np.uint8), 3)], points, warp, image(0), points + 50)


def test_places_outside_all_images_have_no_distance() -> None:
    far = [np.nan, np.inf, -np.inf, 1e300, -1e300, 2.0**31, 2.0**63, -0.5, 12.5, 13.0, 50.0]
    x = np.stack(np.meshgrid(far, far), axis=-1).reshape(-1, 2)
    with np.errstate(invalid='ignore'):
        ours, numpys = both(lambda: match_distances(image(2), x, image(3), x[:, ::-1]))
    np.testing.assert_array_equal(ours, numpys)
    assert 0 < np.isfinite(ours).sum() < len(x)


def test_descriptors_are_those_of_numpy_to_the_last_bit() -> None:
    there, here, rng = image(2), image(3), np.random.default_rng(2)
    x, y = rng.uniform((-9, -9), (330, 210), (2, 400, 2))
    for ours, numpys in (both(lambda: match_distances(there, x, here, y)),
                         both(lambda: dense_descriptors(there, np.rint(x[(x > 14).all(1) & (
                             x < (306, 186)).all(1)]).astype(np.int64)))):
        np.testing.assert_array_equal(ours, numpys)
        assert len(ours) > 200


@pytest.mark.parametrize('strips', [[], [(0, 40, 3, 90), (0, 40, 95, 99), (60, 90, 0, 99)]])
def test_the_most_similar_features_are_those_of_numpy(strips: list[tuple[int, ...]]) -> None:
    rng = np.random.default_rng(3)
    there, here = ((rng.integers(0, 256, (count, 32)).astype(np.uint8),
                    rng.uniform(0, 4, (count, 2))) for count in (90, 99))
    ours, numpys = both(lambda: most_similar(np.reshape(strips, (-1, 4)).astype(int), there, here))
    np.testing.assert_array_equal(ours[0], numpys[0])
    assert (ours[0] >= 0).sum() == (70 if strips else 0)
    for mine, others in zip(ours[1:], numpys[1:]):
        np.testing.assert_allclose(mine, others, atol=1e-4)


def test_of_features_that_look_alike_the_first_is_the_most_similar() -> None:
    alike = np.zeros((9, 32), np.uint8), np.ones((9, 2))
    for ours in both(lambda: most_similar(np.array([[0, 5, 4, 9], [3, 9, 0, 9]]), alike, alike)):
        assert ours[0].tolist() == [4, 4, 4, 4, 4, 0, 0, 0, 0]


@pytest.mark.parametrize('count', [1, 9, 900])
def test_planes_through_depths_equal_numpy(count: int) -> None:
    rng = np.random.default_rng(count)
    u, v = rng.uniform(0, (12, 7), (count, 2)).T
    rho = 0.1 + 0.01 * u + 0.02 * v + 0.02 * (u > 6) + rng.normal(0, 2e-3, count)
    for ours, numpys in zip(*both(lambda: planes_at(u, v, rho, np.full(count, 2e-3**-2)))):
        np.testing.assert_allclose(ours, numpys, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize('counts', [(0, 0), (0, 1), (100, 233)])
def test_references_are_those_of_numpy_to_a_grade(counts: tuple[int, int]) -> None:
    count = sum(counts)
    images = [smooth_finely(image(seed), 0.65) for seed in (2, 3)]
    points = np.random.default_rng(2).uniform((-9, -9), (330, 210), (count, 2))
    contrasts = np.where(np.arange(count) < 100, 0.4, 1.1)
    warp, chosen = warps(np.random.default_rng(3), count), pattern(96, 0.65)
    ours, numpys = both(lambda: warped_grades(
        warp, list(zip(images, counts)), points, 48.0, contrasts, chosen))
    assert ours.shape == numpys.shape == (96, count)
    off = np.abs(ours.astype(int) - numpys)
    assert off.max(initial=0) <= 1 + 100 * PIXELS
    assert off.sum() <= 10 * PIXELS * off.size


@pytest.mark.parametrize('count', [5, 8, 203])
@pytest.mark.parametrize('indefinite', [False, True])
def test_the_optimiser_takes_the_steps_of_numpy(loss: Loss, count: int, indefinite: bool) -> None:
    matches, start = problem(np.random.default_rng(count), count, indefinite)
    # More steps may amplify rounding.
    ours, numpys = both(lambda: minimise(matches, start.R, start.t, loss, 3))
    np.testing.assert_allclose(ours.R, numpys.R, atol=1e-8)
    np.testing.assert_allclose(ours.t, numpys.t, atol=1e-8)
    for mine, others in zip(vars(ours.residuals).values(), vars(numpys.residuals).values()):
        np.testing.assert_allclose(mine, others, rtol=1e-5, atol=1e-5 * np.abs(others).max())


@pytest.mark.parametrize('indefinite', [False, True])
def test_residuals_are_those_of_numpy(indefinite: bool) -> None:
    matches, pose = problem(np.random.default_rng(7), 203, indefinite)
    ours, numpys = both(lambda: epipolar_residuals(matches, pose.R, pose.t))
    for mine, others in zip(vars(ours).values(), vars(numpys).values()):
        np.testing.assert_allclose(mine, others, rtol=1e-9, atol=1e-9 * np.abs(others).max())


def test_the_optimiser_ends_where_numpy_does() -> None:
    matches, start = problem(np.random.default_rng(0), 500, False)
    ours, numpys = both(lambda: minimise(matches, start.R, start.t, Loss('geman_mcclure', 1.5)))
    np.testing.assert_allclose(ours.R, numpys.R, atol=1e-9)
    np.testing.assert_allclose(ours.t, numpys.t, atol=1e-9)


@pytest.mark.parametrize('steps', [0, 4])
def test_many_starts_are_refined_as_numpy_does(loss: Loss, steps: int) -> None:
    matches, start = problem(np.random.default_rng(4), 203, True)
    starts = [*starts_around(start, 10), Pose(np.eye(3), np.zeros(3))]
    ours, numpys = both(lambda: refine_all(matches, starts, loss, steps))
    np.testing.assert_allclose(ours.costs, numpys.costs, rtol=1e-7)
    np.testing.assert_allclose(ours.R, numpys.R, atol=1e-6)
    np.testing.assert_allclose(ours.r, numpys.r, rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(ours.sign, numpys.sign)


@pytest.mark.parametrize('indefinite', [False, True])
@pytest.mark.parametrize('signs', [(1.0,), (1.0, -1.0)])
def test_losses_with_chirality_equal_numpy(
        loss: Loss, indefinite: bool, signs: tuple[float, ...]) -> None:
    matches, start = problem(np.random.default_rng(6), 203, indefinite)
    seen = refine_all(matches, [*starts_around(start, 10), Pose(np.eye(3), np.zeros(3))], loss, 1)
    ours, numpys = both(lambda: losses_in_front(matches, seen, loss, signs))
    np.testing.assert_allclose(ours, numpys, rtol=1e-9, atol=1e-12)


def test_degenerate_matches_move_no_pose() -> None:
    for rays in (np.zeros((3, 6)), np.full((3, 6), np.nan), np.empty((3, 0))):
        matches = JetProblem(rays, rays, np.ones(rays.shape), np.zeros(rays.shape[1]))
        for found in both(partial(minimise, matches, np.eye(3), np.array([0.0, 0, 1]), Loss())):
            assert found.R.tolist() == np.eye(3).tolist()
            assert found.t.tolist() == [0, 0, 1]


@pytest.mark.parametrize('count', [2, 9, 900])
def test_rotations_are_fitted_as_numpy_does(count: int) -> None:
    rng = np.random.default_rng(count)
    x = np.concatenate([rng.uniform(-0.6, 0.6, (count, 2)), np.ones((count, 1))], axis=1)
    for turn in (np.zeros(3), np.array([0.1, -0.2, 0.3]), np.array([3.1, 0.0, 0.0])):
        y = x @ rotation_exp(turn).T + rng.normal(0, 1e-3, x.shape)
        # Some of them are outliers.
        y[:count // 4] += 0.3
        ours, numpys = both(partial(fit_rotation, x, y))
        np.testing.assert_allclose(ours, numpys, atol=1e-9)


@pytest.mark.parametrize('count', [1, 2, 700])
def test_sums_over_cells_equal_numpy(count: int) -> None:
    rng = np.random.default_rng(count)
    order, codes = _morton_order(rng.uniform((-90, -20), (1600, 900), (count, 2)))
    J, weights, r = rng.normal(size=(5, count)), rng.uniform(0, 1, count), rng.normal(size=count)
    ours, numpys = both(lambda: sums_of_cells(J, weights, r, order, codes))
    np.testing.assert_array_equal(ours[1], numpys[1])
    for mine, others in zip(ours, numpys):
        np.testing.assert_allclose(mine, others, rtol=1e-9, atol=1e-9)
    whole = (J * weights) @ J.T + 1e-3 * np.eye(5)
    for mine, others in zip(*both(lambda: leave_one_out(whole, ours[0]))):
        np.testing.assert_allclose(mine, others, rtol=1e-7, atol=1e-7 * np.abs(others).max())


@pytest.mark.parametrize('seen', [False, True])
def test_residuals_of_a_window_are_those_of_numpy(seen: bool) -> None:
    rng = np.random.default_rng(6)
    poses, landmarks = scene(rng, frames=6, landmarks=57)
    landmarks.minima += rng.normal(0, 0.3, landmarks.minima.shape)
    # Some far behind, at the camera, and far outside the image.
    landmarks.rho[:9] = -3.0
    landmarks.rho[9:12] = 1e9
    landmarks.points[12:20] *= 9
    landmarks.observed &= seen
    ours, numpys = both(lambda: observe(BUNDLE_K, poses, landmarks))
    for name, mine in vars(ours).items():
        others = getattr(numpys, name)
        assert np.shape(mine) == np.shape(others)
        np.testing.assert_allclose(mine, others, rtol=1e-9, atol=1e-9)


def test_landmarks_are_eliminated_as_numpy_does() -> None:
    rng = np.random.default_rng(5)
    poses, landmarks = scene(rng, frames=6, landmarks=57)
    landmarks.minima += rng.normal(0, 0.3, landmarks.minima.shape)
    landmarks.points += rng.normal(0, 0.3, landmarks.points.shape)
    # One without observations, and one whose anchor has no precision.
    landmarks.observed[11] = False
    landmarks.anchor_roots[12] = 0
    observed = observe(BUNDLE_K, poses, landmarks)
    weights = rng.uniform(0, 2, len(observed.residuals))
    ours, numpys = both(lambda: eliminate(observed, weights, 1.7, 6))
    for mine, others in zip(vars(ours).values(), vars(numpys).values(), strict=True):
        np.testing.assert_allclose(mine, others, rtol=1e-6, atol=1e-9 * np.abs(others).max())


def motions(frames: list[Frame], name: str) -> list[OdometryResult]:
    odometry = VisualOdometry(preset(name))
    return [odometry.process(frame) for frame in frames]


def apart_by(one: OdometryResult, other: OdometryResult) -> float:
    """Return by how many standard deviations two motions differ, at most in any direction."""
    off = np.linalg.inv(other.motion) @ one.motion
    step = np.concatenate([off[:3, 3], rotation_log(off[:3, :3])])
    return float(np.sqrt(step @ np.linalg.solve(other.motion_covariance, step)))


@cache
def rendered(name: str) -> tuple[list[np.ndarray], np.ndarray]:
    """Return the images of a scene, and K."""
    made = make_scene(name, seed=0, size=(416, 256))
    return [made.render(pose, i) for i, pose in enumerate(made.trajectory(8))], made.K


@pytest.fixture(params=['road', 'handheld'])
def frames(request: pytest.FixtureRequest) -> list[Frame]:
    images, K = rendered(request.param)
    return [Frame(gray, K, 10**8 * (i + 1)) for i, gray in enumerate(images)]


@pytest.mark.parametrize('name', ['best', 'fast', 'paper'])
def test_pairs_have_the_same_pose_compiled_and_not(frames: list[Frame], name: str) -> None:
    estimator = TwoViewEstimator(preset(name))
    views = [frame.view(estimator) for frame in frames[:4]]
    for before, after in pairwise(views):
        ours, numpys = both(partial(estimator.estimate, before, after))
        assert ours.status == numpys.status
        np.testing.assert_allclose(ours.R, numpys.R, atol=PIXELS / 100)
        np.testing.assert_allclose(ours.t, numpys.t, atol=PIXELS / 10)


@pytest.mark.skipif(not EXACT, reason='NumPy samples landmarks up to a 64th of a pixel beside')
@pytest.mark.parametrize('name', ['best', 'fast', 'paper'])
def test_a_track_differs_by_less_than_its_sigma(frames: list[Frame], name: str) -> None:
    # Whether a step of the flow is the last one depends on the last digit of its start.
    for ours, numpys in zip(*both(lambda: motions(frames, name))):
        assert ours.status == numpys.status
        if ours.status == Status.OK:
            # Preset paper does not use the flow.
            assert apart_by(ours, numpys) < (1e-3 if name == 'paper' else 0.5)


def test_two_odometries_in_two_threads_estimate_what_each_does_alone() -> None:
    drives = [[Frame(gray, K, 10**8 * (i + 1)) for i, gray in enumerate(images)]
              for images, K in (rendered('road'), rendered('handheld'))]
    with ThreadPoolExecutor(2) as pool:
        together = list(pool.map(partial(motions, name='best'), drives))
    for drive, in_company in zip(drives, together):
        for alone, other in zip(motions(drive, 'best'), in_company, strict=True):
            assert alone.status == other.status
            np.testing.assert_array_equal(alone.pose, other.pose)
            np.testing.assert_array_equal(alone.motion_covariance, other.motion_covariance)


SOURCES = Path(__file__).parents[1] / 'djet_ros' / 'compiled'

# The tests above of single functions, with another build of them.
CHECKED = f"""
import ctypes
from djet_ros import compiled
compiled.library = ctypes.CDLL('./checked.so')
import pytest, sys
others = ' and not '.join(['not pairs', 'track', 'odometries', 'disabled'])
sys.exit(pytest.main(['-qsx', '-p', 'no:cacheprovider', '-m', 'not slow', '-k', others,
                      {__file__!r}]))
"""


@cache
def sanitizers() -> list[str]:
    """Return the libraries that find accesses outside of arrays; none without GCC's."""
    if shutil.which('gcc') is None:
        return []
    paths = [subprocess.run(['gcc', f'-print-file-name={name}'], capture_output=True, text=True,
                            check=True).stdout.strip()
             for name in ('libasan.so', 'libubsan.so', 'libstdc++.so')]
    return paths if all(map(os.path.isabs, paths)) else []


@pytest.mark.slow
@pytest.mark.skipif(not sanitizers(), reason='needs GCC with its sanitizers')
def test_compiled_loops_stay_within_their_arrays(tmp_path: Path) -> None:
    subprocess.run(['gcc', '-shared', '-fPIC', '-O1', '-g', '-ffp-contract=off',
                    '-fsanitize=address,undefined,float-cast-overflow', '-fno-sanitize-recover',
                    '-Wno-psabi', *map(str, SOURCES.glob('*.c')), '-o', 'checked.so', '-lm'],
                   cwd=tmp_path, check=True)
    done = subprocess.run(
        [sys.executable, '-c', CHECKED], cwd=tmp_path, capture_output=True, text=True,
        env={**os.environ, 'LD_PRELOAD': ' '.join(sanitizers()), 'PYTHONMALLOC': 'malloc',
             'ASAN_OPTIONS': 'detect_leaks=0'})
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]


def test_a_build_of_other_sources_is_ignored(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled, '_INTERFACE', compiled._INTERFACE + 1)
    with pytest.warns(UserWarning, match='of other sources; ignored, reinstall djet_ros'):
        assert compiled._loaded() is None


SAID = """
from djet_ros import compiled
from djet_ros.config.sections import Config
from djet_ros.odometry.tracker import Tracker
from djet_ros.recordings.decoding import message_type
print(compiled.library is None, Tracker(Config(), message_type).diagnosis().values['inner loops'])
"""


def test_compiled_loops_can_be_disabled_and_the_diagnostics_report_it() -> None:
    answers = [subprocess.run(
        [sys.executable, '-c', SAID],
        env={**os.environ, 'DJET_COMPILED': switch}, capture_output=True, text=True, check=True
    ).stdout.strip() for switch in ('0', '1')]
    assert answers == ['True NumPy', 'False compiled']


def test_a_library_that_cannot_be_loaded_is_ignored(monkeypatch: pytest.MonkeyPatch, tmp_path: Path
                                                    ) -> None:
    damaged = tmp_path / '_loops.so'
    damaged.write_bytes(b'no library')
    monkeypatch.setattr(compiled, 'find_spec', lambda name: SimpleNamespace(origin=str(damaged)))
    with pytest.warns(UserWarning, match='ignored, reinstall djet_ros'):
        assert compiled._loaded() is None
