"""The window on simulated data: a known path and world, and observations with known noise."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

from djet_ros.core.bundle import projected
from djet_ros.core.correction import AS_CALIBRATED, Correction
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.geometry import (
    epipolar_lines,
    fundamental,
    line_distances,
    rays,
    rotation_exp,
    rotation_log,
    sphere_tangents,
    unit,
)
from djet_ros.core.known_depths import KnownDepths
from djet_ros.core.radial import distort, undistort
from djet_ros.core.types import RelativePose, Status
from djet_ros.core.window import Window, WINDOW_TUNING
import numpy as np
from numpy.typing import NDArray
import pytest
from two_view import fitted

Numbers = NDArray[np.float64]
Image = NDArray[np.uint8]

K = np.array([[700.0, 0, 600], [0, 700, 180], [0, 0, 1]])
WIDTH, HEIGHT = 1200, 360

# Pixels from the border without observations, and the standard deviation of a pair, in rad.
_BORDER, _SURE = 15, 1e-4


class Street:
    """
    Points (N, 3) next to and on a street, seen from a camera that moves one metre per frame.

    noise: pixels, of each observation; turned: rad, error of each pair's rotation; curve: rad,
    rotation of the street per metre from the thirtieth to the ninetieth; wrong: deviation of the
    camera from its calibration K. Images are corrected by the camera matrix and k1 of `shown`.
    """

    def __init__(self, seed: int, frames: int, noise: float, turned: float = 0.0,
                 curve: float = 0.0, wrong: Correction = AS_CALIBRATED) -> None:
        self.rng, self.noise, self.turned = np.random.default_rng(seed), noise, turned
        self.wrong, self.shown = wrong, (K, 0.0)
        count = 14 * (frames + 70)
        along = self.rng.uniform(0, frames + 70, count)
        road = self.rng.uniform(size=count) < 0.25
        side = self.rng.uniform(5, 12, count) * self.rng.choice([-1, 1], count)
        beside = np.where(road, self.rng.uniform(-5, 5, count), side)
        # Each metre of the street looks its own way, and leads on by that.
        self.heading = curve * np.clip(np.arange(frames + 71) - 30, 0, 60)
        ahead = np.stack([np.sin(self.heading), 0 * self.heading, np.cos(self.heading)], axis=1)
        self.centre = np.cumsum(ahead, axis=0) - ahead[0]
        metre, right = along.astype(int), ahead[:, ::-1] * [1, 0, -1]
        self.points = (self.centre[metre] + (along - metre)[:, None] * ahead[metre]
                       + beside[:, None] * right[metre])
        self.points[:, 1] = np.where(road, 1.65, self.rng.uniform(-6, 1.6, count))

    def turn(self, frame: int) -> Numbers:
        """Rotation (3, 3) of a frame, from the world to its camera."""
        return rotation_exp(np.array([0.0, -self.heading[frame], 0]))

    def seen(self, frame: int) -> tuple[Numbers, NDArray[np.bool_]]:
        """Noisy places (N, 2) of all points in a frame, and which of them are in sight."""
        ahead = (self.points - self.centre[frame]) @ self.turn(frame).T
        near = (ahead[:, 2] > 2) & (ahead[:, 2] < 70)
        true = self.wrong.camera_matrix(K)
        places = distort(true, projected(true, np.where(near[:, None], ahead, [0.0, 0.0, 1.0])),
                         self.wrong.k1)
        places += self.rng.normal(size=places.shape) * self.noise
        places = undistort(self.shown[0], places, self.shown[1])
        return places, near & inside(places)

    def pair(self, frame: int, count: int = 700) -> tuple[NDArray[np.int64], RelativePose]:
        """Points (M,) that a frame and the next one match, and the true pair by them."""
        (x, here), (y, there) = self.seen(frame), self.seen(frame + 1)
        which = self.rng.permutation(np.flatnonzero(here & there))[:count]
        R = self.turn(frame + 1) @ self.turn(frame).T
        if self.turned:
            R = rotation_exp(self.turned * self.rng.normal(size=3)) @ R
        t = self.turn(frame + 1) @ (self.centre[frame] - self.centre[frame + 1])
        x, y = x[which], y[which]
        if any(self.wrong):
            R, t = fitted(self.shown[0], R, t, x, y)
        return which, RelativePose(
            Status.OK, R, t, np.eye(5) * max(_SURE, self.turned)**2, x=x, y=y, y_opt=y,
            residuals=line_distances(epipolar_lines(fundamental(self.shown[0], R, t), x), y),
            inliers=np.ones(len(which), bool))


class NumbersWindow(Window):
    """A window that is given the positions of points, instead of measuring them in images."""

    def __init__(self, street: Street, unit: float = 1.0) -> None:
        super().__init__(EstimatorConfig())
        self._distances: Any = SimpleNamespace(
            describable=lambda points, shape, radius=0: inside(points),
            strengths=lambda seen, points: np.ones(len(points)))
        self._street, self._which = street, dict[tuple[float, ...], int]()
        self._unit = unit
        self._frame, self.scales, self.taken, self.thrown = 0, list[float](), 0, 0
        self.pairs = list[Numbers]()
        self.start(blank())

    def go(self) -> float:
        """Advance by a frame, and return the length that the window estimates of it."""
        which, pair = self._street.pair(self._frame)
        self._which.update(zip(map(tuple, pair.x.tolist()), which.tolist()))
        self._frame += 1
        self.pairs.append(pair.R)
        self.added = self.add(blank(self._joint.K), pair, self._unit)
        return self.added.length

    def correct(self) -> float:
        """Continue with images of the camera as it is expected to be."""
        before, street = self._joint.landmarks.anchor_pixels, self._street
        shown = self.calibration.deviation.camera_matrix(K), self.calibration.deviation.k1
        ratio = self.correct_images(blank(shown[0]))
        moved = undistort(shown[0], distort(street.shown[0], before, street.shown[1]), shown[1])
        for old, new in zip(before.tolist(), moved.tolist()):
            self._which[tuple(new)] = self._which[tuple(old)]
        street.shown = shown
        return ratio

    def _corrected(self, view: Any, before: tuple[Numbers, float]) -> Any:
        return view

    def _observe_landmarks(self) -> None:
        found, newest = self._joint.landmarks, len(self._views) - 1
        places, seen = self._street.seen(self._frame)
        mine = np.array([self._which[tuple(point)] for point in found.anchor_pixels.tolist()], int)
        pixels = self._joint.pixels_in(newest, found)
        wanted = seen[mine] & inside(pixels)
        wanted &= found.observed[:, -3:-1].any(1) | (found.anchors == newest - 1)
        found.minima[wanted, -1], found.observed[wanted, -1] = places[mine[wanted]], True
        found.roots[wanted, -1] = np.eye(2)

    def start(self, *arguments: Any, **options: Any) -> None:
        super().start(*arguments, **options)
        refine = self._joint.refine

        def counted() -> Numbers:
            before = int(self._joint.landmarks.observed[:, -1].sum())
            H = refine()
            self.scales.append(self._joint.scale)
            self.taken += before
            self.thrown += before - int(self._joint.landmarks.observed[:, -1].sum())
            return H

        self._joint.refine = counted  # type: ignore[method-assign]


def inside(places: Numbers) -> NDArray[np.bool_]:
    return np.asarray(((places > _BORDER) & (places < [WIDTH - _BORDER, HEIGHT - _BORDER])).all(1))


def blank(matrix: Numbers = K) -> Any:
    image: Image = np.zeros((HEIGHT, WIDTH), np.uint8)
    return SimpleNamespace(K=matrix, gray=image, surface_gray=image, mask=None)


@pytest.mark.parametrize('noise', [0.05, 0.3])
def test_the_window_estimates_its_noise_and_keeps_inliers(
        noise: float) -> None:
    window = NumbersWindow(Street(0, 60, noise))
    for _ in range(60):
        window.go()
    # Those of the newest frame too, before poses are refined.
    assert np.median(window.scales) == pytest.approx(noise, rel=0.1)
    # Beyond 4 standard deviations in two numbers lie 3 of 10 000, and some leave with the sign of
    # their depth.
    assert window.thrown < 0.015 * window.taken
    assert window.taken > 30 * WINDOW_TUNING.landmarks


def test_only_keyframes_stay_in_the_window() -> None:
    window, chosen = NumbersWindow(Street(0, 30, 0.05)), [True]
    for _ in range(30):
        window.go()
        chosen.append(window.is_keyframe)
        held = min(sum(chosen[:-1]), WINDOW_TUNING.keyframes) + 1
        assert len(window._views) == held
    assert 5 < sum(chosen) < 25


@pytest.mark.slow
def test_noise_does_not_bias_the_scale() -> None:
    lengths = []
    for seed in range(4):
        window = NumbersWindow(Street(seed, 150, 0.3))
        lengths.append([window.go() for _ in range(150)])
    first, last = np.array(lengths)[:, :15].mean(1), np.array(lengths)[:, -15:].mean(1)
    drifts = np.log(last / first)
    assert abs(drifts.mean()) < 0.01
    assert drifts.std() < 0.01


@pytest.mark.slow
@pytest.mark.parametrize('unit', [0.002, 50.0])
def test_a_track_is_the_same_in_any_unit(unit: float) -> None:
    """The first step defines it: one of a vehicle that starts, or one of metres."""
    as_they_are, in_units = (
        [window.go() for _ in range(60)]
        for window in (NumbersWindow(Street(0, 60, 0.3)), NumbersWindow(Street(0, 60, 0.3), unit)))
    assert np.array(in_units) / unit == pytest.approx(as_they_are, rel=1e-6)


@pytest.mark.parametrize('seed', range(3))
def test_the_rotation_drifts_less_than_half_of_that_by_pairs(seed: int) -> None:
    window = NumbersWindow(Street(seed, 60, 0.1, turned=5e-4))
    chained, here, off = np.eye(3), np.eye(4), []
    for _ in range(60):
        window.go()
        chained = window.pairs[-1] @ chained
        here = here @ window.added.corrected_motion
        window.record_published(window.added.corrected_motion)
        off.append([np.linalg.norm(rotation_log(R)) for R in (chained, here[:3, :3])])
    by_pairs, by_window = np.sqrt(np.square(off).mean(0))
    assert by_window < 0.5 * by_pairs


@pytest.mark.parametrize('seed', range(2))
def test_steps_are_as_long_as_their_lengths_however_long_the_track(seed: int) -> None:
    window, off, sigmas = NumbersWindow(Street(seed, 160, 0.2, turned=1e-3)), [], []
    for _ in range(160):
        window.go()
        window.record_published(window.added.corrected_motion)
        off.append(np.linalg.norm(window.added.corrected_motion[:3, 3]) - window.added.length)
        sigmas.append(window.added.sigma)
    assert np.std(off[-50:]) < np.median(sigmas)


@pytest.mark.parametrize('guess', [3.0, 6.0])
@pytest.mark.parametrize('found_by_guess', [0, 30, 60])
def test_an_uncertain_step_is_searched_where_landmarks_are_and_expected_by_the_guess(
        guess: float, found_by_guess: int) -> None:
    """A pair whose direction is hardly determined; its landmarks cannot be observed in the end."""
    street = Street(0, 20, 0.1)
    window = NumbersWindow(street)
    for _ in range(12):
        window.go()
    _, pair = street.pair(12)
    searched = list[float]()

    def observe_none() -> None:
        searched.append(float(np.linalg.norm(window._joint.poses.relative_motions[1][-1, -2])))

    def count_found(view: Any, relative: RelativePose, length: float) -> int:
        assert length == guess or 1 < length < guess
        return found_by_guess if length == guess else 100

    window._observe_landmarks = observe_none  # type: ignore[method-assign]
    window._count_found = count_found  # type: ignore[method-assign]
    step = window.add(blank(), replace(pair, covariance_5=np.eye(5) * 0.035**2), guess)
    assert (searched[0] < 0.99 * guess) == (found_by_guess < 50)
    assert step.length == pytest.approx(guess, rel=1e-3)


def test_unpublished_motion_is_made_up_for_without_a_jump() -> None:
    window, here = NumbersWindow(Street(0, 40, 0.02)), np.eye(4)
    steps = []
    for number in range(40):
        window.go()
        motion = np.eye(4) if number == 10 else window.added.corrected_motion
        window.record_published(motion)
        here = here @ motion
        steps.append(motion[2, 3])
    assert steps[9] == pytest.approx(1, abs=0.02) and steps[10] == 0
    assert steps[11] == pytest.approx(1 + WINDOW_TUNING.correction_share, abs=0.02)
    assert here[2, 3] == pytest.approx(40, abs=0.2)


# Cameras that a calibration is wrong about, by what usually is: several pixels at the border.
WRONG = [Correction(-0.015), Correction(0.015), Correction(cx=0.01),
         Correction(0.012, -0.006, -0.004, 0.003)]


def through_a_turn(seed: int, wrong: Correction, corrects: bool) -> tuple[NumbersWindow, Numbers]:
    """Go through a turn of 70 degrees; returns the window, and the lengths of its steps."""
    window, lengths = NumbersWindow(Street(seed, 120, 0.1, curve=0.02, wrong=wrong)), []
    for _ in range(120):
        lengths.append(window.go())
        if corrects and window.calibration.needs_update:
            window.correct()
    return window, np.array(lengths)


@pytest.mark.slow
@pytest.mark.parametrize('wrong', WRONG)
def test_in_a_turn_the_window_finds_what_is_wrong_with_the_camera_and_lengths_do_not_drift(
        wrong: Correction) -> None:
    drifts, squares = [], []
    for seed in range(3):
        window, lengths = through_a_turn(seed, wrong, corrects=True)
        found = window.calibration
        assert found.significant and any(found.corrected)
        squares.append(((np.array(found.deviation) - wrong) / found.sigmas)**2)
        drifts.append(np.log(lengths[-15:].mean() / lengths[:15].mean()))
    assert np.mean(squares) < 2
    _, unknowing = through_a_turn(0, wrong, corrects=False)
    drift = np.log(unknowing[-15:].mean() / unknowing[:15].mean())
    assert abs(drift) > 0.02
    assert np.sqrt(np.mean(np.square(drifts))) < abs(drift) / 3


@pytest.mark.parametrize('wrong', WRONG)
def test_a_correction_takes_back_how_much_lengths_have_drifted_so_far(wrong: Correction) -> None:
    window, lengths = NumbersWindow(Street(0, 120, 0.1, curve=0.02, wrong=wrong)), []
    while not window.calibration.needs_update:
        lengths.append(window.go())
    before = np.mean(lengths[:15])
    noise, taken, thrown = np.median(window.scales), window.taken, window.thrown
    drifted = window.added.length
    ratio = window.correct()
    assert abs(np.log(ratio * drifted / before)) < 0.02
    after = [window.go() for _ in range(5)]
    assert np.mean(after) == pytest.approx(before, rel=0.02)
    # Earlier observations agree with the new ones.
    assert np.median(window.scales[-5:]) == pytest.approx(noise, rel=0.15)
    assert window.thrown - thrown < 0.02 * (window.taken - taken)


def test_a_correction_far_beyond_first_order_leaves_lengths_positive() -> None:
    for k1 in (-3.0, 3.0):
        window = NumbersWindow(Street(0, 80, 0.1, curve=0.02))
        for _ in range(70):
            window.go()
        before = window._joint.newest_length
        window._joint.adapt_to(np.array([k1, 0, 0, 0]))
        assert 0.3 < window._joint.newest_length / before < 2


@pytest.mark.slow
@pytest.mark.parametrize('curve', [0.0, 0.02])
@pytest.mark.parametrize('seed', range(3))
def test_a_camera_as_calibrated_is_not_corrected(seed: int, curve: float) -> None:
    window = NumbersWindow(Street(seed, 120, 0.1, curve=curve))
    for _ in range(120):
        window.go()
        assert not window.calibration.significant


def seen_at_depths(rng: np.random.Generator, length: float) -> tuple[KnownDepths, RelativePose]:
    """Points of known depths, and an exact pair of that length with an uncertain pose."""
    x = rng.uniform((20, 20), (1200, 350), (150, 2))
    depths = rng.uniform(5, 40, 150)
    R, t = rotation_exp(rng.normal(size=3) * 0.01), unit(np.array([0.9, 0.1, 0.4]))
    y = projected(K, depths[:, None] * rays(K, x) @ R.T + length * t)
    root = rng.normal(size=(5, 5)) * [[1e-4], [1e-4], [1e-4], [1e-2], [1e-2]]
    return KnownDepths(x, 1 / depths, K), RelativePose(
        Status.OK, R, t, root @ root.T, x=x, y=y, y_opt=y, inliers=np.ones(150, bool))


@pytest.mark.parametrize('length', [0.3, 2.0])
def test_a_length_by_depths_is_as_uncertain_as_the_pose_of_its_pair(length: float) -> None:
    for seed in range(3):
        rng = np.random.default_rng(seed)
        known, pair = seen_at_depths(rng, length)
        exact = known.lengths(pair)
        assert exact.median() == pytest.approx(length, rel=1e-3)
        assert exact.standard_error() < 1e-3 * length
        found = []
        for error in rng.multivariate_normal(np.zeros(5), pair.covariance_5, 300):
            t = unit(pair.t + sphere_tangents(pair.t) @ error[3:])
            found.append(known.lengths(replace(
                pair, R=rotation_exp(error[:3]) @ pair.R, t=t)).median())
        # The standard deviation of 300 is known to within 4 %.
        assert exact.noise() == pytest.approx(np.std(found), rel=0.16)


def test_points_keep_their_places_in_the_world_when_the_camera_rotates() -> None:
    rng = np.random.default_rng(0)
    known, _ = seen_at_depths(rng, 1.0)
    R = rotation_exp(np.array([0.02, -0.3, 0.05]))
    turned = known.rotated(R)
    world = rays(K, known.pixels) / known.rho[:, None]
    assert np.allclose(rays(K, turned.pixels) / turned.rho[:, None], world @ R.T)
    assert len(known.rotated(rotation_exp(np.array([0, np.pi, 0]))).rho) == 0


def test_depths_of_one_pair_give_the_length_of_the_next() -> None:
    rng = np.random.default_rng(1)
    x = rng.uniform((100, 50), (1100, 310), (150, 2))
    places, pairs = rng.uniform(5, 40, (150, 1)) * rays(K, x), []
    lengths = 1.7, 0.6
    for length in lengths:
        R, t = rotation_exp(rng.normal(size=3) * 0.01), unit(np.array([0.4, 0.1, 0.9]))
        moved = places @ R.T + length * t
        x, y = projected(K, places), projected(K, moved)
        pairs.append(RelativePose(Status.OK, R, t, np.eye(5) * 1e-12, x=x, y=y, y_opt=y.copy(),
                                  inliers=np.arange(150) < 120))
        if len(pairs) == 1:
            between = moved
            # These move as points behind the camera would.
            pairs[0].y_opt[:10] = projected(K, places[:10] @ R.T - length * t)
        places = moved
    known, chosen = KnownDepths.of_pair(K, pairs[0], lengths[0]), slice(10, 120)
    assert np.array_equal(known.pixels, pairs[0].y[chosen])
    assert np.allclose(known.rho, 1 / between[chosen, 2], rtol=1e-3)
    found = known.lengths(pairs[1])
    assert len(found.values) == 110 and np.allclose(found.values, lengths[1], rtol=1e-3)
    turn = rotation_exp(np.array([0.02, -0.3, 0.05]))
    turned = known.rotated(turn)
    assert np.allclose(turned.pixels, projected(K, between[chosen] @ turn.T), atol=1e-2)
    assert np.allclose(turned.rho, 1 / (between[chosen] @ turn.T)[:, 2], rtol=1e-3)


def test_landmarks_are_not_made_of_noise() -> None:
    """A pair whose depths are noise creates none; half of them would be in front, and near."""
    street = Street(seed=0, frames=3, noise=0.3)
    window = NumbersWindow(street)
    _, pair = street.pair(0)
    assert window.has_depths(pair)
    here = rotation_exp(np.array([0.0, 0.01, 0.0]))
    still = projected(K, rays(K, pair.x) @ here.T)
    y = still + street.rng.normal(size=still.shape) * 0.3
    noise = replace(pair, R=here, y=y, y_opt=y, residuals=line_distances(
        epipolar_lines(fundamental(K, here, pair.t), pair.x), y))
    assert not window.has_depths(noise)
