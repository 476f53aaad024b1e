"""Inputs other than images: gyro, another odometry and masks, live and offline."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
import re
from time import monotonic, sleep
from typing import Any

from cards import Cards, K, pose, SIZE
import cv2
from djet_ros.config.flat import from_flat, with_values
from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.geometry import direction_angle, rotation_angle
from djet_ros.core.masks import blocked, masked_at
from djet_ros.core.types import Array, Status
from djet_ros.errors import DjetError
from djet_ros.lab.scenes.imu import feel, FeltMotion, Mems
from djet_ros.live.session import Session
from djet_ros.odometry.camera import Camera
from djet_ros.odometry.images import BadMessage
from djet_ros.odometry.masks import Masks
from djet_ros.odometry.messages import MessageFactory, pose_of
from djet_ros.odometry.moving_frames import MovingFrames
from djet_ros.odometry.static_frames import StaticFrames
from djet_ros.odometry.tracker import Tracker
from djet_ros.recordings.mask_files import static_mask
import numpy as np
import pytest
from ros_messages import camera_info, header, image, message_type, serialised

START, PERIOD = 50 * 10**9, 100_000_000
MAKE = MessageFactory(message_type)
IMU = {'odometry.imu': True, 'odometry.imu_rotation': '0.5 -0.5 0.5 0.5'}
POSES = ('relative_pose', 'relative_pose_cov', 'relative_pose_status', 'odometry')


def tracker(**values: Any) -> Tracker:
    mask = values.pop('still', None)
    one = Tracker(from_flat({'estimator.max_features': 500, **values}), message_type,
                  image_topic='/camera/image_rect', static_mask=mask)
    one.camera_info(camera_info(K, SIZE))
    return one


class Drive:
    """A drive back and forth past cards, with a gyro along the axes of a robot."""

    def __init__(self, frames: int = 12, standing: int = 0) -> None:
        cards, here, self.poses = Cards(), np.eye(4), []
        self.images: list[Any] = []
        for i in range(-standing, frames):
            self.poses.append(here)
            self.images.append(cards.gray(here, noise=i + 100))
            if i >= 0:
                sign = 1 if i // 11 % 2 == 0 else -1
                here = here @ pose(x=0.25 * sign, z=0.15 * sign, yaw=0.01 * np.sin(i))
        self.felt: FeltMotion = feel(np.array(self.poses), 0.1, Mems(), 0)

    def imu(self) -> list[Any]:
        return [MAKE.imu(START + int(stamp), 'imu', rate, force) for stamp, rate, force in zip(
            self.felt.stamps_ns, self.felt.rates, self.felt.accelerations, strict=True)]

    def image(self, index: int, gray: Any = None) -> Any:
        return image(self.images[index] if gray is None else gray,
                     stamp_ns=START + index * PERIOD)

    def errors(self, index: int, motion: Array) -> tuple[float, float]:
        """Return the errors in rad of rotation and direction of the motion (4, 4) to a frame."""
        true = np.linalg.inv(self.poses[index - 1]) @ self.poses[index]
        return (float(rotation_angle(true[:3, :3], motion[:3, :3])),
                float(direction_angle(true[:3, 3], motion[:3, 3])))

    def turned(self, start: int, end: int) -> Array:
        return np.asarray((np.linalg.inv(self.poses[start]) @ self.poses[end])[:3, :3])


@pytest.fixture(scope='module')
def drive() -> Drive:
    return Drive()


def stamp_of(message: Any) -> int:
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


def played(one: Tracker, drive: Drive, imu: list[Any], black: tuple[int, ...] = ()) -> list[Any]:
    """Play images with the samples up to them, return the messages."""
    waiting, outgoing = list(imu), []
    for i in range(len(drive.images)):
        while waiting and one.needs(drive.image(i)):
            one.imu(waiting.pop(0))
        gray = np.zeros_like(drive.images[i]) if i in black else None
        outgoing += one.image(drive.image(i, gray))
    return outgoing


def diagnostics(one: Tracker) -> dict[str, str]:
    return {complaint.name: complaint.text for complaint in one.complaints}


# Gyro

def test_without_a_gyro_its_messages_change_nothing(drive: Drive) -> None:
    with_them, without = tracker(), tracker()
    heard = []
    for one, messages in ((with_them, drive.imu()), (without, [])):
        for message in messages:
            one.imu(message)
        heard.append([serialised(message.message) for message in played(one, drive, [])
                      if message.topic in POSES])
    assert heard[0] == heard[1]


def test_the_imu_offset_corrects_the_clock_of_a_gyro(drive: Drive) -> None:
    ahead = drive.imu()
    for message in ahead:
        message.header.stamp = MAKE.time(stamp_of(message) + 250_000_000)
    true, known, unknown = (
        [serialised(one.message)
         for one in played(tracker(**IMU, **{'odometry.imu_offset': offset}), drive, messages)
         if one.topic in POSES]
        for messages, offset in ((drive.imu(), 0.0), (ahead, 0.25), (ahead, 0.0)))
    assert true == known != unknown


@pytest.mark.slow
def test_a_gyro_continues_the_orientation_through_darkness() -> None:
    """A camera is stationary for three seconds, starts, and has black images for another two."""
    drive, dark = Drive(frames=30, standing=30), tuple(range(36, 56))
    one = tracker(**IMU)
    angles = {}
    for i in range(len(drive.images)):
        for message in drive.imu():
            if START + (i - 1) * PERIOD < stamp_of(message) <= START + i * PERIOD:
                one.imu(message)
        one.image(drive.image(i, np.zeros_like(drive.images[i]) if i in dark else None))
        assert one.last is not None
        angles[i] = rotation_angle(drive.turned(0, i), one.last.pose[:3, :3])
        if i in dark:
            assert one.last.status.value.startswith('TOO_FEW')
            off = angles[i]**2 / np.trace(one.last.pose_covariance[3:, 3:])
            assert off < 9
    assert max(angles.values()) < np.radians(0.5)
    assert one.last is not None and one.last.status.value == 'OK'


def test_without_a_gyro_the_orientation_after_darkness_is_unknown() -> None:
    drive, one = Drive(), tracker()
    for i in range(8):
        one.image(drive.image(i, np.zeros_like(drive.images[i]) if i > 3 else None))
    assert one.last is not None
    assert np.sqrt(one.last.pose_covariance[3:, 3:].trace()) > 3


def test_an_image_lacks_the_gyro_until_there_is_a_sample_at_its_stamp(drive: Drive) -> None:
    one = tracker(**IMU)
    samples = drive.imu()
    assert one.needs(drive.image(1)) == 'imu'
    for message in samples[:20]:  # up to 95 ms
        one.imu(message)
    assert one.needs(drive.image(1)) == 'imu'
    one.imu(samples[20])
    assert one.needs(drive.image(1)) == ''


@pytest.mark.parametrize(('what', 'name', 'text'), [
    ('none', 'no imu in time', "requires 'imu', and no sample was received; publish it"),
    ('late', 'no imu in time', 'images were processed without it'),
    ('nan', 'gyro samples of no use', '241 of 241 samples|of .* samples: not a rate'),
    ('unmounted', 'no mounting of imu', "no transform from 'camera' to 'imu'"),
])
def test_problems_of_a_gyro_are_reported_and_block_nothing(
        drive: Drive, what: str, name: str, text: str) -> None:
    one = tracker(**{**IMU, **({'odometry.imu_rotation': ''} if what == 'unmounted' else {})})
    samples = drive.imu()
    for i in range(len(drive.images)):
        for message in samples:
            late = 10 * PERIOD if what == 'late' else 0
            if what != 'none' and START + (i - 1) * PERIOD < stamp_of(message) + late \
                    <= START + i * PERIOD:
                if what == 'nan':
                    message.angular_velocity.y = float('nan')
                one.imu(message)
        one.image(drive.image(i))
    assert one.counts.status['OK'] == len(drive.images) - 1
    assert name in diagnostics(one)
    assert re.search(text, diagnostics(one)[name])
    assert one.diagnosis().level == 'WARN'


def test_a_gyro_with_a_wrong_mounting_is_reported_and_not_used() -> None:
    long = Drive(frames=45)
    one = tracker(**{**IMU, 'odometry.imu_rotation': '0 0 0 1'})
    for message in long.imu():
        # Rotations about all axes, to distinguish them.
        message.angular_velocity.x += 1.0
        one.imu(message)
    for i in range(len(long.images)):
        one.image(long.image(i))
    assert 'gyro does not fit' in diagnostics(one)
    assert one.last is not None and one.last.status.value == 'OK'


def test_a_rotation_of_the_imu_that_is_taken_back_is_looked_up_on_tf(drive: Drive) -> None:
    one = tracker(**{**IMU, 'odometry.imu_rotation': '0 0 0 1'})
    for message in drive.imu():
        one.imu(message)
    assert not one.wants_frames
    one.configure(with_values(one.config, {'odometry.imu_rotation': ''}))
    assert one.wants_frames
    assert one.missing_mountings('camera') == {'imu': ('camera', 'imu')}
    one.mount_sensor('imu', np.eye(4))
    one.configure(with_values(one.config, {'odometry.max_lost': 5}))
    assert not one.wants_frames


@pytest.mark.parametrize('text', ['1 0 0', '1 1 1 1', 'a b c d', 'nan 0 0 1'])
def test_an_invalid_rotation_is_refused(text: str) -> None:
    with pytest.raises(DjetError, match="imu_rotation is '.*'; give a quaternion"):
        from_flat({'odometry.imu_rotation': text})


# Live

class Graph:
    """Records what a session publishes, and knows one transform; rate: that of its clock."""

    def __init__(self) -> None:
        self.published: list[Any] = []
        self.rate = 1.0
        self.frames = StaticFrames()

    def publish(self, outgoing: Any) -> None:
        self.published += outgoing

    def log(self, level: str, text: str) -> None:
        pass

    def why_silent(self, topic: str) -> str:
        return ''

    def wants(self, topic: str) -> bool:
        return False

    def now_ns(self) -> int:
        return round(monotonic() * 1e9 * self.rate)

    def transform(self, base: str, camera: str) -> Array | None:
        return self.frames.transform(base, camera)


@pytest.fixture
def live() -> Iterator[Callable[..., tuple[Session, Tracker, Graph]]]:
    sessions = []

    def start(**values: Any) -> tuple[Session, Tracker, Graph]:
        graph, one = Graph(), Tracker(
            from_flat({'estimator.max_features': 500, 'ros.queue_policy': 'every',
                       'ros.queue_size': 100, **values}), message_type,
            image_topic='/camera/image_rect')
        session = Session(one, graph, {'image': '/i', 'camera_info': '/c'})
        session.camera_info(camera_info(K, SIZE))
        session.start()
        sessions.append(session)
        return session, one, graph

    yield start
    for session in sessions:
        session.stop(10)


def wait_for(one: Tracker, images: int) -> None:
    end = monotonic() + 30
    while one.counts.received < images:
        assert monotonic() < end
        sleep(0.005)  # for the worker thread


def mounting(drive: Drive) -> Any:
    where = np.eye(4)
    where[:3, :3] = drive.felt.to_camera
    return MAKE.frame(0, 'camera', 'imu', where)


@pytest.mark.parametrize('order', ['before', 'after'])
def test_live_gives_the_poses_of_the_tracker_to_the_last_bit(
        live: Any, drive: Drive, order: str) -> None:
    """Samples come before their images, or shortly after them."""
    expected = played(tracker(**IMU), drive, drive.imu())
    session, one, graph = live(**{'odometry.imu': True})
    graph.frames.add(mounting(drive))
    samples = drive.imu()
    for i in range(len(drive.images)):
        part = [message for message in samples
                if START + (i - 1) * PERIOD < stamp_of(message) <= START + i * PERIOD]
        if order == 'after':
            session.image(drive.image(i))
        for message in part:
            session.imu(message)
        if order == 'before':
            session.image(drive.image(i))
    wait_for(one, len(drive.images))
    session.configure(one.config)  # let in when the last image is published
    assert [serialised(message.message) for message in graph.published
            if message.topic in POSES] == [serialised(message.message) for message in expected
                                           if message.topic in POSES]


def test_with_policy_every_an_image_waits_while_samples_come(live: Any, drive: Drive) -> None:
    session, one, graph = live(**IMU, **{'ros.queue_policy': 'every'})
    for i in range(3):
        session.image(drive.image(i))
    for message in drive.imu()[:int(2 * PERIOD * 1e-9 * Mems.rate) + 1]:
        session.imu(message)
        sleep(0.01)
    wait_for(one, 3)
    session.configure(one.config)  # let in when the last image is published
    expected = played(tracker(**IMU), drive, drive.imu())
    ours = [serialised(message.message) for message in graph.published if message.topic in POSES]
    assert ours == [serialised(message.message) for message in expected
                    if message.topic in POSES][:len(ours)]
    assert len(ours) > 3


def test_an_image_does_not_wait_for_a_gyro_that_is_silent(live: Any, drive: Drive) -> None:
    session, one, _ = live(**IMU)
    start = monotonic()
    session.image(drive.image(0))
    session.image(drive.image(1))
    end = monotonic() + 30
    while one.counts.processed < 2:
        assert monotonic() < end
        sleep(0.005)  # for the worker thread
    assert monotonic() - start < 3


@pytest.mark.parametrize('policy', ['latest', 'every'])
def test_a_bag_that_is_played_slowly_loses_no_masks(live: Any, drive: Drive, policy: str) -> None:
    session, one, graph = live(**{'odometry.mask': True, 'ros.queue_policy': policy})
    graph.rate = 0.02
    all_free = np.full(SIZE[::-1], 255, np.uint8)
    for i in range(2):
        session.image(drive.image(i))
        sleep(0.5)  # 0.01 s of the clock
        assert one.counts.received == i
        session.mask(drive.image(i, all_free))
        wait_for(one, i + 1)


@pytest.mark.parametrize('policy', ['latest', 'every'])
def test_an_image_does_not_wait_for_a_clock_that_stands(
        live: Any, drive: Drive, policy: str) -> None:
    session, one, graph = live(**{'odometry.mask': True, 'ros.queue_policy': policy})
    graph.rate = 0.0
    start = monotonic()
    for i in range(5):
        session.image(drive.image(i))
        wait_for(one, i + 1)
    # It is found to stand once.
    assert monotonic() - start < 4


@pytest.mark.slow
def test_queued_images_still_have_their_samples(live: Any, drive: Drive) -> None:
    session, one, graph = live(**{'odometry.mask': True})
    all_free = np.full(SIZE[::-1], 255, np.uint8)
    for i in range(200):
        session.mask(drive.image(i, all_free))
        session.image(drive.image(i, drive.images[i % len(drive.images)]))
    wait_for(one, 200)
    session.configure(one.config)  # let in when the last image is done with
    assert one.counts.processed == 200
    diagnostics = [status.message for topic, message in graph.published if topic == '/diagnostics'
                   for status in message.status]
    assert diagnostics
    assert not any('no mask in time' in line for line in diagnostics)


# Masks

def test_masked_pixels_give_no_feature_and_no_surface(drive: Drive) -> None:
    left_out = np.zeros(SIZE[::-1], bool)
    left_out[:, :150] = True
    estimator = TwoViewEstimator()
    views = [estimator.view(gray, K, left_out=left_out) for gray in drive.images[:2]]
    assert min(view.features.points[:, 0].min() for view in views) > 150 + 12
    found = estimator.estimate(*views)
    assert found.inliers.sum() > 50
    assert found.y_opt[found.inliers, 0].min() > 150 + 10
    orb = TwoViewEstimator(from_flat({'estimator.detector': 'orb'}).estimator)
    assert orb.view(drive.images[0], K, left_out=left_out).features.points[:, 0].min() > 150


def test_points_outside_of_a_mask_are_not_ignored() -> None:
    points = np.array([[0.0, 0], [3, 2], [3.4, 2.4], [-0.4, -0.4], [3.6, 1], [1, 2.6], [-0.6, 1],
                       [1, -0.6]])
    assert masked_at(np.ones((3, 4), bool), points).tolist() == [True] * 4 + [False] * 4
    assert not masked_at(None, points).any()


def test_a_single_pixel_blocks_the_patches_around_it() -> None:
    left_out = np.zeros((60, 80), bool)
    left_out[30, 40] = True
    rows, columns = np.nonzero(blocked(left_out))
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (17, 43, 27, 53)


@pytest.mark.parametrize('kind', ['file', 'topic'])
def test_masked_pixels_have_no_influence(drive: Drive, kind: str) -> None:
    """
    The lower half is attached to the camera, as a bonnet would be, or unchanged.

    What is left has the whole width, which tells a turn to the side from a way to the side. (The
    right half alone would not: pictures of a few planes so narrow fit two motions.)
    """
    stuck = np.random.default_rng(0).integers(0, 256, (120, SIZE[0]), np.uint8)
    stuck = cv2.GaussianBlur(stuck, (0, 0), 1.5)
    mask = np.full(SIZE[::-1], 255, np.uint8)
    mask[120:] = 0
    values: dict[str, Any] = {'still': mask < 128} if kind == 'file' else {'odometry.mask': True}
    masked, clean, bare = tracker(**values), tracker(**values), tracker()
    off: dict[Tracker, list[tuple[float, float]]] = {masked: [], clean: [], bare: []}
    undisturbed = 0
    for i, gray in enumerate(drive.images):
        shown = gray.copy()
        shown[120:] = stuck
        for one, pixels in ((masked, shown), (clean, gray), (bare, shown)):
            if kind == 'topic' and one is not bare:
                assert one.needs(drive.image(i)) == 'mask'
                one.mask(drive.image(i, mask))
            assert one.needs(drive.image(i)) == ''
            one.image(drive.image(i, pixels))
            assert one.last is not None
            if i:
                off[one].append(drive.errors(i, one.last.motion))
        undisturbed += bare.last is not None and bare.last.status is Status.OK
        assert masked.last is not None and clean.last is not None
        if i and masked.last.relative is not None and clean.last.relative is not None:
            seen, shared = (set(map(tuple, pair.x.round(1)))
                            for pair in (masked.last.relative, clean.last.relative))
            assert len(seen & shared) > 0.9 * len(shared)
            assert max(y for _, y in seen) < 120 - 12
    # Masked pixels change the pose by less than a degree. Without the mask nothing tells whether
    # the camera moves above them, or stands still while the cards move.
    apart = np.abs(np.subtract(off[masked], off[clean]))
    assert (apart.max(0) < np.radians((0.1, 1))).all()
    assert (np.median(off[clean], axis=0) < np.radians((0.1, 1))).all()
    assert undisturbed == 0


def test_a_mask_of_another_size_is_an_error_and_not_forgotten(drive: Drive) -> None:
    one = tracker(still=np.zeros((10, 10), bool))
    one.image(drive.image(0))
    assert one.counts.rejected == {'mask_size': 1}
    assert 'odometry.mask_file has 10x10 pixels, the image 320x240' in str(one.problem)


def test_a_mask_is_of_one_size_also_where_the_camera_is_of_any() -> None:
    camera = Camera(K, np.empty(0), None)
    masks = Masks(np.zeros((48, 64), bool))
    assert masks.of(1, (48, 64), camera) is not None
    masks.add(image(np.zeros((24, 32), np.uint8), stamp_ns=2))
    for stamp in (2, 3):  # with another mask, and without one
        with pytest.raises(BadMessage, match='mask_file has 64x48 pixels, the image 32x24'):
            masks.of(stamp, (24, 32), camera)
    assert masks.of(4, (48, 64), camera) is not None


def test_masks_are_combined_with_unseen_pixels() -> None:
    camera = Camera(K, np.array([0.4, 0.1, 0, 0, 0]), SIZE)
    still = np.zeros(SIZE[::-1], bool)
    still[100:140, 100:200] = True
    unseen, both = (Masks(mask).of(1, still.shape, camera) for mask in (None, still))
    assert unseen is not None and both is not None
    assert unseen[0, 0] and not unseen[120, 160]
    assert both[0, 0] and both[120, 160] and (both >= unseen).all()


def test_a_mask_file_is_read_and_an_invalid_one_is_named(tmp_path: Path) -> None:
    assert static_mask('') is None
    gray = np.full((40, 60), 255, np.uint8)
    gray[20:] = 0
    cv2.imwrite(str(tmp_path / 'mask.png'), gray)
    mask = static_mask(str(tmp_path / 'mask.png'))
    assert mask is not None and mask[20:].all() and not mask[:20].any()
    with pytest.raises(DjetError, match='could not be read'):
        static_mask(str(tmp_path / 'nowhere.png'))


def test_masks_are_undistorted_with_their_images() -> None:
    one = Tracker(from_flat({}), message_type, image_topic='/camera/image_raw')
    one.camera_info(camera_info(K, SIZE, d=np.array([-0.3, 0.1, 0.0, 0.0, 0.0])))
    mask = np.full(SIZE[::-1], 255, np.uint8)
    mask[:, :60] = 0
    one.mask(image(mask, stamp_ns=START))
    assert one._camera is not None
    left_out = one._inputs.left_out(START, 'camera', mask.shape, one._camera)
    assert left_out is not None
    # Barrel distortion moves the middle of an edge less than its corners.
    ends = [int(np.flatnonzero(row)[-1]) for row in left_out[[0, 119]]]
    assert ends[0] != ends[1]


# Another odometry

def odometry(drive: Drive, index: int, T: Array, frame: str = 'base_link') -> Any:
    """Return the true pose of a base with the camera at T (4, 4), as Odometry."""
    base = T @ drive.poses[index] @ np.linalg.inv(T)
    stamped = MAKE.pose_in(START + index * PERIOD, 'wheels', base)
    with_covariance = message_type('geometry_msgs/msg/PoseWithCovariance')
    nothing = message_type('geometry_msgs/msg/Vector3')(x=0.0, y=0.0, z=0.0)
    return message_type('nav_msgs/msg/Odometry')(
        header=header(START + index * PERIOD, 'wheels'), child_frame_id=frame,
        pose=with_covariance(pose=stamped.pose, covariance=np.zeros(36)),
        twist=message_type('geometry_msgs/msg/TwistWithCovariance')(
            twist=message_type('geometry_msgs/msg/Twist')(linear=nothing, angular=nothing),
            covariance=np.zeros(36)))


def test_another_odometry_gives_the_length_through_its_mounting(drive: Drive) -> None:
    T = np.eye(4)
    T[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    T[:3, 3] = 1.2, 0.1, 0.8
    one = tracker(**{'odometry.scale': 'guess'})
    one.guess(odometry(drive, 0, T))
    assert one.missing_mountings('camera') == {'guess': ('base_link', 'camera')}
    one.mount_sensor('guess', T)
    for i in range(len(drive.images)):
        one.guess(odometry(drive, i, T))
        assert one.needs(drive.image(i)) == ''
        one.image(drive.image(i))
        if i:
            assert one.last is not None and one.last.scale_known
            true = np.linalg.norm(drive.poses[i][:3, 3] - drive.poses[i - 1][:3, 3])
            # Fused with the lengths by landmarks.
            assert one.last.scale == pytest.approx(true, rel=0.01)


def test_a_guess_finds_matches_beyond_the_search_radius() -> None:
    """At 0.35 rad a frame half of the image leaves the view, and the rest moves far."""
    cards = Cards()
    far = Drive(frames=3)
    far.poses = [np.eye(4), pose(x=0.4, z=0.1, yaw=0.35), pose(x=0.8, z=0.2, yaw=0.0)]
    far.images = [cards.gray(one) for one in far.poses]
    one = tracker(**{'odometry.guess': True, 'estimator.search_radius': 0.05})
    one.guess(odometry(far, 0, np.eye(4), 'camera'))
    one.mount_sensor('guess', np.eye(4))
    for i in range(3):
        one.guess(odometry(far, i, np.eye(4), 'camera'))
        one.image(far.image(i))
        if i:
            assert one.last is not None and one.last.status.value == 'OK'
            assert rotation_angle(one.last.motion[:3, :3], far.turned(i - 1, i)) < np.radians(0.2)


def test_static_frames_are_chained_in_both_directions() -> None:
    frames = StaticFrames()
    a, b = pose(x=1.0, yaw=0.3), pose(z=2.0, yaw=-0.2)
    frames.add(MAKE.frame(0, 'base_link', 'mast', a))
    frames.add(MAKE.frame(0, '/mast', 'imu', b))
    assert np.allclose(frames.transform('base_link', 'imu'), a @ b)
    assert np.allclose(frames.transform('imu', 'base_link'), np.linalg.inv(a @ b))
    assert frames.transform('base_link', 'camera') is None
    assert np.array_equal(frames.transform('imu', 'imu'), np.eye(4))


# Another odometry by tf

def moved(stamp: int, parent: str, child: str, pose: Array) -> Any:
    return MAKE.frame(stamp, parent, child, pose)


def test_frames_that_move_are_chained_between_their_stamps() -> None:
    frames = MovingFrames()
    a, b, c = pose(x=1.0, yaw=0.3), pose(z=2.0, yaw=-0.2), pose(x=0.1)
    frames.add(moved(0, 'mast', 'camera', c), static=True)
    for stamp, yaw in ((0, 0.0), (100, 0.4), (300, 0.4)):
        frames.add(moved(stamp, 'base_link', '/mast', pose(yaw=yaw)), static=False)
    for stamp, where in ((0, a), (200, a @ b)):
        frames.add(moved(stamp, '/odom', 'base_link', where), static=False)
    found = frames.poses('odom', 'camera', np.array([0, 50, 100, 200, 250]))
    assert np.allclose(found[0], a @ c)
    assert np.allclose(found[3], a @ b @ pose(yaw=0.4) @ c)
    assert np.allclose(found[1][:3, 3], (a @ pose(z=0.5, yaw=-0.05) @ pose(yaw=0.2) @ c)[:3, 3],
                       atol=0.01)
    assert np.isnan(found[4]).all()
    # Down the tree, and of another tree.
    down = frames.poses('camera', 'odom', np.array([0]))
    assert np.allclose(down[0], np.linalg.inv(a @ c))
    assert np.isnan(frames.poses('map', 'camera', np.array([0]))).all()
    assert frames.covers('odom', 'camera', 200) and not frames.covers('odom', 'camera', 250)
    assert frames.covers('base_link', 'camera', 300) and not frames.covers('map', 'camera', 0)
    frames.forget_before(200)
    assert np.isfinite(frames.poses('odom', 'camera', np.array([200]))).all()
    # Static transforms are kept.
    frames.reset()
    assert not frames.covers('odom', 'base_link', 0)
    assert np.allclose(frames.poses('mast', 'camera', np.array([200])), c)


def test_a_loop_of_frames_terminates() -> None:
    frames = MovingFrames()
    frames.add(moved(0, 'a', 'b', np.eye(4)), static=False)
    frames.add(moved(0, 'b', 'a', np.eye(4)), static=False)
    assert np.isnan(frames.poses('odom', 'a', np.array([0]))).all()


def tf_of(drive: Drive, index: int, T: Array) -> Any:
    return moved(START + index * PERIOD, 'wheels', 'base_link',
                 T @ drive.poses[index] @ np.linalg.inv(T))


def test_tf_gives_what_the_topic_gives(drive: Drive) -> None:
    T = pose(x=1.2, yaw=0.4)
    by_topic = tracker(**{'odometry.scale': 'guess'})
    by_tf = tracker(**{'odometry.scale': 'guess', 'odometry.guess_frame': 'wheels'})
    mounted = moved(START, 'base_link', 'camera', T)
    by_topic.guess(odometry(drive, 0, T))
    by_topic.mount_sensor('guess', pose_of(mounted.transforms[0])[1])
    assert by_tf.needs(drive.image(0)) == 'guess'
    by_tf.tf_static(mounted)
    for i in range(len(drive.images)):
        by_topic.guess(odometry(drive, i, T))
        by_tf.tf(tf_of(drive, i, T))
        assert by_tf.needs(drive.image(i)) == ''
        for one in (by_topic, by_tf):
            one.image(drive.image(i))
        assert by_topic.last is not None and by_tf.last is not None
        assert np.allclose(by_topic.last.pose, by_tf.last.pose, rtol=0, atol=1e-9)
    assert by_tf.last.measured and by_tf.last.status.value == 'OK'


def test_a_frame_that_is_missing_on_tf_is_reported_by_name(drive: Drive) -> None:
    one = tracker(**{'odometry.guess': True, 'odometry.guess_frame': 'wheels'})
    for i in range(6):
        one.image(drive.image(i))
    assert "from 'wheels' (odometry.guess_frame) to 'camera'" in diagnostics(one)[
        'no guess in time']


def test_our_own_output_is_refused_as_a_guess() -> None:
    with pytest.raises(DjetError, match="^odometry.guess_frame is 'odom'"):
        from_flat({'odometry.guess_frame': 'odom', 'ros.publish_tf': True})


def test_live_follows_tf_to_the_last_bit(live: Any, drive: Drive) -> None:
    values = {'odometry.guess': True, 'odometry.guess_frame': 'wheels'}
    T, alone = pose(x=1.2, yaw=0.4), tracker(**values)
    session, one, graph = live(**values)
    for face in (alone, session):
        face.tf_static(moved(START, 'base_link', 'camera', T))
    expected = []
    for i in range(len(drive.images)):
        alone.tf(tf_of(drive, i, T))
        expected += [serialised(message.message) for message in alone.image(drive.image(i))
                     if message.topic in POSES]
        session.image(drive.image(i))  # before its transforms
        session.tf(tf_of(drive, i, T))
    wait_for(one, len(drive.images))
    session.configure(one.config)
    assert [serialised(message.message) for message in graph.published
            if message.topic in POSES] == expected
