"""Readers of TUM RGB-D, EuRoC, TUM-VI and 7-Scenes, and detection of a folder's layout."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath
import re

from djet_ros.config.safe_files import read_yaml
from djet_ros.core.types import Array
from djet_ros.errors import DjetError, one_line
from djet_ros.odometry.interpolation import poses_at
from djet_ros.recordings.frame_sequence import FrameSequence, from_first, ImageFiles
from djet_ros.recordings.imu import ImuTrack, read_asl_imu
from djet_ros.recordings.kitti import check_rigid, KittiSequence, STAMP_OFFSET_NS
from djet_ros.recordings.kitti_raw import is_kitti_raw, kitti_raw
from djet_ros.recordings.text import (
    increasing,
    lines,
    nanoseconds,
    number_rows,
    numbers,
    stamped,
    stamped_rows,
    whole_nanoseconds,
)
from djet_ros.recordings.trajectories import poses_from_quaternions, read_tum
from djet_ros.recordings.varos import varos_camera, VarosSequence
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

# The camera published with 7-Scenes (fx fy cx cy), and the frame period of a Kinect.
SEVEN_SCENES_CAMERA = (585.0, 585.0, 320.0, 240.0)
SEVEN_SCENES_PERIOD_NS = 33_333_333

# Names of OpenCV's two distortion models in ASL and Kalibr files, and numbers of coefficients.
ASL_MODELS = {'radial-tangential': ('plumb_bob', (0, 4, 5)), 'radtan': ('plumb_bob', (4,)),
              'none': ('plumb_bob', (0,)), 'equidistant': ('equidistant', (4,))}


def tum_rgbd(folder: Path) -> FrameSequence:
    """
    Open a TUM RGB-D folder: rgb.txt, the images that it lists, and optionally groundtruth.txt.

    The camera is taken from ``calibration.txt`` ("fx fy cx cy [k1 k2 p1 p2 k3]"), or from
    the folder's name (freiburg1 to 3). Ground truth is the pose of the camera's optical frame.
    """
    stamps, paths = _listed_images(folder / 'rgb.txt', folder, nanoseconds)
    K, distortion = _calibrated_camera(folder, _tum_camera(folder))
    poses = None
    if (truth := folder / 'groundtruth.txt').exists():
        known, known_poses = read_tum(truth)
        poses = from_first(poses_at(increasing(known, truth), known_poses, stamps, LONGEST_GAP_NS))
    return FrameSequence(folder.resolve().name, ImageFiles(paths), K, stamps, poses, distortion)


def seven_scenes(folder: Path) -> FrameSequence:
    """
    Open a sequence of 7-Scenes: frame-*.color.png (or .jpg), each with its frame-*.pose.txt.

    The data set has no stamps; the images are taken to be at 30 Hz. ``calibration.txt`` overrides
    the published camera.
    """
    paths = _seven_scenes_images(folder)
    K, distortion = _calibrated_camera(folder, SEVEN_SCENES_CAMERA)
    stamps = STAMP_OFFSET_NS + np.arange(len(paths), dtype=np.int64) * SEVEN_SCENES_PERIOD_NS
    poses = np.full((len(paths), 4, 4), np.nan)
    for index, path in enumerate(paths):
        truth = path.with_name(f'{path.name.partition(".")[0]}.pose.txt')
        if truth.exists():
            rows = number_rows(truth, 4)
            if len(rows) != 4:
                raise DjetError(f'{truth} has {len(rows)} rows; a pose must have 4')
            check_rigid(rows[None], truth)
            poses[index] = rows
    return FrameSequence(folder.resolve().name, ImageFiles(paths), K, stamps, from_first(poses),
                         distortion)


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
    chain = next((path for path in (mav.parent / 'dso' / 'camchain.yaml', mav / 'camchain.yaml')
                  if path.exists()), None)
    if chain is not None and not (camera / 'sensor.yaml').exists():
        K, distortion, model, camera_in_body = _kalibr_camera(chain)
    else:
        K, distortion, model, camera_in_body = _asl_camera(camera / 'sensor.yaml')
    poses = None
    if (truth := mav / 'state_groundtruth_estimate0' / 'data.csv').exists():
        poses = from_first(poses_at(*_asl_states(truth, camera_in_body, 17), stamps,
                                    LONGEST_GAP_NS))
    elif (truth := mav / 'mocap0' / 'data.csv').exists():
        poses = from_first(poses_at(*_asl_states(truth, camera_in_body, 8), stamps,
                                    LONGEST_GAP_NS))
    return FrameSequence(folder.resolve().name, ImageFiles(paths), K, stamps, poses, distortion,
                         model, _asl_imu(mav / 'imu0', camera_in_body))


def open_sequence(path: Path, own_poses: bool = True) -> FrameSequence:
    """
    Open a folder of KITTI (odometry, raw), TUM RGB-D, 7-Scenes, EuRoC, TUM-VI or VAROS.

    own_poses: whether to read ../../poses/NN.txt of a KITTI sequence as its ground truth.
    """
    if (path / 'rgb.txt').exists():
        return tum_rgbd(path)
    if varos_camera(path) is not None:
        return VarosSequence(path)
    if (path / 'mav0').is_dir() or (path / 'cam0').is_dir():
        return euroc(path)
    if is_kitti_raw(path):
        return kitti_raw(path)
    if _seven_scenes_images(path):
        return seven_scenes(path)
    like_kitti = any(any(path.glob(f'{depth}image_0')) for depth in ('', '*/', 'sequences/*/'))
    if path.is_dir() and not like_kitti:
        raise DjetError(f'{path} is neither a bag nor a folder of KITTI (image_0, or raw: '
                        'image_00/data), TUM RGB-D (rgb.txt), 7-Scenes (frame-*.color.png), EuRoC '
                        'or TUM-VI (mav0), or VAROS (vehicle0)')
    return KittiSequence(path, own_poses=own_poses)


def _seven_scenes_images(folder: Path) -> list[Path]:
    return sorted(path for path in folder.glob('frame-*.color.*')
                  if path.suffix in ('.png', '.jpg', '.jpeg'))


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


def _calibrated_camera(folder: Path, published: Sequence[float]
                       ) -> tuple[Array, Sequence[float]]:
    """Return (K, distortion) of calibration.txt, or else those published with the data set."""
    file, values = folder / 'calibration.txt', tuple(published)
    if file.exists():
        _, text = next(lines(file), (0, ''))
        try:
            values = tuple(numbers(text))
        except ValueError as error:
            raise DjetError(f'{file}: {error}') from error
    if len(values) not in (4, 8, 9):
        raise DjetError(f"{folder} has no known camera; write 'fx fy cx cy', perhaps with "
                        f"'k1 k2 p1 p2 k3', into {file}")
    return _camera(values[:4], values[4:], file)


def _asl_camera(path: Path) -> tuple[Array, Sequence[float], str, Array]:
    """Return camera matrix, distortion, its model, and the pose of the camera in the body."""
    sensor = read_yaml(path)
    if not isinstance(sensor, dict):
        raise DjetError(f'{path} is no ASL camera description: it has neither intrinsics nor '
                        'T_BS; replace the file, which may be truncated')
    try:
        named = sensor.get('distortion_model', 'radial-tangential')
        intrinsics = [float(value) for value in sensor['intrinsics']]
        distortion = [float(value) for value in sensor.get('distortion_coefficients', [])]
        camera_in_body = _rigid(sensor['T_BS']['data'])
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
        raise DjetError(f'{path} is no ASL camera description (intrinsics, T_BS): '
                        f'{one_line(error)}') from error
    check_rigid(camera_in_body[None], path)
    model = _model(path, named, intrinsics, distortion)
    return *_camera(intrinsics, distortion, path), model, camera_in_body


def _kalibr_camera(path: Path) -> tuple[Array, Sequence[float], str, Array]:
    """Do the same for cam0 of a Kalibr camera chain, whose T_cam_imu is the inverse pose."""
    chain = read_yaml(path)
    try:
        camera = chain['cam0']
        named = camera['distortion_model']
        intrinsics = [float(value) for value in camera['intrinsics']]
        distortion = [float(value) for value in camera['distortion_coeffs']]
        body_in_camera = _rigid(camera['T_cam_imu'])
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
        raise DjetError(f'{path} is no Kalibr camera chain (cam0: intrinsics, T_cam_imu): '
                        f'{one_line(error)}') from error
    check_rigid(body_in_camera[None], path)
    model = _model(path, named, intrinsics, distortion)
    return *_camera(intrinsics, distortion, path), model, np.asarray(np.linalg.inv(body_in_camera))


def _rigid(values: object) -> Array:
    return np.array(values, dtype=np.float64).reshape(4, 4)


def _model(path: Path, named: object, intrinsics: Sequence[float], distortion: Sequence[float]
           ) -> str:
    model, counts = ASL_MODELS.get(str(named), ('', ()))
    if len(intrinsics) != 4 or len(distortion) not in counts:
        raise DjetError(f"{path}: distortion model '{one_line(named, 40)}' with "
                        f'{len(intrinsics)} intrinsics and {len(distortion)} coefficients; '
                        'supported are radial-tangential and equidistant, with 4 and 4')
    return model


def _asl_imu(folder: Path, camera_in_body: Array) -> ImuTrack | None:
    """Return the IMU samples, if any; the axes are those of its sensor.yaml, or the body's."""
    if not (folder / 'data.csv').exists():
        return None
    imu_in_body = np.eye(4)
    if (path := folder / 'sensor.yaml').exists():
        sensor = read_yaml(path)
        try:
            imu_in_body = _rigid(sensor['T_BS']['data'])
        except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
            raise DjetError(f'{path} is no ASL sensor description (T_BS): '
                            f'{one_line(error)}') from error
        check_rigid(imu_in_body[None], path)
    return read_asl_imu(folder / 'data.csv', camera_in_body[:3, :3].T @ imu_in_body[:3, :3])


def _camera(intrinsics: Sequence[float], distortion: Sequence[float], path: Path
            ) -> tuple[Array, Sequence[float]]:
    fx, fy, cx, cy = intrinsics
    if not (fx > 0 and fy > 0 and np.isfinite([*intrinsics, *distortion]).all()):
        raise DjetError(f'{path}: fx fy cx cy = {fx:g} {fy:g} {cx:g} {cy:g} is no valid camera; '
                        'focal lengths must be positive')
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), distortion


def _asl_states(path: Path, camera_in_body: Array, columns: int
                ) -> tuple[NDArray[np.int64], Array]:
    stamps, rows = stamped_rows(path, columns, whole_nanoseconds)
    # ASL writes quaternions w x y z.
    bodies = poses_from_quaternions(rows[:, :3], rows[:, [4, 5, 6, 3]], path)
    return increasing(stamps, path), bodies @ camera_in_body
