"""The tracker from messages to messages, and the counts of all images."""

import gc
import re
import weakref

from cards import Cards, K, pose, SIZE
import cv2
from djet_ros.config.flat import from_flat, with_values
from djet_ros.config.sections import Config
from djet_ros.core.masks import masked_at
from djet_ros.core.types import RelativePose, Status
from djet_ros.odometry.camera import Camera
from djet_ros.odometry.debug_image import debug_image
from djet_ros.odometry.diagnostics import Counts, diagnose, StampRate
from djet_ros.odometry.messages import (
    frame_status,
    FrameStatus,
    in_convention,
    OPTICAL_TO_BODY,
    pose_of,
    stamp_ns,
)
from djet_ros.odometry.scale import Scale
from djet_ros.odometry.state import LEVELS, State
from djet_ros.odometry.tracker import Tracker
from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
from ros_messages import camera_info, compressed, header, image, message_type, serialised

STEP = pose(x=0.25, z=0.15, yaw=0.01)
RAW = '/camera/image_raw'
FAST = {'estimator.max_features': 600}


@pytest.fixture(scope='module')
def drive():
    """Return the images of a drive of 12 frames."""
    cards, here, images = Cards(), np.eye(4), []
    for _ in range(12):
        images.append(cards.gray(here))
        here = here @ STEP
    return images


def tracker(info=True, topic=RAW, **values):
    result = Tracker(from_flat({**FAST, **values}), message_type, image_topic=topic)
    if info:
        assert result.camera_info(camera_info(K, SIZE)) == []
    return result


def ns(seconds):
    return round(seconds * 1e9)


def play(tracker, images, start=0.0, period=0.1):
    """Process images, return the messages of each by topic."""
    return [by_topic(tracker.image(image(gray, stamp_ns=ns(start + i * period))))
            for i, gray in enumerate(images)]


def by_topic(outgoing):
    for _, message in outgoing:
        assert len(serialised(message)) > 0
    topics = [topic for topic, _ in outgoing]
    assert len(set(topics)) == len(topics)
    return dict(outgoing)


def values(diagnostics):
    return {pair.key: pair.value for pair in diagnostics.status[0].values}


def accounted(counts):
    return counts.processed + counts.dropped.total() + counts.rejected.total()


def test_a_drive_gives_relative_poses_and_odometry_with_the_images_stamps(drive):
    out = play(tracker(), drive[:4])
    assert set(out[0]) == {'relative_pose_status', 'odometry', '/diagnostics'}
    for i, messages in enumerate(out[1:], 1):
        assert {'relative_pose', 'relative_pose_cov', 'odometry'} <= set(messages)
        for topic in ('relative_pose', 'relative_pose_cov', 'odometry'):
            assert stamp_ns(messages[topic].header) == ns(i * 0.1)
    position = out[3]['odometry'].pose.pose.position
    ahead = np.array([position.x, position.y, position.z]) / 3
    # x forward, y left, z up
    direction = OPTICAL_TO_BODY @ STEP[:3, 3] / np.linalg.norm(STEP[:3, 3])
    assert np.degrees(np.arccos(ahead @ direction / np.linalg.norm(ahead))) < 8


def test_the_same_messages_give_the_same_bytes_also_after_a_reset(drive):
    def poses(tracker):
        return [serialised(message) for out in play(tracker, drive[:4])
                for topic, message in out.items() if topic != '/diagnostics']

    one = tracker()
    first = poses(one)
    assert first == poses(tracker())
    one.reset()
    assert one.counts == Counts()
    assert one.last is None
    assert first == poses(one)


@pytest.fixture(params=[1, 2])
def threads(request):
    before = cv2.getNumThreads()
    cv2.setNumThreads(request.param)
    yield request.param
    cv2.setNumThreads(before)


def meddle(one, number):
    """Change a tracker before an image, so that its preparation may be invalid."""
    if number == 2:
        one.camera_info(camera_info(K * [[1.01], [1.01], [1]], SIZE))
    elif number == 4:
        one.configure(with_values(one.config, {'estimator.max_features': 400}))
    elif number in (6, 7):
        (one.pause if number == 6 else one.resume)()
    elif number == 8:
        one.reset()


@pytest.mark.slow
def test_images_prepared_ahead_give_the_same_results(drive, threads):
    def results(ahead):
        """Return all messages of images, of which so many are prepared ahead."""
        one = tracker()
        messages = [image(gray, stamp_ns=ns(0.1 * i)) for i, gray in enumerate(drive)]
        messages[9].height += 1  # than there are rows
        out = []
        for i, message in enumerate(messages):
            for following in messages[i + 1:i + 1 + ahead]:
                one.prepare_ahead(following)
            meddle(one, i)
            out.append([serialised(what) for topic, what in one.image(message)
                        if topic != '/diagnostics'])
        return out, one.counts

    alone = results(0)
    assert alone[1].rejected == {'short_data': 1}
    assert results(1) == results(2) == results(3) == alone


def test_a_mask_applies_to_an_image_that_was_prepared_before_it_came(drive, threads):
    hidden = np.full(SIZE[::-1], 255, np.uint8)
    hidden[:, :SIZE[0] // 2] = 0

    def seen(ahead):
        one = tracker(**{'odometry.mask': True})
        messages = [image(gray, stamp_ns=ns(0.1 * i)) for i, gray in enumerate(drive[:3])]
        for i, message in enumerate(messages):
            if ahead and i + 1 < len(messages):
                one.prepare_ahead(messages[i + 1])
            one.mask(image(hidden, stamp_ns=ns(0.1 * i)))
            one.image(message)
        return one.last.relative

    alone, expected = seen(False), seen(True)
    assert alone.x[:, 0].min() > SIZE[0] // 2
    np.testing.assert_array_equal(expected.x, alone.x)
    np.testing.assert_array_equal(expected.y_opt, alone.y_opt)


def test_unseen_pixels_are_ignored_prepared_ahead_or_not(drive, threads):
    D = np.array([0.3, 0.1, 0, 0, 0])
    unseen = Camera(K, D, SIZE).unseen(SIZE[::-1])

    def seen(ahead):
        one = tracker(info=False)
        one.camera_info(camera_info(K, SIZE, d=D))
        messages = [image(gray, stamp_ns=ns(0.1 * i)) for i, gray in enumerate(drive[:3])]
        for i, message in enumerate(messages):
            if ahead and i + 1 < len(messages):
                one.prepare_ahead(messages[i + 1])
            one.image(message)
        return one.last.relative

    alone, expected = seen(False), seen(True)
    assert not masked_at(unseen, alone.x).any() and not masked_at(unseen, alone.y_opt).any()
    assert masked_at(unseen, np.indices(SIZE).reshape(2, -1).T).mean() > 0.05
    np.testing.assert_array_equal(expected.x, alone.x)
    np.testing.assert_array_equal(expected.y_opt, alone.y_opt)


@pytest.mark.slow
@pytest.mark.parametrize('threads', [1], indirect=True)
def test_images_prepared_ahead_that_never_come_are_forgotten(drive, threads):
    one = tracker()
    expected = [image(gray, stamp_ns=ns(10 + i)) for i, gray in enumerate(drive)]
    gone = [weakref.ref(message) for message in expected]
    for message in expected:
        one.prepare_ahead(message)
    del message, expected
    gc.collect()
    assert sum(ref() is not None for ref in gone) <= 2
    one.reset()
    gc.collect()
    assert not any(ref() for ref in gone)


def test_compressed_images_are_tracked_like_raw_ones(drive):
    one = tracker()
    for i, gray in enumerate(drive[:3]):
        png = cv2.imencode('.png', gray)[1].tobytes()
        out = by_topic(one.image(compressed(png, 'png', ns(i * 0.1))))
    reference = tracker()
    expected = play(reference, drive[:3])[-1]
    assert serialised(out['odometry']) == serialised(expected['odometry'])


# CameraInfo: latched, periodic, late, changing

def test_images_before_any_camera_info_are_counted_and_reported(drive):
    one = tracker(info=False)
    out = play(one, drive[:3])
    assert out[0]['/diagnostics'].status[0].message == 'waiting for camera_info'
    assert out[0]['/diagnostics'].status[0].level == 1
    assert one.counts.dropped == {'waiting_for_camera_info': 3}
    assert one.camera_info(camera_info(K, SIZE)) == []
    later = play(one, drive[3:6], start=0.3)
    assert one.counts.processed == 3
    assert 'relative_pose' in later[1]
    assert accounted(one.counts) == one.counts.received == 6


def test_a_periodic_camera_info_changes_nothing(drive):
    one = tracker()
    for i, gray in enumerate(drive[:4]):
        one.camera_info(camera_info(K, SIZE, stamp_ns=ns(i * 0.1)))
        one.image(image(gray, stamp_ns=ns(i * 0.1)))
    assert one.counts.status == {'FIRST_FRAME': 1, 'OK': 3}


def test_another_calibration_begins_a_new_pair(drive):
    one = tracker()
    play(one, drive[:2])
    one.camera_info(camera_info(K * [[1.05], [1.05], [1]], SIZE))
    out = play(one, drive[2:4], start=0.2)
    assert one.counts.status == {'FIRST_FRAME': 1, 'OK': 2, 'SIZE_CHANGED': 1}
    assert out[0]['/diagnostics'].status[0].message == 'restarted: SIZE_CHANGED'


def test_an_uncalibrated_camera_is_an_error_until_it_is_calibrated(drive):
    one = tracker(info=False)
    zeros = camera_info(np.zeros((3, 3)), SIZE, p=np.zeros(12))
    statuses = by_topic(one.camera_info(zeros))['/diagnostics'].status[0]
    assert (statuses.level, statuses.message) == (2, 'message rejected: uncalibrated')
    assert 'calibrate' in str(one.problem)
    play(one, drive[:2])
    assert one.counts.rejected_infos == {'uncalibrated': 1}
    assert one.diagnosis().level == 'ERROR'
    one.camera_info(camera_info(K, SIZE))
    assert one.problem is None
    play(one, drive[2:4], start=0.2)
    assert one.diagnosis().level == 'OK'


def test_distorted_raw_images_are_undistorted_and_rectified_ones_are_not(drive):
    info = camera_info(K, SIZE, d=np.array([-0.2, 0.05, 0, 0, 0]))
    poses = {}
    for topic in (RAW, '/camera/image_rect'):
        one = tracker(info=False, topic=topic)
        one.camera_info(info)
        play(one, drive[:2])
        poses[topic] = one.last.pose
    plain = tracker()
    play(plain, drive[:2])
    assert np.array_equal(poses['/camera/image_rect'], plain.last.pose)
    assert not np.array_equal(poses[RAW], plain.last.pose)


def test_a_residual_distortion_gives_what_the_same_one_of_the_calibration_gives(drive):
    sent_bytes = []
    for topic, k1, D in ((RAW, 0.0, [0.05, 0, 0, 0, 0]), (RAW, 0.05, []),
                         ('/camera/image_rect', 0.05, [])):
        one = tracker(info=False, topic=topic, **{'odometry.residual_k1': k1})
        one.camera_info(camera_info(K, SIZE, d=np.array(D)))
        sent_bytes.append([serialised(message) for out in play(one, drive[:3])
                           for name, message in out.items() if name != '/diagnostics'])
    assert len(sent_bytes[0]) > 6
    assert sent_bytes[0] == sent_bytes[1] == sent_bytes[2]


# The status for a back end

def test_the_status_of_each_frame_names_the_reference_of_its_relative_pose(drive):
    one = tracker(**{'odometry.max_lost': 2, 'odometry.scale': 'constant',
                     'odometry.scale_value': 1.0})
    black = np.zeros_like(drive[0])
    images = [drive[0], drive[1], drive[1], drive[2], black, drive[3], black, black, drive[4],
              drive[5]]
    statuses = [frame_status(out['relative_pose_status']) for out in play(one, images)]
    stamps = [ns(0.1 * i) for i in range(len(images))]
    bad = Status.TOO_FEW_MATCHES
    scales = {True: Scale.METRIC, False: Scale.UNKNOWN}
    assert statuses == [FrameStatus(stamps[i], status, None if start is None else stamps[start],
                                    scales[known], still) for i, status, start, known, still in [
        (0, Status.FIRST_FRAME, None, False, False),
        (1, Status.OK, 0, True, False),
        (2, Status.NO_PARALLAX, 1, True, True),
        # after a standstill, so the reference is from before it
        (3, Status.OK, 1, True, False),
        (4, bad, None, False, False),
        # bridged
        (5, Status.OK, 3, True, False),
        (6, bad, None, False, False),
        (7, bad, None, False, False),
        (8, bad, None, False, False),
        # a gap: the reference has no relative pose itself
        (9, Status.OK, 8, True, False)]]


def test_the_diagnostics_of_two_nodes_are_distinguished(drive):
    for node in ('vo_node', 'left/vo_node'):
        one = Tracker(from_flat(FAST), message_type, node=node)
        one.camera_info(camera_info(K, SIZE))
        out = by_topic(one.image(image(drive[0], stamp_ns=0, frame_id='left_camera')))
        status, = out['/diagnostics'].status
        assert (status.name, status.hardware_id) == (f'{node}: visual odometry', 'left_camera')
        status, = out['relative_pose_status'].status
        assert (status.name, status.hardware_id) == (f'{node}: relative pose', 'left_camera')


# Time

def test_an_equal_stamp_drops_the_image(drive):
    one = tracker()
    play(one, drive[:2])
    assert play(one, [drive[2]], start=0.1) == [{}]
    assert one.counts.dropped == {'equal_stamp': 1}
    play(one, [drive[2]], start=0.2)
    assert one.counts.status == {'FIRST_FRAME': 1, 'OK': 2}


def test_looping_bag_resets_the_odometry(drive):
    one = tracker(**{'ros.publish_path': True, 'ros.path_period': 0.0})
    first = play(one, drive[:8], start=50.0)
    again = play(one, drive[:8], start=50.0)
    assert one.counts.status == {'FIRST_FRAME': 1, 'OK': 14, 'TIME_JUMP': 1}
    assert again[0]['/diagnostics'].status[0].message == 'restarted: TIME_JUMP'
    for before, after in zip(first, again, strict=True):
        assert serialised(before['odometry']) == serialised(after['odometry'])
        assert len(before['path'].poses) == len(after['path'].poses)


@pytest.mark.slow
@pytest.mark.parametrize('late', [0.05, 0.1, 0.45])
def test_a_late_image_is_dropped_and_counted_and_changes_no_pose(drive, late):
    one, undisturbed = tracker(), tracker()
    play(undisturbed, drive[:8])
    play(one, drive[:6])
    assert by_topic(one.image(image(drive[3], stamp_ns=ns(0.5 - late)))) == {}
    play(one, drive[6:8], start=0.6)
    assert one.counts.dropped == {'late': 1}
    assert np.array_equal(one.last.pose, undisturbed.last.pose)


def in_a_row(one, stamped):
    """Process pairs of an image and its seconds, each with the following one."""
    messages = [image(gray, stamp_ns=ns(seconds)) for gray, seconds in stamped]
    for message, following in zip(messages, [*messages[1:], None]):
        one.image(message, following)


@pytest.mark.slow
@pytest.mark.parametrize('ahead', [1.5, 5.0, 1e6])
def test_an_image_stamped_ahead_is_dropped_and_the_trajectory_continues(drive, ahead):
    one, undisturbed = tracker(), tracker()
    in_a_row(one, [(gray, 50 + 0.1 * i + (ahead if i == 6 else 0))
                   for i, gray in enumerate(drive)])
    in_a_row(undisturbed, [(gray, 50 + 0.1 * i) for i, gray in enumerate(drive) if i != 6])
    assert one.counts.dropped == {'ahead': 1}
    assert accounted(one.counts) == one.counts.received == 12
    assert one.counts.status == {'FIRST_FRAME': 1, 'OK': 10}
    assert np.array_equal(one.last.pose, undisturbed.last.pose)


@pytest.mark.parametrize(('ahead', 'rate', 'late'), [(0.25, 10, 2), (0.55, 10, 5), (0.85, 10, 6),
                                                     (0.55, 30, 16)])
def test_an_image_stamped_ahead_within_a_gap_does_not_change_the_trajectory(
        drive, ahead, rate, late):
    one = tracker()
    there_and_back = [*drive, *drive[-2:0:-1]]
    in_a_row(one, [(gray, 50 + i / rate + (ahead if i == 3 else 0))
                   for i, gray in enumerate(there_and_back[:10 if rate == 10 else 22])])
    assert one.counts.dropped == {'late': late}
    assert 'TIME_JUMP' not in one.counts.status
    assert one.counts.status['FIRST_FRAME'] == 1


def test_stamps_that_go_back_before_the_last_two_images_reset_the_odometry(drive):
    one = tracker()
    in_a_row(one, [(drive[i], seconds) for i, seconds in enumerate([50.0, 50.1, 50.9, 50.05])])
    assert one.counts.dropped == {}
    assert one.counts.status == {'FIRST_FRAME': 1, 'OK': 2, 'TIME_JUMP': 1}


@pytest.mark.parametrize('then', [2.1, 4.1, -40.0])
def test_after_a_gap_or_where_stamps_go_back_for_good_no_image_counts_as_ahead(drive, then):
    one = tracker()
    in_a_row(one, [(drive[0], 50.0), (drive[1], 50.1), (drive[2], 52.0), (drive[3], 50 + then)])
    assert one.counts.dropped == {}
    assert one.counts.processed == 4


def test_stamps_that_go_back_a_little_for_good_reset_the_odometry(drive):
    one = tracker(**{'odometry.max_backwards': 3.0})
    play(one, drive[:3], start=50.0)
    play(one, drive[:12], start=48.0)
    assert one.counts.dropped == {'late': 9}
    assert one.counts.status == {'FIRST_FRAME': 1, 'TIME_JUMP': 1, 'OK': 4}


def test_a_restart_is_explained(drive):
    one = tracker()
    play(one, drive[:2], start=50.0)
    play(one, drive[:1], start=20.0)
    assert one.remark.startswith('the stamps went back by 30.100 s')
    assert one.remark.endswith('the odometry restarts, and odom jumps to the origin')
    play(one, drive[:1], start=25.0)
    assert one.remark.startswith('5.000 s without an image')


def test_a_gap_begins_a_new_pair_and_keeps_the_pose(drive):
    one = tracker(**{'odometry.max_gap': 0.5})
    play(one, drive[:3])
    before = one.last.pose
    out = play(one, drive[3:5], start=5.0)
    assert 'relative_pose' not in out[0]
    assert np.array_equal(one.last.pose[:3, 3] != before[:3, 3], [True] * 3)
    assert one.counts.status == {'FIRST_FRAME': 1, 'OK': 3, 'TIME_JUMP': 1}
    covariance = np.reshape(out[0]['odometry'].pose.covariance, (6, 6))
    assert covariance[0, 0] > 1e5


# Problems that would go unnoticed

def problems_of(one):
    """Return level and summary of the diagnosis, and its problems."""
    status = one.diagnosis()
    problems = {name.removeprefix('to mend: '): text for name, text in status.values.items()
                if name.startswith('to mend: ')}
    return status.level, status.summary, problems


def test_a_healthy_drive_has_no_problems(drive):
    one = tracker()
    play(one, drive)
    assert problems_of(one) == ('OK', 'tracking', {})


@pytest.mark.parametrize('stamp', [0, ns(12.5)])
def test_constant_stamps_are_reported_as_an_error(drive, stamp):
    one = tracker()
    out = [by_topic(one.image(image(gray, stamp_ns=stamp))) for gray in drive]
    level, summary, found = problems_of(one)
    assert (level, summary) == ('ERROR', 'started; stamps stand still')
    assert f'have the stamp {stamp // 10**9}.{stamp % 10**9:09d}' in found['stamps stand still']
    assert 'the camera driver has to stamp each image' in found['stamps stand still']
    # reported once, not with each image
    assert sum('/diagnostics' in messages for messages in out) == 2
    play(one, drive[:2], start=20.0)
    assert problems_of(one)[2] == {}


@pytest.mark.slow
@pytest.mark.parametrize('prepared', [False, True])
def test_few_gray_levels_of_12_bits_are_reported_and_corrected_by_the_range(drive, prepared):
    def sent(one, first):
        messages = [image(gray.astype('<u2') * 16, 'mono16', ns(0.1 * (first + i)))
                    for i, gray in enumerate(drive)]
        for message, after in zip(messages, [*messages[1:], None]):
            if prepared and after is not None:
                one.prepare_ahead(after)
            one.image(message)
        return one.last.pose

    one, eight, twelve = tracker(), tracker(), tracker(**{'odometry.gray_range': '0 4095'})
    sent(one, 0)
    text = problems_of(one)[2]['few gray levels']
    assert re.match(r'\d+ images of 16 bits in a row became 1?\d gray levels with odometry'
                    r'.gray_range 0 65535; their values lie between \d+ and \d+: set', text)
    play(eight, drive)
    assert np.array_equal(sent(twelve, 0), eight.last.pose)
    assert problems_of(twelve)[2] == {}
    # and while it runs
    one.configure(from_flat({**FAST, 'odometry.gray_range': '0 4095'}))
    sent(one, len(drive))
    assert problems_of(one)[2] == {}


def test_masks_that_exclude_the_images_are_reported(drive):
    one, seen = tracker(**{'odometry.mask': True}), []
    for i, gray in enumerate(drive):
        # Only the last one has 255 for what is to be used.
        mask = np.full(gray.shape, 255 if i == len(drive) - 1 else 1, np.uint8)
        one.mask(image(mask, 'mono8', ns(0.1 * i)))
        one.image(image(gray, 'mono8', ns(0.1 * i)))
        seen.append(problems_of(one)[2].get('mask excludes the image', ''))
    assert seen[:4] == [''] * 4
    assert seen[-1] == ''
    assert all('excludes 100% of the image: pixels below 128 are' in text for text in seen[4:-1])


def test_a_change_of_the_gray_range_applies_to_an_image_prepared_before(drive):
    message = image(drive[0].astype('<u2') * 16, 'mono16', 1)
    one = tracker()
    one.prepare_ahead(message)
    one.configure(from_flat({**FAST, 'odometry.gray_range': '0 4095'}))
    one.image(message)
    assert np.array_equal(one._frame.gray, drive[0])


def test_one_repeated_image_is_no_problem(drive):
    one = tracker()
    for i, gray in enumerate(drive):
        play(one, [gray, gray], start=0.1 * i, period=0.0)
    assert one.counts.dropped == {'equal_stamp': 12}
    assert problems_of(one) == ('OK', 'tracking', {})


def speed(seconds, metres_per_second=3.0):
    vector = message_type('geometry_msgs/msg/Vector3')
    return message_type('geometry_msgs/msg/TwistStamped')(
        header=header(ns(seconds)), twist=message_type('geometry_msgs/msg/Twist')(
            linear=vector(x=metres_per_second, y=0.0, z=0.0),
            angular=vector(x=0.0, y=0.0, z=0.0)))


@pytest.mark.slow
@pytest.mark.parametrize(('off', 'seen'), [
    (None, 'no speed was received; publish it on speed or speed_odometry, stamped by the clock'),
    (100.0, r'the newest speed is stamped 100\.\d s after the newest image'),
    (-100.0, r'the newest speed is stamped 100\.\d s before the newest image')])
def test_a_speed_that_is_missing_or_of_another_clock_is_reported_with_the_remedy(drive, off, seen):
    one = tracker(**{'odometry.scale': 'speed'})
    for i, gray in enumerate(drive):
        if off is not None:
            one.speed(speed(200 + 0.1 * i + off))
        play(one, [gray], start=200 + 0.1 * i)
    level, summary, found = problems_of(one)
    assert (level, summary) == ('WARN', 'tracking; no metric length')
    assert re.search(seen, found['no metric length'])
    for i, gray in enumerate(drive):
        one.speed(speed(201.2 + 0.1 * i if off != 100.0 else 301.2 + 0.1 * i))
        play(one, [gray], start=201.2 + 0.1 * i if off != 100.0 else 301.2 + 0.1 * i)
    assert problems_of(one) == ('OK', 'tracking', {})


def test_ground_that_is_never_visible_is_reported(drive):
    one = tracker(**{'odometry.scale': 'camera_height', 'odometry.camera_height': 1.0})
    play(one, [np.rot90(gray, 2) for gray in drive])
    assert 'no level ground' in problems_of(one)[2]['no metric length']


def test_many_images_dropped_under_load_are_a_warning_and_few_are_none(drive):
    one = tracker()
    play(one, drive)
    one.count_dropped('queue_full', 1)
    assert problems_of(one) == ('OK', 'tracking', {})
    one.count_dropped('queue_full', 8)
    level, summary, found = problems_of(one)
    assert (level, summary) == ('WARN', 'tracking; images dropped under load')
    assert '43% of the newest 21 images' in found['images dropped under load']


@pytest.mark.slow
@pytest.mark.parametrize(('apart', 'dropped'), [
    (0.0, {'equal_stamp': 12}), (0.05, {}), (-0.12, {'late': 12})])
def test_two_cameras_on_one_topic_are_a_warning_whatever_their_stamps_are(drive, apart, dropped):
    one = tracker()
    for i in range(12):
        for gray, frame, later in zip(drive, ('left', 'right'), (0.0, apart)):
            one.image(image(gray, stamp_ns=ns(5 + 0.1 * i + later), frame_id=frame))
    assert {reason: n for reason, n in one.counts.dropped.items() if n > 2} == dropped
    level, _, found = problems_of(one)
    assert level != 'OK'
    assert '23 of the newest 24 images had another frame_id' in found['images of two cameras']


def test_one_camera_that_is_renamed_is_not_taken_for_two(drive):
    one = tracker()
    for i in range(24):
        one.image(image(drive[i % 2], stamp_ns=ns(0.1 * i), frame_id='a' if i < 12 else 'b'))
    assert 'images of two cameras' not in problems_of(one)[2]


@pytest.mark.parametrize(('info', 'images', 'statuses'), [
    ('left', 'right', True), ('left', '/left', False), ('', 'left', False), ('left', '', False)])
def test_a_camera_info_of_another_frame_is_a_warning(drive, info, images, statuses):
    one = tracker(info=False)
    one.camera_info(camera_info(K, SIZE, header=header(0, info)))
    for i, gray in enumerate(drive[:2]):
        one.image(image(gray, stamp_ns=ns(0.1 * i), frame_id=images))
    level, _, found = problems_of(one)
    assert ('camera_info of another frame' in found) is statuses
    if statuses:
        assert level == 'WARN'
        assert "of frame 'left', the images are of 'right'" in found[
            'camera_info of another frame']


@pytest.mark.parametrize(('frame', 'parameters', 'name', 'remedy'), [
    ('', {}, 'no frame_id', 'set it in the camera driver, or odometry.camera_frame'),
    ('odom', {}, 'frame_id is odom_frame', 'set odometry.camera_frame or odometry.odom_frame'),
    ('map', {'odometry.odom_frame': 'map'}, 'frame_id is odom_frame', 'set odometry.camera_frame'),
])
def test_a_frame_that_is_invalid_on_tf_is_reported_and_not_published(
        drive, frame, parameters, name, remedy):
    one = tracker(info=False, **{'ros.publish_tf': True, **parameters})
    one.camera_info(camera_info(K, SIZE, header=header(0, frame)))
    out = [by_topic(one.image(image(gray, stamp_ns=ns(0.1 * i), frame_id=frame)))
           for i, gray in enumerate(drive[:3])]
    assert not any('/tf' in messages for messages in out)
    level, _, found = problems_of(one)
    assert level in ('WARN', 'ERROR')
    assert remedy in found[name]
    one.configure(with_values(one.config, {'odometry.camera_frame': 'cam'}))
    named = by_topic(one.image(image(drive[3], stamp_ns=ns(0.3), frame_id=frame)))
    assert named['/tf'].transforms[0].child_frame_id == 'cam'
    assert problems_of(one)[2] == {}


@pytest.mark.parametrize('scale, metres, warned', [
    ('structure', 0.4, True), ('none', 0.4, True), ('structure', 0.0, False),
    ('constant', 0.4, False)])
def test_a_camera_beside_its_base_needs_metres(drive, scale, metres, warned):
    one = tracker(**{'odometry.base_frame': 'base_link', 'odometry.scale': scale,
                     'odometry.scale_value': 0.2})
    mounting = np.eye(4)
    mounting[0, 3] = metres
    one.mount(lambda *frames: mounting, 'camera')
    play(one, drive[:2])
    level, _, found = problems_of(one)
    assert (level, *found) == (('WARN', 'base_frame without metres') if warned else ('OK',))
    assert all(f"camera is 0.400 m from 'base_link', but odometry.scale is {scale}" in text
               for text in found.values())
    assert [one.name for one in one.complaints_of_content] == list(found)


@pytest.mark.parametrize('parameters, parent, child', [
    ({}, 'odom', 'camera_frame'),
    ({'odometry.odom_frame': '/left/odom', 'odometry.camera_frame': '/left/cam'},
     'left/odom', 'left/cam'),
    ({'odometry.base_frame': '/base_link'}, 'odom', 'base_link')])
def test_leading_slashes_of_frame_names_are_removed(
        drive, parameters, parent, child):
    one = tracker(info=False, **{'ros.publish_tf': True, **parameters})
    one.camera_info(camera_info(K, SIZE, header=header(0, 'camera_optical_frame')))
    asked = []
    if not one.mounted:
        one.mount(lambda *frames: asked.append(frames) or np.eye(4), 'camera_optical_frame')
    for i, gray in enumerate(drive[:2]):
        out = by_topic(one.image(image(gray, stamp_ns=ns(0.1 * i),
                                       frame_id='/camera_optical_frame')))
    there, = out['/tf'].transforms
    assert (there.header.frame_id, there.child_frame_id) == (parent, child)
    assert (out['odometry'].header.frame_id, out['odometry'].child_frame_id) == (parent, child)
    assert not any(frame.startswith('/') for frames in asked for frame in frames)
    assert problems_of(one) == ('OK', 'tracking', {})


# Bad images

def of_another_size():
    return image(np.zeros((100, 100), np.uint8), stamp_ns=ns(0.3))


BAD = {
    'unknown_encoding': lambda gray: image(gray, 'sepia', stamp_ns=ns(0.3)),
    'short_data': lambda gray: image(gray, stamp_ns=ns(0.3), data=np.zeros(9, np.uint8)),
    'short_step': lambda gray: image(gray, stamp_ns=ns(0.3), step=3),
    'too_large': lambda gray: image(gray, stamp_ns=ns(0.3), height=2**31),
    'empty': lambda gray: image(gray, stamp_ns=ns(0.3), width=0),
    'size_mismatch': lambda gray: of_another_size(),
    'undecodable': lambda gray: compressed(b'\xff\xd8\xff\xd9', 'jpeg', ns(0.3)),
}


@pytest.mark.parametrize('reason', BAD)
def test_a_bad_image_is_an_error_with_its_reason_and_the_next_good_one_is_tracked(drive, reason):
    one = tracker()
    play(one, drive[:3])
    out = by_topic(one.image(BAD[reason](drive[3])))
    status = out.pop('/diagnostics').status[0]
    assert out == {}
    assert (status.level, status.message) == (2, f'message rejected: {reason}')
    assert one.problem.reason == reason
    assert one.counts.rejected == {reason: 1}
    good = play(one, [drive[4]], start=0.4)[0]
    assert 'relative_pose' in good
    assert one.problem is None
    assert good['/diagnostics'].status[0].message == 'tracking'
    assert values(good['/diagnostics'])[f'frames rejected: {reason}'] == '1'
    assert accounted(one.counts) == one.counts.received == 5


def test_black_images_end_in_lost_and_a_good_pair_ends_that(drive):
    one = tracker(**{'odometry.max_lost': 2})
    play(one, drive[:2])
    black = np.zeros_like(drive[0])
    out = play(one, [black] * 3, start=0.2)
    statuses = [o['/diagnostics'].status[0] for o in out[:2]]
    assert [(s.level, s.message) for s in statuses] == [
        (1, 'bad pair: TOO_FEW_MATCHES'), (2, 'lost: TOO_FEW_MATCHES')]
    # the pose is held, with a large covariance, as is the velocity's
    for message in (o['odometry'] for o in out):
        held = in_convention(one.last, 'body').pose
        assert np.allclose(pose_of(message)[1], held, rtol=0, atol=1e-12)
        for covariance in (message.pose.covariance, message.twist.covariance):
            assert np.diag(np.reshape(covariance, (6, 6)))[:3].min() >= 9999
        assert message.twist.twist.linear.x == message.twist.twist.angular.y == 0
    assert not any({'relative_pose', '/tf'} & set(o) for o in out)
    play(one, drive[2:4], start=0.5)
    assert one.diagnosis().summary == 'tracking'
    assert one.last.status is Status.OK


# When messages are published

def test_diagnostics_come_on_a_change_of_state_and_once_per_second_of_stamps(drive):
    one = tracker()
    images = [drive[i % 2] for i in range(24)]
    statuses = [i for i, out in enumerate(play(one, images)) if '/diagnostics' in out]
    # The first frame, the first pair, then every second.
    assert statuses == [0, 1, 11, 21]


def test_a_path_continues_with_other_parameters_unless_they_name_other_frames(drive):
    one = tracker(**{'ros.publish_path': True, 'ros.path_period': 0.0})
    lengths = []
    for i, values in enumerate(({}, {'odometry.max_gap': 2.0, 'ros.path_length': 100},
                                {'odometry.odom_frame': 'world'})):
        one.configure(with_values(one.config, values))
        out = play(one, drive[2 * i:2 * i + 2], start=0.2 * i)
        lengths.append(len(out[-1]['path'].poses))
    assert lengths == [2, 4, 2]


def test_a_path_is_published_on_demand_throttled_and_bounded(drive):
    assert all('path' not in out for out in play(tracker(), drive[:3]))
    one = tracker(**{'ros.publish_path': True, 'ros.path_period': 0.25, 'ros.path_length': 4})
    out = play(one, drive[:8])
    assert [i for i, o in enumerate(out) if 'path' in o] == [0, 3, 6]
    assert len(out[6]['path'].poses) == 4
    last = out[6]['path'].poses[-1].pose.position
    assert last == out[6]['odometry'].pose.pose.position


def test_a_transform_is_published_on_demand(drive):
    assert all('/tf' not in out for out in play(tracker(), drive[:2]))
    out = play(tracker(**{'ros.publish_tf': True}), drive[:2])[1]
    transform = out['/tf'].transforms[0]
    assert (transform.header.frame_id, transform.child_frame_id) == ('odom', 'camera_body')
    assert transform.transform.rotation == out['odometry'].pose.pose.orientation


def test_a_debug_image_shows_the_last_pair(drive):
    one = tracker()
    assert one.debug_image() is None
    play(one, drive[:1])
    assert one.debug_image() is None
    play(one, drive[1:2], start=0.1)
    topic, message = one.debug_image()
    assert topic == 'debug_image'
    assert stamp_ns(message.header) == ns(0.1)
    drawn = np.frombuffer(message.data, np.uint8).reshape(*drive[1].shape, 3)
    coloured = (drawn.max(2) - drawn.min(2) > 60).mean()
    assert 0.01 < coloured < 0.9
    play(one, [np.zeros_like(drive[0])], start=0.2)
    assert one.debug_image() is not None


def test_a_debug_image_draws_a_residual_twenty_times_as_long_towards_the_line():
    x, y = np.array([[30.0, 30], [80, 60]]), np.array([[40.0, 30], [80, 50]])
    drawn = debug_image(np.full((90, 120), 50, np.uint8), RelativePose(
        Status.OK, x=x, y=y, y_opt=np.array([[40.0, 31.5], [79, 50]]),
        inliers=np.ones(2, bool)))
    yellow = (drawn[:, :, 2] > 150) & (drawn[:, :, 0] < 100) & (drawn[:, :, 1] > 100)
    rows, columns = np.nonzero(yellow)
    down, left = columns < 45, columns > 55
    assert (down | left).all()
    assert rows[down].min() >= 29 and rows[down].max() == pytest.approx(60, abs=1)
    assert columns[left].max() <= 81 and columns[left].min() == pytest.approx(60, abs=1)


def test_a_debug_image_tells_outliers_from_another_body():
    x = np.array([[30.0, 30], [60, 60], [90, 45]])
    y = np.add(x, (10, 0))
    drawn = debug_image(np.full((90, 120), 50, np.uint8), RelativePose(
        Status.OK, x=x, y=y, inliers=np.array([True, False, False]),
        left_out=np.array([False, False, True])))
    middles = np.rint((x + y) / 2).astype(int)
    # Of blue, green and red most is …
    assert [int(drawn[row, column].argmax()) for column, row in middles] == [1, 2, 0]


def test_landmarks_are_a_cloud_in_front_of_the_camera(drive):
    one = tracker()
    play(one, drive[:1])
    assert one.landmarks() is None
    play(one, drive[1:4], start=0.1)
    topic, cloud = one.landmarks()
    assert (topic, cloud.header.frame_id) == ('landmarks', one.last.frame_id)
    assert stamp_ns(cloud.header) == one.last.stamp_ns
    assert [field.name for field in cloud.fields] == ['x', 'y', 'z']
    places = np.frombuffer(np.asarray(cloud.data).tobytes(), '<f4').reshape(cloud.width, 3)
    assert cloud.row_step == 12 * cloud.width == len(cloud.data)
    assert len(places) > 20
    assert (places[:, 2] > 0).mean() > 0.9
    serialised(cloud)
    play(one, [np.zeros_like(drive[0])], start=0.5)
    assert one.landmarks() is None
    none = tracker(**{'odometry.scale': 'none'})
    play(none, drive[:3])
    assert none.landmarks() is None


def test_a_standstill_keeps_the_landmarks_without_a_new_one(drive):
    one = tracker()
    play(one, drive[:6])
    moving = one.unsettled()
    assert len(moving) > 20
    for i in range(3):
        play(one, [drive[5]], start=0.6 + 0.1 * i)
        assert one.last.stationary
        assert one.landmarks() is None
        assert len(one.settled()) == 0
        assert np.array_equal(one.unsettled(), moving)


def test_speeds_give_the_length(drive):
    one = tracker(**{'odometry.scale': 'speed'})
    vector = message_type('geometry_msgs/msg/Vector3')
    twist = message_type('geometry_msgs/msg/Twist')(
        linear=vector(x=3.0, y=0.0, z=4.0), angular=vector(x=0.0, y=0.0, z=0.0))
    for i, gray in enumerate(drive[:3]):
        stamped = message_type('geometry_msgs/msg/TwistStamped')(
            header=header(ns(i * 0.1)), twist=twist)
        one.speed(stamped)
        one.image(image(gray, stamp_ns=ns(i * 0.1)))
    assert np.linalg.norm(one.last.motion[:3, 3]) == pytest.approx(0.5, rel=0.02)
    assert one.last.scale_kind is Scale.METRIC
    one.reset()
    play(one, drive[:2])
    assert one.last.scale_kind is Scale.RELATIVE


def test_faces_add_their_counts_and_values(drive):
    one = tracker()
    one.count_dropped('queue_full', 3)
    one.node_values = lambda: {'latency (ms)': '7.0'}
    out = play(one, drive[:1])[0]
    statuses = values(out['/diagnostics'])
    assert statuses['frames received'] == '4'
    assert statuses['frames dropped: queue_full'] == '3'
    assert statuses['latency (ms)'] == '7.0'


SMALL = np.random.default_rng(1).integers(0, 256, (48, 64), dtype=np.uint8)
SENT = st.sampled_from(['good', 'black', 'short', 'unknown', 'size', 'info', 'zeros', 'reset'])


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(SENT, st.integers(-10**9, 4 * 10**9)), max_size=12))
def test_every_image_is_accounted_for_in_any_order_of_messages(events):
    one, sent = tracker(info=False), 0
    for what, stamp in events:
        if what == 'reset':
            one.reset()
            sent = 0
        elif what in ('info', 'zeros'):
            calibration = K if what == 'info' else np.zeros((3, 3))
            one.camera_info(camera_info(calibration, (64, 48), stamp))
        else:
            message = {
                'good': lambda t: image(SMALL, stamp_ns=t),
                'black': lambda t: image(np.zeros_like(SMALL), stamp_ns=t),
                'short': lambda t: image(SMALL, stamp_ns=t, height=99),
                'unknown': lambda t: image(SMALL, 'sepia', stamp_ns=t),
                'size': lambda t: image(SMALL[:40], stamp_ns=t)}[what](stamp)
            for _, out in one.image(message):
                assert len(serialised(out)) > 0
            sent += 1
        assert accounted(one.counts) == one.counts.received == sent
        assert one.counts.status.total() == one.counts.processed
    assert len(serialised(one.diagnostics(0).message)) > 0


# Parameters at run time

def test_new_parameters_apply_from_the_next_frame_and_the_trajectory_continues(drive):
    one = tracker()
    play(one, drive[:2])
    before = one.last.pose
    one.configure(with_values(one.config, {
        'estimator.method': 'rpe', 'odometry.scale': 'constant', 'odometry.scale_value': 2.0,
        'odometry.odom_frame': 'world'}))
    out = play(one, drive[2:3], start=0.2)[0]
    assert one.last.status is Status.OK
    assert np.linalg.norm(one.last.pose[:3, 3] - before[:3, 3]) == pytest.approx(2.0)
    assert out['odometry'].header.frame_id == 'world'


def test_a_switch_to_rectified_images_takes_the_other_camera(drive):
    one = tracker(info=False)
    one.camera_info(camera_info(K, SIZE, p=np.hstack([1.1 * K, np.zeros((3, 1))]).ravel() /
                                np.array([1] * 10 + [1.1, 1])))
    play(one, drive[:1])
    one.configure(with_values(one.config, {'odometry.rectified': 'true'}))
    play(one, drive[1:2], start=0.1)
    assert one.last.status is Status.SIZE_CHANGED


def test_another_residual_distortion_makes_another_camera(drive):
    one = tracker()
    play(one, drive[:2])
    for k1 in (0.05, 0.0):
        one.configure(with_values(one.config, {'odometry.residual_k1': k1}))
        assert one.camera.k1 == k1
    same = one.camera
    one.configure(with_values(one.config, {'odometry.max_lost': 5}))
    assert one.camera is same


def test_an_invalid_residual_distortion_is_reported_until_corrected(drive):
    one = tracker(info=False)
    one.camera_info(camera_info(K, SIZE, d=np.array([-0.2, 0.05, 0, 0, 0])))
    play(one, drive[:1])
    one.configure(with_values(one.config, {'odometry.residual_k1': 0.02}))
    play(one, drive[1:2], start=0.1)
    assert (one.counts.processed, one.diagnosis().level) == (1, 'ERROR')
    assert 'odometry.residual_k1 is 0.02' in str(one.problem)
    one.configure(with_values(one.config, {'odometry.residual_k1': 0.0}))
    play(one, drive[2:3], start=0.2)
    assert (one.counts.processed, one.diagnosis().level) == (2, 'OK')


# Diagnostics as a pure function

def test_every_state_has_a_level():
    assert set(LEVELS) == set(State)


def test_diagnostics_say_what_was_counted(drive):
    one = tracker()
    play(one, drive[:3])
    counts = Counts(received=9, processed=5)
    counts.dropped.update(equal_stamp=3)
    counts.rejected.update(short_data=1)
    counts.status.update(OK=4, FIRST_FRAME=1)
    diagnosis = diagnose(State.BAD_PAIR, 'DEGENERATE', counts, one.last, 9.987)
    assert (diagnosis.level, diagnosis.summary) == ('WARN', 'bad pair: DEGENERATE')
    assert diagnosis.values['frames received'] == '9'
    assert diagnosis.values['frames dropped: equal_stamp'] == '3'
    assert diagnosis.values['frames rejected: short_data'] == '1'
    assert diagnosis.values['status: OK'] == '4'
    assert diagnosis.values['rate (Hz)'] == '9.99'
    assert diagnosis.values['scale'] == 'relative'
    assert int(diagnosis.values['inliers']) <= int(diagnosis.values['matches'])
    assert float(diagnosis.values['median residual (px)']) < 2
    assert 'time of matching (ms)' in diagnosis.values


def test_diagnostics_exist_before_any_message():
    diagnosis = Tracker(Config(), message_type).diagnosis()
    assert (diagnosis.level, diagnosis.summary) == ('WARN', 'waiting for camera_info')


def test_the_rate_is_that_of_the_stamps():
    rate = StampRate(frames=5)
    assert rate.hertz is None
    for i in range(20):
        rate.add(ns(0.05 * i))
    assert rate.hertz == pytest.approx(20)
    rate.add(0)
    assert rate.hertz is None
