"""Gyro integration and its bias estimate, against exactly known trajectories."""

from __future__ import annotations

from typing import Any

from djet_ros.core.fusion import agrees, fused, MeasuredRotation
from djet_ros.core.geometry import rotation_exp, sphere_tangents
from djet_ros.core.types import Array, RelativePose, Status
from djet_ros.lab.scenes.imu import feel, Mems, TO_CAMERA
from djet_ros.lab.scenes.walk import HandHeld
from djet_ros.odometry.inertial import Gyro, GyroNoise
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

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


# Invalid samples

def test_without_a_mounting_or_with_a_gap_there_is_no_rotation() -> None:
    unmounted = Gyro(NOISE)
    for i in range(100):
        unmounted.add(i * 5_000_000, np.zeros(3))
    assert unmounted.turn(0, PERIOD) is None
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


def test_a_saturated_gyro_measures_no_rotation() -> None:
    gyro = mounted()
    for i in range(200):
        faster = 20 * np.sin(np.pi * i / 200)
        gyro.add(i * 5_000_000, np.array([0.001 * i, 0, min(faster, 8.7)]))
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
