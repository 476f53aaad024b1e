"""The pair before decides which of the motions that a pair alone leaves open is the true one."""

from dataclasses import replace
from itertools import pairwise, product

import cv2
from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.geometry import direction_angle, rotation_angle, unit
from djet_ros.core.three_views import consistent_motion
from djet_ros.core.types import Pose, RelativePose, Rival, Status
from djet_ros.odometry.frame import Frame
from djet_ros.odometry.visual_odometry import VisualOdometry
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from two_view import flight_over_a_plane, K, project, SIZE

NOISE = 0.1


def three_views_of_a_plane(seed: int, far: int = 0, speed: float = 1.0
                           ) -> list[tuple[RelativePose, Pose, Pose]]:
    """
    Return two pairs that follow one another, each with its true motion, and with its twin.

    Each has its matches in an order of its own, and lacks some of the points of the other. far:
    number of points that are so far behind the plane that they have no parallax; speed: factor of
    the motions, a twentieth of the distance to the plane.
    """
    rng = np.random.default_rng(seed)
    x = rng.uniform((20, 20), np.array(SIZE) - 20, (400, 2))
    normal = unit(np.array([0.3, 0.5, 1]) + 0.1 * rng.normal(size=3)) / 10
    rays = np.column_stack([x, np.ones(len(x))]) @ np.linalg.inv(K).T
    points = rays / (rays @ normal)[:, None]
    points[:far] *= 1e6
    pixels, pairs, noise = x, [], rng.normal(0, NOISE, (3, *x.shape))
    for number in (1, 2):
        R = Rotation.from_rotvec(rng.normal(0, 0.01, 3)).as_matrix()
        t = speed * rng.normal(size=3) * (0.5, 0.5, 0.3)
        H = R + np.outer(t, normal)
        points = points @ R.T + t
        # n.X = 1 before, so that X' = H X, and n' = H^-T n.
        normal = np.linalg.inv(H).T @ normal
        seen, _ = project(K, points)
        _, turns, ways, _ = cv2.decomposeHomographyMat(H, np.eye(3))
        motions = [Pose(turn, unit(way.ravel())) for turn, way in zip(turns, ways)]
        twin = max(motions, key=lambda pose: rotation_angle(pose.R, R) + min(
            direction_angle(sign * pose.t, t) for sign in (1, -1)))
        matched = rng.permutation(len(x))[:-20]
        pair = RelativePose(
            Status.AMBIGUOUS, R, unit(t), x=(pixels + noise[number - 1])[matched],
            y=(seen + noise[number])[matched], inliers=np.ones(len(matched), bool),
            residuals=rng.normal(0, np.sqrt(2) * NOISE, len(matched)))
        pairs.append((pair, Pose(R, unit(t)), twin))
        pixels = seen
    return pairs


def of_motions(pair: RelativePose, *motions: Pose) -> RelativePose:
    """Return the pair with the first of some motions as its pose, and the others as rivals."""
    first, *rivals = motions
    return RelativePose(Status.AMBIGUOUS, first.R, first.t, x=pair.x, y=pair.y,
                        inliers=pair.inliers, residuals=pair.residuals,
                        rivals=tuple(Rival(rival, 0.0) for rival in rivals))


def test_the_true_motion_of_a_plane_is_found_whichever_was_taken_first():
    missed = 0
    for seed in range(20):
        (before, *earlier), (current, *later) = three_views_of_a_plane(seed)
        for one, other in product((earlier, earlier[::-1]), (later, later[::-1])):
            found = consistent_motion(of_motions(before, *one), of_motions(current, *other), K)
            missed += found is None
            assert found is None or (np.array_equal(found.R, later[0].R)
                                     and np.array_equal(found.t, later[0].t))
    assert missed < 0.1 * 80


def test_matches_that_slip_along_their_epipolar_lines_rarely_hide_the_true_motion():
    undecided = 0
    for seed in range(10):
        (before, *earlier), (current, *later) = three_views_of_a_plane(seed)
        true = later[0]
        y, epipole = current.y[::20], (K @ true.t)[:2] / (K @ true.t)[2]
        y += 12 * unit(y - epipole) * np.random.default_rng(seed).choice([-1, 1], (len(y), 1))
        found = consistent_motion(of_motions(before, *earlier), of_motions(current, *later), K)
        undecided += found is None
        assert found is None or np.array_equal(found.t, true.t)
    assert undecided <= 1


@pytest.mark.parametrize('seed', range(10))
def test_points_too_far_for_parallax_do_not_hide_the_true_motion(seed: int):
    (before, *earlier), (current, *later) = three_views_of_a_plane(seed, far=280)
    found = consistent_motion(of_motions(before, *earlier), of_motions(current, *later), K)
    assert found is not None and np.array_equal(found.t, later[0].t)


def test_nothing_is_decided_if_the_matches_of_the_two_pairs_do_not_agree():
    (before, *earlier), (current, *later) = three_views_of_a_plane(3)
    assert consistent_motion(of_motions(before, *earlier), of_motions(current, *later), K)
    # Rows of a rolling shutter see other poses.
    shift = np.outer(np.sin(current.y[:, 1] / 60), (3.0, 0.0))
    rolling = of_motions(current, *later)
    rolling.y[:] += shift
    assert consistent_motion(of_motions(before, *earlier), rolling, K) is None
    # Many false matches do not make it agree any better.
    rolling.inliers[::2], rolling.residuals[::2] = False, 20
    assert consistent_motion(of_motions(before, *earlier), rolling, K) is None


@pytest.mark.parametrize('rotates', [0, 1])
def test_a_pair_taken_as_a_rotation_in_place_decides_nothing(rotates: int):
    """Its rivals remain, but it tells no depths: not even numbers to divide by."""
    views = three_views_of_a_plane(3)
    pairs = [of_motions(*motions) for motions in views]
    assert consistent_motion(*pairs, K)
    pair, motion, twin = views[rotates]
    pairs[rotates] = of_motions(pair, Pose(motion.R, np.zeros(3)), motion, twin)
    with np.errstate(all='raise'):
        assert consistent_motion(*pairs, K) is None


def test_a_slow_camera_hardly_ever_finds_that_its_matches_chose_the_wrong_motion():
    """Displacements are a few times the noise: in one pair of some hundred it prefers the twin."""
    decided = 0
    for seed in range(200):
        (before, *earlier), (current, *later) = three_views_of_a_plane(seed, speed=0.03)
        if not (earlier[1].t.any() and later[1].t.any()):
            continue  # A rotation alone explains the plane.
        found = consistent_motion(of_motions(before, *earlier), of_motions(current, *later), K)
        assert found is None or np.array_equal(found.t, later[0].t)
        decided += found is not None
    assert decided > 100


def test_what_matches_prefer_is_confirmed_by_less_than_overrules_them():
    """Of a slow camera, whose depths are noisy."""
    confirmed, overruled = [], []
    for seed in range(40):
        (before, *earlier), (current, *later) = three_views_of_a_plane(seed, speed=0.03)
        if not all(motion.t.any() for motion in (*earlier, *later)):
            continue  # the plane has one motion only
        before = of_motions(before, *earlier)
        for motions, found in ((later, confirmed), (later[::-1], overruled)):
            pair = of_motions(current, *motions)
            found.append([consistent_motion(before, replace(pair, status=status), K) is not None
                          for status in (Status.AMBIGUOUS, Status.OK)])
    assert np.sum(confirmed, axis=0)[0] + 2 <= np.sum(confirmed, axis=0)[1]
    assert all(undecided == sure for undecided, sure in overruled)


@pytest.mark.parametrize('seed', range(5))
def test_fewer_than_thirty_shared_points_do_not_even_confirm_what_matches_prefer(seed):
    (before, *earlier), (current, *later) = three_views_of_a_plane(seed)
    # Even what the matches prefer.
    before = of_motions(before, *earlier)
    current = replace(of_motions(current, *later), status=Status.OK)
    shared = np.flatnonzero(np.isin(current.x[:, 0], before.y[:, 0]))
    for count, decides in ((25, False), (100, True)):
        current.inliers[:] = False
        current.inliers[shared[:count]] = True
        assert (consistent_motion(before, current, K) is not None) == decides


def test_a_wrong_motion_before_decides_nothing():
    (before, _, wrong), (current, *later) = three_views_of_a_plane(3)
    assert consistent_motion(of_motions(before, wrong), of_motions(current, *later), K) is None


def test_few_shared_points_decide_nothing():
    (before, *earlier), (current, *later) = three_views_of_a_plane(3)
    current.inliers[20:] = False
    assert consistent_motion(of_motions(before, *earlier), of_motions(current, *later), K) is None


def test_the_sign_of_t_alone_is_not_decided():
    (before, *earlier), (current, true, _) = three_views_of_a_plane(3)
    both = of_motions(current, true, Pose(true.R, -true.t))
    assert consistent_motion(of_motions(before, *earlier), both, K) is None


@pytest.mark.slow
def test_over_flat_ground_nearly_all_pairs_after_the_first_ones_have_the_true_motion():
    """By themselves a third of them are ambiguous: the lens is too narrow for chirality."""
    estimator, alone, in_a_row = TwoViewEstimator(), [], []
    for seed in range(6):
        lens, pictures, poses = flight_over_a_plane(np.random.default_rng(seed), 8)
        views = [estimator.view(gray, lens) for gray in pictures]
        alone += [estimator.estimate(one, other).status for one, other in pairwise(views[2:])]
        odometry = VisualOdometry()
        results = [odometry.process(Frame(gray, lens, (number + 1) * 10**8))
                   for number, gray in enumerate(pictures)]
        in_a_row += [result.status for result in results[3:]]
        for result, before, after in zip(results[3:], poses[2:], poses[3:]):
            true_motion = np.linalg.inv(before) @ after
            if result.status is Status.OK:
                assert np.degrees(direction_angle(result.motion[:3, 3], true_motion[:3, 3])) < 2
    assert alone.count(Status.AMBIGUOUS) > len(alone) / 3
    assert in_a_row.count(Status.OK) >= 0.85 * len(in_a_row)
