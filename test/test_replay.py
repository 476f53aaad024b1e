"""``djet replay``: what it writes, and its error messages."""

import csv
from itertools import count
import json
import os
from pathlib import Path
import re
import shutil
import signal
import subprocess
import sys
import time

from cards import Cards, DEPTHS, filmed, K, pose, SIZE
from commands import alone, checked as djet, contents, DJET
import cv2
from djet_ros.config.flat import from_flat
from djet_ros.config.sections import Config
from djet_ros.config.yaml_files import load_yaml
from djet_ros.core.geometry import rotation_exp
from djet_ros.core.types import Status
from djet_ros.errors import DjetError
from djet_ros.odometry.camera import Camera
from djet_ros.odometry.messages import OPTICAL_TO_BODY, pose_of
from djet_ros.posegraph import recorded_frames
from djet_ros.posegraph.recorded_frames import frame_finder
from djet_ros.posegraph.steps import Step
from djet_ros.recordings.bag_writers import write_kitti_bag
from djet_ros.recordings.bags import Bag, BagMessage
from djet_ros.recordings.decoding import MAKE
from djet_ros.recordings.kitti import KittiSequence
from djet_ros.recordings.recording import IMAGE_TOPIC, INFO_TOPIC, open_recording
from djet_ros.recordings.trajectories import read_tum, TumWriter
from djet_ros.replay import replay
from djet_ros.replay.alignment import aligned, position_rmse
from djet_ros.replay.drift import drift, scale_change
from djet_ros.replay.ground_truth import GroundTruth
from djet_ros.replay.lookahead import with_next_image
from djet_ros.replay.pair_errors import pair_errors, statistics
from djet_ros.replay.results import ResultsFolder
import numpy as np
import pytest
from ros_messages import camera_info, header, image, message_type, record
from rosbags.rosbag2 import Writer

FRAMES = 6
STEP = pose(x=0.25, z=0.15, yaw=0.01)
POSES = [np.linalg.matrix_power(STEP, i) for i in range(FRAMES)]
SECOND = 10**9


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """Write a small KITTI sequence with ground truth, and return its folder."""
    return filmed(tmp_path_factory.mktemp('dataset') / 'sequences' / '00', POSES)


@pytest.fixture(scope='module')
def bag(folder, tmp_path_factory):
    path = tmp_path_factory.mktemp('bags') / 'bag'
    write_kitti_bag(KittiSequence(folder), path)
    return path


def stamp_at(frame):
    """Return the stamp of a frame of the drive."""
    return SECOND + frame * SECOND // 10


def true_poses(path, stamp=stamp_at):
    """Write the poses of the drive, with the stamp of each frame, as a TUM file."""
    with TumWriter(path) as truth:
        for i, here in enumerate(POSES):
            truth.write(stamp(i), here)
    return path


def drive(change=lambda i, message: message, info=True):
    """Yield the messages of a drive; change makes another message of an image (or None)."""
    cards = Cards()
    for i, here in enumerate(POSES):
        stamp = stamp_at(i)
        if info:
            yield INFO_TOPIC, camera_info(K, SIZE, stamp), stamp
        message = change(i, image(cards.gray(here), stamp_ns=stamp))
        if message is not None:
            yield IMAGE_TOPIC, message, stamp


def summary(results):
    return json.loads((results / 'summary.json').read_text())


def test_keyframe_images_have_the_masks_of_the_odometry(tmp_path):
    """Each mask is recorded a little after its image; those of one image are missing."""
    def messages():
        for i, (topic, message, stamp) in enumerate(drive()):
            yield topic, message, stamp
            if topic == IMAGE_TOPIC and i // 2 != 3:
                mask = np.full(SIZE[::-1], 255, np.uint8)
                mask[:, :10 + i // 2] = 0
                yield '/camera/mask', image(mask, stamp_ns=stamp), stamp + 30_000_000

    config = from_flat({'odometry.mask': True})
    with open_recording(record(tmp_path / 'bag', messages()), IMAGE_TOPIC,
                        auxiliary={'mask': None}) as recording:
        frame_at = frame_finder(recording, config)
        for i in (0, 1, 3, 5):
            left_out = frame_at(stamp_at(i)).left_out
            assert left_out is None if i == 3 else left_out[0].sum() == 10 + i


def test_images_wait_for_masks_in_bounded_number_if_the_recorded_time_stands_still(
        tmp_path, monkeypatch):
    for module in (recorded_frames, replay):
        monkeypatch.setattr(module, 'MOST_WAITING', 2)
    still = [(topic, message, SECOND) for topic, message, _ in drive()]
    mask = image(np.full(SIZE[::-1], 255, np.uint8), stamp_ns=SECOND // 2)
    config = from_flat({'odometry.mask': True})
    with open_recording(record(tmp_path / 'bag', [*still, ('/camera/mask', mask, SECOND)]),
                        IMAGE_TOPIC, auxiliary={'mask': None}) as recording:
        read, messages = [], recording.messages
        monkeypatch.setattr(recording, 'messages', lambda topics=None: (
            read.append(one) or one for one in messages(topics)))
        frame_finder(recording, config)(SECOND)
        assert len(read) == 6
        read.clear()
        done = []
        with ResultsFolder(tmp_path / 'out', config) as results:
            replay.Replay(recording, config, 'bag').run(results, lambda: done.append(len(read)))
    assert len(done) == FRAMES
    # Of the image, the CameraInfo that waits with it, and two images ahead.
    assert done[0] <= 6


def test_keyframe_images_have_the_residual_distortion_corrected(tmp_path):
    k1 = -0.05
    with open_recording(record(tmp_path / 'bag', drive()), IMAGE_TOPIC) as recording:
        frame = frame_finder(recording, from_flat({'odometry.residual_k1': k1}))(SECOND)
    camera = Camera(K, np.array([k1, 0, 0, 0, 0]), SIZE)
    assert np.array_equal(frame.gray, camera.undistort(Cards().gray(np.eye(4))))


# Of the vehicle

AHEAD = np.array([[0.0, 0, 1, 0.3], [-1, 0, 0, 0], [0, -1, 0, 1.0], [0, 0, 0, 1]])


def on_a_robot():
    """Yield the messages of a drive with the camera on a mast on the base."""
    mast = pose(x=0.1)
    yield '/tf_static', MAKE.frame(0, 'base_link', 'mast', AHEAD @ np.linalg.inv(mast)), SECOND
    yield '/tf_static', MAKE.frame(0, 'mast', 'camera', mast), SECOND
    yield from drive()


@pytest.mark.slow
def test_odometry_is_of_the_base_frame_with_the_mounting_from_the_bag(tmp_path):
    path = record(tmp_path / 'bag', on_a_robot())
    for name, call in (('camera', ()), ('base', ('--base-frame', 'base_link'))):
        djet('replay', path, '--output', tmp_path / name, *call)
    with Bag(tmp_path / 'base' / 'bag') as result:
        published = [one.message for one in result.messages({'/vo_node/odometry'})]
    _, camera = read_tum(tmp_path / 'camera' / 'trajectory_tum.txt')
    assert len(published) == FRAMES
    for message, here in zip(published, camera):
        assert (message.header.frame_id, message.child_frame_id) == ('odom', 'base_link')
        assert np.allclose(pose_of(message)[1], AHEAD @ here @ np.linalg.inv(AHEAD), atol=1e-6)
    # the files stay those of the camera
    assert np.array_equal(read_tum(tmp_path / 'base' / 'trajectory_tum.txt')[1], camera)


def test_tf_of_a_recording_gives_the_lengths_through_moving_frames(tmp_path):
    """Messages of tf are recorded between the images, a little after the image they cover."""
    here = np.eye(4)

    def with_tf():
        nonlocal here
        for topic, message, stamp in on_a_robot():
            yield topic, message, stamp
            if topic == IMAGE_TOPIC:
                base = AHEAD @ here @ np.linalg.inv(AHEAD)
                yield '/tf', MAKE.frame(stamp, 'wheels', 'base_link', base), stamp + 20_000_000
                here = here @ STEP

    path = record(tmp_path / 'bag', with_tf())
    call = ('--scale', 'guess', '--guess-frame', 'wheels')
    djet('replay', path, '--output', tmp_path / 'out', *call)
    assert summary(tmp_path / 'out')['pairs_of_known_scale'] == FRAMES - 1
    _, camera = read_tum(tmp_path / 'out' / 'trajectory_tum.txt')
    assert np.allclose(camera[:, :3, 3], [here[:3, 3] for here in POSES], atol=0.02)
    without = djet('replay', record(tmp_path / 'none', drive()), '--output', tmp_path / 'no',
                   *call, expect=2)
    assert 'has no topic /tf, which odometry.guess_frame requires' in without.stderr


def test_missing_mounting_in_a_recording_is_one_line(tmp_path, folder):
    path = record(tmp_path / 'bag', drive())
    for source in (path, folder):
        done = djet('replay', source, '--output', tmp_path / f'of_{source.name}', '--base-frame',
                    'base_link', expect=2)
        line, = [text for text in done.stderr.splitlines() if 'error' in text]
        assert line.startswith(f"djet: error: odometry.base_frame is 'base_link', but {source} "
                               "has no transform from it to 'camera' on /tf_static")
        assert not (tmp_path / f'of_{source.name}').exists()


def with_imu(folder, tmp_path):
    """Copy the sequence, and add a gyro at 100 Hz that turns as the camera does."""
    copy = Path(shutil.copytree(folder, tmp_path / '01'))
    with (copy / 'calib.txt').open('a') as calibration:
        calibration.write('Tr_imu_to_cam: 1 0 0 0 0 1 0 0 0 0 1 0\n')
    (copy / 'imu.csv').write_text(''.join(
        f'{i * SECOND // 100},0,0.1,0,0,-9.8,0\n' for i in range(10 * FRAMES)))
    return copy


def test_sequence_with_an_imu_gives_the_odometry_of_the_imu(folder, tmp_path):
    call = ('replay', with_imu(folder, tmp_path), '--output', tmp_path / 'out', '--base-frame',
            'imu')
    assert "has no transform from it to 'camera'" in djet(*call, expect=2).stderr
    djet(*call, '--imu', 'true')
    with Bag(tmp_path / 'out' / 'bag') as result:
        published = [one.message for one in result.messages({'/vo_node/odometry'})]
    assert [message.child_frame_id for message in published] == ['imu'] * FRAMES


def test_missing_mounting_keeps_earlier_results(tmp_path):
    path, results = record(tmp_path / 'bag', on_a_robot()), tmp_path / 'results'
    results.mkdir()
    for name in ('summary.json', 'config.yaml'):
        (results / name).write_text('of an hour')
    done = djet('replay', path, '--output', results, '--overwrite', '--base-frame', 'arm',
                expect=2)
    assert "odometry.base_frame is 'arm'" in done.stderr
    assert {one.name: one.read_text() for one in results.iterdir()} == {
        'summary.json': 'of an hour', 'config.yaml': 'of an hour'}


# What is written

@pytest.fixture(scope='module')
def replayed(bag, tmp_path_factory):
    """Results of the bag, and what was printed."""
    results = tmp_path_factory.mktemp('replay') / 'deep' / 'results'
    return results, djet('replay', bag, '--output', results)


def test_summary_has_counts_and_errors(replayed):
    results, _ = replayed
    found = summary(results)
    assert found['complete'] is True
    assert found['error'] is None
    assert (found['frames'], found['pairs'], found['images']) == (FRAMES, FRAMES - 1, FRAMES)
    assert found['status'] == {'FIRST_FRAME': 1, 'OK': FRAMES - 1}
    assert found['seconds'] > 0
    assert found['inner_loops'] in ('compiled', 'NumPy')
    assert found['compared_pairs'] == FRAMES - 1
    assert found['failures'] == found['translation_failures'] == 0
    for name, limit in (('rotation_error_deg', 0.5), ('translation_error_deg', 10)):
        assert set(found[name]) == {'mean', 'median', 'p95', 'max'}
        assert 0 < found[name]['median'] <= found[name]['p95'] <= found[name]['max'] < limit


def test_position_error_is_after_alignment_with_scale(replayed, folder):
    results, _ = replayed
    found = summary(results)
    truth = KittiSequence(folder).poses[:, :3, 3]
    _, estimate = read_tum(results / 'trajectory_tum.txt')
    metric = found['scale_kind'] == 'metric'
    assert found['positions']['rmse_m'] == pytest.approx(
        position_rmse(aligned(estimate[:, :3, 3], truth, metric), truth), rel=1e-3)
    assert found['positions']['way_m'] == pytest.approx(
        np.linalg.norm(np.diff(truth, axis=0), axis=1).sum())
    assert found['positions']['scale_change'] == pytest.approx(
        scale_change(estimate[:, :3, 3], truth), rel=1e-6)
    assert found['positions']['rmse_m'] < 0.02 * found['positions']['way_m']


@pytest.mark.slow
def test_drift_is_given_for_paths_over_100_metres(replayed, folder, tmp_path):
    results, _ = replayed
    assert summary(results)['drift'] is None
    truth = KittiSequence(folder).poses
    truth[:, :3, 3] *= 100
    np.savetxt(tmp_path / 'far.txt', truth[:, :3].reshape(-1, 12))
    drifts = {}
    places = {}
    for scale in ('none', 'ground_truth'):
        done = djet('replay', folder, '--poses', tmp_path / 'far.txt', '--scale', scale,
                    '--output', tmp_path / scale)
        drifts[scale], places[scale] = (summary(tmp_path / scale)[what]
                                        for what in ('drift', 'positions'))
        _, estimate = read_tum(tmp_path / scale / 'trajectory_tum.txt')
        expected = drift(truth, estimate)
        assert drifts[scale]['rotation_deg_per_100m'] == pytest.approx(
            expected.rotation_deg_per_100m, rel=1e-3)
        assert (drifts[scale]['segments'], drifts[scale]['longest']) == (1, 100)
        assert 'r_rel' in done.stdout
        assert ('t_rel' in done.stdout) == (scale != 'none')
    # Without a scale the lengths of the estimate mean nothing, but its rotations do.
    assert drifts['none']['translation_percent'] is None
    assert drifts['ground_truth']['translation_percent'] == pytest.approx(
        expected.translation_percent, rel=1e-3)
    assert 0 < expected.translation_percent < 10
    assert places['none'] is None
    assert places['ground_truth']['scale_change'] == pytest.approx(1, abs=1e-6)


def test_scale_change_is_the_scale_at_the_end_over_that_at_the_start():
    rng = np.random.default_rng(4)
    steps = rng.uniform(0.5, 2, (200, 1)) * [[0.6, 0.0, 0.8]]
    truth = np.cumsum(steps, axis=0)
    grown = np.cumsum(steps * np.geomspace(3, 3.3, 200)[:, None], axis=0)
    assert scale_change(truth, truth) == pytest.approx(1)
    assert scale_change(7 * truth, truth) == pytest.approx(1)
    assert scale_change(grown, truth) == pytest.approx(1.1**0.9, rel=0.005)
    still = np.where(np.arange(len(truth))[:, None] < len(truth) / 8, truth[0], truth)
    assert np.isnan(scale_change(still, truth))
    assert np.isfinite(scale_change(truth, still))  # the way begins later
    assert np.isnan(scale_change(truth, np.zeros_like(truth)))


def test_both_trajectories_have_a_pose_for_each_frame(replayed):
    results, _ = replayed
    stamps, poses = read_tum(results / 'trajectory_tum.txt')
    kitti = np.loadtxt(results / 'trajectory_kitti.txt').reshape(-1, 3, 4)
    assert len(stamps) == FRAMES
    assert np.allclose(kitti, poses[:, :3], atol=1e-12)
    assert np.array_equal(poses[0], np.eye(4))


def test_the_bag_holds_what_the_live_node_publishes(replayed):
    results, _ = replayed
    with Bag(results / 'bag') as out:
        counts = {topic.name: topic.message_count for topic in out.topics}
        relative = [m.message for m in out.messages({'/vo_node/relative_pose'})]
        newest = [m.message for m in out.messages({'/vo_node/odometry'})][-1]
    assert counts == {'/vo_node/relative_pose': FRAMES - 1, '/vo_node/odometry': FRAMES,
                      '/vo_node/relative_pose_cov': FRAMES - 1,
                      '/vo_node/relative_pose_status': FRAMES, '/diagnostics': 2}
    _, poses = read_tum(results / 'trajectory_tum.txt')
    chained = np.eye(4)
    for message in relative:
        chained = chained @ pose_of(message)[1]
    # the file has optical axes, the bag those of messages
    axes = np.eye(4)
    axes[:3, :3] = OPTICAL_TO_BODY
    last = axes @ poses[-1] @ axes.T
    assert np.allclose(pose_of(newest)[1], last, atol=1e-9)
    # Poses include later corrections of a frame, the motion of its pair does not.
    assert np.allclose(chained, last, atol=0.02)


def test_landmarks_lie_on_the_cards(replayed):
    results, _ = replayed
    head, _, data = (results / 'landmarks.ply').read_bytes().partition(b'end_header\n')
    count = int(re.search(rb'element vertex (\d+)', head)[1])
    assert count > 50
    assert len(data) == 12 * count
    # In the length of the first step, as the trajectory is.
    depths = np.frombuffer(data, '<f4').reshape(-1, 3)[:, 2] * np.linalg.norm(STEP[:3, 3])
    off = np.abs(depths[:, None] / DEPTHS - 1).min(1)
    assert np.median(off) < 0.02
    assert np.quantile(off, 0.9) < 0.1


def test_frames_csv_has_a_row_for_each_image(replayed):
    results, _ = replayed
    rows = list(csv.DictReader((results / 'frames.csv').open()))
    assert [row['status'] for row in rows] == ['FIRST_FRAME'] + ['OK'] * (FRAMES - 1)
    assert [row['image'] for row in rows] == [str(i) for i in range(FRAMES)]
    assert int(rows[1]['inliers']) <= int(rows[1]['matches'])
    assert rows[2]['previous_stamp_ns'] == rows[1]['stamp_ns']
    errors = list(csv.DictReader((results / 'errors.csv').open()))
    assert len(errors) == FRAMES - 1
    assert float(errors[0]['rotation_error_deg']) < 0.5


def test_printed_table_is_short_and_names_the_plot(replayed):
    results, done = replayed
    assert done.stderr == ''
    assert 'rotation' in done.stdout
    assert done.stdout.rstrip().endswith(str(results / 'trajectory.png'))
    assert len(done.stdout.splitlines()) < 25
    # Millimetres of a path of a few metres are not rounded away.
    positions = json.loads((results / 'summary.json').read_text())['positions']
    printed = re.search(r'(\S+) m over a path of (\S+) m', done.stdout)
    assert printed is not None
    assert [float(length) for length in printed.groups()] == pytest.approx(
        [positions['rmse_m'], positions['way_m']], rel=1e-3)
    assert cv2.imread(str(results / 'trajectory.png')).shape[0] > 300


@pytest.mark.slow
@pytest.mark.parametrize('name', [b'drive \xff', rb'a$\nope{$b', b'[red]x'],
                         ids=['no text', 'formula', 'markup'])
def test_plot_works_for_any_recording_name(folder, tmp_path, name):
    source, results = (Path(os.fsdecode(os.fsencode(tmp_path) + b'/' + word))
                       for word in (name, b'of ' + name))
    source.symlink_to(folder)
    done = djet('replay', source, '--output', results, '--preset', 'fast')
    assert (done.returncode, done.stderr) == (0, '')
    assert (results / 'trajectory.png').exists()


def test_folder_and_bag_give_identical_results(folder, replayed, tmp_path):
    djet('replay', folder, '--output', tmp_path / 'a')
    places = tmp_path / 'a', replayed[0]
    for name in ('trajectory_tum.txt', 'trajectory_kitti.txt', 'errors.csv', 'landmarks.ply',
                 'config.yaml'):
        assert len({(place / name).read_bytes() for place in places}) == 1, name
    # All else holds how long the work took, and differs in nothing but that.
    rows = [list(csv.DictReader((place / 'frames.csv').open())) for place in places]
    assert [{**row, 'ms': ''} for row in rows[0]] == [{**row, 'ms': ''} for row in rows[1]]
    summaries = [{**summary(place), 'seconds': 0, 'source': ''} for place in places]
    assert summaries[0] == summaries[1]
    bags = []
    for place in places:
        with Bag(place / 'bag') as out:
            bags.append([(one.topic, one.stamp_ns, repr(one.message)) for one in out.messages()
                         if one.topic != '/diagnostics'])
    assert bags[0] == bags[1]


class Stream:
    """A recording of so many messages of a name's first letter: images, and others; a break."""

    image_topic = 'i'

    def __init__(self, names, broken=False):
        self.names, self.broken, self.read = names, broken, 0

    def messages(self):
        for name in self.names:
            self.read += 1
            yield BagMessage(name[0], self.read, name)
        if self.broken:
            raise DjetError('the file ends here')


@pytest.mark.parametrize('broken', [False, True])
@pytest.mark.parametrize('names', ['', 'i1', 'a1', 'i1 i2', 'a1 i1 a2 a3 i2 i3 a4'])
def test_messages_are_in_order_with_the_next_image_ahead(names, broken):
    names, seen = names.split(), []
    try:
        for message, following in with_next_image(Stream(names, broken)):
            seen.append(message.message)
            rest = [name for name in names[len(seen):] if name[0] == 'i']
            later = rest if message.topic == 'i' else rest[1:]
            assert (following and following.message) == (later[0] if later else None)
    except DjetError:
        assert broken
    else:
        assert not broken
    assert seen == names


def test_lookahead_is_bounded_without_images():
    stream = Stream(['i1', *['a'] * 10_000])
    assert next(with_next_image(stream))[0].message == 'i1'
    assert stream.read < 2_000


def test_written_configuration_combines_flags_and_file(bag, tmp_path):
    parameters = tmp_path / 'mine.yaml'
    parameters.write_text('estimator: {max_features: 400, method: pjet}\n')
    djet('replay', bag, '--output', tmp_path / 'r', '--config', parameters, '--method', 'rpe',
         '--scale', 'ground_truth')
    config = load_yaml(tmp_path / 'r' / 'config.yaml')
    assert (config.estimator.method, config.estimator.max_features) == ('rpe', 400)
    assert summary(tmp_path / 'r')['method'] == 'rpe'
    _, poses = read_tum(tmp_path / 'r' / 'trajectory_tum.txt')
    lengths = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    moved = lengths > 0  # while a pair is in doubt the pose is held
    assert moved.any()
    assert np.allclose(lengths[moved], np.linalg.norm(STEP[:3, 3]), atol=1e-6)


@pytest.mark.slow
def test_debug_images_are_those_of_the_node_and_go_when_results_are_replaced(folder, tmp_path):
    results, drawn = tmp_path / 'results', tmp_path / 'results' / 'debug'
    djet('replay', folder, '--output', results, '--debug-images')
    assert [path.name for path in sorted(drawn.iterdir())] == [
        f'{i:06d}.jpg' for i in range(1, FRAMES)]
    picture = cv2.imread(str(drawn / '000003.jpg'))
    gray = cv2.imread(str(folder / 'image_0' / '000003.png'), cv2.IMREAD_GRAYSCALE)
    assert picture.shape == (*gray.shape, 3)
    coloured = np.ptp(picture.astype(int), axis=2) > 90
    green = coloured & (picture.argmax(2) == 1)
    assert green.mean() > 0.005
    assert np.abs(picture.mean(2) - gray)[~coloured].mean() < 20
    djet('replay', folder, '--output', results, '--overwrite')
    assert not drawn.exists()


@pytest.mark.slow
def test_only_results_are_overwritten_and_only_on_request(bag, replayed, tmp_path):
    results = tmp_path / 'results'
    shutil.copytree(replayed[0], results)
    (results / 'notes.txt').write_text('mine')
    before = (results / 'summary.json').read_bytes()
    printed = djet('replay', bag, '--output', results, expect=2).stderr
    assert '--overwrite' in printed
    assert len(printed.splitlines()) == 1
    assert (results / 'summary.json').read_bytes() == before
    djet('replay', bag, '--output', results, '--overwrite', '--preset', 'paper')
    assert summary(results)['preset'] == 'paper'
    assert (results / 'notes.txt').read_text() == 'mine'
    other = tmp_path / 'other'
    other.mkdir()
    (other / 'thesis.tex').write_text('mine')
    assert 'no earlier results' in djet('replay', bag, '--output', other, '--overwrite',
                                        expect=2).stderr


def test_a_folder_to_which_another_replay_still_writes_is_refused(tmp_path):
    results = tmp_path / 'results'
    with ResultsFolder(results, Config()):
        before = contents(results)
        with pytest.raises(DjetError, match='written to by another replay, which still runs'):
            ResultsFolder(results, from_flat({'preset': 'fast'}), overwrite=True)
        assert contents(results) == before
    with ResultsFolder(results, from_flat({'preset': 'fast'}), overwrite=True):
        assert load_yaml(results / 'config.yaml').preset == 'fast'


@pytest.mark.parametrize('mistake', [
    ('absent',), ('bag', '--mask-file', 'absent.png'), ('bag', '--poses', 'absent.txt'),
    ('bag', '--scale', 'speed'), ('bag', '--preset', 'bset'), ('bag', '--imu-topic', '/imu')])
def test_a_mistake_in_the_command_costs_no_earlier_results(mistake, bag, replayed, tmp_path):
    results = tmp_path / 'results'
    shutil.copytree(replayed[0], results)
    before = contents(results)
    source, *call = mistake
    printed = djet('replay', bag if source == 'bag' else tmp_path / source, *call, '--output',
                   results, '--overwrite', expect=2).stderr
    assert printed.count('\n') == 1
    assert contents(results) == before


def test_images_of_which_none_can_be_used_cost_no_earlier_results(folder, replayed, tmp_path):
    results = tmp_path / 'results'
    shutil.copytree(replayed[0], results)
    before = contents(results)
    shutil.copytree(folder, tmp_path / '00')
    for path in (tmp_path / '00' / 'image_0').iterdir():
        path.write_bytes(path.read_bytes()[:500])
    printed = djet('replay', tmp_path / '00', '--output', results, '--overwrite', expect=2).stderr
    assert f'none of {FRAMES} images could be used' in printed
    assert contents(results) == before
    djet('replay', folder, '--output', results, '--overwrite', '--preset', 'paper')
    assert summary(results)['preset'] == 'paper'
    assert not list(results.glob('.*'))


@pytest.mark.slow
def test_results_are_utf_8_whatever_the_locale_is(bag, tmp_path):
    done = alone('replay', bag, '--output', tmp_path / 'out', LC_ALL='C', PYTHONUTF8='0',
                 PYTHONCOERCECLOCALE='0')
    assert (done.returncode, done.stderr) == (0, '')
    assert 'rad/s²' in (tmp_path / 'out' / 'config.yaml').read_text('utf-8')
    assert load_yaml(tmp_path / 'out' / 'config.yaml') == Config()


# What is refused

def missing(tmp_path, bag):
    return [tmp_path / 'absent']


def device(tmp_path, bag):
    return ['/dev/null']


def empty_bag(tmp_path, bag):
    return [record(tmp_path / 'empty', [])]


def no_images(tmp_path, bag):
    return [record(tmp_path / 'blind', [(INFO_TOPIC, camera_info(K, SIZE), SECOND)])]


def no_info(tmp_path, bag):
    return [record(tmp_path / 'wild', drive(info=False))]


def late_info(tmp_path, bag):
    messages = [*drive(info=False), (INFO_TOPIC, camera_info(K, SIZE), 9 * SECOND)]
    return [record(tmp_path / 'late', messages)]


def zeros(tmp_path, bag):
    info = camera_info(np.zeros((3, 3)), SIZE, p=np.zeros(12))
    return [record(tmp_path / 'zeros', [(INFO_TOPIC, info, SECOND), *drive(info=False)])]


def sepia(tmp_path, bag):
    return [record(tmp_path / 'sepia', drive(
        lambda i, m: image(np.zeros(SIZE[::-1], np.uint8), 'sepia')))]


def short(tmp_path, bag):
    return [record(tmp_path / 'short', drive(
        lambda i, m: image(np.zeros(SIZE[::-1], np.uint8), data=np.zeros(9, np.uint8))))]


def wrong_poses(tmp_path, bag):
    file = tmp_path / 'poses.txt'
    file.write_text('1 0 0 0 0 1 0 0 0 0 1 0\n' * (FRAMES - 1))
    return [bag, '--poses', file]


def poses_without_stamps(tmp_path, bag):
    # As TartanAir has them.
    file = tmp_path / 'poses.txt'
    file.write_text('0 0 0 0 0 0 1\n' * FRAMES)
    return [bag, '--poses', file]


def bad_config(tmp_path, bag):
    file = tmp_path / 'bad.yaml'
    file.write_text('estimator: {windw: 5}\n')
    return [bag, '--config', file]


@pytest.mark.parametrize('make, message', [
    (missing, 'does not exist'), (empty_bag, 'holds no messages'), (no_images, 'no image topic'),
    (device, '/dev/null is neither a file nor a folder; name a bag or a folder'),
    (no_info, 'no CameraInfo'), (zeros, 'all zeros'),
    (late_info, f'has an earlier CameraInfo on {INFO_TOPIC} (the first one was recorded 8.000 s '
                'after the first image); record it before'),
    (sepia, "'sepia'"), (short, '9 bytes'), (wrong_poses, '5 poses'),
    (poses_without_stamps, 'begins with a row of 7 words; a TUM file has 8 numbers in a row'),
    (bad_config, "did you mean 'estimator.window'"),
    (lambda t, b: [b, '--method', 'sift'], "'sift'"),
    (lambda t, b: [b, '--scale', 'speed'], 'speed'),
    (lambda t, b: [b, '--scale', 'camera_height'], 'give the metres from the ground'),
    (lambda t, b: [b, '--scale', 'constant'], 'scale_value is 0; give the metres of each'),
    (lambda t, b: [b, '--image-topic', '/other'], "no image topic '/other'"),
    (lambda t, b: [b, '--info-topic', '/other'], "no CameraInfo topic '/other'"),
    (lambda t, b: [b, '--imu', 'true', '--imu-topic', '/other'], "no topic '/other' for 'imu'"),
    *[(lambda t, b, what=what: [b, f'--{what}-topic', '/some'],
       f"--{what}-topic is '/some', but the configuration does not use it; set odometry.")
      for what in ('speed', 'imu', 'guess', 'mask')],
    *[(lambda t, b, call=call: [b, *call],
       f"{call[-2]} is '{call[-1]}', but the configuration does not use it; set odometry.{use}, "
       'or omit the option')
      for *call, use in (
          ('--camera-height', '1.65', 'scale to camera_height'),
          ('--camera-pitch', '-2.0', 'scale to camera_height'),
          ('--scale', 'none', '--scale-value', '3.0', 'scale to constant'),
          ('--guess-frame', 'odom', 'guess to true or odometry.scale to guess'))],
])
def test_invalid_call_is_one_line_and_exit_code_2(make, message, tmp_path, bag):
    done = djet('replay', *make(tmp_path, bag), '--output', tmp_path / 'results', expect=2)
    assert len(done.stderr.splitlines()) == 1
    assert done.stderr.startswith('djet: error: ')
    assert message in done.stderr


@pytest.mark.parametrize('verb', [('replay',), ('lab', 'evaluate'), ('lab', 'surfaces')])
def test_unwritable_output_is_one_line_without_results(
        verb, folder, tmp_path):
    file = tmp_path / 'bad.yaml'
    file.write_text('')
    for place, why in ((file / 'x.png', f'{file} exists and is not a folder; choose another'),
                       ('/proc/x/y.png', 'could not be created: ')):
        printed = djet(*verb, folder, '--output', place, expect=2).stderr
        assert why in printed
        assert printed.count('\n') == 1
        assert 'readable' not in printed
    assert file.read_text() == ''


def test_dangling_link_or_empty_output_path_is_reported(folder, tmp_path):
    (tmp_path / 'link').symlink_to(tmp_path / 'gone')
    for place, why in ((tmp_path / 'link', f'is a link to {tmp_path}/gone, which does not exist'),
                       ('', 'argument --output: the path is empty; name a file or folder')):
        assert why in djet('replay', folder, '--output', place, expect=2).stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ['link']


def test_scale_of_a_file_may_have_its_length_from_a_flag(bag, tmp_path):
    file = tmp_path / 'car.yaml'
    file.write_text('odometry: {scale: constant}\n')
    djet('replay', bag, '--config', file, '--scale-value', '0.5', '--output', tmp_path / 'out')
    assert summary(tmp_path / 'out')['scale_kind'] == 'metric'


def test_a_file_may_have_parameters_that_only_some_scales_use(bag, tmp_path):
    """Cars and drones share one; a flag may also take back a value."""
    file = tmp_path / 'fleet.yaml'
    file.write_text('odometry: {camera_height: 1.65, scale_value: 3.0, guess_frame: odom}\n')
    djet('replay', bag, '--config', file, '--guess-frame', '', '--output', tmp_path / 'out')
    assert summary(tmp_path / 'out')['scale_kind'] == 'relative'


def test_recording_without_tracked_pairs_gives_a_warning(tmp_path):
    source = record(tmp_path / 'bag', drive(
        lambda i, message: image(np.zeros(SIZE[::-1], np.uint8), stamp_ns=stamp_at(i))))
    done = djet('replay', source, '--poses', true_poses(tmp_path / 'poses.txt'), '--output',
                tmp_path / 'out')
    assert (f'djet: warning: none of {FRAMES - 1} pairs could be tracked (mostly '
            'TOO_FEW_MATCHES): the images are dark') in done.stderr
    assert 'positions' not in done.stdout
    assert 'plot' not in done.stdout
    found = summary(tmp_path / 'out')
    assert (found['positions'], found['drift']) == (None, None)
    assert found['failures'] == FRAMES - 1
    assert found['scale_kind'] == 'unknown'


def test_a_recording_of_one_image_gives_a_warning(tmp_path):
    source = record(tmp_path / 'bag', drive(lambda i, message: None if i else message))
    done = djet('replay', source, '--output', tmp_path / 'out')
    assert done.stderr == ('djet: warning: only one image was used, so no motion was estimated: '
                           'that takes two images\n')


@pytest.mark.slow
def test_stationary_camera_gives_a_warning(tmp_path):
    source = record(tmp_path / 'bag', drive(
        lambda i, message: image(Cards().gray(), stamp_ns=stamp_at(i))))
    done = djet('replay', source, '--output', tmp_path / 'out')
    assert (f'djet: warning: all {FRAMES - 1} pairs have no parallax (NO_PARALLAX): the camera '
            'was stationary or only rotated') in done.stderr


def test_a_mask_that_excludes_the_image_is_named_with_its_values(tmp_path, folder):
    """One of 0 and 1, as segmentation writes it, would leave dark images to be blamed."""
    file, mask = tmp_path / 'mask.png', np.ones(SIZE[::-1], np.uint8)
    mask[200:] = 0
    cv2.imwrite(str(file), mask)
    replayed = ('replay', folder, '--mask-file', file, '--output', tmp_path / 'out')
    done = djet(*replayed, expect=2)
    assert (f'{file} excludes the whole image, or leaves no place for a feature: pixels below 128 '
            'are excluded, and its values are 0 to 1; make 255 ') in done.stderr
    assert not (tmp_path / 'out').exists()
    mask[:], mask[:, :30] = 0, 255
    cv2.imwrite(str(file), mask)
    done = djet(*replayed)
    assert f'none of {FRAMES - 1} pairs could be tracked (mostly TOO_FEW_MATCHES): ' in done.stderr
    assert 'excludes 91% of the image: pixels below 128 are excluded' in done.stderr
    assert 'exposure' not in done.stderr


def test_images_beyond_max_gap_give_a_warning(tmp_path, bag):
    file = tmp_path / 'slow.yaml'
    file.write_text('odometry: {max_gap: 0.05}\n')
    done = djet('replay', bag, '--config', file, '--output', tmp_path / 'out')
    assert f'none of {FRAMES} images could be paired' in done.stderr
    assert 'exceeds odometry.max_gap; set it to a larger value' in done.stderr


def test_12_bit_camera_gives_a_warning_that_gray_range_resolves(tmp_path):
    source = record(tmp_path / 'bag', drive(lambda i, message: image(
        message.data.reshape(SIZE[::-1]).astype('<u2') * 4, 'mono16', stamp_at(i))))
    done = djet('replay', source, '--output', tmp_path / 'dark')
    assert 'djet: warning: few gray levels: ' in done.stderr
    done = djet('replay', source, '--gray-range', '0 1023', '--output', tmp_path / 'stretched')
    assert 'warning' not in done.stderr
    assert summary(tmp_path / 'stretched')['status'][Status.OK.value] == FRAMES - 1


def test_truncated_bag_is_used_up_to_the_cut(bag, tmp_path):
    cut = tmp_path / 'cut.mcap'
    whole = next(bag.glob('*.mcap')).read_bytes()
    cut.write_bytes(whole[:len(whole) * 6 // 10])
    results = tmp_path / 'results'
    printed = djet('replay', cut, '--scale', 'ground_truth', '--output', results, expect=2).stderr
    assert len(printed.splitlines()) == 1
    assert 'cut short' in printed
    found = summary(results)
    assert found['complete'] is False
    assert 'cut short' in found['error']
    assert 1 < found['frames'] < FRAMES
    assert len(read_tum(results / 'trajectory_tum.txt')[0]) == found['frames']
    with Bag(results / 'bag') as out:
        assert len(list(out.messages({'/vo_node/odometry'}))) == found['frames']
    assert found['rotation_error_deg'] is not None


@pytest.mark.slow
@pytest.mark.parametrize('damage, reason, frames', [
    (lambda i, m: image(np.zeros((100, 100), np.uint8), stamp_ns=stamp_at(i)) if i == 3 else m,
     'size_mismatch', FRAMES - 1),
    (lambda i, m: image(np.zeros((240, 320), np.uint8), height=999, stamp_ns=stamp_at(i))
     if i in (2, 4) else m, 'size_mismatch|short_data', FRAMES - 2)])
def test_bad_image_is_named_and_the_rest_is_tracked(
        damage, reason, frames, tmp_path):
    results = tmp_path / 'results'
    printed = djet('replay', record(tmp_path / 'bag', drive(damage)), '--output', results,
                   expect=2).stderr
    assert len(printed.splitlines()) == 1
    assert f'{FRAMES - frames} of {FRAMES} images' in printed
    found = summary(results)
    assert found['complete'] is True
    assert found['frames'] == frames
    assert set(found['rejected']) <= set(reason.split('|'))
    rows = list(csv.DictReader((results / 'frames.csv').open()))
    assert sum(row['status'] == 'UNUSED' for row in rows) == FRAMES - frames


@pytest.mark.slow
@pytest.mark.parametrize('bad', [{'data': np.zeros(9, np.uint8)}, {'height': 0, 'width': 0}])
def test_bad_first_image_is_named_and_does_not_change_the_other_poses(bad, tmp_path):
    def damage(i, message):
        return image(np.zeros(SIZE[::-1], np.uint8), **bad) if i == 0 else message

    printed = djet('replay', record(tmp_path / 'bad', drive(damage)), '--output', tmp_path / 'r',
                   expect=2).stderr
    assert printed.count('\n') == 1
    assert f'1 of {FRAMES} images could not be used; image 0: ' in printed
    djet('replay', record(tmp_path / 'good', drive(lambda i, message: message if i else None)),
         '--output', tmp_path / 'without')
    assert summary(tmp_path / 'r')['complete'] is True
    assert summary(tmp_path / 'r')['frames'] == FRAMES - 1
    assert (tmp_path / 'r' / 'trajectory_tum.txt').read_bytes() == (
        tmp_path / 'without' / 'trajectory_tum.txt').read_bytes()


@pytest.mark.parametrize(('at', 'left', 'why'), [
    (0, 500, 'PNG image of 500 bytes is cut short'),
    (3, 500, 'PNG image of 500 bytes is cut short'),
    (3, 20, 'PNG image of 20 bytes is cut short'), (0, 0, 'compressed image is empty'),
    (FRAMES - 1, 0, 'compressed image is empty')])
def test_damaged_image_file_is_counted_like_a_bad_image_of_a_bag(
        at, left, why, folder, tmp_path):
    shutil.copytree(folder, tmp_path / '00')
    cut = tmp_path / '00' / 'image_0' / f'{at:06d}.png'
    cut.write_bytes(cut.read_bytes()[:left])
    printed = djet('replay', tmp_path / '00', '--output', tmp_path / 'r', expect=2).stderr
    assert printed == (
        f'djet: error: {tmp_path / "00"}: 1 of {FRAMES} images could not be used; image {at}: '
        f'{why}\n')
    found = summary(tmp_path / 'r')
    assert (found['complete'], found['frames']) == (True, FRAMES - 1)
    assert found['rejected'] == {'undecodable': 1}
    # The commands that make something of each image go no further.
    done = djet('kitti-to-bag', tmp_path / '00', tmp_path / 'bag', expect=2)
    assert f'{cut} is a damaged image' in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize('at', [0, 3])
def test_zero_camera_info_loses_the_images_up_to_the_next_one(at, tmp_path):
    messages, zero = list(drive()), camera_info(np.zeros((3, 3)), SIZE, p=np.zeros(12))
    messages.insert(2 * at + 1, (INFO_TOPIC, zero, messages[2 * at][2]))
    path = record(tmp_path / 'bag', messages)
    printed = djet('replay', path, '--output', tmp_path / 'r', expect=2).stderr
    assert printed.count('\n') == 1
    assert ': 1 CameraInfo could not be used; ' in printed
    assert 'all zeros' in printed
    found = summary(tmp_path / 'r')
    assert (found['complete'], found['frames']) == (True, FRAMES - 1)
    assert found['dropped'] == {'waiting_for_camera_info': 1}
    assert sum(found['rejected_infos'].values()) == 1
    # A second pass over the recording has the cameras of the odometry.
    with open_recording(path) as recording:
        frame = frame_finder(recording, Config())(stamp_at(5))
    assert frame.gray.shape == SIZE[::-1]


@pytest.mark.slow
def test_change_of_image_size_is_reported(tmp_path):
    messages = list(drive())
    for i, (topic, message, _) in enumerate(messages):
        if i >= 6 and topic == IMAGE_TOPIC:
            message.height, message.data = 200, message.data[:200 * SIZE[0]]
        elif i >= 6:
            message.height = 200
    printed = djet('replay', record(tmp_path / 'bag', messages), '--output', tmp_path / 'r',
                   expect=2).stderr
    assert 'changes once' in printed
    assert summary(tmp_path / 'r')['status'] == {'FIRST_FRAME': 1, 'OK': 4, 'SIZE_CHANGED': 1}


def test_autofocus_that_changes_every_camera_matrix_is_named_with_a_remedy(tmp_path):
    messages = [
        (topic, camera_info(K + np.diag([0.01 * i, 0.01 * i, 0]), SIZE, stamp), stamp)
        if topic == INFO_TOPIC else (topic, message, stamp)
        for i, (topic, message, stamp) in enumerate(drive())]
    printed = djet('replay', record(tmp_path / 'bag', messages), '--output', tmp_path / 'r',
                   expect=2).stderr
    assert f'the camera matrix changes {FRAMES - 1} times' in printed
    assert 'with autofocus and zoom off and one CameraInfo for all images' in printed
    # A longer max_gap would not help.
    assert printed.count('\n') == 1


def test_images_before_the_first_camera_info_give_a_warning(tmp_path):
    def messages():
        for i, (topic, message, stamp) in enumerate(drive(info=False)):
            if i == 2:
                yield INFO_TOPIC, camera_info(K, SIZE, stamp), stamp
            yield topic, message, stamp

    path = record(tmp_path / 'bag', messages())
    printed = djet('replay', path, '--output', tmp_path / 'r').stderr
    assert printed == (
        f'djet: warning: 2 of {FRAMES} images have no earlier CameraInfo on {INFO_TOPIC} and were '
        'dropped, as in a live node: the first one was recorded 0.200 s after the first image; '
        'record it before the images\n')
    assert summary(tmp_path / 'r')['dropped'] == {'waiting_for_camera_info': 2}


def shifted(frames, seconds):
    """Yield the messages of a drive, of which some frames have other stamps."""
    for i, (topic, message, stamp) in enumerate(drive()):
        stamp += round(seconds * SECOND) if i // 2 in frames else 0
        message.header = header(stamp)
        yield topic, message, SECOND + i


@pytest.mark.slow
def test_stamps_that_go_back_are_reported_with_the_restart(tmp_path):
    path = record(tmp_path / 'bag', shifted(range(3), 10))
    printed = djet('replay', path, '--output', tmp_path / 'r', expect=2).stderr
    assert printed == (f'djet: error: {path}: the stamps go back once; the poses restart at the '
                       'origin at stamp 1.300000000\n')
    assert summary(tmp_path / 'r')['complete'] is True
    _, poses = read_tum(tmp_path / 'r' / 'trajectory_tum.txt')
    assert np.array_equal(poses[3], np.eye(4))


@pytest.mark.slow
def test_image_stamped_ahead_does_not_change_the_poses(tmp_path):
    for name, messages in (('ahead', shifted({3}, 5)),
                           ('without', drive(lambda i, message: None if i == 3 else message))):
        djet('replay', record(tmp_path / name, messages), '--output', tmp_path / f'{name}_r')
    poses = [(tmp_path / f'{name}_r' / 'trajectory_tum.txt').read_bytes()
             for name in ('ahead', 'without')]
    assert poses[0] == poses[1]
    assert summary(tmp_path / 'ahead_r')['dropped'] == {'ahead': 1}


@pytest.mark.slow
def test_gap_gives_a_warning_with_its_length(tmp_path):
    path = record(tmp_path / 'bag', shifted(range(3, FRAMES), 5))
    printed = djet('replay', path, '--output', tmp_path / 'r').stderr
    assert printed == (
        'djet: warning: 1 gaps between images exceed odometry.max_gap; the longest, 5.100 s, ends '
        'at stamp 6.300000000; the trajectory continues at the last pose, without the motion in '
        'the gap\n')


@pytest.mark.slow
@pytest.mark.parametrize('goes_on', [False, True])
def test_constant_stamps_give_a_warning(goes_on, tmp_path):
    def messages():
        yield INFO_TOPIC, camera_info(K, SIZE, SECOND), SECOND
        stamps = [1] * 8 + [2] * goes_on
        for i, stamp in enumerate(stamps):
            yield IMAGE_TOPIC, image(Cards().gray(), stamp_ns=stamp * SECOND), SECOND + i

    bag = record(tmp_path / 'bag', messages())
    printed = djet('replay', bag, '--output', tmp_path / 'r').stderr
    assert ('djet: warning: stamps stand still: 7 images in a row have the stamp 1.000000000 and '
            'are dropped; ') in printed
    assert summary(tmp_path / 'r')['dropped'] == {'equal_stamp': 7}


@pytest.mark.slow
@pytest.mark.parametrize('sign, code', [
    (signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_interrupted_run_is_readable_and_marked_incomplete(tmp_path, sign, code):
    endless = filmed(tmp_path / 'sequences' / '01', POSES, 2000)
    results = tmp_path / 'results'
    process = subprocess.Popen([*DJET, 'replay', endless, '--output', results],
                               stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    trajectory = results / 'trajectory_tum.txt'
    deadline = time.monotonic() + 60
    while not (trajectory.exists() and len(trajectory.read_text().splitlines()) > 5):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    process.send_signal(sign)
    assert process.wait(30) == code
    assert 'Traceback' not in process.stderr.read()
    found = summary(results)
    assert found['complete'] is False
    assert (found['source'], found['image_topic']) == (str(endless), IMAGE_TOPIC)
    assert 'images' in found
    assert len(trajectory.read_text().splitlines()) > 5
    assert (results / 'bag' / 'metadata.yaml').exists()
    with Bag(results / 'bag') as out:
        assert len(list(out.messages({'/vo_node/odometry'}))) > 5


@pytest.mark.parametrize('place', range(1, 11, 3))
def test_a_signal_within_a_write_waits_until_the_frame_is_in_all_results(
        place, folder, tmp_path, monkeypatch):
    """The signal comes at several places within what rosbags writes of a frame."""
    records, write, left = count(1), Writer.write, place

    def watch(frame, event, _):
        nonlocal left
        if event == 'call' and 'rosbags' in frame.f_code.co_filename:
            left -= 1
            if not left:
                sys.setprofile(None)
                signal.raise_signal(signal.SIGTERM)

    def watched(*arguments):
        if next(records) == 9:
            sys.setprofile(watch)
        write(*arguments)

    monkeypatch.setattr(Writer, 'write', watched)
    results = tmp_path / 'results'
    djet('replay', folder, '--output', results, expect=143)
    with Bag(results / 'bag') as out:
        written = list(out.messages({'/vo_node/odometry'}))
    poses = (results / 'trajectory_tum.txt').read_text().splitlines()
    rows = (results / 'frames.csv').read_text().splitlines()[1:]
    assert 0 < len(written) == len(poses) == len(rows) < FRAMES


# Sources of ground truth

def test_poses_of_a_file_replace_those_of_the_bag(bag, folder, tmp_path):
    kitti = folder.parents[1] / 'poses' / '00.txt'
    tum = tmp_path / 'truth.txt'
    sequence = KittiSequence(folder)
    with TumWriter(tum) as writer:
        for stamp, true_pose in zip(sequence.stamps_ns.tolist(), sequence.poses, strict=True):
            writer.write(stamp, true_pose)
    for poses in (None, kitti, tum):
        source = open_recording(bag, poses=poses)
        found = [pose_of(m.message) for m in source.messages()
                 if m.topic == source.ground_truth_topic]
        source.close()
        assert [stamp for stamp, _ in found] == sequence.stamps_ns.tolist()
        assert np.allclose([p for _, p in found], sequence.poses, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize('first, apart, why', [
    (5000, 1, 'no errors were computed: the stamps of {} are 5000.000000000 to 5005.000000000, '
     'those of the images 1.000000000 to 1.500000000; give ground truth with the same clock'),
    (0.95, 0.2, 'no errors were computed: no image lies between two poses of {} that are at most '
     '0.1 s apart; give ground truth with a higher rate')])
def test_ground_truth_of_another_time_gives_a_warning(first, apart, why, tmp_path):
    poses = true_poses(tmp_path / 'poses.txt', lambda i: round((first + i * apart) * SECOND))
    printed = djet('replay', record(tmp_path / 'bag', drive()), '--poses', poses, '--output',
                   tmp_path / 'r').stderr
    assert printed == f'djet: warning: {why.format(poses)}\n'
    assert summary(tmp_path / 'r')['compared_pairs'] == 0
    assert summary(tmp_path / 'r')['drift'] is None


@pytest.mark.slow
def test_several_ground_truths_are_named_with_a_remedy(bag, tmp_path):
    with Bag(bag) as whole:
        messages = [(one.topic, one.message, one.stamp_ns) for one in whole.messages()]
    twice = record(tmp_path / 'twice', [
        *messages, *(('/ground_truth/base', message, stamp)
                     for topic, message, stamp in messages if topic == '/ground_truth/pose')])
    both = ('/ground_truth/base and /ground_truth/pose may be the ground truth; give that of the '
            'camera as a file (--poses)\n')
    done = djet('replay', twice, '--output', tmp_path / 'out')
    assert done.stderr == f'djet: warning: no errors were computed: {both}'
    answer = djet('replay', twice, '--output', tmp_path / 'no', '--scale', 'ground_truth',
                  expect=2)
    assert answer.stderr.endswith(f"odometry.scale is 'ground_truth', but {both}")


@pytest.mark.slow
@pytest.mark.parametrize('child, warned', [
    ('base_link', True), ('/camera', False), ('', False), ('\x1b[2Jbase', True)])
def test_a_ground_truth_that_is_not_of_the_camera_gives_a_warning(child, warned, tmp_path):
    # As a simulator publishes it, of the vehicle.
    kinds = {name: message_type(f'geometry_msgs/msg/{name}')
             for name in ('TransformStamped', 'Transform', 'Vector3')}

    def truth():
        for i, here in enumerate(POSES):
            stamp = stamp_at(i)
            stamped = MAKE.pose_in(stamp, 'world', here)
            at = stamped.pose.position
            yield '/ground_truth/state', kinds['TransformStamped'](
                stamped.header, child, kinds['Transform'](
                    kinds['Vector3'](at.x, at.y, at.z), stamped.pose.orientation)), stamp

    bag = record(tmp_path / 'bag', [*truth(), *drive()])
    printed = djet('replay', bag, '--output', tmp_path / 'r').stderr
    # A name from a bag controls no terminal.
    told = child.replace('\x1b', '?')
    assert printed == warned * (
        f"djet: warning: the ground truth on /ground_truth/state is of '{told}', the images of "
        "'camera': errors hold only if both have the same place and axes (x right, y down, z "
        'ahead); give ground truth of the camera as a file (--poses)\n')
    assert summary(tmp_path / 'r')['compared_pairs'] == FRAMES - 1


def test_poses_are_read_from_every_kind_of_message():
    quaternion = message_type('geometry_msgs/msg/Quaternion')(x=0.0, y=0.0, z=1.0, w=0.0)
    point = message_type('geometry_msgs/msg/Point')(x=1.0, y=2.0, z=3.0)
    vector = message_type('geometry_msgs/msg/Vector3')(x=1.0, y=2.0, z=3.0)
    posed = message_type('geometry_msgs/msg/Pose')(position=point, orientation=quaternion)
    twist = message_type('geometry_msgs/msg/Twist')(linear=vector, angular=vector)
    with_covariance = message_type('geometry_msgs/msg/PoseWithCovariance')(posed, np.zeros(36))
    moving = message_type('geometry_msgs/msg/TwistWithCovariance')(twist, np.zeros(36))
    head = header(5 * SECOND + 7)
    for message in (
            message_type('geometry_msgs/msg/PoseStamped')(head, posed),
            message_type('nav_msgs/msg/Odometry')(head, 'a', with_covariance, moving),
            message_type('geometry_msgs/msg/TransformStamped')(
                head, 'a', message_type('geometry_msgs/msg/Transform')(vector, quaternion))):
        stamp, found = pose_of(message)
        assert stamp == 5 * SECOND + 7
        assert np.allclose(found, [[-1, 0, 0, 1], [0, -1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    posed.orientation.z = 0.0
    assert np.isnan(pose_of(message_type('geometry_msgs/msg/PoseStamped')(head, posed))[1]).all()


def with_speeds(late=0):
    """Yield the messages of a drive with speeds, whose stamps are late by some seconds."""
    vector = message_type('geometry_msgs/msg/Vector3')
    for topic, message, stamp in drive():
        if topic == INFO_TOPIC:
            twist = message_type('geometry_msgs/msg/Twist')(
                linear=vector(x=2.0, y=0.0, z=0.0), angular=vector(x=0.0, y=0.0, z=0.0))
            yield '/wheel', message_type('geometry_msgs/msg/TwistStamped')(
                header=header(stamp + late * SECOND), twist=twist), stamp
        yield topic, message, stamp


def test_a_speed_topic_gives_metres(tmp_path):
    printed = djet('replay', record(tmp_path / 'bag', with_speeds()), '--output', tmp_path / 'r',
                   '--scale', 'speed')
    assert re.search(r'scale\W+metric', printed.stdout)
    assert printed.stderr == ''
    _, poses = read_tum(tmp_path / 'r' / 'trajectory_tum.txt')
    # Speeds are fused with the lengths from landmarks.
    assert np.allclose(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1), 0.2, rtol=0.01)


@pytest.mark.slow
def test_metric_scale_without_measurements_gives_a_warning(tmp_path):
    source = record(tmp_path / 'bag', with_speeds(late=3600))
    poses = true_poses(tmp_path / 'another_day.txt', lambda i: (5000 + i) * SECOND)
    for call, why in (
            (('speed',), 'the newest speed is stamped 3600.0 s after the newest image; give speeds'
             ' that are stamped by the clock of the images'),
            (('camera_height', '--camera-height', '1.5'), 'the images show no level ground'),
            (('ground_truth', '--poses', poses), 'the ground truth does not cover the time')):
        done = djet('replay', source, '--output', tmp_path / call[0], '--scale', *call)
        assert ('djet: warning: no metric length: odometry.scale is '
                f'{call[0]}, and no length was measured: {why}') in done.stderr
        assert re.search(r'scale\W+relative, in units of the first step', done.stdout)


@pytest.mark.slow
def test_scale_source_that_begins_late_gives_a_warning_of_mixed_units(tmp_path):
    """At 2.5 Hz a speed counts for the images up to half a second before it."""
    def slower(stamp):
        return SECOND + 4 * (stamp - SECOND)

    def messages(first):
        for topic, message, stamp in with_speeds():
            message.header = header(slower(stamp))
            if topic != '/wheel' or slower(stamp) >= first:
                yield topic, message, slower(stamp)

    for first, said in ((SECOND, ''), (26 * SECOND // 10, (
            'djet: warning: the trajectory mixes units: its first 3 lengths are relative, those '
            'from stamp 2.600000000 on are metric; start the source of odometry.scale before the '
            'images, or use only the part after that stamp\n'))):
        done = djet('replay', record(tmp_path / f'{first}', messages(first)), '--output',
                    tmp_path / f'{first}r', '--scale', 'speed')
        assert done.stderr == said


def test_topics_are_for_bags(folder):
    with pytest.raises(DjetError, match='not a bag'):
        open_recording(folder, image_topic='/camera')


# Errors

def test_ground_truth_is_exact_at_its_stamps_and_interpolated_between_near_ones():
    truth = GroundTruth()
    for i, x in enumerate((0.0, 1.0, 4.0)):
        truth.add(i * 80_000_000, pose(x=x, yaw=0.1 * i))
    truth.add(SECOND, pose(x=9))
    truth.add(2 * SECOND, np.full((4, 4), np.nan))
    found = truth.at(np.array([80_000_000, 120_000_000, 500_000_000, SECOND, 2 * SECOND, -1]))
    assert np.array_equal(found[0], pose(x=1.0, yaw=0.1))
    assert np.allclose(found[1], pose(x=2.5, yaw=0.15))
    assert np.array_equal(found[3], pose(x=9))
    assert np.isnan(found[[2, 4, 5]]).all()


def test_errors_follow_the_stated_rules():
    truth = [np.eye(4), pose(z=1.0), pose(z=1.005), pose(z=2), pose(z=3), np.full((4, 4), np.nan)]
    wrong = pose(x=1.0)
    wrong[:3, :3] = rotation_exp(np.array([0, 0, np.radians(3)]))
    pairs = [Step(i + 1, status, pose(), i, wrong) for i, status in enumerate(
        (Status.OK, Status.OK, Status.NO_PARALLAX, Status.TOO_FEW_MATCHES, Status.OK))]
    errors = pair_errors(pairs, np.array(truth[:-1]), np.array(truth[1:]))
    assert np.allclose(errors.rotation_deg, [3, 3, 3, np.nan, np.nan], equal_nan=True)
    # The second pair went 5 mm; the third was called NO_PARALLAX but went a metre.
    assert np.allclose(errors.translation_deg, [90, *[np.nan] * 4], equal_nan=True)
    assert (errors.compared, errors.failures, errors.translation_failures) == (4, 1, 2)


def test_statistics_ignore_nan():
    assert statistics(np.array([np.nan])) is None
    assert statistics(np.array([1.0, np.nan, 3.0])) == {
        'mean': 2.0, 'median': 2.0, 'p95': pytest.approx(2.9), 'max': 3.0}


def test_real_frames_are_replayed_within_a_degree(kitti, tmp_path):
    source = kitti / 'sequences' / '06'
    short = tmp_path / 'sequences' / '06'
    (short / 'image_0').mkdir(parents=True)
    for i in range(8):
        os.symlink(source / 'image_0' / f'{i:06d}.png', short / 'image_0' / f'{i:06d}.png')
    shutil.copy(source / 'calib.txt', short)
    (short / 'times.txt').write_text(
        '\n'.join((source / 'times.txt').read_text().splitlines()[:8]) + '\n')
    truth = tmp_path / 'truth.txt'
    truth.write_text('\n'.join((kitti / 'poses' / '06.txt').read_text().splitlines()[:8]) + '\n')
    djet('replay', short, '--poses', truth, '--output', tmp_path / 'r')
    found = summary(tmp_path / 'r')
    assert found['status'] == {'FIRST_FRAME': 1, 'OK': 7}
    assert found['rotation_error_deg']['max'] < 0.5
    assert found['translation_error_deg']['max'] < 2


def test_unused_auxiliary_inputs_give_a_warning(folder, tmp_path):
    source = with_imu(folder, tmp_path)
    for enough in (False, True):
        if enough:
            (source / 'imu.csv').write_text('')
        run = djet('replay', source, '--imu', 'true', '--overwrite', '--output', tmp_path / 'out')
        assert ('djet: warning: no imu in time: ' in run.stderr) is enough
