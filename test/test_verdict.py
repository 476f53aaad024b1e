"""What a pair claims: its covariances, residuals and rivals, also after other evidence decided."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from djet_ros.core.covariance import lifted_covariance, pose_difference, UNDETERMINED
from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.geometry import (
    direction_angle,
    epipolar_lines,
    fundamental,
    line_distances,
    rotation_log,
    unit,
)
from djet_ros.core.pair import Pair
from djet_ros.core.surfaces import ReprojectionSurface
from djet_ros.core.tracking import track_jointly
from djet_ros.core.types import Pose, RelativePose, Rival, Status
from djet_ros.core.verdict import as_decided, as_pure_rotation, verdict, with_left_out
from djet_ros.odometry.uncertainty import UNKNOWN_MOTION
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from two_view import (
    BACKWARD,
    FORWARD,
    K,
    project,
    SIDEWAYS,
    SIZE,
    textured,
    two_views,
    TwoViews,
    uniform_view,
)

NOISE = 0.2

CHI2_999_OF_ROTATION = chi2.ppf(0.999, 3)


def pair_of(x: np.ndarray, y: np.ndarray, start: Pose | None = None) -> Pair:
    return Pair(uniform_view(), uniform_view(), x, y, start=start)


def estimate(pair: Pair, **settings: float) -> RelativePose:
    return TwoViewEstimator(EstimatorConfig(method='rpe', **settings)).estimate_pair(pair)


def noisy_views(seed: int, t: Sequence[float] = SIDEWAYS, **scene: float
                ) -> tuple[TwoViews, np.ndarray]:
    """Return views, and their pixels in the second one with noise."""
    rng = np.random.default_rng(seed)
    seen = two_views(rng, t=t, **scene)
    return seen, seen.y + rng.normal(0, NOISE, seen.y.shape)


def open_sign() -> tuple[np.ndarray, np.ndarray]:
    """Return matches half of which are behind the cameras, and some that fit no motion."""
    rng = np.random.default_rng(4)
    parts = [two_views(rng, t=sign * np.array(FORWARD), count=100) for sign in (1, -1)]
    anywhere = rng.uniform((0, 0), SIZE, (2, 150, 2))
    return (np.concatenate([*(part.x for part in parts), anywhere[0]]),
            np.concatenate([*(part.y for part in parts), anywhere[1]]))


@pytest.mark.parametrize('t', [SIDEWAYS, FORWARD, BACKWARD])
def test_a_pose_and_its_covariances_do_not_depend_on_the_sign_that_the_search_started_with(
        t: Sequence[float]) -> None:
    seen, y = noisy_views(1, t)
    one, other = (estimate(pair_of(seen.x, y, Pose(seen.R, sign * seen.t))) for sign in (1, -1))
    assert direction_angle(one.t, seen.t) < 0.02
    np.testing.assert_allclose(other.t, one.t, atol=1e-6)
    size = np.sqrt(np.diag(one.covariance_6))
    assert np.abs(one.covariance_6[:3, 3:] / np.outer(size[:3], size[3:])).max() > 0.3
    np.testing.assert_array_less(np.abs(other.covariance_6 - one.covariance_6),
                                 0.02 * np.outer(size, size))


def test_covariances_of_six_are_those_of_five_whatever_the_status() -> None:
    seen, y = noisy_views(2)
    known, unsure = estimate(pair_of(seen.x, y)), estimate(pair_of(*open_sign()))
    assert (known.status, unsure.status) == (Status.OK, Status.AMBIGUOUS)
    # As a pure rotation it has no t, but the tangents of its covariance remain.
    for pair, t in ((known, known.t), (unsure, unsure.t), (as_decided(unsure), unsure.t),
                    (as_pure_rotation(known, K), known.t)):
        np.testing.assert_allclose(pair.covariance_6, lifted_covariance(pair.covariance_5, t))


def test_a_pure_rotation_may_be_as_wrong_as_the_motion_it_replaces() -> None:
    seen, y = noisy_views(3)
    motion = estimate(pair_of(seen.x, y))
    turn = as_pure_rotation(motion, K)
    off = pose_difference(turn.R, motion.t, Pose(motion.R, motion.t))
    # Or right, if the scene is a plane.
    assert off @ turn.covariance_5 @ off > (off @ off)**2 / 2


def test_the_opposite_motion_is_a_rival_while_its_sign_is_open() -> None:
    unsure = estimate(pair_of(*open_sign()))
    assert any(np.allclose(rival.pose.R, unsure.R) and np.allclose(rival.pose.t, -unsure.t)
               for rival in unsure.rivals)
    seen, y = noisy_views(4)
    assert not estimate(pair_of(seen.x, y)).rivals


def test_a_pair_that_other_evidence_decides_is_as_sure_as_without_its_rivals() -> None:
    unsure = estimate(pair_of(*open_sign()))
    decided = as_decided(unsure)
    assert decided.status is Status.OK and not decided.rivals
    assert np.trace(unsure.covariance_5[3:, 3:]) > 1 > 100 * np.trace(decided.covariance_5)


def test_a_wrong_camera_matrix_is_in_the_covariance_without_rivals_too() -> None:
    x, y = open_sign()
    exact, wrong = (estimate(pair_of(x, y), calibration_sigma=sigma) for sigma in (0.0, 2.0))
    for name in ('covariance_5', 'own_covariance_5'):
        more = np.linalg.eigvalsh(getattr(wrong, name) - getattr(exact, name))
        assert more[-1] > 1e-8 and more[0] > -1e-6 * more[-1]
    np.testing.assert_allclose(wrong.own_covariance_5 - exact.own_covariance_5,
                               wrong.covariance_5 - exact.covariance_5, atol=1e-9)


@pytest.mark.parametrize('sign', [1, -1])
def test_a_wrong_camera_matrix_moves_rotation_and_direction_together_as_claimed(sign: int) -> None:
    """Whichever sign of t the search started with."""
    seen, _ = noisy_views(11, count=400)
    start, errors = Pose(seen.R, sign * seen.t), []
    # The three parameters, as all of them add up in the covariance.
    for f, cx, cy in np.eye(3):
        view = uniform_view(np.add(K, [[f, 0, cx], [0, f, cy], [0, 0, 0]]))
        pair = estimate(Pair(view, view, seen.x, seen.y, start=start))
        errors.append(pose_difference(pair.R, pair.t, Pose(seen.R, seen.t)))
    expected = np.transpose(errors) @ errors
    exact, unsure = (estimate(pair_of(seen.x, seen.y, start), calibration_sigma=sigma)
                     for sigma in (0.0, 1.0))
    size = np.sqrt(np.diag(expected))
    np.testing.assert_array_less(
        np.abs(unsure.covariance_5 - exact.covariance_5 - expected), 0.1 * np.outer(size, size))


def test_without_parallax_residuals_are_distances_from_lines_and_no_opposite_is_a_rival() -> None:
    seen, y = noisy_views(5, near=1e5, far=1e6)
    turn = estimate(pair_of(seen.x, y))
    assert turn.status is Status.NO_PARALLAX and not turn.rivals
    # The true place is on the line, so noise across it is all that is left.
    assert (np.abs(turn.residuals) <= np.linalg.norm(y - seen.y, axis=1) + 0.1).all()
    assert np.std(turn.residuals) == pytest.approx(NOISE, rel=0.3)


def test_matches_that_were_left_out_are_outliers_in_their_places() -> None:
    seen, y = noisy_views(6, count=300)
    kept = np.random.default_rng(0).random(300) < 0.6
    y[~kept] += (0, 5)
    pair = pair_of(seen.x, y)
    part = estimate(pair.without(~kept))
    whole = with_left_out(part, pair, kept)
    assert (whole.x is pair.x) and (whole.y is pair.y)
    for name in ('inliers', 'voting', 'y_opt', 'placed', 'placed_covariances', 'residuals',
                 'hamming', 'losses'):
        np.testing.assert_array_equal(getattr(whole, name)[kept], getattr(part, name))
    assert part.inliers.sum() > 100 and not (whole.inliers | whole.voting)[~kept].any()
    np.testing.assert_array_equal(whole.y_opt[~kept], y[~kept])
    np.testing.assert_array_equal(whole.of_body, kept)
    assert part.of_body.all() and len(part.of_body) == kept.sum()
    lines = epipolar_lines(fundamental(K, seen.R, seen.t), seen.x)
    np.testing.assert_allclose(whole.residuals, line_distances(lines, y), atol=0.5)
    assert np.median(np.abs(whole.residuals[~kept])) > 3


def test_matches_between_places_that_look_unrelated_are_no_motion() -> None:
    """However well they agree with one."""
    rng, estimator, (seen, y) = np.random.default_rng(0), TwoViewEstimator(), noisy_views(9)
    views = [estimator.view(textured(rng, SIZE), K) for _ in range(2)]
    assert estimate(pair_of(seen.x, y)).status is Status.OK
    pair = estimate(Pair(*views, seen.x, y))
    assert pair.inliers.sum() > 150 and np.nanmedian(pair.hamming[pair.inliers]) > 112
    assert pair.status is Status.DEGENERATE and not pair.t.any()


@pytest.mark.parametrize(('side', 'status'), [(30, Status.DEGENERATE), (600, Status.OK)])
def test_matches_of_one_cell_of_the_image_determine_no_motion(side: float, status: Status) -> None:
    """They may be of one object, and share their errors."""
    rng = np.random.default_rng(10)
    x = rng.uniform((609, 161), (609 + side, 161 + side / 3), (300, 2))
    points = np.column_stack([x, np.ones(300)]) @ np.linalg.inv(K).T * rng.uniform(4, 40, (300, 1))
    y, _ = project(K, points + SIDEWAYS)
    pair = estimate(pair_of(x, y + rng.normal(0, 0.05, y.shape)))
    assert pair.status is status
    assert pair.t.any() == np.isfinite(pair.covariance_6).all() == (status is Status.OK)


def test_a_rotation_of_noise_is_not_biased() -> None:
    for seed in range(20):
        seen, y = noisy_views(seed, near=1e5, far=1e6)
        turn = estimate(pair_of(seen.x, y))
        assert turn.status is Status.NO_PARALLAX
        off = pose_difference(turn.R, seen.t, Pose(seen.R, seen.t))[:3]
        assert np.linalg.norm(off) < 5e-4
        assert off @ np.linalg.solve(turn.covariance_5[:3, :3], off) < CHI2_999_OF_ROTATION
        assert np.trace(turn.covariance_5[:3, :3]) < 0.001**2


def test_no_rotation_is_certain_of_what_a_translation_along_a_wall_explains_as_well() -> None:
    """Seen through a slit they look alike, and the rotation alone absorbs the translation."""
    rng, within, certain = np.random.default_rng(3), 0, 0
    for _ in range(40):
        x = rng.uniform((K[0, 2] - 80, 0), (K[0, 2] + 80, SIZE[1]), (400, 2))
        wall = np.column_stack([x, np.ones(400)]) @ np.linalg.inv(K).T
        R = Rotation.from_rotvec(rng.normal(0, 0.01, 3)).as_matrix()
        t = 10**rng.uniform(-3.3, -1.7) * unit(rng.normal(0, (1, 1, 0.1)))
        y, _ = project(K, wall @ R.T + t)
        turn = estimate(pair_of(x, y + rng.normal(0, 0.05, y.shape)))
        assert turn.status is Status.NO_PARALLAX
        off = rotation_log(turn.R @ R.T)
        squares = [off @ np.linalg.solve(covariance[:3, :3], off)
                   for covariance in (turn.covariance_5, turn.own_covariance_5)]
        within += squares[0] < CHI2_999_OF_ROTATION
        certain += squares[1] > CHI2_999_OF_ROTATION
    # As the pose would be, if depths were free.
    assert certain > 20
    assert within >= 39


@pytest.mark.parametrize('slope', [0.0, 0.2, 0.5])
def test_nor_if_the_wall_is_seen_askew(slope: float) -> None:
    rng, squares = np.random.default_rng(4), []
    for _ in range(200):
        x = rng.uniform((0, 0), SIZE, (400, 2))
        wall = np.column_stack([x, np.ones(400)]) @ np.linalg.inv(K).T
        wall /= 1 + slope * wall[:, :1]
        R = Rotation.from_rotvec(rng.normal(0, 0.01, 3)).as_matrix()
        y, _ = project(K, wall @ R.T + 0.001 * unit(rng.normal(0, (1, 1, 0.1))))
        turn = estimate(pair_of(x, y + rng.normal(0, 0.05, y.shape)))
        assert turn.status is Status.NO_PARALLAX
        off = rotation_log(turn.R @ R.T)
        squares.append(off @ np.linalg.solve(turn.covariance_5[:3, :3], off))
    # Of correct covariances three or more of 200 are beyond in one of a thousand such tests.
    assert sum(np.array(squares) > CHI2_999_OF_ROTATION) < 3


def test_the_noise_of_matches_is_no_parallax_that_tells_the_direction_along_a_wall() -> None:
    """It turns epipolar lines as parallax does; of nine pixels of that, little depends on t."""
    rng, squares = np.random.default_rng(0), []
    for _ in range(80):
        x = rng.uniform((0, 0), SIZE, (300, 2))
        wall = np.column_stack([x, np.ones(300)]) @ np.linalg.inv(K).T
        wall *= 8 / np.maximum(wall @ (*rng.normal(0, 0.3, 2), 1), 0.2)[:, None]
        R = Rotation.from_rotvec(rng.normal(0, 0.02, 3)).as_matrix()
        t = unit(rng.normal(size=3) * (1, 0.1, 0.05))
        y, _ = project(K, wall @ R.T + 0.1 * t)
        pair = estimate(pair_of(x, y + rng.normal(0, 0.3, y.shape)))
        if pair.status is Status.OK:
            off = pose_difference(pair.R, pair.t, Pose(R, t))[3:]
            squares.append(off @ np.linalg.solve(pair.covariance_5[3:, 3:], off))
    assert len(squares) > 60
    assert 0.5 < np.median(squares) / chi2.median(2) < 1.3
    assert np.mean(np.array(squares) > chi2.ppf(0.999, 2)) < 0.06


@pytest.mark.parametrize('nearly', [1.0, 0.3])
def test_what_a_pair_claims_does_not_depend_on_the_order_of_its_rivals(nearly: float) -> None:
    """An improbable rival widens the covariance, but does not hide an undecided one beside it."""
    seen, y = noisy_views(7)
    pair = pair_of(seen.x, y, Pose(seen.R, seen.t))
    estimator = TwoViewEstimator(EstimatorConfig(method='rpe'))
    track = track_jointly(pair, ReprojectionSurface(pair.x, y), [Pose(seen.R, seen.t)],
                          estimator.config)
    assert track is not None
    aside = [Pose(seen.R, unit(np.array(seen.t) + angle * np.array([0, 0, 1])))
             for angle in (1.0, 1.1)]
    rivals = Rival(aside[0], 3.0), Rival(aside[1], nearly)
    claims = [verdict(pair, replace(track, rivals=order), estimator.config)
              for order in (rivals, rivals[::-1])]
    assert [claim.status for claim in claims] == [Status.AMBIGUOUS] * 2
    np.testing.assert_array_equal(claims[0].covariance_5, claims[1].covariance_5)


def test_a_rival_of_opposite_sign_is_as_uncertain_as_the_one_of_the_nearer_sign() -> None:
    seen, y = noisy_views(8)
    pair = pair_of(seen.x, y, Pose(seen.R, seen.t))
    config = EstimatorConfig(method='rpe')
    track = track_jointly(pair, ReprojectionSurface(pair.x, y), [Pose(seen.R, seen.t)], config)
    assert track is not None
    aside = unit(np.array(seen.t) + 0.02 * np.array([0, 0.5, 1]))
    one, other = (verdict(pair, replace(track, rivals=(Rival(Pose(seen.R, sign * aside), 1.0),)),
                          config) for sign in (1, -1))
    np.testing.assert_allclose(other.covariance_5, one.covariance_5, rtol=1e-6, atol=1e-12)


def test_residuals_of_a_pure_rotation_are_those_of_its_rotation() -> None:
    seen, y = noisy_views(3)
    motion = estimate(pair_of(seen.x, y))
    turn = as_pure_rotation(motion, K)
    lines = epipolar_lines(fundamental(K, turn.R, motion.t), seen.x)
    np.testing.assert_allclose(turn.residuals, line_distances(lines, y))


def test_covariances_that_results_share_cannot_be_changed_through_one_of_them() -> None:
    assert not any(shared.flags.writeable for shared in (*UNDETERMINED, UNKNOWN_MOTION))
