"""Distinct basins among the poses that starts lead to."""

from itertools import combinations

from djet_ros.core.basins import choose_basin
from djet_ros.core.covariance import CHI2_999, pose_difference
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.geometry import rays
from djet_ros.core.jet import epipolar_residuals, JetProblem
from djet_ros.core.starts import hemisphere_starts
import numpy as np
import pytest
from two_view import K, SIDEWAYS, two_views

NOISE = 0.5


@pytest.mark.parametrize('seed', range(16))
def test_basins_of_a_pair_differ_significantly_for_its_matches(seed):
    """Distant points leave a valley of minima, as rotation compensates for sideways motion."""
    rng = np.random.default_rng(seed)
    views = two_views(rng, 100, SIDEWAYS, near=30.0)
    y = views.y + rng.normal(0, NOISE, views.y.shape)
    spread = np.repeat([[1.0], [0.0], [1.0]], len(y), axis=1) / K[0, 0]**2
    problem = JetProblem(rays(K, views.x).T.copy(), rays(K, y).T.copy(), spread, np.zeros(len(y)))
    basin = choose_basin(problem, views.x, hemisphere_starts(views.R, 12), EstimatorConfig(), None,
                         None)
    for one, other in combinations([basin.pose, *basin.rivals], 2):
        residuals = epipolar_residuals(problem, one.R, one.t)
        near = residuals.jacobian[:, np.abs(residuals.r) < 3 * NOISE]
        off = pose_difference(one.R, one.t, other)
        # The noise of the best matches.
        assert off @ (near @ near.T) @ off / NOISE**2 > CHI2_999 / 2
