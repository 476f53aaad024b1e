"""Ambiguous pairs: two basins, two bodies, random matches; and unambiguous ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
import math
from types import SimpleNamespace

from djet_ros.core.basins import likeliest, lowest_nearby_minimum
from djet_ros.core.covariance import (
    lifted_covariance,
    pose_covariance,
    pose_difference,
    squared_distance,
    widened,
    widened_to_span,
)
from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.geometry import (
    direction_angle,
    epipolar_lines,
    fundamental,
    in_front,
    rays,
    rotation_angle,
    rotation_exp,
    unit,
)
from djet_ros.core.jet import epipolar_residuals, jet_problem, Loss, minimise
from djet_ros.core.pair import Pair
from djet_ros.core.rivals import (
    continues_motion,
    false_alarms,
    is_planar,
    may_stand,
    planar_twin,
    pose_distance,
    preferences,
    PreviousMotion,
    static_by_depth,
    unsigned_distance,
)
from djet_ros.core.sketch import losses_at
from djet_ros.core.starts import hemisphere_starts, KnownMotion
from djet_ros.core.surfaces import ReprojectionSurface
from djet_ros.core.types import Pose, RelativePose, Rival, Status
from djet_ros.core.verdict import _compare_with_rivals, as_decided, as_pure_rotation
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
# Motion of a body relative to the camera: across, or against it along its own direction.
BODIES = {'across': (0.3, 0.05, 0.4), 'against': (0.0, -0.016, 0.8)}
FLAT, DEEP = (3, 4), (4, 40)


def scene_with_body(still: int, moving: int, motion: str, box: tuple[float, float],
                    depths: tuple[float, float] = (5, 8)
                    ) -> tuple[TwoViews, np.ndarray, np.ndarray, Pose]:
    """Return matches of the static world and of a body between two columns, and its motion."""
    rng = np.random.default_rng(3)
    seen = two_views(rng, count=still, t=FORWARD, turn=(0.0, 0.004, 0.0))
    pixels = rng.uniform((box[0], 60), (box[1], SIZE[1]), (moving, 2))
    points = (np.column_stack([pixels, np.ones(moving)]) @ np.linalg.inv(K).T
              * rng.uniform(*depths, (moving, 1)))
    R, t = rotation_exp(np.array([0.0, -0.01, 0.003])), np.array(BODIES[motion])
    x = np.concatenate([seen.x, pixels])
    y = np.concatenate([seen.y, project(K, points @ R.T + t)[0]])
    return seen, x, y + rng.normal(0, NOISE, y.shape), Pose(R, unit(t))


def estimate(x: np.ndarray, y: np.ndarray, motion: Pose | None = None) -> RelativePose:
    prior = None if motion is None else RelativePose(Status.OK, motion.R, motion.t)
    return TwoViewEstimator(EstimatorConfig(method='rpe')).estimate_matched(
        uniform_view(), uniform_view(), x, y, prior)


@pytest.mark.parametrize(('behind', 'prior', 'status'), [
    (20, None, Status.OK), (95, None, Status.AMBIGUOUS), (95, 'likewise', Status.OK),
    (105, 'likewise', Status.OK)])
def test_balanced_chirality_leaves_the_sign_of_t_to_the_prior(
        behind: int, prior: str | None, status: Status) -> None:
    """Edges along the motion have false matches on either half of epipolar lines."""
    rng = np.random.default_rng(4)
    seen = two_views(rng, t=FORWARD, count=100)
    on_lines = two_views(rng, t=np.negative(FORWARD), count=behind)
    anywhere = rng.uniform((0, 0), SIZE, (2, 2 * behind, 2))
    x, y = (np.concatenate(parts) for parts in zip(
        (seen.x, seen.y), (on_lines.x, on_lines.y), anywhere))
    result = estimate(x, y, Pose(seen.R, seen.t) if prior else None)
    assert result.status is status
    if status is Status.OK:
        assert direction_angle(result.t, seen.t) < 1e-3
        assert direction_claimed(result) < 1
    else:
        assert direction_claimed(result) > 30


def direction_claimed(result: RelativePose) -> float:
    """Return the largest standard deviation of the direction, in degrees."""
    return float(np.degrees(np.sqrt(np.linalg.eigvalsh(result.covariance_5[3:, 3:])[-1])))


@pytest.mark.parametrize('motion', BODIES)
def test_two_bodies_of_equal_depth_range_are_two_motions(motion: str) -> None:
    _, x, y, _ = scene_with_body(200, 300, motion, (300, 1000), DEEP)
    assert estimate(x, y).status is Status.TWO_MOTIONS


@pytest.mark.parametrize('motion', BODIES)
def test_the_static_world_spans_depths_even_if_a_flat_body_has_most_matches(
        motion: str) -> None:
    seen, x, y, _ = scene_with_body(200, 300, motion, (300, 1000), FLAT)
    result = estimate(x, y)
    assert result.status is Status.OK
    assert rotation_angle(result.R, seen.R) < 2e-3
    assert direction_angle(result.t, seen.t) < 0.02


@pytest.mark.parametrize(('flatness', 'static'), [
    ((0.1, 0.8), 0), ((0.8, 0.1), 1), ((0.1, 0.1), None), ((0.8, 0.8), None), ((0.4, 0.8), None),
    ((0.1, 0.4), None), ((np.nan, 0.8), None), ((0.1, np.nan), None)])
def test_the_static_world_alone_has_depths_from_near_to_far(
        flatness: tuple[float, float], static: int | None) -> None:
    """Near over far depth of both bodies, NaN if noise hides it."""
    assert static_by_depth(flatness) == static


@pytest.mark.parametrize(('box', 'narrower'), [((0, 700), False), ((300, 500), True)])
def test_of_two_bodies_that_nothing_tells_apart_the_one_over_a_wider_area_is_the_best_guess(
        box: tuple[float, float], narrower: bool) -> None:
    """The static world surrounds what moves in it; the other motion is the rival."""
    seen, x, y, body = scene_with_body(200, 300, 'across', box, DEEP)
    if not narrower:
        keep = np.arange(500)[(np.arange(500) >= 200) | (np.abs(x[:, 0] - 950) < 150)]
        x, y = x[keep], y[keep]
    result = estimate(x, y)
    guess, other = (seen.t, body.t) if narrower else (body.t, seen.t)
    assert result.status is Status.TWO_MOTIONS
    assert direction_angle(result.t, guess) < 0.1
    assert min(direction_angle(rival.pose.t, other) for rival in result.rivals) < 0.1


def test_a_body_without_parallax_may_be_the_static_world(
        monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(BODIES, 'beside', (0.0, 0.0, 1e-9))
    _, x, y, _ = scene_with_body(200, 300, 'beside', (300, 1000), FLAT)
    assert estimate(x, y).status is Status.TWO_MOTIONS


@pytest.mark.parametrize('motion', BODIES)
def test_the_prior_identifies_the_static_world_against_the_majority(
        motion: str) -> None:
    seen, x, y, body = scene_with_body(200, 300, motion, (300, 1000))
    result = estimate(x, y, Pose(rotation_exp(np.array([0, 0.002, 0])) @ seen.R, seen.t))
    assert result.status is Status.OK
    assert rotation_angle(result.R, seen.R) < 2e-3
    assert direction_angle(result.t, seen.t) < 0.02
    assert result.inliers[:200].mean() > 0.8 and result.inliers[200:].mean() < 0.3
    # … and with the motion of the body as the prior, the body is chosen.
    assert direction_angle(estimate(x, y, body).t, body.t) < 0.1


def test_a_small_body_is_not_mistaken_for_the_static_world() -> None:
    seen, x, y, _ = scene_with_body(400, 60, 'across', (600, 760))
    result = estimate(x, y)
    assert result.status is Status.OK
    assert direction_angle(result.t, seen.t) < 0.01
    assert not result.inliers[400:].any()


@pytest.mark.parametrize('false', [0, 25])
def test_a_few_matches_that_move_alike_all_over_the_image_are_no_body(false: int) -> None:
    rng = np.random.default_rng(0)
    seen, *matches, _ = scene_with_body(400, 40, 'across', (0, SIZE[0]), DEEP)
    x, y = (np.concatenate([places, rng.uniform((0, 0), SIZE, (false, 2))]) for places in matches)
    result = estimate(x, y)
    assert result.status is Status.OK
    assert direction_angle(result.t, seen.t) < 0.01


@pytest.mark.parametrize('stuck', [200, 500])
@pytest.mark.parametrize('seed', range(3))
def test_matches_attached_to_a_rotating_camera_are_removed(
        stuck: int, seed: int) -> None:
    """A bonnet in the lower part of the image, with up to as many matches as the world."""
    rng = np.random.default_rng(seed)
    seen = two_views(rng, count=400, t=FORWARD, turn=(0.0, 0.012, 0.0))
    bonnet = rng.uniform((0, 250), SIZE, (stuck, 2))
    x = np.concatenate([seen.x, bonnet])
    y = np.concatenate([seen.y, bonnet])
    y += rng.normal(0, NOISE, y.shape) * np.where(np.arange(len(y)) < 400, 1.0, 0.2)[:, None]
    # The prior has no rotation, as the bonnet.
    for prior in (None, Pose(np.eye(3), seen.t)):
        result = estimate(x, y, prior)
        assert result.status is Status.OK
        assert rotation_angle(result.R, seen.R) < 1e-3
        assert direction_angle(result.t, seen.t) < 0.02
        assert squared_error(result, seen) < chi2.ppf(0.9999, 5)


@pytest.mark.parametrize('seed', range(3))
def test_the_prior_tells_a_bonnet_from_a_world_of_one_depth(seed: int) -> None:
    rng = np.random.default_rng(seed)
    seen = two_views(rng, count=400, t=FORWARD, turn=(0.0, 0.012, 0.0), near=8, far=14)
    bonnet = rng.uniform((0, 250), SIZE, (200, 2))
    x, y = np.concatenate([seen.x, bonnet]), np.concatenate([seen.y, bonnet])
    y += rng.normal(0, NOISE, y.shape) * np.where(np.arange(600) < 400, 1.0, 0.2)[:, None]
    result = estimate(x, y, Pose(seen.R, seen.t))
    assert result.status is Status.OK
    assert rotation_angle(result.R, seen.R) < 1e-3
    assert direction_angle(result.t, seen.t) < 0.02


def test_what_stays_in_place_before_a_standing_camera_is_kept_while_a_lorry_passes() -> None:
    """Only the static world has depths from near to far; without them, it may be what stays."""
    rng = np.random.default_rng(0)
    _, x, y, _ = scene_with_body(1, 300, 'against', (300, 1000), FLAT)
    still = rng.uniform((0, 0), SIZE, (300, 2))
    x, y = np.concatenate([still, x]), np.concatenate([still, y])
    y[:300] += rng.normal(0, NOISE, still.shape)
    assert len(estimate(x, y).x) == len(x)


def test_a_body_that_passes_may_move_instead_of_the_camera() -> None:
    """To its motion what stands still is infinitely far; only the previous motion tells more."""
    rng = np.random.default_rng(0)
    seen = two_views(rng, count=600, t=SIDEWAYS, turn=(0.0, 0.0, 0.0), near=8, far=9)
    still = rng.uniform((0, 0), SIZE, (60, 2))
    x, y = np.concatenate([seen.x, still]), np.concatenate([seen.y, still])
    y += rng.normal(0, NOISE, y.shape)
    for prior, status in ((None, Status.TWO_MOTIONS), (Pose(seen.R, seen.t), Status.OK),
                          (Pose(seen.R, np.array(FORWARD)), Status.TWO_MOTIONS)):
        result = estimate(x, y, prior)
        assert result.status is status
        sigma = np.degrees(np.sqrt(np.trace(result.covariance_5[3:, 3:])))
        assert (sigma > 90) == (status is Status.TWO_MOTIONS)


@pytest.mark.parametrize(('far', 'turn', 'still', 'slightly', 'prior', 'stands'), [
    (9.0, 0.0, 60, 0, None, True),
    (80.0, 0.0, 60, 0, None, False),  # the static world
    (9.0, 0.01, 60, 0, None, False),
    (9.0, 0.0, 20, 0, None, False),
    (9.0, 0.0, 60, 12, None, True),
    (9.0, 0.0, 60, 18, None, False),
    (9.0, 0.0, 60, 0, 0.05, False),
    (9.0, 0.0, 60, 0, 0.2, True)])
def test_a_camera_may_stand_if_enough_stays_and_all_else_moves_far_as_one_compact_body(
        far: float, turn: float, still: int, slightly: int, prior: float | None, stands: bool
        ) -> None:
    """It may not if it turns, or goes on as before. Slightly is by 6 to 18 standard deviations."""
    rng = np.random.default_rng(1)
    seen = two_views(rng, count=400, t=SIDEWAYS, turn=(0.0, turn, 0.0), near=8, far=far)
    in_place = rng.uniform((0, 0), SIZE, (still + slightly, 2))
    false = rng.uniform((0, 0), SIZE, (2, 100, 2))
    x, y = (np.concatenate(parts) for parts in zip((seen.x, seen.y), false, (in_place, in_place)))
    y[len(y) - slightly:, 0] += 12 * NOISE
    y += rng.normal(0, NOISE, y.shape)
    problem = jet_problem(K, x, ReprojectionSurface(x, y).fit_around(y))
    pose = Pose(seen.R, seen.t)
    before = None if prior is None else Pose(rotation_exp(np.array([prior, 0, 0])), seen.t)
    assert may_stand(problem, np.linalg.norm(y - x, axis=1), pose, K[0, 0], NOISE, 30, before
                     ) == stands


@pytest.mark.parametrize('differs', ['depths', 'turn', 'slightly'])
def test_a_camera_that_moves_past_something_distant_does_not_stand(differs: str) -> None:
    """It sees depths from near to far, or turns, or sees places that move slightly."""
    rng = np.random.default_rng(0)
    turn = (0.0, 0.01, 0.0) if differs == 'turn' else (0.0, 0.0, 0.0)
    far = 80.0 if differs == 'depths' else 9.0
    seen = two_views(rng, count=600, t=SIDEWAYS, turn=turn, near=8, far=far)
    near, far = (200, 1000) if differs == 'slightly' else (1000, 9000)
    distant = two_views(rng, count=200, t=SIDEWAYS, turn=turn, near=near, far=far)
    x, y = (np.concatenate([getattr(seen, each), getattr(distant, each)]) for each in 'xy')
    y += rng.normal(0, NOISE, y.shape)
    result = estimate(x, y)
    assert result.status is Status.OK
    assert direction_angle(result.t, seen.t) < 0.02


def test_what_stays_in_place_before_a_camera_that_stood_is_not_attached_to_it() -> None:
    """All else moves by one motion, with depths from near to far."""
    rng = np.random.default_rng(0)
    seen = two_views(rng, count=400, t=FORWARD, turn=(0.0, 0.012, 0.0))
    still = rng.uniform((0, 250), SIZE, (200, 2))
    x, y = np.concatenate([seen.x, still]), np.concatenate([seen.y, still])
    y += rng.normal(0, NOISE, y.shape) * np.where(np.arange(600) < 400, 1.0, 0.2)[:, None]
    estimator = TwoViewEstimator(EstimatorConfig(method='rpe'))
    for stood, kept in ((False, 0.0), (True, 1.0)):
        result = estimator.estimate_pair(Pair(uniform_view(), uniform_view(), x, y,
                                              known=KnownMotion(stood=stood)))
        assert np.isin(still[:, 0], result.x[:, 0]).mean() == kept


def test_a_static_sky_before_a_camera_without_rotation_is_kept() -> None:
    rng = np.random.default_rng(6)
    seen = two_views(rng, count=300, t=FORWARD, turn=(0.0, 0.0, 0.0))
    sky = rng.uniform((0, 0), (SIZE[0], 120), (200, 2))
    x, y = np.concatenate([seen.x, sky]), np.concatenate([seen.y, sky])
    result = estimate(x, y + rng.normal(0, NOISE, y.shape))
    assert result.status is Status.OK
    assert len(result.x) == 500 and result.inliers[300:].mean() > 0.9


def squared_error(result: RelativePose, seen: TwoViews) -> float:
    """Return the squared error of a pose over its covariance, 5 on average."""
    return squared_distance(result.covariance_5,
                            pose_difference(result.R, result.t, Pose(seen.R, seen.t)))


def plane_of_two_motions() -> tuple[np.ndarray, np.ndarray]:
    """Return noisy matches on one plane, which two motions explain."""
    rng = np.random.default_rng(4)
    x = rng.uniform((50, 50), (1190, 330), (200, 2))
    R = Rotation.from_rotvec((0.01, 0.03, -0.005)).as_matrix()
    H = K @ (R + np.outer((0.2, 0.1, -0.3), [0.1, 0.2, 0.15])) @ np.linalg.inv(K)
    y = np.column_stack([x, np.ones(200)]) @ H.T
    return x, y[:, :2] / y[:, 2:] + rng.normal(0, NOISE, (200, 2))


def test_an_equally_likely_motion_makes_a_pose_ambiguous() -> None:
    result = estimate(*plane_of_two_motions())
    assert result.status is Status.AMBIGUOUS
    # Its best guess is one of them, and its covariance spans a large part of the distance to the
    # other.
    assert result.t.any()
    assert np.sqrt(np.trace(result.covariance_5[3:, 3:])) > 0.1
    assert min(abs(rival.pose.t @ result.t) for rival in result.rivals) < 0.9
    assert np.sqrt(np.trace(result.own_covariance_5[3:, 3:])) < 0.1


def test_as_pure_rotation_fits_the_rotation_and_widens_the_covariance() -> None:
    rng = np.random.default_rng(3)
    x, R = rng.uniform((50, 50), (1190, 330), (300, 2)), Rotation.from_rotvec(TURN).as_matrix()
    y, _ = project(K, np.column_stack([x, np.ones(len(x))]) @ np.linalg.inv(K).T @ R.T)
    seen = estimate(x, y + rng.normal(0, NOISE, y.shape))
    wrong = rotation_exp(np.array([0.002, -0.003, 0.001])) @ seen.R
    biased = replace(seen, status=Status.OK, R=wrong, t=unit(np.asarray(SIDEWAYS)))
    turn = as_pure_rotation(biased, K)
    assert turn.status is Status.NO_PARALLAX and not turn.t.any()
    assert rotation_angle(turn.R, R) < 1e-4
    off = Rotation.from_matrix(wrong @ R.T).as_rotvec()
    # Either of the two rotations may be right.
    assert unit(off) @ turn.covariance_5[:3, :3] @ unit(off) > 0.45 * off @ off


def test_the_prior_decides_between_two_motions() -> None:
    x, y = plane_of_two_motions()
    guess = estimate(x, y)
    assert estimate(x, y, Pose(guess.R, guess.t)).status is Status.OK


@pytest.mark.parametrize('seed', range(4))
def test_no_planar_pair_is_certain_of_the_wrong_twin(seed: int) -> None:
    rng, estimator, sure = np.random.default_rng(seed), TwoViewEstimator(), 0
    for _ in range(8):
        R, t, *pictures = pictures_of_a_plane(rng)
        result = estimator.estimate(*(estimator.view(gray, CLOSE_UP) for gray in pictures))
        assert result.status in (Status.OK, Status.AMBIGUOUS)
        # If it is wrong, its ellipsoid spans both.
        off = pose_difference(result.R, result.t, Pose(R, unit(t)))
        assert squared_distance(result.covariance_5, off) < chi2.ppf(0.999, 5)
        sure += result.status is Status.OK and np.linalg.norm(off) < 0.02
    # The other motion often has some of the points behind the camera.
    assert sure >= 2


def test_motion_towards_a_wall_is_not_certain_of_the_wrong_twin() -> None:
    """
    Both are in one basin, and the prior may lead all starts to the same one.

    A covariance spans the line to its rival, which is itself off by a degree or two: in one or two
    of a hundred pairs the true motion is far beside that line.
    """
    t = -0.06 * Rotation.from_euler('y', 10, degrees=True).as_matrix()[:, 2]
    true, beyond = Pose(np.eye(3), unit(t)), []
    for seed in range(10):
        estimator, prior = TwoViewEstimator(), None
        views = [estimator.view(gray, CLOSE_UP) for gray in pictures_towards_a_wall(
            np.random.default_rng([seed, 11]), t, 14)]
        for pair in pairwise(views):
            prior = estimator.estimate(*pair, prior)
            off = pose_difference(prior.R, prior.t, true)
            if np.degrees(np.linalg.norm(off[3:])) > 5:
                assert np.degrees(np.sqrt(np.trace(prior.covariance_5[3:, 3:]))) > 2.5
            beyond.append(squared_distance(prior.covariance_5, off) > chi2.ppf(1 - 1e-5, 5))
    assert np.mean(beyond) < 0.03


def test_planar_twins_are_mutual() -> None:
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


@pytest.mark.parametrize('seed', range(5))
def test_false_matches_on_their_epipolar_lines_do_not_hide_the_twin_of_a_plane(seed: int) -> None:
    """They agree with the motion, and have any depth."""
    rng, (x, y) = np.random.default_rng(seed), plane_of_two_motions()
    one = Pose(Rotation.from_rotvec((0.01, 0.03, -0.005)).as_matrix(), unit([0.2, 0.1, -0.3]))
    alone = planar_twin(one, K, x, y, NOISE)
    false = rng.permutation(len(x))[:6]
    lines = epipolar_lines(fundamental(K, one.R, one.t), x[false])
    y[false] += unit(lines[:, 1::-1] * (1, -1)) * rng.uniform(10, 40, (6, 1))
    beside = planar_twin(one, K, x, y, NOISE)
    assert alone is not None and beside is not None
    assert unsigned_distance(alone.pose, beside.pose) < 0.02


@pytest.mark.parametrize('seed', range(20))
def test_a_twin_is_less_likely_if_and_only_if_it_has_points_behind_a_camera(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x = rng.uniform((0, 0), SIZE, (300, 2))
    true = Pose(rotation_exp(rng.normal(0, 0.02, 3)), unit(rng.normal(size=3)))
    H = K @ (true.R + np.outer(true.t, (*rng.normal(0, 0.13, 2), 1 / 3))) @ np.linalg.inv(K)
    y = np.column_stack([x, np.ones(300)]) @ H.T
    y = y[:, :2] / y[:, 2:]
    twin = planar_twin(true, K, x, y, NOISE)
    assert twin is not None
    ahead = max(in_front(twin.pose.R, sign * twin.pose.t, rays(K, x), rays(K, y)).mean()
                for sign in (1, -1))
    assert (twin.preference > 0) == (ahead < 1)
    assert twin.preference > 2.33 or ahead > 0.95


def test_a_match_at_the_epipole_has_no_depth_and_thus_no_twin() -> None:
    x, y = plane_of_two_motions()
    x[0] = K[:2, 2]
    assert planar_twin(Pose(np.eye(3), np.array([0, 0, -1.0])), K, x, y, NOISE) is None


def test_a_relief_of_some_standard_deviations_is_no_plane() -> None:
    x, y = plane_of_two_motions()
    relief = np.random.default_rng(0).normal(0, 2.5 * NOISE, y.shape)
    assert not is_planar(x, y + relief, NOISE)


@pytest.mark.parametrize('off', [2.0, 20.0])
def test_points_off_a_plane_exclude_its_twin(off: float) -> None:
    x, y = plane_of_two_motions()
    assert is_planar(x, y, NOISE)
    y[:30] += off  # one of seven, ten standard deviations or more
    assert not is_planar(x, y, NOISE)


def estimate_predicted(x: np.ndarray, y: np.ndarray, prior: PreviousMotion) -> RelativePose:
    """Estimate from matches that were predicted by a previous motion."""
    return TwoViewEstimator(EstimatorConfig(method='rpe')).estimate_pair(
        Pair(uniform_view(), uniform_view(), x, y, prior, predicted=prior))


@pytest.mark.parametrize('t', [FORWARD, SIDEWAYS])
@pytest.mark.parametrize('off', [0.0, 0.02, 0.1])
def test_a_predicted_pair_converges_as_with_all_starts(t: Sequence[float], off: float) -> None:
    rng = np.random.default_rng(8)
    seen = two_views(rng, count=600, t=t)
    y = seen.y + rng.normal(0, NOISE, seen.y.shape)
    y[::5] += rng.uniform(-24, 24, y[::5].shape)  # false ones, as near as they are sought
    prior = PreviousMotion(*moved_pose(seen.R, seen.t, off, rng))
    one = estimate_predicted(seen.x, y, prior)
    other = estimate(seen.x, y)
    assert one.status is other.status is Status.OK
    assert rotation_angle(one.R, other.R) < 1e-4
    assert direction_angle(one.t, other.t) < 1e-3


def test_a_wrong_prediction_still_finds_the_right_motion() -> None:
    for seed in range(5):
        rng = np.random.default_rng(seed)
        seen = two_views(rng, count=600, t=FORWARD)
        wrong = PreviousMotion(seen.R, unit(np.asarray(SIDEWAYS)))
        result = estimate_predicted(seen.x, seen.y + rng.normal(0, NOISE, seen.y.shape), wrong)
        assert result.status is Status.OK
        assert direction_angle(result.t, seen.t) < 0.02


def test_a_distant_prediction_does_not_decide() -> None:
    x, y = plane_of_two_motions()
    guess = estimate(x, y)
    distant = PreviousMotion(guess.R, -unit(np.cross(guess.t, (0.3, 0.8, 0.1))))
    assert estimate_predicted(x, y, distant).status is Status.AMBIGUOUS


def test_what_the_pair_before_left_open_it_does_not_decide() -> None:
    """Two motions that fit about equally, the second a bit better."""
    rng = np.random.default_rng(0)
    places, losses = rng.uniform((0, 0), SIZE, (400, 2)), rng.uniform(size=(2, 400))
    losses[1] += 0.03 + (losses[0] - losses[1]).mean()
    losses = losses[::-1]
    turned = rotation_exp(np.array([0.0, 0.02, 0.0]))
    one, other = Pose(np.eye(3), np.array([0, 0, 1.0])), Pose(turned, np.array([0.6, 0, 0.8]))
    assert losses[0].mean() > losses[1].mean()

    def chosen(*undecided: Pose) -> int:
        return likeliest(losses, places, [one, other], PreviousMotion(one.R, one.t, undecided))

    assert likeliest(losses, places, [one, other], None) == 1
    assert chosen() == 0
    assert chosen(other) == chosen(Pose(turned, -other.t)) == 1
    # Motions that the pair before left open, but neither of these.
    assert chosen(Pose(np.eye(3), np.array([-0.8, 0, 0.6]))) == 0
    assert chosen(Pose(np.eye(3), unit(np.array([0.03, 0, 1.0])))) == 0


def test_a_predicted_pair_is_also_sought_where_the_pair_before_left_it_open() -> None:
    """From a rotation so far off no start around the prediction leads to the right one."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        seen = two_views(rng, count=600, t=SIDEWAYS)
        y = seen.y + rng.normal(0, NOISE, seen.y.shape)
        wrong = rotation_exp(np.array([3.0, 0.0, 0.0])) @ seen.R
        found = [estimate_predicted(seen.x, y, PreviousMotion(wrong, unit(np.ones(3)), undecided))
                 for undecided in ((), (Pose(*moved_pose(seen.R, seen.t, 0.03, rng)),))]
        assert rotation_angle(found[0].R, seen.R) > 0.01
        assert rotation_angle(found[1].R, seen.R) < 1e-3


def test_a_motion_is_undecided_as_long_as_the_matches_do_not_prefer_another() -> None:
    unsure = estimate(*plane_of_two_motions())
    assert len(PreviousMotion.of(unsure).undecided) == len(unsure.rivals)
    sure = replace(unsure, rivals=tuple(replace(rival, preference=2.4) for rival in unsure.rivals))
    assert not PreviousMotion.of(sure).undecided


@pytest.mark.parametrize(('preference', 'kept'), [(-1.1, True), (-0.9, False), (2.0, False)])
def test_a_decided_pair_keeps_the_rivals_that_its_matches_prefer(
        preference: float, kept: bool) -> None:
    unsure = estimate(*plane_of_two_motions())
    rivals = tuple(replace(rival, preference=preference) for rival in unsure.rivals)
    assert as_decided(replace(unsure, rivals=rivals)).rivals == (rivals if kept else ())


def test_points_in_general_position_have_no_rivals() -> None:
    for seed in range(5):
        rng = np.random.default_rng(seed)
        seen = two_views(rng, count=100)
        result = estimate(seen.x, seen.y + rng.normal(0, NOISE, seen.y.shape))
        assert result.status is Status.OK


def test_false_matches_give_no_significant_motion() -> None:
    for seed in range(30):
        rng = np.random.default_rng(seed)
        x = rng.uniform((0, 0), SIZE, (250, 2))
        angle, length = rng.uniform(0, 2 * np.pi, 250), 186 * np.sqrt(rng.uniform(0, 1, 250))
        y = x + np.column_stack([np.cos(angle), np.sin(angle)]) * length[:, None]
        assert estimate(x, y).status not in (Status.OK, Status.NO_PARALLAX)


def test_few_inliers_among_many_matches_are_not_significant() -> None:
    assert false_alarms(20, 332, 0.02) > 0
    assert false_alarms(5, 332, 0.02) == np.inf
    assert false_alarms(100, 332, 0.02) < 0
    assert false_alarms(20, 24, 0.02) < 0


@pytest.mark.parametrize(('agreeing', 'matches', 'chance'), [
    (20, 332, 0.02), (6, 8, 0.5), (7, 7, 0.3), (100, 300, 0.1)])
def test_false_alarms_are_as_many_as_choices_of_matches_that_agree_by_chance(
        agreeing: int, matches: int, chance: float) -> None:
    # Of each size, ten solutions for each five of each group of matches.
    groups = math.comb(matches, agreeing) * math.comb(agreeing, 5)
    expected = (matches - 5) * 10 * groups * chance**(agreeing - 5)
    assert false_alarms(agreeing, matches, chance) == pytest.approx(math.log10(expected))
    # Lines that are wider than the search agree with every match.
    assert false_alarms(agreeing, matches, 3.0) == false_alarms(agreeing, matches, 1.0)


def preference_between(x: np.ndarray, y: np.ndarray, one: Pose, other: Pose) -> float:
    surface = ReprojectionSurface(x, y)
    problem = jet_problem(K, x, surface.fit_around(y))
    losses = losses_at(problem, [one, other], Loss('geman_mcclure', 1.0))
    return float(preferences(losses, x, 0)[1])


def test_preferences_between_equally_wrong_motions_are_calibrated() -> None:
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


def test_duplicated_matches_do_not_strengthen_a_preference() -> None:
    rng = np.random.default_rng(0)
    seen = two_views(rng, count=100)
    y = seen.y + rng.normal(0, NOISE, seen.y.shape)
    one, other = Pose(seen.R, seen.t), Pose(rotation_exp(np.array([0, 2e-3, 0])) @ seen.R, seen.t)
    once = preference_between(seen.x, y, one, other)
    assert once > 3
    assert preference_between(np.tile(seen.x, (2, 1)), np.tile(y, (2, 1)), one, other) == \
        pytest.approx(once)


def test_a_covariance_widened_to_span_is_the_expected_squared_error() -> None:
    rng = np.random.default_rng(5)
    A, t = rng.normal(size=(5, 5)) * 0.01, unit(rng.normal(size=3))
    R = rotation_exp(rng.normal(size=3))
    off = pose_difference(R, t, Pose(rotation_exp(rng.normal(size=3) * 0.3) @ R,
                                     -unit(t + rng.normal(size=3) * 0.3)))
    five = widened_to_span(A @ A.T, off, 1 / 9)
    six = lifted_covariance(five, t)
    assert squared_distance(five, off) < 9  # a third of it is one standard deviation at least
    assert np.linalg.eigvalsh(five - A @ A.T).min() > -1e-12
    assert np.linalg.norm(six[3:, 3:] @ t) < 1e-12  # t keeps its length
    # The errors of both, weighted by their probabilities, have that covariance.
    errors = rng.multivariate_normal(np.zeros(5), A @ A.T, 200_000)
    errors[rng.random(len(errors)) < 1 / 9] += off
    assert np.allclose(errors.T @ errors / len(errors), five, atol=0.03 * np.abs(five).max())


@pytest.mark.parametrize(('preference', 'two_bodies', 'spanned'), [
    (2.4, False, True), (4.5, False, True), (4.8, False, False), (8.0, False, False),
    (4.8, True, True)])
def test_an_improbable_distant_rival_does_not_widen_the_covariance(
        preference: float, two_bodies: bool, spanned: bool) -> None:
    seen = two_views(np.random.default_rng(7), count=100)
    around, aside = np.cross(seen.t, (0, 0, 1)), np.radians(60)
    rival = Rival(Pose(seen.R, rotation_exp(aside * unit(around)) @ seen.t), preference)
    own = np.radians(0.2)**2 * np.eye(5)
    covariance, of_rival = compared_with(rival, seen, own, two_bodies)
    # The squared distance times its probability, and how uncertain the rival itself is; otherwise
    # only the covariance of the pose.
    added = covariance - own - spanned * of_rival
    probable = norm.cdf(-preference / 2) if spanned else 0.0
    assert np.trace(added[3:, 3:]) == pytest.approx(probable * aside**2, rel=1e-6, abs=1e-12)


def compared_with(rival: Rival, seen: TwoViews, own: np.ndarray, two_bodies: bool = False
                  ) -> tuple[np.ndarray, np.ndarray]:
    """Return the covariance of the true pose that spans a rival, and that of the rival (5, 5)."""
    pose, voting = Pose(seen.R, seen.t), np.ones(len(seen.x), bool)
    problem = jet_problem(K, seen.x, ReprojectionSurface(seen.x, seen.y).fit_around(seen.y))
    track = SimpleNamespace(rivals=(rival,), nearby=(), body_ambiguous=two_bodies,
                            problem=problem, loss=Loss(), voting=voting)
    _, covariance, _ = _compare_with_rivals(pose, own, track, seen.x, None, sign_open=False)
    residuals = epipolar_residuals(problem, rival.pose.R, rival.pose.t)
    of_rival = pose_covariance(residuals, Loss(), seen.x, seen.t, flipped=False)[1]
    return covariance, widened(np.zeros((5, 5)), seen.t, of_rival)


@pytest.mark.parametrize('seed', range(5))
def test_beside_the_line_to_a_possible_rival_a_pose_is_as_uncertain_as_that(seed: int) -> None:
    rng = np.random.default_rng(seed)
    seen = two_views(rng, count=100)
    rival = Rival(Pose(*moved_pose(seen.R, seen.t, 0.1, rng)), rng.uniform(0.5, 4.5))
    off = pose_difference(seen.R, seen.t, rival.pose)
    covariance, of_rival = compared_with(rival, seen, 1e-12 * np.eye(5))
    # Errors of a true rival, sampled: all but their part along the line are within the bound.
    errors = off + rng.multivariate_normal(np.zeros(5), of_rival, 1000)
    probability = norm.cdf(-rival.preference / 2)
    squared = np.array([squared_distance(covariance, error) for error in errors])
    assert (squared < 1 / probability + chi2.ppf(0.999, 5)).mean() > 0.99


def test_only_a_motion_like_the_previous_one_continues_it() -> None:
    prior, turned = Pose(np.eye(3), unit(np.array([0.0, 0, -1]))), rotation_exp(
        np.array([0, 0.02, 0]))
    alike, unlike = Pose(turned, prior.t), Pose(np.eye(3), unit(np.array([1.0, 0, -1])))
    assert continues_motion(prior, alike, unlike)
    assert not continues_motion(prior, unlike, alike)
    assert not continues_motion(prior, alike, Pose(turned.T, prior.t))  # as like as the other
    somewhat_less = Pose(rotation_exp(np.array([0, 0.03, 0])), prior.t)
    assert not continues_motion(prior, alike, somewhat_less)
    assert not continues_motion(prior, unlike, Pose(np.eye(3), -prior.t))  # unlike, as both


@pytest.mark.parametrize('seed', range(5))
def test_the_distance_of_motions_is_the_angle_of_rotation_and_direction(seed: int) -> None:
    rng = np.random.default_rng(seed)
    one = Pose(rotation_exp(rng.normal(size=3)), unit(rng.normal(size=3)))
    turn, aside = rng.normal(0, 1e-3, (2, 3))
    aside -= one.t * (one.t @ aside)
    R, t = rotation_exp(turn) @ one.R, unit(one.t + aside)
    turned, moved = np.linalg.norm(turn), np.linalg.norm(aside)
    for other, angle in ((Pose(R, one.t), turned), (Pose(one.R, t), moved),
                         (Pose(R, t), np.hypot(turned, moved))):
        opposite = Pose(other.R, -other.t)
        assert pose_distance(one, other) == pytest.approx(angle, rel=1e-3)
        assert pose_distance(one, opposite) > 1.9
        assert unsigned_distance(one, other) == pytest.approx(angle, rel=1e-3)
        assert unsigned_distance(one, opposite) == pytest.approx(angle, rel=1e-3)


def test_hemisphere_directions_leave_no_large_gap() -> None:
    starts = np.array([pose.t for pose in hemisphere_starts(np.eye(3), 10)])
    assert np.allclose(np.linalg.norm(starts, axis=1), 1)
    sphere = unit(np.random.default_rng(6).normal(size=(500, 3)))
    assert np.degrees(np.arccos(np.abs(sphere @ starts.T).max(1)).max()) < 45


@pytest.mark.parametrize(('ours', 'others'), [(3, 5), (5, 3), (3, 6), (6, 3)])
def test_the_lowest_nearby_minimum_is_taken_with_the_others_as_rivals(
        ours: int, others: int) -> None:
    # Distant points determine the rotation, the few near ones the direction; some of these are
    # wrong by some scales of the loss. Each group has a minimum, all in one basin.
    rng = np.random.default_rng(3)
    one = Pose(rotation_exp(np.array(TURN)), unit(np.array(SIDEWAYS)))
    other = Pose(one.R, rotation_exp(np.array([0, 0, 0.005])) @ one.t)
    parts = [two_views(rng, 300, one.t, near=300, far=1000),
             two_views(rng, ours, one.t, near=5, far=6),
             two_views(rng, others, other.t, near=5, far=6)]
    x, y = (np.concatenate([getattr(part, name) for part in parts]) for name in 'xy')
    y += rng.normal(0, 0.05, y.shape)
    problem = jet_problem(K, x, ReprojectionSurface(x, y).fit_around(y))
    loss = Loss('geman_mcclure', 0.2)
    right, wrong = (one, other) if ours > others else (other, one)
    for pose in (right, wrong):
        end = minimise(problem, pose.R, pose.t, loss)
        solution, beside = lowest_nearby_minimum(problem, x, end, loss)
        assert unsigned_distance(solution.pose, right) < 0.003
        assert all(0 < rival.preference < 2.33 for rival in beside)
    assert unsigned_distance(end.pose, right) > 0.003
    assert min(unsigned_distance(rival.pose, end.pose) for rival in beside) < 1e-9


def test_a_single_minimum_has_no_neighbours() -> None:
    rng = np.random.default_rng(6)
    views = two_views(rng, 300)
    y = views.y + rng.normal(0, 0.05, views.y.shape)
    problem = jet_problem(K, views.x, ReprojectionSurface(views.x, y).fit_around(y))
    loss = Loss('geman_mcclure', 0.2)
    end = minimise(problem, views.R, views.t, loss)
    assert lowest_nearby_minimum(problem, views.x, end, loss) == (end, ())
