"""
Drives of KITTI's raw data (Geiger et al., IJRR 2013), in the layout of the download.

A drive holds image_00/data/*.png and image_00/timestamps.txt. The calibration is in the drive or
in the folder above it: calib_cam_to_cam.txt and, to use the GPS/IMU (oxts), calib_velo_to_cam.txt
and calib_imu_to_velo.txt.
"""

from __future__ import annotations

from datetime import datetime, UTC
from pathlib import Path

from djet_ros.core.geometry import nearest_rotation
from djet_ros.core.types import Array
from djet_ros.errors import DjetError
from djet_ros.odometry.interpolation import poses_at
from djet_ros.recordings.frame_sequence import FrameSequence, from_first, ImageFiles, Intrinsics
from djet_ros.recordings.imu import ImuTrack
from djet_ros.recordings.kitti import check_rigid, required_row
from djet_ros.recordings.text import check_positions, image_stamps, number_rows, read_stamps
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

_EARTH_RADIUS = 6378137.0

# Longest gap in the GPS/IMU, in ns, that is interpolated; synchronised drives have one per image.
_LONGEST_GAP_NS = 250_000_000

# Columns of a file of oxts, and those of accelerations and angular rates in the unit's axes.
_COLUMNS, _ACCELERATIONS, _RATES = 30, slice(11, 14), slice(17, 20)

_IMAGES = Path('image_00') / 'data'


def is_kitti_raw(folder: Path) -> bool:
    """Return whether a folder is a drive of the raw data."""
    return (folder / _IMAGES).is_dir()


def kitti_raw(folder: Path) -> FrameSequence:
    """
    Open a drive: the left gray camera, rectified (…_sync) or raw (…_extract).

    Ground truth and IMU are those of oxts, if it and its calibration are present. Stamps are
    taken as UTC. Raises DjetError.
    """
    paths = sorted((folder / _IMAGES).glob('*.png'))
    if not paths:
        raise DjetError(f'{folder / _IMAGES} holds no *.png; name a drive of the raw data')
    images = ImageFiles(paths)
    stamps = image_stamps(folder / 'image_00' / 'timestamps.txt', clock_nanoseconds, len(paths))
    camera, rectifying = _camera(_calibration_file(folder, 'calib_cam_to_cam.txt'), images.size)
    poses = imu = None
    if (unit_in_camera := _unit_in_camera(folder, rectifying)) is not None:
        known, rows = _oxts(folder / 'oxts')
        units = _unit_poses(rows, folder)
        poses = from_first(poses_at(known, units @ np.linalg.inv(unit_in_camera), stamps,
                                    _LONGEST_GAP_NS))
        imu = ImuTrack(known, rows[:, _RATES], rows[:, _ACCELERATIONS], unit_in_camera[:3, :3])
    return FrameSequence(f'KITTI raw {folder.resolve().name}', images, camera, stamps, poses, imu)


def _calibration_file(folder: Path, name: str) -> Path:
    """Return a calibration file, in the drive or in the day's folder above it."""
    places = (folder / name, folder.resolve().parent / name)
    found = next((path for path in places if path.exists()), None)
    if found is None:
        raise DjetError(f'{places[1]} is missing; download the calibration of that day')
    return found


def clock_nanoseconds(text: str) -> int:
    """Return the ns since 1970 of a UTC time such as '2011-09-26 13:02:25.964389445'."""
    whole, _, rest = text.partition('.')
    if len(rest) > 9 or (rest and not (rest.isascii() and rest.isdecimal())):
        raise ValueError(f"'{text[:40]}' is not a stamp of the form 2011-09-26 13:02:25.964389445")
    try:
        clock = datetime.strptime(whole, '%Y-%m-%d %H:%M:%S').replace(tzinfo=UTC)
    except ValueError:
        raise ValueError(f"'{text[:40]}' is not a stamp of the form 2011-09-26 13:02:25.964389445"
                         ) from None
    if not 1970 < clock.year < 2038:
        raise ValueError(f"'{text[:40]}' is not a stamp between 1971 and 2037")
    return int(clock.timestamp()) * 10**9 + int(rest.ljust(9, '0'))


def _camera(path: Path, size: tuple[int, int]) -> tuple[Intrinsics, Array]:
    """Return the camera and the rectifying rotation for images of a size (rectified or raw)."""
    rectified, raw = (required_row(path, name, 2) for name in ('S_rect_00', 'S_00'))
    if tuple(rectified) == size:
        K, distortion = required_row(path, 'P_rect_00', 12).reshape(3, 4)[:, :3], np.zeros(5)
        turn = required_row(path, 'R_rect_00', 9).reshape(3, 3)
        rectified_axes = np.eye(4)
        rectified_axes[:3, :3] = turn
        check_rigid(rectified_axes[None], path)
    elif tuple(raw) == size:
        K, distortion = required_row(path, 'K_00', 9).reshape(3, 3), required_row(path, 'D_00', 5)
        turn = np.eye(3)
    else:
        raise DjetError(f'{path} is for images of {_size(rectified)} or {_size(raw)}, these are '
                        f'{_size(np.array(size))}; use the calibration of the same day')
    if min(K[0, 0], K[1, 1]) <= 0 or K[2].tolist() != [0, 0, 1]:
        raise DjetError(f'{path}: fx fy cx cy = {K[0, 0]:g} {K[1, 1]:g} {K[0, 2]:g} {K[1, 2]:g} '
                        'is no valid camera; focal lengths must be positive')
    return Intrinsics(K.copy(), distortion.tolist()), turn


def _size(size: Array) -> str:
    return f'{size[0]:g}x{size[1]:g}'


def _unit_in_camera(folder: Path, rectifying: Array) -> Array | None:
    """Return the pose of the GPS/IMU in the camera (4, 4), None if it or its calibration lacks."""
    day = folder.resolve().parent
    names = ('calib_imu_to_velo.txt', 'calib_velo_to_cam.txt')
    if not (folder / 'oxts' / 'timestamps.txt').exists() or not all(
            (folder / name).exists() or (day / name).exists() for name in names):
        return None
    pose = np.eye(4)
    for name in names:
        path = _calibration_file(folder, name)
        step = np.eye(4)
        step[:3, :3] = required_row(path, 'R', 9).reshape(3, 3)
        step[:3, 3] = required_row(path, 'T', 3)
        check_rigid(step[None], path)
        pose = step @ pose
    turn = np.eye(4)
    turn[:3, :3] = rectifying
    # The files have too few digits for an exact rotation.
    pose = turn @ pose
    pose[:3, :3] = nearest_rotation(pose[:3, :3])
    return pose


def _oxts(folder: Path) -> tuple[NDArray[np.int64], Array]:
    """Return increasing stamps (M,) and rows (M, 30) of the GPS/IMU."""
    stamps = read_stamps(folder / 'timestamps.txt', clock_nanoseconds)
    paths = sorted((folder / 'data').glob('*.txt'))
    if len(stamps) != len(paths):
        raise DjetError(f'{folder}: timestamps.txt has {len(stamps)} lines for {len(paths)} files '
                        'data/*.txt; there must be one per image')
    rows = [number_rows(path, _COLUMNS) for path in paths]
    wrong = next((path for path, row in zip(paths, rows, strict=True) if len(row) != 1), None)
    if wrong is not None:
        raise DjetError(f'{wrong} must have exactly one line of {_COLUMNS} numbers')
    # In unsynchronised drives some packets were stamped in another order, or at one time.
    stamps, first = np.unique(stamps, return_index=True)
    return stamps, np.concatenate(rows)[first] if rows else np.empty((0, _COLUMNS))


def _unit_poses(rows: Array, folder: Path) -> Array:
    """Return the poses (M, 4, 4) of the unit in Mercator coordinates, as KITTI's devkit does."""
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    if not len(rows):
        return poses
    latitude, longitude, altitude, roll, pitch, yaw = rows[:, :6].T
    scale = np.cos(np.radians(latitude[0]))
    with np.errstate(divide='ignore', invalid='ignore'):
        north = scale * _EARTH_RADIUS * np.log(np.tan(np.radians(90 + latitude) / 2))
    poses[:, :3, 3] = np.stack([scale * np.radians(longitude) * _EARTH_RADIUS, north, altitude], 1)
    check_positions(poses[:, :3, 3], folder / 'oxts' / 'data')
    poses[:, :3, :3] = Rotation.from_euler('ZYX', np.stack([yaw, pitch, roll], 1)).as_matrix()
    return poses
