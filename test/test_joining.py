"""Fusion of surfaces and patch alignment as two Gaussian measurements."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

from djet_ros.core.geometry import fundamental, rotation_angle
from djet_ros.core.jet import (
    clipped_scale,
    epipolar_residuals,
    jet_problem,
    JetProblem,
    Loss,
    minimise,
    Solution,
)
from djet_ros.core.joining import fuse_alignment, fuse_positions
from djet_ros.core.paraboloid import Paraboloids
from djet_ros.core.patches import Aligned
from djet_ros.core.surfaces import ReprojectionSurface
from djet_ros.core.types import Pose
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from two_view import FORWARD, K, SKEWED, two_views, TwoViews

# Inflation of a surface's covariance, because gray levels see the same pixels.
TOGETHER = 2.0


def ellipses(rng: np.random.Generator, places: np.ndarray, sigma: float
             ) -> tuple[np.ndarray, np.ndarray]:
    """Places that are off by sigma pixels, some way by a third of that; their covariances."""
    turn = Rotation.from_rotvec(rng.uniform(0, np.pi, (len(places), 1)) * [0, 0, 1])
    axes = turn.as_matrix()[:, :2, :2]
    S = axes @ (sigma**2 * np.diag([1, 1 / 9])) @ axes.transpose(0, 2, 1)
    off = np.einsum('nij,nj->ni', np.linalg.cholesky(S), rng.normal(size=places.shape))
    return places + off, S


def surfaces(centres: np.ndarray, S: np.ndarray) -> Paraboloids:
    return Paraboloids(centres, np.linalg.inv(S), np.zeros_like(centres), np.zeros(len(centres)),
                       np.ones(len(centres), bool))


def alike(places: np.ndarray) -> Aligned:
    return Aligned(places, np.tile(np.eye(2), (len(places), 1, 1)))


def at(problem: JetProblem, R: np.ndarray, t: np.ndarray) -> Solution:
    """Take a pose as the solution of a problem."""
    return Solution(R, t, epipolar_residuals(problem, R, t))


def rotation_errors(poses: Callable[[np.random.Generator, TwoViews], Iterable[Pose]],
                    seeds: int, count: int) -> np.ndarray:
    """Root mean square errors (P,) of the rotations of P poses, in rad, over random views."""
    errors = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        views = two_views(rng, count)
        errors.append([rotation_angle(views.R, pose.R) for pose in poses(rng, views)])
    return np.sqrt(np.mean(np.square(errors), axis=0))


def test_two_measurements_are_fused_as_gaussians() -> None:
    rng = np.random.default_rng(20)
    views = two_views(rng, 400)
    x, y, R, t = views.x, views.y, views.R, views.t
    y_star, S = ellipses(rng, y, 0.3)
    found, T = ellipses(rng, y, 0.2)
    alone = jet_problem(K, x, surfaces(y_star, S))
    # Only the shapes and ratios of covariances are known.
    joined = fuse_alignment(alone, at(alone, R, t), K, Aligned(found, 7 * T))
    # The standard deviation of each, in pixels, by the distances to the true lines.
    lines = np.c_[x, np.ones(len(x))] @ fundamental(K, R, t).T
    normals = lines[:, :2] / np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    S, T = (shape * clipped_scale(((at_places - y) * normals).sum(1) / np.sqrt(
        np.einsum('ni,nij,nj->n', normals, shape, normals)))**2
        for shape, at_places in ((S, y_star), (T, found)))
    S *= TOGETHER
    precision = np.linalg.inv(S) + np.linalg.inv(T)
    expected = np.linalg.solve(precision, (np.linalg.solve(S, y_star[..., None])
                                           + np.linalg.solve(T, found[..., None])))
    joined_at = (joined.rays_y.T @ K.T)[:, :2]
    assert np.abs(joined_at - expected[..., 0]).max() < 1e-6
    # Covariances, but for their common unit, and for how much the noise seems to differ.
    C = K[:2, :2] @ joined.covariances[[0, 1, 1, 2]].T.reshape(-1, 2, 2) @ K[:2, :2].T
    apart = y_star - found
    squared = (apart * np.linalg.solve(S + T, apart[..., None])[..., 0]).sum(1)
    ratio = np.linalg.eigvalsh(np.linalg.solve(np.linalg.inv(precision), C))
    assert np.ptp(ratio, axis=1).max() < 1e-6 * ratio.max()
    by_distance = ratio[np.argsort(squared), 0]
    assert (np.diff(by_distance) > -1e-9 * ratio.max()).all()
    assert np.median(by_distance) < 1.5 * by_distance[0]


@pytest.mark.parametrize('unit', [1.0, 0.01])
def test_where_both_agree_residuals_stay_in_pixels_and_uncertain_near_the_epipole(
        unit: float) -> None:
    """Whatever the unit of the alignment's covariances."""
    rng = np.random.default_rng(23)
    views = two_views(rng, 100, t=FORWARD, K=SKEWED)
    places = views.y + rng.normal(0, 0.3, views.y.shape)
    alone = jet_problem(SKEWED, views.x, ReprojectionSurface(views.x, places).fit_around(places),
                        epipole_blur=30.0)
    before = at(alone, views.R, views.t)
    joined = fuse_alignment(alone, before, SKEWED,
                            Aligned(places, np.tile(unit * np.eye(2), (100, 1, 1))))
    after = epipolar_residuals(joined, views.R, views.t)
    np.testing.assert_allclose(after.r, before.residuals.r, rtol=1e-6)


@pytest.mark.parametrize('sigma', [0.1, 0.3, 1.0])
def test_a_fused_pose_is_about_as_accurate_as_the_better_of_both(sigma: float
                                                                 ) -> None:
    def poses(rng: np.random.Generator, views: TwoViews) -> list[Pose]:
        y_star, S = ellipses(rng, views.y, 0.3)
        found = views.y + rng.normal(0, sigma, views.y.shape)
        problems = [jet_problem(K, views.x, surfaces(y_star, S)),
                    jet_problem(K, views.x, ReprojectionSurface(views.x, found).fit_around(found))]
        solutions = [minimise(problem, views.R, views.t, Loss()) for problem in problems]
        joined = fuse_alignment(problems[0], solutions[0], K, alike(found))
        return [one.pose for one in (*solutions, minimise(joined, views.R, views.t, Loss()))]

    surface, place, both = rotation_errors(poses, 30, 150)
    assert both < 1.1 * min(surface, place)


def test_measurements_are_weighted_by_their_precision() -> None:
    """Where one half of the matches is ten times as exact, the pose is that of this half."""
    def poses(rng: np.random.Generator, views: TwoViews) -> list[Pose]:
        sigma = np.where(np.arange(200) % 2, 0.05, 0.5)
        y_star, S = ellipses(rng, views.y, 0.5)
        found = views.y + sigma[:, None] * rng.normal(size=views.y.shape)
        alone = jet_problem(K, views.x, surfaces(y_star, S))
        start = minimise(alone, views.R, views.t, Loss())
        known = Aligned(found, sigma[:, None, None]**2 * np.eye(2))
        return [minimise(fuse_alignment(alone, start, K, placed), views.R, views.t, Loss()).pose
                for placed in (known, alike(found))]

    weighed, unweighed = rotation_errors(poses, 20, 200)
    assert weighed < 0.5 * unweighed


def test_agreeing_measurements_have_more_weight_if_the_noise_varies() -> None:
    rng = np.random.default_rng(22)
    views = two_views(rng, 400)
    x, y, R, t = views.x, views.y, views.R, views.t
    noise = rng.choice([0.3, 1.0, 2.0], 400)  # of what is seen around a place, however
    off, S = ellipses(rng, np.zeros_like(y), 0.2)
    found = y + noise[:, None] * rng.normal(0, 0.2, y.shape)
    alone = jet_problem(K, x, surfaces(y + noise[:, None] * off, S))
    joined = fuse_alignment(alone, at(alone, R, t), K, alike(found))
    grown = np.median(joined.covariances[::2], axis=0) / np.median(alone.covariances[::2], axis=0)
    assert np.median(grown[noise == 0.3]) < 0.5 * np.median(grown[noise == 2.0])


def test_outliers_of_the_alignment_hardly_change_the_pose() -> None:
    def poses(rng: np.random.Generator, views: TwoViews) -> Iterator[Pose]:
        y_star, S = ellipses(rng, views.y, 0.2)
        found = views.y + rng.normal(0, 0.2, views.y.shape)
        elsewhere = np.where(np.arange(400) % 10, 0, 3)[:, None] * rng.normal(size=found.shape)
        alone = jet_problem(K, views.x, surfaces(y_star, S))
        start = minimise(alone, views.R, views.t, Loss('geman_mcclure', 0.6))
        for places in (found, found + elsewhere):
            joined = fuse_alignment(alone, start, K, alike(places))
            scale = 3 * clipped_scale(epipolar_residuals(joined, start.R, start.t).r)
            yield minimise(joined, start.R, start.t, Loss('geman_mcclure', scale)).pose

    right, some_wrong = rotation_errors(poses, 20, 400)
    assert some_wrong < 1.3 * right


def test_matches_without_a_minimum_are_not_fused() -> None:
    rng = np.random.default_rng(21)
    views = two_views(rng, 60)
    x, y, R, t = views.x, views.y, views.R, views.t
    y_star, S = ellipses(rng, y, 0.3)
    S[::3] *= -1
    S[1::3, 0, 0] *= -1
    S[2::6, 0, 1] = S[2::6, 1, 0] = 1.0
    problem = jet_problem(K, x, surfaces(y_star, S))
    joined = fuse_alignment(problem, at(problem, R, t), K, alike(y))
    saddles = problem.covariances[0] * problem.covariances[2] <= problem.covariances[1]**2
    saddles |= problem.covariances[0] <= 0
    assert saddles[2::6].all() and saddles.sum() > 40
    assert np.array_equal(joined.rays_y[:, saddles], problem.rays_y[:, saddles])
    assert not np.array_equal(joined.rays_y[:, ~saddles], problem.rays_y[:, ~saddles])
    assert np.isfinite(joined.covariances).all() and np.isfinite(joined.blur).all()


def test_without_a_pose_the_differences_calibrate_the_covariances() -> None:
    """Covariances are in pixels, whatever unit surfaces come in; the joined place is better."""
    rng = np.random.default_rng(25)
    y = rng.uniform(0, 400, (4000, 2))
    y_star, S = ellipses(rng, y, 0.3)
    # Common errors, and those of each.
    found, T = ellipses(rng, y, 0.15)
    alike_off = 0.05 * rng.normal(size=y.shape)
    y_star, found = y_star + alike_off, found + alike_off
    # Errors of the alignment are twice as large as stated.
    places, C = fuse_positions(y_star, 1000 * S, Aligned(found, T / 4))
    errors = [np.sqrt(np.mean((one - y)**2)) for one in (y_star, found, places)]
    assert errors[2] < min(errors[:2])
    squared = ((places - y) * np.linalg.solve(C, (places - y)[..., None])[..., 0]).sum(1)
    assert 0.5 < np.median(squared) / (2 * np.log(2)) < 2


def test_equal_positions_have_a_covariance() -> None:
    y, eye = np.full((5, 2), 40.0), np.tile(np.eye(2), (5, 1, 1))
    places, C = fuse_positions(y, 3 * eye, Aligned(y, 1e-4 * eye))
    assert np.array_equal(places, y)
    # That of the alignment, which is four times what it states, and of the surfaces, which are
    # taken for no better and whose errors are partly the same.
    np.testing.assert_allclose(C, eye / (1 / 4e-4 + 1 / (TOGETHER * 4e-4)), rtol=1e-6)


def test_exact_matches_stay_exact() -> None:
    views = two_views(np.random.default_rng(24), 60)
    problem = jet_problem(K, views.x, surfaces(views.y, np.tile(np.eye(2), (60, 1, 1))))
    joined = fuse_alignment(problem, at(problem, views.R, views.t), K, alike(views.y))
    assert np.isfinite(joined.covariances).all()
    assert np.abs(epipolar_residuals(joined, views.R, views.t).r).max() < 1e-9
