"""Standstill of a camera while most of the image moves, and its start."""

from __future__ import annotations

from dataclasses import replace

from djet_ros.core.types import Array, RelativePose, Status
from djet_ros.odometry.standstill import Standstill
import numpy as np
from numpy.typing import NDArray
import pytest

MOST = 0.3
RIGHT = np.array([1.0, 0.0])
WORLD = np.random.default_rng(3).uniform((0, 0), (1240, 376), (400, 2))


def seen(x: Array, y: Array, follow: NDArray[np.bool_] | None = None) -> RelativePose:
    """Return a pair whose inliers follow its motion."""
    return RelativePose(Status.OK, t=np.array([1.0, 0, 0]), x=x, y=y,
                        inliers=np.zeros(len(x), bool) if follow is None else follow)


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
    assert standstill.detect(seen(WORLD, WORLD), MOST, at_rest=False)
    standstill.stay(seen(WORLD, WORLD), MOST)
    return standstill


def test_static_features_prove_a_standstill_however_few_are_visible() -> None:
    for stand, stationary in ((200, True), (15, True), (3, False)):
        assert after_a_stand().detect(behind_a_lorry(stand), MOST, at_rest=True) is stationary


def test_static_features_need_a_gyro_at_rest_and_a_standstill_before() -> None:
    assert not after_a_stand().detect(behind_a_lorry(40), MOST, at_rest=False)
    assert not Standstill().detect(behind_a_lorry(40), MOST, at_rest=True)
    elsewhere = after_a_stand()
    elsewhere.refer()
    assert not elsewhere.detect(behind_a_lorry(40), MOST, at_rest=True)


def test_a_standstill_after_motion_needs_more_still_matches_than_at_first() -> None:
    for share, first, later in ((0.3, True, True), (0.1, True, False), (0.03, False, False)):
        pair = seen(WORLD, WORLD + np.where(np.arange(400) < 400 * share, 0, 60)[:, None] * RIGHT)
        standstill = Standstill()
        assert standstill.detect(pair, MOST, at_rest=True) is first
        standstill.moved()
        assert standstill.detect(pair, MOST, at_rest=True) is later


def test_distant_features_are_no_standstill_of_a_camera_that_starts() -> None:
    """A few static features are in the sky, all others follow the motion of the camera."""
    y = WORLD + np.random.default_rng(6).uniform(2, 40, (400, 1)) * RIGHT
    y[:15] = WORLD[:15]
    away = seen(WORLD, y, np.ones(400, bool))
    assert not after_a_stand().detect(away, MOST, at_rest=True)
    # The same for few static features.
    new = np.random.default_rng(8).uniform((0, 0), (1240, 376), (500, 2))
    few = seen(np.vstack([WORLD[:60], new]), np.vstack([y[:60], new + RIGHT * 20]),
               np.ones(560, bool))
    assert not after_a_stand().detect(few, MOST, at_rest=True)


def test_a_creeping_camera_is_stationary_only_briefly() -> None:
    """Near features move slightly at first, far ones later."""
    shift = 1.0 / np.random.default_rng(7).uniform(2, 60, (400, 1)) * RIGHT
    stationary = [after_a_stand().detect(
        seen(WORLD, WORLD + pixels * shift, np.ones(400, bool)), MOST, at_rest=True)
        for pixels in (1, 20, 40, 80)]
    assert stationary == [True, False, False, False]


def test_a_lorry_that_stood_and_left_is_not_static() -> None:
    standstill, lorry = after_a_stand(), np.arange(400) < 150
    away = seen(WORLD, WORLD + np.where(lorry[:, None], (30.0, 0), (0.0, 0)), lorry)
    assert standstill.detect(away, MOST, at_rest=True)
    standstill.stay(away, MOST)
    # Another one stops there, and hides the rest.
    beside = np.random.default_rng(9).uniform((0, 0), (1240, 376), (4000, 2))
    x = np.vstack([WORLD, beside])
    y = np.vstack([WORLD[:150], scattered(WORLD[150:]), beside + RIGHT * 40])
    assert not standstill.detect(seen(x, y, np.arange(len(x)) >= 400), MOST, at_rest=True)


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
        assert not before.detect(starts, MOST, at_rest=True)
        assert before.detect(passes, MOST, at_rest=True)


def test_static_features_behind_a_lorry_that_move_slightly_are_those_of_a_camera_that_starts(
        ) -> None:
    """Only the most distant ones are still then, and the lorry's motion explains no other."""
    panel, hidden = 60.0 * RIGHT, WORLD[60:]
    for slightly, stands in ((15, True), (40, False)):
        pixels = np.where(np.arange(60) < slightly, 2 * MOST, 0.0)[:, None]
        x = np.vstack([WORLD, np.random.default_rng(4).uniform((0, 0), (1240, 376), (2000, 2))])
        y = np.vstack([WORLD[:60] + pixels * RIGHT, scattered(hidden), x[400:] + panel])
        pair = seen(x, y, np.arange(len(x)) >= len(WORLD))
        assert after_a_stand().detect(pair, MOST, at_rest=True) is stands


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
        assert standstill.detect(pair, MOST, at_rest=True) is stands


def test_dirt_on_the_lens_is_no_standstill() -> None:
    x = np.vstack([WORLD, np.random.default_rng(15).uniform((200, 100), (260, 160), (100, 2))])
    y = x + np.where(np.arange(500)[:, None] < 400, 60.0, 0.0) * RIGHT
    assert not Standstill().detect(seen(x, y, np.arange(500) < 400), MOST, at_rest=True)


def test_refined_matches_tell_whether_anything_moves_if_all_are_refined() -> None:
    """Matches are whole pixels, or of a detector that is off by a good part of one."""
    off = WORLD + np.random.default_rng(12).choice((-0.5, 0.5), WORLD.shape)
    assert not Standstill().detect(seen(WORLD, off), MOST, at_rest=False)
    aligned = replace(seen(WORLD, off), y_opt=WORLD)
    assert Standstill().detect(aligned, MOST, at_rest=False)
    moves = replace(seen(WORLD, WORLD), y_opt=off)
    assert not Standstill().detect(moves, MOST, at_rest=False)
    some = np.where(np.arange(len(WORLD))[:, None] < 3, np.nan, WORLD)
    assert not Standstill().detect(replace(aligned, y_opt=some), MOST, at_rest=False)


def test_before_anything_is_known_still_features_are_more_likely_those_of_a_standstill() -> None:
    for pair, likely in ((some_move((0.1, 0.0), (0.9, 60.0)), True),
                         (some_move((0.1, 0.0), (0.3, 2 * MOST), (0.6, 60.0)), False),
                         (some_move((0.1, 0.0), (0.9, 60.0), x=WORLD[:30]), False)):
        assert Standstill().is_likely(pair, MOST) is likely
        assert after_a_stand().is_likely(pair, MOST)
        moved = after_a_stand()
        moved.moved()
        assert not moved.is_likely(pair, MOST)


CENTRE = np.array([620.0, 188.0])
DRIFTS = {'to the side': np.tile(RIGHT, (400, 1)), 'ahead': (WORLD - CENTRE) / 300,
          'about the axis': (WORLD - CENTRE)[:, ::-1] * (1, -1) / 300}


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
