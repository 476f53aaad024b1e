"""Bundle adjustment: exact data is reproduced, and elimination is exact."""

from dataclasses import replace

from djet_ros.core.bundle import (
    eliminate,
    jacobians,
    Landmarks,
    noise_scale,
    observe,
    points_in_frame,
    PosePrior,
    Poses,
    projected,
)
from djet_ros.core.correction import Correction, motion_shift
from djet_ros.core.geometry import rays, rotation_exp, rotation_log, sphere_tangents, unit
from djet_ros.core.joint_problem import JointProblem
from djet_ros.core.radial import distort
from djet_ros.core.types import RelativePose, Status
import numpy as np
import pytest

K = np.array([[500.0, 9, 320], [0, 480, 240], [0, 0, 1]])


def scene(rng, frames=4, landmarks=40):
    """Poses of a camera that drives and turns, and exact observations of landmarks."""
    poses = Poses(
        np.array([rotation_exp(np.array([0.01, 0.03, -0.02]) * f) for f in range(frames)]),
        np.array([[0.1, -0.05, -0.4]]) * np.arange(frames)[:, None])
    found = Landmarks.at(rng.uniform((100, 80), (540, 400), (landmarks, 2)),
                         1 / rng.uniform(4, 20, landmarks), 0, frames)
    found.anchors[landmarks // 2:] = 1
    for frame in range(frames):
        found.minima[:, frame] = projected(K, points_in_frame(K, poses, found, frame))
        later = found.anchors < frame
        found.observed[later, frame] = True
        A = rng.normal(size=(landmarks, 2, 2))
        found.roots[:, frame] = A + 2 * np.eye(2)
    found.anchor_roots[:] = rng.normal(size=(landmarks, 2, 2)) + 2 * np.eye(2)
    return poses, found


def with_camera(step):
    """Return a step of camera and poses in which the camera stays."""
    return np.concatenate([np.zeros(4), step])


def test_a_landmark_is_observed_at_its_projection():
    poses, landmarks = scene(np.random.default_rng(0))
    for n in (0, 39):
        anchor = landmarks.anchors[n]
        ray = np.linalg.inv(K) @ [*landmarks.points[n], 1]
        world = poses.R[anchor].T @ (ray / landmarks.rho[n] - poses.t[anchor])
        there = K @ (poses.R[3] @ world + poses.t[3])
        assert projected(K, points_in_frame(K, poses, landmarks, 3))[n] == pytest.approx(
            there[:2] / there[2])


def test_a_camera_takes_points_into_the_world():
    poses, _ = scene(np.random.default_rng(16))
    here = np.random.default_rng(17).normal(size=(9, 3))
    for frame in range(4):
        camera = poses.camera(frame)
        world = here @ camera[:3, :3].T + camera[:3, 3]
        assert world @ poses.R[frame].T + poses.t[frame] == pytest.approx(here)


def test_points_far_outside_the_image_are_not_folded_into_it():
    far = np.array([[20.0, 0, 1], [0, -1e5, 1], [3, 3, -1], [1e12, 0, 0]])
    pixels = np.abs(projected(K, far))
    assert (pixels > 2000).any(1).all()
    # They are rounded to integers.
    assert pixels.max() < 2**31


def test_exact_observations_leave_no_residual():
    poses, landmarks = scene(np.random.default_rng(1))
    observed = observe(K, poses, landmarks)
    assert np.abs(observed.residuals).max() < 1e-9
    assert np.abs(observed.anchor_residuals).max() < 0.1


def test_a_landmark_in_the_plane_of_the_camera_leaves_the_equations_finite():
    poses = Poses(np.array([np.eye(3)] * 2), np.array([[0, 0, 0], [0, 0, -0.5]]))
    landmarks = Landmarks.at(np.array([[340.0, 250]]), np.array([2.0]), 0, 2)
    landmarks.observed[:, 1], landmarks.roots[:, 1] = True, np.eye(2)
    observed = observe(K, poses, landmarks)
    assert observed.place[0, 2] == 0
    reduced = eliminate(observed, np.ones(1), 1.0, 2)
    assert np.isfinite(reduced.H).all() and np.isfinite(reduced.g).all()
    assert np.isfinite(reduced.change(np.zeros(16))).all()


def test_jacobians_are_those_of_finite_differences():
    poses, landmarks = scene(np.random.default_rng(2))
    landmarks.minima += 3.0
    observed = observe(K, poses, landmarks)
    by = jacobians(observed)
    step = np.random.default_rng(3).normal(size=(4, 6)) * 1e-6
    own = np.random.default_rng(4).normal(size=(40, 3)) * [1e-7, 1e-5, 1e-5]
    expected = (np.einsum('nij,nj->ni', by.by_frame, step[observed.frame])
                + np.einsum('nij,nj->ni', by.by_anchor, step[observed.anchor])
                + np.einsum('nij,nj->ni', by.by_own, own[observed.landmark]))
    ahead, back = (observe(K, poses.moved(sign * step.ravel()), landmarks.moved(sign * own))
                   for sign in (1, -1))
    assert (ahead.residuals - back.residuals) / 2 == pytest.approx(expected, rel=1e-5, abs=1e-9)
    assert (ahead.anchor_residuals - back.anchor_residuals) / 2 == pytest.approx(
        np.einsum('nij,nj->ni', by.points_by_own, own[:, 1:]), rel=1e-5, abs=1e-9)


def test_jacobians_by_the_camera_are_those_of_one_that_deviates():
    poses, landmarks = scene(np.random.default_rng(2))
    observed = observe(K, poses, landmarks)
    by, rng = jacobians(observed), np.random.default_rng(3)
    for wrong in (*1e-6 * np.eye(4), 1e-6 * rng.normal(size=4)):
        correction = Correction(*wrong)
        there = correction.camera_matrix(K)
        for places, root, found in (
                (observed.place, observed.root, by.by_camera),
                (rays(K, landmarks.points), observed.anchor_roots, by.points_by_camera)):
            moved = (distort(there, projected(there, places), correction.k1)
                     - projected(K, places))
            assert found @ wrong == pytest.approx(np.einsum('nij,nj->ni', root, moved), rel=1e-4,
                                                  abs=1e-8)


def test_a_step_and_its_inverse_cancel():
    poses, _ = scene(np.random.default_rng(5))
    step = np.random.default_rng(6).normal(size=24) * 0.05
    assert poses.moved(step).step_from(poses) == pytest.approx(step, abs=1e-12)


def test_elimination_equals_solving_the_full_system():
    poses, landmarks = scene(np.random.default_rng(7))
    # Rotations about several axes determine the camera.
    poses = poses.moved(np.random.default_rng(25).normal(size=24) * 0.15)
    landmarks.minima += np.random.default_rng(8).normal(size=landmarks.minima.shape)
    landmarks.points += np.random.default_rng(13).normal(size=landmarks.points.shape)
    observed = observe(K, poses, landmarks)
    by = jacobians(observed)
    weights = np.random.default_rng(9).uniform(0.5, 2, len(observed.residuals))
    J = np.zeros((len(weights) + 40, 2, 24 + 3 * 40))
    of_camera = np.concatenate([by.by_camera, by.points_by_camera])
    for n, (landmark, frame, anchor) in enumerate(
            zip(observed.landmark, observed.frame, observed.anchor)):
        J[n, :, 6 * frame:6 * frame + 6] += by.by_frame[n]
        J[n, :, 6 * anchor:6 * anchor + 6] += by.by_anchor[n]
        J[n, :, 24 + 3 * landmark:][:, :3] = by.by_own[n]
    for landmark in range(40):
        J[len(weights) + landmark, :, 25 + 3 * landmark:][:, :2] = by.points_by_own[landmark]
    W = np.repeat([*weights, *[0.7] * 40], 2)[:, None]
    e = np.concatenate([observed.residuals, observed.anchor_residuals]).ravel()
    J = J.reshape(-1, 144)
    # The seven gauge freedoms are fixed by a little information on each pose.
    held = np.diag([*[1.0] * 24, *[0.0] * 120])
    whole = -np.linalg.solve((J * W).T @ J + held, (J * W).T @ e)
    reduced = eliminate(observed, weights, 0.7, 4)
    step = with_camera(-np.linalg.solve(reduced.H[4:, 4:] + np.eye(24), reduced.g[4:]))
    assert step[4:] == pytest.approx(whole[:24], rel=1e-4, abs=1e-7)
    assert reduced.change(step).ravel() == pytest.approx(whole[24:], rel=1e-4, abs=1e-6)
    # With the camera, and no other information: the gauge does not affect it.
    J = np.column_stack([of_camera.reshape(-1, 4), J])
    information = np.linalg.pinv((J * W).T @ J, rcond=1e-12, hermitian=True)
    H, g = reduced.of_camera()
    assert np.linalg.inv(H) == pytest.approx(information[:4, :4], rel=1e-2)
    assert -np.linalg.solve(H, g) == pytest.approx(-(information @ (J * W).T @ e)[:4], rel=1e-2)


def test_without_observations_there_is_no_information_on_poses():
    poses, landmarks = scene(np.random.default_rng(23))
    landmarks.observed[:] = False
    reduced = eliminate(observe(K, poses, landmarks), np.empty(0), 1.0, 4)
    assert not reduced.H[4:].any() and not reduced.g[4:].any()
    # The landmarks go back to where their patches were.
    back = landmarks.moved(reduced.change(np.zeros(28)))
    assert back.rho == pytest.approx(landmarks.rho)
    assert back.points == pytest.approx(landmarks.anchor_pixels)


def test_poses_and_depths_are_recovered_without_noise():
    poses, landmarks = scene(np.random.default_rng(10))
    rng = np.random.default_rng(11)
    wrong = poses.moved(rng.normal(size=24) * [*[0.0] * 12, *[0.01] * 12])
    guessed = replace(landmarks, rho=landmarks.rho * rng.uniform(0.8, 1.2, 40))
    # The first two poses fix position and scale.
    held = np.diag([*[1e12] * 12, *[0.0] * 12])
    for _ in range(8):
        observed = observe(K, wrong, guessed)
        reduced = eliminate(observed, np.ones(len(observed.residuals)), 1.0, 4)
        step = -np.linalg.solve(reduced.H[4:, 4:] + held, reduced.g[4:])
        wrong = wrong.moved(step)
        guessed = guessed.moved(reduced.change(with_camera(step)))
    assert np.abs(wrong.step_from(poses)).max() < 1e-6
    assert guessed.rho == pytest.approx(landmarks.rho, rel=1e-5)


def test_removing_a_frame_removes_the_landmarks_anchored_in_it():
    _, landmarks = scene(np.random.default_rng(12))
    left = landmarks.without_frame(0)
    assert len(left) == 20
    assert not left.anchors.any()
    assert np.array_equal(left.minima, landmarks.minima[20:, 1:])
    assert landmarks.with_frame().observed.shape == (40, 5)


def test_frames_that_come_and_go_leave_the_others_where_they_are():
    poses, landmarks = scene(np.random.default_rng(18))
    more, _ = scene(np.random.default_rng(18), frames=5)
    poses, landmarks = poses.joined(more.R[4], more.t[4]), landmarks.with_frame()
    landmarks.minima[:, 4] = projected(K, points_in_frame(K, more, landmarks, 4))
    landmarks.roots[:, 4], landmarks.observed[:, 4] = np.eye(2), True
    for removed in (2, 0):
        poses, landmarks = poses.without_frame(removed), landmarks.without_frame(removed)
        observed = observe(K, poses, landmarks)
        assert len(observed.residuals) >= 40
        assert np.abs(observed.residuals).max() < 1e-9


def test_observations_say_the_same_in_images_of_another_correction():
    rng, before, after = np.random.default_rng(19), (K, 0.03), (
        Correction(0, 0.01, 0.004, -0.006).camera_matrix(K), -0.08)
    _, landmarks = scene(rng)
    landmarks.slopes = rng.normal(size=(40, 2)) * 1e-3
    off = rng.normal(size=(40, 2)) * 1e-3
    beside = replace(landmarks, anchor_pixels=landmarks.anchor_pixels + off,
                     minima=landmarks.minima + off[:, None])
    corrected, next_to = (one.with_corrected_images(before, after)
                          for one in (landmarks, beside))
    for pixels, moved in ((landmarks.anchor_pixels, corrected.anchor_pixels),
                          (landmarks.minima[:, 1], corrected.minima[:, 1])):
        assert distort(after[0], moved, after[1]) == pytest.approx(
            distort(K, pixels, before[1]), abs=1e-3)
    shift = next_to.anchor_pixels - corrected.anchor_pixels
    assert np.abs(shift - off).max() > 1e-4
    by_slopes = (np.einsum('ni,ni->n', one.slopes, way) for one, way in (
        (corrected, shift), (landmarks, off)))
    assert next(by_slopes) == pytest.approx(next(by_slopes), rel=1e-3, abs=1e-9)
    assert np.einsum('nij,nj->ni', corrected.anchor_roots, shift) == pytest.approx(
        np.einsum('nij,nj->ni', landmarks.anchor_roots, off), rel=1e-3, abs=1e-6)
    shifts = next_to.minima - corrected.minima
    assert np.einsum('nfij,nfj->nfi', corrected.roots, shifts) == pytest.approx(
        np.einsum('nfij,nj->nfi', landmarks.roots, off), rel=1e-3, abs=1e-6)
    assert rays(after[0], corrected.points) == pytest.approx(rays(K, landmarks.points))


def test_noise_of_the_anchor_patch_does_not_bias_steps():
    # It is common to all observations of a landmark, so with a fixed ray it looks like parallax
    # that does not grow, as if the camera became slower.
    rng = np.random.default_rng(14)
    poses, landmarks = scene(rng, 3, 16_000)
    length = np.linalg.norm(poses.t[2] - poses.R[2] @ poses.R[1].T @ poses.t[1])
    landmarks = landmarks.of(landmarks.anchors == 0)
    landmarks.roots[:], landmarks.anchor_roots[:] = np.eye(2), np.eye(2)
    landmarks.minima += rng.normal(size=(8000, 1, 2))
    held = np.diag([*[1e12] * 12, *[0.0] * 6])
    for _ in range(6):
        observed = observe(K, poses, landmarks)
        reduced = eliminate(observed, np.full(len(observed.residuals), 1e4), 1.0, 3)
        step = -np.linalg.solve(reduced.H[4:, 4:] + held, reduced.g[4:])
        poses = poses.moved(step)
        landmarks = landmarks.moved(reduced.change(with_camera(step)))
    found = np.linalg.norm(poses.t[2] - poses.R[2] @ poses.R[1].T @ poses.t[1])
    assert found == pytest.approx(length, rel=3e-3)


@pytest.mark.parametrize('frames', [2, 3, 6])
def test_the_noise_estimate_accounts_for_degrees_of_freedom(frames):
    rng = np.random.default_rng(15)
    poses, landmarks = scene(rng, frames, 3000)
    landmarks = landmarks.of(landmarks.anchors == 0)
    landmarks.roots[:], landmarks.anchor_roots[:] = np.eye(2), np.eye(2)
    landmarks.anchor_pixels = landmarks.anchor_pixels + rng.normal(size=(1500, 2)) * 0.3
    landmarks.minima += rng.normal(size=landmarks.minima.shape) * 0.3
    for _ in range(4):
        observed = observe(K, poses, landmarks)
        reduced = eliminate(observed, np.ones(len(observed.residuals)), 1.0, frames)
        landmarks = landmarks.moved(reduced.change(np.zeros(4 + 6 * frames)))
    found = noise_scale(observe(K, poses, landmarks))
    assert found == pytest.approx(0.3, rel=0.05)
    # Landmarks that were only just created tell nothing.
    new = replace(landmarks, observed=np.zeros_like(landmarks.observed))
    assert noise_scale(observe(K, poses, landmarks.joined(new))) == found


def random_prior(rng, frames):
    """Return a prior that determines camera and poses, far from those it is linearised at."""
    size = 4 + 6 * frames
    half = rng.normal(size=(size, size))
    return PosePrior(half @ half.T + np.eye(size), 9 * rng.normal(size=size), Poses(
        rotation_exp(rng.normal(size=(frames, 3))), rng.normal(size=(frames, 3))))


def test_the_gradient_of_a_prior_is_that_of_its_cost():
    rng = np.random.default_rng(7)
    prior = random_prior(rng, 2)
    # As large as that at the start, although the step is small.
    prior.H *= 1e5
    poses = prior.linearised_at.moved(1e-4 * rng.normal(size=12))
    slopes = [(prior.at(poses.moved(step)).cost - prior.at(poses.moved(-step)).cost) / 2e-6
              for step in 1e-6 * np.eye(12)]
    found = prior.at(poses).gradient
    assert np.abs(found - prior.g[4:]).max() > 50
    assert slopes == pytest.approx(found, rel=1e-3, abs=0.1)


def test_information_is_added_to_a_prior_where_it_was_linearised():
    rng = np.random.default_rng(20)
    prior, added = random_prior(rng, 2), random_prior(rng, 2)
    # Without a rotation steps are exact.
    there, step = rng.normal(size=(2, 2, 6)) * [0, 0, 0, 1, 1, 1]
    there, step = prior.linearised_at.moved(there), step.ravel()
    costs = [prior.at(poses).cost for poses in (there, there.moved(step))]
    prior.add(added.H, added.g, there)
    more = [prior.at(poses).cost - cost for poses, cost in zip((there, there.moved(step)), costs)]
    assert more[1] - more[0] == pytest.approx(
        step @ added.of_poses @ step / 2 + added.g[4:] @ step)


def test_a_prior_says_the_same_relative_to_another_camera():
    rng = np.random.default_rng(24)
    prior, change = random_prior(rng, 2), rng.normal(size=4)
    corrected = prior.with_corrected_camera(change)
    # Where the poses go if the camera is known to be off by so much.
    expected = -np.linalg.solve(prior.of_poses, prior.g[4:] + prior.H[4:, :4] @ change)
    assert -np.linalg.solve(corrected.of_poses, corrected.g[4:]) == pytest.approx(expected)
    # And the minimum over both: the camera is nearer by the change.
    whole, relative = (-np.linalg.solve(one.H, one.g) for one in (prior, corrected))
    assert relative == pytest.approx(whole - [*change, *[0.0] * 12])


@pytest.mark.parametrize('frame', range(3))
def test_without_a_frame_a_prior_keeps_minimum_and_covariance_of_the_others(frame):
    prior, kept = random_prior(np.random.default_rng(21), 3), np.arange(3) != frame
    left, columns = prior.without_frame(frame), np.repeat([True, *kept], [4, 6, 6, 6])
    covariance = np.linalg.inv(prior.H)
    assert np.linalg.inv(left.H) == pytest.approx(covariance[np.ix_(columns, columns)], rel=1e-3,
                                                  abs=1e-5)
    assert np.linalg.solve(left.H, left.g) == pytest.approx((covariance @ prior.g)[columns],
                                                            rel=1e-3, abs=1e-4)
    assert left.linearised_at.R.tolist() == prior.linearised_at.R[kept].tolist()
    assert left.linearised_at.t.tolist() == prior.linearised_at.t[kept].tolist()


def test_a_frame_without_information_comes_and_goes_without_effect_on_a_prior():
    prior = random_prior(np.random.default_rng(22), 2)
    left = prior.with_frame(np.eye(3), np.ones(3)).without_frame(2)
    assert np.allclose(left.H, prior.H, rtol=1e-9)
    assert left.g == pytest.approx(prior.g)


def refined(wrong, noise, count, seed=0, frames=4):
    """Return poses and landmarks after they have adapted to a camera that deviates."""
    rng, deviation = np.random.default_rng(seed), Correction(*wrong)
    poses, landmarks = scene(rng, frames, count)
    # Rotations about several axes determine the camera.
    poses = poses.moved(np.random.default_rng(25).normal(size=6 * frames) * 0.15)
    landmarks.roots[:], landmarks.anchor_roots[:] = np.eye(2), np.eye(2)

    def seen(places):
        there = deviation.camera_matrix(K)
        return (distort(there, projected(there, places), deviation.k1)
                + noise * rng.normal(size=(count, 2)))

    for frame in range(frames):
        landmarks.minima[:, frame] = seen(points_in_frame(K, poses, landmarks, frame))
    landmarks.anchor_pixels = seen(rays(K, landmarks.points))
    landmarks.points = landmarks.anchor_pixels.copy()
    # The first pose, and the length of the way to the second, are the gauge.
    prior = PosePrior.holding(Poses(poses.R[:1], poses.t[:1]))
    for R, t in zip(poses.R[1:], poses.t[1:]):
        prior = prior.with_frame(R, t)
    prior.H[4 + 11, 4 + 11] = 1e10
    problem = JointProblem(K, poses, landmarks, prior)
    for _ in range(4):
        problem.refine()
    return problem


@pytest.mark.parametrize('wrong', [(1e-3, 0, 0, 0), (0, 3e-4, 0, 0), (2e-4, 1e-4, -1e-4, 1e-4)])
def test_a_deviation_of_the_camera_leaves_the_mean_square_that_is_said_of_it(wrong):
    """In pixels, per observation, after poses and landmarks have adapted."""
    problem = refined(wrong, 0.0, 300)
    observed = observe(K, problem.poses, problem.landmarks)
    left = ((observed.residuals**2).sum() + (observed.anchor_residuals**2).sum()) / len(
        observed.residuals)
    H = refined(np.zeros(4), 0.0, 300).camera_information(1).H
    assert left == pytest.approx(np.array(wrong) @ H @ wrong, rel=0.05)


def test_observations_tell_how_the_camera_deviates_whatever_the_robust_loss_flattens():
    told = refined((0.02, 0, 0, 0), 0.3, 10_000).camera_information(1)
    assert -np.linalg.solve(told.H, told.g)[0] == pytest.approx(0.02, rel=0.1)


@pytest.mark.parametrize('windows', [1, 6])
def test_observations_that_several_windows_share_are_as_uncertain_as_if_each_had_its_part(windows):
    """A robust loss takes them for at most twice as uncertain as they are."""
    wrong, squares = np.array([4e-3, 1e-3, -1e-3, 1e-3]), []
    for seed in range(24):
        told = refined(wrong, 0.3, 300, seed).camera_information(windows)
        off = np.linalg.solve(told.H, told.g) + wrong
        squares.append(off @ told.H @ off / told.noise)
    assert 0.5 < windows * np.mean(squares) / 4 < 1.2


def test_the_cost_that_no_step_may_increase_is_the_one_whose_slope_is_solved_for():
    """Of observations with a robust loss, anchors, and a prior, in one unit."""
    problem, rng = refined(np.zeros(4), 0.3, 60), np.random.default_rng(9)
    prior = random_prior(rng, 4)
    # Steps such that each part counts.
    problem.prior = PosePrior(1e4 * prior.H, 1e4 * prior.g, problem.poses)
    problem.scale = 0.4
    poses, landmarks = problem.poses.moved(1e-4 * rng.normal(size=24)), problem.landmarks
    step = 1e-4 * rng.normal(size=24)
    change = rng.normal(size=(len(landmarks), 3)) * [1e-4, 1, 1]

    def cost(share):
        moved = poses.moved(share * step)
        observed = observe(K, moved, landmarks.moved(share * change))
        return problem._cost(observed, problem.scale) + problem.prior.at(moved).cost

    observed = observe(K, poses, landmarks)
    reduced = problem._reduced(observed)
    # Landmarks at rest: the slope by poses alone is that of the equations before elimination.
    by_landmarks = np.einsum('ni,ni->', reduced._slopes, change)
    gain = np.einsum('nij,njk->nik', reduced._variances, reduced._coupling)
    by_poses = reduced.g + np.einsum('nik,ni->k', gain, reduced._slopes)
    slope = by_poses[4:] @ step + by_landmarks + problem.prior.at(poses).gradient @ step
    assert (cost(1e-3) - cost(-1e-3)) / 2e-3 == pytest.approx(slope, rel=1e-3)


@pytest.mark.parametrize('by_prior', [False, True])
@pytest.mark.parametrize(('factor', 'taken'), [(1, 1), (3, 3 / 2), (6, 3 / 2), (-1, 0)])
def test_a_step_that_would_increase_the_cost_is_halved_or_not_taken(factor, taken, by_prior):
    """Whether observations want poses elsewhere, or a prior against what is observed."""
    problem, rng = refined(np.zeros(4), 0.02, 60), np.random.default_rng(9)
    off = 2e-4 * rng.normal(size=24) * [*[0] * 12, *[1] * 12]
    if by_prior:
        problem.prior.H[4:, 4:] += 1e8 * np.eye(24)
        problem.prior.g[4:] = 1e8 * off - problem.prior.H[4:, 4:] @ problem.poses.step_from(
            problem.prior.linearised_at)
    else:
        problem.poses = problem.poses.moved(off)
    observed, prior = problem._observed(), problem.prior.at(problem.poses)
    reduced = problem._reduced(observed)
    step = -np.linalg.solve(problem.prior.of_poses + reduced.H[4:, 4:],
                            prior.gradient + reduced.g[4:])
    change, before, scale = reduced.change(with_camera(step)), problem.poses, problem.scale
    landmarks = problem.landmarks
    problem._line_search(observed, prior, factor * step, factor * change)
    assert problem.poses.step_from(before) == pytest.approx(taken * step, rel=1e-2, abs=1e-8)
    assert problem.landmarks.points - landmarks.points == pytest.approx(taken * change[:, 1:])
    assert taken or problem.scale == scale


def test_the_newest_length_depends_on_the_camera_as_a_correction_then_changes_it():
    problem = refined((2e-3, 1e-3, 1e-3, -1e-3), 0.05, 200)
    dependence, before = problem.length_by_camera.copy(), problem.newest_length
    assert np.abs(dependence).min() > 1e-3
    for change in 1e-4 * np.eye(4):
        changed = replace(problem)
        changed.adapt_to(change)
        assert np.log(changed.newest_length / before) == pytest.approx(
            dependence @ change, rel=0.05, abs=1e-7)


def of_pair(length, expected, sigma, by_camera):
    """Return a problem with a pair whose length depends on the camera, the pair and a pose."""
    rng = np.random.default_rng(31)
    half, x = rng.normal(size=(5, 5)), rng.uniform((100, 80), (540, 400), (50, 2))
    pair = RelativePose(
        Status.OK, rotation_exp(np.array([0.02, -0.1, 0.05])), unit(np.array([0.3, -0.1, 0.9])),
        1e-4 * (half @ half.T + np.eye(5)), x=x, y=x, y_opt=x + 5, inliers=np.ones(50, bool))
    first = Poses(rotation_exp(np.array([[0.1, 0.2, 0.3]])), np.array([[1.0, 2, 3]]))
    prior = PosePrior(np.zeros((10, 10)), np.zeros(10), first)
    problem = JointProblem(K, first, Landmarks.at(np.empty((0, 2)), np.empty(0), 0, 1), prior,
                           length_by_camera=by_camera)
    problem.add_frame(pair.R @ first.R[0], pair.R @ first.t[0] + length * pair.t)
    problem.add_pair(pair, length, expected, sigma)
    return problem, pair


def test_a_pair_costs_what_poses_deviate_from_its_rotation_direction_and_expected_length():
    expected, sigma = 2.3, 0.1
    problem, pair = of_pair(2.5, expected, sigma, np.zeros(4))

    def cost(poses):
        motion, shift = (motions[1, 0] for motions in poses.relative_motions)
        off = np.concatenate([rotation_log(motion @ pair.R.T),
                              sphere_tangents(pair.t).T @ (unit(shift) - pair.t)])
        return (off @ np.linalg.solve(pair.covariance_5, off)
                + ((np.linalg.norm(shift) - expected) / sigma)**2) / 2

    for seed in range(5):
        moved = problem.poses.moved(1e-4 * np.random.default_rng(seed).normal(size=12))
        said = problem.prior.at(moved).cost - problem.prior.at(problem.poses).cost
        assert said == pytest.approx(cost(moved) - cost(problem.poses), rel=2e-3, abs=1e-7)


@pytest.mark.parametrize('field', range(4))
def test_another_camera_moves_a_pair_as_its_matches_and_a_length_as_those_before(field):
    by_camera, change = np.array([3.0, -2.0, 1.0, 0.5]), 1e-5 * np.eye(4)[field]
    problem, pair = of_pair(2.5, 2.5, 0.1, by_camera)
    prior = problem.prior.with_corrected_camera(change)
    # The first pose stays.
    step = np.linalg.solve(prior.of_poses[6:, 6:], -prior.g[10:])
    motion, shift = (motions[1, 0] for motions in problem.poses.moved(
        np.concatenate([np.zeros(6), step])).relative_motions)
    moved = np.concatenate([rotation_log(motion @ pair.R.T),
                            sphere_tangents(pair.t).T @ (unit(shift) - pair.t)])
    assert moved == pytest.approx(motion_shift(pair, K) @ change, rel=1e-2, abs=1e-9)
    assert np.log(np.linalg.norm(shift) / 2.5) == pytest.approx(by_camera @ change, rel=1e-2)
