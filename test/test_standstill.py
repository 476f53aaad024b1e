"""Standstill of a camera while most of the image moves, and its start."""

from __future__ import annotations

from dataclasses import dataclass, replace

from djet_ros.core.geometry import rotation_exp
from djet_ros.core.types import Array, RelativePose, Status
from djet_ros.lab.scenes.camera import SensorNoise
from djet_ros.lab.scenes.cuboid import cuboid
from djet_ros.lab.scenes.panel import tiled, World
from djet_ros.lab.scenes.route import pose_at
from djet_ros.lab.scenes.scene import Scene
from djet_ros.lab.scenes.texture import fractal, make_texture
from djet_ros.odometry.frame import Frame
from djet_ros.odometry.standstill import Standstill
from djet_ros.odometry.visual_odometry import VisualOdometry
import numpy as np
from numpy.typing import NDArray
import pytest

MOST = 0.3
RIGHT = np.array([1.0, 0.0])
HORIZON = 188.0
K = np.array([[700, 0, 620], [0, 700, HORIZON], [0, 0, 1]])
WORLD = np.random.default_rng(3).uniform((0, 0), (1240, 376), (400, 2))


def seen(x: Array, y: Array, follow: NDArray[np.bool_] | None = None) -> RelativePose:
    """Return a pair whose inliers follow its motion."""
    return RelativePose(Status.OK, t=np.array([1.0, 0, 0]), x=x, y=y,
                        inliers=np.zeros(len(x), bool) if follow is None else follow)


def detected(standstill: Standstill, pair: RelativePose, at_rest: bool | None) -> bool:
    return standstill.detect(pair, K, MOST, at_rest)


def likely_stands(standstill: Standstill, pair: RelativePose, at_rest: bool | None) -> bool:
    return standstill.is_likely(pair, K, MOST, at_rest)


def depart(standstill: Standstill, pair: RelativePose | None = None) -> None:
    standstill.take(pair or seen(WORLD, WORLD + 60 * RIGHT), K, MOST)


def scattered(x: Array) -> Array:
    """Return false matches, anywhere in a search radius of 186 pixels."""
    rng = np.random.default_rng(5)
    angle, radius = rng.uniform(0, 2 * np.pi, len(x)), 186 * np.sqrt(rng.uniform(size=len(x)))
    return x + radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])


def behind_a_lorry(stand: int, lorry: int = 1000) -> RelativePose:
    """Return a pair with static features, false matches of hidden ones, and a lorry."""
    panel = np.random.default_rng(4).uniform((0, 0), (1240, 376), (lorry, 2))
    y = np.vstack([WORLD[:stand], scattered(WORLD[stand:]), panel + RIGHT * 60])
    return seen(np.vstack([WORLD, panel]), y, np.arange(len(y)) >= len(WORLD))


def after_a_stand() -> Standstill:
    standstill = Standstill()
    assert detected(standstill, seen(WORLD, WORLD), at_rest=False)
    standstill.stay(seen(WORLD, WORLD), MOST)
    return standstill


def test_static_features_prove_a_standstill_however_few_are_visible() -> None:
    for stand, stationary in ((200, True), (15, True), (3, False)):
        assert detected(after_a_stand(), behind_a_lorry(stand), at_rest=True) is stationary


def test_static_features_need_no_rotation_and_a_standstill_before() -> None:
    assert not detected(after_a_stand(), behind_a_lorry(40), at_rest=False)
    assert not detected(Standstill(), behind_a_lorry(40), at_rest=True)
    elsewhere = after_a_stand()
    elsewhere.refer()
    assert not detected(elsewhere, behind_a_lorry(40), at_rest=True)


def test_a_standstill_after_motion_needs_more_still_matches_than_at_first() -> None:
    for share, first, later in ((0.3, True, True), (0.1, True, False), (0.03, False, False)):
        pair = seen(WORLD, WORLD + np.where(np.arange(400) < 400 * share, 0, 60)[:, None] * RIGHT)
        standstill = Standstill()
        assert detected(standstill, pair, at_rest=True) is first
        depart(standstill)
        assert detected(standstill, pair, at_rest=True) is later


def test_distant_features_are_no_standstill_of_a_camera_that_starts() -> None:
    """A few static features are in the sky, all others follow the motion of the camera."""
    y = WORLD + np.random.default_rng(6).uniform(2, 40, (400, 1)) * RIGHT
    y[:15] = WORLD[:15]
    away = seen(WORLD, y, np.ones(400, bool))
    assert not detected(after_a_stand(), away, at_rest=True)
    # The same for few static features.
    new = np.random.default_rng(8).uniform((0, 0), (1240, 376), (500, 2))
    few = seen(np.vstack([WORLD[:60], new]), np.vstack([y[:60], new + RIGHT * 20]),
               np.ones(560, bool))
    assert not detected(after_a_stand(), few, at_rest=True)


def test_a_creeping_camera_is_stationary_only_briefly() -> None:
    """Near features move slightly at first, far ones later."""
    shift = 1.0 / np.random.default_rng(7).uniform(2, 60, (400, 1)) * RIGHT
    stationary = [detected(
        after_a_stand(), seen(WORLD, WORLD + pixels * shift, np.ones(400, bool)), at_rest=True)
        for pixels in (1, 20, 40, 80)]
    assert stationary == [True, False, False, False]


def test_a_lorry_that_stood_and_left_is_not_static() -> None:
    standstill, lorry = after_a_stand(), np.arange(400) < 150
    away = seen(WORLD, WORLD + np.where(lorry[:, None], (30.0, 0), (0.0, 0)), lorry)
    assert detected(standstill, away, at_rest=True)
    standstill.stay(away, MOST)
    # Another one stops there, and hides the rest.
    beside = np.random.default_rng(9).uniform((0, 0), (1240, 376), (4000, 2))
    x = np.vstack([WORLD, beside])
    y = np.vstack([WORLD[:150], scattered(WORLD[150:]), beside + RIGHT * 40])
    assert not detected(standstill, seen(x, y, np.arange(len(x)) >= 400), at_rest=True)


def some_move(*shares_and_pixels: tuple[float, float], x: Array = WORLD) -> RelativePose:
    """Return a pair in which shares of the features, all over the image, move by some pixels."""
    shares, pixels = zip(*shares_and_pixels)
    of_each = np.random.default_rng(11).choice(pixels, len(x), p=shares)
    return seen(x, x + of_each[:, None] * RIGHT)


def test_a_camera_that_moves_far_things_less_than_near_ones_does_not_stand() -> None:
    """A third are as far as the sky, and most others move by one to three times the threshold."""
    starts = some_move((0.33, 0.0), (0.5, 2 * MOST), (0.17, 60.0))
    passes = some_move((0.33, 0.0), (0.1, 2 * MOST), (0.57, 60.0))
    for before in (Standstill(), after_a_stand()):
        assert not detected(before, starts, at_rest=True)
        assert detected(before, passes, at_rest=True)


def test_static_features_behind_a_lorry_that_move_slightly_are_those_of_a_camera_that_starts(
        ) -> None:
    """Only the most distant ones are still then, and the lorry's motion explains no other."""
    panel, hidden = 60.0 * RIGHT, WORLD[60:]
    for slightly, stands in ((15, True), (40, False)):
        pixels = np.where(np.arange(60) < slightly, 2 * MOST, 0.0)[:, None]
        x = np.vstack([WORLD, np.random.default_rng(4).uniform((0, 0), (1240, 376), (2000, 2))])
        y = np.vstack([WORLD[:60] + pixels * RIGHT, scattered(hidden), x[400:] + panel])
        pair = seen(x, y, np.arange(len(x)) >= len(WORLD))
        assert detected(after_a_stand(), pair, at_rest=True) is stands


def test_features_that_a_body_hides_while_it_passes_stay_static_and_its_own_do_not() -> None:
    """Its features are in the same columns or rows as static ones."""
    standstill, rng = after_a_stand(), np.random.default_rng(14)
    beside = np.where(np.arange(100)[:, None] < 50, (0, 1), (1, 0)) * rng.uniform(5, 50, (100, 2))
    body, lorry = WORLD[:100] + beside, rng.uniform((0, 0), (1240, 376), (4000, 2))
    x = np.vstack([WORLD[:50], body])
    standstill.stay(seen(x, np.vstack([WORLD[:50], body + 60 * RIGHT])), MOST)
    x, follow = np.vstack([WORLD, body, lorry]), np.arange(4500) >= 500
    for still, stands in ((np.arange(4500) // 20 == 3, True),
                          ((np.arange(4500) >= 400) & ~follow, False)):
        y = np.vstack([scattered(x[:500]), lorry + 60 * RIGHT])
        pair = seen(x, np.where(still[:, None], x, y), follow)
        assert detected(standstill, pair, at_rest=True) is stands


def test_dirt_on_the_lens_is_no_standstill() -> None:
    x = np.vstack([WORLD, np.random.default_rng(15).uniform((200, 100), (260, 160), (100, 2))])
    y = x + np.where(np.arange(500)[:, None] < 400, 60.0, 0.0) * RIGHT
    assert not detected(Standstill(), seen(x, y, np.arange(500) < 400), at_rest=True)


def test_refined_matches_tell_whether_anything_moves_if_all_are_refined() -> None:
    """Matches are whole pixels, or of a detector that is off by a good part of one."""
    off = WORLD + np.random.default_rng(12).choice((-0.5, 0.5), WORLD.shape)
    assert not detected(Standstill(), seen(WORLD, off), at_rest=False)
    aligned = replace(seen(WORLD, off), y_opt=WORLD)
    assert detected(Standstill(), aligned, at_rest=False)
    moves = replace(seen(WORLD, WORLD), y_opt=off)
    assert not detected(Standstill(), moves, at_rest=False)
    some = np.where(np.arange(len(WORLD))[:, None] < 3, np.nan, WORLD)
    assert not detected(Standstill(), replace(aligned, y_opt=some), at_rest=False)


def test_before_anything_is_known_still_features_are_more_likely_those_of_a_standstill() -> None:
    for pair, likely in ((some_move((0.1, 0.0), (0.9, 60.0)), True),
                         (some_move((0.1, 0.0), (0.3, 2 * MOST), (0.6, 60.0)), False),
                         (some_move((0.1, 0.0), (0.9, 60.0), x=WORLD[:30]), False)):
        assert likely_stands(Standstill(), pair, at_rest=True) is likely


def test_a_camera_that_stood_likely_stands_until_most_of_what_stood_moves_together() -> None:
    lorry = np.random.default_rng(4).uniform((0, 0), (1240, 376), (1000, 2))
    hides_all = seen(np.vstack([WORLD, lorry]), np.vstack([scattered(WORLD), lorry + 60 * RIGHT]))
    for at_rest in (True, None):
        for pair, likely in ((hides_all, True), (some_move((0.4, 0.0), (0.6, 60.0)), False),
                             (some_move((0.6, 0.0), (0.4, 60.0)), True)):
            assert likely_stands(after_a_stand(), pair, at_rest) is likely
            moved = after_a_stand()
            depart(moved)
            assert not likely_stands(moved, pair, at_rest)


def test_without_a_gyro_what_stood_proves_a_standstill_until_it_moves_together() -> None:
    for still in (200, 15):
        assert detected(after_a_stand(), behind_a_lorry(still), at_rest=None)
    assert not detected(after_a_stand(), behind_a_lorry(3), at_rest=None)
    assert not detected(Standstill(), behind_a_lorry(40), at_rest=None)
    # A lorry in front of the camera drives off, or the camera does and a bonnet stays in place.
    for share, stays in ((0.7, True), (0.3, False)):
        below = WORLD[:, 1] > 376 * (1 - share)
        pair = seen(WORLD, WORLD + np.where(below, 0.0, 60.0)[:, None] * RIGHT, ~below)
        assert detected(after_a_stand(), pair, at_rest=None) is stays


def test_what_may_be_a_bonnet_is_no_standstill_of_a_camera_that_has_not_stood() -> None:
    """It is below the horizon; what stays in place above is not attached to the camera."""
    for still, stands in ((WORLD[:, 1] > 260, False), (WORLD[:, 1] < 110, True)):
        pair = seen(WORLD, WORLD + np.where(still, 0.0, 60.0)[:, None] * RIGHT, ~still)
        before = Standstill()
        assert detected(before, pair, at_rest=None) is stands
        assert likely_stands(before, pair, at_rest=None) is stands
        depart(before)
        assert detected(before, pair, at_rest=None) is stands


def test_a_bonnet_with_most_of_the_features_is_no_standstill() -> None:
    """It fills less of the image than they are of all."""
    bonnet = np.random.default_rng(4).uniform((0, 300), (1240, 376), (1000, 2))
    pair = seen(np.vstack([WORLD, bonnet]), np.vstack([WORLD + 60 * RIGHT, bonnet]))
    assert not detected(Standstill(), pair, at_rest=None)


def test_with_a_gyro_at_rest_what_is_still_below_the_horizon_is_no_bonnet() -> None:
    ground = WORLD[:, 1] > 230
    pair = seen(WORLD, WORLD + np.where(ground, 0.0, 60.0)[:, None] * RIGHT, ~ground)
    for at_rest, stands in ((True, True), (None, False)):
        assert detected(Standstill(), pair, at_rest) is stands
        assert likely_stands(Standstill(), pair, at_rest) is stands


def test_without_a_gyro_a_standstill_needs_more_still_matches() -> None:
    for share, by_gyro, by_images in ((0.3, True, True), (0.1, True, False)):
        pair = some_move((share, 0.0), (1 - share, 60.0))
        assert detected(Standstill(), pair, at_rest=True) is by_gyro
        assert detected(Standstill(), pair, at_rest=None) is by_images


def test_matches_as_noisy_as_the_threshold_are_no_slow_start() -> None:
    """Half of them move slightly, but with no common drift."""
    rng = np.random.default_rng(14)
    pair = seen(WORLD, WORLD + rng.normal(0, 0.8 * MOST, WORLD.shape))
    for at_rest in (True, None):
        assert likely_stands(Standstill(), pair, at_rest)


def test_what_stayed_in_place_while_the_camera_moved_is_attached_to_it() -> None:
    bonnet = WORLD[:, 1] > 250
    drives = seen(WORLD, WORLD + np.where(bonnet, 0.0, 60.0)[:, None] * RIGHT)
    # Nothing but it is matched: without this memory all that is matched is still.
    lost = seen(WORLD, np.where(bonnet[:, None], WORLD, scattered(WORLD)))
    standstill = Standstill()
    depart(standstill, drives)
    assert detected(standstill, seen(WORLD, WORLD), at_rest=None)
    standstill.stay(seen(WORLD, WORLD), MOST)
    assert not detected(standstill, lost, at_rest=None)
    assert detected(after_a_stand(), lost, at_rest=None)
    # Once something moves there, nothing is attached.
    depart(standstill)
    standstill.stay(seen(WORLD, WORLD), MOST)
    assert detected(standstill, lost, at_rest=None)


@pytest.mark.parametrize('other_camera', [False, True])
def test_after_a_gap_the_bonnet_of_the_same_camera_is_still_attached_to_it(
        other_camera: bool) -> None:
    bonnet = WORLD[:, 1] > 250
    standstill = Standstill()
    depart(standstill, seen(WORLD, WORLD + np.where(bonnet, 0.0, 60.0)[:, None] * RIGHT))
    standstill.interrupt(other_camera)
    assert standstill.may_stand
    standstill.stay(seen(WORLD, WORLD), MOST)
    lost = seen(WORLD, np.where(bonnet[:, None], WORLD, scattered(WORLD)))
    assert detected(standstill, lost, at_rest=None) is other_camera


def test_a_camera_that_starts_slowly_above_a_bonnet_does_not_stand() -> None:
    """The bonnet and the most distant features are still, and others move slightly."""
    rng, bonnet = np.random.default_rng(16), WORLD[:, 1] > 250
    away = 0.5 / rng.uniform(0.05, 2, 400)
    shift = np.where(bonnet, 0.0, np.where(away < MOST, 0.0, away))[:, None] * RIGHT
    pair = seen(WORLD, WORLD + shift, ~bonnet)
    assert not detected(after_a_stand(), pair, at_rest=None)
    assert not likely_stands(after_a_stand(), pair, at_rest=None)


def test_a_camera_that_vibrates_in_traffic_stands() -> None:
    lorry = np.random.default_rng(4).uniform((0, 0), (1240, 376), (1000, 2))
    for shift, stands in ((2 * MOST, True), (20.0, False)):
        x = np.vstack([WORLD, lorry])
        y = np.vstack([WORLD[:100] + shift * RIGHT, scattered(WORLD[100:]), lorry + 60 * RIGHT])
        pair = seen(x, y, np.arange(1400) >= 400)
        assert detected(after_a_stand(), pair, at_rest=None) is stands


def test_a_camera_is_not_stationary_for_long_behind_what_hides_the_rest() -> None:
    standstill, pair = after_a_stand(), behind_a_lorry(40)
    stands = []
    for _ in range(60):
        stands.append(detected(standstill, pair, at_rest=None))
        if stands[-1]:
            standstill.stay(pair, MOST)
    assert 20 < sum(stands) < 40
    assert detected(standstill, pair, at_rest=True)


def test_a_standstill_is_the_previous_motion_of_the_next_pair_unless_much_moves() -> None:
    standstill = Standstill()
    assert standstill.prior is None
    noise = rotation_exp(np.array([1e-4, 0, 0]))
    pair = replace(some_move((0.95, 0.05), (0.05, 60.0)), R=noise)
    standstill.stay(pair, MOST)
    prior = standstill.prior
    assert prior is not None and prior.status is Status.NO_PARALLAX
    assert prior.residuals == pytest.approx(np.linalg.norm(pair.y - pair.x, axis=1))
    assert not prior.t.any() and np.array_equal(prior.R, np.eye(3))
    assert np.array_equal(prior.y, prior.x) and np.array_equal(prior.y_opt, prior.x)
    assert prior.inliers.mean() == pytest.approx(0.95, abs=0.03)
    standstill.stay(some_move((0.7, 0.05), (0.3, 60.0)), MOST)
    assert standstill.prior is None
    standstill.stay(seen(WORLD, WORLD), MOST)
    standstill.refer()
    assert standstill.prior is None


def moves_around(turn_sigma: float = 1e-5, wall: float = 0.7) -> RelativePose:
    """
    Return a pair of a camera that passes things and turns, so that a wall behind stays in place.

    turn_sigma: standard deviation of its rotation in rad; wall: share of the features.
    """
    depths = np.where(np.random.default_rng(17).uniform(size=400) < wall, 20.0, 2.0)
    R, t = rotation_exp(np.array([0, -1e-3, 0])), np.array([0.02, 0, 0])
    rays = np.column_stack([WORLD, np.ones(400)]) @ np.linalg.inv(K).T
    y = (depths[:, None] * rays) @ R.T + t
    y = (y @ K.T)[:, :2] / y[:, 2:]
    return replace(seen(WORLD, y, np.ones(400, bool)), R=R, t=np.array([1.0, 0, 0]),
                   covariance_5=np.diag(np.repeat([turn_sigma, 1e-2], [3, 2])**2))


@pytest.mark.parametrize('wall', [0.7, 0.9])
def test_a_camera_moves_around_something_though_a_wall_stays_in_place(wall: float) -> None:
    """What is still is part of the motion of a camera that has turned, and so it is near."""
    pair = moves_around(wall=wall)
    assert (np.linalg.norm(pair.y - pair.x, axis=1) < MOST).mean() > 0.5
    for before in (Standstill(), after_a_stand()):
        for at_rest in (False, None):
            assert not detected(before, pair, at_rest)
        assert detected(before, pair, at_rest=True)


def test_a_camera_stands_in_front_of_a_body_that_turns_or_if_its_own_turn_is_none() -> None:
    """The still features are no part of the body's motion; a turn may be noise, or too small."""
    pair = moves_around()
    still = np.linalg.norm(pair.y - pair.x, axis=1) < MOST
    by_body = replace(pair, inliers=~still)
    unsure = moves_around(turn_sigma=1e-3)
    slight = replace(pair, R=rotation_exp(np.array([0, -0.9 * MOST / K[0, 0], 0])))
    rotates = replace(pair, status=Status.NO_PARALLAX, t=np.zeros(3))
    for stands in (by_body, unsure, slight, rotates):
        assert detected(Standstill(), stands, at_rest=None)


def test_a_wall_that_stayed_in_place_while_the_camera_moved_around_is_not_attached_to_it() -> None:
    hides_above = seen(WORLD, np.where(WORLD[:, 1:] > HORIZON, WORLD, scattered(WORLD)))
    for pair, attached in ((moves_around(wall=1.0), False),
                           (some_move((1.0, 0.0)), True)):
        standstill = Standstill()
        depart(standstill, pair)
        standstill.stay(seen(WORLD, WORLD), MOST)
        assert detected(standstill, hides_above, at_rest=None) is not attached


@dataclass(frozen=True)
class Around:
    """A path to the side by so many metres per frame, always towards a point ten metres ahead."""

    step: float
    limit: int = 100

    def pose(self, index: int) -> Array:
        return pose_at((self.step * index, 0, 0), -np.arctan(self.step * index / 10), 0, 0)


@pytest.mark.slow
@pytest.mark.parametrize('step', [0.01, 0.015])
def test_a_track_around_a_box_in_front_of_a_wall_goes_on_evenly(step: float) -> None:
    """The wall, two thirds of the image, moves by less than the threshold from frame to frame."""
    rng = np.random.default_rng(18)
    wall, face = (make_texture(np.clip(120 + 45 * fractal(rng, (1024, 1024), 1.0), 5, 250),
                               (metres, metres)) for metres in (6.0, 1.0))
    box = cuboid((-0.5, -0.5, 1.5), (0.3, 0.5, 2.2), face)
    scene = Scene('around', World((tiled((-30, -12, 10), (60, 0, 0), (0, 24, 0), wall), *box)),
                  Around(step), np.array([[500, 0, 319.5], [0, 500, 239.5], [0, 0, 1.0]]),
                  (640, 480), 0, effects=(SensorNoise(0.8, 0.06),))
    odometry, truth = VisualOdometry(), scene.trajectory(10)
    results = [odometry.process(Frame(scene.render(pose, i), scene.K, i * 33_000_000))
               for i, pose in enumerate(truth)]
    assert not any(result.stationary for result in results[3:])
    steps = np.diff([result.pose[0, 3] for result in results[3:]])
    assert steps == pytest.approx(np.full(6, steps.mean()), rel=0.05)


def test_a_camera_that_vibrates_stood_and_one_that_turns_did_not() -> None:
    for degrees, stood in ((0.02, True), (0.2, False)):
        standstill = after_a_stand()
        turn = replace(seen(WORLD, WORLD), status=Status.NO_PARALLAX,
                       R=rotation_exp(np.radians([0, degrees, 0])))
        depart(standstill, turn)
        assert standstill.may_stand is stood


CENTRE = np.array([620.0, 188.0])
DRIFTS = {'to the side': np.tile(RIGHT, (400, 1)), 'ahead': (WORLD - CENTRE) / 300,
          'about the axis': (WORLD - CENTRE)[:, ::-1] * (1, -1) / 300}


@pytest.mark.parametrize('at_rest', [True, None])
@pytest.mark.parametrize('drift', DRIFTS.values(), ids=DRIFTS.keys())
def test_a_camera_that_starts_at_once_does_not_stand_whichever_way_it_goes(
        drift: Array, at_rest: bool | None) -> None:
    """Features beside one another move alike, but those at the border of the image faster."""
    away = seen(WORLD, WORLD + 60 * drift)
    assert not detected(after_a_stand(), away, at_rest)
    assert not likely_stands(after_a_stand(), away, at_rest)


def test_a_camera_that_starts_slowly_is_not_one_that_vibrates() -> None:
    """All features move by the same little, and not most of them by more."""
    away = seen(WORLD, WORLD + 2 * MOST * RIGHT)
    assert not detected(after_a_stand(), away, at_rest=None)
    assert not likely_stands(after_a_stand(), away, at_rest=None)


def test_still_mountains_are_no_standstill_of_a_camera_that_starts() -> None:
    """Without a gyro it is enough that what stood moves together in more of the image."""
    far = WORLD[:, 1] < 0.4 * HORIZON
    away = seen(WORLD, WORLD + np.where(far, 0.0, 60.0)[:, None] * RIGHT, ~far)
    assert not detected(after_a_stand(), away, at_rest=None)


def test_what_moves_by_many_thresholds_does_not_move_slightly() -> None:
    """A few pixels are a start of none but the nearest things, such as people."""
    for pixels, likely in ((2 * MOST, False), (10 * MOST, True)):
        pair = some_move((0.1, 0.0), (0.3, pixels), (0.6, 60.0))
        assert likely_stands(Standstill(), pair, at_rest=True) is likely


def test_one_feature_is_no_evidence_of_a_start() -> None:
    one = seen(WORLD[:1], WORLD[:1] + 60 * RIGHT)
    assert likely_stands(after_a_stand(), one, at_rest=True)
    assert not detected(after_a_stand(), one, at_rest=True)


def test_static_features_prove_a_standstill_of_a_pair_without_any_motion() -> None:
    """Of too few matches none is an inlier of anything."""
    pair = replace(behind_a_lorry(40), status=Status.DEGENERATE, inliers=np.empty(0, bool))
    assert detected(after_a_stand(), pair, at_rest=True)


@pytest.mark.parametrize('drift', DRIFTS.values(), ids=DRIFTS.keys())
def test_a_camera_creeps_from_a_tenth_of_the_threshold_on_however_noisy_its_matches(
        drift: Array) -> None:
    """Root mean squares: of the drift a twentieth or a seventh of it, of the noise a third."""
    unit = drift / np.sqrt((drift**2).sum(1).mean())
    creeping = {share: [Standstill().creeps(seen(WORLD, WORLD + share * MOST * unit
                        + np.random.default_rng(seed).normal(0, 0.07, WORLD.shape)), MOST)
                        for seed in range(100)] for share in (0.05, 0.15)}
    assert not any(creeping[0.05])
    assert np.mean(creeping[0.15]) > 0.9


def test_noise_does_not_creep_nor_do_things_that_pass_nor_too_few_features() -> None:
    rng = np.random.default_rng(13)
    for count, sigma in ((400, 0.02), (400, 0.1), (12, 0.1), (4, 0.1)):
        x = WORLD[:count]
        assert np.mean([Standstill().creeps(seen(x, x + rng.normal(0, sigma, x.shape)), MOST)
                        for _ in range(300)]) < 0.01
    passing = WORLD + np.where(np.arange(400)[:, None] < 300, 0.5, 0.0) * RIGHT
    assert not Standstill().creeps(seen(WORLD, passing), MOST)
    for count, creeps in ((3, False), (4, True)):
        x = WORLD[:count]
        assert Standstill().creeps(seen(x, x + 0.5 * MOST * RIGHT), MOST) is creeps


@pytest.mark.parametrize('step', [0.03, 0.06, 0.2])
def test_a_camera_that_is_slow_from_the_first_frame_on_moves(step: float) -> None:
    """Points of a street, 6 to 600 metres ahead, move by any amount, of which none stands out."""
    rng = np.random.default_rng(7)
    x = rng.uniform((0, 0), (1240, 376), (1500, 2))
    y = x + (x - K[:2, 2]) * step / np.exp(rng.uniform(np.log(6), np.log(600), (1500, 1)))
    still = np.linalg.norm(y - x, axis=1) < MOST
    assert still.sum() > 100
    assert not likely_stands(Standstill(), seen(x, y, np.ones(len(x), bool)), None)


def test_a_camera_seems_to_stand_from_the_first_frame_on_if_few_points_move_slightly() -> None:
    assert likely_stands(Standstill(), behind_a_lorry(stand=120), None)
