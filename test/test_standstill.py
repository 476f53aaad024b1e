"""Standstill of a camera while most of the image moves, and its start."""

from __future__ import annotations

from djet_ros.core.types import Array, RelativePose, Status
from djet_ros.odometry.standstill import Standstill
import numpy as np
from numpy.typing import NDArray

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
