"""The joint optimiser: its residuals, their derivatives, the robust losses, and convergence."""

from __future__ import annotations

from djet_ros.core import jet
from djet_ros.core.geometry import direction_angle, fundamental, rotation_angle, sphere_tangents
from djet_ros.core.jet import (
    clipped_scale,
    epipolar_residuals,
    jet_problem,
    Loss,
    median,
    minimise,
    retract,
    robust_scale,
)
from djet_ros.core.paraboloid import constrained_minimum, Paraboloids
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays
import numpy as np
import pytest
from scipy.optimize import approx_fprime
from scipy.spatial.transform import Rotation
from two_view import BACKWARD, FORWARD, K, moved_pose, SIDEWAYS, SKEWED, two_views

LOSSES = ('none', 'huber', 'cauchy', 'geman_mcclure')


def circles(y):
    """RP-E's surfaces: the squared distance to y."""
    count = len(y)
    return Paraboloids(y, np.repeat(np.eye(2)[None], count, axis=0), np.zeros((count, 2)),
                       np.zeros(count), np.ones(count, bool))


def random_surfaces(rng, y, kind):
    """Ellipses with their minima some pixels beside y; or saddles and peaks among them."""
    count = len(y)
    half = rng.normal(size=(count, 2, 2))
    A = half @ half.transpose(0, 2, 1) + 0.3 * np.eye(2)
    if kind == 'indefinite':
        A[::3] *= -1
        A[1::3, 0, 0] *= -1
    return Paraboloids(y, A, rng.normal(size=(count, 2)), rng.uniform(0, 80, count),
                       np.ones(count, bool))


def random_pose(rng):
    t = rng.normal(size=3)
    return Rotation.from_rotvec(rng.normal(size=3)).as_matrix(), t / np.linalg.norm(t)


@pytest.mark.parametrize('kind', ['bowls', 'indefinite'])
@pytest.mark.parametrize('camera', [K, SKEWED])
@given(seed=st.integers(0, 2**32 - 1), blur=st.sampled_from([0.0, 20.0]))
@settings(max_examples=25, deadline=None)
def test_the_jacobian_is_that_of_central_differences(camera, kind, seed, blur):
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, 1000, (2, 30, 2))
    problem = jet_problem(camera, x, random_surfaces(rng, y, kind), epipole_blur=blur)
    R, t = random_pose(rng)
    residuals = epipolar_residuals(problem, R, t)
    tangents, step = residuals.tangents, 1e-6

    def at(parameter, distance):
        step = distance * np.eye(5)[parameter]
        return epipolar_residuals(problem, *retract(R, t, tangents, step))

    for parameter in range(5):
        ahead, behind = at(parameter, step), at(parameter, -step)
        numeric = (ahead.r - behind.r) / (2 * step)
        # where g^T A'^-1 g of a saddle passes through zero, the residual has no derivative
        steep = np.abs(ahead.r - 2 * residuals.r + behind.r) > 1e-4 * np.abs(ahead.r - behind.r)
        assert steep.mean() < 0.2
        scale = np.abs(residuals.jacobian).max(0) + np.abs(residuals.r)
        wrong = np.abs(residuals.jacobian[parameter] - numeric) > 1e-6 * scale
        assert not (wrong & ~steep).any()


@pytest.mark.parametrize('kind', ['bowls', 'indefinite'])
@pytest.mark.parametrize('camera', [K, SKEWED])
def test_a_squared_residual_is_what_the_line_costs_above_the_surfaces_own_minimum(camera, kind):
    """In pixels, by the closed form of v_opt; all matches may be scaled alike."""
    rng = np.random.default_rng(3)
    x, y = rng.uniform(0, 1000, (2, 40, 2))
    surfaces = random_surfaces(rng, y, kind)
    R, t = random_pose(rng)
    residuals = epipolar_residuals(jet_problem(camera, x, surfaces), R, t)

    lines = np.column_stack([x, np.ones(40)]) @ fundamental(camera, R, t).T
    h = -(np.column_stack([y, np.ones(40)]) * lines).sum(1)
    v_opt = constrained_minimum(surfaces.A, surfaces.b, lines[:, :2], h)
    above = surfaces.values(y + v_opt) - surfaces.values(surfaces.minima())
    ratio = residuals.sign * residuals.r**2 / above
    assert np.allclose(ratio, ratio[0], rtol=1e-6)
    assert ratio[0] > 0
    assert (residuals.sign < 0).any() == (kind == 'indefinite')


@pytest.mark.parametrize('camera', [K, SKEWED])
def test_another_camera_matrix_is_as_if_the_problem_had_been_made_with_it(camera):
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, 1000, (2, 30, 2))
    surfaces, other = random_surfaces(rng, y, 'bowls'), camera * [[1.1], [1.1], [1]] + [
        [0, 0, 3], [0, 0, -2], [0, 0, 0]]
    made, before = (jet_problem(matrix, x, surfaces, epipole_blur=20.0)
                    for matrix in (other, camera))
    for one, another in zip(made.matches, before.with_camera(camera, other).matches):
        np.testing.assert_allclose(another, one, rtol=1e-9)


def test_residuals_of_circles_are_the_distances_to_the_epipolar_lines_in_pixels():
    rng = np.random.default_rng(4)
    x, y = rng.uniform(0, 1000, (2, 40, 2))
    R, t = random_pose(rng)
    lines = np.column_stack([x, np.ones(40)]) @ fundamental(SKEWED, R, t).T
    distances = ((np.column_stack([y, np.ones(40)]) * lines).sum(1)
                 / np.linalg.norm(lines[:, :2], axis=1))
    residuals = epipolar_residuals(jet_problem(SKEWED, x, circles(y)), R, t)
    assert np.allclose(residuals.r, distances, rtol=1e-9)


def test_residuals_are_down_weighted_near_the_epipole():
    # straight ahead the epipole is the principal point, and lines run outwards from it
    across = np.array([1.0, 5.0, 30.0, 400.0])
    x = K[:2, 2] + across[:, None] * (1, 0)
    y = x + np.array([7.0, 2.0])
    ahead = np.eye(3), np.array([0, 0, -1.0])
    sharp = epipolar_residuals(jet_problem(K, x, circles(y)), *ahead)
    assert np.allclose(np.abs(sharp.r), 2)
    blurred = epipolar_residuals(jet_problem(K, x, circles(y), epipole_blur=5.0), *ahead)
    assert np.allclose(blurred.r / sharp.r, across / np.hypot(across, 5))


@pytest.mark.parametrize('curvature', [7.0, -0.02])
def test_residuals_are_in_pixels_however_curved_all_surfaces_are(curvature):
    """So that losses of different surfaces can be compared; upside down only the sign differs."""
    seen = two_views(np.random.default_rng(5))
    y = seen.y + 0.5
    there = circles(y)
    curved = Paraboloids(y, curvature * there.A, there.b, there.c, there.usable)
    one, other = (epipolar_residuals(jet_problem(K, seen.x, each, epipole_blur=20.0),
                                     seen.R, seen.t) for each in (there, curved))
    np.testing.assert_allclose(other.r, one.r, rtol=1e-9)
    assert (other.sign == np.sign(curvature)).all()


def test_by_its_fit_a_match_is_as_certain_as_its_surface_is_low_within_bounds():
    """The value at the minimum is a noisy estimate of the variance; zero makes nothing certain."""
    seen = two_views(np.random.default_rng(5))
    y, there = seen.y + 0.5, circles(seen.y + 0.5)
    values = np.full(len(y), 8.0)
    values[:4] = 0.0, 4.0, 32.0, 0.5
    surfaces = Paraboloids(y, there.A, there.b, values, there.usable)
    alike, by_fit = (epipolar_residuals(jet_problem(K, seen.x, surfaces, by_fit=each),
                                        seen.R, seen.t).r for each in (False, True))
    np.testing.assert_allclose((alike / by_fit)[:5]**2, (0.25, 0.5, 4, 0.25, 1), rtol=1e-9)


def test_a_flat_surface_has_no_weight():
    seen = two_views(np.random.default_rng(5))
    surfaces = circles(seen.y + 0.5)
    surfaces.A[:7] = 0
    R, t = moved_pose(seen.R, seen.t, 0.01, np.random.default_rng(5))
    residuals = epipolar_residuals(jet_problem(K, seen.x, surfaces), R, t)
    assert np.abs(residuals.r[:7]).max() < 0.01 * np.median(np.abs(residuals.r[7:]))
    assert np.abs(residuals.jacobian[:, :7]).max() < 0.01 * np.abs(residuals.jacobian).max()


def test_a_subset_of_matches_has_the_same_residuals():
    rng = np.random.default_rng(6)
    x, y = rng.uniform(0, 1000, (2, 20, 2))
    problem, pose = jet_problem(K, x, random_surfaces(rng, y, 'bowls')), random_pose(rng)
    whole = epipolar_residuals(problem, *pose)
    part = epipolar_residuals(problem.subset(np.array([3, 11])), *pose)
    assert np.allclose(part.r, whole.r[[3, 11]])
    assert np.allclose(part.jacobian, whole.jacobian[:, [3, 11]])


@given(seed=st.integers(0, 2**32 - 1))
def test_a_step_gives_a_valid_pose_at_its_own_distance(seed):
    rng = np.random.default_rng(seed)
    R, t = random_pose(rng)
    step = 1e-3 * rng.normal(size=5)
    R_new, t_new = retract(R, t, sphere_tangents(t), step)
    assert np.allclose(R_new @ R_new.T, np.eye(3), atol=1e-12)
    assert np.linalg.norm(t_new) == pytest.approx(1, abs=1e-12)
    assert np.allclose(Rotation.from_matrix(R_new @ R.T).as_rotvec(), step[:3], atol=1e-12)
    assert direction_angle(t, t_new) == pytest.approx(np.linalg.norm(step[3:]), rel=1e-4)


@pytest.mark.parametrize('name', LOSSES)
@pytest.mark.parametrize('scale', [0.3, 1.0, 4.0])
def test_the_weight_of_a_loss_is_its_derivative_by_the_squared_residual(name, scale):
    loss = Loss(name, scale)
    squared = np.geomspace(1e-4, 1e4, 400)
    _, weights = loss(squared)
    numeric = (loss(squared * (1 + 1e-6))[0] - loss(squared * (1 - 1e-6))[0]) / (2e-6 * squared)
    bend = np.isclose(squared, scale**2, rtol=1e-5)
    assert np.allclose(weights[~bend], numeric[~bend], rtol=1e-4, atol=1e-12)


@pytest.mark.parametrize('name', LOSSES)
def test_the_curvature_of_a_loss_is_half_its_second_derivative(name):
    loss, step = Loss(name, 1.3), 1e-4
    r = np.linspace(0.01, 8, 300)
    r = r[np.abs(r - 1.3) > 0.01]  # where Huber's bends
    low, middle, high = (loss((r + d)**2)[0] for d in (-step, 0, step))
    assert np.allclose(loss.curvature(r**2), (low - 2 * middle + high) / (2 * step**2), atol=1e-5)


@pytest.mark.parametrize('name', LOSSES)
def test_a_loss_grows_with_the_residual_and_is_its_square_while_that_is_small(name):
    loss = Loss(name, 2.0)
    values, weights = loss(np.linspace(0, 30, 500)**2)
    assert values[0] == 0
    assert (np.diff(values) > 0).all()
    assert (np.diff(weights) <= 1e-12).all() and (weights > 0).all()
    small = np.array([1e-6, 1e-4])
    assert np.allclose(loss(small)[0], small, rtol=1e-3)


def test_losses_differ_in_the_cost_of_a_gross_outlier():
    gross = np.array([1e6])
    none, huber, cauchy, geman = (Loss(name, 2.0)(gross)[0][0] for name in LOSSES)
    assert none == 1e6
    assert huber == pytest.approx(2 * 2.0 * 1e3 - 2.0**2)
    assert cauchy == pytest.approx(4 * np.log(1 + 1e6 / 4))
    assert geman == pytest.approx(4, rel=1e-4)


def test_an_unknown_loss_is_refused_by_name():
    with pytest.raises(ValueError, match="loss is 'tukey'"):
        Loss('tukey')(np.ones(1))


@pytest.mark.parametrize('kind', ['bowls', 'indefinite'])
@pytest.mark.parametrize('name', LOSSES)
def test_minimising_never_ends_above_the_cost_of_the_start(name, kind):
    rng = np.random.default_rng(7)
    loss = Loss(name, 1.0)
    for _ in range(25):
        x, y = rng.uniform(0, 1000, (2, 40, 2))
        problem = jet_problem(K, x, random_surfaces(rng, y, kind))
        R, t = random_pose(rng)
        start = epipolar_residuals(problem, R, t)
        cost = (start.sign * loss(start.r**2)[0]).sum()
        found = minimise(problem, R, t, loss)
        there = epipolar_residuals(problem, found.R, found.t)
        assert (there.sign * loss(there.r**2)[0]).sum() <= cost
        # and the solution has the residuals and costs of its pose
        assert np.allclose(found.residuals.r, there.r)


@pytest.mark.parametrize('name', LOSSES)
@pytest.mark.parametrize('t', [SIDEWAYS, FORWARD, BACKWARD])
@pytest.mark.parametrize('camera', [K, SKEWED])
def test_without_noise_the_exact_pose_is_found_from_degrees_away(camera, t, name):
    rng = np.random.default_rng(8)
    seen = two_views(rng, t=t, K=camera)
    problem = jet_problem(camera, seen.x, circles(seen.y))
    for _ in range(5):
        start = moved_pose(seen.R, seen.t, np.deg2rad(2), rng)
        found = minimise(problem, *start, Loss(name, 10.0))
        assert rotation_angle(found.R, seen.R) < 1e-9
        assert direction_angle(found.t, seen.t) < 1e-9


@pytest.mark.parametrize('kind', ['bowls', 'indefinite'])
@pytest.mark.parametrize('name', LOSSES)
def test_at_the_minimum_the_gradient_of_the_summed_loss_vanishes(name, kind):
    rng = np.random.default_rng(9)
    seen = two_views(rng)
    surfaces = circles(seen.y + rng.normal(0, 0.5, seen.y.shape))
    if kind == 'indefinite':
        surfaces.A[::10] *= -0.5  # some peaks, which push
    problem = jet_problem(K, seen.x, surfaces)
    loss = Loss(name, 1.0)
    found = minimise(problem, *moved_pose(seen.R, seen.t, 0.01, rng), loss, 100)

    def cost(step):
        there = epipolar_residuals(problem, *retract(
            found.R, found.t, found.residuals.tangents, step))
        return (there.sign * loss(there.r**2)[0]).sum()

    gradient = approx_fprime(np.zeros(5), cost, 1e-7)
    uphill = approx_fprime(np.full(5, 1e-3), cost, 1e-7)
    assert np.linalg.norm(gradient) < 1e-2 * np.linalg.norm(uphill)


def test_a_third_of_outliers_biases_only_least_squares():
    rng = np.random.default_rng(10)
    seen = two_views(rng)
    y = seen.y.copy()
    y[::3] += rng.uniform(-60, 60, y[::3].shape)
    problem = jet_problem(K, seen.x, circles(y))
    start = moved_pose(seen.R, seen.t, np.deg2rad(0.5), rng)
    errors = {name: rotation_angle(minimise(problem, *start, Loss(name, 0.5), 100).R, seen.R)
              for name in LOSSES}
    assert errors['geman_mcclure'] < 1e-4 and errors['cauchy'] < 1e-3
    assert errors['none'] > 1e-2


@given(arrays(float, st.integers(1, 9), elements=st.floats(-10, 10)))
def test_the_median_is_that_of_numpy(values):
    assert np.isclose(median(values), np.median(values), atol=1e-12)


def test_the_robust_scale_is_the_standard_deviation_of_the_inliers():
    rng = np.random.default_rng(11)
    residuals = rng.normal(0, 0.7, 100_000)
    assert robust_scale(residuals) == pytest.approx(0.7, rel=0.02)
    residuals[:5000] = 1e6
    assert robust_scale(residuals) == pytest.approx(0.7, rel=0.1)


def test_the_clipped_scale_is_that_of_the_inliers_even_if_most_are_outliers():
    rng = np.random.default_rng(13)
    right = rng.normal(0, 0.1, 10_000)
    false = rng.uniform(-20, 20, 15_000)
    assert clipped_scale(np.concatenate([right, false])) == pytest.approx(0.1, rel=0.05)
    assert clipped_scale(right) == pytest.approx(0.1, rel=0.05)
    assert clipped_scale(np.full(30, 2.0)) == pytest.approx(robust_scale(np.full(30, 2.0)))


@pytest.mark.parametrize('rounds', [1, 6, 7, 8, 9])
def test_the_clipped_scale_of_exact_matches_is_zero_after_any_round(monkeypatch, rounds):
    monkeypatch.setattr(jet, '_CLIPPING_ROUNDS', rounds)
    assert clipped_scale(np.zeros(10)) == 0.0
    assert clipped_scale(np.append(np.zeros(10), [3.0, 5.0, 9.0])) == 0.0


def test_degenerate_matches_leave_the_pose_finite():
    one = two_views(np.random.default_rng(12), count=1)
    for count in (1, 30):
        x, y = np.tile(one.x, (count, 1)), np.tile(one.y, (count, 1))
        problem = jet_problem(K, x, circles(y + 3))
        found = minimise(problem, one.R, one.t, Loss())
        assert np.isfinite(found.R).all() and np.linalg.norm(found.t) == pytest.approx(1)
