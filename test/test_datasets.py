"""TUM RGB-D and EuRoC folders, and the detection of layouts."""

import cv2
from djet_ros.errors import DjetError
from djet_ros.odometry.camera import Camera, is_rectified
from djet_ros.odometry.images import gray_image
from djet_ros.odometry.interpolation import poses_at
from djet_ros.recordings.bag_writers import write_kitti_bag
from djet_ros.recordings.datasets import euroc, LONGEST_GAP_NS, open_sequence, tum_rgbd
from djet_ros.recordings.frame_sequence import from_first
from djet_ros.recordings.kitti import KittiSequence
from djet_ros.recordings.recording import BagRecording, open_recording
from djet_ros.replay.ground_truth import GroundTruth
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

STAMPS = [1403636579763555584 + i * 50_000_000 for i in range(5)]
SIZE = (160, 120)
DISTORTION = [-0.28, 0.07, 0.0002, 0.00002]
INTRINSICS = [110.0, 109.0, 80.0, 60.0]
K = np.array([[110.0, 0, 80], [0, 109, 60], [0, 0, 1]])
# cam0 sees along the body's x axis.
CAMERA_IN_BODY = np.array([[0, 0, 1, 0.1], [-1, 0, 0, 0.2], [0, -1, 0, 0.3], [0, 0, 0, 1.0]])

SENSOR = f"""\
# General sensor definitions.
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: {CAMERA_IN_BODY.ravel().tolist()}
resolution: [160, 120]
camera_model: pinhole
intrinsics: {INTRINSICS} #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: {DISTORTION}
"""


def spot(place):
    """Image of a bright spot around a place in pixels."""
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    square = (x - place[0])**2 + (y - place[1])**2
    return np.round(255 * np.exp(-square / 8)).astype(np.uint8)


@pytest.fixture
def asl(tmp_path):
    """Return an EuRoC folder: a body that flies 1 m/s along its x axis, its images a spot."""
    folder = tmp_path / 'MH_01'
    (folder / 'mav0' / 'cam0' / 'data').mkdir(parents=True)
    (folder / 'mav0' / 'state_groundtruth_estimate0').mkdir()
    camera = folder / 'mav0' / 'cam0'
    (camera / 'sensor.yaml').write_text(SENSOR)
    (camera / 'data.csv').write_text('#timestamp [ns],filename\r\n' + ''.join(
        f'{stamp},{stamp}.png\r\n' for stamp in STAMPS))
    distorted = cv2.projectPoints(np.array([[[-0.6, 0.45, 1.0]]]), np.zeros(3), np.zeros(3), K,
                                  np.array(DISTORTION))[0].ravel()
    for stamp in STAMPS:
        cv2.imwrite(str(camera / 'data' / f'{stamp}.png'), spot(distorted))
    first = STAMPS[0] + 20_000_000
    (folder / 'mav0' / 'state_groundtruth_estimate0' / 'data.csv').write_text(
        '#timestamp, p_RS_R_x [m], ...\n' + ''.join(
            f'{first + i * 5_000_000},{i * 0.005},7,8,1,0,0,0' + ',0' * 9 + '\n'
            for i in range(40)))
    return folder


@pytest.fixture
def tum(tmp_path):
    """Return a TUM RGB-D folder of a turning camera, with ground truth at 100 Hz."""
    folder = tmp_path / 'rgbd_dataset_freiburg3_desk'
    (folder / 'rgb').mkdir(parents=True)
    stamps = [f'{1341846313 + i // 30}.{i % 30 * 33333 + 500:06d}' for i in range(40)]
    for stamp in stamps:
        cv2.imwrite(str(folder / 'rgb' / f'{stamp}.png'), np.zeros((480, 640, 3), np.uint8))
    (folder / 'rgb.txt').write_text('# color images\n# timestamp filename\n' + ''.join(
        f'{stamp} rgb/{stamp}.png\n' for stamp in stamps))
    lines = []
    for i in range(140):
        x, y, z, w = Rotation.from_rotvec([0, 0.003 * i, 0]).as_quat()
        lines.append(f'{1341846313 + i // 100}.{i % 100:02d}00 {0.01 * i} 1 2 {x} {y} {z} {w}\n')
    (folder / 'groundtruth.txt').write_text('# ground truth\n' + ''.join(lines))
    return folder


def test_euroc_images_are_rectified(asl):
    sequence = euroc(asl)
    assert (len(sequence), sequence.size, sequence.name) == (5, SIZE, 'MH_01')
    assert sequence.stamps_ns.tolist() == STAMPS
    assert sequence.K.tolist() == K.tolist()
    image = sequence.image(2).astype(float)
    y, x = np.indices(image.shape)
    found = np.array([(x * image).sum(), (y * image).sum()]) / image.sum()
    assert np.abs(found - [110 * -0.6 + 80, 109 * 0.45 + 60]).max() < 0.2


PINCUSHION = [0.3, 0.1, 0.001, 0.002]


def pincushion(folder, gray):
    """Make the images of an EuRoC folder those of a lens that leaves the undistorted corners."""
    camera = folder / 'mav0' / 'cam0'
    (camera / 'sensor.yaml').write_text(SENSOR.replace(str(DISTORTION), str(PINCUSHION)))
    for stamp in STAMPS:
        cv2.imwrite(str(camera / 'data' / f'{stamp}.png'), gray)


def test_no_black_rim_moves_with_the_camera(asl):
    """Pixels beyond the raw image are no edge in the rectified image."""
    texture = np.random.default_rng(0).integers(100, 256, SIZE[::-1], np.uint8)
    pincushion(asl, texture)
    rectified = euroc(asl).image(2)
    assert rectified.min() >= 100
    assert not np.array_equal(rectified, texture)


def test_a_distorted_sequence_is_replayed_as_its_raw_images_with_their_distortion(asl):
    texture = np.random.default_rng(0).integers(100, 256, SIZE[::-1], np.uint8)
    pincushion(asl, texture)
    recording = open_recording(asl)
    info, image = [message for _, _, message in recording.messages(
        {recording.info_topic, recording.image_topic})][:2]
    assert info.d.tolist() == [*PINCUSHION, 0]
    assert np.array_equal(gray_image(image), texture)
    camera = Camera.from_info(info, is_rectified('auto', recording.image_topic))
    assert camera.K.tolist() == K.tolist()
    assert np.array_equal(camera.corrected(texture), euroc(asl).image(2))


def test_files_of_16_bits_are_replayed_at_full_depth(asl):
    values = np.random.default_rng(0).integers(0, 4096, SIZE[::-1], np.uint16)
    pincushion(asl, values)
    recording = open_recording(asl)
    message = next(message for topic, _, message in recording.messages()
                   if topic == recording.image_topic)
    assert message.encoding == 'mono16'
    assert np.array_equal(gray_image(message, (0, 4095)), values // 16)
    assert np.array_equal(euroc(asl).raw(0), values)
    assert euroc(asl).image(0).max() <= 15


def test_euroc_ground_truth_is_the_cameras_and_starts_where_it_is_known(asl):
    poses = euroc(asl).poses
    assert np.isnan(poses[0]).all()
    assert np.allclose(poses[1], np.eye(4))
    # Ahead for the body is z for this camera.
    assert np.allclose(poses[3][:3, 3], [0, 0, 0.1], atol=1e-9)


def test_tum_ground_truth_is_interpolated_to_the_images(tum):
    sequence = tum_rgbd(tum)
    assert len(sequence) == 40
    assert sequence.K[0].tolist() == [535.4, 0, 320.1]
    assert sequence.stamps_ns[0] == 1341846313_000500000
    poses = sequence.poses
    assert np.allclose(poses[15][:3, 3], Rotation.from_rotvec([0, -0.00015, 0]).apply(
        [15 * 0.033333, 0, 0]), atol=1e-6)
    turn = Rotation.from_matrix(poses[15][:3, :3]).as_rotvec()
    assert np.allclose(turn, [0, 15 * 0.0099999, 0], atol=1e-6)


def poses_of(folder, file):
    """Stamps and poses of the ground truth that a file gives a folder."""
    recording = open_recording(folder, poses=file)
    assert recording.ground_truth_topic is not None
    return GroundTruth.of(recording).known()


def test_a_file_of_poses_of_either_form_serves_a_folder_of_either_layout(
        tum, small_kitti, tmp_path):
    kitti = small_kitti(frames=40)
    rows = (kitti / '../../poses/07.txt').read_text()
    stamps, found = poses_of(tum, tum / 'groundtruth.txt')
    assert len(stamps) == 140
    assert np.allclose(found[:, 0, 3], 0.01 * np.arange(140))
    # Rows belong to the images, one to each.
    (tmp_path / 'rows.txt').write_text(rows)
    stamps, found = poses_of(tum, tmp_path / 'rows.txt')
    assert stamps.tolist() == tum_rgbd(tum).stamps_ns.tolist()
    assert np.allclose(found[:, 2, 3], 0.5 * np.arange(40))
    # Files next to a sequence may belong to others.
    (kitti / '../../poses/07.txt').write_text(rows * 2)
    stamps, found = poses_of(kitti, tum / 'groundtruth.txt')
    assert len(stamps) == 140
    stamps, found = poses_of(kitti, tmp_path / 'rows.txt')
    assert np.allclose(found[:, 2, 3], 0.5 * np.arange(40))
    for folder in (tum, kitti):
        with pytest.raises(DjetError, match='07.txt has 80 poses, the recording has 40 images'):
            open_recording(folder, poses=kitti / '../../poses/07.txt')


def test_a_gap_in_the_ground_truth_is_not_bridged():
    known = np.tile(np.eye(4), (4, 1, 1))
    stamps = np.array([0, 50, 300, 350]) * 1_000_000
    poses = poses_at(stamps, known, np.array([-1, 25, 200, 325, 351]) * 1_000_000, LONGEST_GAP_NS)
    assert np.isnan(poses[:, 0, 0]).tolist() == [True, False, True, False, True]
    alone = poses_at(stamps[:1], known[:1], stamps, LONGEST_GAP_NS)
    assert np.isnan(alone[:, 0, 0]).tolist() == [False, True, True, True]
    nowhere = poses_at(stamps, known, np.array([10**12]), LONGEST_GAP_NS)
    assert np.isnan(nowhere).all()
    assert from_first(nowhere) is None


def test_a_calibration_file_precedes_the_name_of_the_folder(tum):
    (tum / 'calibration.txt').write_text('# fx fy cx cy\n100 101 80 60\n')
    assert tum_rgbd(tum).K.tolist() == [[100, 0, 80], [0, 101, 60], [0, 0, 1]]


def test_an_unknown_camera_requires_a_calibration_file(tum):
    unknown = tum.rename(tum.with_name('kitchen'))
    with pytest.raises(DjetError, match=r"no known camera; write 'fx fy cx cy'.*calibration.txt"):
        tum_rgbd(unknown)


def test_a_path_is_opened_by_its_contents(asl, tum, small_kitti, tmp_path):
    folder = small_kitti()
    write_kitti_bag(KittiSequence(folder), tmp_path / 'bag')
    assert open_sequence(asl).name == 'MH_01'
    assert open_sequence(asl / 'mav0').name == 'mav0'
    assert open_sequence(tum).name == 'rgbd_dataset_freiburg3_desk'
    assert open_sequence(folder).name == 'KITTI 07'
    for path in (tmp_path / 'bag', tmp_path / 'bag' / 'bag.mcap'):
        with open_recording(path) as recording:
            assert isinstance(recording, BagRecording)
    with pytest.raises(DjetError, match='is neither a bag nor a folder of KITTI'):
        open_sequence(asl / 'mav0' / 'cam0')
    with pytest.raises(DjetError, match='it holds sequences/07: name one of these'):
        open_sequence(folder.parent.parent)
    with pytest.raises(DjetError, match='nowhere does not exist'):
        open_sequence(tmp_path / 'nowhere')


@pytest.mark.parametrize(('file', 'old', 'new', 'error_text'), [
    ('cam0/data.csv', f',{STAMPS[0]}.png', ',../../secret.png', 'lies outside the folder'),
    ('cam0/data.csv', f',{STAMPS[0]}.png', ',a\0b.png', 'is not a file name'),
    ('cam0/data.csv', f',{STAMPS[0]}.png', '', 'line 2 has 1 words'),
    ('cam0/data.csv', str(STAMPS[0]), '1.5', 'is not a stamp in nanoseconds'),
    ('cam0/data.csv', str(STAMPS[0]), str(STAMPS[3]), 'is not after the one before'),
    ('cam0/sensor.yaml', 'radial-tangential', 'fov', "distortion model 'fov'"),
    ('cam0/sensor.yaml', '[110.0,', '[-110.0,', 'is no valid camera'),
    ('cam0/sensor.yaml', 'intrinsics', 'outsides', 'is no ASL camera description'),
    ('cam0/sensor.yaml', 'data: [', 'data: [1, ', 'is no ASL sensor description'),
    ('cam0/sensor.yaml', 'T_BS:', 'T_BS: [', 'is not valid YAML'),
    ('cam0/sensor.yaml', '[160, 120]', '!!bool [', 'is not valid YAML'),
    ('cam0/sensor.yaml', '[160, 120]', '!!bool so', 'is not valid YAML'),
    ('cam0/sensor.yaml', 'data: [0.0', 'data: [1e308', 'is no rigid transformation'),
    ('cam0/sensor.yaml', ' 0.3, 0.0,', ' 0.3, 5.0,', 'is no rigid transformation'),
    ('state_groundtruth_estimate0/data.csv', ',1,0,0,0,', ',2,0,0,0,', 'has length 2; it must'),
    ('state_groundtruth_estimate0/data.csv', ',7,8,', ',1e300,8,', 'farther than 1e[+]09 m'),
])
def test_a_wrong_euroc_folder_is_named(asl, file, old, new, error_text):
    path = asl / 'mav0' / file
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(DjetError, match=error_text) as caught:
        euroc(asl)
    assert '\n' not in str(caught.value)
