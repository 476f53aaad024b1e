"""
All readers of foreign data, each as a function of bytes.

A target takes any bytes. It gives them to the public functions that would read them, and lets
nothing through but a good result and an error of ours, worded for a terminal. Whatever else comes
out of it is a bug. ``fuzz.py`` gives them what atheris thinks of, ``test_fuzz.py`` mutated seeds.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from itertools import islice
from pathlib import Path
import shutil
import sqlite3
import tempfile
from typing import Any, cast, NamedTuple

import cv2
from djet_ros.config.flat import flat, from_flat
from djet_ros.config.sections import Config
from djet_ros.config.yaml_files import dump_yaml, load_yaml
from djet_ros.errors import DjetError
from djet_ros.odometry.camera import Camera
from djet_ros.odometry.images import gray_image
from djet_ros.odometry.messages import pose_of
from djet_ros.odometry.tracker import Tracker
from djet_ros.recordings.bag_writers import ResultBag, write_kitti_bag
from djet_ros.recordings.bags import Bag
from djet_ros.recordings.datasets import euroc, plain_images, seven_scenes, tum_rgbd
from djet_ros.recordings.decoding import decoder, message_type
from djet_ros.recordings.frame_sequence import FrameSequence
from djet_ros.recordings.kitti import KittiSequence, read_camera, read_poses
from djet_ros.recordings.kitti_raw import kitti_raw
from djet_ros.recordings.mask_files import static_mask
from djet_ros.recordings.recording import BagRecording
from djet_ros.recordings.storages import BrokenFile, Connection
from djet_ros.recordings.trajectories import KittiWriter, read_tum, TumWriter
from djet_ros.recordings.varos import varos
from djet_ros.replay.graph_of_results import read_results
import numpy as np
from ros_messages import camera_info, compressed, header, image, record, roi, serialised
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionMode
from rosbags.typesys import get_typestore, Stores

# Beyond this an error is no line for a terminal any more.
LONGEST_ERROR = 1200
# Of a bag that claims to hold any number of messages, these are read.
MESSAGES_READ = 200

# Large enough for a few dozen features.
SIZE = (160, 120)
K = np.array([[130.0, 0, 79.5], [0, 130, 59.5], [0, 0, 1]])
NOISE = np.random.default_rng(3).integers(0, 256, SIZE[::-1], dtype=np.uint8)
PICTURE = cv2.normalize(cv2.GaussianBlur(NOISE, (0, 0), 1.5), None, 0, 255, cv2.NORM_MINMAX)
SMALL = PICTURE[:20, :24]
SECOND = 10**9


class Target(NamedTuple):
    """seeds: makes good inputs; run: takes any bytes."""

    seeds: Callable[[], list[bytes]]
    run: Callable[[bytes], None]


# How often inputs were taken, and how often refused.
outcomes = Counter[str]()


@contextmanager
def only_our_errors() -> Iterator[None]:
    """Take a DjetError of one printable line; let all others through."""
    try:
        yield
        outcomes['taken'] += 1
    except DjetError as error:
        outcomes['refused'] += 1
        line = str(error)
        assert line.isprintable(), f'an error is no line for a terminal: {line!r:.300}'
        assert 0 < len(line) < LONGEST_ERROR, f'an error has {len(line)} letters: {line[:300]}'


@contextmanager
def folder() -> Iterator[Path]:
    """Return a new folder, in memory where there is such a place, and remove it."""
    memory = Path('/dev/shm')
    with tempfile.TemporaryDirectory(prefix='djet-fuzz-',
                                     dir=memory if memory.is_dir() else None) as name:
        yield Path(name)


# Messages


def wire(kind: str) -> Connection:
    return Connection(0, '/any', kind, 'cdr', '', 1)


def decoded(kind: str, data: bytes) -> Any:
    """Read a message off the wire, as a bag does; None where the bytes are none."""
    try:
        return decoder(wire(kind))(memoryview(data))
    except BrokenFile:
        return None


def gray_of(kind: str, data: bytes) -> None:
    message = decoded(kind, data)
    if message is None:
        return
    with only_our_errors():
        gray = gray_image(message)
        assert gray.dtype == np.uint8
        assert gray.ndim == 2
        assert gray.flags.c_contiguous


def image_seeds() -> list[bytes]:
    colours = np.dstack([SMALL] * 3)
    return [serialised(image(SMALL, encoding)) for encoding in
            ('mono8', 'bayer_rggb8', 'nv12')] + [
        serialised(image(colours, 'bgr8', padding=3)),
        serialised(image(SMALL.astype(np.uint16) * 256, 'mono16', is_bigendian=1))]


def compressed_seeds() -> list[bytes]:
    return [serialised(compressed(cv2.imencode(f'.{kind}', SMALL)[1].tobytes(), kind))
            for kind in ('png', 'jpg')]


def camera_of(data: bytes) -> None:
    """Take a CameraInfo as the odometry does: undistort with it, and track with it."""
    info = decoded('sensor_msgs/msg/CameraInfo', data)
    if info is None:
        return
    for rectified in (False, True):
        with only_our_errors():
            camera = Camera.from_info(info, rectified)
            assert np.isfinite(camera.K).all()
            assert camera.undistort(PICTURE).shape == PICTURE.shape
    one = tracker()
    outgoing = one.camera_info(info)
    for i in range(3):
        outgoing += one.image(image(np.roll(PICTURE, 2 * i, axis=1), stamp_ns=i * SECOND // 10))
    for _, message in outgoing:
        assert serialised(message)


def tracker(**values: Any) -> Tracker:
    return Tracker(from_flat({'estimator.max_features': 100, 'ros.publish_tf': True,
                              'ros.publish_path': True, **values}), message_type)


def info_seeds() -> list[bytes]:
    distorted = camera_info(K, SIZE, d=np.array([-0.1, 0.02, 0.001, 0, 0]))
    fish = camera_info(K, SIZE, distortion_model='equidistant', d=np.full(4, 0.01))
    binned = camera_info(K * [[2], [2], [1]], (320, 240), binning_x=2, binning_y=2)
    part = camera_info(K, (640, 480), roi=roi(10, 20, *SIZE))
    return [*map(serialised, (camera_info(K, SIZE), distorted, fish, binned, part, *absurd()))]


def absurd() -> Iterator[Any]:
    """Numbers that are finite, but not those of a camera."""
    for value in (1e300, 1e6, 1e-300):
        for at in ((0, 0), (0, 2), (0, 1)):
            matrix = K.copy()
            matrix[at] = value
            yield camera_info(matrix, SIZE)
            yield camera_info(matrix, (0, 0))
        yield camera_info(K, SIZE, d=np.array([value, 0, 0, 0, 0]))
        yield camera_info(K, SIZE, distortion_model='equidistant', d=np.array([value, 0, 0, 0]))


def stream_of(data: bytes) -> None:
    """
    Send a tracker what the bytes say, and take what it publishes to the wire.

    Each five bytes are one message: its kind, and its stamp in steps of 2^28 ns (so that steps
    back, jumps, and the ends of the range of stamps occur).
    """
    one = tracker(**{'odometry.scale': 'speed'})
    out = one.camera_info(camera_info(K, SIZE))
    for at in range(0, min(len(data), 60) - 4, 5):
        kind, stamp = data[at] % 8, int.from_bytes(data[at + 1:at + 5], 'little', signed=True)
        with_stamp = image(np.roll(PICTURE, at, axis=1))
        with_stamp.header.stamp.sec = stamp
        with_stamp.header.stamp.nanosec = stamp * 2654435761 % 2**32
        if kind == 0:
            one.reset()
        elif kind == 1:
            out += one.camera_info(camera_info(
                K, SIZE, header=with_stamp.header, k=np.zeros(9), p=np.zeros(12)))
        elif kind == 2:
            out += one.camera_info(camera_info(K, SIZE))
        elif kind == 3:
            one.speed(speed_at(with_stamp.header))
        else:
            out += one.image(with_stamp)
    out.append(one.diagnostics(0))
    for _, message in out:
        assert serialised(message)
    outcomes['taken'] += 1


def speed_at(stamped: Any) -> Any:
    twist = message_type('geometry_msgs/msg/Twist')
    vector = message_type('geometry_msgs/msg/Vector3')
    return message_type('geometry_msgs/msg/TwistStamped')(
        header=stamped, twist=twist(linear=vector(x=1e300, y=0.0, z=-3.0),
                                    angular=vector(x=0.0, y=0.0, z=0.0)))


def stream_seeds() -> list[bytes]:
    def sent(*messages: tuple[int, int]) -> bytes:
        return b''.join(bytes([kind]) + stamp.to_bytes(4, 'little', signed=True)
                        for kind, stamp in messages)
    return [sent((4, 1), (4, 2), (4, 2), (3, 2), (4, 3)), sent((4, 9), (4, 2), (0, 0), (1, 3)),
            sent((4, 2**31 - 1), (4, -2**31), (1, 2**31 - 1), (2, 0), (4, 0))]


def truth_of(data: bytes) -> None:
    """Take a pose as ground truth, and a speed as scale."""
    for kind in ('geometry_msgs/msg/PoseStamped', 'nav_msgs/msg/Odometry',
                 'geometry_msgs/msg/TransformStamped'):
        message = decoded(kind, data)
        if message is not None:
            _, pose = pose_of(message)
            R = pose[:3, :3]
            assert np.isnan(pose).all() or np.allclose(R.T @ R, np.eye(3))
            outcomes['taken'] += 1
    speed = decoded('geometry_msgs/msg/TwistStamped', data)
    if speed is not None:
        one = tracker(**{'odometry.scale': 'speed'})
        one.speed(speed)
        one.camera_info(camera_info(K, SIZE))
        for i in range(2):
            for _, message in one.image(image(PICTURE, stamp_ns=i)):
                assert serialised(message)


def truth_seeds() -> list[bytes]:
    point, quaternion, vector = (message_type(f'geometry_msgs/msg/{name}')
                                 for name in ('Point', 'Quaternion', 'Vector3'))
    turn, at = quaternion(x=0.0, y=0.0, z=0.6, w=0.8), header(SECOND)
    pose = message_type('geometry_msgs/msg/Pose')(point(x=1.0, y=2.0, z=3.0), turn)
    transform = message_type('geometry_msgs/msg/Transform')(vector(x=1.0, y=2.0, z=3.0), turn)
    return [serialised(message) for message in (
        message_type('geometry_msgs/msg/PoseStamped')(at, pose),
        message_type('geometry_msgs/msg/TransformStamped')(at, 'camera', transform),
        speed_at(at))]


# Recordings


def bag_of(name: str, data: bytes) -> None:
    """Read a file with all that comes out of it, as replay does."""
    with folder() as place:
        path = place / name
        path.write_bytes(data)
        with only_our_errors(), Bag(path) as bag:
            for item in islice(bag.messages(), MESSAGES_READ):
                assert item.topic is not None
        with only_our_errors(), BagRecording(path) as source:
            assert len(source) >= 0
            for _ in islice(source.messages(), MESSAGES_READ):
                pass


def recorded() -> Iterator[tuple[str, Any, int]]:
    for i in range(1, 5):
        yield '/cam/camera_info', camera_info(K, SIZE, i * SECOND), i * SECOND
        yield '/cam/image', image(PICTURE[:16, :16], stamp_ns=i * SECOND), i * SECOND


def bag_bytes(storage: str, mode: CompressionMode = CompressionMode.NONE) -> bytes:
    with folder() as place:
        record(place / 'bag', recorded(), storage, mode)
        data, = (path.read_bytes() for path in (place / 'bag').iterdir()
                 if path.suffix != '.yaml')
        return data


def mcap_seeds() -> list[bytes]:
    with folder() as place:
        with ResultBag(place / 'bag') as bag:
            for topic, message, stamp in recorded():
                bag.write(topic, message, stamp)
        chunked = (place / 'bag' / 'bag.mcap').read_bytes()
    plain = bag_bytes('mcap')
    return [chunked, plain, plain[:len(plain) // 2],
            bag_bytes('mcap', CompressionMode.STORAGE),
            bag_bytes('mcap', CompressionMode.FILE)]


def sqlite_seeds() -> list[bytes]:
    plain = bag_bytes('sqlite3')
    with folder() as place:
        humble = place / 'humble.db3'
        humble.write_bytes(plain)
        database = sqlite3.connect(humble)
        database.executescript('DROP TABLE message_definitions; DROP TABLE schema; VACUUM')
        database.close()
        return [plain, humble.read_bytes(),
                bag_bytes('sqlite3', CompressionMode.MESSAGE)]


def ros1_seeds() -> list[bytes]:
    noetic = get_typestore(Stores.ROS1_NOETIC)
    time, head, text = (noetic.types[name] for name in (
        'builtin_interfaces/msg/Time', 'std_msgs/msg/Header', 'std_msgs/msg/String'))
    picture = noetic.types['sensor_msgs/msg/Image']
    result = []
    for compression in (None, *Ros1Writer.CompressionFormat):
        with folder() as place:
            writer = Ros1Writer(place / 'old.bag')
            if compression:
                writer.set_compression(compression)
            with writer:
                pictures = writer.add_connection('/image', picture.__msgtype__, typestore=noetic)
                texts = writer.add_connection('/text', text.__msgtype__, typestore=noetic)
                for i in range(1, 4):
                    message = picture(head(i, time(i, 0), 'camera'), 16, 16, 'mono8', 0, 16,
                                      PICTURE[:16, :16].ravel())
                    writer.write(pictures, i * SECOND, noetic.serialize_ros1(
                        message, picture.__msgtype__))
                    writer.write(texts, i * SECOND, noetic.serialize_ros1(
                        text('word'), text.__msgtype__))
            result.append((place / 'old.bag').read_bytes())
    return result


def metadata_of(data: bytes) -> None:
    with folder() as place:
        (place / 'bag.mcap').write_bytes(mcap_seed())
        (place / 'metadata.yaml').write_bytes(data)
        with only_our_errors(), Bag(place) as bag:
            assert bag.topics


@cache
def mcap_seed() -> bytes:
    return bag_bytes('mcap')


def metadata_seeds() -> list[bytes]:
    with folder() as place:
        with ResultBag(place / 'bag') as bag:
            for topic, message, stamp in recorded():
                bag.write(topic, message, stamp)
        return [(place / 'bag' / 'metadata.yaml').read_bytes(),
                b'rosbag2_bagfile_information: {relative_file_paths: [../bag.mcap]}']


# Text


def config_of(data: bytes) -> None:
    with folder() as place:
        (place / 'mine.yaml').write_bytes(data)
        with only_our_errors():
            config = load_yaml(place / 'mine.yaml')
            (place / 'again.yaml').write_text(dump_yaml(config))
            again = flat(load_yaml(place / 'again.yaml'))
            assert again == flat(config), 'a configuration that was read does not read back'


def config_seeds() -> list[bytes]:
    return [dump_yaml(Config()).encode()[:3000],
            b'/**: {ros__parameters: {use_sim_time: true, estimator.method: djet}}\n',
            b'estimator: {window: 7, method: rpe}\nodometry: {max_gap: 1e-1, rectified: true}\n',
            b'a: &a [1, 2]\nb: {<<: {c: *a}}\npreset: !!str paper\nd: !!int 0x1f\ne: 1:20\n'
            b'f: 2001-12-14t21:59:43.10-05:00\ng: !!binary aGk=\nh: !!set {? x}\n'
            b'i: !!bool yes\nj: !!omap [a: 1]\n']


class Sequence(NamedTuple):
    """A folder of images in some layout, of which the target writes one text file."""

    build: Callable[[Path], None]
    file: str
    opened: Callable[[Path], object]

    def take(self, data: bytes) -> None:
        with folder() as place:
            self.build(place)
            (place / self.file).parent.mkdir(parents=True, exist_ok=True)
            (place / self.file).write_bytes(data)
            with only_our_errors():
                check_sequence(cast(FrameSequence, self.opened(place)), place)

    def seeds(self) -> list[bytes]:
        with folder() as place:
            self.build(place)
            return [(place / self.file).read_bytes()]


def check_sequence(sequence: FrameSequence, place: Path) -> None:
    """Check that the sequence of any folder keeps the contract of FrameSequence."""
    assert (np.diff(sequence.stamps_ns) > 0).all()
    assert np.isfinite(sequence.K).all()
    if sequence.poses is not None:
        known = sequence.poses[np.isfinite(sequence.poses).all(axis=(1, 2))]
        R = known[:, :3, :3]
        assert np.allclose(R.transpose(0, 2, 1) @ R, np.eye(3), atol=1e-2)
    write_kitti_bag(sequence, place / 'out')
    shutil.rmtree(place / 'out')


PNG = cv2.imencode('.png', SMALL)[1].tobytes()
FRAMES = 3


def kitti_folder(place: Path) -> None:
    sequence = place / 'sequences' / '00'
    (sequence / 'image_0').mkdir(parents=True)
    (place / 'poses').mkdir()
    for i in range(FRAMES):
        (sequence / 'image_0' / f'{i:06d}.png').write_bytes(PNG)
    (sequence / 'calib.txt').write_text('P0: 60 0 11.5 0 0 60 9.5 0 0 0 1 0\n'
                                        'P1: 60 0 31.5 -20 0 60 23.5 0 0 0 1 0\n')
    (sequence / 'times.txt').write_text('0.000000e+00\n1.0360e-01\n2.0731e-01\n')
    (place / 'poses' / '00.txt').write_text('1 0 0 0 0 1 0 0 0 0 1 0\n'
                                            '0.6 0 0.8 1 0 1 0 -2.5e-3 -0.8 0 0.6 3\n'
                                            '1 0 0 0 0 -1 0 0 0 0 -1 9\n')


def tum_folder(place: Path) -> None:
    (place / 'rgb').mkdir()
    for i in range(FRAMES):
        (place / 'rgb' / f'{i}.png').write_bytes(PNG)
    (place / 'calibration.txt').write_text('60 60 31.5 23.5 0.01 -0.02 0.001 0.001 0.003\n')
    (place / 'rgb.txt').write_text('# stamp file\n' + ''.join(
        f'1305031102.{i}75304 rgb/{i}.png\n' for i in range(FRAMES)))
    (place / 'groundtruth.txt').write_text('# stamp x y z qx qy qz qw\n' + ''.join(
        f'1305031102.{i}5 {i} 0.5 -1e-2 0 0.6 0 0.8\n' for i in range(5)))


def plain_folder(place: Path) -> None:
    for i in range(FRAMES):
        (place / f'{i}.png').write_bytes(PNG)
    (place / 'calibration.yaml').write_text(
        'image_width: 24\nimage_height: 20\n'
        'camera_matrix: {rows: 3, cols: 3, data: [60, 0, 31.5, 0, 60, 23.5, 0, 0, 1]}\n'
        'distortion_model: plumb_bob\n'
        'distortion_coefficients: {rows: 1, cols: 5, data: [0.1, -0.02, 0, 0, 0]}\n')
    (place / 'times.txt').write_text(''.join(f'0.{i}\n' for i in range(FRAMES)))


SENSOR = """# General sensor definitions.
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [0.0, -1.0, 0.0, -0.02, 1.0, 0.0, 0.0, -0.06, 0.0, 0.0, 1.0, 0.01, 0.0, 0.0, 0.0, 1.0]
resolution: [24, 20]
intrinsics: [60, 60, 31.5, 23.5] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28, 0.07, 0.0002, 1.8e-05]
"""


def euroc_folder(place: Path) -> None:
    camera, truth = (place / 'mav0' / name for name in ('cam0', 'state_groundtruth_estimate0'))
    (camera / 'data').mkdir(parents=True)
    truth.mkdir()
    stamps = [1403636579763555584 + i * 50_000_000 for i in range(FRAMES)]
    for stamp in stamps:
        (camera / 'data' / f'{stamp}.png').write_bytes(PNG)
    (camera / 'data.csv').write_text('#timestamp [ns],filename\n' + ''.join(
        f'{stamp},{stamp}.png\n' for stamp in stamps))
    (camera / 'sensor.yaml').write_text(SENSOR)
    (truth / 'data.csv').write_text('#timestamp,p,q,v,b_w,b_a\n' + ''.join(
        f'{stamp - 5000},{i},2,3,0.8,0,0.6,0,' + '0.1,' * 8 + '0.1\n'
        for i, stamp in enumerate(stamps)))


IMU_ROWS = '#timestamp [ns],w_x,w_y,w_z,a_x,a_y,a_z\n' + ''.join(
    f'{1403636579763555584 + i * 20_000_000},-0.1,0.2,1.5e-3,9.8,0.1,-0.2\n' for i in range(6))


def euroc_with_imu(place: Path) -> None:
    euroc_folder(place)
    (place / 'mav0' / 'imu0').mkdir()
    (place / 'mav0' / 'imu0' / 'data.csv').write_text(IMU_ROWS)
    (place / 'mav0' / 'imu0' / 'sensor.yaml').write_text(
        'T_BS:\n  data: [0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n')


def euroc_of_opencv(place: Path) -> None:
    """With a camera as OpenCV's FileStorage writes it."""
    euroc_folder(place)
    (place / 'mav0' / 'cam0' / 'sensor.yaml').write_text(
        f'%YAML:1.0\n---\n{SENSOR.replace("T_BS:", "T_BS: !!opencv-matrix")}')


def tum_vi_folder(place: Path) -> None:
    euroc_folder(place)
    (place / 'mav0' / 'cam0' / 'sensor.yaml').unlink()
    (place / 'dso').mkdir()
    (place / 'dso' / 'camchain.yaml').write_text(
        'cam0:\n  T_cam_imu:\n  - [0.0, -1.0, 0.0, -0.02]\n  - [1.0, 0.0, 0.0, -0.06]\n'
        '  - [0.0, 0.0, 1.0, 0.01]\n  - [0.0, 0.0, 0.0, 1.0]\n  camera_model: pinhole\n'
        '  distortion_coeffs: [0.0034, 0.0007, -0.002, 0.0002]\n'
        '  distortion_model: equidistant\n  intrinsics: [60.0, 60.5, 31.0, 23.0]\n'
        '  resolution: [24, 20]\n')


def kitti_with_imu(place: Path) -> None:
    kitti_folder(place)
    sequence = place / 'sequences' / '00'
    with (sequence / 'calib.txt').open('a') as calib:
        calib.write('Tr_imu_to_cam: 0 -1 0 0.1 0 0 -1 0.2 1 0 0 0.3\n')
    (sequence / 'imu.csv').write_text(IMU_ROWS.replace('14036365797', ''))


def seven_scenes_folder(place: Path) -> None:
    # Its camera is known, of pictures of this size.
    picture = cv2.imencode('.png', cv2.resize(NOISE, (640, 480)))[1].tobytes()
    for i in range(FRAMES):
        (place / f'frame-{i:06d}.color.png').write_bytes(picture)
        (place / f'frame-{i:06d}.pose.txt').write_text(
            '0.6 0 0.8 1\n0 1 0 -2.5e-3\n-0.8 0 0.6 3\n0 0 0 1\n')


def kitti_raw_folder(place: Path) -> None:
    for inner in ('image_00', 'oxts'):
        (place / inner / 'data').mkdir(parents=True)
        (place / inner / 'timestamps.txt').write_text(''.join(
            f'2011-09-26 13:02:25.{i}64389445\n' for i in range(FRAMES)))
    for i in range(FRAMES):
        (place / 'image_00' / 'data' / f'{i:010d}.png').write_bytes(PNG)
        (place / 'oxts' / 'data' / f'{i:010d}.txt').write_text(
            f'49.0 8.40000{i} 115.5 0.01 -0.02 0.3 ' + '0.5 ' * 23 + '4\n')
    (place / 'calib_cam_to_cam.txt').write_text(
        'calib_time: 09-Jan-2012 13:57:47\nS_00: 30 26\nK_00: 70 0 15 0 70 13 0 0 1\n'
        'D_00: -0.3 0.1 0 0 0\nS_rect_00: 24 20\nR_rect_00: 1 0 0 0 1 0 0 0 1\n'
        'P_rect_00: 50 0 12 0 0 50 10 0 0 0 1 0\n')
    (place / 'calib_velo_to_cam.txt').write_text('R: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 -0.3\n')
    (place / 'calib_imu_to_velo.txt').write_text('R: 1 0 0 0 1 0 0 0 1\nT: -0.8 0.3 -0.8\n')


def mask_of(data: bytes) -> None:
    """Read a mask, and take an image with it."""
    with folder() as place:
        (place / 'mask.png').write_bytes(data)
        with only_our_errors():
            mask = static_mask(str(place / 'mask.png'))
            assert mask is not None and mask.dtype == bool and mask.ndim == 2
            one = Tracker(Config(), message_type, static_mask=mask)
            one.camera_info(camera_info(K, SIZE))
            one.image(image(PICTURE, stamp_ns=SECOND))
            assert one.counts.received == 1


def mask_seeds() -> list[bytes]:
    half = np.where(np.arange(SIZE[0]) < 80, 0, 255).astype(np.uint8)
    return [cv2.imencode(f'.{kind}', np.tile(half, (SIZE[1], 1)))[1].tobytes()
            for kind in ('png', 'jpg')]


def varos_folder(place: Path) -> None:
    camera = place / 'vehicle0' / 'cam0'
    (camera / 'A').mkdir(parents=True)
    (camera / 'camM0_poses').mkdir()
    png = cv2.imencode('.png', np.zeros((720, 1280), np.uint8))[1].tobytes()
    for i in range(2):
        (camera / 'A' / f'{i}.png').write_bytes(png)
    (camera / 'camM0_timestamps.csv').write_text('1000000,a\n2000000,b\n')
    (camera / 'camM0_poses' / 'camM0_poses_transformation_matrix.csv').write_text(
        '1000000,1,0,0,0,0,1,0,0,0,0,1,0\n2000000,1,0,0,5,0,1,0,0,0,0,1,0\n')


def files_of_a_trajectory(data: bytes) -> None:
    """Read a trajectory; what could be read is written and reads back the same."""
    with folder() as place:
        path = place / 'some.txt'
        path.write_bytes(data)
        with only_our_errors():
            stamps, poses = read_tum(path)
            with TumWriter(place / 'again.txt') as writer:
                for stamp, pose in zip(stamps.tolist(), poses, strict=True):
                    writer.write(stamp, pose)
            again, poses_again = read_tum(place / 'again.txt')
            assert np.array_equal(stamps, again)
            assert np.allclose(poses, poses_again, atol=1e-9)
        with only_our_errors():
            poses = read_poses(path)
            with KittiWriter(place / 'kitti.txt') as writer:
                for pose in poses:
                    writer.write(0, pose)
            assert np.array_equal(read_poses(place / 'kitti.txt'), poses)
        with only_our_errors():
            assert np.isfinite(read_camera(path)).all()


def trajectory_seeds() -> list[bytes]:
    return [b'1.5 1 2 3 0 0 0.6 0.8\n2.25 -1e-3 2 3 0 0 0 1\n',
            b'1 0 0 0 0 1 0 0 0 0 1 0\n0.6 0 0.8 1 0 1 0 0 -0.8 0 0.6 3\n',
            b'# comment\nP0: 60 0 11.5 0 0 60 9.5 0 0 0 1 0\n']


def results_of(data: bytes) -> None:
    """Read a results folder whose table of frames may have been edited."""
    with folder() as place:
        for name, text in (('frames.csv', data), ('trajectory_tum.txt', TUM_OF_RESULTS),
                           ('config.yaml', dump_yaml(Config()).encode())):
            (place / name).write_bytes(text)
        with ResultBag(place / 'bag') as bag:
            bag.write('/vo_node/relative_pose_cov', motion(3 * SECOND), 3 * SECOND)
        with only_our_errors():
            graph = read_results(place)
            assert len(graph.poses) == len(graph.stamps_ns)


def motion(stamp: int) -> Any:
    kind = {name: message_type(f'geometry_msgs/msg/{name}') for name in (
        'Point', 'Quaternion', 'Pose', 'PoseWithCovariance', 'PoseWithCovarianceStamped')}
    pose = kind['Pose'](kind['Point'](x=0.0, y=0.0, z=1.0),
                        kind['Quaternion'](x=0.0, y=0.0, z=0.0, w=1.0))
    return kind['PoseWithCovarianceStamped'](
        header(stamp), kind['PoseWithCovariance'](pose, np.eye(6).ravel() * 1e-4))


TUM_OF_RESULTS = b''.join(b'%d.000000000 0 0 %d 0 0 0 1\n' % (i, i) for i in range(1, 4))
FRAMES_OF_RESULTS = (
    b'image,stamp_ns,status,reason,previous_stamp_ns,matches,inliers,culled,iterations,'
    b'median_residual_px,mean_hamming,scale,scale_kind,ms\n'
    b'0,1000000000,FIRST_FRAME,,,,,,,,,,,1.00\n'
    b'1,2000000000,TIME_JUMP,,,,,,,,,,,1.00\n'
    b'2,3000000000,OK,,2000000000,9,9,0,2,0.1,9.0,1.0,metric,1.00\n')


def varos_in(place: Path) -> FrameSequence:
    return varos(place / 'vehicle0' / 'cam0', place.name)


def sequence_target(build: Callable[[Path], None], file: str,
                    opener: Callable[[Path], object]) -> Target:
    sequence = Sequence(build, file, opener)
    return Target(sequence.seeds, sequence.take)


def kitti(place: Path) -> object:
    return KittiSequence(place / 'sequences' / '00')


TARGETS: dict[str, Target] = {
    'image': Target(image_seeds, partial(gray_of, 'sensor_msgs/msg/Image')),
    'compressed_image': Target(compressed_seeds,
                               partial(gray_of, 'sensor_msgs/msg/CompressedImage')),
    'camera_info': Target(info_seeds, camera_of),
    'message_stream': Target(stream_seeds, stream_of),
    'truth_and_speed': Target(truth_seeds, truth_of),
    'mcap': Target(mcap_seeds, partial(bag_of, 'some.mcap')),
    'sqlite': Target(sqlite_seeds, partial(bag_of, 'some.db3')),
    'ros1': Target(ros1_seeds, partial(bag_of, 'some.bag')),
    'metadata': Target(metadata_seeds, metadata_of),
    'config': Target(config_seeds, config_of),
    'trajectory': Target(trajectory_seeds, files_of_a_trajectory),
    'results': Target(lambda: [FRAMES_OF_RESULTS], results_of),
    'kitti_calib': sequence_target(kitti_folder, 'sequences/00/calib.txt', kitti),
    'kitti_times': sequence_target(kitti_folder, 'sequences/00/times.txt', kitti),
    'kitti_poses': sequence_target(kitti_folder, 'poses/00.txt', kitti),
    'kitti_png': sequence_target(kitti_folder, 'sequences/00/image_0/000001.png', kitti),
    'tum_list': sequence_target(tum_folder, 'rgb.txt', tum_rgbd),
    'tum_camera': sequence_target(tum_folder, 'calibration.txt', tum_rgbd),
    'tum_truth': sequence_target(tum_folder, 'groundtruth.txt', tum_rgbd),
    'plain_camera': sequence_target(plain_folder, 'calibration.yaml', plain_images),
    'plain_times': sequence_target(plain_folder, 'times.txt', plain_images),
    'euroc_list': sequence_target(euroc_folder, 'mav0/cam0/data.csv', euroc),
    'euroc_camera': sequence_target(euroc_folder, 'mav0/cam0/sensor.yaml', euroc),
    'euroc_truth': sequence_target(
        euroc_folder, 'mav0/state_groundtruth_estimate0/data.csv', euroc),
    'euroc_imu': sequence_target(euroc_with_imu, 'mav0/imu0/data.csv', euroc),
    'euroc_imu_mounting': sequence_target(euroc_with_imu, 'mav0/imu0/sensor.yaml', euroc),
    'opencv_yaml': sequence_target(euroc_of_opencv, 'mav0/cam0/sensor.yaml', euroc),
    'tum_vi_camera': sequence_target(tum_vi_folder, 'dso/camchain.yaml', euroc),
    'kitti_imu': sequence_target(kitti_with_imu, 'sequences/00/imu.csv', kitti),
    'seven_scenes_truth': sequence_target(
        seven_scenes_folder, 'frame-000001.pose.txt', seven_scenes),
    'kitti_raw_clock': sequence_target(kitti_raw_folder, 'image_00/timestamps.txt', kitti_raw),
    'kitti_raw_camera': sequence_target(kitti_raw_folder, 'calib_cam_to_cam.txt', kitti_raw),
    'kitti_raw_mounting': sequence_target(kitti_raw_folder, 'calib_imu_to_velo.txt', kitti_raw),
    'kitti_raw_oxts': sequence_target(
        kitti_raw_folder, 'oxts/data/0000000001.txt', kitti_raw),
    'kitti_raw_oxts_clock': sequence_target(kitti_raw_folder, 'oxts/timestamps.txt', kitti_raw),
    'mask_file': Target(mask_seeds, mask_of),
    'varos_stamps': sequence_target(
        varos_folder, 'vehicle0/cam0/camM0_timestamps.csv', varos_in),
    'varos_truth': sequence_target(
        varos_folder, 'vehicle0/cam0/camM0_poses/camM0_poses_transformation_matrix.csv',
        varos_in),
}
