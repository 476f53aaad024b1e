"""Which of the poses that starts lead to are basins of their own."""

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
def test_the_basins_of_a_pair_are_told_apart_by_its_matches(seed):
    """Where all is far, and turning makes up for going sideways, many minima lie in one valley."""
    rng = np.random.default_rng(seed)
    views = two_views(rng, 100, SIDEWAYS, near=30.0)
    y = views.y + rng.normal(0, NOISE, views.y.shape)
    spread = np.repeat([[1.0], [0.0], [1.0]], len(y), axis=1) / K[0, 0]**2
    problem = JetProblem(rays(K, views.x).T.copy(), rays(K, y).T.copy(), spread, np.zeros(len(y)))
    basin = choose_basin(problem, views.x, hemisphere_starts(views.R, 12), EstimatorConfig(), None,
                         None)
    for one, other in combinations([basin.pose, *basin.rivals], 2):
        told = epipolar_residuals(problem, one.R, one.t)
        near = told.jacobian[:, np.abs(told.r) < 3 * NOISE]
        off = pose_difference(one.R, one.t, other)
        # As exact as matches that are right would be at most.
        assert off @ (near @ near.T) @ off / NOISE**2 > CHI2_999 / 2
