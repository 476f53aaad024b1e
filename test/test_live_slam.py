"""The live pose graph: steps from messages, an incremental map, and loop closure."""

from dataclasses import replace
import gc
from itertools import pairwise, permutations

from cards import Cards, K, pose, REST, SIZE
from djet_ros.config.flat import from_flat, with_values
from djet_ros.config.sections import Config, OdometryConfig, SlamConfig
from djet_ros.core.geometry import unit
from djet_ros.core.types import Status
from djet_ros.errors import DjetError
from djet_ros.odometry.camera import Camera
from djet_ros.odometry.frame import Frame
from djet_ros.odometry.messages import Messages, pose_of
from djet_ros.odometry.result import OdometryResult
from djet_ros.odometry.scale import UNKNOWN_LENGTH_SIGMA
from djet_ros.odometry.uncertainty import compose, UNKNOWN_MOTION
from djet_ros.posegraph.pose_graph import Edge, PoseGraph
from djet_ros.posegraph.step_messages import StepMessages
import numpy as np
import pytest
from ros_messages import camera_info, image, message_type

PERIOD = 100_000_000
START = 50 * 10**9
# 0.3 m ahead of the base and 1 m above it, looking ahead.
MOUNTING = np.array([[0.0, 0, 1, 0.3], [-1, 0, 0, 0], [0, -1, 0, 1.0], [0, 0, 0, 1]])
SIGMAS = np.array([0.01, 0.01, 0.01, 1e-3, 1e-3, 1e-3])


class Odometry:
    """An odometry with given motions, which publishes them as vo_node does."""

    def __init__(self, convention='optical', base_frame='', mounting=None):
        self._make = Messages(message_type, OdometryConfig(
            frame_convention=convention, base_frame=base_frame), mounting=mounting)
        self.stamp = START
        self.reset()

    def reset(self):
        """Restart at the origin."""
        self.here, self.covariance = np.eye(4), np.zeros((6, 6))

    def _result(self, status, motion, covariance, standing=False, known=True):
        return OdometryResult(
            self.stamp, 'camera', status, self._reference, None, motion, self.here @ motion,
            covariance, compose(self.here, self.covariance, motion, covariance), 1.0, known,
            standing, self._reference)

    def start(self):
        """Return (status, Odometry) of a first frame at the current pose."""
        self._reference = None
        result = self._result(Status.FIRST_FRAME, np.eye(4), np.zeros((6, 6)))
        self._reference = self.stamp
        self.stamp += PERIOD
        return self._make.status(result), self._make.odometry(result)

    def move(self, motion, covariance=None, standing=False, known=True):
        """Return (relative pose, status, Odometry) of the next frame."""
        covariance = np.diag(SIGMAS**2) if covariance is None else covariance
        result = self._result(Status.OK, motion, covariance, standing, known)
        if not standing:
            self.here, self.covariance = result.pose, result.pose_covariance
            self._reference = self.stamp
        self.stamp += PERIOD
        return (self._make.relative_pose_cov(result), self._make.status(result),
                self._make.odometry(result))

    def lose_track(self, *, bridged=False):
        """Return (status, Odometry) of a bad pair; unless bridged the next starts from here."""
        result = self._result(Status.TOO_FEW_MATCHES, np.eye(4), UNKNOWN_MOTION)
        if not bridged:
            self.covariance, self._reference = result.pose_covariance, self.stamp
        self.stamp += PERIOD
        return self._make.status(result), self._make.odometry(result)


# Steps

def by_odometry(steps, *messages):
    """Return the steps that messages complete."""
    return [step for message in messages for step in take(steps, message)]


def take(taker, message):
    """Have a message taken by what is there for its type."""
    if hasattr(message, 'twist'):
        return taker.odometry(message)
    if hasattr(message, 'status'):
        return (taker.relative_pose_status if hasattr(taker, 'relative_pose_status')
                else taker.status)(message)
    return taker.relative_pose(message)


@pytest.mark.parametrize('convention', ['optical', 'body'])
def test_step_is_the_motion_of_the_camera_in_optical_axes(convention):
    odometry, steps, motion = Odometry(convention), StepMessages(convention), pose(z=1.0, yaw=0.1)
    covariance = np.diag(np.arange(1.0, 7)**2) * 1e-6
    first, = by_odometry(steps, *odometry.start())
    second, = by_odometry(steps, *odometry.move(motion, covariance))
    assert (first.tracked, second.tracked) == (False, True)
    assert second.previous_stamp_ns == first.stamp_ns
    assert second.scale_known
    assert np.allclose(second.motion, motion)
    assert np.allclose(second.covariance, covariance, atol=2e-9)
    assert np.allclose(second.pose, motion)


@pytest.mark.parametrize('convention', ['optical', 'body'])
def test_step_of_a_base_frame_is_the_motion_of_the_camera(convention):
    motion, covariance = pose(z=1.0, yaw=0.1), np.diag(np.arange(1.0, 7)**2) * 1e-6
    odometry = Odometry(convention, 'base_link', MOUNTING)
    steps = StepMessages(convention, 'base_link', MOUNTING)
    by_odometry(steps, *odometry.start())
    step, = by_odometry(steps, *odometry.move(motion, covariance))
    assert np.allclose(step.motion, motion)
    assert np.allclose(step.pose, motion)
    assert np.allclose(step.covariance, covariance, atol=2e-9)


def test_odometry_of_another_frame_is_refused_with_the_remedy():
    odometry, steps = Odometry('body', 'base_link', MOUNTING), StepMessages('body')
    by_odometry(steps, *odometry.start())
    with pytest.raises(DjetError, match="odometry is 'base_link', not 'camera_body'; give both "
                       'nodes the same odometry.base_frame'):
        by_odometry(steps, *odometry.move(pose(z=1.0)))


def test_messages_of_a_frame_may_arrive_in_any_order():
    odometry, steps = Odometry(), StepMessages('optical')
    by_odometry(steps, *odometry.start())
    for order in permutations(range(3)):
        frame = odometry.move(pose(z=1.0))
        assert not by_odometry(steps, frame[order[0]], frame[order[1]])
        step, = by_odometry(steps, frame[order[2]])
        assert step.tracked
    assert steps.missing == 0


def test_late_start_begins_at_the_current_pose_of_the_odometry():
    odometry, steps = Odometry(), StepMessages('optical')
    odometry.start()
    odometry.move(pose(z=3.0))
    first, = by_odometry(steps, *odometry.move(pose(z=1.0)))
    assert first.pose[2, 3] == 4.0


def test_motions_of_a_stationary_camera_start_at_its_first_frame():
    odometry, steps = Odometry(), StepMessages('optical')
    _, reference = by_odometry(steps, *odometry.start(), *odometry.move(pose(z=1.0)))
    for _ in range(3):
        stationary, = by_odometry(steps, *odometry.move(np.eye(4), standing=True))
        assert stationary.previous_stamp_ns == reference.stamp_ns
    step, = by_odometry(steps, *odometry.move(pose(x=0.5)))
    assert step.previous_stamp_ns == reference.stamp_ns
    assert np.allclose(step.covariance, np.diag(SIGMAS**2), atol=2e-9)
    after, = by_odometry(steps, *odometry.move(pose(x=0.5)))
    assert after.previous_stamp_ns == step.stamp_ns


def test_motion_over_a_gap_is_unknown():
    odometry, steps = Odometry(), StepMessages('optical')
    by_odometry(steps, *odometry.start(), *odometry.move(pose(z=1.0)))
    odometry.lose_track()
    step, = by_odometry(steps, *odometry.start())
    assert (step.tracked, step.status) == (False, Status.FIRST_FRAME)
    assert np.array_equal(step.covariance, UNKNOWN_MOTION)
    after, = by_odometry(steps, *odometry.move(pose(z=1.0)))
    assert after.previous_stamp_ns == step.stamp_ns


def test_motion_after_lost_tracking_starts_at_a_frame_without_a_motion():
    """That frame comes with it, as from results, or one more motion would be lost."""
    odometry, steps = Odometry(), StepMessages('optical')
    known = by_odometry(steps, *odometry.start(), *odometry.move(pose(z=1.0)))
    for _ in range(3):
        assert not by_odometry(steps, *odometry.lose_track())
    lost, step = by_odometry(steps, *odometry.move(pose(z=1.0)))
    assert (lost.tracked, lost.status) == (False, Status.TOO_FEW_MATCHES)
    assert step.previous_stamp_ns == lost.stamp_ns == step.stamp_ns - PERIOD
    assert step.previous_stamp_ns not in {one.stamp_ns for one in known}
    after, = by_odometry(steps, *odometry.move(pose(z=1.0)))
    assert after.previous_stamp_ns == step.stamp_ns
    assert steps.missing == 0


@pytest.mark.parametrize('convention', ['optical', 'body'])
def test_step_has_the_rotation_covariance_of_its_pose(convention):
    odometry, steps = Odometry(convention), StepMessages(convention)
    by_odometry(steps, *odometry.start())
    step, = by_odometry(steps, *odometry.move(pose(z=1.0), np.diag(np.arange(1.0, 7)**2) * 1e-6))
    assert np.allclose(step.rotation_covariance, odometry.covariance[3:, 3:], atol=2e-9)


def test_bridged_failed_frame_is_not_a_step():
    odometry, steps = Odometry(), StepMessages('optical')
    *_, before = by_odometry(steps, *odometry.start(), *odometry.move(pose(z=1.0)))
    by_odometry(steps, *odometry.lose_track(bridged=True))
    step, = by_odometry(steps, *odometry.move(pose(z=1.0)))
    assert step.previous_stamp_ns == before.stamp_ns


@pytest.mark.parametrize('lost', [0, 1, 2])
def test_lost_message_leaves_a_counted_gap(lost):
    odometry, steps = Odometry(), StepMessages('optical')
    by_odometry(steps, *odometry.start(), *odometry.move(pose(z=1.0)))
    assert not by_odometry(steps, *np.delete(np.array(odometry.move(pose(z=2.0)), object), lost))
    step, = by_odometry(steps, *odometry.move(pose(z=1.0)))
    assert step.previous_stamp_ns == step.stamp_ns - PERIOD
    assert np.allclose(step.pose, pose(z=4.0))
    assert steps.missing == (lost != 2)


def test_status_gives_the_kind_of_scale():
    odometry, steps = Odometry(), StepMessages('optical')
    by_odometry(steps, *odometry.start())
    for known in (True, False, True):
        step, = by_odometry(steps, *odometry.move(pose(z=1.0), known=known))
        assert step.scale_known == known


@pytest.mark.parametrize('spoil', [
    lambda message: message.status.clear(), lambda message: message.status[0].values.clear(),
    lambda message: setattr(message.status[0].values[0], 'value', 'FINE'),
    lambda message: setattr(message.status[0].values[1], 'value', 'long ago'),
    lambda message: setattr(message.status[0].values[-1], 'value', 'nan')])
def test_invalid_status_message_is_refused(spoil):
    odometry, steps = Odometry(), StepMessages('optical')
    status, _ = odometry.start()
    spoil(status)
    with pytest.raises(DjetError, match=f'the status of {START} ns lacks something'):
        steps.status(status)


# The map

@pytest.fixture(scope='module')
def live():
    """Return the class, for which GTSAM must be installed."""
    pytest.importorskip('gtsam', reason='GTSAM is not installed: the extra slam')
    from djet_ros.posegraph.live_slam import LiveSlam
    return LiveSlam


QUICK = SlamConfig(keyframe_distance=0.5, loop_gap=0.5, optimise_period=0.0, path_period=0.0)
FEW_FEATURES = from_flat({'estimator.max_features': 800,
                          'odometry.frame_convention': 'optical'})


class Drive:
    """A path past cards, as estimated by an odometry that drifts to the right."""

    def __init__(self, live, config=FEW_FEATURES, slam=QUICK, drift=0.01):
        self.slam = live(replace(config, slam=slam), message_type, 'image_rect')
        self.slam.camera_info(camera_info(K, SIZE))
        base_frame = config.odometry.base_frame
        self.odometry = Odometry(config.odometry.frame_convention, base_frame,
                                 MOUNTING if base_frame else None)
        self._cards, self._drift, self._frame = Cards(), pose(x=drift), 0
        self._true = np.eye(4)
        self.true, self.by_odometry, self.corrections, self.path = {}, {}, {}, None

    def start(self, place=REST):
        """Start or restart at a place."""
        self._true = place
        return self._take(self.odometry.start)

    def stand(self):
        """Stay where it is for a frame."""
        return self._take(lambda: self.odometry.move(np.eye(4), standing=True))

    def go(self, place, *, seen=True):
        """Go to a place; give what comes of it."""
        motion = np.linalg.inv(self._true) @ place
        self._true = place
        return self._take(lambda: self.odometry.move(motion @ self._drift), seen)

    def _take(self, messages, seen=True):
        stamp = self.odometry.stamp
        if seen:
            self._frame += 1
            self.slam.image(image(self._cards.gray(self._true, noise=self._frame),
                                  stamp_ns=stamp))
        outgoing = []
        for message in messages():
            outgoing += take(self.slam, message)
            if hasattr(message, 'twist'):
                self.by_odometry[stamp] = pose_of(message)[1]
        self.true[stamp] = self._true
        while not self.slam.idle:
            outgoing += self.slam.work()
        for topic, message in outgoing:
            if topic == '/tf':
                transform, = message.transforms
                self.corrections[stamp] = pose_of(transform)[1]
            elif topic == 'path':
                self.path = message
        return outgoing

    @property
    def reported(self):
        """Values of its diagnostics, as they are now."""
        message = self.slam.diagnostics(0).message
        return {pair.key: pair.value for pair in message.status[0].values}

    def to_and_fro(self, steps=8):
        """Go 2 m to the right on a curve, and back."""
        positions = [0.25 * i for i in (*range(steps + 1), *range(steps - 1, -1, -1))]
        self.start()
        for metres in positions[1:]:
            self.go(pose(x=metres, z=0.3 * metres**2))

    def errors(self):
        """Distances from the truth of the path's poses, by odometry and as optimised."""
        pairs = [pose_of(one) for one in self.path.poses]
        return [np.array([np.linalg.norm((poses[stamp] - self.true[stamp])[:3, 3])
                          for stamp, _ in pairs]) for poses in (self.by_odometry, dict(pairs))]


def test_live_keyframes_have_the_residual_distortion_corrected(live):
    gray, k1 = Cards().gray(REST), -0.05
    slam = live(with_values(FEW_FEATURES, {'odometry.residual_k1': k1}), message_type,
                'image_rect')
    slam.camera_info(camera_info(K, SIZE))
    slam.image(image(gray, stamp_ns=START))
    undone = Camera(K, np.array([k1, 0, 0, 0, 0]), SIZE).undistort(gray)
    assert np.array_equal(slam._frame(START).gray, undone)


def test_waiting_image_keeps_its_camera(live):
    """Whoever zooms in says so before the odometry of the last image has come."""
    slam = live(FEW_FEATURES, message_type, 'image_rect')
    early, wide, near = START - PERIOD, START, START + PERIOD
    slam.image(image(Cards().gray(REST), stamp_ns=early))
    slam.camera_info(camera_info(K, SIZE))
    slam.image(image(Cards().gray(REST), stamp_ns=wide))
    zoomed = K * [[2.0], [2.0], [1.0]]
    slam.camera_info(camera_info(zoomed, SIZE))
    slam.image(image(Cards().gray(REST), stamp_ns=near))
    assert np.array_equal(slam._frame(wide).K, K)
    assert np.array_equal(slam._frame(near).K, zoomed)
    # One from before any CameraInfo has the one that there is.
    assert np.array_equal(slam._frame(early).K, zoomed)


def test_live_keyframes_have_the_masks_of_their_images(live):
    """One for all images, and one by its stamp."""
    still = np.zeros(SIZE[::-1], bool)
    still[200:] = True
    slam = live(replace(FEW_FEATURES, slam=QUICK), message_type, 'image_rect', static_mask=still)
    slam.camera_info(camera_info(K, SIZE))
    moving = np.full(SIZE[::-1], 255, np.uint8)
    moving[:, :50] = 0
    for stamp in (START, START + PERIOD):
        slam.image(image(Cards().gray(REST), stamp_ns=stamp))
    slam.mask(image(moving, stamp_ns=START + PERIOD))
    assert np.array_equal(slam._frame(START).left_out, still)
    assert np.array_equal(slam._frame(START + PERIOD).left_out, still | (moving < 128))


@pytest.fixture(scope='module')
def driven(live):
    drive = Drive(live)
    drive.to_and_fro()
    return drive


def test_loop_closure_removes_drift(driven):
    before, after = driven.errors()
    assert before.max() > 0.12
    assert after.max() < before.max() / 2
    assert after.mean() < before.mean() / 2
    assert int(driven.reported['loops']) >= 3
    assert driven.reported['state'] == 'mapping'


def test_map_to_odom_and_odom_to_camera_compose_to_the_optimised_pose(driven):
    """As in REP 105: only the odometry publishes the camera in the odometry frame."""
    optimised = dict(pose_of(one) for one in driven.path.poses)
    newest = max(optimised)
    correction = driven.slam.map.correction
    assert np.abs(correction - np.eye(4)).max() > 0.05
    assert np.allclose(correction @ driven.by_odometry[newest], optimised[newest], rtol=0,
                       atol=1e-9)
    # at all times: each was valid until the next optimisation
    assert driven.corrections.keys() == driven.by_odometry.keys()
    changes = np.diff([driven.corrections[stamp] for stamp in sorted(driven.corrections)], axis=0)
    assert 0 < np.count_nonzero(np.abs(changes).max((1, 2))) <= int(
        driven.reported['optimisations'])


def test_the_messages_name_their_frames_and_carry_the_stamps_of_the_images(live):
    drive = Drive(live)
    drive.start()
    outgoing = dict(drive.go(pose(x=1.0)))
    transform, = outgoing['/tf'].transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ('map', 'odom')
    assert pose_of(transform)[0] == START + PERIOD
    assert outgoing['path'].header.frame_id == 'map'
    assert [pose_of(one)[0] for one in outgoing['path'].poses] == [START, START + PERIOD]


def test_map_with_body_axes_is_the_same_in_other_axes(live, driven):
    drive = Drive(live, from_flat({'estimator.max_features': 800,
                                   'odometry.frame_convention': 'body'}))
    drive.to_and_fro()
    axes = np.eye(4)
    axes[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    for ours, theirs in zip(drive.path.poses, driven.path.poses, strict=True):
        assert np.allclose(pose_of(ours)[1], axes @ pose_of(theirs)[1] @ axes.T, atol=1e-6)
    stamp, newest = pose_of(drive.path.poses[-1])
    drive.go(pose(x=0.01))
    correction = drive.corrections[max(drive.corrections)]
    assert np.allclose(correction @ drive.by_odometry[stamp], newest)


@pytest.mark.parametrize(('convention', 'other', 'frame'), [
    ('optical', 'body', 'camera_body'), ('body', 'optical', 'camera')])
def test_odometry_of_another_convention_is_refused(live, convention, other, frame):
    """Its axes would be taken for others, and no loop would fit."""
    drive = Drive(live, with_values(FEW_FEATURES, {'odometry.frame_convention': convention}))
    drive.odometry = Odometry(other)
    drive.to_and_fro(2)
    assert str(drive.slam.problem) == (
        f"the relative pose is in '{frame}', which has the axes of odometry.frame_convention "
        f'{other}, while it is {convention} here; give both nodes the same')
    assert drive.slam.map.count('odometry') == 0
    # A name of its own says nothing about the axes.
    assert not drive.slam._check_convention('front')


def test_map_frame_of_the_name_of_the_odometry_s_frame_is_an_error(live):
    drive = Drive(live, slam=replace(QUICK, map_frame='odom'))
    drive.start()
    drive.go(pose(x=1.0))
    assert drive.slam.state == ('ERROR', 'slam.map_frame is odom_frame')
    assert not drive.corrections


def test_map_is_of_the_base_frame_once_tf_has_the_mounting(live, driven):
    drive = Drive(live, from_flat({'estimator.max_features': 800,
                                   'odometry.base_frame': 'base_link'}))
    frames = {('base_link', 'camera'): MOUNTING}
    assert drive.slam.mount(lambda *_: None).startswith('no image received yet')
    drive.slam.image(image(np.zeros((9, 9), np.uint8), stamp_ns=START - PERIOD))
    assert drive.slam.mount(lambda *_: None) == (
        "tf has no transform from 'base_link' (odometry.base_frame) to 'camera'; publish it on "
        '/tf_static')
    assert drive.slam.state == ('WARN', 'waiting for the mounting of the camera on tf')
    assert drive.slam.mount(lambda *names: frames.get(names)) == ''
    drive.to_and_fro()
    for one, other in zip(drive.path.poses, driven.path.poses, strict=True):
        turned = MOUNTING @ pose_of(other)[1] @ np.linalg.inv(MOUNTING)
        assert np.allclose(pose_of(one)[1], turned, atol=1e-4)
    stamp, newest = pose_of(drive.path.poses[-1])
    drive.go(pose(x=0.01))
    correction = drive.corrections[max(drive.corrections)]
    assert np.allclose(correction @ drive.by_odometry[stamp], newest)


def test_odometry_reset_continues_at_the_last_pose_until_a_loop_corrects_it(live):
    """After a reset of vo_node: another odometry frame, and a motion of which nothing is known."""
    drive = Drive(live, drift=0.0)
    drive.start()
    for i in range(1, 7):
        drive.go(pose(x=0.5 * i))
    drive.odometry.reset()
    drive.start(pose(x=2.0))
    newest = pose_of(drive.path.poses[-1])[1]
    assert np.allclose(newest, pose(x=3.0), atol=0.02)
    for i in range(5):
        drive.go(pose(x=1.6 - 0.4 * i))
    assert drive.reported['unknown motions'] == '1'
    assert int(drive.reported['loops']) >= 2
    # in the map's first frame, by loops alone
    _, after = drive.errors()
    assert after.max() < 0.1


@pytest.fixture
def growing(live):
    """Drive to and fro with a unit of length that grows by 3 % per frame, which a loop finds."""
    drive = Drive(live, drift=0.0)
    result, move = drive.odometry._result, drive.odometry.move
    drive.metric, drive.unit_of_length = False, 1.0
    drive.odometry._result = lambda *args: replace(result(*args), metric=drive.metric)

    def move_in_its_unit(motion):
        in_unit = motion.copy()
        in_unit[:3, 3] /= drive.unit_of_length
        return move(in_unit, np.diag([(0.06 * 0.25)**2, *SIGMAS[1:]**2]))

    drive.odometry.move = move_in_its_unit
    drive.start()
    for i in (*range(1, 9), *range(7, -1, -1)):
        drive.unit_of_length *= 1.03
        drive.go(pose(x=0.25 * i))
    assert drive.slam.map.keyframes[-1].factor > 1.3
    # where there is no loop to find
    drive.slam.map.search_loops = lambda: bool(drive.slam.map._pending.clear())
    return drive


def test_after_a_loop_the_map_goes_on_in_the_unit_that_the_loop_has_corrected(growing):
    drive, newest = growing, growing.slam.map.keyframes[-1]
    optimisations = drive.reported['optimisations']
    for i in range(1, 9):
        drive.go(pose(x=-0.25 * i))
    assert drive.reported['optimisations'] == optimisations
    poses = dict(pose_of(one) for one in drive.path.poses)
    gone = {stamp: np.linalg.norm(drive.by_odometry[stamp] - drive.by_odometry[newest.stamp_ns])
            for stamp in poses if stamp > newest.stamp_ns}
    assert max(gone.values()) > 1.0
    for stamp, length in gone.items():
        assert np.linalg.norm((poses[stamp] - newest.pose)[:3, 3]) == pytest.approx(
            newest.factor * length)
        if stamp in drive.corrections:
            assert np.allclose(drive.corrections[stamp] @ drive.by_odometry[stamp], poses[stamp])


def test_metres_are_metres_in_a_map_whose_relative_unit_was_corrected(growing):
    """The first speed comes after the loop: no motion in metres is scaled, at no time."""
    drive, keyframes = growing, growing.slam.map.keyframes
    place = 0.0
    while keyframes[-1].stamp_ns != max(drive.true):
        place -= 0.25
        drive.go(pose(x=place))
    drive.metric, drive.unit_of_length, last = True, 1.0, len(keyframes) - 1
    assert keyframes[last].factor > 1.3
    for i in range(1, 6):
        drive.go(pose(x=place - 0.25 * i))
        # with an optimisation since, or without; also where no keyframe is of metres yet
        for _ in range(2):
            here = drive.slam.map.correction @ drive.by_odometry[max(drive.true)]
            assert np.linalg.norm((here - keyframes[last].pose)[:3, 3]) == pytest.approx(
                0.25 * i, rel=1e-3)
            drive.slam.map.optimise()
    assert [one.factor for one in keyframes][last:] == [1.0] * 3


@pytest.mark.parametrize(('first', 'unit_of_length'), [(0, 0.5), (7, 0.7)])
def test_map_is_metric_once_lengths_are(live, first, unit_of_length):
    """Before the first speed arrives, and after a gap, lengths are in another unit."""
    drive = Drive(live, drift=0.0)
    result, move, metric = drive.odometry._result, drive.odometry.move, True
    drive.odometry._result = lambda *args: replace(result(*args), metric=metric)

    def move_in_its_unit(motion):
        in_unit = motion.copy()
        in_unit[:3, 3] /= 1.0 if metric else unit_of_length
        return move(in_unit, np.diag([(0.05 * in_unit[0, 3])**2 + 1e-8, *SIGMAS[1:]**2]))

    drive.odometry.move = move_in_its_unit
    drive.start()
    for step, i in enumerate((*range(1, 9), *range(7, -1, -1))):
        metric = not first <= step < first + 3
        drive.go(pose(x=0.25 * i))
    assert int(drive.reported['loops']) >= 3
    places = {stamp: here[0, 3] for stamp, here in map(pose_of, drive.path.poses)}
    for stamp, place in places.items():
        assert place == pytest.approx(drive.true[stamp][0, 3], abs=0.1)
    newest = drive.slam.map.keyframes[-1]
    assert newest.factor == 1.0


def test_length_of_an_edge_over_the_first_measured_length_is_unknown(live):
    """It would be a sum of metres and of another unit; its direction is known as before."""
    drive = Drive(live, drift=0.0)
    result, metric = drive.odometry._result, False
    drive.odometry._result = lambda *args: replace(result(*args), metric=metric)
    drive.start()
    drive.go(pose(x=0.2))
    metric = True
    drive.go(pose(x=0.6))
    edge, = drive.slam.map.edges
    assert not edge.scale_known
    assert not edge.metric
    assert np.sqrt(np.diag(edge.covariance)[:3]) == pytest.approx(
        [0.6, 0.014, 0.014], rel=0.1)
    drive.go(pose(x=1.2))
    assert drive.slam.map.edges[1].metric


def test_step_back_in_time_starts_a_new_map(live):
    drive = Drive(live)
    drive.start()
    drive.go(pose(x=1.0))
    drive.odometry.stamp = START - 10**9
    drive.odometry.reset()
    drive.start()
    assert [pose_of(one)[0] for one in drive.path.poses] == [START - 10**9]
    assert drive.reported['keyframes'] == '1'
    assert np.array_equal(drive.corrections[START - 10**9], np.eye(4))


def in_memory(kind):
    gc.collect()
    return sum(type(one) is kind for one in gc.get_objects())


@pytest.mark.slow
def test_map_memory_is_bounded(live):
    image_type = message_type('sensor_msgs/msg/Image')
    frames, messages = in_memory(Frame), in_memory(image_type)
    drive = Drive(live, slam=replace(QUICK, max_keyframes=7, image_buffer=3))
    drive.to_and_fro()
    for i in range(1, 9):
        drive.go(pose(x=0.25 * i, z=0.3 * (0.25 * i)**2))
    graph = drive.slam.map
    assert len(graph.keyframes) == 7
    assert graph.first >= 4
    assert drive.reported['keyframes forgotten'] == str(graph.first)
    assert in_memory(Frame) - frames == 7
    assert in_memory(image_type) - messages <= 3
    ends = {end for edge in graph.edges for end in (edge.source, edge.target)}
    assert ends == set(range(graph.first, graph.first + 7))
    before, after = drive.errors()
    assert after.max() < before.max()


def test_only_images_whose_odometry_has_not_come_are_kept(live):
    """Fifty colour images of a camera are a third of a gigabyte."""
    drive = Drive(live, drift=0.0)
    drive.start()
    for i in range(1, 5):
        drive.go(pose(x=0.01 * i))
    assert not drive.slam._images
    ahead = drive.odometry.stamp
    for stamp in (ahead, ahead + PERIOD):
        drive.slam.image(image(Cards().gray(REST), stamp_ns=stamp))
    # and those of a bag that has started again
    again = START - 10**9
    drive.slam.image(image(Cards().gray(REST), stamp_ns=again))
    drive.go(pose(x=1.0))
    assert [*drive.slam._images] == [ahead + PERIOD, again]


@pytest.mark.parametrize(('source', 'target'), [(0, 2), (2, 0)])
def test_edges_of_a_removed_keyframe_are_transferred_to_its_successor(live, source, target):
    """With the forgotten one held relative to its heir, an edge costs what it cost before."""
    from djet_ros.posegraph.backend import factor_graph, initial_values
    from djet_ros.posegraph.keyframe_map import transferred
    rng = np.random.default_rng(3)
    poses = np.array([pose(), pose(x=0.3, z=2.0, yaw=0.4), pose(x=-1.0, z=3.0, yaw=-0.7)])
    spread = rng.normal(size=(6, 6)) * 0.1
    by_odometry = Edge(source, target, np.linalg.inv(poses[source]) @ poses[target],
                       spread @ spread.T + np.eye(6) * 1e-3, 'loop')
    ours = transferred(by_odometry, 0, np.linalg.inv(poses[0]) @ poses[1])
    assert {ours.source, ours.target} == {1, 2}
    for _ in range(5):
        moved = poses.copy()
        moved[2] = moved[2] @ pose(*rng.normal(size=4) * 1e-3)
        costs = [factor_graph(PoseGraph(np.arange(3), poses, (edge,))).error(
            initial_values(moved)) for edge in (by_odometry, ours)]
        assert costs[0] > 0
        assert costs[1] == pytest.approx(costs[0], rel=0.01)


def test_map_of_unknown_scale_keeps_the_units_of_the_odometry(live):
    """Directions are corrected; lengths change, but no motion is reversed."""
    drive = Drive(live)
    move = drive.odometry.move

    def move_somehow_far(motion):
        along = unit(motion[:3, 3])
        spread = np.pad(np.outer(along, along), (0, 3)) * UNKNOWN_LENGTH_SIGMA**2
        return move(motion, np.diag(SIGMAS**2) + spread, known=False)

    drive.odometry.move = move_somehow_far
    drive.to_and_fro()
    assert int(drive.reported['loops']) >= 3
    assert not any(edge.scale_known for edge in drive.slam.map.edges)
    poses = dict(pose_of(one) for one in drive.path.poses)
    stamps = sorted(poses)
    for before, after in pairwise(stamps):
        ours = poses[after][:3, 3] - poses[before][:3, 3]
        theirs = drive.by_odometry[after][:3, 3] - drive.by_odometry[before][:3, 3]
        assert unit(ours) @ unit(theirs) > 0.9
        assert 0.3 < np.linalg.norm(ours) / np.linalg.norm(theirs) < 3


def test_rotation_in_place_with_unknown_scale_does_not_translate(live):
    """Its way is unknown, but is no more than a step."""
    drive = Drive(live, drift=0.0)
    drive.start()
    wide = np.diag([*[UNKNOWN_LENGTH_SIGMA**2] * 3, *SIGMAS[3:]**2])
    move = drive.odometry.move
    drive.odometry.move = lambda motion: move(motion, wide, known=False)
    drive.go(pose(yaw=0.2))
    edge, = drive.slam.map.edges
    assert np.allclose(edge.covariance, np.diag([1, 1, 1, *SIGMAS[3:]**2]), atol=2e-9)


def test_covariance_does_not_grow_while_stationary(live):
    drive = Drive(live, drift=0.0)
    drive.start()
    for _ in range(10):
        drive.stand()
    drive.go(pose(x=1.0))
    edge, = (edge for edge in drive.slam.map.edges if edge.kind == 'odometry')
    assert np.allclose(edge.covariance, np.diag(SIGMAS**2), atol=2e-9)


@pytest.mark.parametrize(('by_odometry', 'believed', 'kept'), [
    (0.05, 0.05, 0.02), (0.01, 0.01, 0.01), (0.05, 0.5, 0.02), (0.1, 0.05, 0.0889)])
def test_common_length_error_does_not_distort_a_loop(live, by_odometry, believed, kept):
    """Shares of the length: as the odometry says, as the parameter has it, and in the map."""
    config = from_flat({'estimator.max_features': 800, 'odometry.scale_uncertainty': believed})
    drive = Drive(live, config, drift=0.0)
    drive.start()
    covariance = np.diag(SIGMAS**2)
    covariance[0, 0] = (2.0 * by_odometry)**2
    drive.odometry.move, move = lambda motion: move(motion, covariance), drive.odometry.move
    drive.go(pose(x=2.0))
    edge, = drive.slam.map.edges
    assert np.sqrt(edge.covariance[0, 0]) / 2.0 == pytest.approx(kept, rel=1e-3)


def test_keyframe_needs_its_image(live):
    drive = Drive(live)
    drive.start()
    drive.go(pose(x=0.6), seen=False)
    assert drive.reported['keyframes'] == '1'
    drive.go(pose(x=0.7))
    assert (drive.reported['keyframes'], drive.reported['keyframes without image']) == ('2', '1')
    edge, = drive.slam.map.edges
    assert np.allclose(edge.motion, np.linalg.inv(drive.by_odometry[START]) @ drive.odometry.here)


def test_diagnostics_once_a_second_and_at_state_changes(live):
    drive = Drive(live)
    times = []
    for i in range(25):
        stamp = drive.odometry.stamp
        for topic, message in drive.start() if i == 0 else drive.go(pose(x=0.1 * i)):
            if topic == '/diagnostics':
                times.append((stamp - START) / 1e9)
                assert message.status[0].name == 'pose_graph_node: pose graph'
    assert times == [0.0, 1.0, 2.0]


def test_diagnostics_say_what_is_missing(live):
    slam = live(Config(slam=QUICK), message_type)
    assert slam.state == ('WARN', 'waiting for odometry')
    odometry = Odometry()
    for message in odometry.start():
        take(slam, message)
    assert slam.state == ('WARN', 'waiting for camera_info')
    slam.camera_info(camera_info(K, SIZE))
    for message in odometry.move(pose(z=1.0)):
        assert '/tf' not in dict(take(slam, message))
    assert slam.state == ('WARN', 'waiting for the images of the odometry')


def test_invalid_messages_are_counted_and_named_and_leave_a_gap(live):
    drive = Drive(live)
    drive.start()
    relative, status, odometry = drive.odometry.move(pose(x=1.0))
    relative.pose.covariance[:] = 0
    for message in (relative, status, odometry):
        take(drive.slam, message)
    assert drive.slam.state == ('ERROR', 'message rejected')
    assert 'odometry edge' in str(drive.slam.problem)
    assert f'{START + PERIOD} ns' in str(drive.slam.problem)
    relative, status, odometry = drive.odometry.move(pose(x=1.0))
    odometry.pose.pose.position.x = float('nan')
    for message in (relative, status, odometry):
        take(drive.slam, message)
    drive.slam.camera_info(camera_info(K, SIZE, k=np.zeros(9), p=np.zeros(12)))
    assert drive.slam.rejected.total() == 3
    drive.slam.camera_info(camera_info(K, SIZE))
    drive.go(pose(x=1.0))
    assert drive.slam.state == ('OK', 'mapping')
    assert [edge.kind for edge in drive.slam.map.edges] == ['unknown']
