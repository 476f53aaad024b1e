"""Readers of TUM RGB-D, EuRoC, TUM-VI, 7-Scenes and plain images; detection of the layout."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path, PurePosixPath
import re

from djet_ros.core.types import Array
from djet_ros.errors import DjetError
from djet_ros.odometry.interpolation import poses_at
from djet_ros.recordings.calibrations import (
    asl_camera,
    asl_mounting,
    camera_beside,
    kalibr_camera,
    PLAIN,
    YAML,
)
from djet_ros.recordings.frame_sequence import (
    FrameSequence,
    from_first,
    IMAGE_SUFFIXES,
    ImageFiles,
)
from djet_ros.recordings.imu import ImuTrack, read_asl_imu
from djet_ros.recordings.kitti import check_rigid, KittiSequence, STAMP_OFFSET_NS
from djet_ros.recordings.kitti_raw import is_kitti_raw, kitti_raw
from djet_ros.recordings.text import (
    by_numbers,
    image_stamps,
    increasing,
    lines,
    nanoseconds,
    number_rows,
    stamped,
    stamped_rows,
    whole_nanoseconds,
)
from djet_ros.recordings.trajectories import poses_from_quaternions, read_tum
from djet_ros.recordings.varos import varos, varos_camera
import numpy as np
from numpy.typing import NDArray

# Longest gap in the ground truth, in ns, that is interpolated.
LONGEST_GAP_NS = 100_000_000

# Published calibrations of the benchmark's cameras (fx fy cx cy, then k1 k2 p1 p2 k3), by the
# number in the folder's name: https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
TUM_CAMERAS = {
    '1': (517.3, 516.5, 318.6, 255.3, 0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
    '2': (520.9, 521.0, 325.1, 249.7, 0.2312, -0.7849, -0.0033, -0.0001, 0.9172),
    '3': (535.4, 539.2, 320.1, 247.6),
}

# The camera published with 7-Scenes (fx fy cx cy).
SEVEN_SCENES_CAMERA = (585.0, 585.0, 320.0, 240.0)

# Frame period of images without stamps: 30 Hz, as of a Kinect and of most others.
USUAL_PERIOD_NS = 33_333_333


def tum_rgbd(folder: Path) -> FrameSequence:
    """
    Open a TUM RGB-D folder: rgb.txt, the images that it lists, and optionally groundtruth.txt.

    The camera is that of ``camera_beside``, or known by the folder's name (freiburg1 to 3). Ground
    truth is the pose of the camera's optical frame.
    """
    stamps, paths = _listed_images(folder / 'rgb.txt', folder, nanoseconds)
    images = ImageFiles(paths)
    camera = camera_beside(folder, images.size, _tum_camera(folder))
    poses = None
    if (truth := folder / 'groundtruth.txt').exists():
        known, known_poses = read_tum(truth)
        poses = from_first(poses_at(increasing(known, truth), known_poses, stamps, LONGEST_GAP_NS))
    return FrameSequence(folder.resolve().name, images, camera, stamps, poses)


def seven_scenes(folder: Path) -> FrameSequence:
    """
    Open a sequence of 7-Scenes: frame-*.color.png (or .jpg), each with its frame-*.pose.txt.

    The data set has no stamps; the images are taken to be at 30 Hz. The camera is that of
    ``camera_beside``, or the published one.
    """
    paths = _seven_scenes_images(folder)
    images = ImageFiles(paths)
    camera = camera_beside(folder, images.size, SEVEN_SCENES_CAMERA)
    poses = np.full((len(paths), 4, 4), np.nan)
    for index, path in enumerate(paths):
        truth = path.with_name(f'{path.name.partition(".")[0]}.pose.txt')
        if truth.exists():
            rows = number_rows(truth, 4)
            if len(rows) != 4:
                raise DjetError(f'{truth} has {len(rows)} rows; a pose must have 4')
            check_rigid(rows[None], truth)
            poses[index] = rows
    return FrameSequence(folder.resolve().name, images, camera, _usual_stamps(len(paths)),
                         from_first(poses))


def plain_images(folder: Path) -> FrameSequence:
    """
    Open a folder of images (PNG or JPEG) of one camera, and its calibration.

    The images are in the order of the numbers in their names. The camera is that of
    ``camera_beside``. times.txt holds a stamp in seconds per image, to which STAMP_OFFSET_NS is
    added if they begin before it: a clock that ROS can use is kept. Without times.txt the images
    are taken to be at 30 Hz.
    """
    paths = sorted(_images_in(folder), key=by_numbers)
    images = ImageFiles(paths)
    camera, times = camera_beside(folder, images.size), folder / 'times.txt'
    stamps = (image_stamps(times, nanoseconds, len(paths)) if times.exists()
              else _usual_stamps(len(paths)))
    if stamps[0] < STAMP_OFFSET_NS:
        stamps = stamps + STAMP_OFFSET_NS
    return FrameSequence(folder.resolve().name, images, camera, stamps, None)


def euroc(folder: Path) -> FrameSequence:
    """
    Open an EuRoC or TUM-VI (ASL) folder: mav0/cam0, optionally with ground truth and an IMU.

    The camera is that of cam0/sensor.yaml or, in TUM-VI, of dso/camchain.yaml. Ground truth
    (state_groundtruth_estimate0, or mocap0) is transformed from the body frame, which is that of
    the IMU, to the camera.
    """
    mav = folder / 'mav0' if (folder / 'mav0').is_dir() else folder
    camera = mav / 'cam0'
    stamps, paths = _listed_images(camera / 'data.csv', camera / 'data', whole_nanoseconds)
    images = ImageFiles(paths)
    chain = next((path for path in (mav.parent / 'dso' / 'camchain.yaml', mav / 'camchain.yaml')
                  if path.exists()), None)
    if chain is not None and not (camera / 'sensor.yaml').exists():
        lens, camera_in_body = kalibr_camera(chain, images.size)
    else:
        lens, camera_in_body = asl_camera(camera / 'sensor.yaml', images.size)
    poses = None
    if (truth := mav / 'state_groundtruth_estimate0' / 'data.csv').exists():
        poses = from_first(poses_at(*_asl_states(truth, camera_in_body, 17), stamps,
                                    LONGEST_GAP_NS))
    elif (truth := mav / 'mocap0' / 'data.csv').exists():
        poses = from_first(poses_at(*_asl_states(truth, camera_in_body, 8), stamps,
                                    LONGEST_GAP_NS))
    return FrameSequence(folder.resolve().name, images, lens, stamps, poses,
                         _asl_imu(mav / 'imu0', camera_in_body))


def open_sequence(path: Path, own_poses: bool = True) -> FrameSequence:
    """
    Open a folder of KITTI (odometry, raw), TUM RGB-D, 7-Scenes, EuRoC, TUM-VI, VAROS or images.

    own_poses: whether to read ../../poses/NN.txt of a KITTI sequence as its ground truth.
    """
    if (path / 'rgb.txt').exists():
        return tum_rgbd(path)
    if (camera := varos_camera(path)) is not None:
        return varos(camera, path.resolve().name)
    if (path / 'mav0').is_dir() or (path / 'cam0').is_dir():
        return euroc(path)
    if is_kitti_raw(path):
        return kitti_raw(path)
    if _seven_scenes_images(path):
        return seven_scenes(path)
    like_kitti = any(any(path.glob(f'{depth}image_0')) for depth in ('', '*/', 'sequences/*/'))
    calibrated = any((path / name).exists() for name in (PLAIN, YAML))
    if not like_kitti and calibrated and any(_images_in(path)):
        return plain_images(path)
    if not like_kitti and calibrated:
        raise DjetError(f'{path} has a calibration, but no image: PNG and JPEG are read '
                        f'({", ".join(IMAGE_SUFFIXES)}); convert others to PNG')
    if path.is_dir() and not like_kitti:
        raise DjetError(f'{path} is neither a bag nor a folder of KITTI (image_0, or raw: '
                        'image_00/data), TUM RGB-D (rgb.txt), 7-Scenes (frame-*.color.png), EuRoC '
                        f'or TUM-VI (mav0), VAROS (vehicle0), or images with {YAML} or {PLAIN}')
    return KittiSequence(path, own_poses=own_poses)


def _seven_scenes_images(folder: Path) -> list[Path]:
    return sorted(path for path in _images_in(folder)
                  if re.match(r'frame-.*\.color\.', path.name))


def _images_in(folder: Path) -> Iterable[Path]:
    """Return the image files in a folder, hidden ones excepted."""
    return (path for path in folder.glob('*')
            if path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith('.'))


def _usual_stamps(count: int) -> NDArray[np.int64]:
    return STAMP_OFFSET_NS + np.arange(count, dtype=np.int64) * USUAL_PERIOD_NS


def _listed_images(path: Path, folder: Path, stamp: Callable[[str], int]
                   ) -> tuple[NDArray[np.int64], list[Path]]:
    """Return stamps and image paths of a list "stamp name" with names relative to a folder."""
    stamps, paths = [], []
    for number, text in lines(path):
        words = text.replace(',', ' ').split()
        if len(words) != 2:
            raise DjetError(f"{path} line {number} has {len(words)} words; 'stamp file' is "
                            'expected')
        name = PurePosixPath(words[1])
        if name.is_absolute() or '..' in name.parts:
            raise DjetError(f"{path} line {number}: '{name}' lies outside the folder")
        if '\0' in words[1]:
            raise DjetError(f"{path} line {number}: '{name}' is not a file name")
        stamps.append(stamped(path, number, words[0], stamp))
        paths.append(folder / name)
    if not stamps:
        raise DjetError(f'{path} lists no images')
    return increasing(np.array(stamps, dtype=np.int64), path), paths


def _tum_camera(folder: Path) -> Sequence[float]:
    named = re.search('freiburg([123])', folder.resolve().name)
    return TUM_CAMERAS[named[1]] if named else ()


def _asl_imu(folder: Path, camera_in_body: Array) -> ImuTrack | None:
    """Return the IMU samples, if any; the axes are those of its sensor.yaml, or the body's."""
    if not (folder / 'data.csv').exists():
        return None
    path = folder / 'sensor.yaml'
    imu_in_body = asl_mounting(path) if path.exists() else np.eye(4)
    return read_asl_imu(folder / 'data.csv', camera_in_body[:3, :3].T @ imu_in_body[:3, :3])


def _asl_states(path: Path, camera_in_body: Array, columns: int
                ) -> tuple[NDArray[np.int64], Array]:
    stamps, rows = stamped_rows(path, columns, whole_nanoseconds)
    # ASL writes quaternions w x y z.
    bodies = poses_from_quaternions(rows[:, :3], rows[:, [4, 5, 6, 3]], path)
    return increasing(stamps, path), bodies @ camera_in_body
