"""Properties that hold for any input: geometry, messages, paraboloids, and the rules of time."""

from __future__ import annotations

from itertools import pairwise

from djet_ros.config.sections import OdometryConfig
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.geometry import (
    direction_angle,
    epipolar_lines,
    fundamental,
    in_front,
    line_distances,
    rays,
    rotation_angle,
    unit,
)
from djet_ros.core.paraboloid import constrained_minimum, fit_paraboloids, project_to_positive
from djet_ros.core.types import RelativePose, Status
from djet_ros.odometry.diagnostics import StampRate
from djet_ros.odometry.frame import Frame
from djet_ros.odometry.messages import Messages, pose_of, stamp_ns, twist
from djet_ros.odometry.result import camera_motion, OdometryResult
from djet_ros.odometry.scale import GroundTruthScale, SpeedScale
from djet_ros.odometry.uncertainty import compose
from djet_ros.odometry.visual_odometry import VisualOdometry
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays
import numpy as np
import pytest
from ros_messages import header, message_type, serialised, STORE
from scipy.spatial.transform import Rotation

SECOND = 10**9
K = np.array([[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]])

vectors = arrays(float, 3, elements=st.floats(-3, 3))
directions = vectors.filter(lambda v: np.linalg.norm(v) > 1e-2).map(unit)
rotations = vectors.map(lambda v: Rotation.from_rotvec(v).as_matrix())
seeds = st.integers(0, 2**32 - 1)


@st.composite
def poses(draw, reach=1e4):
    pose = np.eye(4)
    pose[:3, :3] = draw(rotations)
    pose[:3, 3] = draw(arrays(float, 3, elements=st.floats(-reach, reach)))
    return pose


# Geometry


@given(rotations, directions, seeds)
def test_exact_matches_lie_on_their_epipolar_lines_in_front_of_both_cameras(R, t, seed):
    X = np.random.default_rng(seed).uniform((-3, -3, 2), (3, 3, 30), (40, 3))
    Y = X @ R.T + t
    seen = Y[:, 2] > 0.5
    x, y = ((P[seen] @ K.T)[:, :2] / P[seen][:, 2:] for P in (X, Y))
    F = fundamental(K, R, t)
    # To rounding, which grows with how far off the image a wide camera would see the point.
    off = 1e-9 * (1 + np.abs(y).max(1, initial=0.0)) * (1 + np.abs(x).max(1, initial=0.0))
    assert (np.abs(line_distances(epipolar_lines(F, x), y)) < off).all()
    assert np.linalg.matrix_rank(F, tol=1e-9 * np.abs(F).max()) == 2
    parallax = np.linalg.norm(np.cross(unit(rays(K, x) @ R.T), unit(rays(K, y))), axis=1)
    distinct = parallax > 1e-9
    assert in_front(R, t, rays(K, x), rays(K, y))[distinct].all()
    assert not in_front(R, -t, rays(K, x), rays(K, y))[distinct].any()


@given(rotations, rotations, rotations, directions, directions)
def test_angles_are_distances(A, B, C, a, b):
    assert rotation_angle(A, A) < 1e-6
    assert rotation_angle(A, B) == pytest.approx(rotation_angle(B, A), abs=1e-9)
    assert rotation_angle(A, C) <= rotation_angle(A, B) + rotation_angle(B, C) + 1e-9
    assert rotation_angle(C @ A, C @ B) == pytest.approx(rotation_angle(A, B), abs=1e-6)
    assert direction_angle(a, b) == pytest.approx(direction_angle(A @ a, A @ b), abs=1e-9)
    assert direction_angle(a, -b) == pytest.approx(np.pi - direction_angle(a, b), abs=1e-9)


@given(rotations, directions, st.floats(1e-3, 1e3), vectors)
def test_a_motion_takes_points_of_the_current_camera_back_to_the_previous_one(R, t, length, X):
    motion = camera_motion(RelativePose(Status.OK, R=R, t=t), length)
    current = R @ X + length * t
    assert np.allclose(motion[:3, :3] @ current + motion[:3, 3], X, atol=1e-9 * (1 + length))


@given(poses(100), poses(100), seeds)
def test_a_composed_covariance_is_symmetric_and_grows(pose, motion, seed):
    rng = np.random.default_rng(seed)
    first, second = (L @ L.T for L in rng.normal(size=(2, 6, 6)) * 10.0**rng.uniform(-4, 2))
    both = compose(pose, first, motion, second)
    assert np.array_equal(both, both.T)
    assert np.linalg.eigvalsh(both)[0] > -1e-9 * np.abs(both).max()
    more = compose(pose, first, motion, second + np.eye(6)) - both
    assert np.linalg.eigvalsh(more)[0] > 1 - 1e-6 * (1 + np.abs(both).max())


# Messages


def result(motion, pose, stamp=5 * SECOND, previous=4 * SECOND):
    return OdometryResult(stamp, 'camera', Status.OK, previous, None, motion, pose,
                          np.eye(6), np.eye(6), 1.0, True, since_ns=previous)


def on_the_wire(message):
    return STORE.deserialize_cdr(serialised(message), message.__msgtype__)


@given(st.integers(-2**31 * SECOND, 2**31 * SECOND - 1))
def test_every_stamp_that_a_message_holds_survives_it(stamp):
    made = Messages(message_type, OdometryConfig()).header(stamp, 'camera')
    assert stamp_ns(on_the_wire(made)) == stamp


@given(st.integers(-2**31, 2**31 - 1), st.integers(0, 2**32 - 1))
def test_every_valid_stamp_can_be_forwarded(sec, nanosec):
    sent = header()
    sent.stamp.sec, sent.stamp.nanosec = sec, nanosec
    made = Messages(message_type, OdometryConfig()).header(stamp_ns(sent), 'camera')
    assert stamp_ns(on_the_wire(made)) == stamp_ns(sent)


@given(poses(), poses())
def test_poses_survive_their_messages(motion, pose):
    made = Messages(message_type, OdometryConfig(frame_convention='optical'))
    one = result(motion, pose)
    for message, expected in ((made.relative_pose(one), motion), (made.odometry(one), pose),
                              (made.pose_stamped(one), pose),
                              (made.relative_pose_cov(one), motion)):
        stamp, back = pose_of(on_the_wire(message))
        assert stamp == 5 * SECOND
        assert np.allclose(back, expected, atol=1e-9)


@given(st.lists(poses(10), min_size=1, max_size=6))
def test_in_body_axes_too_relative_poses_chain_to_the_odometry(motions):
    made = Messages(message_type, OdometryConfig(frame_convention='body'))
    pose, chained = np.eye(4), np.eye(4)
    for motion in motions:
        pose = pose @ motion
        one = result(motion, pose)
        chained = chained @ pose_of(made.relative_pose(one))[1]
        assert np.allclose(pose_of(made.odometry(one))[1], chained, atol=1e-6)


@given(poses(100), st.integers(10**6, 3600 * SECOND))
def test_a_twist_held_for_its_time_is_the_motion(motion, nanoseconds):
    velocity, covariance = twist(result(motion, motion, 10**15 + nanoseconds, 10**15))
    seconds = nanoseconds * 1e-9
    turned = Rotation.from_rotvec(velocity[3:] * seconds).as_matrix()
    assert np.allclose(turned, motion[:3, :3], atol=1e-6)
    assert np.allclose(motion[:3, :3] @ velocity[:3] * seconds, motion[:3, 3], atol=1e-6)
    assert np.isfinite(covariance).all()


# Paraboloids


@st.composite
def samples(draw):
    """Windows (P, P, N) of any whole numbers that Hamming distances can be, and a sigma."""
    side = draw(st.sampled_from([3, 5, 7]))
    rng = np.random.default_rng(draw(seeds))
    return (rng.integers(0, 257, (side, side, 5)).astype(np.uint16),
            draw(st.sampled_from([0.0, 1.0, 2.5])))


@given(samples(), arrays(float, 2, elements=st.floats(-500, 500)), st.integers(0, 1000))
def test_a_fit_moves_with_its_window_and_rises_with_its_samples(window, shift, more):
    surfaces, sigma = window
    centres = np.zeros((5, 2))
    here = fit_paraboloids(surfaces, centres, sigma)
    there = fit_paraboloids(surfaces + np.uint16(more), centres + shift, sigma)
    assert np.allclose(there.A, here.A, atol=1e-8)
    assert np.allclose(there.b, here.b, atol=1e-8)
    assert np.allclose(there.c, here.c + more, atol=1e-6)
    y = np.array([[0.3, -1.2]]).repeat(5, axis=0)
    assert np.allclose(there.values(y + shift), here.values(y) + more, atol=1e-5)


@given(samples())
def test_a_projected_surface_is_a_bowl_and_stays_one(window):
    fitted = fit_paraboloids(window[0], np.zeros((5, 2)), window[1])
    bowls = project_to_positive(fitted)
    assert (np.linalg.eigvalsh(bowls.A) > 0).all()
    assert np.isfinite(bowls.minima()).all()
    around = bowls.minima()[None] + np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])[:, None]
    lowest = bowls.values(bowls.minima())
    for y in around:
        assert (bowls.values(y) >= lowest).all()


@given(samples(), st.floats(0, np.pi), st.floats(-5, 5), st.floats(-9, 9))
def test_the_optimum_on_a_line_lies_on_it_and_no_other_of_its_points_is_lower(
        window, angle, h, along):
    bowls = project_to_positive(fit_paraboloids(window[0], np.zeros((5, 2)), window[1]))
    g = np.tile([np.cos(angle), np.sin(angle)], (5, 1))
    v = constrained_minimum(bowls.A, bowls.b, g, np.full(5, h))
    assert np.allclose((g * v).sum(1), h, atol=1e-6)
    other = v + along * np.stack([-g[:, 1], g[:, 0]], axis=1)
    scale = 1 + np.abs(bowls.values(other))
    assert (bowls.values(other) >= bowls.values(v) - 1e-9 * scale).all()


# The rules of time

BLACK = np.zeros((48, 64), np.uint8)


def rules(stamps, max_gap_ns, max_lost):
    """
    Return (status, reference) of each frame without features, by the rules of the README.

    A gap or a step back restarts; otherwise a frame refers to the newest reference, which the
    newest frame takes over after max_lost bad pairs in a row.
    """
    last = reference = None
    bad = 0
    for stamp in stamps:
        if last is None:
            yield Status.FIRST_FRAME, None
        elif not 0 <= stamp - last <= max_gap_ns:
            yield Status.TIME_JUMP, None
        else:
            yield Status.TOO_FEW_MATCHES, reference
            bad += 1
            if bad >= max_lost:
                reference = stamp
            last = stamp
            continue
        last = reference = stamp
        bad = 0


steps = st.lists(st.one_of(st.integers(1, 2 * SECOND), st.integers(-3 * SECOND, -1),
                           st.just(SECOND), st.just(SECOND + 10)), min_size=1, max_size=25)


@settings(deadline=None)
@given(st.integers(0, 2**31 * SECOND - 60 * SECOND), steps, st.integers(1, 4))
def test_every_frame_refers_to_what_the_rules_of_time_say(start, between, max_lost):
    stamps = np.cumsum([start + 80 * SECOND, *between]).tolist()
    odometry = VisualOdometry(EstimatorConfig(),
                              OdometryConfig(max_gap=1.0, max_lost=max_lost))
    # Ten nanoseconds: stamps of this size are compared as floats of seconds.
    for stamp, (status, reference) in zip(stamps, rules(stamps, SECOND, max_lost)):
        result = odometry.process(Frame(BLACK, K, stamp))
        assert (result.status, result.previous_stamp_ns) == (status, reference)
        assert np.isfinite(result.pose_covariance).all()
    with pytest.raises(ValueError, match='two frames in a row'):
        odometry.process(Frame(BLACK, K, stamps[-1]))


speeds = st.lists(st.tuples(st.integers(1, SECOND // 2), st.floats(-100, 100)), min_size=1,
                  max_size=20)


@given(speeds, st.lists(st.floats(0, 1), min_size=3, max_size=3))
def test_lengths_add_up_and_are_those_of_the_speeds(measured, shares):
    source = SpeedScale()
    stamps = np.cumsum([SECOND, *(step for step, _ in measured)])[1:].tolist()
    for stamp, (_, speed) in zip(stamps, measured):
        source.add_speed(stamp, speed)
    first, last = stamps[0], stamps[-1]
    a, b, c = sorted(first + round(share * (last - first)) for share in shares)
    whole, left, right = (source.between(*ends) for ends in ((a, c), (a, b), (b, c)))
    assert whole.value == pytest.approx(left.value + right.value, abs=1e-6)
    assert 0 <= whole.value <= 100 * (c - a) * 1e-9 * (1 + 1e-9)
    assert whole.known
    assert whole.sigma >= 1e-3


@given(st.floats(allow_nan=True, allow_infinity=True))
def test_no_speed_makes_a_length_that_is_not_finite(speed):
    source = SpeedScale()
    source.add_speed(SECOND, 3.0)
    source.add_speed(2 * SECOND, speed)
    length = source.between(SECOND, 2 * SECOND)
    assert np.isfinite(length.value**2 + length.sigma**2)
    assert length.value >= 0


@given(st.lists(vectors, min_size=2, max_size=12), seeds)
def test_the_displacement_is_no_longer_than_the_path(positions, seed):
    stamps = np.arange(len(positions), dtype=np.int64) * SECOND // 10 + SECOND
    source = GroundTruthScale(stamps, np.array(positions))
    a, b, c = np.sort(np.random.default_rng(seed).integers(stamps[0], stamps[-1] + 1, 3)).tolist()
    assert source.between(a, c).known
    assert source.between(a, c).value <= (source.between(a, b).value
                                          + source.between(b, c).value + 1e-9)


@given(st.lists(st.integers(0, 10 * SECOND), min_size=2, max_size=60))
def test_the_rate_is_that_of_the_newest_frames_in_order(stamps):
    rate = StampRate(frames=30)
    for stamp in stamps:
        rate.add(stamp)
    run = len(stamps)
    while run > 1 and all(b > a for a, b in pairwise(stamps[run - 2:])):
        run -= 1
    newest = stamps[run - 1:][-30:]
    if len(newest) < 2:
        assert rate.hertz is None
    else:
        assert rate.hertz == pytest.approx((len(newest) - 1) / (newest[-1] - newest[0]) * SECOND)
