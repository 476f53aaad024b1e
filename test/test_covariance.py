"""Consistency of the covariance on scenes other than the one it was calibrated on."""

from __future__ import annotations

from pathlib import Path

from cards import Cards, K as CARDS_K, pose as card_pose
from djet_ros.core.covariance import (
    calibration_covariance,
    curvature_at,
    loss_hessian,
    pose_covariance,
    widened_by_profile,
)
from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.estimator_config import EstimatorConfig, preset
from djet_ros.core.geometry import rotation_log, sphere_log, sphere_tangents, unit
from djet_ros.core.jet import epipolar_residuals, jet_problem, Loss, minimise, Residuals, retract
from djet_ros.core.paraboloid import Paraboloids
from djet_ros.core.surfaces import DescriptorSurface, ReprojectionSurface, resolve_indefinite
from djet_ros.core.types import Pose, Status
from djet_ros.lab.scenes.pair import render_pair
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from two_view import BACKWARD, FORWARD, K, SIDEWAYS, SKEWED, two_views
import yaml

BOUNDS = Path(__file__).parents[1] / 'doc' / 'bounds.yaml'


def normalised_squared_error(name: str, first: int) -> float:
    """e^T C^-1 e over the five degrees of freedom of a pair; 5 on average if C is correct."""
    pair = render_pair(name, first, seed=3)
    estimator = TwoViewEstimator(preset('best'))
    pose = estimator.estimate(*(estimator.view(gray, pair.K)
                                for gray in (pair.previous, pair.current)))
    assert pose.status is Status.OK
    error = np.concatenate([Rotation.from_matrix(pair.R @ pose.R.T).as_rotvec(),
                            sphere_log(pose.t, unit(pair.t))])
    return float(error @ np.linalg.solve(pose.covariance_5, error))


def test_exact_matches_have_a_tiny_but_finite_covariance():
    rng = np.random.default_rng(9)
    t = unit(np.array([0.1, 0.2, -1.0]))
    exact = Residuals(np.zeros(100), np.ones(100), 700 * rng.normal(size=(5, 100)),
                      sphere_tangents(t))
    covariance, _ = pose_covariance(exact, Loss(), rng.uniform(0, 400, (100, 2)), t, False)
    variances = np.linalg.eigvalsh(covariance)
    assert np.isfinite(variances).all() and (variances < 1e-8).all()


def test_no_variance_is_negative_where_the_pose_is_not_at_the_minimum() -> None:
    # Of the 5-point algorithm residuals are not noise, and cells pull in opposite directions.
    cards, rng, determined = Cards(3), np.random.default_rng(3), 0
    for number in range(6):
        here = card_pose(*rng.uniform(-0.6, 0.6, 3) * (1, 0.3, 1))
        step = card_pose(*rng.uniform(-0.3, 0.3, 3), yaw=rng.uniform(-0.03, 0.03))
        estimator = TwoViewEstimator(EstimatorConfig(
            method='five_point', max_features=(250, 500, 1000)[number % 3]))
        pair = estimator.estimate(*(
            estimator.view(cards.gray(there, noise=noise), CARDS_K)
            for there, noise in ((here, number), (here @ step, number + 50))))
        if np.isfinite(pair.covariance_5).all():
            determined += 1
            assert np.linalg.eigvalsh(pair.covariance_5)[0] > 0
    assert determined > 3


def calibrated(K: np.ndarray, f: float = 0.0, cx: float = 0.0, cy: float = 0.0) -> np.ndarray:
    """Camera matrix with an error of so many pixels."""
    return K + np.array([[f, 0, cx], [0, f, cy], [0, 0, 0]])


@pytest.mark.parametrize('camera', [K, SKEWED])
@pytest.mark.parametrize('t', [SIDEWAYS, FORWARD, BACKWARD])
def test_a_calibration_error_moves_a_pose_as_its_covariance_predicts(camera, t):
    views, off = two_views(np.random.default_rng(5), t=t, K=camera), 0.5
    # Gross outliers do not pull it.
    views.y[::10] += np.random.default_rng(7).normal(0, 200, views.y[::10].shape)
    loss, count = Loss('geman_mcclure', 3.0), len(views.x)
    sharp = np.random.default_rng(6).uniform(0.5, 2, (count, 1, 2)) * np.eye(2)
    surfaces = Paraboloids(views.y, sharp + 0.2, np.zeros((count, 2)), np.zeros(count),
                           np.ones(count, bool))

    def problem(matrix):
        return jet_problem(matrix, views.x, surfaces, epipole_blur=5.0)

    right = problem(camera)
    there = minimise(right, views.R, views.t, loss)
    moves = []
    for name in ('f', 'cx', 'cy'):
        wrong = minimise(problem(calibrated(camera, **{name: off})), views.R, views.t, loss)
        moves.append(np.append(rotation_log(wrong.R @ there.R.T), wrong.t - there.t))
    moves = np.transpose(moves)
    size = np.sqrt(np.diag(moves @ moves.T))
    assert size[:3].max() > 1e-5 and size[3:].max() > 1e-4
    for flipped in (False, True):
        estimated = calibration_covariance(right, camera, there.pose, there.residuals, loss, off,
                                           flipped)
        # The opposite direction moves oppositely.
        expected = np.diag([1] * 3 + [-1 if flipped else 1] * 3) @ moves
        np.testing.assert_array_less(np.abs(estimated - expected @ expected.T),
                                     0.05 * np.outer(size, size))


@pytest.mark.slow
def test_covariance_is_consistent_with_calibration_errors():
    # Half a pixel, as between conventions of the pixel centre, is ten times the error of a pair
    # with the correct calibration.
    rng, found = np.random.default_rng(0), {0.0: [], 0.5: []}
    estimators = {sigma: TwoViewEstimator(preset('best', calibration_sigma=sigma))
                  for sigma in found}
    for name, first in (('road', 5), ('road', 40), ('indoor', 3), ('forest', 5)):
        pair = render_pair(name, first, seed=3)
        for off in rng.normal(0, 0.5, (8, 3)):
            exact, poses = estimators[0.0], {}
            views = [exact.view(gray, calibrated(pair.K, *off))
                     for gray in (pair.previous, pair.current)]
            for sigma, estimator in estimators.items():
                pose = poses[sigma] = estimator.estimate(*views)
                error = np.append(rotation_log(pair.R @ pose.R.T),
                                  sphere_log(pose.t, unit(pair.t)))
                found[sigma].append(error @ np.linalg.solve(pose.covariance_5, error))
            # Only the covariance differs.
            assert poses[0.0].status is poses[0.5].status is Status.OK
            assert poses[0.0].R.tobytes() == poses[0.5].R.tobytes()
            assert poses[0.0].t.tobytes() == poses[0.5].t.tobytes()
    most = chi2.ppf(0.95, 5)
    assert np.mean(np.array(found[0.0]) < most) < 0.5
    assert np.mean(np.array(found[0.5]) < most) > 0.9
    assert np.median(found[0.5]) / chi2.median(5) > 0.5


@pytest.mark.slow
def test_errors_are_consistent_with_the_covariance():
    # Distant pairs, with independent errors. Within a factor of 2 in variance, 1.4 in standard
    # deviation: errors of real surfaces are not Gaussian.
    found = [normalised_squared_error(name, first)
             for name in ('road', 'loop', 'sharp_turn', 'underwater')
             for first in range(5, 100, 19)]
    bounds = yaml.safe_load(BOUNDS.read_text())['normalised_squared_error']
    assert bounds['least'] < np.mean(found) < bounds['most']


def test_flipping_t_flips_its_cross_covariance():
    rng = np.random.default_rng(0)
    t = unit(np.array([0.2, -0.1, -1.0]))
    residuals = Residuals(rng.normal(size=400), np.ones(400), rng.normal(size=(5, 400)),
                          sphere_tangents(t))
    places = rng.uniform(0, 1000, (400, 2))
    same, opposite = (pose_covariance(residuals, Loss(), places, sign * t, sign < 0)[1]
                      for sign in (1, -1))
    assert np.allclose(opposite[:3, :3], same[:3, :3])
    assert np.allclose(opposite[3:, 3:], same[3:, 3:])
    assert np.allclose(opposite[:3, 3:], -same[:3, 3:])
    assert np.linalg.matrix_rank(same, 1e-12) == 5


def test_duplicated_matches_do_not_reduce_the_covariance():
    rng = np.random.default_rng(1)
    t = np.array([0.0, 0, 1])
    J, r, places = rng.normal(size=(5, 300)), rng.normal(size=300), rng.uniform(0, 1000, (300, 2))
    once = pose_covariance(Residuals(r, np.ones(300), J, sphere_tangents(t)), Loss(), places, t,
                           False)[0]
    twice = pose_covariance(
        Residuals(np.tile(r, 2), np.ones(600), np.tile(J, 2), sphere_tangents(t)), Loss(),
        np.tile(places, (2, 1)), t, False)[0]
    assert np.allclose(once, twice)


def test_a_direction_determined_by_one_match_is_as_uncertain_as_it():
    rng = np.random.default_rng(2)
    t, places, off = np.array([0.0, 0, 1]), rng.uniform(0, 1000, (300, 2)), []
    for _ in range(300):
        J, noise = rng.normal(size=(5, 300)), rng.normal(size=300)
        J[4] /= 100
        J[4, 7] = 2  # 99 % of what is known of the fifth parameter
        error = np.linalg.solve(J @ J.T, J @ noise)
        residuals = Residuals(noise - error @ J, np.ones(300), J, sphere_tangents(t))
        covariance = pose_covariance(residuals, Loss(), places, t, False)[0]
        off.append(error / np.sqrt(np.diag(covariance)))
    # Its residual is a hundredth of its noise; errors are nevertheless no larger than predicted,
    # and those of the other parameters hardly smaller.
    typical = np.median(np.abs(off), axis=0) / 0.6745
    assert np.all((typical[:4] > 0.8) & (typical[:4] < 1.05)) and typical[4] < 1


def test_a_pose_that_depends_on_one_match_is_undetermined():
    rng = np.random.default_rng(3)
    t = np.array([0.0, 0, 1])
    J, r, places = rng.normal(size=(5, 300)), rng.normal(size=300), rng.uniform(0, 1000, (300, 2))
    J[4] = 0
    J[4, 7], r[7] = 1, 0  # the pose goes where the match wants it, and nothing is left to see
    residuals = Residuals(r, np.ones(300), J, sphere_tangents(t))
    assert np.isnan(pose_covariance(residuals, Loss(), places, t, False)[0]).all()


@pytest.mark.parametrize('parts', [1, 2])
def test_what_one_part_of_the_image_determines_alone_is_undetermined(parts):
    """However many matches it has: they may all be of one object."""
    rng, t = np.random.default_rng(4), np.array([0.0, 0, 1])
    places, J = rng.uniform((0, 0), (1240, 376), (600, 2)), rng.normal(size=(5, 600))
    places[:200] = rng.uniform(10, 130, (200, 2))
    places[:200:2] += (900, 200) if parts == 2 else (0, 0)
    J[4, 200:] = 0
    residuals = Residuals(rng.normal(size=600), np.ones(600), J, sphere_tangents(t))
    covariance = pose_covariance(residuals, Loss(), places, t, False)[0]
    assert np.isfinite(covariance).all() == (parts == 2)


@pytest.mark.slow
def test_minima_do_not_follow_small_displacements_of_their_keypoints():
    pair = render_pair('road', 5, seed=1, size=(620, 188))
    estimator = TwoViewEstimator()
    views = [estimator.view(gray, pair.K) for gray in (pair.previous, pair.current)]
    x = views[0].features.points
    y, seen = pair.project(x)
    x, y = x[seen], y[seen]
    as_it_is = np.repeat(np.eye(3, 2)[None], len(x), 0)
    rng = np.random.default_rng(0)
    drawn = []
    for _ in range(5):
        surface = DescriptorSurface(*views, x, estimator.config)
        surface.fit_around(y)  # without what it looks like there; tells the contrast
        off = rng.normal(0, 0.1, x.shape)
        fits = [resolve_indefinite(surface.fit_around(place, as_it_is), 'project')[0]
                for place in (y, y + off)]
        right = np.all([one.usable & (np.abs(one.minima() - y).max(1) < 0.5) for one in fits], 0)
        moved = (fits[1].minima() - fits[0].minima())[right]
        drawn.append((moved * off[right]).sum() / (off[right]**2).sum())
    # As fitted, paraboloids follow by a quarter of the displacement.
    assert abs(np.mean(drawn)) < 0.1


@pytest.mark.parametrize('reach', [0, 40, 80])
def test_errors_correlated_over_many_patches_inflate_the_covariance(reach):
    # Half of the noise is a field that hardly changes over so many pixels: if patches were taken
    # as independent, a tenth of the poses would lie within the 95 % ellipsoid.
    rng, t, squares = np.random.default_rng(0), np.array([0.0, 0, 1]), []
    for _ in range(60):
        places = rng.uniform(0, 1, (1500, 2)) * [1200, 400]
        u, v = (places / [600, 200] - 1).T
        near = rng.uniform(0, 1, 1500)
        J = np.stack([np.ones(1500), u, v, near * u, near * v])
        noise = rng.normal(size=1500)
        if reach:
            waves, phases = rng.normal(size=(60, 2)) / reach, rng.uniform(0, 2 * np.pi, 60)
            field = np.sqrt(2 / 60) * np.cos(places @ waves.T + phases).sum(1)
            noise = np.sqrt(0.5) * (noise + field)
        error = np.linalg.solve(J @ J.T, J @ noise)
        residuals = Residuals(noise - error @ J, np.ones(1500), J, sphere_tangents(t))
        covariance = pose_covariance(residuals, Loss(), places, t, False)[0]
        squares.append(error @ np.linalg.solve(covariance, error))
    assert np.mean(np.array(squares) < chi2.ppf(0.95, 5)) > 0.9
    # And the covariance is not far too large.
    assert np.median(squares) / chi2.median(5) > 0.4


@pytest.mark.parametrize(('share', 'least', 'most'), [(0.01, 1.0, 1.02), (1.0, 1.0, 1.1),
                                                      (100.0, 2.0, 400.0)])
def test_profile_widens_where_matches_become_outliers(share, least, most):
    rng = np.random.default_rng(4)
    views = two_views(rng, 400)
    surface = ReprojectionSurface(views.x, views.y)
    problem = jet_problem(views.K, views.x, surface.fit_around(views.y))
    loss, pose = Loss('geman_mcclure', 0.3), Pose(views.R, views.t)
    residuals = epipolar_residuals(problem, views.R, views.t)
    J = residuals.jacobian
    # The noise is a tenth of the scale of the loss: the bound is within it, or far beyond.
    claimed = np.linalg.inv(J @ J.T) * (0.03 * share)**2
    estimated = widened_by_profile(claimed, problem, pose, loss, residuals,
                                   curvature_at(residuals, loss))
    wider = np.linalg.eigvals(np.linalg.solve(claimed, estimated)).real
    assert wider.min() > least - 1e-9 and wider.max() < most
    # A sum of squares rises as its curvature predicts, for small differences of the pose.
    squares = widened_by_profile(claimed, problem, pose, Loss(), residuals,
                                 curvature_at(residuals, Loss()))
    assert np.allclose(np.linalg.eigvals(np.linalg.solve(claimed, squares)).real, 1, atol=0.2)


@pytest.mark.parametrize('t', [SIDEWAYS, FORWARD, (0.6, 0.8, 0.0)])
def test_the_hessian_of_a_loss_is_that_of_its_second_differences(t):
    rng = np.random.default_rng(6)
    views = two_views(rng, 300, t=t, near=100, far=120)
    y = views.y + rng.normal(0, 0.5, views.y.shape)
    problem = jet_problem(views.K, views.x, ReprojectionSurface(views.x, y).fit_around(y), 5.0)
    loss = Loss('geman_mcclure', 1.0)
    end = minimise(problem, views.R, views.t, loss)

    def cost(step):
        at = epipolar_residuals(problem, *retract(end.R, end.t, end.residuals.tangents, step))
        return loss(at.r**2)[0].sum() / 2

    steps = 2e-5 * np.eye(5)
    differences = [[cost(one + other) - cost(one - other) - cost(other - one) + cost(-one - other)
                    for other in steps] for one in steps]
    expected = np.array(differences) / (2 * steps[0, 0])**2
    found = loss_hessian(problem, end.pose, end.residuals, loss)
    size = np.sqrt(np.diag(expected))
    np.testing.assert_array_less(np.abs(found - expected), 0.01 * np.outer(size, size))


@pytest.mark.parametrize('direction', [2, -2])
def test_a_pose_off_its_minimum_is_widened_towards_either_side(direction):
    views = two_views(np.random.default_rng(5), count=300)
    surface = ReprojectionSurface(views.x, views.y)
    problem = jet_problem(views.K, views.x, surface.fit_around(views.y))
    residuals = epipolar_residuals(problem, views.R, views.t)
    claimed = np.linalg.inv(residuals.jacobian @ residuals.jacobian.T) * 0.01**2
    variances, axes = np.linalg.eigh(claimed)
    for variance, axis in zip(variances, axes.T):
        pose = Pose(*retract(views.R, views.t, residuals.tangents,
                             direction * np.sqrt(variance) * axis))
        there = epipolar_residuals(problem, pose.R, pose.t)
        estimated = widened_by_profile(claimed, problem, pose, Loss(), there,
                                       curvature_at(there, Loss()))
        assert axis @ estimated @ axis > 50 * variance


def test_bounds_hold_for_a_covariance_from_a_small_sample():
    # As many cells as matches, and few of them: normalised errors are not Gaussian.
    rng, t, squares = np.random.default_rng(5), np.array([0.0, 0, 1]), []
    for _ in range(1000):
        J, noise = rng.normal(size=(5, 16)), rng.normal(size=16)
        error = np.linalg.solve(J @ J.T, J @ noise)
        residuals = Residuals(noise - error @ J, np.ones(16), J, sphere_tangents(t))
        covariance = pose_covariance(residuals, Loss(), 40 * np.arange(32.0).reshape(16, 2), t,
                                     False)[0]
        squares.append(error @ np.linalg.solve(covariance, error))
    assert np.mean(np.array(squares) < chi2.ppf(0.95, 5)) > 0.92
    assert np.mean(np.array(squares) > chi2.ppf(0.999, 5)) <= 0.005
