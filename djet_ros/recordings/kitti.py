"""Sequences in the layout of the KITTI odometry benchmark (Geiger et al., CVPR 2012)."""

from __future__ import annotations

from pathlib import Path

from djet_ros.core.types import Array
from djet_ros.errors import DjetError
from djet_ros.recordings.frame_sequence import FrameSequence, from_first, ImageFiles, Intrinsics
from djet_ros.recordings.imu import ImuTrack, read_asl_imu
from djet_ros.recordings.text import (
    check_count,
    check_positions,
    image_stamps,
    lines,
    nanoseconds,
    number_rows,
    numbers_of,
)
import numpy as np

# Offset of stamps in ns. times.txt begins at 0, but in ROS a stamp of 0 means "no time", and tf
# lookups some seconds back must not become negative. A round number is easy to subtract, and
# 1000 s leave sub-nanosecond resolution in a double.
STAMP_OFFSET_NS = 1000 * 10**9


class KittiSequence(FrameSequence):
    """
    A folder ``.../sequences/NN`` with ``image_0/*.png``, ``calib.txt`` and ``times.txt``.

    The left gray camera, already rectified; calib.txt may give its residual distortion in a row
    ``D: k1 k2 p1 p2 k3`` (OpenCV's coefficients). Stamps are those of times.txt plus
    STAMP_OFFSET_NS. Rendered sequences may have an ``imu.csv`` in the format of EuRoC, and a row
    ``Tr_imu_to_cam`` in calib.txt. Ground truth is taken from ``poses`` or, if it exists and
    own_poses is true, from ``../../poses/NN.txt``, and expressed in the first camera of the range
    start <= i < end. Raises DjetError if the folder does not have this layout.
    """

    def __init__(self, folder: Path, poses: Path | None = None, start: int = 0,
                 end: int | None = None, own_poses: bool = True) -> None:
        """Read everything but the images, and check its consistency."""
        self.folder = folder.resolve()
        paths = _image_paths(self.folder)
        chosen = _frame_range(len(paths), start, end, self.folder)
        K = read_camera(self.folder / 'calib.txt')
        D = calibration_row(self.folder / 'calib.txt', 'D', 5)
        camera = Intrinsics(K, () if D is None else D.tolist())
        times = image_stamps(self.folder / 'times.txt', nanoseconds, len(paths))
        images = ImageFiles(paths[chosen])
        truth = None
        if own_poses and poses is None:
            poses = _poses_beside(self.folder)
        if poses is not None:
            truth = from_first(_poses(poses, len(paths))[chosen])
        super().__init__(f'KITTI {self.folder.name}', images, camera,
                         times[chosen] + STAMP_OFFSET_NS, truth, _imu(self.folder))


def read_camera(path: Path) -> Array:
    """Return K (3, 3) from the row P0 of a calib.txt; raise DjetError if P0 is invalid."""
    P = required_row(path, 'P0', 12, 'it must give the 3x4 projection of camera 0').reshape(3, 4)
    if min(P[0, 0], P[1, 1]) <= 0 or P[2].tolist() != [0, 0, 1, 0] or P[1, 0] != 0:
        raise DjetError(f'{path}: P0 is no projection of a rectified camera '
                        f'(focal lengths {P[0, 0]:g} and {P[1, 1]:g}, last row '
                        f'{" ".join(f"{v:g}" for v in P[2])})')
    return P[:, :3].copy()


def required_row(path: Path, name: str, count: int, meaning: str = 'it may be truncated'
                 ) -> Array:
    """Return the same as ``calibration_row``; without the row raise DjetError with its meaning."""
    row = calibration_row(path, name, count)
    if row is None:
        raise DjetError(f"{path} has no line '{name}:'; {meaning}")
    return row


def calibration_row(path: Path, name: str, count: int) -> Array | None:
    """Return so many numbers of the first row ``name: ...`` of a calibration file, or None."""
    for number, text in lines(path):
        first, _, row = text.partition(':')
        if first.strip() == name:
            return np.array(numbers_of(f'{path} line {number}: {name}', row, count))
    return None


def _imu(folder: Path) -> ImuTrack | None:
    if not (folder / 'imu.csv').exists():
        return None
    pose = required_row(folder / 'calib.txt', 'Tr_imu_to_cam', 12, 'it must give the 3x4 pose of '
                        'the IMU of imu.csv in camera 0').reshape(3, 4)
    check_rigid(np.vstack([pose, np.eye(4)[3]])[None], folder / 'calib.txt')
    return read_asl_imu(folder / 'imu.csv', pose[:, :3], STAMP_OFFSET_NS)


def read_poses(path: Path) -> Array:
    """Return the poses (N, 4, 4) of a KITTI file; raise DjetError for the first invalid line."""
    rows = number_rows(path, 12)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows.reshape(-1, 3, 4)
    check_rigid(poses, path)
    return poses


def check_rigid(poses: Array, path: Path) -> None:
    """Raise DjetError for the first of poses (N, 4, 4) that is no rigid transformation."""
    check_positions(poses[:, :3, 3], path)
    # Clipped, because squares of larger numbers could overflow to inf, and inf - inf is NaN.
    R = np.clip(np.nan_to_num(poses[:, :3, :3], nan=9.0), -9.0, 9.0)
    error = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2), initial=0.0)
    wrong = np.flatnonzero((error > 1e-3) | (np.linalg.det(R) < 0)
                           | (poses[:, 3] != (0, 0, 0, 1)).any(axis=1))
    if wrong.size:
        raise DjetError(f'{path}: pose {wrong[0]} is no rigid transformation (R R^T differs from '
                        f'the identity by {error[wrong[0]]:.2g}); is it a file of poses?')


def _image_paths(folder: Path) -> list[Path]:
    if not folder.is_dir():
        state = 'is a file' if folder.exists() else 'does not exist'
        raise DjetError(f'{folder} {state}; name a KITTI sequence folder such as sequences/00')
    paths = sorted((folder / 'image_0').glob('*.png'))
    if not paths:
        inner = sorted(path.parent.relative_to(folder) for depth in ('*', 'sequences/*')
                       for path in folder.glob(f'{depth}/image_0'))
        hint = (f'it holds {", ".join(map(str, inner[:8]))}: name one of these' if inner else
                'name a KITTI sequence folder such as sequences/00')
        raise DjetError(f'{folder} has no images image_0/*.png; {hint}')
    return paths


def _frame_range(count: int, start: int, end: int | None, folder: Path) -> slice:
    stop = count if end is None else end
    if not 0 <= start < stop <= count:
        raise DjetError(f'--start {start} --end {stop} is outside of the {count} frames of '
                        f'{folder}, or empty; it must hold that 0 <= start < end <= {count}')
    return slice(start, stop)


def _poses_beside(folder: Path) -> Path | None:
    published = folder.parent.parent / 'poses' / f'{folder.name}.txt'
    return published if published.exists() else None


def _poses(path: Path, count: int) -> Array:
    poses = read_poses(path)
    check_count(path, len(poses), count)
    return poses
