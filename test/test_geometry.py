"""Two-view geometry, against exact points and independent formulas."""

from __future__ import annotations

from djet_ros.core.geometry import (
    chirality_signs,
    depth_ratio,
    depths_in_second,
    direction_angle,
    epipolar_lines,
    essential,
    fit_rotation,
    fundamental,
    in_front,
    inverse_depths,
    inverses,
    line_distances,
    norms,
    patch_warp,
    rays,
    rotation_angle,
    rotation_exp,
    rotation_log,
    singular_values,
    skew,
    slant_warp,
    sphere_log,
    sphere_tangents,
    turn_before_plane,
    unit,
)
from djet_ros.recordings.trajectories import position_and_quaternion
from hypothesis import example, given, strategies as st
from hypothesis.extra.numpy import arrays
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from two_view import BACKWARD, FORWARD, K, project, SIDEWAYS, SKEWED, two_views

vectors = arrays(float, 3, elements=st.floats(-3, 3))
directions = vectors.filter(lambda v: np.linalg.norm(v) > 1e-3).map(unit)


@given(vectors, vectors)
def test_the_skew_matrix_is_the_cross_product(v, w):
    assert np.allclose(skew(v) @ w, np.cross(v, w), atol=1e-14)


@given(vectors)
@example(np.zeros(3))
@example(np.array([1e-12, 0, 0]))
@example(np.array([0, np.pi, 0]))
def test_a_rotation_is_the_matrix_exponential_of_its_vector(omega):
    assert np.allclose(rotation_exp(omega), expm(skew(omega)), atol=1e-13)


@given(directions)
@example(np.array([0.0, 0.0, 1.0]))
@example(np.array([0.0, 0.0, -1.0]))
@example(np.array([1.0, 0.0, -0.0]))
@example(unit(np.array([1e-9, -1e-9, -1.0])))
def test_the_tangents_of_the_sphere_are_orthonormal_everywhere(t):
    basis = np.column_stack([sphere_tangents(t), t])
    assert np.allclose(basis.T @ basis, np.eye(3), atol=1e-14)


def test_vectorised_functions_agree_with_single_calls():
    v = np.random.default_rng(2).normal(size=(7, 3))
    assert np.allclose(rotation_exp(v), [rotation_exp(one) for one in v], atol=1e-14)
    assert (sphere_tangents(unit(v)) == [sphere_tangents(unit(one)) for one in v]).all()


@given(directions, st.floats(-np.pi, np.pi))
@example(np.array([0.0, 1.0, 0.0]), np.pi)
@example(np.array([0.0, 0.0, 1.0]), 0.0)
def test_a_quaternion_makes_its_rotation_again(axis, angle):
    R = Rotation.from_rotvec(angle * axis).as_matrix()
    pose = np.eye(4)
    pose[:3, :3] = R
    found = position_and_quaternion(pose)[3:]
    assert found[3] >= 0 and norms(np.array(found)) == pytest.approx(1, abs=1e-15)
    assert Rotation.from_quat(found).as_matrix() == pytest.approx(R, abs=1e-15)


@given(directions)
@example(np.array([0.0, 1.0, 0.0]))
def test_the_logarithm_of_a_half_turn_is_about_its_axis_either_way(axis):
    omega = rotation_log(2 * np.outer(axis, axis) - np.eye(3))
    assert abs(omega @ axis) == pytest.approx(np.pi)
    assert norms(omega) == pytest.approx(np.pi)


@given(directions)
@example(np.array([0.0, 0.0, 1.0]))
@example(np.array([1.0, 0.0, 0.0]))
def test_the_arc_to_the_opposite_direction_is_half_a_turn(t):
    assert norms(sphere_log(t, -t)) == pytest.approx(np.pi)


def test_the_logarithm_of_a_direction_is_the_arc_towards_it():
    rng = np.random.default_rng(0)
    t, others = unit(rng.normal(size=3)), unit(rng.normal(size=(50, 3)))
    arcs = sphere_log(t, others)
    assert np.allclose(norms(arcs), np.arccos(others @ t))
    axes = np.cross(t, arcs @ sphere_tangents(t).T)
    assert np.allclose(rotation_exp(axes) @ t, others)
    assert np.allclose(sphere_log(t, t), 0) and np.isclose(norms(sphere_log(t, -t)), np.pi)
    assert np.allclose([sphere_log(t, other) for other in others], arcs)


@given(arrays(float, (5, 2, 2), elements=st.floats(-3, 3)))
def test_a_matrix_times_its_inverse_is_one(A):
    # np.linalg.det divides by a zero pivot
    A = A[np.abs(A[:, 0, 0] * A[:, 1, 1] - A[:, 0, 1] * A[:, 1, 0]) > 1e-3]
    assert np.allclose(inverses(A) @ A, np.eye(2), atol=1e-9)


def test_unit_vectors_have_length_one_and_zero_stays_zero():
    v = unit(np.array([[3.0, 0, 4.0], [0, 0, 0], [1e-100, 0, 0]]))
    assert np.allclose(np.linalg.norm(v, axis=1), [1, 0, 1])
    assert np.allclose(v[0], [0.6, 0, 0.8])


@pytest.mark.parametrize('camera', [K, SKEWED])
def test_rays_go_through_their_pixels(camera):
    pixels = np.random.default_rng(1).uniform(0, 1000, (50, 2))
    through = rays(camera, pixels) @ camera.T
    assert np.allclose(through[:, :2] / through[:, 2:], pixels, atol=1e-9)
    assert np.allclose(rays(camera, pixels)[:, 2], 1)


@pytest.mark.parametrize('camera', [K, SKEWED])
@pytest.mark.parametrize('t', [SIDEWAYS, FORWARD, BACKWARD])
def test_every_point_lies_on_its_epipolar_line(camera, t):
    seen = two_views(np.random.default_rng(2), t=t, K=camera)
    F = fundamental(camera, seen.R, seen.t)
    assert np.abs(line_distances(epipolar_lines(F, seen.x), seen.y)).max() < 1e-9
    # and on no other: the lines are not there by being zero
    other = two_views(np.random.default_rng(2), t=t, K=camera, turn=(0.02, 0.0, 0.0))
    assert np.median(np.abs(line_distances(epipolar_lines(F, other.x), other.y))) > 1


@given(directions, vectors)
def test_an_essential_matrix_has_two_equal_singular_values_and_a_zero(t, omega):
    values = np.linalg.svd(essential(rotation_exp(omega), t), compute_uv=False)
    assert np.allclose(values, [1, 1, 0], atol=1e-12)


def test_the_distance_to_a_line_is_that_to_the_nearest_of_its_points_and_changes_sign_across_it():
    # the line through a with direction u, as a cross product of two of its points
    a, u = np.array([12.0, -7.0]), np.array([0.6, 0.8])
    line = np.cross([*a, 1], [*(a + 5 * u), 1])
    across = np.array([-0.8, 0.6])
    offsets = np.array([-3.5, 0.0, 1e-6, 20.0])
    y = a + 31.0 * u + offsets[:, None] * across
    distances = line_distances(np.tile(line, (4, 1)), y)
    assert np.allclose(np.abs(distances), np.abs(offsets), atol=1e-12)
    assert distances[0] * distances[3] < 0


@pytest.mark.parametrize('t', [SIDEWAYS, FORWARD, BACKWARD])
@pytest.mark.parametrize(('near', 'far'), [(4.0, 40.0), (1e3, 1e5)])
def test_only_the_true_one_of_four_motions_has_all_points_in_front(t, near, far):
    """Also a thousand baselines away, where cv2.recoverPose ignores points."""
    seen = two_views(np.random.default_rng(3), t=t, near=near, far=far)
    rays_x, rays_y = rays(K, seen.x), rays(K, seen.y)
    half_turn = Rotation.from_rotvec(np.pi * seen.t).as_matrix()
    assert in_front(seen.R, seen.t, rays_x, rays_y).all()
    for R, t in ((seen.R, -seen.t), (half_turn @ seen.R, seen.t), (half_turn @ seen.R, -seen.t)):
        assert np.allclose(np.abs(np.einsum('ni,ij,nj->n', rays_y, essential(R, t), rays_x)), 0,
                           atol=1e-9)
        assert not in_front(R, t, rays_x, rays_y).any()


@pytest.mark.parametrize('t', [SIDEWAYS, FORWARD, BACKWARD])
def test_each_point_votes_for_the_sign_that_brings_it_in_front_of_both_cameras(t):
    seen = two_views(np.random.default_rng(8), t=t)
    before, after = rays(K, seen.x), rays(K, seen.y)
    for sign in (1, -1):
        votes = chirality_signs(seen.R, sign * seen.t, before, after)
        assert np.array_equal(votes, np.full(len(before), sign))
    # One that looks back sees nothing of what the other one does.
    back = Rotation.from_rotvec([0, np.pi, 0]).as_matrix()
    behind = seen.points @ back.T + seen.t
    assert not chirality_signs(back, seen.t, before, behind / behind[:, 2:]).any()


@pytest.mark.parametrize('t', [SIDEWAYS, FORWARD, BACKWARD])
def test_depths_in_the_second_camera_are_those_of_the_moved_points(t):
    seen = two_views(np.random.default_rng(9), t=t, K=SKEWED)
    depths = seen.points[:, 2]
    grown = depths_in_second(seen.R, seen.t, rays(SKEWED, seen.x), 1 / depths)
    assert np.allclose(grown * depths, project(SKEWED, seen.points @ seen.R.T + seen.t)[1])


def test_chirality_is_decided_per_point():
    seen = two_views(np.random.default_rng(4), t=SIDEWAYS)
    rays_y = rays(K, seen.y)
    behind = np.arange(len(rays_y)) % 3 == 0
    # mirrored at the direction of the far point, a point's parallax has the wrong sign
    far_away = rays(K, seen.x) @ seen.R.T
    rays_y[behind] = 2 * far_away[behind] - rays_y[behind]
    assert np.array_equal(in_front(seen.R, seen.t, rays(K, seen.x), rays_y), ~behind)


@pytest.mark.parametrize('t', [FORWARD, BACKWARD, SIDEWAYS])
def test_depth_ratio_is_depth_before_over_depth_after(t):
    seen = two_views(np.random.default_rng(6), t=t, near=3, far=30)
    depths = seen.points[:, 2], (seen.points @ seen.R.T + seen.t)[:, 2]
    for sign in (1, -1):  # t and -t have the same essential matrix
        found = depth_ratio(seen.R, sign * seen.t, rays(K, seen.x), rays(K, seen.y))
        assert np.allclose(found, depths[0] / depths[1])


@pytest.mark.parametrize('t', [FORWARD, SIDEWAYS])
def test_a_fronto_parallel_patch_is_warped_as_its_points_move(t):
    seen = two_views(np.random.default_rng(7), t=t, near=3, far=30)
    grown = depth_ratio(seen.R, seen.t, rays(K, seen.x), rays(K, seen.y))
    warp = patch_warp(K, seen.R, seen.y, grown)
    for step in ((1e-4, 0), (0, 1e-4), (13, 13), (-13, 4)):
        there, _ = project(K, (rays(K, seen.x + step) * seen.points[:, 2:]) @ seen.R.T + seen.t)
        moved = warp @ step
        assert np.allclose(there - seen.y, moved[:, :2] / (1 + moved[:, 2:]), atol=1e-8)


def test_patch_warps_of_several_cameras_agree_with_single_ones():
    rng = np.random.default_rng(8)
    R, t = rotation_exp(rng.normal(0, 0.1, (5, 3))), rng.normal(size=(5, 3))
    y, grown, slope = rng.uniform(0, 300, (5, 2)), rng.uniform(0.5, 2, 5), rng.normal(size=(5, 2))
    together = patch_warp(K, R, y, grown) + slant_warp(K, t, y, grown, slope)
    for i, some in enumerate(np.arange(5)[:, None]):
        seen = y[some], grown[some]
        alone = patch_warp(K, R[i], *seen) + slant_warp(K, t[i], *seen, slope[some])
        assert np.allclose(together[some], alone, rtol=1e-12)


def test_singular_values_are_those_of_numpy():
    warps = np.random.default_rng(8).normal(size=(50, 2, 2))
    warps[0] = 2 * np.eye(2)
    expected = np.linalg.svd(warps, compute_uv=False)
    assert np.allclose(singular_values(warps), expected.T[::-1])


def test_a_rotation_fit_is_exact_and_robust_to_outliers():
    rng = np.random.default_rng(5)
    seen = two_views(rng, count=200)
    rays_x = rays(K, seen.x)
    turned = rays_x @ seen.R.T * rng.uniform(0.5, 2, (200, 1))  # rays of any length
    assert rotation_angle(fit_rotation(rays_x, turned), seen.R) < 1e-9
    turned[:60] += (0.05, 0.01, 0)  # a lorry passes by
    turned += rng.normal(0, 1e-4, turned.shape)
    assert rotation_angle(fit_rotation(rays_x, turned), seen.R) < 1e-4


@pytest.mark.parametrize('slope', [0.0, 0.2, -0.5])
@pytest.mark.parametrize('translation', [(0, 0, 0), SIDEWAYS, (0, -1, 0.3)])
def test_a_turn_in_front_of_a_wall_does_not_absorb_a_translation_along_it(translation, slope):
    rng = np.random.default_rng(5)
    wall = np.column_stack([rng.uniform(-0.6, 0.6, (200, 2)), np.ones(200)])
    turn, v = np.array([1e-4, -2e-4, 3e-4]), 1e-3 * np.array(translation)
    # Seen askew, one side of the wall is nearer than the other.
    seen = wall @ rotation_exp(turn).T + (1 + slope * wall[:, :1]) * v
    # Not of the wall: some nearer points, as a moving arm.
    seen[:30] += [0.01, 0.02, 0]
    found, _ = turn_before_plane(wall, seen)
    # To first order in both, of 1e-3.
    assert np.abs(found - turn).max() < 1e-6
    absorbed = np.abs(rotation_log(fit_rotation(wall, seen)) - turn).max()
    assert absorbed > 3e-4 if any(translation) else absorbed < 1e-5


@pytest.mark.parametrize(('half_width', 'slope', 'shift'), [
    (0.05, 0.0, 1e-4), (0.6, 0.0, 1e-4), (0.6, 0.2, 1e-3)])
def test_a_turn_in_front_of_a_wall_is_as_uncertain_as_it_claims(half_width, slope, shift):
    rng, noise = np.random.default_rng(6), 1e-4
    wall = np.column_stack([rng.uniform(-half_width, half_width, 200),
                            rng.uniform(-0.4, 0.4, 200), np.ones(200)])
    squares = []
    for _ in range(200):
        turn, v = rng.normal(0, 1, (2, 3)) * [[1e-4], [shift]]
        seen = wall @ rotation_exp(turn).T + (1 + slope * wall[:, :1]) * v
        seen /= seen[:, 2:]
        seen[:, :2] += rng.normal(0, noise, (200, 2))
        found, covariance = turn_before_plane(wall, seen)
        squares.append((found - turn) @ np.linalg.solve(covariance, found - turn))
    # Its expectation is 3; a robust fit is somewhat less accurate than least squares.
    assert 2.5 < np.mean(squares) < 4.5


def test_a_turn_that_nothing_determines_has_a_covariance():
    nowhere = np.tile([0.1, 0.2, 1.0], (10, 1))
    turn, covariance = turn_before_plane(nowhere, nowhere)
    assert not turn.any()
    assert 0.1 < np.linalg.eigvalsh(covariance)[-1] <= 1


def test_a_rotation_fitted_to_coplanar_rays_is_no_reflection():
    rays_x = np.array([[-0.5, 0, 1], [-0.2, 0, 1], [0.3, 0, 1], [0.4, 0, 1]])
    for turn in ((0.1, 0.2, 0.3), (-0.3, 0, 0.5), (0, 0, np.pi), (np.pi, 0, 0)):
        R = Rotation.from_rotvec(turn).as_matrix()
        assert np.allclose(fit_rotation(rays_x, rays_x @ R.T), R, atol=1e-9)


@pytest.mark.parametrize('angle', [0.0, 1e-9, 1e-6, 0.3, np.pi - 1e-6])
def test_angles_are_exact_where_an_arc_cosine_loses_precision(angle):
    axis = unit(np.array([1.0, -2.0, 0.5]))
    before = Rotation.from_rotvec([0.4, 0.1, -0.9]).as_matrix()
    after = before @ Rotation.from_rotvec(angle * axis).as_matrix()
    assert rotation_angle(before, after) == pytest.approx(angle, rel=1e-6, abs=1e-15)
    assert rotation_angle(after, before) == pytest.approx(angle, rel=1e-6, abs=1e-15)
    a = unit(np.cross(axis, [1.0, 0, 0]))
    b = Rotation.from_rotvec(angle * axis).apply(a)
    assert direction_angle(3 * a, b) == pytest.approx(angle, rel=1e-6, abs=1e-15)


def test_opposite_directions_are_pi_apart():
    assert direction_angle(np.array([0, 0, 1.0]), np.array([0, 0, -2.0])) == pytest.approx(np.pi)


@pytest.mark.parametrize('t', [[0, 0, -1.0], [0, 0, 1.0], [1.0, 0, 0], [0.3, -0.2, -0.9]],
                         ids=['forwards', 'backwards', 'sideways', 'aslant'])
@pytest.mark.parametrize('turn', [[0.0, 0, 0], [0.05, -0.1, 0.08]], ids=['straight', 'turning'])
@pytest.mark.parametrize('rho', [0.1, 0.3, 0.5, 0.8])
def test_inverse_depths_scatter_as_their_standard_deviations_predict(t, turn, rho):
    rng, noise, count = np.random.default_rng(11), 1e-5, 20_000
    R, t = rotation_exp(np.array(turn)), unit(np.array(t))
    for x in ([0.4, 0.2, 1], [-0.1, 0.5, 1], [0.8, -0.6, 1]):
        there = R @ x + rho * t
        y = np.repeat([there / there[2]], count, axis=0)
        y[:, :2] += noise * rng.normal(size=(count, 2))
        found, sigma = inverse_depths(R, t, np.repeat([x], count, axis=0), y)
        assert found.mean() == pytest.approx(rho, abs=0.05 * found.std())
        assert sigma * noise == pytest.approx(found.std(), rel=0.03)


def test_depths_at_the_epipole_are_undetermined():
    x = np.array([[0.0, 0, 1]])
    _, sigma = inverse_depths(np.eye(3), np.array([0.0, 0, -1]), x, x)
    assert sigma[0] > 1e5


def test_inverse_depths_of_several_poses_are_those_of_each():
    rng = np.random.default_rng(5)
    rays_x, rays_y = (np.column_stack([rng.normal(size=(20, 2)), np.ones(20)]) for _ in range(2))
    R = rotation_exp(rng.normal(size=(4, 3)) * 0.1)
    t = rng.normal(size=(4, 3))
    rho, sigma = inverse_depths(R, t, rays_x, rays_y)
    for index in range(4):
        one, its_sigma = inverse_depths(R[index], t[index], rays_x, rays_y)
        assert np.array_equal(rho[index], one) and np.array_equal(sigma[index], its_sigma)
