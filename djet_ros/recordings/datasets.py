"""Other public layouts as FrameSequence: TUM RGB-D and EuRoC (ASL); and which one a path has."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath
import re

from djet_ros.config.safe_files import read_yaml
from djet_ros.core.types import Array
from djet_ros.errors import DjetError, one_line
from djet_ros.odometry.interpolation import poses_at
from djet_ros.recordings.frame_sequence import FrameSequence, from_first, ImageFiles
from djet_ros.recordings.kitti import check_rigid, KittiSequence
from djet_ros.recordings.text import (
    increasing,
    lines,
    nanoseconds,
    numbers,
    stamped,
    stamped_rows,
    whole_nanoseconds,
)
from djet_ros.recordings.trajectories import poses_from_quaternions, read_tum
from djet_ros.recordings.varos import varos_camera, VarosSequence
import numpy as np
from numpy.typing import NDArray

# A gap in the ground truth wider than this is not bridged by interpolation.
LONGEST_GAP_NS = 100_000_000

# Published calibrations of the benchmark's cameras (fx fy cx cy, then k1 k2 p1 p2 k3), by the
# number in the folder's name: https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
TUM_CAMERAS = {
    '1': (517.3, 516.5, 318.6, 255.3, 0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
    '2': (520.9, 521.0, 325.1, 249.7, 0.2312, -0.7849, -0.0033, -0.0001, 0.9172),
    '3': (535.4, 539.2, 320.1, 247.6),
}


def tum_rgbd(folder: Path) -> FrameSequence:
    """
    Open a TUM RGB-D folder: rgb.txt, rgb/*.png and perhaps groundtruth.txt.

    The camera is taken from ``calibration.txt`` ("fx fy cx cy [k1 k2 p1 p2 k3]"), or from
    the folder's name (freiburg1 to 3). Ground truth is the camera's optical frame.
    """
    stamps, paths = _listed_images(folder / 'rgb.txt', folder, nanoseconds)
    K, distortion = _tum_camera(folder)
    poses = None
    if (truth := folder / 'groundtruth.txt').exists():
        known, known_poses = read_tum(truth)
        poses = from_first(poses_at(increasing(known, truth), known_poses, stamps, LONGEST_GAP_NS))
    return FrameSequence(folder.resolve().name, ImageFiles(paths), K, stamps, poses, distortion)


def euroc(folder: Path) -> FrameSequence:
    """
    Open an EuRoC (ASL) folder: mav0/cam0 and perhaps mav0/state_groundtruth_estimate0.

    Ground truth is moved from the body to the camera by T_BS of cam0/sensor.yaml.
    """
    mav = folder / 'mav0' if (folder / 'mav0').is_dir() else folder
    camera = mav / 'cam0'
    stamps, paths = _listed_images(camera / 'data.csv', camera / 'data', whole_nanoseconds)
    K, distortion, camera_in_body = _asl_camera(camera / 'sensor.yaml')
    poses = None
    if (truth := mav / 'state_groundtruth_estimate0' / 'data.csv').exists():
        poses = from_first(poses_at(*_asl_states(truth, camera_in_body), stamps, LONGEST_GAP_NS))
    return FrameSequence(folder.resolve().name, ImageFiles(paths), K, stamps, poses, distortion)


def open_sequence(path: Path) -> FrameSequence:
    """Open a folder of KITTI, TUM RGB-D, EuRoC or VAROS, whichever it is."""
    if (path / 'rgb.txt').exists():
        return tum_rgbd(path)
    if varos_camera(path) is not None:
        return VarosSequence(path)
    if (path / 'mav0').is_dir() or (path / 'cam0').is_dir():
        return euroc(path)
    like_kitti = any(any(path.glob(f'{depth}image_0')) for depth in ('', '*/', 'sequences/*/'))
    if path.is_dir() and not like_kitti:
        raise DjetError(f'{path} is neither a bag nor a folder of KITTI (image_0), TUM RGB-D '
                        '(rgb.txt), EuRoC (mav0) or VAROS (vehicle0)')
    return KittiSequence(path)


def _listed_images(path: Path, folder: Path, stamp: Callable[[str], int]
                   ) -> tuple[NDArray[np.int64], list[Path]]:
    """Stamps and image paths of a list "stamp name"; the names are relative to a folder."""
    stamps, paths = [], []
    for number, text in lines(path):
        words = text.replace(',', ' ').split()
        if len(words) != 2:
            raise DjetError(f"{path} line {number} has {len(words)} words; 'stamp file' belongs "
                            'there')
        name = PurePosixPath(words[1])
        if name.is_absolute() or '..' in name.parts:
            raise DjetError(f"{path} line {number}: '{name}' lies outside the folder")
        if '\0' in words[1]:
            raise DjetError(f"{path} line {number}: '{name}' is no name of a file")
        stamps.append(stamped(path, number, words[0], stamp))
        paths.append(folder / name)
    if not stamps:
        raise DjetError(f'{path} lists no image')
    return increasing(np.array(stamps, dtype=np.int64), path), paths


def _tum_camera(folder: Path) -> tuple[Array, Sequence[float]]:
    file = folder / 'calibration.txt'
    if file.exists():
        _, text = next(lines(file), (0, ''))
        try:
            values = tuple(numbers(text))
        except ValueError as error:
            raise DjetError(f'{file}: {error}') from error
    else:
        named = re.search('freiburg([123])', folder.resolve().name)
        values = TUM_CAMERAS[named[1]] if named else ()
    if len(values) not in (4, 8, 9):
        raise DjetError(f"{folder} has no known camera; write 'fx fy cx cy', perhaps with "
                        f"'k1 k2 p1 p2 k3', into {file}")
    return _camera(values[:4], values[4:], file)


def _asl_camera(path: Path) -> tuple[Array, Sequence[float], Array]:
    sensor = read_yaml(path)
    try:
        model = sensor.get('distortion_model', 'radial-tangential')
        intrinsics = [float(value) for value in sensor['intrinsics']]
        distortion = [float(value) for value in sensor.get('distortion_coefficients', [])]
        camera_in_body = np.array(sensor['T_BS']['data'], dtype=np.float64).reshape(4, 4)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise DjetError(f'{path} is no ASL camera description (intrinsics, T_BS): '
                        f'{one_line(error)}') from error
    if model != 'radial-tangential' or len(intrinsics) != 4 or len(distortion) not in (0, 4, 5):
        raise DjetError(f"{path}: distortion model '{model}' with {len(intrinsics)} and "
                        f'{len(distortion)} numbers; radial-tangential with 4 and 4 is known')
    check_rigid(camera_in_body[None], path)
    return *_camera(intrinsics, distortion, path), camera_in_body


def _camera(intrinsics: Sequence[float], distortion: Sequence[float], path: Path
            ) -> tuple[Array, Sequence[float]]:
    fx, fy, cx, cy = intrinsics
    if not (fx > 0 and fy > 0 and np.isfinite([*intrinsics, *distortion]).all()):
        raise DjetError(f'{path}: fx fy cx cy = {fx:g} {fy:g} {cx:g} {cy:g} is no camera')
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), distortion


def _asl_states(path: Path, camera_in_body: Array) -> tuple[NDArray[np.int64], Array]:
    stamps, rows = stamped_rows(path, 17, whole_nanoseconds)
    # ASL writes quaternions w x y z.
    bodies = poses_from_quaternions(rows[:, :3], rows[:, [4, 5, 6, 3]], path)
    return increasing(stamps, path), bodies @ camera_in_body
