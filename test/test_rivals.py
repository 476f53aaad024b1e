"""Pairs that leave a choice: two basins, two bodies, matches by chance; and pairs that do not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

from djet_ros.core.basins import lowest_nearby_minimum
from djet_ros.core.covariance import pose_difference, squared_distance, widened_to_span
from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.geometry import direction_angle, rotation_angle, rotation_exp, unit
from djet_ros.core.jet import jet_problem, Loss, minimise
from djet_ros.core.pair import Pair
from djet_ros.core.rivals import (
    continues_motion,
    false_alarms,
    is_planar,
    planar_twin,
    preferences,
    Rival,
    unsigned_distance,
)
from djet_ros.core.sketch import losses_at
from djet_ros.core.starts import hemisphere_starts
from djet_ros.core.surfaces import ReprojectionSurface
from djet_ros.core.types import Pose, RelativePose, Status
from djet_ros.core.verdict import _compare_with_rivals, as_turn
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, norm
from two_view import (
    CLOSE_UP,
    FORWARD,
    K,
    moved_pose,
    pictures_of_a_plane,
    pictures_towards_a_wall,
    project,
    SIDEWAYS,
    SIZE,
    TURN,
    two_views,
    TwoViews,
    uniform_view,
)

NOISE = 0.2
# How a body may move, as the camera sees it: across, or against it along the camera's own way.
BODIES = {'across': (0.3, 0.05, 0.4), 'against': (0.0, -0.016, 0.8)}
FLAT, DEEP = (3, 4), (4, 40)


def scene_with_body(still: int, moving: int, motion: str, box: tuple[float, float],
                    depths: tuple[float, float] = (5, 8)
                    ) -> tuple[TwoViews, np.ndarray, np.ndarray, Pose]:
    """Give matches of the world and of a body between two columns, and how that moves."""
    rng = np.random.default_rng(3)
    seen = two_views(rng, count=still, t=FORWARD, turn=(0.0, 0.004, 0.0))
    pixels = rng.uniform((box[0], 60), (box[1], SIZE[1]), (moving, 2))
    points = (np.column_stack([pixels, np.ones(moving)]) @ np.linalg.inv(K).T
              * rng.uniform(*depths, (moving, 1)))
    R, t = rotation_exp(np.array([0.0, -0.01, 0.003])), np.array(BODIES[motion])
    x = np.concatenate([seen.x, pixels])
    y = np.concatenate([seen.y, project(K, points @ R.T + t)[0]])
    return seen, x, y + rng.normal(0, NOISE, y.shape), Pose(R, unit(t))


def estimate(x: np.ndarray, y: np.ndarray, before: Pose | None = None) -> RelativePose:
    prior = None if before is None else RelativePose(Status.OK, before.R, before.t)
    return TwoViewEstimator(EstimatorConfig(method='rpe')).estimate_matched(
        uniform_view(), uniform_view(), x, y, prior)


@pytest.mark.parametrize(('behind', 'before', 'status'), [
    (20, None, Status.OK), (95, None, Status.AMBIGUOUS), (95, 'likewise', Status.OK),
    (105, 'likewise', Status.OK)])
def test_where_as_many_points_are_behind_as_before_the_camera_its_way_is_told_by_none_of_them(
        behind: int, before: str | None, status: Status) -> None:
    """Edges along the way have false matches on epipolar lines, on the wrong half as often."""
    rng = np.random.default_rng(4)
    seen = two_views(rng, t=FORWARD, count=100)
    on_lines = two_views(rng, t=np.negative(FORWARD), count=behind)
    anywhere = rng.uniform((0, 0), SIZE, (2, 2 * behind, 2))
    x, y = (np.concatenate(parts) for parts in zip(
        (seen.x, seen.y), (on_lines.x, on_lines.y), anywhere))
    result = estimate(x, y, Pose(seen.R, seen.t) if before else None)
    assert result.status is status
    if status is Status.OK:
        assert direction_angle(result.t, seen.t) < 1e-3
        assert direction_claimed(result) < 1
    else:
        assert direction_claimed(result) > 30


def direction_claimed(result: RelativePose) -> float:
    """Give the standard deviation of the direction in degrees, where that is largest."""
    return float(np.degrees(np.sqrt(np.linalg.eigvalsh(result.covariance_5[3:, 3:])[-1])))


@pytest.mark.parametrize('motion', BODIES)
def test_of_two_bodies_equally_deep_none_is_taken_for_the_world_for_sure(motion: str) -> None:
    _, x, y, _ = scene_with_body(200, 300, motion, (300, 1000), DEEP)
    assert estimate(x, y).status is Status.TWO_MOTIONS


@pytest.mark.parametrize('motion', BODIES)
def test_the_world_is_what_reaches_far_though_most_matches_follow_a_flat_body(
        motion: str) -> None:
    seen, x, y, _ = scene_with_body(200, 300, motion, (300, 1000), FLAT)
    result = estimate(x, y)
    assert result.status is Status.OK
    assert rotation_angle(result.R, seen.R) < 2e-3
    assert direction_angle(result.t, seen.t) < 0.02


def test_a_body_that_shows_no_depth_for_want_of_parallax_may_be_the_world(
        monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(BODIES, 'beside', (0.0, 0.0, 1e-9))
    _, x, y, _ = scene_with_body(200, 300, 'beside', (300, 1000), FLAT)
    assert estimate(x, y).status is Status.TWO_MOTIONS


@pytest.mark.parametrize('motion', BODIES)
def test_the_world_is_what_goes_on_as_before_though_most_matches_follow_another_body(
        motion: str) -> None:
    seen, x, y, body = scene_with_body(200, 300, motion, (300, 1000))
    result = estimate(x, y, Pose(rotation_exp(np.array([0, 0.002, 0])) @ seen.R, seen.t))
    assert result.status is Status.OK
    assert rotation_angle(result.R, seen.R) < 2e-3
    assert direction_angle(result.t, seen.t) < 0.02
    assert result.inliers[:200].mean() > 0.8 and result.inliers[200:].mean() < 0.3
    # … and with the body's motion before it, it would be the body.
    assert direction_angle(estimate(x, y, body).t, body.t) < 0.1


def test_a_small_body_leaves_no_doubt_about_the_world() -> None:
    seen, x, y, _ = scene_with_body(400, 60, 'across', (600, 760))
    result = estimate(x, y)
    assert result.status is Status.OK
    assert direction_angle(result.t, seen.t) < 0.01
    assert not result.inliers[400:].any()


@pytest.mark.parametrize('stuck', [200, 500])
@pytest.mark.parametrize('seed', range(3))
def test_what_keeps_its_pixels_before_a_camera_that_turns_is_not_the_sky(
        stuck: int, seed: int) -> None:
    """A bonnet in the lower part of the image, as many matches as the world has or fewer."""
    rng = np.random.default_rng(seed)
    seen = two_views(rng, count=400, t=FORWARD, turn=(0.0, 0.012, 0.0))
    bonnet = rng.uniform((0, 250), SIZE, (stuck, 2))
    x = np.concatenate([seen.x, bonnet])
    y = np.concatenate([seen.y, bonnet])
    y += rng.normal(0, NOISE, y.shape) * np.where(np.arange(len(y)) < 400, 1.0, 0.2)[:, None]
    # It went straight on before, as the bonnet has it all the time.
    for before in (None, Pose(np.eye(3), seen.t)):
        result = estimate(x, y, before)
        assert result.status is Status.OK
        assert rotation_angle(result.R, seen.R) < 1e-3
        assert direction_angle(result.t, seen.t) < 0.02
        assert squared_error(result, seen) < chi2.ppf(0.9999, 5)


def test_a_sky_that_keeps_its_pixels_while_the_camera_drives_straight_on_is_of_the_world() -> None:
    rng = np.random.default_rng(6)
    seen = two_views(rng, count=300, t=FORWARD, turn=(0.0, 0.0, 0.0))
    sky = rng.uniform((0, 0), (SIZE[0], 120), (200, 2))
    x, y = np.concatenate([seen.x, sky]), np.concatenate([seen.y, sky])
    result = estimate(x, y + rng.normal(0, NOISE, y.shape))
    assert result.status is Status.OK
    assert len(result.x) == 500 and result.inliers[300:].mean() > 0.9


def squared_error(result: RelativePose, seen: TwoViews) -> float:
    """Give the squared error of a pose over its covariance, 5 on average."""
    return squared_distance(result.covariance_5,
                            pose_difference(result.R, result.t, Pose(seen.R, seen.t)))


def plane_of_two_motions() -> tuple[np.ndarray, np.ndarray]:
    """Give noisy matches on one plane, which move alike under two motions."""
    rng = np.random.default_rng(4)
    x = rng.uniform((50, 50), (1190, 330), (200, 2))
    R = Rotation.from_rotvec((0.01, 0.03, -0.005)).as_matrix()
    H = K @ (R + np.outer((0.2, 0.1, -0.3), [0.1, 0.2, 0.15])) @ np.linalg.inv(K)
    y = np.column_stack([x, np.ones(200)]) @ H.T
    return x, y[:, :2] / y[:, 2:] + rng.normal(0, NOISE, (200, 2))


def test_where_another_motion_explains_the_matches_as_well_the_pose_says_so() -> None:
    result = estimate(*plane_of_two_motions())
    assert result.status is Status.AMBIGUOUS
    # Its guess is one of them, and its covariance spans a large part of the way to the other.
    assert result.t.any()
    assert np.sqrt(np.trace(result.covariance_5[3:, 3:])) > 0.1


def test_a_pair_without_its_parallax_turns_as_its_matches_do_and_doubts_the_bent_one() -> None:
    rng = np.random.default_rng(3)
    x, R = rng.uniform((50, 50), (1190, 330), (300, 2)), Rotation.from_rotvec(TURN).as_matrix()
    y, _ = project(K, np.column_stack([x, np.ones(len(x))]) @ np.linalg.inv(K).T @ R.T)
    seen = estimate(x, y + rng.normal(0, NOISE, y.shape))
    wrong = rotation_exp(np.array([0.002, -0.003, 0.001])) @ seen.R
    bent = replace(seen, status=Status.OK, R=wrong, t=unit(np.asarray(SIDEWAYS)))
    turn = as_turn(bent, K)
    assert turn.status is Status.NO_PARALLAX and not turn.t.any()
    assert rotation_angle(turn.R, R) < 1e-4
    off = Rotation.from_matrix(wrong @ R.T).as_rotvec()
    assert unit(off) @ turn.covariance_5[:3, :3] @ unit(off) > 0.9 * off @ off


def test_the_motion_before_decides_between_them() -> None:
    x, y = plane_of_two_motions()
    guess = estimate(x, y)
    assert estimate(x, y, Pose(guess.R, guess.t)).status is Status.OK


@pytest.mark.parametrize('seed', range(4))
def test_no_picture_of_a_plane_alone_is_sure_of_the_wrong_one_of_its_motions(seed: int) -> None:
    rng, estimator, sure = np.random.default_rng(seed), TwoViewEstimator(), 0
    for _ in range(8):
        R, t, *pictures = pictures_of_a_plane(rng)
        result = estimator.estimate(*(estimator.view(gray, CLOSE_UP) for gray in pictures))
        assert result.status in (Status.OK, Status.AMBIGUOUS)
        # Where it is wrong, its ellipsoid spans both.
        off = pose_difference(result.R, result.t, Pose(R, unit(t)))
        assert squared_distance(result.covariance_5, off) < chi2.ppf(0.999, 5)
        sure += result.status is Status.OK and np.linalg.norm(off) < 0.02
    # The other motion has some of what is seen behind it, often.
    assert sure >= 2


@pytest.mark.parametrize('seed', range(4))
def test_who_drives_towards_a_wall_is_not_sure_of_the_wrong_one_of_its_motions(seed: int) -> None:
    """Both are in one basin, and what goes on before may lead all starts to the same."""
    t = -0.06 * Rotation.from_euler('y', 10, degrees=True).as_matrix()[:, 2]
    estimator, before = TwoViewEstimator(), None
    views = [estimator.view(gray, CLOSE_UP)
             for gray in pictures_towards_a_wall(np.random.default_rng([seed, 11]), t, 14)]
    for pair in pairwise(views):
        before = estimator.estimate(*pair, before)
        off = pose_difference(before.R, before.t, Pose(np.eye(3), unit(t)))
        assert squared_distance(before.covariance_5, off) < chi2.ppf(1 - 1e-5, 5)


def test_each_motion_of_a_plane_is_the_other_one_of_the_other() -> None:
    x, y = plane_of_two_motions()
    one = Pose(Rotation.from_rotvec((0.01, 0.03, -0.005)).as_matrix(), unit([0.2, 0.1, -0.3]))
    other = planar_twin(one, K, x, y, NOISE)
    assert other is not None
    assert unsigned_distance(one, other.pose) > 0.1
    back = planar_twin(other.pose, K, x, y, NOISE)
    assert back is not None
    assert unsigned_distance(one, back.pose) < 0.01
    y[:30] += 2.0
    assert planar_twin(one, K, x, y, NOISE) is None


def test_what_stands_out_of_a_plane_tells_its_motions_apart() -> None:
    x, y = plane_of_two_motions()
    assert is_planar(x, y, NOISE)
    y[:30] += 2.0  # one of seven, ten standard deviations
    assert not is_planar(x, y, NOISE)


def going_on(x: np.ndarray, y: np.ndarray, before: Pose) -> RelativePose:
    """Estimate from matches that were found where a motion before foresaw them."""
    return TwoViewEstimator(EstimatorConfig(method='rpe')).estimate_pair(
        Pair(uniform_view(), uniform_view(), x, y, before, predicted=before))


@pytest.mark.parametrize('t', [FORWARD, SIDEWAYS])
@pytest.mark.parametrize('off', [0.0, 0.02, 0.1])
def test_going_on_ends_where_all_starts_end(t: Sequence[float], off: float) -> None:
    rng = np.random.default_rng(8)
    seen = two_views(rng, count=600, t=t)
    y = seen.y + rng.normal(0, NOISE, seen.y.shape)
    y[::5] += rng.uniform(-24, 24, y[::5].shape)  # false ones, as near as they are sought
    one = going_on(seen.x, y, Pose(*moved_pose(seen.R, seen.t, off, rng)))
    other = estimate(seen.x, y)
    assert one.status is other.status is Status.OK
    assert rotation_angle(one.R, other.R) < 1e-4
    assert direction_angle(one.t, other.t) < 1e-3


def test_going_on_with_a_wrong_motion_finds_the_right_one_nevertheless() -> None:
    for seed in range(5):
        rng = np.random.default_rng(seed)
        seen = two_views(rng, count=600, t=FORWARD)
        wrong = Pose(seen.R, unit(np.asarray(SIDEWAYS)))
        result = going_on(seen.x, seen.y + rng.normal(0, NOISE, seen.y.shape), wrong)
        assert result.status is Status.OK
        assert direction_angle(result.t, seen.t) < 0.02


def test_going_on_does_not_decide_between_motions_that_are_both_far_from_the_one_before() -> None:
    x, y = plane_of_two_motions()
    guess = estimate(x, y)
    assert going_on(x, y, Pose(guess.R, -unit(np.cross(guess.t, (0.3, 0.8, 0.1))))).status \
        is Status.AMBIGUOUS


def test_points_in_space_leave_no_choice() -> None:
    for seed in range(5):
        rng = np.random.default_rng(seed)
        seen = two_views(rng, count=100)
        result = estimate(seen.x, seen.y + rng.normal(0, NOISE, seen.y.shape))
        assert result.status is Status.OK


def test_false_matches_agree_with_no_motion_that_is_believed() -> None:
    for seed in range(30):
        rng = np.random.default_rng(seed)
        x = rng.uniform((0, 0), SIZE, (250, 2))
        angle, length = rng.uniform(0, 2 * np.pi, 250), 186 * np.sqrt(rng.uniform(0, 1, 250))
        y = x + np.column_stack([np.cos(angle), np.sin(angle)]) * length[:, None]
        assert estimate(x, y).status not in (Status.OK, Status.NO_PARALLAX)


def test_a_motion_that_a_few_of_many_agree_with_is_expected_by_chance() -> None:
    assert false_alarms(20, 332, 0.02) > 0
    assert false_alarms(5, 332, 0.02) == np.inf
    assert false_alarms(100, 332, 0.02) < 0
    assert false_alarms(20, 24, 0.02) < 0


def preference_between(x: np.ndarray, y: np.ndarray, one: Pose, other: Pose) -> float:
    surface = ReprojectionSurface(x, y)
    problem = jet_problem(K, x, surface.around(y))
    losses = losses_at(problem, [one, other], Loss('geman_mcclure', 1.0))
    return float(preferences(losses, x, 0)[1])


def test_of_two_motions_equally_wrong_neither_is_preferred_more_often_than_chance_has_it() -> None:
    found = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        seen = two_views(rng, count=100)
        y = seen.y + rng.normal(0, NOISE, seen.y.shape)
        off = rng.normal(0, 1e-3, 3)
        one, other = (Pose(rotation_exp(sign * off) @ seen.R, seen.t) for sign in (1, -1))
        found.append(preference_between(seen.x, y, one, other))
    assert abs(np.mean(found)) < 4 / np.sqrt(200)
    assert 0.7 < np.std(found) < 1.2


def test_repeating_every_match_next_to_itself_makes_no_preference_stronger() -> None:
    rng = np.random.default_rng(0)
    seen = two_views(rng, count=100)
    y = seen.y + rng.normal(0, NOISE, seen.y.shape)
    one, other = Pose(seen.R, seen.t), Pose(rotation_exp(np.array([0, 2e-3, 0])) @ seen.R, seen.t)
    once = preference_between(seen.x, y, one, other)
    assert once > 3
    assert preference_between(np.tile(seen.x, (2, 1)), np.tile(y, (2, 1)), one, other) == \
        pytest.approx(once)


def test_a_covariance_that_spans_a_pose_is_that_of_errors_where_it_may_be_true() -> None:
    rng = np.random.default_rng(5)
    A, t = rng.normal(size=(5, 5)) * 0.01, unit(rng.normal(size=3))
    R = rotation_exp(rng.normal(size=3))
    off = pose_difference(R, t, Pose(rotation_exp(rng.normal(size=3) * 0.3) @ R,
                                     -unit(t + rng.normal(size=3) * 0.3)))
    five, six = widened_to_span(A @ A.T, t, off, 1 / 9)
    assert squared_distance(five, off) < 9  # a third of it is one standard deviation at least
    assert np.linalg.eigvalsh(five - A @ A.T).min() > -1e-12
    assert np.linalg.norm(six[3:, 3:] @ t) < 1e-12  # t keeps its length
    # Errors of the two, as often as either is true, have that covariance.
    errors = rng.multivariate_normal(np.zeros(5), A @ A.T, 200_000)
    errors[rng.random(len(errors)) < 1 / 9] += off
    assert np.allclose(errors.T @ errors / len(errors), five, atol=0.03 * np.abs(five).max())


@pytest.mark.parametrize(('preference', 'two_bodies', 'spanned'), [
    (2.4, False, True), (4.5, False, True), (4.8, False, False), (8.0, False, False),
    (4.8, True, True)])
def test_a_motion_far_off_that_is_true_of_less_than_one_pair_of_a_hundred_blurs_none_of_them(
        preference: float, two_bodies: bool, spanned: bool) -> None:
    seen = two_views(np.random.default_rng(7), count=100)
    around, aside = np.cross(seen.t, (0, 0, 1)), np.radians(60)
    rival = Rival(Pose(seen.R, rotation_exp(aside * unit(around)) @ seen.t), preference)
    track = SimpleNamespace(rivals=(rival,), nearby=(), body_ambiguous=two_bodies)
    own = np.radians(0.2)**2 * np.eye(5), np.zeros((6, 6))
    _, (covariance, _) = _compare_with_rivals(Pose(seen.R, seen.t), own, track, seen.x, None,
                                              sign_open=False)
    claimed = np.degrees(np.sqrt(np.trace(covariance[3:, 3:])))
    # As far as it is off, as often as it is the true one; else what is known of the pose alone.
    probable = norm.cdf(-preference / 2) if spanned else 0.0
    assert claimed == pytest.approx(np.hypot(
        0.2 * np.sqrt(2), np.degrees(np.sqrt(probable) * np.sin(aside))), rel=0.01)


def test_only_what_is_like_the_motion_before_goes_on() -> None:
    before, turned = Pose(np.eye(3), unit(np.array([0.0, 0, -1]))), rotation_exp(
        np.array([0, 0.02, 0]))
    alike, unlike = Pose(turned, before.t), Pose(np.eye(3), unit(np.array([1.0, 0, -1])))
    assert continues_motion(before, alike, unlike)
    assert not continues_motion(before, unlike, alike)
    assert not continues_motion(before, alike, Pose(turned.T, before.t))  # as like as the other


def test_directions_all_round_leave_no_large_gap() -> None:
    starts = np.array([pose.t for pose in hemisphere_starts(np.eye(3), 10)])
    assert np.allclose(np.linalg.norm(starts, axis=1), 1)
    sphere = unit(np.random.default_rng(6).normal(size=(500, 3)))
    assert np.degrees(np.arccos(np.abs(sphere @ starts.T).max(1)).max()) < 45


@pytest.mark.parametrize(('ours', 'others'), [(3, 5), (5, 3), (3, 6), (6, 3)])
def test_of_minima_beside_one_another_the_lowest_is_taken_and_no_pose_is_sure_of_it(
        ours: int, others: int) -> None:
    # What is far tells the rotation, and the few that are near the direction: some of them are
    # wrong by some widths of the loss. Each group has a minimum, all in one basin.
    rng = np.random.default_rng(3)
    one = Pose(rotation_exp(np.array(TURN)), unit(np.array(SIDEWAYS)))
    other = Pose(one.R, rotation_exp(np.array([0, 0, 0.005])) @ one.t)
    parts = [two_views(rng, 300, one.t, near=300, far=1000),
             two_views(rng, ours, one.t, near=5, far=6),
             two_views(rng, others, other.t, near=5, far=6)]
    x, y = (np.concatenate([getattr(part, name) for part in parts]) for name in 'xy')
    y += rng.normal(0, 0.05, y.shape)
    problem = jet_problem(K, x, ReprojectionSurface(x, y).around(y))
    loss = Loss('geman_mcclure', 0.2)
    right, wrong = (one, other) if ours > others else (other, one)
    for pose in (right, wrong):
        end = minimise(problem, pose.R, pose.t, loss)
        solution, beside = lowest_nearby_minimum(problem, x, end, loss)
        assert unsigned_distance(solution.pose, right) < 0.003
        assert all(0 < rival.preference < 2.33 for rival in beside)
    assert unsigned_distance(end.pose, right) > 0.003
    assert min(unsigned_distance(rival.pose, end.pose) for rival in beside) < 1e-9


def test_a_lone_minimum_has_none_beside_it() -> None:
    rng = np.random.default_rng(6)
    views = two_views(rng, 300)
    y = views.y + rng.normal(0, 0.05, views.y.shape)
    problem = jet_problem(K, views.x, ReprojectionSurface(views.x, y).around(y))
    loss = Loss('geman_mcclure', 0.2)
    end = minimise(problem, views.R, views.t, loss)
    assert lowest_nearby_minimum(problem, views.x, end, loss) == (end, ())
