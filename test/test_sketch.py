"""Joint refinement of starting poses: the same least squares as for single ones."""

from djet_ros.core.geometry import direction_angle, rotation_angle
from djet_ros.core.jet import epipolar_residuals, jet_problem, Loss, minimise
from djet_ros.core.sketch import refine_all
from djet_ros.core.types import Pose
from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
from test_jet import LOSSES, random_surfaces
from two_view import FORWARD, K, moved_pose, SIDEWAYS, two_views

STARTS = 7


def problem_of(rng, t, kind='bowls'):
    """Exact matches, a fifth of them replaced by outliers, and poses around the true one."""
    views = two_views(rng, 300, t)
    y = views.y.copy()
    y[::5] += rng.normal(0, 40, y[::5].shape)
    surfaces = random_surfaces(rng, y, kind)
    # Exact but for the false ones: the minimum of a surface lies at its y.
    surfaces.b[:] = 0
    poses = [moved_pose(views.R, views.t, angle, rng) for angle in rng.uniform(0, 0.2, STARTS)]
    return views, jet_problem(K, views.x, surfaces, epipole_blur=5.0), [
        Pose(R, t) for R, t in poses]


@pytest.mark.parametrize('kind', ['bowls', 'indefinite'])
@pytest.mark.parametrize('name', LOSSES)
def test_without_steps_costs_and_residuals_are_those_of_each_pose(name, kind):
    _, problem, starts = problem_of(np.random.default_rng(1), SIDEWAYS, kind)
    loss = Loss(name, 2.0)
    sketch = refine_all(problem, starts, loss, 0)
    for i in range(STARTS):
        alone = epipolar_residuals(problem, starts[i].R, starts[i].t)
        assert np.allclose(sketch.r[i], alone.r, rtol=1e-9, atol=1e-12)
        assert np.isclose(sketch.costs[i], (alone.sign * loss(alone.r**2)[0]).sum(), rtol=1e-9)


@given(seed=st.integers(0, 2**32 - 1), steps=st.integers(1, 8),
       t=st.sampled_from([SIDEWAYS, FORWARD]), name=st.sampled_from(LOSSES))
@settings(max_examples=30, deadline=None)
def test_no_start_ends_above_its_cost(seed, steps, t, name):
    _, problem, starts = problem_of(np.random.default_rng(seed), t)
    loss = Loss(name, 1.0)
    together = refine_all(problem, starts, loss, steps)
    assert (together.costs <= refine_all(problem, starts, loss, 0).costs).all()
    alone = refine_all(problem, starts[2:3], loss, steps)
    assert np.allclose(alone.R, together.R[2:3], atol=1e-6)
    assert np.allclose(alone.t, together.t[2:3], atol=1e-6)


@pytest.mark.parametrize('t', [SIDEWAYS, FORWARD])
def test_refinement_in_the_true_basin_agrees_with_the_optimiser(t):
    views, problem, starts = problem_of(np.random.default_rng(4), t)
    loss = Loss('geman_mcclure', 1.0)
    sketch = refine_all(problem, starts, loss, 40)
    best = int(np.argmin(sketch.costs))
    exact = minimise(problem, views.R, views.t, loss)
    assert rotation_angle(sketch.R[best], exact.R) < 1e-5
    assert direction_angle(sketch.t[best], exact.t) < 1e-4
    there = refine_all(problem, [Pose(exact.R, exact.t)], loss, 0)
    assert np.isclose(sketch.costs[best], there.costs[0], rtol=1e-3, atol=1e-6)


def test_a_degenerate_start_stays_where_it_is():
    _, problem, starts = problem_of(np.random.default_rng(2), SIDEWAYS)
    empty = problem.subset(np.zeros(len(problem.blur), bool))
    sketch = refine_all(empty, starts, Loss(), 3)
    assert np.allclose(sketch.R, [start.R for start in starts])
    assert np.allclose(sketch.t, [start.t for start in starts])
