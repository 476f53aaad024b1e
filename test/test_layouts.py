"""Layouts as they are downloaded: OpenCV's YAML, JPEG, TUM-VI, 7-Scenes, KITTI raw, and IMUs."""

from pathlib import Path
import re
import shutil

from commands import checked
import cv2
from djet_ros.errors import DjetError
from djet_ros.lab.scenes.sequence import render_sequence
from djet_ros.odometry.camera import Camera
from djet_ros.odometry.messages import seconds_text, stamp_ns
from djet_ros.recordings.bag_writers import write_kitti_bag
from djet_ros.recordings.bags import Bag
from djet_ros.recordings.datasets import euroc, open_sequence, seven_scenes, tum_rgbd
from djet_ros.recordings.kitti_raw import clock_nanoseconds
from djet_ros.recordings.recording import open_recording, RAW_IMAGE_TOPIC, SequenceRecording
from djet_ros.replay.ground_truth import GroundTruth
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

STAMPS = [1403636579763555584 + i * 50_000_000 for i in range(4)]
SIZE = (160, 120)
NOISE = cv2.GaussianBlur(
    np.random.default_rng(4).integers(0, 256, SIZE[::-1], dtype=np.uint8), (0, 0), 2)
# The camera sees along the body's x axis; the IMU's axes are the body's, turned about z.
CAMERA_IN_BODY = np.array([[0, 0, 1, 0.1], [-1, 0, 0, 0.2], [0, -1, 0, 0.3], [0, 0, 0, 1.0]])
IMU_IN_BODY = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])

OPENCV = f"""\
%YAML:1.0
---
sensor_type: camera
T_BS: !!opencv-matrix
   rows: 4
   cols: 4
   dt: d
   data: {CAMERA_IN_BODY.ravel().tolist()}
intrinsics: [110.0, 109.0, 80.0, 60.0]
distortion_model: radial-tangential
distortion_coefficients: [-0.28, 0.07, 0.0002, 0.00002]
"""

KALIBR = f"""\
cam0:
  T_cam_imu: {np.linalg.inv(CAMERA_IN_BODY).tolist()}
  camera_model: pinhole
  distortion_coeffs: [0.0034, 0.0007, -0.0020, 0.0002]
  distortion_model: equidistant
  intrinsics: [60.0, 60.5, 79.0, 59.0]
  resolution: [160, 120]
"""


@pytest.fixture
def asl(tmp_path: Path) -> Path:
    """Return an EuRoC folder with an IMU at 100 Hz that turns by 0.1, 0.2 and 0.3 rad/s."""
    folder = tmp_path / 'MH_02'
    camera, imu = folder / 'mav0' / 'cam0', folder / 'mav0' / 'imu0'
    (camera / 'data').mkdir(parents=True)
    imu.mkdir()
    (camera / 'sensor.yaml').write_text(OPENCV)
    (camera / 'data.csv').write_text('#timestamp [ns],filename\n' + ''.join(
        f'{stamp},{stamp}.png\n' for stamp in STAMPS))
    for stamp in STAMPS:
        cv2.imwrite(str(camera / 'data' / f'{stamp}.png'), NOISE)
    (imu / 'sensor.yaml').write_text(
        f'%YAML:1.0\nsensor_type: imu\nT_BS: {{data: {IMU_IN_BODY.ravel().tolist()}}}\n')
    (imu / 'data.csv').write_text('#timestamp [ns],w_RS_S_x [rad s^-1],...\n' + ''.join(
        f'{STAMPS[0] + (i - 3) * 10_000_000 + 1},0.1,0.2,0.3,9.8,0,0\n' for i in range(25)))
    return folder


# EuRoC and TUM-VI

def test_the_yaml_of_opencv_is_read(asl: Path) -> None:
    sequence = euroc(asl)
    assert sequence.K.tolist() == [[110.0, 0, 80], [0, 109, 60], [0, 0, 1]]
    assert sequence.distortion.tolist() == [-0.28, 0.07, 0.0002, 0.00002, 0]


@pytest.mark.parametrize(('header', 'error_text'), [
    ('', 'has no T_BS'), ('%YAML:1.0', 'has no T_BS'), ('%YAML:1.0\n', 'has no T_BS'),
    ('%YAML:1.0\n---\n', 'has no T_BS'), ('%YAML:1.0\n---\nsens', 'has no T_BS'),
    ('%YAML', 'not valid'), ('%YAML:1.0\n---\nT_BS: !!opencv-matrix', 'not valid'),
    ('%YAML 9.9\n---\n', 'not valid'), ('%YAML:1.0\n---\nT_BS: !!opencv-matrix [1, 2]\n',
                                        'not valid')])
def test_a_cut_or_odd_header_is_one_line(asl: Path, header: str, error_text: str) -> None:
    path = asl / 'mav0' / 'cam0' / 'sensor.yaml'
    path.write_text(header)
    with pytest.raises(DjetError, match=f'sensor.yaml .*{error_text}') as caught:
        euroc(asl)
    assert '\n' not in str(caught.value)


def test_imu_samples_are_rotated_to_the_camera(asl: Path) -> None:
    imu = euroc(asl).imu
    assert imu is not None
    assert len(imu.stamps_ns) == 25
    assert imu.stamps_ns[0] == STAMPS[0] - 29_999_999
    # To the body by a quarter turn about z, and to the camera: x right is -y, y down is -z.
    assert np.allclose(imu.to_camera @ imu.rates[0], [-0.1, -0.3, -0.2])


def test_samples_come_before_the_image_up_to_the_first_one_after_it(asl: Path) -> None:
    with open_recording(asl, auxiliary={'imu': None}) as recording:
        error_text = list(recording.messages())
    images = [i for i, one in enumerate(error_text) if one.topic == recording.image_topic]
    for number, place in enumerate(images):
        felt = [stamp_ns(one.message.header) for one in error_text[:place]
                if one.topic == recording.auxiliary['imu']]
        assert felt[-2] < STAMPS[number] <= felt[-1]
    assert error_text[0].topic == recording.auxiliary['frames']


def test_imu_samples_are_only_read_on_request(asl: Path) -> None:
    with open_recording(asl) as recording:
        assert recording.auxiliary == {}
        assert {one.message.__msgtype__ for one in recording.messages()} == {
            'sensor_msgs/msg/Image', 'sensor_msgs/msg/CameraInfo'}


def test_a_folder_without_an_imu_is_one_line(asl: Path) -> None:
    shutil.rmtree(asl / 'mav0' / 'imu0')
    with pytest.raises(DjetError, match='holds no IMU data'):
        open_recording(asl, auxiliary={'imu': None})


def test_a_bag_of_a_folder_holds_its_imu_and_how_it_is_mounted(asl: Path) -> None:
    write_kitti_bag(euroc(asl), asl / 'bag')
    with open_recording(asl / 'bag', auxiliary={'imu': None}) as recording:
        assert recording.auxiliary == {'imu': '/imu/data_raw', 'frames': '/tf_static'}
    with open_recording(asl, auxiliary={'imu': None}) as folder, Bag(asl / 'bag') as bag:
        rates = [[one.message.angular_velocity.x, stamp_ns(one.message.header)]
                 for one in folder.messages() if one.topic == '/imu/data_raw']
        assert rates == [[one.message.angular_velocity.x, stamp_ns(one.message.header)]
                         for one in bag.messages({'/imu/data_raw'})]
        assert len(list(bag.messages({'/tf_static'}))) == 2


@pytest.mark.parametrize(('file', 'old', 'new', 'error_text'), [
    ('imu0/data.csv', ',0.1,', ',nan,', 'not a finite number'),
    ('imu0/data.csv', ',0.1,0.2', ',0.1', 'has 6 numbers'),
    ('imu0/sensor.yaml', 'T_BS', 'S_BT', 'no ASL sensor description'),
    ('imu0/sensor.yaml', '[0.0, -1.0', '[5.0, -1.0', 'no rigid transformation'),
])
def test_a_wrong_imu_is_named(asl: Path, file: str, old: str, new: str, error_text: str) -> None:
    path = asl / 'mav0' / file
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(DjetError, match=error_text):
        euroc(asl)


def test_tum_vi_has_its_camera_from_kalibr_and_its_truth_from_mocap(asl: Path) -> None:
    (asl / 'dso').mkdir()
    (asl / 'dso' / 'camchain.yaml').write_text(KALIBR)
    (asl / 'mav0' / 'cam0' / 'sensor.yaml').unlink()
    (asl / 'mav0' / 'mocap0').mkdir()
    (asl / 'mav0' / 'mocap0' / 'data.csv').write_text('#timestamp [ns], p_RS_R_x [m], ...\n' + (
        ''.join(f'{STAMPS[0] + i * 8_000_000},{i * 0.008},7,8,1,0,0,0\n' for i in range(30))))
    sequence = euroc(asl)
    assert (sequence.model, len(sequence.distortion)) == ('equidistant', 4)
    assert sequence.poses is not None
    assert np.allclose(sequence.poses[3][:3, 3], [0, 0, 0.15], atol=1e-9)
    # The image is that of a pinhole: a ray of 30 degrees is seen at f tan 30.
    theta = np.radians(30)
    seen = 60.0 * theta * (1 + 0.0034 * theta**2 + 0.0007 * theta**4 - 0.0020 * theta**6
                           + 0.0002 * theta**8)
    spot = np.zeros(SIZE[::-1], np.uint8)
    cv2.circle(spot, (round(79 + seen), 59), 3, 255, -1)
    cv2.imwrite(str(asl / 'mav0' / 'cam0' / 'data' / f'{STAMPS[0]}.png'), spot)
    columns = sequence.image(0).astype(float).sum(0)
    assert np.average(np.arange(SIZE[0]), weights=columns) == pytest.approx(
        79 + 60 * np.tan(theta), abs=0.7)
    # As it is with coefficients that are zeros.
    (asl / 'dso' / 'camchain.yaml').write_text(re.sub(
        'distortion_coeffs: .*', 'distortion_coeffs: [0, 0, 0, 0]', KALIBR))
    assert SequenceRecording(euroc(asl)).image_topic == RAW_IMAGE_TOPIC
    (asl / 'dso' / 'camchain.yaml').write_text(KALIBR.replace('T_cam_imu', 'T_imu_cam'))
    with pytest.raises(DjetError, match=r'no Kalibr camera chain \(cam0'):
        euroc(asl)


@pytest.mark.parametrize(('resolution', 'reason'), [
    ('[320, 240]', 'is of 320x240 pixels, the images have 160x120; calibrate at this size'),
    (f'[{10**400}, 120]', 'is of 1000.{1,40}x120 pixels'),
    ('160', "resolution.*: 'int' object"), ('[w, h]', 'resolution.*: invalid literal'),
])
@pytest.mark.parametrize('tool', ['asl', 'kalibr'])
def test_a_calibration_for_images_of_another_size_is_refused(
        asl: Path, tool: str, resolution: str, reason: str) -> None:
    # As of images that were made smaller after the download.
    file, text = asl / 'mav0' / 'cam0' / 'sensor.yaml', f'{OPENCV}resolution: [160, 120]\n'
    if tool == 'kalibr':
        file.unlink()
        file, text = asl / 'mav0' / 'camchain.yaml', KALIBR
    file.write_text(text)
    assert euroc(asl).size == SIZE
    file.write_text(text.replace('[160, 120]', resolution))
    with pytest.raises(DjetError, match=f'{file} .*{reason}'):
        euroc(asl)


@pytest.mark.parametrize('sensor', ['cam0', 'imu0'])
def test_a_number_too_large_for_any_mounting_is_an_error_of_one_line(
        asl: Path, sensor: str) -> None:
    path = asl / 'mav0' / sensor / 'sensor.yaml'
    path.write_text(path.read_text().replace('data: [0.0', f'data: [{10**400}', 1))
    with pytest.raises(DjetError, match=f'{sensor}/sensor.yaml is no ASL'):
        euroc(asl)


# TUM-like folders and 7-Scenes

def test_jpeg_images_are_read_where_png_are(tmp_path: Path) -> None:
    folder = tmp_path / 'phone'
    (folder / 'rgb').mkdir(parents=True)
    for i in range(3):
        cv2.imwrite(str(folder / 'rgb' / f'{i}.jpg'), NOISE, [cv2.IMWRITE_JPEG_QUALITY, 100])
    (folder / 'rgb.txt').write_text(''.join(f'{1 + i}.5 rgb/{i}.jpg\n' for i in range(3)))
    (folder / 'calibration.txt').write_text('100 101 80 60')
    sequence = tum_rgbd(folder)
    assert sequence.size == SIZE
    assert np.abs(sequence.image(1).astype(int) - NOISE).max() <= 2
    whole = (folder / 'rgb' / '1.jpg').read_bytes()
    (folder / 'rgb' / '1.jpg').write_bytes(whole[:len(whole) // 2])
    with pytest.raises(DjetError, match=r'1.jpg is a damaged image \(JPEG image of \d+ bytes is'):
        tum_rgbd(folder).image(1)
    # What a crashed recorder leaves does not spoil the other images.
    for left in (30, 1, 0):
        (folder / 'rgb' / '1.jpg').write_bytes(whole[:left])
        sequence = tum_rgbd(folder)
        assert np.abs(sequence.image(2).astype(int) - NOISE).max() <= 2
        with pytest.raises(DjetError, match='1.jpg is a damaged image'):
            sequence.image(1)
    for name in ('0.jpg', '2.jpg'):
        (folder / 'rgb' / name).write_bytes(b'')
    with pytest.raises(DjetError, match='no image has a header with its size: .*0.jpg is empty'):
        tum_rgbd(folder)


def seven_scenes_folder(folder: Path, suffix: str, size: tuple[int, int] = (640, 480)) -> Path:
    folder.mkdir()
    for i in range(3):
        cv2.imwrite(str(folder / f'frame-{i:06d}.color.{suffix}'), cv2.resize(NOISE, size))
        pose = np.eye(4)
        pose[:3, 3] = 2 + 0.1 * i, 1, 0
        np.savetxt(folder / f'frame-{i:06d}.pose.txt', pose)
    return folder


@pytest.mark.parametrize('suffix', ['png', 'jpg'])
def test_7_scenes_is_read_as_published(tmp_path: Path, suffix: str) -> None:
    sequence = open_sequence(seven_scenes_folder(tmp_path / 'seq-01', suffix))
    assert sequence.K.tolist() == [[585, 0, 320], [0, 585, 240], [0, 0, 1]]
    assert sequence.poses is not None
    assert np.allclose(sequence.poses[:, :3, 3], [[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]])
    assert np.diff(sequence.stamps_ns).tolist() == [33_333_333] * 2


def test_a_published_camera_is_not_that_of_images_of_another_size(tmp_path: Path) -> None:
    folder = seven_scenes_folder(tmp_path / 'seq-01', 'png', (320, 240))
    with pytest.raises(DjetError, match='published camera is of 640x480 pixels, the images have '
                       "320x240; write 'fx fy cx cy' of these into .*calibration.txt"):
        open_sequence(folder)
    (folder / 'calibration.txt').write_text('292.5 292.5 160 120')
    assert open_sequence(folder).K[0, 0] == 292.5


def test_a_pose_of_7_scenes_that_is_none_is_named(tmp_path: Path) -> None:
    folder = seven_scenes_folder(tmp_path / 'seq-01', 'png')
    (folder / 'frame-000001.pose.txt').write_text('1 0 0 0\n')
    with pytest.raises(DjetError, match='has 1 rows; a pose must have 4'):
        seven_scenes(folder)


# Images of one's own

ROS_CALIBRATION = """\
image_width: 160
image_height: 120
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [100.5, 0, 80, 0, 101, 60, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.1, -0.2, 0.001, 0.002, 0]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [98, 0, 80, 0, 0, 98, 60, 0, 0, 0, 1, 0]
"""


@pytest.fixture
def images(tmp_path: Path) -> Path:
    """Return a folder of twelve images, each brighter than the one before."""
    folder = tmp_path / 'my_images'
    folder.mkdir()
    for i in range(12):
        cv2.imwrite(str(folder / f'frame{i}.{"png" if i % 2 else "JPG"}'),
                    np.full(SIZE[::-1], 10 * i, np.uint8))
    (folder / 'calibration.yaml').write_text(ROS_CALIBRATION)
    return folder


def test_own_images_are_in_the_order_of_their_numbers_with_the_camera_of_ros(images: Path) -> None:
    sequence = open_sequence(images)
    assert [round(sequence.image(i).mean() / 10) for i in range(12)] == list(range(12))
    assert sequence.K.tolist() == [[100.5, 0, 80], [0, 101, 60], [0, 0, 1]]
    assert sequence.distortion.tolist() == [0.1, -0.2, 0.001, 0.002, 0]
    assert (sequence.name, sequence.poses) == ('my_images', None)
    assert np.diff(sequence.stamps_ns).tolist() == [33_333_333] * 11
    (images / 'times.txt').write_text(''.join(f'{0.1 * i:.3f}\n' for i in range(12)))
    assert open_sequence(images).stamps_ns.tolist() == [
        (10_000 + i) * 100_000_000 for i in range(12)]


def test_the_stamps_of_own_images_by_a_clock_are_kept(images: Path) -> None:
    stamps = [1_403_636_579_763_555_584 + i * 50_000_001 for i in range(12)]
    (images / 'times.txt').write_text(''.join(f'{seconds_text(stamp)}\n' for stamp in stamps))
    assert open_sequence(images).stamps_ns.tolist() == stamps
    # So ground truth with stamps is of the same clock.
    truth = images / 'truth.txt'
    truth.write_text(''.join(f'{seconds_text(stamp)} 0 0 0 0 0 0 1\n' for stamp in stamps))
    with open_recording(images, poses=truth) as recording:
        known, _ = GroundTruth.of(recording).known()
    assert known.tolist() == stamps


def test_a_byte_order_mark_of_an_editor_is_no_part_of_the_text(images: Path) -> None:
    (images / 'calibration.yaml').unlink()
    (images / 'calibration.txt').write_text('100 101 80 60\r\n', 'utf-8-sig')
    (images / 'times.txt').write_text(''.join(f'{i}\r\n' for i in range(12)), 'utf-8-sig')
    assert open_sequence(images).K.tolist() == [[100, 0, 80], [0, 101, 60], [0, 0, 1]]


def test_a_calibration_by_opencv_and_one_of_many_coefficients_are_read(images: Path) -> None:
    file = cv2.FileStorage(str(images / 'calibration.yaml'), cv2.FILE_STORAGE_WRITE)
    for name, value in zip(('image_width', 'image_height'), SIZE):
        file.write(name, value)
    file.write('camera_matrix', np.array([[100, 0, 80], [0, 101, 60], [0, 0, 1.0]]))
    file.write('distortion_coefficients', np.array([[0.1], [0.2], [0], [0], [0.3]]))
    file.release()
    assert open_sequence(images).distortion.tolist() == [0.1, 0.2, 0, 0, 0.3]
    rational = ROS_CALIBRATION.replace('plumb_bob', 'rational_polynomial').replace(
        '0.002, 0]', '0.002, 0, 0.3, 0.1, 0]').replace('cols: 5', 'cols: 8')
    (images / 'calibration.yaml').write_text(rational)
    sequence = open_sequence(images)
    assert sequence.model == 'rational_polynomial'
    assert sequence.distortion.tolist() == [0.1, -0.2, 0.001, 0.002, 0, 0.3, 0.1, 0]
    assert sequence.image(3).shape == SIZE[::-1]


def test_a_fisheye_of_opencv_is_seen_as_such(images: Path) -> None:
    D = np.array([[0.05], [-0.02], [0.01], [-0.003]])
    file = cv2.FileStorage(str(images / 'calibration.yaml'), cv2.FILE_STORAGE_WRITE)
    for name, value in zip(('image_width', 'image_height', 'fisheye_model'), (*SIZE, 1)):
        file.write(name, value)
    file.write('camera_matrix', np.array([[70, 0, 80], [0, 71, 60], [0, 0, 1.0]]))
    file.write('distortion_coefficients', D)
    file.release()
    sequence = open_sequence(images)
    assert sequence.model == 'equidistant'
    ray = np.array([[0.5, -0.3]])
    seen, _ = cv2.fisheye.projectPoints(np.append(ray, [[1.0]], 1)[None], np.zeros(3), np.zeros(3),
                                        sequence.K, D)
    camera = Camera(sequence.K, sequence.distortion, SIZE, sequence.model)
    assert np.allclose(camera.pixels(ray, camera.k1)[0], seen[0])


def test_own_images_give_the_same_trajectory_as_in_another_layout(tmp_path: Path) -> None:
    original = render_sequence('road', tmp_path / 'rendered', 4, size=(310, 94))
    K = open_sequence(original).K
    folder = tmp_path / 'mine'
    shutil.copytree(original / 'image_0', folder)
    shutil.copy(original / 'times.txt', folder)
    (folder / 'calibration.txt').write_text(f'{K[0, 0]} {K[1, 1]} {K[0, 2]} {K[1, 2]}')
    for source in (original, folder):
        checked('replay', source, '--output', tmp_path / f'results_{source.name}')
    one, other = ((tmp_path / f'results_{source.name}' / 'trajectory_tum.txt').read_text()
                  for source in (original, folder))
    assert len(one.splitlines()) == 4 and one == other


@pytest.mark.parametrize(('file', 'old', 'new', 'reason'), [
    ('calibration.yaml', 'image_width: 160', 'image_width: 320',
     'calibration.yaml is of 320x120 pixels, the images have 160x120; calibrate at this size'),
    ('calibration.yaml', 'camera_matrix', 'camera_matrices', 'is no calibration of ROS'),
    ('calibration.yaml', '100.5, 0, 80', '100.5, 2, 80', 'camera_matrix is .*; it must be fx 0'),
    ('calibration.yaml', '100.5, 0, 80', '0, 0, 80', 'focal lengths must be positive'),
    ('calibration.yaml', 'plumb_bob', 'equidistant', "'equidistant' with 5 numbers is not known"),
    ('calibration.yaml', 'plumb_bob', 'ftheta', "'ftheta' with 5 numbers is not known"),
    ('calibration.txt', '', '1 2 3 4', 'has calibration.txt and calibration.yaml; remove'),
    ('times.txt', '', '0.0\n0.1\n', 'times.txt has 2 lines for 12 images'),
])
def test_a_wrong_file_beside_own_images_is_named(images: Path, file: str, old: str, new: str,
                                                 reason: str) -> None:
    before = (images / file).read_text() if (images / file).exists() else ''
    (images / file).write_text(before.replace(old, new) if old else new)
    with pytest.raises(DjetError, match=reason):
        open_sequence(images)


def test_images_without_a_calibration_are_told_what_they_need(images: Path) -> None:
    (images / 'calibration.yaml').unlink()
    with pytest.raises(DjetError, match=r'or images with calibration.yaml or calibration.txt'):
        open_sequence(images)


@pytest.mark.parametrize(('text', 'holds'), [
    ('100 101 80\n', ' holds 3 numbers in one line'),
    ('100 101 80 60 0.1 0 0 0 0 0\n', ' holds 10 numbers in one line'),
    ('100 101 80 60 640 480 0 0 0 0 0\n', ' holds 11 numbers in one line'),
    ('100\n101\n80\n60\n', ' holds 4 numbers in 4 lines'),
    ('100 0 80\n0 101 60\n0 0 1\n', ' holds 9 numbers in 3 lines'),
    ('100 101 80 60\n0.1 0 0 0\n', ' holds 8 numbers in 2 lines'),
    ('# fx fy cx cy\n', ' holds 0 numbers in 0 lines'),
    # Of camera_calibration, next to its ost.yaml.
    ('# oST version 5.0 parameters\n\n[image]\n\nwidth\n160\n', ": '.image.' is not a number"),
])
def test_a_calibration_of_another_form_is_told_what_it_holds_and_must_hold(
        images: Path, text: str, holds: str) -> None:
    (images / 'calibration.yaml').unlink()
    (images / 'calibration.txt').write_text(text)
    with pytest.raises(DjetError, match=f'calibration.txt{holds}; it must hold one line '
                                        "'fx fy cx cy' in pixels, perhaps with"):
        open_sequence(images)


def test_images_of_other_formats_are_told_which_are_read(images: Path) -> None:
    for path in images.glob('frame*'):
        path.rename(path.with_suffix('.tiff'))
    with pytest.raises(DjetError, match='has a calibration, but no image: PNG and JPEG are read'):
        open_sequence(images)


# KITTI raw

P_RECT = [50.0, 0, 80, 0, 0, 50, 60, 0, 0, 0, 1, 0]
CALIBRATION = {
    'calib_cam_to_cam.txt': (
        'calib_time: 09-Jan-2012 13:57:47\ncorner_dist: 9.95e-02\nS_00: 200 150\n'
        'K_00: 70 0 100 0 70 75 0 0 1\nD_00: -0.3 0.1 0 0 0\nS_rect_00: 160 120\n'
        f'R_rect_00: 1 0 0 0 1 0 0 0 1\nP_rect_00: {" ".join(map(str, P_RECT))}\n'),
    # x of the scanner and of the unit is ahead, which is the camera's z.
    'calib_velo_to_cam.txt': 'R: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 -0.3\ndelta_f: 0 0\n',
    'calib_imu_to_velo.txt': 'R: 1 0 0 0 1 0 0 0 1\nT: -0.8 0.3 -0.8\n',
}


@pytest.fixture
def raw(tmp_path: Path) -> Path:
    """Return a drive that goes east at 10 m/s, level, and turns left by 0.1 rad/s."""
    drive = tmp_path / '2011_09_26' / '2011_09_26_drive_0001_sync'
    (drive / 'image_00' / 'data').mkdir(parents=True)
    (drive / 'oxts' / 'data').mkdir(parents=True)
    for name, text in CALIBRATION.items():
        (drive.parent / name).write_text(text)
    clock = [f'2011-09-26 13:02:25.{9 - 5 + i}64389445\n' for i in range(4)]
    for i in range(4):
        cv2.imwrite(str(drive / 'image_00' / 'data' / f'{i:010d}.png'), NOISE)
        longitude = 8.4 + np.degrees(i / 6378137.0 / np.cos(np.radians(49.0)))
        row = [49.0, longitude, 115, 0, 0, 0.01 * i, *[0] * 5, 0.1, 0.2, 9.8, 0, 0, 0,
               0.01, 0.02, 0.1, *[0] * 10]
        (drive / 'oxts' / 'data' / f'{i:010d}.txt').write_text(' '.join(map(str, row)))
    for folder in ('image_00', 'oxts'):
        (drive / folder / 'timestamps.txt').write_text(''.join(clock))
    return drive


def test_a_raw_drive_of_kitti_is_read_as_published(raw: Path) -> None:
    sequence = open_sequence(raw)
    assert sequence.K.tolist() == [[50, 0, 80], [0, 50, 60], [0, 0, 1]]
    assert sequence.stamps_ns[0] == 1317042145_464389445
    assert np.diff(sequence.stamps_ns).tolist() == [100_000_000] * 3
    assert sequence.poses is not None
    turn = Rotation.from_matrix(sequence.poses[3, :3, :3]).as_rotvec()
    assert np.allclose(turn, [0, -0.03, 0], atol=1e-9)  # left is about -y of the camera
    assert sequence.poses[3, 2, 3] == pytest.approx(3, abs=0.02)
    assert sequence.imu is not None
    assert np.allclose(sequence.imu.to_camera @ sequence.imu.rates[0], [-0.02, -0.1, 0.01])


def test_packets_of_the_gps_may_be_in_any_order(raw: Path) -> None:
    before = open_sequence(raw)
    data, stamps = raw / 'oxts' / 'data', raw / 'oxts' / 'timestamps.txt'
    order = (0, 2, 1, 3, 3)
    packets = [(data / f'{i:010d}.txt').read_text() for i in order]
    for i, packet in enumerate(packets):
        (data / f'{i:010d}.txt').write_text(packet)
    clock = stamps.read_text().splitlines(keepends=True)
    stamps.write_text(''.join(clock[i] for i in order))
    after = open_sequence(raw)
    assert np.array_equal(after.poses, before.poses)
    assert np.array_equal(after.imu.stamps_ns, before.imu.stamps_ns)


def test_a_raw_drive_needs_no_gps(raw: Path) -> None:
    shutil.rmtree(raw / 'oxts')
    sequence = open_sequence(raw)
    assert (sequence.poses, sequence.imu) == (None, None)


def test_unrectified_images_of_a_raw_drive_have_their_distortion(raw: Path) -> None:
    for path in (raw / 'image_00' / 'data').iterdir():
        cv2.imwrite(str(path), np.zeros((150, 200), np.uint8))
    sequence = open_sequence(raw)
    assert sequence.K[0].tolist() == [70, 0, 100]
    assert sequence.distortion.tolist() == [-0.3, 0.1, 0, 0, 0]


@pytest.mark.parametrize(('file', 'old', 'new', 'error_text'), [
    ('../calib_cam_to_cam.txt', 'S_rect_00: 160', 'S_rect_00: 161', 'these are 160x120'),
    ('../calib_cam_to_cam.txt', 'P_rect_00', 'P_rect_99', "has no line 'P_rect_00:'"),
    ('../calib_cam_to_cam.txt', 'P_rect_00: 50.0', 'P_rect_00: -50.0', 'is no valid camera'),
    ('../calib_velo_to_cam.txt', 'T: 0', 'T:', 'T has 2 numbers; it must have 3'),
    ('../calib_velo_to_cam.txt', 'R: 0 -1 0', 'R: 0 1 0', 'velo_to_cam.txt: pose 0 is no'),
    ('../calib_cam_to_cam.txt', 'R_rect_00: 1', 'R_rect_00: -1', 'cam_to_cam.txt: pose 0 is no'),
    ('image_00/timestamps.txt', '2011-09-26', '2011-13-26', 'line 1.*is not a stamp'),
    ('image_00/timestamps.txt', '2011-09-26', '1911-09-26', 'is not a stamp between'),
    ('oxts/data/0000000001.txt', '49.0', '', 'has 29 numbers'),
    ('oxts/data/0000000001.txt', '49.0', '95.0', 'farther than'),
])
def test_a_wrong_raw_drive_is_named(
        raw: Path, file: str, old: str, new: str, error_text: str) -> None:
    path = raw / file
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(DjetError, match=error_text) as caught:
        open_sequence(raw)
    assert '\n' not in str(caught.value)


def test_a_raw_drive_without_images_is_named(raw: Path) -> None:
    for path in (raw / 'image_00' / 'data').iterdir():
        path.unlink()
    with pytest.raises(DjetError, match=f'^{raw}/image_00/data holds no \\*.png; '):
        open_sequence(raw)


def test_a_raw_drive_without_calibration_names_the_file(raw: Path) -> None:
    (raw.parent / 'calib_cam_to_cam.txt').unlink()
    with pytest.raises(DjetError, match='calib_cam_to_cam.txt is missing; download'):
        open_sequence(raw)


@pytest.mark.parametrize(('text', 'nanoseconds'), [
    ('1971-01-02 00:00:01', (366 * 86400 + 1) * 10**9),
    ('2011-09-26 13:02:25.5', 1317042145_500000000),
    ('2011-09-26 13:02:25.964389445', 1317042145_964389445)])
def test_clocks_are_read_to_the_nanosecond(text: str, nanoseconds: int) -> None:
    assert clock_nanoseconds(text) == nanoseconds
