"""Odometry of good, bad, stationary and missing frames, and the covariances of its poses."""

from dataclasses import replace

from cards import Cards, K, pose
from djet_ros.config.sections import OdometryConfig
from djet_ros.core.correction import Correction
from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.geometry import direction_angle, rotation_angle, rotation_exp, unit
from djet_ros.core.self_calibration import SelfCalibration
from djet_ros.core.types import RelativePose, Status
from djet_ros.core.verdict import as_undecided
from djet_ros.errors import DjetError
from djet_ros.lab.scenes import make_scene
from djet_ros.odometry.frame import continuity, Frame
from djet_ros.odometry.inertial import Gyro, GyroNoise
from djet_ros.odometry.messages import twist
from djet_ros.odometry.order import Order
from djet_ros.odometry.result import camera_motion
from djet_ros.odometry.scale import (
    ConstantScale,
    GroundTruthScale,
    GuessScale,
    Length,
    RelativeScale,
    Scale,
    scale_source,
    SpeedScale,
    UnitScale,
)
from djet_ros.odometry.uncertainty import compose, motion_covariance, standstill_covariance
from djet_ros.odometry.visual_odometry import VisualOdometry
from djet_ros.recordings.kitti import KittiSequence
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from two_view import CLOSE_UP, pictures_of_a_plane

ESTIMATOR = EstimatorConfig(max_features=800)
STEP = pose(x=0.25, z=0.15, yaw=0.01)


@pytest.fixture(scope='module')
def cards():
    return Cards()


def odometry(scale=None, **config):
    return VisualOdometry(ESTIMATOR, OdometryConfig(**config), scale)


def drive(vo, cards, steps, start=0.0):
    """Process the frames of a drive; a step is a pose (4, 4), or the image itself."""
    results, here = [], np.eye(4)
    for i, step in enumerate(steps):
        black = step is None
        here = here if black else here @ step
        frame = cards.frame(start + 0.1 * i, here)
        if black:
            frame = Frame(np.zeros_like(frame.gray), frame.K, frame.stamp_ns, frame.frame_id)
        results.append(vo.process(frame))
    return results


def test_poses_are_the_current_camera_in_the_first_and_in_the_previous_one(cards):
    length = float(np.linalg.norm(STEP[:3, 3]))
    results = drive(odometry(ConstantScale(length)), cards, [np.eye(4), STEP, STEP, STEP])
    assert [r.status for r in results] == [Status.FIRST_FRAME, *[Status.OK] * 3]
    for result in results[1:]:
        assert np.degrees(rotation_angle(result.motion[:3, :3], STEP[:3, :3])) < 0.3
        assert np.degrees(direction_angle(result.motion[:3, 3], STEP[:3, 3])) < 8
        assert np.linalg.norm(result.motion[:3, 3]) == pytest.approx(length)
    truth = STEP @ STEP @ STEP
    assert np.linalg.norm(results[-1].pose[:3, 3] - truth[:3, 3]) < 0.15 * 3 * length
    assert results[3].previous_stamp_ns == results[2].stamp_ns


def test_an_undecided_pair_makes_its_newer_image_the_reference():
    """Otherwise the next pair spans two steps, over which the smaller body leaves the image."""
    world, body = Cards(), Cards(seed=6)

    def image(number):
        left = world.gray(pose(z=0.12 * number), noise=number)
        right = body.gray(pose(x=0.1 * number, z=-0.25 * number), noise=number)
        left[:, 190:] = right[:, 190:]
        return Frame(left, K, number * 10**8)

    vo = odometry(ConstantScale(1.0))
    results = [vo.process(image(number)) for number in range(4)]
    assert [r.status for r in results[1:]] == [Status.TWO_MOTIONS] * 3
    assert [r.previous_stamp_ns for r in results[1:]] == [0, 10**8, 2 * 10**8]
    # The motion in between stays unknown.
    assert (np.diag(results[2].pose_covariance) >= np.diag(results[1].pose_covariance)).all()
    assert results[3].pose_covariance[0, 0] > 1e5


def test_after_an_undecided_pair_its_matches_are_not_reused():
    """The motion may continue, but the matches are of an older image."""
    world, body, estimator = Cards(), Cards(seed=6), TwoViewEstimator(ESTIMATOR)
    vo, here, there, views, results = odometry(ConstantScale(1.0)), np.eye(4), np.eye(4), [], []
    alike, apart = (pose(x=0.2), pose(x=0.2)), (pose(z=0.12), pose(x=0.1, z=-0.25))
    for number, steps in enumerate((alike, apart, apart, alike, alike)):
        gray = world.gray(here, noise=number)
        gray[:, 160:] = body.gray(there, noise=number)[:, 160:]
        results.append(vo.process(Frame(gray, K, number * 10**8)))
        views.append(estimator.view(gray, K))
        here, there = here @ steps[0], there @ steps[1]
    assert [result.status for result in results[1:]] == [
        Status.OK, Status.TWO_MOTIONS, Status.TWO_MOTIONS, Status.OK]
    before, after = results[1].relative, results[4].relative
    motion = RelativePose(Status.OK, before.R, before.t)
    assert np.array_equal(estimator.estimate(*views[3:], motion).x, after.x)


@pytest.mark.parametrize(('gray', 'got'), [
    (np.zeros((48, 64, 3), np.uint8), r'\(48, 64, 3\) uint8'),
    (np.zeros((48, 64)), r'\(48, 64\) float64'),
])
def test_a_frame_that_is_no_gray_image_is_refused_with_its_shape(gray, got):
    with pytest.raises(ValueError, match=f'expected a gray image .* got {got}'):
        Frame(gray, np.eye(3), 1)


@pytest.mark.parametrize(('gray', 'got'), [
    (None, 'NoneType'), ([[0, 0]], 'list'), (np.zeros((0, 64), np.uint8), r'\(0, 64\) uint8'),
])
def test_a_frame_without_an_image_is_refused(gray, got):
    with pytest.raises(ValueError, match=f'expected a gray image .* got {got}'):
        Frame(gray, K, 1)


@pytest.mark.parametrize(('matrix', 'said'), [
    (np.full((3, 3), np.nan), 'K is .*nan.* finite numbers'),
    (np.zeros((3, 3)), r'K is \[\[0.0, .* positive fx and fy'),
    (K.T, r'K is .* a camera matrix is \[\[fx, skew, cx\], \[0, fy, cy\]'),
    (K * [[-1], [1], [1]], 'positive fx and fy'),
    (None, r'camera matrix K \(3, 3\)'), (K[:2], r'K \(3, 3\), got \(2, 3\)'),
])
def test_a_matrix_of_no_camera_is_refused_with_its_values(matrix, said):
    image = np.zeros((48, 64), np.uint8)
    with pytest.raises(ValueError, match=said):
        Frame(image, matrix, 1)
    with pytest.raises(ValueError, match=said):
        TwoViewEstimator(ESTIMATOR).view(image, matrix)


def test_a_mask_of_another_size_is_refused():
    image, mask = np.zeros((48, 64), np.uint8), np.ones((64, 48), bool)
    with pytest.raises(ValueError, match=r'mask left_out is \(64, 48\), its image \(48, 64\)'):
        Frame(image, K, 1, left_out=mask)
    with pytest.raises(ValueError, match=r'mask left_out is \(64, 48\), its image \(48, 64\)'):
        TwoViewEstimator(ESTIMATOR).view(image, K, left_out=mask)


@pytest.mark.parametrize('stamp', [0.1, np.float64(1.7e9), None])
def test_a_stamp_in_seconds_is_refused(stamp):
    """Taken for nanoseconds, all images would be within one gap, and of one moment."""
    with pytest.raises(ValueError, match=r'stamp_ns is .*whole nanoseconds'):
        Frame(np.zeros((48, 64), np.uint8), K, stamp)


def test_a_result_is_printed_in_a_line(cards):
    vo = odometry()
    first, second = (vo.process(Frame(cards.gray(pose(x=0.2 * i)), K, np.int64(i * 10**8)))
                     for i in range(2))
    assert repr(first) == ('OdometryResult(FIRST_FRAME, stamp_ns 0, position [0.0, 0.0, 0.0], '
                           'scale unknown, None)')
    x, *_ = second.pose[:3, 3].round(4).tolist()
    agree, count = second.relative.inliers.sum(), len(second.relative.x)
    assert f'OdometryResult(OK, stamp_ns 100000000, position [{x}, ' in repr(second)
    assert f'{agree} of {count} matches agree))' in repr(second)


def test_one_buffer_may_hold_all_images_in_turn(cards):
    """As cameras are read: the trajectory would be that of one image, without a word."""
    images = [cards.gray(pose(x=0.2 * i)) for i in range(3)]
    buffer, matrix, left_out = np.empty_like(images[0]), K.copy(), np.empty(images[0].shape, bool)

    def read(i):
        """Overwrite the buffers, all values of which are others in between."""
        buffer[:], matrix[:], left_out[:] = images[i], K, False
        frame = Frame(buffer, matrix, i * 10**8, left_out=left_out)
        buffer[:], matrix[:], left_out[:] = 0, np.nan, True
        return frame

    separate, together = odometry(), odometry()
    for i, image in enumerate(images):
        before = separate.process(Frame(image, K, i * 10**8,
                                        left_out=np.zeros(image.shape, bool)))
        after = together.process(read(i))
        assert after.status is before.status
        assert np.array_equal(after.pose, before.pose)
    assert after.status is Status.OK


@pytest.mark.slow
def test_a_compromise_between_two_bodies_does_not_persist():
    scene = make_scene('moving_object', size=(620, 188))
    poses = scene.trajectory(6)
    vo = VisualOdometry()
    results = [vo.process(Frame(scene.render(pose, i), scene.K, (i + 1) * 10**8))
               for i, pose in enumerate(poses)]
    # The first pair alone may fit a compromise; all later ones are correct or uncertain.
    for i, result in enumerate(results[2:], 2):
        if result.status is Status.OK:
            truth = np.linalg.inv(poses[i - 1]) @ poses[i]
            assert np.degrees(direction_angle(result.motion[:3, 3], truth[:3, 3])) < 2
    assert results[-1].status is Status.OK


def test_without_a_scale_a_translation_has_length_one_and_is_not_metric(cards):
    result = drive(odometry(UnitScale()), cards, [np.eye(4), STEP])[-1]
    assert np.linalg.norm(result.motion[:3, 3]) == pytest.approx(1)
    assert not result.scale_known
    along = unit(result.motion[:3, 3])
    assert along @ result.motion_covariance[:3, :3] @ along == pytest.approx(1e6, rel=1e-3)


def test_one_bad_frame_is_bridged_by_the_next_good_one(cards):
    results = drive(odometry(), cards, [np.eye(4), STEP, None, STEP])
    assert [r.status for r in results[2:]] == [Status.TOO_FEW_MATCHES, Status.OK]
    bad, bridged = results[2:]
    assert bad.previous_stamp_ns == bridged.previous_stamp_ns == results[1].stamp_ns
    assert np.array_equal(bad.pose, results[1].pose)
    assert np.diag(bad.motion_covariance).min() > 1
    assert np.degrees(rotation_angle(bridged.motion[:3, :3], STEP[:3, :3])) < 0.3


@pytest.mark.slow
def test_a_pair_with_an_ambiguous_direction_still_rotates_the_pose():
    rng, doubted = np.random.default_rng(0), []
    for _ in range(24):
        R, _, *pictures = pictures_of_a_plane(rng)
        result = drive_past(pictures)[-1]
        if result.status is not Status.AMBIGUOUS:
            continue
        off = Rotation.from_matrix(result.pose[:3, :3] @ R).as_rotvec()
        # The direction is unknown, but the rotation is bounded.
        covariance = result.pose_covariance[3:, 3:]
        assert off @ np.linalg.solve(covariance, off) < chi2.ppf(0.999, 3)
        assert np.array_equal(result.pose[:3, 3], np.zeros(3))
        assert np.linalg.eigvalsh(result.pose_covariance[:3, :3])[0] > 1e5
        doubted.append((np.linalg.norm(off), rotation_angle(R, np.eye(3))))
    assert len(doubted) >= 6
    # Nearly always that is closer to the truth than no rotation.
    assert np.mean([off < turn for off, turn in doubted]) > 0.8


def drive_past(pictures):
    """Process images of the wide-angle camera."""
    vo = VisualOdometry()
    return [vo.process(Frame(gray, CLOSE_UP, (i + 1) * 10**8)) for i, gray in enumerate(pictures)]


def test_after_too_many_bad_pairs_the_reference_is_replaced_and_the_pose_uncertain(cards):
    results = drive(odometry(max_lost=2), cards,
                    [np.eye(4), STEP, None, None, STEP, STEP])
    assert [r.status.value for r in results[2:]] == [
        'TOO_FEW_MATCHES', 'TOO_FEW_MATCHES', 'TOO_FEW_MATCHES', 'OK']
    # The frame after the black ones could only be compared with a black one.
    assert results[5].previous_stamp_ns == results[4].stamp_ns
    angles = [np.sqrt(r.pose_covariance[3, 3]) for r in results]
    assert angles[1] < 0.01
    assert angles[5] > 1


def test_a_stationary_camera_has_no_motion_and_keeps_its_reference(cards):
    vo = odometry()
    first, *still = (vo.process(cards.frame(0.1 * i, noise=i)) for i in range(4))
    for result in still:
        assert result.status is Status.NO_PARALLAX
        assert result.stationary
        assert np.array_equal(result.pose, np.eye(4))
        assert result.previous_stamp_ns == first.stamp_ns
    moved = vo.process(cards.frame(0.4, STEP))
    assert moved.status is Status.OK
    assert moved.previous_stamp_ns == first.stamp_ns


def test_the_velocity_after_a_standstill_excludes_the_wait(cards):
    scale, step = SpeedScale(), pose(x=0.25)
    for i in range(-1, 60):
        # 0.25 m from frame to frame once it starts
        scale.add_speed(i * 100_000_000, 0.0 if i < 30 else 2.5)
    results = drive(odometry(scale), cards, [np.eye(4)] * 31 + [step] * 2)
    assert all(result.stationary for result in results[1:31])
    # a standstill is known at once, within 0.3 m/s, and its sigma does not shrink with time
    for result in results[1:31]:
        velocity, covariance = twist(result)
        assert not velocity.any()
        assert 1e-3 < np.sqrt(covariance[0, 0]) < 0.3
    for result in results[31:]:
        velocity, covariance = twist(result)
        sigma = np.sqrt(covariance[0, 0])
        assert abs(velocity[0] - 2.5) < 4 * sigma
        assert sigma < 1.0


def test_the_velocity_across_a_bad_frame_is_the_mean_over_both_steps(cards):
    bridged = drive(odometry(ConstantScale(0.5)), cards,
                    [np.eye(4), pose(x=0.25), None, pose(x=0.5)])[-1]
    velocity, _ = twist(bridged)
    assert velocity[0] == pytest.approx(0.5 / 0.2, rel=0.02)


@pytest.mark.parametrize('method', ['djet', 'pjet', 'rpe', 'five_point'])
def test_the_same_image_twice_is_a_standstill_for_every_method(cards, method):
    vo = VisualOdometry(EstimatorConfig(method=method, max_features=500))
    vo.process(cards.frame(0.0))
    assert vo.process(cards.frame(0.1)).stationary


def test_pure_rotation_rotates_the_pose_and_does_not_move_it(cards):
    results = drive(odometry(), cards, [np.eye(4), *[pose(yaw=0.02)] * 8])
    for i, result in enumerate(results[1:], 1):
        assert result.status is Status.NO_PARALLAX
        assert not result.stationary
        turned = pose(yaw=0.02 * i)
        assert np.degrees(rotation_angle(result.pose[:3, :3], turned[:3, :3])) < 0.1
        assert not result.motion[:3, 3].any()
        assert result.motion_covariance[0, 0] == pytest.approx(1e6)


def test_the_reference_is_kept_in_view_while_the_direction_is_undetermined(cards):
    results = drive(odometry(), cards, [np.eye(4), *[pose(yaw=0.018)] * 8])
    # 4.7 pixels a step; the limit in an image of width 320 is 16
    stamps = [result.stamp_ns for result in results]
    references = [stamps.index(result.previous_stamp_ns) for result in results[1:]]
    assert references == [0, 0, 0, 0, 4, 4, 4, 4]


def test_a_motion_that_starts_with_creep_is_counted_from_the_standstill(cards):
    creeping = [pose(x=0.002)] * 20
    results = drive(odometry(ConstantScale(1.0)), cards, [*[np.eye(4)] * 10, *creeping])
    resting = results[9].stamp_ns
    assert all(result.stationary for result in results[1:12])
    moving = next(result for result in results[1:] if not result.stationary)
    # creep exceeds a tenth of the standstill threshold within a frame
    assert moving.since_ns in (resting, resting + 10**8)
    assert moving.previous_stamp_ns == 0


@pytest.mark.slow
def test_a_slow_pan_is_not_taken_for_the_bias_of_a_gyro(cards):
    gyro, rate = Gyro(GyroNoise(2e-4, 2e-5)), 0.008
    gyro.mount(np.eye(3))
    rng = np.random.default_rng(3)
    for i in range(-5, 50 * 20):
        gyro.add(i * 5_000_000, rng.normal([0, rate, 0], 2e-4 * np.sqrt(200)))
    # a fifth of a pixel from frame to frame
    drive(VisualOdometry(ESTIMATOR, gyro=gyro), cards, [pose(yaw=0.1 * rate)] * 40)
    assert np.sqrt(gyro.bias_covariance[1, 1]) < 0.1 * rate
    assert abs(gyro.bias[1]) < 0.1 * rate


def gyro_of(rate):
    """Return a gyro that measures a nearly constant rate (3,), without saturation."""
    gyro = Gyro(GyroNoise(2e-4, 2e-5))
    gyro.mount(np.eye(3))
    for i in range(-5, 50 * 20):
        gyro.add(i * 5_000_000, np.asarray(rate) * (1 + 1e-3 * (-1) ** i))
    return gyro


@pytest.mark.slow
def test_a_gyro_in_degrees_is_rejected_though_it_misleads_all_matches(cards):
    gyro = gyro_of(np.degrees([0, 0.1, 0]))
    results = drive(VisualOdometry(ESTIMATOR, gyro=gyro), cards, [STEP] * 36)
    assert not gyro.trusted
    assert results[1].status is not Status.OK
    assert results[-1].status is Status.OK


def test_a_gyro_that_contradicts_all_images_is_not_dead_reckoned(cards):
    results = drive(VisualOdometry(ESTIMATOR, gyro=gyro_of([0, 1.0, 0])), cards, [STEP] * 3)
    for result in results[1:]:
        # Matches that a wrong rotation selects may be of one plane, which has two motions.
        assert result.status in (Status.DEGENERATE, Status.AMBIGUOUS)
        # What is claimed includes what is true, not what the gyro says.
        turned = result.motion[:3, :3]
        assert rotation_angle(turned, rotation_exp(np.array([0, 0.1, 0]))) > 0.03
        assert rotation_angle(turned, rotation_exp(np.array([0, -0.1, 0]))) > 0.03
        off = Rotation.from_matrix(turned @ STEP[:3, :3].T).as_rotvec()
        assert off @ np.linalg.solve(result.motion_covariance[3:, 3:], off) < chi2.ppf(0.999, 3)


def test_a_step_back_in_time_resets_everything(cards):
    vo = odometry()
    drive(vo, cards, [np.eye(4), STEP], start=100.0)
    again = vo.process(cards.frame(1.0))
    assert again.status is Status.TIME_JUMP
    assert np.array_equal(again.pose, np.eye(4))
    assert not again.pose_covariance.any()
    assert vo.process(cards.frame(1.1, STEP)).status is Status.OK


def measure(scale, stamp_ns, metres):
    """Return a scale source a measurement: the position along x, or its speed."""
    if isinstance(scale, SpeedScale):
        scale.add_speed(stamp_ns, 4 * metres)
    else:
        scale.guess.add(stamp_ns, pose(x=metres))


def by_guess():
    scale = GuessScale()
    scale.guess.mount(np.eye(4))
    return scale


@pytest.mark.parametrize('source', [SpeedScale, by_guess])
def test_measurements_of_the_new_time_before_its_first_image_are_kept(cards, source):
    """A looping bag has its speeds with its images, or before them."""
    scale = source()
    vo, lengths = odometry(scale), []
    for start in (100.0, 1.0):
        for i in range(3):
            frame = cards.frame(start + 0.1 * i, pose(x=0.25 * i))
            measure(scale, frame.stamp_ns, 0.25 * (1 + i))
            result = vo.process(frame)
            if i:
                assert result.scale_kind is Scale.METRIC
                lengths.append(result.scale)
    assert lengths[:2] == pytest.approx(lengths[2:], rel=1e-6)


@pytest.mark.parametrize('source', [SpeedScale, by_guess])
def test_measurements_of_a_looping_bag_are_kept_though_their_stamps_are_known(source):
    scale = source()
    for _ in range(2):
        for i in range(20):
            measure(scale, i * 10**8, 0.25 * i)
    # Its first speeds and poses come before its first image, which is of the new time then.
    measure(scale, 0, 0.0)
    measure(scale, 10**8, 0.25)
    scale.go_back(0)
    assert scale.between(0, 10**8).known
    assert not scale.between(10**9, 11 * 10**8).known


@pytest.mark.parametrize('source', [SpeedScale, by_guess])
def test_measurements_of_the_old_time_are_forgotten(cards, source):
    """A bag is played again from its middle, without its speeds."""
    scale = source()
    for i in range(30):
        measure(scale, i * 10**8, 0.25 * i)
    vo = odometry(scale)
    drive(vo, cards, [np.eye(4), STEP], start=2.8)
    assert scale.between(2_800_000_000, 2_900_000_000).known
    vo.process(cards.frame(1.0))
    assert not scale.between(10**9, 1_100_000_000).known


def test_a_gap_begins_a_new_reference_at_the_last_pose(cards):
    vo = odometry(max_gap=0.5)
    before = drive(vo, cards, [np.eye(4), STEP])[-1]
    after = vo.process(cards.frame(2.0, STEP))
    assert after.status is Status.TIME_JUMP
    assert after.relative is None
    assert np.array_equal(after.pose, before.pose)
    assert np.diag(after.pose_covariance).min() > 1


def test_a_time_of_exactly_max_gap_is_no_gap():
    gray = np.zeros((48, 64), np.uint8)
    for milliseconds in range(1, 1500):
        max_gap, end = milliseconds / 1000, 10**18 + milliseconds * 10**6
        order = Order(max_gap=max_gap)
        order.take(10**18)
        for beyond, status in enumerate((Status.OK, Status.TIME_JUMP)):
            assert continuity(Frame(gray, K, 10**18), Frame(gray, K, end + beyond),
                              max_gap) is status
            assert order.follows_gap(end + beyond) == (status is Status.TIME_JUMP)


def test_a_camera_may_have_started_to_move_in_a_gap(cards):
    """That it stood before, and which features did, tells nothing of it then."""
    sideways = [pose(x=0.06)] * 12
    for gap, size in ((1.5, 0), (0.1, 2)):
        vo = odometry(max_gap=1.0)
        assert drive(vo, cards, [np.eye(4)] * 5)[-1].stationary
        here, statuses = pose(x=1.0), []
        for i, step in enumerate(sideways):
            here = here @ step
            frame = cards.frame(0.4 + gap + 0.1 * i, here)
            frame = replace(frame, gray=frame.gray[:, size:].copy())
            statuses.append(vo.process(frame).status)
        assert statuses[0] in (Status.TIME_JUMP, Status.SIZE_CHANGED)
        assert statuses[1:] == [Status.OK] * 11


def test_what_is_attached_to_a_camera_is_not_to_another_one(cards):
    vo = odometry()
    drive(vo, cards, [np.eye(4), STEP])
    vo._standstill._attached = np.array([1 + 1j])
    vo.process(cards.frame(5.0))
    assert len(vo._standstill._attached)
    frame = cards.frame(5.1)
    vo.process(replace(frame, gray=frame.gray[:-2].copy()))
    assert not len(vo._standstill._attached)


def test_another_calibration_ends_the_evidence_about_the_one_before(cards):
    vo = odometry()
    drive(vo, cards, [np.eye(4), *[STEP] * 30])
    unknown = SelfCalibration.unknown(K, vo._reference.view.gray.shape)
    assert not np.allclose(vo._scale._window.calibration.covariance, unknown.covariance)
    assert not any(vo.estimator.correction)
    vo.recalibrated()
    assert np.array_equal(vo._scale._window.calibration.covariance, unknown.covariance)


def test_a_pair_that_is_rejected_teaches_neither_gyro_nor_scale(cards, monkeypatch):
    """What has taken over the view would be measured, not the camera."""
    gyro, scale = gyro_of([0, 0.1, 0]), Observing()
    vo = VisualOdometry(ESTIMATOR, OdometryConfig(), scale, gyro)
    drive(vo, cards, [np.eye(4), *[STEP] * 5])
    known, seen = gyro.bias_covariance.copy(), scale.seen
    assert seen == 5
    monkeypatch.setattr(vo._takeover, 'judged',
                        lambda before, pair, stamp: as_undecided(pair, Status.TWO_MOTIONS))
    result = vo.process(cards.frame(0.6, np.linalg.matrix_power(STEP, 6)))
    assert result.status is Status.TWO_MOTIONS
    assert np.array_equal(gyro.bias_covariance, known) and scale.seen == seen


class Observing(ConstantScale):
    """A length of one that counts the pairs it has seen."""

    def __init__(self):
        super().__init__(1.0)
        self.seen = 0

    def observe(self, *pair):
        self.seen += 1


def test_standing_still_for_long_is_no_gap(cards):
    vo = odometry(max_gap=0.5)
    statuses = [vo.process(cards.frame(0.4 * i, noise=i)).status for i in range(5)]
    assert statuses[1:] == [Status.NO_PARALLAX] * 4


def test_another_size_or_another_camera_begins_a_new_reference(cards):
    vo = odometry()
    frame = cards.frame(0.0)
    vo.process(frame)
    smaller = Frame(frame.gray[:200, :300], K, 100, 'camera')
    assert vo.process(smaller).status is Status.SIZE_CHANGED
    zoomed = Frame(smaller.gray, K * [[1.1], [1.1], [1]], 200, 'camera')
    assert vo.process(zoomed).status is Status.SIZE_CHANGED


def test_two_frames_with_one_stamp_are_refused(cards):
    vo = odometry()
    vo.process(cards.frame(0.0))
    with pytest.raises(ValueError, match='stamp 0 ns'):
        vo.process(cards.frame(0.0))


def test_after_a_reset_the_same_frames_give_the_same_bits(cards):
    vo = odometry()
    first = drive(vo, cards, [np.eye(4), STEP, STEP])
    vo.reset()
    second = drive(vo, cards, [np.eye(4), STEP, STEP])
    assert [r.pose.tobytes() for r in first] == [r.pose.tobytes() for r in second]
    assert [r.pose_covariance.tobytes() for r in first] == \
        [r.pose_covariance.tobytes() for r in second]


@pytest.mark.parametrize('image', [
    np.zeros((48, 64)), np.full((48, 64), 255), np.full((3, 3), 7), np.zeros((2, 2)),
    np.random.default_rng(0).integers(0, 256, (240, 320))])
def test_no_image_is_too_bad_to_survive(cards, image):
    vo = odometry()
    for i in range(3):
        result = vo.process(Frame(image.astype(np.uint8), K, i, 'camera'))
        assert np.isfinite(result.pose).all()
        assert np.isfinite(result.pose_covariance).all()


def test_real_frames_are_tracked(kitti):
    sequence = KittiSequence(kitti / 'sequences' / '06', end=6)
    truth = GroundTruthScale(sequence.stamps_ns, sequence.poses[:, :3, 3])
    vo = VisualOdometry(scale=truth)
    results = [vo.process(Frame(sequence.image(i), sequence.K, int(stamp), 'camera'))
               for i, stamp in enumerate(sequence.stamps_ns)]
    assert [r.status for r in results[1:]] == [Status.OK] * 5
    assert np.linalg.norm(results[-1].pose[:3, 3] - sequence.poses[-1, :3, 3]) < 0.1


# Covariances

def some_relative(rng):
    t = unit(rng.normal(size=3))
    L = np.zeros((6, 5))
    L[:3, :3], L[3:, 3:] = np.eye(3), np.linalg.svd(t[None])[2][1:].T
    S = rng.normal(size=(5, 5)) * 0.004
    return RelativePose(Status.OK, rotation_exp(rng.normal(size=3) * 0.5), t,
                        covariance_6=L @ S @ S.T @ L.T)


def error(pose_with_error, exact):
    """Perturbation as in ROS: difference of positions, rotation vector in the fixed axes."""
    return np.concatenate([
        pose_with_error[:3, 3] - exact[:3, 3],
        Rotation.from_matrix(pose_with_error[:3, :3] @ exact[:3, :3].T).as_rotvec()])


def sampled(covariance, rng, count=20000):
    values, vectors = np.linalg.eigh(covariance)
    return rng.normal(size=(count, 6)) * np.sqrt(np.maximum(values, 0)) @ vectors.T


def assert_covariance(errors, covariance):
    measured = np.cov(np.array(errors).T)
    scale = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    assert np.abs(measured - covariance).max() < 0.05 * scale.max()
    assert np.allclose(measured / scale, covariance / scale, atol=0.06)


@pytest.mark.slow
def test_the_covariance_of_a_motion_is_that_of_sampled_motions():
    rng = np.random.default_rng(1)
    relative, length = some_relative(rng), Length(2.0, 0.03, True)
    exact = camera_motion(relative, length.value)
    errors = []
    for delta, longer in zip(sampled(relative.covariance_6, rng),
                             rng.normal(0, length.sigma, 20000), strict=True):
        disturbed = RelativePose(Status.OK, rotation_exp(delta[:3]) @ relative.R,
                                 relative.t + delta[3:])
        errors.append(error(camera_motion(disturbed, 2.0 + longer), exact))
    assert_covariance(errors, motion_covariance(relative, length))


def test_a_motion_without_a_direction_is_as_unsure_as_it_is_long_along_each_axis():
    rng = np.random.default_rng(3)
    relative = replace(some_relative(rng), status=Status.NO_PARALLAX, t=np.zeros(3))
    rotation = relative.R.T @ relative.covariance_6[:3, :3] @ relative.R
    for length, sigma in ((Length(2.0, 0.1, True), 2.0), (Length(0.0, 0.1, True), 1e-3),
                          (Length(2.0, 0.1, False), 1e3)):
        covariance = motion_covariance(relative, length)
        assert covariance[:3, :3] == pytest.approx(np.eye(3) * sigma**2)
        assert not covariance[:3, 3:].any() and not covariance[3:, :3].any()
        assert np.allclose(covariance[3:, 3:], rotation, rtol=1e-12)


def test_a_measured_length_of_zero_does_not_make_the_direction_exact():
    relative = some_relative(np.random.default_rng(4))
    along = np.pad(relative.R.T @ relative.t, (0, 3))
    of_length = 0.01**2 * np.outer(along, along)
    assert np.allclose(motion_covariance(relative, Length(0.0, 0.01, True)) - of_length,
                       motion_covariance(relative, Length(1e-3, 0.0, True)), rtol=1e-6)


def test_a_standstill_is_known_to_a_tenth_of_a_usual_step_and_turns_by_a_pixel_at_most():
    relative = some_relative(np.random.default_rng(5))
    for length, sigma in ((Length(2.0, 0.1, True), 0.2), (Length(0.0, 0.1, True), 1e-3),
                          (Length(2.0, 0.1, False), 1e3)):
        for pair, rotation in ((relative, relative.covariance_6[:3, :3]),
                               (RelativePose(Status.DEGENERATE), np.eye(3) * 1e-3**2)):
            covariance = standstill_covariance(pair, length)
            assert covariance[:3, :3] == pytest.approx(np.eye(3) * sigma**2)
            assert covariance[3:, 3:] == pytest.approx(rotation)
            assert not covariance[:3, 3:].any() and not covariance[3:, :3].any()


def test_a_pair_without_a_covariance_says_nothing_of_its_motion():
    covariance = motion_covariance(RelativePose(Status.DEGENERATE), Length(2.0, 0.1, True))
    assert np.sqrt(np.diag(covariance)) == pytest.approx([1e3] * 3 + [np.pi] * 3)
    assert np.array_equal(covariance, np.diag(np.diag(covariance)))


def disturbed(exact, delta):
    result = exact.copy()
    result[:3, :3] = rotation_exp(delta[3:]) @ exact[:3, :3]
    result[:3, 3] += delta[:3]
    return result


@pytest.mark.slow
def test_the_covariance_of_a_composed_pose_is_that_of_sampled_poses():
    rng = np.random.default_rng(2)
    covariances = [S @ S.T for S in rng.normal(size=(2, 6, 6)) * 0.006]
    poses = [pose(1, 2, 3, 0.7), pose(-1, 0.3, 2, -0.4)]
    exact = poses[0] @ poses[1]
    errors = [error(disturbed(poses[0], a) @ disturbed(poses[1], b), exact)
              for a, b in zip(*(sampled(c, rng) for c in covariances), strict=True)]
    assert_covariance(errors, compose(poses[0], covariances[0], poses[1], covariances[1]))


def test_covariances_stay_finite_symmetric_and_positive(cards):
    vo = odometry(max_lost=1, max_gap=0.5)
    for i in range(30):
        gray = cards.gray(pose(x=0.2 * i)) if i % 4 else np.zeros((240, 320), np.uint8)
        result = vo.process(Frame(gray, K, i * 10**8 + (i // 10) * 10**9))
    for covariance in (result.pose_covariance, result.motion_covariance):
        assert np.isfinite(covariance).all()
        assert np.array_equal(covariance, covariance.T)
        assert np.linalg.eigvalsh(covariance).min() > -1e-6 * np.abs(covariance).max()
        assert covariance.max() < 1e12


@pytest.mark.parametrize('changes', [
    {'grading': 0.0}, {'patch_scale': 1.0}, {'detector': 'orb'}])
def test_other_parameters_apply_to_both_images_of_the_next_pair(cards, changes):
    other = replace(ESTIMATOR, **changes)
    frames = [cards.frame(0.1 * i, pose(x=0.25 * i), noise=i) for i in range(4)]
    for before, after in ((ESTIMATOR, other), (other, ESTIMATOR)):
        vo = VisualOdometry(before)
        prior = [vo.process(frame) for frame in frames[:3]][-1].relative
        vo.configure(after, OdometryConfig(), RelativeScale())
        estimator = TwoViewEstimator(after)
        views = [estimator.view(frame.gray, frame.K) for frame in frames[2:]]
        expected, found = estimator.estimate(*views, prior), vo.process(frames[3]).relative
        assert np.array_equal(found.x, expected.x)
        assert np.array_equal(found.R, expected.R) and np.array_equal(found.t, expected.t)


# Scale

def test_unit_scale_is_unknown():
    assert UnitScale().between(0, 5) == Length(1.0, 1e3, False)


def test_speed_times_time_is_the_length():
    scale = SpeedScale(uncertainty=0.1)
    assert not scale.between(0, 10**9).known
    for tenth in range(11):
        scale.add_speed(tenth * 10**8, float(tenth))
    length = scale.between(250_000_000, 750_000_000)
    assert length.value == pytest.approx(5.0 * 0.5)
    assert length.sigma == pytest.approx(0.25)
    assert length.known


def test_a_known_length_is_off_by_a_share_of_it_and_by_a_millimetre_at_least():
    truth = GroundTruthScale(np.array([0, 1, 2]) * 10**8,
                             np.array([[0, 0, 0], [2, 0, 0], [2, 0, 0.0]]), 0.1)
    guess, speed = GuessScale(0.1), SpeedScale(0.1)
    guess.guess.mount(np.eye(4))
    for tenth, metres in enumerate((0.0, 2.0, 2.0)):
        guess.guess.add(tenth * 10**8, pose(x=metres))
    for stamp_ns, fast in ((0, True), (10**8, True), (10**8 + 1, False), (2 * 10**8, False)):
        speed.add_speed(stamp_ns, 20.0 * fast)
    for scale in truth, guess, speed:
        moved, stood = (scale.between(begin * 10**8, (begin + 1) * 10**8) for begin in (0, 1))
        assert (moved.value, moved.sigma) == (pytest.approx(2.0), pytest.approx(0.2))
        assert (stood.value, stood.sigma) == (pytest.approx(0.0, abs=1e-6), 1e-3)
        assert stood.is_zero and not moved.is_zero
    constant = ConstantScale(2.0, 0.1).between(0, 10**8)
    assert (constant.value, constant.sigma) == (2.0, pytest.approx(0.2))


def test_a_speed_is_held_for_half_a_second_and_then_only_guessed():
    scale = SpeedScale()
    scale.add_speed(0, -2.0)
    assert scale.between(100_000_000, 400_000_000) == Length(
        pytest.approx(0.6), pytest.approx(0.03), True)
    late = scale.between(900_000_000, 10**9)
    assert not late.known
    assert late.value == pytest.approx(0.2)


def test_speeds_at_one_hertz_are_interpolated_but_not_over_a_gap():
    scale = SpeedScale()
    for second in (10, 11, 12, 20):
        scale.add_speed(second * 10**9, float(second))
    for start, end in ((10.5, 10.6), (10.8, 10.9), (10.2, 11.7)):
        length = scale.between(round(start * 1e9), round(end * 1e9))
        assert length.known and length.value == pytest.approx((end**2 - start**2) / 2)
    for start, end in ((9, 10), (12, 20), (15, 20), (19, 20)):
        assert not scale.between(start * 10**9, end * 10**9).known


def test_a_reset_source_has_no_length_for_the_next_track():
    scale = SpeedScale()
    scale.add_speed(0, 2.0)
    odometry = VisualOdometry(scale=scale)
    assert scale.between(0, 10**8).known  # came before
    odometry.reset()
    assert not scale.between(0, 10**8).known


def test_invalid_speeds_are_ignored():
    scale = SpeedScale()
    for stamp, speed in ((0, 1.0), (1, np.nan), (2, np.inf), (0, 9.0), (-5, 9.0)):
        scale.add_speed(stamp, speed)
    assert scale.between(0, 10**8).value == pytest.approx(0.1)
    scale.reset()
    assert not scale.between(0, 10**8).known


def test_one_speed_of_another_clock_does_not_silence_those_that_follow():
    scale = SpeedScale()
    for stamp in (10**9, 10**18, *range(2 * 10**9, 3 * 10**9, 10**8)):
        scale.add_speed(stamp, 2.0)
    length = scale.between(25 * 10**8, 26 * 10**8)
    assert length.known and length.value == pytest.approx(0.2)
    assert '1.1 s before' in scale.why_unknown(4 * 10**9)


def test_speeds_that_come_a_little_late_count_at_their_stamps():
    scale = SpeedScale()
    for stamp, speed in ((0, 1.0), (4 * 10**8, 1.0), (10**8, 3.0), (2 * 10**8, 3.0)):
        scale.add_speed(stamp, speed)
    assert scale.between(10**8, 2 * 10**8).value == pytest.approx(0.3)
    assert scale.between(0, 4 * 10**8).value == pytest.approx(0.9)


def test_ground_truth_is_interpolated_but_not_across_gaps():
    stamps = np.array([0, 1, 2, 30, 31]) * 10**8
    positions = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [np.nan] * 3, [9, 9, 9.0]])
    scale = GroundTruthScale(stamps, positions)
    assert scale.between(0, 200_000_000).value == pytest.approx(np.sqrt(2))
    assert scale.between(0, 50_000_000).value == pytest.approx(0.5)
    assert not scale.between(0, 10**9).known
    assert not scale.between(-1, 10**8).known


def test_the_configuration_names_the_scale():
    assert isinstance(scale_source(OdometryConfig()), RelativeScale)
    assert isinstance(scale_source(OdometryConfig(scale='none')), UnitScale)
    assert scale_source(OdometryConfig(scale='constant', scale_value=2)).between(0, 1).value == 2
    assert isinstance(scale_source(OdometryConfig(scale='speed')), SpeedScale)
    with pytest.raises(DjetError, match='no ground truth'):
        scale_source(OdometryConfig(scale='ground_truth'))


@pytest.mark.parametrize(('scale', 'length', 'too_short'), [
    ('constant', 'scale_value', 1e-7), ('camera_height', 'camera_height', 0.009)])
def test_a_scale_without_its_required_length_is_refused(scale, length, too_short):
    for given in ({}, {length: too_short}):
        with pytest.raises(DjetError, match=rf"scale is '{scale}', and odometry.{length} is "
                           rf'\S+; give the metres .*--{length.replace("_", "-")}'):
            scale_source(OdometryConfig(scale=scale, **given))


def test_a_frame_that_is_refused_leaves_no_trace(cards):
    vo, frame = odometry(), cards.frame(0.0, np.eye(4))
    vo.process(frame)
    with pytest.raises(ValueError, match='have the stamp'):
        vo.process(replace(frame, gray=frame.gray[:-2]))
    assert vo.process(cards.frame(0.1, STEP)).status is Status.OK


@pytest.mark.parametrize('gap', [0.1, 60.0])
def test_the_correction_of_a_camera_is_forgotten_for_another_one(cards, gap):
    vo = odometry()
    drive(vo, cards, [np.eye(4), STEP, STEP])
    vo._correct(Correction(0.02, 0.01))
    frame = cards.frame(0.2 + gap, STEP)
    result = vo.process(replace(frame, gray=frame.gray[:-20].copy()))
    assert result.status is (Status.SIZE_CHANGED if gap < 1 else Status.TIME_JUMP)
    assert not any(vo.estimator.correction)


def test_a_wrong_motion_at_the_start_does_not_last(corridor):
    """
    Between textureless walls the first pairs of a camera on its side fit two motions.

    Each later pair has a slight preference for the right one.
    """
    sequence, odometry = KittiSequence(corridor, end=16), VisualOdometry()
    K, side = sequence.K.copy(), np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    K[0, 2], K[1, 2] = sequence.size[1] - 1 - sequence.K[1, 2], sequence.K[0, 2]
    errors = []
    for index in range(16):
        image = np.ascontiguousarray(np.rot90(sequence.image(index), -1))
        result = odometry.process(Frame(image, K, index + 1))
        if index:
            true = np.linalg.inv(sequence.poses[index - 1]) @ sequence.poses[index]
            errors.append(direction_angle(result.motion[:3, 3], side @ true[:3, 3]))
    assert np.degrees(np.nanmedian(errors[5:])) < 3
