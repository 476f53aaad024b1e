"""Gyro integration and its bias estimate, against exactly known trajectories."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from djet_ros.core.fusion import agrees, fused, MeasuredRotation
from djet_ros.core.geometry import (
    rotation_angle,
    rotation_exp,
    rotation_log,
    sphere_tangents,
    unit,
)
from djet_ros.core.types import Array, RelativePose, Status
from djet_ros.lab.scenes.imu import feel, Mems, TO_CAMERA
from djet_ros.lab.scenes.walk import HandHeld
from djet_ros.odometry.inertial import Gyro, GyroNoise
from djet_ros.odometry.priors import MotionPriors
from djet_ros.odometry.uncertainty import compose
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

NOISE = GyroNoise(2e-4, 2e-5)
SECOND, PERIOD = 10**9, 10**8
EXACT = Mems(gyro=0, gyro_walk=0, gyro_bias=0)


def mounted(noise: GyroNoise = NOISE, to_camera: Array | None = None, offset_ns: int = 0) -> Gyro:
    gyro = Gyro(noise, offset_ns)
    gyro.mount(np.eye(3) if to_camera is None else to_camera)
    return gyro


def constant(rate: Array, seconds: float = 1.0, hertz: int = 200, **more: object) -> Gyro:
    gyro = mounted(**more)  # type: ignore[arg-type]
    for i in range(round(seconds * hertz) + 1):
        gyro.add(i * SECOND // hertz, rate)
    return gyro


def trajectory(frames: int = 60, seed: int = 0) -> Array:
    hand = HandHeld((0.0, -1.3, 0.0), 0.2, seed, limit=frames)
    return np.stack([hand.pose(i) for i in range(frames)])


def relative(poses: Array, start: int, end: int) -> Array:
    """Return the rotation R of x_end = R x_start."""
    return np.asarray((np.linalg.inv(poses[start]) @ poses[end])[:3, :3].T)


def felt_by(poses: Array, mems: Mems, seed: int = 0) -> tuple[Gyro, Array]:
    """Return a gyro that was moved along poses, and its true biases at the samples."""
    felt = feel(poses, PERIOD * 1e-9, mems, seed)
    gyro = mounted(to_camera=felt.to_camera)
    for stamp, rate in zip(felt.stamps_ns.tolist(), felt.rates, strict=True):
        gyro.add(stamp, rate)
    return gyro, felt.rate_biases


# Integration

def test_a_constant_rate_turns_by_rate_times_time_between_any_two_stamps() -> None:
    rate = np.array([0.5, -1.2, 2.0])
    turn = constant(rate).turn(123_456_789, 876_543_210)
    assert turn is not None
    expected = Rotation.from_rotvec(-rate * (876_543_210 - 123_456_789) * 1e-9).as_matrix()
    assert np.abs(turn.R - expected).max() < 1e-12


@pytest.mark.parametrize('seed', [0, 1, 2])
def test_the_jerks_of_a_hand_are_integrated_to_a_hundredth_of_a_degree(seed: int) -> None:
    poses = trajectory(seed=seed)
    gyro, _ = felt_by(poses, EXACT, seed)
    for i in range(len(poses) - 1):
        turn = gyro.turn(i * PERIOD, (i + 1) * PERIOD)
        assert turn is not None
        assert np.linalg.norm(turn.correction(relative(poses, i, i + 1))) < np.radians(0.01)


def test_between_few_samples_an_axis_that_turns_is_integrated_to_the_fourth_order() -> None:
    """Twenty samples a second of a rate that changes from one axis to another."""
    gyro, slow, parts = mounted(), 50_000_000, 2000
    rates = np.array([[2.0, 0.5, 0], [0.5, 2.0, 0], [0, 1.0, 2.0]])
    turned = np.eye(3)
    for i, rate in enumerate(rates):
        gyro.add(i * slow, rate)
        for share in (np.arange(parts) + 0.5) / parts if i else ():
            between = rates[i - 1] + share * (rate - rates[i - 1])
            turned = turned @ rotation_exp(between * slow * 1e-9 / parts)
    turn = gyro.turn(0, 2 * slow)
    assert turn is not None
    assert np.linalg.norm(turn.correction(turned.T)) < 2e-5  # 4e-4 to the second


def test_rates_along_the_axes_of_a_robot_are_those_of_its_camera() -> None:
    # To the left about z of the robot is about -y of the camera.
    turn = constant(np.array([0, 0, 0.3]), to_camera=TO_CAMERA).turn(0, SECOND)
    assert turn is not None
    assert np.allclose(Rotation.from_matrix(turn.R.T).as_rotvec(), [0, -0.3, 0])


def test_the_clock_offset_shifts_the_stamps() -> None:
    ahead = mounted(offset_ns=30_000_000)
    for i in range(201):
        ahead.add(i * 5_000_000, np.array([0, 0, i * 0.01]))
    turn = ahead.turn(100_000_000, 200_000_000)
    assert turn is not None
    # A rate of 2 t from 0.13 to 0.23 s.
    assert np.allclose(Rotation.from_matrix(turn.R.T).as_rotvec(), [0, 0, 0.23**2 - 0.13**2])


@pytest.mark.parametrize('offset_ns', [-30_000_000, 30_000_000])
def test_images_need_samples_up_to_their_stamp_by_the_clock_of_the_imu(offset_ns: int) -> None:
    gyro, image = mounted(offset_ns=offset_ns), 5 * PERIOD
    for stamp in range(0, image + offset_ns, 10_000_000):
        gyro.add(stamp, np.array([0, 0, 0.5]))
        assert not gyro.covers(image)
    gyro.add(image + offset_ns, np.array([0, 0, 0.5]))
    assert gyro.covers(image)
    gyro.forget_before(image - PERIOD)
    assert gyro.turn(image - PERIOD, image) is not None
    assert gyro.turn(image - PERIOD - 1, image) is None


def test_the_covariance_is_that_of_white_noise_and_of_the_bias() -> None:
    rng = np.random.default_rng(5)
    off = []
    for _ in range(300):
        gyro = mounted(GyroNoise(0.01, 0.0))
        bias = rng.normal(0, 0.02, 3)  # not estimated yet
        for i in range(41):
            gyro.add(i * 5_000_000, bias + 0.01 * np.sqrt(200) * rng.standard_normal(3))
        turn = gyro.turn(2_000_000, 198_000_000)
        assert turn is not None
        off.append(turn.correction(np.eye(3)))
    scatter = np.mean(np.square(off))
    assert scatter / np.diag(turn.covariance).mean() == pytest.approx(1, abs=0.25)


def test_a_rotation_whose_rate_changes_between_samples_is_less_certain_than_one_at_a_constant_rate(
        ) -> None:
    even, jerking = mounted(), mounted()
    for i in range(11):
        even.add(i * 10_000_000, np.array([1.0, 0, 0]))
        jerking.add(i * 10_000_000, np.array([2.0 * (i % 2), 0, 0]))
    one, other = (gyro.turn(0, PERIOD) for gyro in (even, jerking))
    assert one is not None and other is not None
    assert rotation_angle(one.R, other.R) < 1e-9
    assert (np.linalg.eigvalsh(other.covariance - one.covariance) > 0).all()


def test_a_bias_is_learned_from_one_sure_rotation_however_the_axes_turn_meanwhile() -> None:
    """By 90 degrees about one axis, then another, and back again by both."""
    bias, exact, biased = np.array([1e-3, -2e-3, 1.5e-3]), mounted(), mounted()
    about = [(1.9, 0, 0), (0, 1.9, 0), (0, -1.9, 0), (-1.9, 0, 0)]
    for i in range(641):
        rate = np.array(about[min(i // 160, 3)])
        exact.add(i * 5_000_000, rate)
        biased.add(i * 5_000_000, rate + bias)
    turn = exact.turn(0, 640 * 5_000_000)
    assert turn is not None
    biased.learn(0, 640 * 5_000_000, turn.R, np.eye(3) * 1e-12)
    assert np.linalg.norm(biased.bias - bias) < 0.05 * np.linalg.norm(bias)


# Invalid samples

def test_without_a_mounting_or_with_a_gap_there_is_no_rotation() -> None:
    unmounted = Gyro(NOISE)
    for i in range(100):
        unmounted.add(i * 5_000_000, np.zeros(3))
    assert unmounted.turn(0, PERIOD) is None and unmounted.at_rest(0, PERIOD) is None
    gyro = mounted()
    for i in [*range(100), *range(200, 300)]:
        gyro.add(i * 5_000_000, np.zeros(3))
    assert gyro.turn(0, 450_000_000) is not None
    assert gyro.turn(450_000_000, 1_050_000_000) is None
    assert gyro.turn(1_000_000_000, 1_600_000_000) is None  # too late
    assert gyro.turn(-1, PERIOD) is None  # too early


def test_samples_may_come_out_of_order_and_twice() -> None:
    rates = np.random.default_rng(1).normal(0, 1, (200, 3))
    ordered, mixed = mounted(), mounted()
    for i, rate in enumerate(rates):
        ordered.add(i * 5_000_000, rate)
    for i in range(0, 200, 2):
        for j in (i + 1, i, i):
            mixed.add(j * 5_000_000, rates[j])
    a, b = (one.turn(7, 990_000_000) for one in (ordered, mixed))
    assert a is not None and b is not None
    assert np.array_equal(a.R, b.R)
    assert mixed.refused == {'out of order': 100, 'equal stamp': 100}


@pytest.mark.parametrize('rate', [np.nan, np.inf, -np.inf, 1e30])
def test_invalid_rates_are_ignored(rate: float) -> None:
    gyro = constant(np.array([0, 0, 0.1]))
    gyro.add(500_000_001, np.array([0, rate, 0]))
    assert gyro.refused == {'not a rate': 1}
    turn = gyro.turn(0, SECOND)
    assert turn is not None
    assert np.allclose(Rotation.from_matrix(turn.R.T).as_rotvec(), [0, 0, 0.1])


@pytest.mark.parametrize('way', [1, -1])
def test_a_saturated_gyro_measures_no_rotation(way: int) -> None:
    gyro = mounted()
    for i in range(200):
        faster = 20 * np.sin(np.pi * i / 200)
        gyro.add(i * 5_000_000, np.array([0.001 * i, 0, way * min(faster, 8.7)]))
    assert gyro.refused['end of its range'] > 50
    assert gyro.turn(400_000_000, 500_000_000) is None
    assert gyro.turn(0, PERIOD) is not None


def test_the_smallest_range_of_a_mems_gyro_is_noticed() -> None:
    gyro, range_ = mounted(), np.radians(125.0)
    for i in range(200):
        gyro.add(i * 5_000_000, np.array([0, 0, min(4 * np.sin(np.pi * i / 200), range_)]))
    assert gyro.turn(400_000_000, 500_000_000) is None


@pytest.mark.parametrize('wrong', [
    {'scale': 1.02}, {'scale': 0.98}, {'about': np.radians([2.0, 0, 0])},
    {'about': np.radians([0, -2.0, 0])}])
def test_a_fast_rotation_agrees_with_a_gyro_of_common_scale_factor_and_mounting(
        wrong: dict[str, Any]) -> None:
    """By 2 % and by 2 degrees; images are as sure of a rotation as a hundredth of a pixel."""
    rate = np.array([0.0, 0, 1.9])
    R = rotation_exp(-rate * PERIOD * 1e-9)
    off = rotation_exp(wrong.get('about', np.zeros(3)))
    gyro = constant(wrong.get('scale', 1.0) * (off @ rate))
    gyro.bias_covariance = np.eye(3) * 1e-4**2
    turn = gyro.turn(SECOND // 2, SECOND // 2 + PERIOD)
    assert turn is not None
    visual = pair(R, np.array([0.0, 0, 1]), np.eye(5) * 1e-5**2)
    assert agrees(turn, visual)
    # What is fused is then nearly the rotation by the images.
    assert np.linalg.norm(MeasuredRotation(fused(visual, turn).R, np.eye(3)).correction(R)) < 2e-5
    # That of another robot does not agree.
    assert not agrees(MeasuredRotation(R.T, turn.covariance), visual)


def test_late_samples_neither_hide_nor_feign_saturation() -> None:
    """Some samples come after later ones."""
    fast, slow, ms = np.array([0, 0, 9.0]), np.array([0, 0, 8.0]), 1_000_000
    at_its_end = mounted()
    for stamp in (0, 10, 20, 30, 40, 50, 35, 60, 70):
        at_its_end.add(stamp * ms, fast)
    for start, end in ((25, 38), (32, 34), (41, 58), (52, 59)):
        assert at_its_end.turn(start * ms, end * ms) is None
    # Equal to the newest sample, but not to those around it.
    turning = mounted()
    for stamp, rate in ((0, slow), (10, slow * 1.01), (20, fast), (30, fast), (15, fast),
                        (40, slow), (50, slow * 1.01)):
        turning.add(stamp * ms, rate)
    assert turning.refused == {'out of order': 1}
    assert turning.turn(12 * ms, 48 * ms) is not None


def test_a_looping_bag_resets_the_samples_but_not_the_bias() -> None:
    gyro = constant(np.array([0, 0, 0.1]), seconds=2.0)
    gyro.learn(0, SECOND, np.eye(3), np.eye(3) * 1e-8)
    bias = gyro.bias.copy()
    assert abs(bias[2] - 0.1) < 0.01
    gyro.add(0, np.zeros(3))
    gyro.add(5_000_000, np.zeros(3))
    assert gyro.turn(0, 5_000_000) is not None
    assert gyro.turn(SECOND, SECOND + 5_000_000) is None
    assert np.array_equal(gyro.bias, bias)


def test_memory_is_bounded() -> None:
    gyro = mounted()
    for i in range(5000):
        gyro.add(i * 5_000_000, np.zeros(3))
        gyro.forget_before((i - 40) * 5_000_000)
    assert len(gyro._rates) < 50
    assert gyro.turn(4980 * 5_000_000, 4999 * 5_000_000) is not None


# Bias

@pytest.mark.parametrize('seed', range(5))
def test_after_30_s_of_pairs_the_bias_is_known_to_a_tenth_of_it(seed: int) -> None:
    """Visual rotations as in a street: 0.004 degrees, the mean of measured errors."""
    poses, rng = trajectory(301, seed), np.random.default_rng(seed)
    gyro, biases = felt_by(poses, Mems(), seed)
    sigma = np.radians(0.004)
    for i in range(300):
        seen = rotation_exp(rng.normal(0, sigma, 3)) @ relative(poses, i, i + 1)
        gyro.learn(i * PERIOD, (i + 1) * PERIOD, seen, np.eye(3) * sigma**2)
    off = gyro.bias - biases[-1]
    assert np.linalg.norm(off) < 0.1 * np.linalg.norm(biases[-1])
    assert off @ np.linalg.solve(gyro.bias_covariance, off) < 16  # of 3 expected


def test_information_of_a_pair_adds_to_that_of_the_bias() -> None:
    rng, seconds = np.random.default_rng(11), 0.1
    known, of_pair = some_covariance(rng, 3), some_covariance(rng, 3)
    bias = 0.01 * rng.normal(size=3)
    gyro = constant(np.zeros(3), noise=GyroNoise(0.05, 0.0), to_camera=TO_CAMERA)
    gyro.bias_covariance = known
    # The camera turned by what the gyro did not measure.
    gyro.learn(0, PERIOD, rotation_exp(TO_CAMERA @ bias * seconds), of_pair)
    J, noise = seconds * TO_CAMERA, of_pair + 0.05**2 * seconds * np.eye(3)
    expected = np.linalg.inv(np.linalg.inv(known) + J.T @ np.linalg.solve(noise, J))
    assert np.allclose(gyro.bias_covariance, expected)
    assert np.allclose(gyro.bias, expected @ J.T @ np.linalg.solve(noise, J @ bias), rtol=1e-3)


def test_a_standstill_determines_the_bias() -> None:
    gyro, biases = felt_by(np.tile(np.eye(4), (101, 1, 1)), Mems(), 3)
    for i in range(100):
        gyro.learn(i * PERIOD, (i + 1) * PERIOD, np.eye(3), np.eye(3) * 2e-4**2)
    assert np.linalg.norm(gyro.bias - biases[-1]) < 0.1 * np.linalg.norm(biases[-1])


def test_rest_is_distinguished_from_the_slowest_rotation() -> None:
    at_rest, _ = felt_by(np.tile(np.eye(4), (31, 1, 1)), Mems(), 4)
    turning, _ = felt_by(np.array([np.block([
        [rotation_exp(np.array([0, np.radians(0.05) * i, 0])), np.zeros((3, 1))],
        [np.zeros((1, 3)), np.ones((1, 1))]]) for i in range(31)]), Mems(), 4)
    for gyro in (at_rest, turning):
        assert not gyro.at_rest(0, 2 * PERIOD)  # it might be the bias
        gyro.bias = feel(np.tile(np.eye(4), (31, 1, 1)), 0.1, Mems(), 4).rate_biases[0].copy()
        gyro.bias_covariance = np.eye(3) * 1e-4**2
    at_rest = [[gyro.at_rest(i * PERIOD, (i + 1) * PERIOD) for i in range(30)]
               for gyro in (at_rest, turning)]
    assert all(at_rest[0])
    assert not any(at_rest[1])


@pytest.mark.parametrize('axis', range(3))
def test_a_camera_that_shakes_to_and_fro_about_any_axis_is_not_at_rest(axis: int) -> None:
    """It shakes at twenty hertz, so that it is back at each image, by five times the noise."""
    rng, noise = np.random.default_rng(7), NOISE.density * np.sqrt(200) * np.ones(3)
    for amplitude, rests in ((0.0, True), (5 * np.sqrt(2) * noise[0], False)):
        gyro = mounted()
        gyro.bias_covariance = np.eye(3) * 1e-5**2
        for i in range(41):
            shaking = amplitude * np.sin(2 * np.pi * 20 * i / 200) * np.eye(3)[axis]
            gyro.add(i * 5_000_000, shaking + rng.normal(0, noise))
        assert gyro.at_rest(0, PERIOD) is gyro.at_rest(PERIOD, 2 * PERIOD) is rests


def test_two_samples_do_not_tell_a_camera_at_rest() -> None:
    """One that shakes may be at the same point of its way at both."""
    for hertz, rests in ((10, None), (20, True)):
        gyro = constant(np.zeros(3), hertz=hertz)
        gyro.bias_covariance = np.eye(3) * 1e-5**2
        assert gyro.at_rest(0, PERIOD) is rests


def test_a_gyro_that_never_agrees_is_not_trusted() -> None:
    gyro = mounted()
    for _ in range(60):
        gyro.judge(True)
    assert gyro.trusted
    for _ in range(40):
        gyro.judge(False)
    assert not gyro.trusted
    for _ in range(30):
        gyro.judge(True)
    assert gyro.trusted


# Fusion

def pair(R: Array, t: Array, covariance: Array) -> RelativePose:
    lift = np.zeros((6, 5))
    lift[:3, :3], lift[3:, 3:] = np.eye(3), sphere_tangents(t)
    return RelativePose(Status.OK, R, t, covariance, lift @ covariance @ lift.T)


def test_fused_errors_are_consistent_with_their_covariance_and_smaller() -> None:
    rng = np.random.default_rng(2)
    root = rng.normal(0, 1e-3, (5, 5))
    covariance, gyro_covariance = root @ root.T, np.eye(3) * 5e-4**2
    R, t = rotation_exp(np.array([0.1, 0.2, -0.1])), np.array([0.6, 0.0, 0.8])
    before, after = [], []
    for _ in range(2000):
        error = root @ rng.standard_normal(5)
        seen = t + sphere_tangents(t) @ error[3:]
        visual = pair(rotation_exp(error[:3]) @ R, seen / np.linalg.norm(seen), covariance)
        turn = MeasuredRotation(rotation_exp(rng.normal(0, 5e-4, 3)) @ R, gyro_covariance)
        found = fused(visual, turn)
        off = np.concatenate([MeasuredRotation(found.R, gyro_covariance).correction(R),
                              sphere_tangents(found.t).T @ (found.t - t)])
        before.append(error @ np.linalg.solve(covariance, error))
        after.append(off @ np.linalg.solve(found.covariance_5, off))
    assert np.mean(before) == pytest.approx(5, abs=0.3)
    assert np.mean(after) == pytest.approx(5, abs=0.3)
    assert np.trace(found.covariance_5) < np.trace(covariance)
    assert np.allclose(found.covariance_6[:, 3:] @ found.t, 0, atol=1e-12)


def some_covariance(rng: np.random.Generator, size: int) -> Array:
    """Return a covariance with standard deviations of 0.01 to 0.03 along any axes."""
    axes = np.linalg.qr(rng.normal(size=(size, size)))[0]
    return np.asarray(axes * np.square(rng.uniform(0.01, 0.03, size)) @ axes.T)


@pytest.mark.parametrize('t', [
    unit(np.array(way)) for way in ((-0.3, 0.2, 0.9), (0.1, 0.7, -0.7), (0.6, 0.8, 0.0))])
def test_information_of_a_rotation_adds_to_that_of_a_pair(t: Array) -> None:
    rng = np.random.default_rng(8)
    covariance, of_turn = some_covariance(rng, 5), some_covariance(rng, 3)
    R, little = rotation_exp(rng.normal(size=3)), 1e-6 * rng.normal(size=3)
    information = np.linalg.inv(covariance)
    information[:3, :3] += np.linalg.inv(of_turn)
    both = np.linalg.inv(information)
    same = fused(pair(R, t, covariance), MeasuredRotation(R, of_turn))
    assert np.allclose(same.R, R) and np.allclose(same.t, t)
    assert np.allclose(same.covariance_5, both, rtol=1e-9)
    for off in little, -little:
        found = fused(pair(R, t, covariance), MeasuredRotation(rotation_exp(off) @ R, of_turn))
        step = both[:, :3] @ np.linalg.solve(of_turn, off)
        assert np.allclose(rotation_log(found.R @ R.T), step[:3], rtol=1e-4, atol=1e-11)
        assert np.allclose(found.t - t, sphere_tangents(t) @ step[3:], rtol=1e-4, atol=1e-11)
        # The basis of its tangents flips where t passes by the image plane.
        assert np.allclose(found.covariance_6, same.covariance_6, atol=1e-8)
        assert np.allclose(found.covariance_6, pair(R, found.t, found.covariance_5).covariance_6)


def test_without_parallax_only_the_rotation_is_fused() -> None:
    rng = np.random.default_rng(4)
    covariance, of_turn = some_covariance(rng, 5), some_covariance(rng, 3)
    R, off = rotation_exp(rng.normal(size=3)), 1e-6 * rng.normal(size=3)
    visual = replace(pair(R, unit(rng.normal(size=3)), covariance),
                     status=Status.NO_PARALLAX, t=np.zeros(3))
    before = visual.covariance_6.copy()
    found = fused(visual, MeasuredRotation(rotation_exp(off) @ R, of_turn))
    both = np.linalg.inv(np.linalg.inv(covariance[:3, :3]) + np.linalg.inv(of_turn))
    assert np.allclose(rotation_log(found.R @ R.T), both @ np.linalg.solve(of_turn, off),
                       rtol=1e-4, atol=1e-11)
    assert not found.t.any() and found.status is Status.NO_PARALLAX
    assert np.allclose(found.covariance_6[:3, :3], both)
    assert np.array_equal(found.covariance_6[3:, 3:], visual.covariance_6[3:, 3:])
    assert not found.covariance_6[:3, 3:].any() and not found.covariance_6[3:, :3].any()
    assert np.array_equal(visual.covariance_6, before)


def test_a_rotation_without_information_changes_nothing() -> None:
    visual = pair(rotation_exp(np.array([0.01, 0, 0])), np.array([0, 0, 1.0]), np.eye(5) * 1e-6)
    found = fused(visual, MeasuredRotation(np.eye(3), np.eye(3) * 1e6))
    assert np.allclose(found.R, visual.R, atol=1e-9)
    assert np.allclose(found.covariance_5, visual.covariance_5, rtol=1e-5)


def test_a_pair_with_another_rotation_does_not_agree() -> None:
    visual = pair(np.eye(3), np.array([0, 0, 1.0]), np.eye(5) * np.radians(0.01)**2)
    sure = np.eye(3) * np.radians(0.004)**2
    assert agrees(MeasuredRotation(rotation_exp(np.radians([0.03, 0, 0])), sure), visual)
    assert not agrees(MeasuredRotation(rotation_exp(np.radians([0.3, 0, 0])), sure), visual)


def test_rotations_agree_to_a_few_hundredths_of_a_degree_however_sure_both_are() -> None:
    """Not even rotations that both are sure of are the same to a hundredth of a degree."""
    visual = pair(np.eye(3), np.array([0, 0, 1.0]), np.eye(5) * np.radians(0.001)**2)
    for degrees, agree in ((0.03, True), (0.3, False)):
        other = rotation_exp(np.radians([degrees, 0, 0]))
        measured = MeasuredRotation(other, np.eye(3) * np.radians(0.001)**2)
        assert agrees(measured, visual) is measured.compatible_with(visual.R) is agree


@pytest.mark.parametrize('seed', range(5))
def test_rotations_differ_if_noise_makes_such_a_difference_less_than_once_in_a_million(
        seed: int) -> None:
    rng = np.random.default_rng(seed)
    covariance, of_turn = some_covariance(rng, 5), some_covariance(rng, 3)
    visual = pair(rotation_exp(rng.normal(size=3)), unit(rng.normal(size=3)), covariance)
    off = np.linalg.cholesky(covariance[:3, :3] + of_turn) @ unit(rng.normal(size=3))
    for chance, agree in ((2e-6, True), (0.5e-6, False)):
        turn = rotation_exp(np.sqrt(chi2.isf(chance, 3)) * off)
        assert agrees(MeasuredRotation(turn @ visual.R, of_turn), visual) is agree


def test_a_rotation_is_incompatible_with_those_a_thousand_times_less_likely_than_itself() -> None:
    rng = np.random.default_rng(9)
    measured = MeasuredRotation(rotation_exp(rng.normal(size=3)), some_covariance(rng, 3))
    for _ in range(5):
        sigma = np.linalg.cholesky(measured.covariance) @ unit(rng.normal(size=3))
        for times, compatible in ((900, True), (1100, False)):
            R = rotation_exp(-np.sqrt(2 * np.log(times)) * sigma) @ measured.R
            assert measured.compatible_with(R) is compatible


def test_a_rotation_decides_between_two_motions_only_by_its_covariance() -> None:
    rng = np.random.default_rng(3)
    one, other = (rotation_exp(np.radians([0, angle, 0])) for angle in (0.0, 0.3))
    wrong = {}
    for sigma in np.radians([0.02, 0.1, 1.0]):
        measured = [MeasuredRotation(rotation_exp(rng.normal(0, sigma, 3)) @ one,
                                     np.eye(3) * sigma**2) for _ in range(500)]
        wrong[sigma] = np.mean([turn.prefers(other, one) for turn in measured])
        right = np.mean([turn.prefers(one, other) for turn in measured])
        assert right == 1 if sigma < 1e-3 else right < 1
    assert max(wrong.values()) < 0.01
    assert right == 0  # with a sigma of a degree


def test_a_bias_estimated_from_a_moving_object_is_reset() -> None:
    """The images show the rotation of a lorry for a second, and then that of the world."""
    poses = trajectory(frames=160)
    gyro, biases = felt_by(poses, Mems(), 6)
    sure, lorry = np.eye(3) * np.radians(0.01)**2, rotation_exp(np.radians([0, 0.2, 0.1]))
    fitted = []
    for i in range(len(poses) - 1):
        R = relative(poses, i, i + 1)
        seen = RelativePose(Status.OK, lorry @ R if i < 10 else R, np.array([0, 0, 1.0]),
                            covariance_6=np.block([[sure, np.zeros((3, 3))],
                                                   [np.zeros((3, 6))]]))
        turn = gyro.turn(i * PERIOD, (i + 1) * PERIOD)
        assert turn is not None
        agreed = agrees(turn, seen)
        gyro.judge(agreed)
        if agreed:
            gyro.learn(i * PERIOD, (i + 1) * PERIOD, seen.R, sure)
        fitted.append(gyro.trusted)
    assert not all(fitted) and fitted[-1]
    assert np.linalg.norm(gyro.bias - biases[-1]) < 0.1 * np.linalg.norm(biases[-1])


# Without images

def test_dead_reckoning_frame_by_frame_is_as_sure_as_the_gyro_over_the_whole_time() -> None:
    """The errors of its bias and scale factor are the same in all frames, so they add up."""
    gyro, priors = constant(np.array([0, 0, 0.05]), 3.0, noise=GyroNoise(0, 0)), MotionPriors()
    priors.gyro, priors.known_ns = gyro, 5 * PERIOD
    pose, covariance = np.eye(4), np.zeros((6, 6))
    for i in range(5, 25):
        reckoned = priors.dead_reckoned((i * PERIOD, (i + 1) * PERIOD))
        assert reckoned is not None
        motion, of_motion = reckoned
        pose, covariance = pose @ motion, compose(pose, covariance, motion, of_motion)
    whole = gyro.turn(5 * PERIOD, 25 * PERIOD)
    assert whole is not None
    assert np.allclose(pose[:3, :3], whole.R.T)
    assert np.allclose(covariance[3:, 3:], whole.covariance, rtol=1e-2, atol=1e-9)
    # Nothing measures the translation.
    assert not pose[:3, 3].any() and np.linalg.eigvalsh(covariance[:3, :3])[0] >= 1e6


def test_the_error_of_dead_reckoning_is_along_the_axes_of_the_camera_before() -> None:
    """By a bias that differs from axis to axis, in a large rotation; 1 % is by its scale."""
    bias_covariance = some_covariance(np.random.default_rng(12), 3)

    def reckoned(bias: Array) -> tuple[Array, Array]:
        gyro, priors = constant(np.array([1.5, 0, 1.0]), noise=GyroNoise(0, 0),
                                to_camera=TO_CAMERA), MotionPriors()
        gyro.bias, gyro.bias_covariance, priors.gyro = bias, bias_covariance, gyro
        found = priors.dead_reckoned((0, SECOND))
        assert found is not None
        return found[0][:3, :3], found[1][3:, 3:]

    R, covariance = reckoned(np.zeros(3))
    by_bias = np.column_stack([rotation_log(reckoned(1e-6 * axis)[0] @ R.T) / 1e-6
                               for axis in np.eye(3)])
    assert np.allclose(covariance, by_bias @ bias_covariance @ by_bias.T + (
        0.01 * rotation_angle(R, np.eye(3)))**2 * np.eye(3), rtol=1e-2, atol=4e-6)


@pytest.mark.parametrize(('verdicts', 'is_used'), [
    ([], True), ([False], False), ([True, False], True), ([True, False, False], False),
    ([True] * 20 + [False] * 19, True), ([True] * 20 + [False] * 21, False)])
def test_a_gyro_is_dead_reckoned_if_half_of_the_pairs_agreed(
        verdicts: list[bool], is_used: bool) -> None:
    priors = MotionPriors()
    assert priors.dead_reckoned((0, PERIOD)) is None
    priors.gyro = constant(np.array([0, 0, 0.1]))
    for agreed in verdicts:
        priors.gyro.judge(agreed)
    assert (priors.dead_reckoned((0, PERIOD)) is not None) is is_used
