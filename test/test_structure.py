"""Scale along a track: lengths by shared landmarks, and metres by a scale source."""

from dataclasses import replace
from types import SimpleNamespace
from typing import ClassVar

from cards import Cards, DEPTHS, K as CARDS_K, pose
from djet_ros.config.sections import OdometryConfig
from djet_ros.core.covariance import lift
from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.geometry import rotation_exp, rotation_log, sphere_tangents
from djet_ros.core.landmark_choice import choose_landmarks, PATCH, surrounding_means
from djet_ros.core.types import Pose, RelativePose, Rival, Status, TRACKED
from djet_ros.core.window import Window, WINDOW_TUNING, WindowStep
from djet_ros.lab.scenes import make_scene
from djet_ros.odometry.frame import Frame
from djet_ros.odometry.result import camera_motion, OdometryResult
from djet_ros.odometry.scale import (
    ConstantScale,
    Length,
    RelativeScale,
    Scale,
    scale_source,
    ScaleSource,
    SpeedScale,
)
from djet_ros.odometry.scale_filter import ScaleFilter
from djet_ros.odometry.structure import TrackScale
from djet_ros.odometry.uncertainty import motion_covariance, PathCovariance
from djet_ros.odometry.visual_odometry import VisualOdometry
from djet_ros.recordings.datasets import open_sequence
import numpy as np
import pytest

ESTIMATOR = EstimatorConfig(max_features=800)

# A camera that accelerates, brakes and turns: metres and radians in a tenth of a second.
LENGTHS = [0.2, 0.2, 0.25, 0.3, 0.36, 0.36, 0.3, 0.22, 0.16, 0.16, 0.2, 0.26]


@pytest.fixture(scope='module')
def cards():
    return Cards()


def steps(metres=LENGTHS):
    return [pose(x=0.8 * one, z=0.6 * one, yaw=0.01 * (-1)**i) for i, one in enumerate(metres)]


class Drive:
    """An odometry, a camera among the cards, and a clock."""

    def __init__(self, cards, source=None, **config):
        self.cards, self.here, self.ns = cards, np.eye(4), 0
        self.odometry = VisualOdometry(ESTIMATOR, OdometryConfig(**config), source)
        self.look()

    def look(self, gap_ns=10**8):
        frame = self.cards.frame(0.0, self.here, noise=self.ns // 10**8)
        self.ns += gap_ns
        return self.odometry.process(Frame(frame.gray, frame.K, self.ns, 'camera'))

    def go(self, moves):
        results = []
        for move in moves:
            self.here = self.here @ move
            results.append(self.look())
        return results


def lengths(results):
    return np.array([np.linalg.norm(result.motion[:3, 3]) for result in results])


def test_before_the_first_frame_there_are_neither_landmarks_nor_a_calibration():
    odometry = VisualOdometry()
    assert odometry.landmarks().shape == odometry.landmarks(settled=True).shape == (0, 3)
    assert odometry.calibration is None


def test_the_first_step_is_the_unit_of_all_that_follow(cards):
    results = Drive(cards).go(steps())
    assert lengths(results)[0] == pytest.approx(1)
    assert lengths(results) * LENGTHS[0] == pytest.approx(np.array(LENGTHS), rel=0.03)
    assert all(result.scale_kind is Scale.RELATIVE for result in results)


def test_a_speed_of_zero_is_ignored_while_images_show_motion(cards):
    speeds = SpeedScale()
    for ns in range(0, 2 * 10**9, 10**8):
        speeds.add_speed(ns, 0.0)
    drive = Drive(cards, speeds, scale='speed')
    slipping = drive.go(steps(LENGTHS[:4]))
    assert all(result.scale_kind is Scale.RELATIVE and not result.measured for result in slipping)
    assert 'standstill while the images show motion' in speeds.why_unknown(drive.ns)
    # Metres are known as soon as the wheels turn.
    speeds.reset()
    for ns in range(drive.ns, drive.ns + 10**9, 10**8):
        speeds.add_speed(ns, LENGTHS[4] * 10)
    driving = drive.go(steps(LENGTHS[:5])[4:])
    assert driving[0].scale_kind is Scale.METRIC and driving[0].measured
    assert lengths(driving)[0] == pytest.approx(LENGTHS[4], rel=0.1)


def test_a_shaking_rotation_away_from_landmarks_keeps_the_scale(cards):
    drive = Drive(cards)
    before = drive.go(steps(LENGTHS[:4]))
    # Half of the landmarks are out of view for so many frames that, were each one a keyframe, all
    # keyframes of the window would be replaced.
    still = drive.go([pose(yaw=turn) for turn in (
        *[0.06] * 6, *[0.015 * (-1)**i for i in range(2 * WINDOW_TUNING.keyframes)],
        *[-0.06] * 5)])
    assert all(result.status is Status.NO_PARALLAX for result in still)
    assert not any(result.stationary or result.keyframe for result in still)
    after = drive.go(steps(LENGTHS[4:8]))
    assert lengths(before + after) * LENGTHS[0] == pytest.approx(np.array(LENGTHS[:8]), rel=0.03)


def test_landmarks_take_over_from_another_scale_while_running(cards):
    drive = Drive(cards, scale='constant', scale_value=1.0)
    drive.go(steps()[:2])
    for scale in ('structure', 'none', 'structure'):
        config = OdometryConfig(scale=scale)
        drive.odometry.configure(ESTIMATOR, config, scale_source(config))
        results = drive.go(steps(LENGTHS[:4]))
        assert all(result.status in TRACKED for result in results)
        assert all((result.keyframe is None) == (scale == 'none') for result in results)
        if scale == 'structure':
            ratios = lengths(results) / LENGTHS[:4]
            assert ratios == pytest.approx(np.full(4, ratios[0]), rel=0.03)


def test_an_odometry_that_never_had_a_window_tracks(cards):
    for scale in ('none', 'constant'):
        results = Drive(cards, scale=scale, scale_value=1.0).go(steps()[:3])
        assert all(result.status in TRACKED for result in results[1:])


def test_the_sigma_of_a_step_is_that_of_its_parallax_and_not_of_the_unit(cards):
    results = Drive(cards).go(steps())[1:]
    lengths_of, sigmas = [], []
    for result in results:
        along = result.motion[:3, 3] / np.linalg.norm(result.motion[:3, 3])
        lengths_of.append(result.scale)
        sigmas.append(np.sqrt(along @ result.motion_covariance[:3, :3] @ along) / result.scale)
    assert all(1e-4 < sigma < 0.1 for sigma in sigmas)
    # The error of the first step is in all of them.
    ratios = np.array(lengths_of) / LENGTHS[1:]
    off = ratios / np.average(ratios, weights=np.array(sigmas)**-2) - 1
    assert np.all(np.abs(off) < 3.5 * np.array(sigmas))


def test_an_ambiguous_pair_that_agrees_with_the_landmarks_keeps_the_scale(cards):
    estimator, here = TwoViewEstimator(ESTIMATOR), np.eye(4)
    true_lengths = [*[0.32] * 6, 0.46, 0.46, 0.32]
    views, scale = [], TrackScale()
    for number, way in enumerate([0, *true_lengths]):
        here = here @ pose(x=way)
        frame = cards.frame(0.0, here, noise=number)
        views.append(estimator.view(frame.gray, frame.K))
    pairs = [estimator.estimate(*views[n:n + 2]) for n in range(len(true_lengths))]
    doubtful = pairs[-2]
    # Far points move as much as near ones, and the other way round.
    moved = doubtful.y_opt - doubtful.x
    by_shift = np.argsort(moved[:, 0], kind='stable')
    moved[by_shift] = moved[by_shift[::-1]]
    wrong = replace(doubtful, y_opt=doubtful.x + moved)
    turned = pose(yaw=0.01)
    found, kept = [], []
    for pair in doubtful, wrong:
        scale.configure(ESTIMATOR, RelativeScale(), 0.05)
        scale.reset()
        scale.begin(views[0])
        for n, known in enumerate(pairs[:-2]):
            scale.of_step((n * 10**8, (n + 1) * 10**8), views[n + 1], known)
        variance = scale._filter.variance
        scale.bridge((7 * 10**8, 8 * 10**8), views[8], pair, turned)
        kept.append(not scale.is_new and scale._filter.variance > variance)
        found.append(scale.of_step((8 * 10**8, 9 * 10**8), views[9], pairs[-1]))
    lengths = [step.length.value for step in found]
    assert lengths[0] == pytest.approx(1, abs=0.04)
    # Interrupted: the camera was faster before, but what it sees is as far away as it was.
    assert lengths[1] == pytest.approx(1, abs=0.04)
    assert kept == [True, False]
    # A share of what was missed is made up for: the way of the bridged pair, and its turn.
    share = WINDOW_TUNING.correction_share
    corrected = found[0].window_motion
    assert corrected[0, 3] == pytest.approx(1 + share * 0.46 / 0.32, abs=0.05)
    assert rotation_log(corrected[:3, :3])[1] == pytest.approx(
        -share * rotation_log(turned[:3, :3])[1], rel=0.05)


def test_standing_still_and_rotating_in_place_keep_the_scale(cards):
    drive = Drive(cards)
    before = lengths(drive.go(steps()[:5]))
    rest = drive.go([np.eye(4)] * 3)
    assert all(result.stationary for result in rest)
    turns = drive.go([pose(yaw=0.03)] * 2 + [pose(yaw=-0.03)] * 2)
    assert all(result.status in TRACKED for result in turns)
    after = lengths(drive.go([pose(x=0.16, z=0.12)] * 3))
    assert before[0] == pytest.approx(1)
    assert after == pytest.approx(1, rel=0.05)


def test_a_rotation_in_place_does_not_change_the_expected_length(cards):
    drive = Drive(cards)
    drive.go(steps()[:5])
    expected = drive.odometry._scale._speed
    turns = drive.go([pose(yaw=0.02)] * 2 + [pose(yaw=-0.02)] * 2)
    assert all(result.status is Status.NO_PARALLAX for result in turns)
    assert drive.odometry._scale._speed == expected


def rotated_on_the_spot(seed: int) -> tuple[VisualOdometry, list[OdometryResult]]:
    """Go on for six frames indoors, and then rotate by 100 degrees."""
    scene = make_scene('indoor', seed, (320, 240))
    poses, turn = list(scene.trajectory(6)), pose(yaw=0.06)
    for _ in range(30):
        poses.append(poses[-1] @ turn)
    odometry = VisualOdometry(ESTIMATOR, OdometryConfig())
    results = [odometry.process(Frame(scene.render(there, i), scene.K, 10**9 + i * 10**8))
               for i, there in enumerate(poses)]
    assert all(result.scale_known for result in results[1:])
    return odometry, results


@pytest.mark.slow
def test_in_a_rotation_landmarks_carry_the_scale_beyond_the_field_of_view():
    """They come into view one after the other; in one of these rooms a wall is nearly blank."""
    worst = []
    for seed in range(5):
        _, results = rotated_on_the_spot(seed)
        factors = [result.common.variances[0] for result in results[1:23] if result.common]
        assert len(factors) == 22
        worst.append(max(factors))
    assert np.median(worst) < 0.003 and max(worst) < 0.04


@pytest.mark.slow
def test_a_rotation_beyond_all_landmarks_leaves_the_scale_to_one_guess():
    odometry, results = rotated_on_the_spot(0)
    # At a blank corner there are too few landmarks to determine a length, and a usual step is the
    # guess, once for all frames without any.
    assert any(result.status not in TRACKED for result in results[23:])
    assert odometry._scale._filter.variance < 0.36 + 0.25 + 0.02


@pytest.mark.parametrize('way', [0.004, 0.008, 0.012])
def test_motion_too_slow_for_parallax_from_frame_to_frame_accumulates(cards, way):
    drive, slow = Drive(cards), [pose(x=way, yaw=0.001 * (-1)**i) for i in range(30)]
    start = drive.go(steps(LENGTHS[:4]))[-1].pose
    results = drive.go(slow)
    # Unless new landmarks are needed, and the reference frame waits for it.
    assert sum(result.status is Status.OK for result in results) < 3
    assert all(result.status in TRACKED for result in results)
    gone = (np.linalg.inv(start) @ results[-1].pose)[:3, 3] * LENGTHS[0]
    assert np.linalg.norm(gone - [30 * way, 0, 0]) < 0.1 * 30 * way
    sigma = np.sqrt(np.linalg.eigvalsh(results[-1].pose_covariance[:3, :3])[-1]) * LENGTHS[0]
    assert np.linalg.norm(gone - [30 * way, 0, 0]) < 4 * sigma


@pytest.mark.parametrize('way', [0.004, 0.008, 0.012])
def test_motion_too_slow_for_parallax_accumulates_before_there_are_landmarks(cards, way):
    speed = SpeedScale()
    for i in range(80):
        speed.add_speed(i * 10**8, way * 10)
    results = Drive(cards, speed, scale='speed').go([
        pose(x=way, yaw=0.0005 * (-1)**i) for i in range(40)])
    assert sum(result.status is Status.OK for result in results) < 3
    gone = results[-1].pose[:3, 3]
    assert np.linalg.norm(gone - [40 * way, 0, 0]) < 0.1 * 40 * way
    sigma = np.sqrt(np.linalg.eigvalsh(results[-1].pose_covariance[:3, :3])[-1])
    assert np.linalg.norm(gone - [40 * way, 0, 0]) < 4 * sigma


class Previewed(TrackScale):
    """A scale that previews each step before it is made."""

    lengths: ClassVar[list[Length]] = []
    _previews = False

    def of_step(self, *arguments):
        if not self._previews:
            self._previews = True
            self.lengths.append(self.preview(*arguments).length)
            self._previews = False
        return super().of_step(*arguments)


def test_a_preview_of_a_step_leaves_the_track_as_it_is(cards):
    """Of all kinds of pairs: those with parallax, and those without."""
    plain, previewing = Drive(cards), Drive(cards)
    previewing.odometry._scale.__class__ = Previewed
    moves = [*steps(LENGTHS[:6]), *[pose(x=0.01)] * 4, *[pose(yaw=0.06)] * 8, *steps(LENGTHS[:3])]
    for one, other in zip(plain.go(moves), previewing.go(moves), strict=True):
        assert np.array_equal(one.pose, other.pose)
        assert np.array_equal(one.pose_covariance, other.pose_covariance)
    assert sum(length.known for length in Previewed.lengths) > 12


def test_a_camera_that_stops_after_it_moved_a_little_is_seen_to_stand(cards):
    """Also if its reference frame was kept for parallax, as new landmarks were needed."""
    drive = Drive(cards)
    drive.go([*steps(LENGTHS[:4]), *[pose(yaw=0.06)] * 8])
    assert drive.odometry._scale.needs_parallax
    drive.go([pose(x=0.03)] * 2)
    stopped = drive.go([np.eye(4)] * 30)
    assert all(result.status is Status.NO_PARALLAX for result in stopped)
    assert all(result.stationary for result in stopped[22:])


def test_a_bad_frame_does_not_change_the_scale(cards):
    drive = Drive(cards)
    drive.go(steps()[:4])
    drive.here = drive.here @ pose(x=0.16, z=0.12)
    black = np.zeros((240, 320), np.uint8)
    drive.ns += 10**8
    bad = drive.odometry.process(Frame(black, drive.cards.frame(0).K, drive.ns, 'camera'))
    assert bad.status not in TRACKED
    bridged = drive.go([pose(x=0.16, z=0.12)])[0]
    assert np.linalg.norm(bridged.motion[:3, 3]) == pytest.approx(2, rel=0.05)


def test_the_usual_speed_is_a_mean_over_half_a_second_unless_a_step_is_well_known(cards):
    drive = Drive(cards)
    drive.go([pose(x=0.16, z=0.12)] * 6)
    scale = drive.odometry._scale
    assert scale._speed == pytest.approx(10, rel=0.03)  # units per second
    # Half as fast, by a rough estimate, and then by images.
    rough = WindowStep(np.eye(3), np.array([0, 0, 0.5]), 0.5, 0.2, np.eye(6), np.eye(4))
    scale._wander(rough, 0.1, parallax=True)
    assert scale._speed == pytest.approx(10 - 5 * (1 - np.exp(-0.1 / 0.5)), rel=0.03)
    drive.go([pose(x=0.08, z=0.06)])
    assert scale._speed == pytest.approx(5, rel=0.03)


@pytest.mark.slow
def test_the_scale_lasts_in_a_fast_hand_with_a_rolling_shutter(freiburg1_rpy):
    """
    A path that shrinks to a point fits the truth by a common scale as well as this one.

    The unit wanders by chance, so it is averaged over the sequence as recorded, mirrored, and
    backwards.
    """
    sequence = open_sequence(freiburg1_rpy)
    frames = [sequence.frame(index) for index in range(200)]
    poses = sequence.poses[:200]
    backwards = [replace(frame, stamp_ns=earlier.stamp_ns)
                 for frame, earlier in zip(frames[::-1], frames)]
    wandering = [unit_wanders_by(frames, poses),
                 unit_wanders_by([mirrored(frame) for frame in frames], poses),
                 unit_wanders_by(backwards, poses[::-1])]
    # Ten was measured over five such variants; without what holds it, 100,000.
    assert np.exp(np.mean(np.log(wandering))) < 100


def mirrored(frame):
    """Return a frame seen in a mirror beside the camera."""
    K = frame.K.copy()
    K[0, 2] = frame.gray.shape[1] - 1 - K[0, 2]
    return replace(frame, gray=np.ascontiguousarray(frame.gray[:, ::-1]), K=K)


def unit_wanders_by(frames, poses):
    """Return the largest over the smallest unit of five parts of a sequence."""
    odometry, units = VisualOdometry(), []
    for index, frame in enumerate(frames):
        result = odometry.process(frame)
        if index and result.status is Status.OK:
            true = np.linalg.norm((np.linalg.inv(poses[index - 1]) @ poses[index])[:3, 3])
            units.append((index, true / np.linalg.norm(result.motion[:3, 3])))
    index, unit = np.array(units).T
    medians = [np.median(unit[index * 5 // len(frames) == part]) for part in range(5)]
    return max(medians) / min(medians)


def test_after_a_gap_the_old_speed_is_the_guess(cards):
    drive = Drive(cards, max_gap=0.5)
    drive.go([pose(x=0.16, z=0.12)] * 4)
    drive.look(gap_ns=10**9)
    after = drive.go([pose(x=0.16, z=0.12), pose(x=0.08, z=0.06)])
    assert lengths(after)[0] == pytest.approx(1, rel=0.05)
    assert lengths(after)[1] == pytest.approx(0.5, rel=0.05)


def test_without_any_parallax_there_is_no_unit_yet(cards):
    drive = Drive(cards)
    turns = drive.go([pose(yaw=0.03)] * 2)
    assert all(result.scale_kind is Scale.UNKNOWN for result in turns)
    assert drive.go(steps()[:2])[0].scale == pytest.approx(1)


def test_a_speed_makes_the_scale_metric_and_landmarks_carry_it_without_speeds(cards):
    speeds = SpeedScale()
    drive = Drive(cards, speeds)
    measured = []
    for move, way in zip(steps()[:6], LENGTHS):
        for stamp in (drive.ns + 1, drive.ns + 10**8):
            speeds.add_speed(stamp, way / 0.1)
        measured += drive.go([move])
    assert lengths(measured)[2:] == pytest.approx(np.array(LENGTHS[2:6]), rel=0.04)
    silent = []
    for move in [*steps()[6:], *[pose(x=0.12, z=0.09)] * 2]:
        drive.here = drive.here @ move
        silent.append(drive.look(gap_ns=3 * 10**8))
    assert lengths(silent)[-1] == pytest.approx(0.15, rel=0.06)
    assert all(result.scale_kind is Scale.METRIC for result in silent)
    shares = [sigma(result) / result.scale for result in silent]
    assert shares[-1] > sigma(measured[-1]) / measured[-1].scale


def sigma(result):
    along = result.motion[:3, 3] / np.linalg.norm(result.motion[:3, 3])
    return float(np.sqrt(along @ result.motion_covariance[:3, :3] @ along))


def test_one_outlier_of_the_speeds_does_not_change_the_scale(cards):
    speeds = SpeedScale()
    drive = Drive(cards, speeds)
    speeds.add_speed(0, 2.0)
    results = []
    for number in range(8):
        speeds.add_speed(drive.ns + 5 * 10**7, 40.0 if number == 5 else 2.0)
        speeds.add_speed(drive.ns + 10**8, 2.0)
        results += drive.go([pose(x=0.16, z=0.12)])
    assert lengths(results) == pytest.approx(0.2, rel=0.06)


def test_the_same_frames_give_the_same_scale_to_the_last_bit(cards):
    first, second = (Drive(cards, RelativeScale()).go(steps()[:6]) for _ in range(2))
    for one, other in zip(first, second):
        assert np.array_equal(one.pose, other.pose)
        assert np.array_equal(one.pose_covariance, other.pose_covariance)


def test_the_window_keeps_few_views(cards):
    drive = Drive(cards)
    drive.go([pose(x=0.16, z=0.12, yaw=0.004)] * 14)
    window = drive.odometry._scale._window
    assert len(window._views) <= 7
    assert len(window._joint.landmarks) < 2000
    assert window.landmarks().shape[1] == 3
    assert (window.landmarks()[:, 2] > 0).mean() > 0.9


def test_landmarks_leave_the_window_once_each_at_their_true_position(cards):
    drive, depths = Drive(cards), []
    for number in range(36):
        result, = drive.go([pose(x=0.32 * (-1)**(number // 6), z=0.03)])
        here = result.pose[:3, :3] @ drive.odometry.landmarks(settled=True).T
        depths.append((here.T + result.pose[:3, 3])[:, 2] * np.hypot(0.32, 0.03))
    left = [part for part in depths if len(part)]
    assert 2 <= len(left) < 30  # not in each frame, but as they leave the view
    off = np.abs(np.concatenate(left)[:, None] / DEPTHS - 1).min(1)
    assert len(off) > 50
    assert np.median(off) < 0.03


def test_landmarks_are_those_of_the_reference_frame_while_it_waits(cards):
    drive, kept = Drive(cards), 0
    drive.go([pose(x=0.32 * (-1)**(number // 6), z=0.03) for number in range(14)])
    for _ in range(24):
        result, = drive.go([pose(yaw=0.02)])
        here = drive.odometry.reference_pose
        assert result.status is Status.NO_PARALLAX
        depths = (drive.odometry.landmarks() @ here[:3, :3].T + here[:3, 3])[:, 2]
        off = np.abs(depths[:, None] * np.hypot(0.32, 0.03) / DEPTHS - 1).min(1)
        assert np.median(off) < 0.003
        if not drive.odometry.newest_is_reference:
            kept += 1
            assert not np.array_equal(here, result.pose)
            assert len(drive.odometry.landmarks(settled=True)) == 0
    assert kept > 3


def test_a_pair_with_other_depths_than_the_landmarks_disagrees(cards):
    """Sideways any depth fits two frames, as the epipolar lines are horizontal."""
    true_lengths = [pose(x=0.32)] * 8
    pair = Drive(cards).go(true_lengths)[-1].relative
    drive = Drive(cards)
    drive.go(true_lengths[:-1])
    scale = drive.odometry._scale  # as it was before the last frame
    aside = Pose(np.eye(3), np.array([-1.0, 0.0, 0.0]))
    assert scale.agrees(aside, pair.x, pair.y_opt)
    assert scale.agrees(Pose(aside.R, -aside.t), pair.x, pair.y_opt)  # chirality is not tested
    nearer = np.random.default_rng(6).uniform(0.2, 3, len(pair.x))[:, None]
    wrong = pair.x + nearer * (pair.y_opt - pair.x)
    assert scale.agrees(aside, pair.x, wrong) is False
    few = np.arange(4)
    assert scale.agrees(aside, pair.x[few], wrong[few]) is None


def test_the_depths_of_landmarks_decide_on_the_status_of_a_pair(cards):
    true_lengths = [pose(x=0.32)] * 8
    pair = Drive(cards).go(true_lengths)[-1].relative
    turned, drive = Drive(cards), Drive(cards)
    for one in turned, drive:
        one.go(true_lengths[:-1])
    verified, aside = drive.odometry._scale.verified, Pose(np.eye(3), np.array([-1.0, 0, 0]))
    assert pair.status is Status.OK and verified(pair, CARDS_K) is pair
    # Other depths than before: it may be the motion of something else.
    nearer = np.random.default_rng(6).uniform(0.2, 3, len(pair.x))[:, None]
    wrong = replace(pair, y_opt=pair.x + nearer * (pair.y_opt - pair.x))
    doubted = verified(wrong, CARDS_K)
    assert doubted.status is Status.AMBIGUOUS and not np.isfinite(doubted.covariance_6).any()
    # Of several motions the only one that gives the known depths is the true one.
    other = Pose(np.eye(3), np.array([0, 0, -1.0]))
    for one, rivals, status in (
            (pair, (other,), Status.OK), (pair, (other, aside), Status.AMBIGUOUS),
            (pair, (), Status.OK), (wrong, (other,), Status.AMBIGUOUS)):
        rivals = tuple(Rival(rival, 0.0) for rival in rivals)
        assert verified(replace(one, status=Status.AMBIGUOUS, rivals=rivals), CARDS_K
                        ).status is status
    # A rotation, for which the direction of noise was taken.
    turn = pose(yaw=0.02)
    rotated = turned.go([turn])[-1].relative
    found = verified(replace(rotated, status=Status.OK, t=aside.t), CARDS_K)
    assert found.status is Status.NO_PARALLAX and not found.t.any()
    assert np.allclose(found.R, turn[:3, :3].T, atol=1e-3)
    # Landmarks do not tell bodies apart, nor what there are too few matches for.
    for status in Status.TWO_MOTIONS, Status.TOO_FEW_MATCHES, Status.NO_PARALLAX:
        undecided = replace(pair, status=status)
        assert verified(undecided, CARDS_K) is undecided


def test_landmarks_observed_between_keyframes_contradict_other_depths_too(cards):
    """In slow motion only the first two frames are kept, though many confirmed their depths."""
    true_lengths = [pose(x=0.04)] * 7
    pair = Drive(cards).go(true_lengths)[-1].relative
    drive = Drive(cards)
    drive.go(true_lengths[:-1])
    window = drive.odometry._scale._window
    assert len(window._views) == 3
    aside = Pose(np.eye(3), np.array([-1.0, 0.0, 0.0]))
    agree, asked = window.count_agreeing(aside, pair.x, pair.y_opt)
    assert asked > 50 and agree > 0.9 * asked


def test_parallax_that_depths_do_not_confirm_is_noise(cards):
    """The residual of a blurred rotation has any size and sign, wherever landmarks are."""
    true_lengths = [pose(x=0.16, z=0.12)] * 8
    pair = Drive(cards).go(true_lengths)[-1].relative
    drive = Drive(cards)
    drive.go(true_lengths[:-1])
    scale = drive.odometry._scale  # as it was before the last frame
    assert not scale.lacks_parallax(pair)
    length, error = scale._window.pair_length(pair)
    assert length == pytest.approx(1, rel=0.05) and error < 0.02
    rng, none = np.random.default_rng(5), 0
    for _ in range(20):
        any_way = rng.normal(0, 1, len(pair.x))[:, None]
        none += scale.lacks_parallax(replace(pair, y_opt=pair.x + any_way * (pair.y_opt - pair.x)))
    assert none >= 19
    # Without landmarks it is unknown.
    scale.reset()
    scale.begin(drive.odometry._reference.view)
    assert not scale.lacks_parallax(pair)


def test_another_estimator_continues_at_the_last_speed(cards):
    drive = Drive(cards)
    drive.go([pose(x=0.16, z=0.12)] * 3)
    drive.odometry.configure(EstimatorConfig(max_features=600), OdometryConfig(), RelativeScale())
    assert lengths(drive.go([pose(x=0.16, z=0.12)] * 2)) == pytest.approx(1, rel=0.05)


def test_the_measurement_of_a_landmark_does_not_depend_on_its_prediction(cards):
    drive = Drive(cards)
    drive.go([pose(x=0.16, z=0.03)] * 4)
    window = drive.odometry._scale._window
    found = window._joint.landmarks
    before, seen = found.minima[:, -1].copy(), found.observed[:, -1].copy()
    focal, R = window._joint.K[0, 0], window._joint.poses.R.copy()
    for pixels in (-1.0, -0.5, 0.5, 1.0):
        window._joint.poses.R[-1] = rotation_exp(np.array([0.0, pixels / focal, 0.0])) @ R[-1]
        found.observed[:, -1] = False
        window._observe_landmarks()
        both = seen & found.observed[:, -1]
        assert both.sum() > 0.5 * seen.sum()
        moved = (found.minima[both, -1] - before[both])[:, 0]
        assert abs(np.median(moved)) < 0.06 * abs(pixels)


def test_landmarks_are_not_chosen_by_the_errors_of_their_own_depths(cards):
    estimator, rng = TwoViewEstimator(ESTIMATOR), np.random.default_rng(2)
    views = [estimator.view(frame.gray, frame.K) for frame in (
        cards.frame(0.0, pose(x=x), noise=n) for n, x in enumerate((0, 0.3)))]
    pair = estimator.estimate(*views)
    factors = np.exp(rng.normal(0, 0.5, len(pair.x)))
    wrong = replace(pair, y_opt=pair.x + factors[:, None] * (pair.y_opt - pair.x))
    window = Window(ESTIMATOR, replace(WINDOW_TUNING, landmarks=40))
    window.start(views[0])
    window._append(views[1], wrong, 1.0)
    window._create_landmarks(wrong, 1.0)
    at = {tuple(x): factor for x, factor in zip(pair.x, factors)}
    chosen = np.log([at[tuple(x)] for x in window._joint.landmarks.anchor_pixels])
    assert len(chosen) == 40
    assert abs(chosen.mean() - np.log(factors[pair.inliers]).mean()) < 3 * 0.5 / np.sqrt(40)


@pytest.mark.parametrize('seed', range(3))
def test_each_cell_gets_a_landmark_before_any_gets_another_and_near_ones_come_first(seed):
    rng, side = np.random.default_rng(seed), 40
    x = rng.uniform(0, (800, 400), (3000, 2))
    near = x[:, 0] > 400
    # The right half is 64 times as near.
    rho = np.where(near, 0.5, 0.5 / 64)
    present = (0.5 + np.arange(20)[:, None] * [1, 0]) * side  # in each cell of the first row
    cells, free = np.floor(x / side) @ [1, 20], x[:, 1] >= side
    one_each = choose_landmarks(x, rho, present, side, 180)
    assert free[one_each].all()
    assert sorted(cells[one_each]) == list(range(20, 200))
    # Those with near ones around them.
    assert (x[choose_landmarks(x, rho, present, side, 72), 0] > 400 - 3 * PATCH).all()
    assert not near[one_each[120:]].any()
    two_each = choose_landmarks(x, rho, present, side, 380)
    assert (np.bincount(cells[two_each].astype(int)) == np.where(np.arange(200) < 20, 1, 2)).all()
    everything = choose_landmarks(x, rho, present, side, 9000)
    assert sorted(everything) == list(range(3000))
    assert not len(choose_landmarks(x, rho, present, side, -3))


def test_among_equally_near_points_the_first_in_a_cell_becomes_a_landmark():
    rng = np.random.default_rng(4)
    x, rho = rng.uniform(0, (800, 400), (3000, 2)), 2**rng.uniform(-3.4, -2.6, 3000)
    _, first = np.unique(np.floor(x / 40) @ [1, 20], return_index=True)
    chosen = choose_landmarks(x, rho, np.empty((0, 2)), 40, 200)
    assert chosen.tolist() == sorted(first)


def test_depth_around_a_patch_is_that_of_its_next_but_one_neighbours():
    rng = np.random.default_rng(3)
    points, values = rng.uniform(0, (600, 180), (300, 2)), rng.normal(size=300)
    cells = np.floor((points - np.minimum(points.min(0), 0)) / PATCH)
    apart = np.abs(cells[:, None] - cells).max(2)
    expected = [values[mask].mean() if mask.any() else values.mean() for mask in apart == 2]
    assert surrounding_means(points, values) == pytest.approx(expected)
    assert not len(surrounding_means(points[:0], values[:0]))


@pytest.mark.slow
@pytest.mark.parametrize('seed', [1, 3])
def test_pauses_with_hardly_any_motion_do_not_lose_the_scale(seed: int) -> None:
    """A hand-held camera pauses, and new landmarks have hardly any parallax."""
    scene = make_scene('handheld', seed, (480, 360))
    poses, odometry = scene.trajectory(80), VisualOdometry(EstimatorConfig(max_features=1000))
    found = [odometry.process(Frame(scene.render(pose, i), scene.K, i * 10**8)).motion[:3, 3]
             for i, pose in enumerate(poses)][1:]
    lengths, true_lengths = np.linalg.norm([found, np.diff(poses[:, :3, 3], axis=0)], axis=2)
    moved = (lengths > 0) & (true_lengths > 0.005)
    assert np.std(np.log(lengths[moved] / true_lengths[moved])) < np.log(2)


@pytest.mark.slow
@pytest.mark.parametrize('seed', [2, 3, 5])
def test_reversing_while_turning_does_not_lose_the_scale(seed: int) -> None:
    """At the turning point images determine no direction, and the usual speed is far too high."""
    scene, odometry = make_scene('indoor', seed, (480, 360)), VisualOdometry(
        EstimatorConfig(max_features=1000))
    first, frames = scene.trajectory(2)[0], np.arange(30)
    sideways = 0.004 * (frames - 14.3)**2
    found = []
    for frame, metres in enumerate(sideways):
        camera = np.eye(4)
        camera[:3, :3] = rotation_exp(np.radians([0.0, frame - 15.0, 0.0]))
        camera[:3, 3] = metres, 0, -metres / 2
        image = scene.render(first @ camera, frame)
        result = odometry.process(Frame(image, scene.K, (frame + 1) * 10**8))
        found.append(np.linalg.norm(result.motion[:3, 3]))
    ratios = found[1:] / np.abs(np.diff(sideways))
    assert np.median(ratios[-8:]) == pytest.approx(np.median(ratios[1:9]), rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize('seed', [0, 1, 4, 6])
def test_fast_rotations_keep_the_scale(seed: int) -> None:
    """At 15 degrees a frame landmarks leave the view after a few, at times all at once."""
    scene, odometry = make_scene('whip', seed, (480, 360)), VisualOdometry()
    poses = scene.trajectory(36)
    found = [odometry.process(Frame(scene.render(pose, i), scene.K, i * 10**8)).motion[:3, 3]
             for i, pose in enumerate(poses)][1:]
    lengths, true_lengths = np.linalg.norm([found, np.diff(poses[:, :3, 3], axis=0)], axis=2)
    ratios = lengths / true_lengths
    assert np.abs(np.log(ratios / ratios[0])).max() < np.log(1.1)


@pytest.mark.parametrize('frames_per_second', [10, 30])
@pytest.mark.parametrize('size', [0.1, 0.025])
def test_a_slow_camera_is_metric_at_any_frame_rate(cards, size, frames_per_second):
    """At 30 frames a second each step is 7 mm, or 1.75 mm, and the speed is known to a mm."""
    speeds = SpeedScale()
    odometry, here, ns, results = VisualOdometry(ESTIMATOR, OdometryConfig(), speeds), 0.0, 0, []
    for number in range(25):
        frame = cards.frame(0.0, pose(x=here / size), noise=number)
        if number < 22:
            speeds.add_speed(ns, 2.1 * size)
        results.append(odometry.process(Frame(frame.gray, frame.K, ns, 'camera')))
        here += 2.1 * size / frames_per_second
        ns += 10**9 // frames_per_second if number < 21 else 7 * 10**8
    moved = results[1:]
    assert all(result.scale_kind is Scale.METRIC for result in moved)
    assert not moved[-1].measured
    assert lengths(moved) == pytest.approx(np.full(24, 2.1 * size / frames_per_second), rel=0.05)


def test_speeds_of_zero_do_not_observe_the_scale(cards):
    speeds = SpeedScale()
    drive = Drive(cards, speeds)
    speeds.add_speed(0, 0.0)
    for _ in range(4):  # the wheels slip, or an object fills the image and moves
        speeds.add_speed(drive.ns + 10**8, 0.0)
        result, = drive.go([pose(x=0.16, z=0.12)])
        assert result.scale_kind is Scale.RELATIVE and not result.measured
        assert np.linalg.eigvalsh(result.motion_covariance)[0] > 0
    speeds.add_speed(drive.ns + 1, 2.0)
    speeds.add_speed(drive.ns + 10**8, 2.0)
    drive.go([pose(x=0.16, z=0.12)])
    drive.here = drive.here @ pose(x=0.16, z=0.12)
    silent = drive.look(gap_ns=7 * 10**8)
    assert not silent.measured
    assert np.linalg.norm(silent.motion[:3, 3]) == pytest.approx(0.2, rel=0.05)


def test_the_error_of_a_constant_length_is_common_to_all_steps(cards):
    frame, scale, count = cards.frame(0.0), TrackScale(), 100
    view = TwoViewEstimator(ESTIMATOR).view(frame.gray, frame.K)
    scale.configure(ESTIMATOR, ConstantScale(1.0, 0.05), 0.05)
    ahead = RelativePose(Status.OK, t=np.array([0, 0, -1.0]), covariance_6=np.eye(6) * 1e-12)
    here, path = np.eye(4), PathCovariance()
    for number in range(count):
        length = scale.of_step((number * 10**8, (number + 1) * 10**8), view, ahead).length
        assert length.sigma == pytest.approx(0.05)
        step = camera_motion(ahead, length.value)
        path = path.moved_by_pair(here, step, motion_covariance(ahead, length.own), length.common)
        here = here @ step
    assert here[2, 3] == pytest.approx(count)
    assert np.sqrt(path.pose[2, 2]) == pytest.approx(0.05 * count, rel=1e-3)


def test_after_a_gap_a_standing_camera_is_no_longer_metric(cards):
    speeds = SpeedScale()
    drive = Drive(cards, speeds, max_gap=2.0)
    for _ in range(3):
        speeds.add_speed(drive.ns, 2.0)
        speeds.add_speed(drive.ns + 10**8, 2.0)
        drive.go([pose(x=0.16, z=0.12)])
    before = drive.look(gap_ns=10**9)
    drive.look(gap_ns=3 * 10**9)
    after = drive.look()
    assert before.stationary and after.stationary
    assert before.scale_kind is Scale.METRIC
    assert after.scale_kind is Scale.RELATIVE


@pytest.mark.parametrize('source', [RelativeScale(), ConstantScale(1.2)])
def test_a_rotation_without_landmarks_has_the_uncertainty_of_a_usual_step(source):
    """Without landmarks the newest frame in the window is determined by rounding only."""
    ahead = np.array([0, 0, -1.0])
    added = [WindowStep(np.eye(3), length * ahead, length, sigma, sigma**2 * np.eye(6), np.eye(4))
             for length, sigma in ((1.0, 1e-3), (0.02, 800.0))]
    source.exact, source.uses_landmarks = False, True
    scale = TrackScale()
    scale.configure(ESTIMATOR, source, 0.0)
    scale._window = SimpleNamespace(
        is_new=False, determines_translation=True,
        record_published=lambda motion: None, add=lambda view, relative, guess: added.pop(0))
    known = {'covariance_5': np.eye(5) * 1e-8, 'covariance_6': np.eye(6) * 1e-8}
    scale.of_step((0, 10**8), None, RelativePose(Status.OK, t=ahead, **known))
    step = scale.of_step((10**8, 2 * 10**8), None, RelativePose(Status.NO_PARALLAX, **known))
    usual = 1.2 if isinstance(source, ConstantScale) else 1.0
    # The expected length of the next step stays the same, too.
    assert scale._speed == pytest.approx(10)
    assert step.length.value == pytest.approx(usual)
    assert step.length.sigma >= 0.99 * usual
    assert np.exp(scale._filter.log) == pytest.approx(usual)


def test_motion_and_covariances_without_parallax_are_those_of_the_window():
    ahead, aside = np.array([0, 0, -1.0]), np.array([0.5, 0, 0])
    sure = np.diag([1, 2, 3, 4, 5, 6]) * 1e-6
    added = [WindowStep(np.eye(3), t, float(np.linalg.norm(t)), 1e-3, sure, np.eye(4))
             for t in (ahead, aside)]
    scale = TrackScale()
    scale.configure(ESTIMATOR, RelativeScale(), 0.0)
    scale._window = SimpleNamespace(
        is_new=False, determines_translation=True,
        record_published=lambda motion: None, add=lambda view, relative, guess: added.pop(0))
    known = {'covariance_5': np.eye(5), 'covariance_6': np.eye(6)}
    scale.of_step((0, 10**8), None, RelativePose(Status.OK, t=ahead, **known))
    pair = scale.of_step((10**8, 2 * 10**8), None,
                         RelativePose(Status.NO_PARALLAX, **known)).relative
    assert np.allclose(pair.t, [1, 0, 0])
    # Radians of a direction of half a unit, by errors along the other axes.
    assert np.allclose(pair.covariance_6, np.diag([1, 2, 3, 0, 20, 24]) * 1e-6)
    basis = lift(sphere_tangents(pair.t))
    assert np.allclose(basis @ pair.covariance_5 @ basis.T, pair.covariance_6)


class Ground(ScaleSource):
    """A source of given lengths in metres, one for each second, each with a sigma of 2 %."""

    def __init__(self, metres, alike):
        self.metres, self.correlation_length = metres, alike

    def between(self, start_ns, end_ns):
        metres = self.metres[start_ns // 10**9]
        return Length(metres, 0.02 * metres, True)


def factors(metres, alike):
    """
    Return log factors after each of N lengths, their variances and kept shares (3, N).

    alike: correlation length in metres.
    """
    step = WindowStep(np.eye(3), np.array([0, 0, -1.0]), 1.0, 0.002, np.eye(6) * 1e-6, np.eye(4))
    scale = TrackScale()
    scale.configure(ESTIMATOR, Ground(metres, alike), 0.0)
    # A window with steps of constant length, with a sigma of 0.2 %.
    scale._window = SimpleNamespace(
        is_new=False, determines_translation=True,
        record_published=lambda motion: None, add=lambda view, relative, guess: step)
    ahead = RelativePose(Status.OK, t=np.array([0, 0, -1.0]), covariance_6=np.eye(6) * 1e-12)
    found = []
    for number in range(len(metres)):
        length = scale.of_step((number * 10**9, (number + 1) * 10**9), None, ahead).length
        found.append((scale._filter.log, scale._filter.variance, length.common.kept[0]))
    return np.array(found).T


@pytest.mark.parametrize('step', [1.0, 0.25])
def test_the_variance_of_the_factor_is_consistent_with_correlated_lengths(step):
    """Of steps, in metres, eight in a row have one error."""
    rng, squares = np.random.default_rng(0), {0: [], 8: []}
    for _ in range(60):
        metres = step * np.exp(np.repeat(rng.normal(0, 0.02, 20), 8))
        for alike, ended in squares.items():
            logs, variances, _ = factors(metres, alike * step)
            ended.append((logs[-1] - np.log(step))**2 / variances[-1])
    assert 0.5 < np.mean(squares[8]) < 1.5
    # As independent measurements they would give far too small a variance.
    assert np.mean(squares[0]) > 3


def test_the_kept_share_of_the_error_is_what_updates_leave_of_it():
    rng = np.random.default_rng(1)
    runs = np.array([factors(np.exp(rng.normal(0, 0.02, 4)), alike=0) for _ in range(400)])
    errors, kept = runs[:, 0], runs[0, 2]
    assert kept == pytest.approx([0, 1 / 2, 2 / 3, 3 / 4], abs=0.02)
    for before in range(3):
        one, next_one = errors[:, before], errors[:, before + 1]
        assert one @ next_one / (one @ one) == pytest.approx(kept[before + 1], abs=0.12)


def test_outliers_as_long_as_the_visible_ground_do_not_change_the_scale():
    metres = np.ones(160)
    metres[80:95] = 0.8
    logs, *_ = factors(metres, alike=8)
    assert np.abs(logs).max() < 0.01
    # Longer ones do change it.
    metres[80:] = 0.8
    logs, *_ = factors(metres, alike=8)
    assert logs[-1] == pytest.approx(np.log(0.8), abs=0.02)


def test_single_outliers_do_not_add_up_to_a_change():
    metres = np.ones(160)
    metres[5::3] = 1.5
    logs, *_ = factors(metres, alike=0)
    assert np.abs(logs).max() < 0.01


def test_coarse_lengths_average_out_however_sure_the_factor_is():
    """Each of 150 is off by 20 %, ten times as much as their mean."""
    rng, squares = np.random.default_rng(2), []
    for _ in range(40):
        scale = ScaleFilter()
        for metres in np.exp(rng.normal(0, 0.2, 150)):
            scale.update(Length(metres, 0.2 * metres, True), 1.0, 0.0, 0.1)
        squares.append(scale.log**2 / scale.variance)
        assert np.sqrt(scale.variance) == pytest.approx(0.2 / np.sqrt(150), rel=1e-3)
    assert 0.5 < np.mean(squares) < 1.6


def metric(share=0.05):
    """Return the scale of a track after one length, of 3 m a unit: known to 2 %, and a share."""
    scale = ScaleFilter()
    scale.configure(share)
    scale.update(Length(6.0, 6 * share, True), 2.0, 0.0, 0.1)
    return scale


@pytest.mark.parametrize(('sigma', 'of_units', 'noise'), [
    (0.05, 0.0, 0.02), (np.hypot(0.05, 0.04), 0.0, 0.04), (0.05, 0.03, np.hypot(0.02, 0.03))])
def test_a_factor_is_as_sure_as_both_lengths_without_what_all_have_in_common(
        sigma, of_units, noise):
    """Of lengths with 5 % in common at least 2 % are their own, and average out."""
    scale = ScaleFilter()
    scale.configure(0.05)
    for count in range(1, 6):
        scale.update(Length(3.0, 3 * sigma, True), 2.0, of_units, 0.1)
        assert scale.factor == pytest.approx(1.5)
        assert np.sqrt(scale.variance) == pytest.approx(noise / np.sqrt(count))


def test_metric_lengths_have_the_errors_of_factor_and_source_and_relative_ones_only_their_own():
    scale = ScaleFilter()
    scale.configure(0.05)
    scale.add_noise(0.03**2)
    relative = scale.scaled(2.0, 0.01, False)
    assert (relative.value, relative.metric) == (2.0, False)
    assert relative.sigma == relative.own.sigma == pytest.approx(0.01 * 2)
    # It was never measured, so no source is wrong in it.
    assert relative.common.variances == pytest.approx([0.03**2, 0.0])
    length = metric().scaled(2.0, 0.01, True)
    assert length.value == pytest.approx(6.0) and length.metric
    assert length.sigma == pytest.approx(6 * np.sqrt(0.01**2 + 0.02**2 + 0.05**2))
    assert length.own.sigma == pytest.approx(0.01 * 6)
    assert length.common.variances == pytest.approx([0.02**2, 0.05**2])


def test_a_length_as_its_source_measured_it_has_no_error_of_the_factor():
    scale = metric()
    assert scale.as_measured(Length(6.0, 0.3, True)).common.variances == pytest.approx(
        [0.0, 0.05**2])
    # What is not known has nothing in common with others.
    unknown = Length(1.0, 1e3, False)
    assert scale.as_measured(unknown) is unknown


def test_after_a_reset_a_scale_is_as_if_it_were_new():
    new, used = ScaleFilter(), metric()
    new.configure(0.05)
    for _ in range(7):
        used.update(Length(12.0, 0.6, True), 2.0, 0.0, 0.1)
    used.scaled(2.0, 0.01, False)
    crept(used, 12, 0.5)
    found = []
    for scale in new, used:
        scale.reset()
        found.append([])
        for metres in 0.0, 6.0, 12.0:
            length = scale.scaled(2.0, 0.01, False)
            found[-1] += [length.value, length.sigma, length.metric, *length.common.variances,
                          *length.common.kept]
            crept(scale, 12, 0.5)
            scale.update(Length(metres, 0.05 * metres, True), 2.0, 0.0, 0.1)
        found[-1].append(scale.factor)
    assert found[0] == found[1]
    assert found[0][5:7] == [1, 1]


def test_a_factor_wanders_until_its_lengths_are_no_longer_metres():
    """That is where it is off by 35 %; the next length then begins anew."""
    scale = metric()
    assert scale.scaled(2.0, 0.01, True).metric
    for count in range(1, 14):
        scale.add_noise(0.1**2)
        assert scale.metric is (count < 13)
    length = scale.scaled(2.0, 0.01, False)
    assert (length.known, length.metric) == (True, False)
    assert length.value == pytest.approx(6.0) and length.sigma == pytest.approx(0.01 * 6)
    assert length.common.variances[1] == 0.05**2
    scale.update(Length(8.0, 0.4, True), 2.0, 0.0, 0.1)
    assert scale.metric and scale.factor == pytest.approx(4)
    # Nothing is left of the error of the factor, but all of that of the source.
    assert scale.scaled(2.0, 0.01, True).common.kept == pytest.approx([0, 1])
    assert scale.scaled(2.0, 0.01, True).common.kept == pytest.approx([1, 1])


@pytest.mark.parametrize(('share', 'error'), [(0.05, 20 * 0.05), (0.02, np.hypot(0.5, 0.2))])
def test_lengths_with_another_share_have_another_error_in_common(share, error):
    """Ten metres with 5 % are followed by ten with as much, the same, or with 2 %."""
    scale, path, here, ahead = metric(), PathCovariance(), np.eye(4), pose(z=1.0)
    for number in range(20):
        if number == 10:
            scale.configure(share)
        scale.update(Length(1.0, 0.05, True), 1.0, 0.0, 0.1, exact=True)
        length = scale.scaled(1.0, 0.0, True)
        path = path.moved(here, ahead, np.zeros((6, 6)), length.common)
        here = here @ ahead
    assert np.sqrt(path.pose[2, 2]) == pytest.approx(error)


def test_exact_lengths_leave_nothing_of_the_errors_before():
    """The steps in between wander by 10 %; a source without errors of its own ends that."""
    scale, path, here, ahead = metric(0.0), PathCovariance(), np.eye(4), pose(z=1.0)
    for _ in range(25):
        scale.update(Length(1.0, 0.0, True), 1.0, 0.0, 0.1, exact=True)
        assert (scale.factor, scale.variance) == (1.0, 0.0)
        scale.add_noise(0.1**2)
        path = path.moved(here, ahead, np.zeros((6, 6)), scale.scaled(1.0, 0.0, True).common)
        here = here @ ahead
    assert np.sqrt(path.pose[2, 2]) == pytest.approx(0.1 * np.sqrt(25))


def test_an_exact_length_makes_a_track_metric_at_once():
    scale = ScaleFilter()
    scale.update(Length(3.0, 0.0, True), 2.0, 0.01, 0.1, exact=True)
    assert (scale.metric, scale.factor, scale.variance) == (True, pytest.approx(1.5), 0.0)


def test_of_the_error_of_a_factor_that_two_lengths_correct_less_is_kept():
    """Of a mean of equal lengths, the share of the first n is n over the number of all."""
    scale = metric()
    for kept in (0, 3 / 5, 5 / 7):
        for _ in range(2):
            scale.update(Length(6.0, 0.3, True), 2.0, 0.0, 0.1)
        assert scale.scaled(2.0, 0.0, True).common.kept[0] == pytest.approx(kept)


def wandered(rng, seconds, measured):
    """
    Move at a speed of about one, seen in a unit that wanders by a factor of e in a second.

    measured: before which second a length in metres becomes known. Returns errors of the log
    factor, variances and kept shares (3, N).
    """
    scale, factor, usual, found = ScaleFilter(), 0.0, 0.0, []
    for second in range(seconds):
        if second == measured:
            scale.update(Length(np.exp(factor), 0.0, True), 1.0, 0.0, 1.0)
        usual += rng.normal(0, np.sqrt(0.05))
        factor += rng.normal(0, 1.0)
        scale.add_noise(1.0)
        scale.moved(float(np.exp(usual + rng.normal(0, 1.0) - factor)), 1.0, True)
        kept = scale.scaled(1.0, 0.0, False).common.kept[0]
        found.append((scale.log - factor, scale.variance, kept))
    return np.array(found).T


@pytest.mark.parametrize('measured', [None, 0, 30])
def test_where_landmarks_lose_the_scale_the_usual_speed_bounds_its_drift(measured):
    """By itself it would drift by 1.0 times the root of the number of seconds."""
    rng = np.random.default_rng(0)
    runs = np.array([wandered(rng, 60, measured) for _ in range(200)])
    errors, variances, kept = runs[:, 0], runs[0, 1], runs[0, 2]
    assert np.std(errors[:, -1]) < 0.5 * np.sqrt(60)
    assert (errors**2).mean(0) == pytest.approx(variances, rel=0.3)
    for second in 5, 30, 59:
        before, after = errors[:, second - 1], errors[:, second]
        assert before @ after / (before @ before) == pytest.approx(kept[second], abs=0.1)


def test_where_landmarks_hold_the_scale_no_speed_changes_it():
    """A car at 1 % a minute stops at a light, and drives four times as fast ever after."""
    scale = ScaleFilter()
    for second in range(600):
        scale.add_noise((0.01 / np.sqrt(60))**2)
        standing = 100 <= second < 160
        scale.moved(0.0 if standing else 1.0 if second < 300 else 4.0, 1.0, not standing)
        assert abs(scale.log) < 2e-3
    assert np.sqrt(scale.variance) == pytest.approx(0.01 * np.sqrt(10), rel=0.01)


def test_steps_of_a_second_are_one_speed_and_without_parallax_none():
    """Lengths of less than a second are hardly more than noise, as those without parallax are."""
    for parallax in True, False:
        scale = ScaleFilter()
        for number in range(96):
            scale.add_noise(0.1)
            # The unit has become a third of what it was.
            scale.moved(0.1 if number < 32 else 0.3, 1 / 32, parallax or number < 32)
            assert (abs(scale.log) > 1e-3) is (parallax and number >= 63)
        assert -np.log(3) < scale.log < -0.3 or not parallax


def test_the_usual_speed_is_the_same_in_metres_and_in_another_unit():
    """With the first length in metres, and with a correction that makes all of them longer."""
    found = {}
    for change in 'metres', 'unit', 'nothing':
        scale, units = ScaleFilter(), 2.0
        for second in range(60):
            if second == 30 and change == 'metres':
                scale.update(Length(6.0, 0.1, True), units, 0.0, 1.0)
                assert scale.factor == pytest.approx(3)
            if second == 30 and change == 'unit':
                scale.unit_changed(1.5)
                units *= 1.5
            scale.add_noise(0.04)
            scale.moved(units, 1.0, True)
        found[change] = scale.factor
    assert found == pytest.approx({'metres': 3.0, 'unit': 1.0, 'nothing': 1.0}, rel=1e-4)


def test_lengths_in_metres_stay_as_long_when_a_correction_changes_the_unit():
    scale = metric()
    before = scale.scaled(2.0, 0.01, True)
    scale.unit_changed(1.5)
    after = scale.scaled(3.0, 0.01, True)
    assert (after.value, after.sigma) == pytest.approx((before.value, before.sigma))


def crept(scale, steps, units, hertz=30):
    """Show steps of a millimetre, each as long as its standard deviation, in units of a track."""
    for _ in range(steps):
        scale.update(Length(1e-3, 1e-3, True), units, 0.0, 1 / hertz)


def test_lengths_that_may_be_noise_are_summed_for_a_second_and_no_longer():
    """The sum of more than sixteen is significant, by four standard deviations."""
    for hertz, significant in ((10, False), (30, True)):
        scale = ScaleFilter()
        crept(scale, 3 * hertz, 0.5, hertz)
        assert scale.metric is significant
    assert scale.factor == pytest.approx(2e-3)


def test_lengths_that_are_summed_count_once():
    """Only seventeen of these are significant together."""
    scale = ScaleFilter()
    for number in range(1, 52):
        scale.update(Length(1e-3, 1.01e-3, True), 0.5, 0.0, 0.01)
        if number >= 17:
            assert scale.variance == pytest.approx(1.01**2 / (number // 17 * 17))


def test_a_length_that_is_significant_by_itself_is_not_added_to_noise_before_it():
    """A speed is positive where noise is not: a camera that stands still seems to creep."""
    scale = ScaleFilter()
    crept(scale, 10, 0.0)
    scale.update(Length(0.02, 1e-3, True), 2.0, 0.0, 0.03)
    assert scale.factor == pytest.approx(0.01)
    # What was significant is over: all that follows is summed anew.
    crept(scale, 15, 0.05)
    assert scale.variance == pytest.approx(0.05**2)


def test_a_standstill_that_is_sure_says_nothing_about_the_scale():
    scale = ScaleFilter()
    scale.update(Length(0.0, 0.0, True), 2.0, 0.0, 0.1)
    assert (scale.metric, scale.factor) == (False, 1.0)


@pytest.mark.parametrize('change', ['share', 'unit'])
def test_lengths_before_and_after_a_change_are_not_summed(cards, change):
    frame, track = cards.frame(0.0), TrackScale()
    track.configure(ESTIMATOR, RelativeScale(), 0.0)
    scale = track._filter
    crept(scale, 12, 0.5)
    if change == 'share':
        track.configure(ESTIMATOR, RelativeScale(), 0.02)
    else:
        track.begin(TwoViewEstimator(ESTIMATOR).view(frame.gray, frame.K))
    crept(scale, 12, 1.0)
    assert not scale.metric
    crept(scale, 8, 1.0)
    assert scale.metric and scale.factor == pytest.approx(1e-3)
