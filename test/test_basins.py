"""Distinct basins among the poses that starts lead to."""

from itertools import combinations

from djet_ros.core.basins import better_by_parts, choose_basin, choose_predicted_basin
from djet_ros.core.covariance import CHI2_999, pose_difference
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.fusion import MeasuredRotation
from djet_ros.core.geometry import rays, rotation_angle, rotation_exp, unit
from djet_ros.core.jet import epipolar_residuals, JetProblem, Loss, minimise
from djet_ros.core.rivals import pose_distance, PreviousMotion
from djet_ros.core.starts import hemisphere_starts
from djet_ros.core.types import Pose
import numpy as np
import pytest
from two_view import FORWARD, K, project, SIDEWAYS, two_views

NOISE = 0.5


def problem_of(x: np.ndarray, y: np.ndarray) -> JetProblem:
    """Return the problem of matches (N, 2) that are as accurate in all directions."""
    spread = np.repeat([[1.0], [0.0], [1.0]], len(y), axis=1) / K[0, 0]**2
    return JetProblem(rays(K, x).T.copy(), rays(K, y).T.copy(), spread, np.zeros(len(y)))


@pytest.mark.parametrize('seed', range(16))
def test_basins_of_a_pair_differ_significantly_for_its_matches(seed):
    """Distant points leave a valley of minima, as rotation compensates for sideways motion."""
    rng = np.random.default_rng(seed)
    views = two_views(rng, 100, SIDEWAYS, near=30.0)
    y = views.y + rng.normal(0, NOISE, views.y.shape)
    problem = problem_of(views.x, y)
    basin = choose_basin(problem, views.x, hemisphere_starts(views.R, 12), EstimatorConfig(), None,
                         None)
    assert basin.rivals
    for one, other in combinations([basin.pose, *basin.rivals], 2):
        residuals = epipolar_residuals(problem, one.R, one.t)
        near = residuals.jacobian[:, np.abs(residuals.r) < 3 * NOISE]
        off = pose_difference(one.R, one.t, other)
        # The noise of the best matches.
        assert off @ (near @ near.T) @ off / NOISE**2 > CHI2_999 / 2


@pytest.mark.parametrize('seed', range(8))
def test_a_part_of_the_image_shows_that_a_pose_is_a_compromise_of_two_motions(seed):
    """As behind a wide lorry, whose epipolar lines are nearly those of the world."""
    rng = np.random.default_rng(seed)
    views = two_views(rng, 600, FORWARD)
    lorry = (views.x[:, 0] > 300) & (views.x[:, 0] < 700)
    ahead = project(K, views.points @ rotation_exp(np.array([0.01, 0.034, -0.005])).T
                    + unit(np.array([0.25, 0.0, -1.0])))[0]
    world, mixed = (problem_of(views.x, y + rng.normal(0, NOISE / 5, y.shape))
                    for y in (views.y, np.where(lorry[:, None], ahead, views.y)))
    true = Pose(views.R, views.t)
    compromise = minimise(mixed, views.R, views.t, Loss('cauchy', 2.0)).pose
    assert pose_distance(compromise, true) > 0.03
    found = better_by_parts(mixed, views.x, compromise, EstimatorConfig())
    assert found is not None
    assert pose_distance(found, true) < 0.002
    # One motion alone: the pose of all matches is the best.
    of_all = minimise(world, views.R, views.t, Loss('geman_mcclure', NOISE)).pose
    found = better_by_parts(world, views.x, of_all, EstimatorConfig())
    assert found is None or pose_distance(found, of_all) < 0.002


@pytest.mark.parametrize('seed', range(8))
def test_of_a_camera_that_only_turns_no_direction_is_a_rival(seed):
    """Matches that a rotation explains prefer none, so the choice does not matter."""
    rng = np.random.default_rng(seed)
    views = two_views(rng, 200, near=1e5, far=1e6, turn=(0.02, 0.1, -0.03))
    y = views.y + rng.normal(0, NOISE / 2, views.y.shape)
    before = PreviousMotion(rotation_exp(np.array([0.01, 0.09, -0.02])), unit(np.array(FORWARD)))
    basin = choose_predicted_basin(problem_of(views.x, y), views.x, before, EstimatorConfig())
    assert not basin.rivals
    assert rotation_angle(basin.pose.R, views.R) < 0.002


@pytest.mark.parametrize('seed', range(8))
def test_a_measured_rotation_tells_the_camera_from_a_body_with_most_matches(seed):
    rng = np.random.default_rng(seed)
    views = two_views(rng, 400, FORWARD)
    lorry = np.arange(400) % 3 > 0
    ahead = project(K, views.points @ rotation_exp(np.array([0.01, 0.06, -0.005])).T
                    + unit(np.array([0.5, 0.0, -1.0])))[0]
    y = np.where(lorry[:, None], ahead, views.y) + rng.normal(0, NOISE / 5, ahead.shape)
    problem, starts = problem_of(views.x, y), hemisphere_starts(views.R, 12)
    alone, by_gyro = (choose_basin(problem, views.x, starts, EstimatorConfig(), None, measured)
                      for measured in (None, MeasuredRotation(views.R, np.eye(3) * 1e-4**2)))
    # Without it the pose is that of most matches, or a compromise.
    assert rotation_angle(alone.pose.R, views.R) > 5e-3
    assert rotation_angle(by_gyro.pose.R, views.R) < 1e-3
    assert all(rotation_angle(rival.R, views.R) < 3e-3 for rival in by_gyro.rivals)
    # The noise is that of the matches, not that of the outliers.
    assert by_gyro.scale < NOISE
