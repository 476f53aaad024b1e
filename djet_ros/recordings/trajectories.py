"""
Trajectory files: TUM (stamp, position, quaternion) and KITTI (3x4 matrix), one pose per line.

Every line is flushed to the operating system, so that a killed run loses nothing. Numbers have
the fewest digits that read back to the same double, stamps all nine decimals, so that files are
exact and equal poses give equal bytes.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable
from pathlib import Path

from djet_ros.core.types import Array
from djet_ros.errors import DjetError
from djet_ros.odometry.messages import seconds_text
from djet_ros.recordings.closing import Closing
from djet_ros.recordings.text import check_positions, LineFile, signed_nanoseconds, stamped_rows
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation


class TrajectoryWriter(Closing):
    """Writer of one line per pose to a new file."""

    def __init__(self, path: Path) -> None:
        """Create the file; raise DjetError if it exists or can't be created."""
        self.path = path
        try:
            self._file = LineFile(path)
        except OSError as error:
            raise DjetError(f'{path} could not be created: {error.strerror}') from error

    @staticmethod
    @abstractmethod
    def line(stamp_ns: int, pose: Array) -> str:
        """Return the line of one pose (4, 4), without its end."""

    def write(self, stamp_ns: int, pose: Array) -> None:
        """Append one pose (4, 4), of the camera in the world."""
        try:
            self._file.write(f'{self.line(stamp_ns, pose)}\n')
        except OSError as error:
            raise DjetError(f'{self.path} could not be written: {error.strerror}; the poses '
                            'written so far are complete') from error

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class TumWriter(TrajectoryWriter):
    """Lines ``timestamp tx ty tz qx qy qz qw``, seconds and metres, qw >= 0."""

    @staticmethod
    def line(stamp_ns: int, pose: Array) -> str:
        """Return the line of one pose (4, 4), without its end."""
        return f'{seconds_text(stamp_ns)} {digits(position_and_quaternion(pose))}'


class KittiWriter(TrajectoryWriter):
    """Lines of the 12 numbers of a 3x4 matrix, row by row; the stamp is not part of the format."""

    @staticmethod
    def line(stamp_ns: int, pose: Array) -> str:
        """Return the line of one pose (4, 4), without its end."""
        return digits(pose[:3].ravel())


def read_tum(path: Path) -> tuple[NDArray[np.int64], Array]:
    """Return stamps (N,) in ns and poses (N, 4, 4) of a TUM file. Raises DjetError."""
    stamps, rows = stamped_rows(path, 8, signed_nanoseconds)
    return stamps, poses_from_quaternions(rows[:, :3], rows[:, 3:], path)


def poses_from_quaternions(positions: Array, quaternions: Array, path: Path) -> Array:
    """Return poses (N, 4, 4) from (N, 3) and (N, 4) x y z w; path: source, for a DjetError."""
    check_positions(positions, path)
    # Clipped, because squares of larger numbers could overflow.
    length = np.linalg.norm(np.clip(quaternions, -9.0, 9.0), axis=1)
    wrong = np.flatnonzero(np.abs(length - 1) > 1e-2)
    if wrong.size:
        raise DjetError(f'{path}: the quaternion of pose {wrong[0]} has length '
                        f'{length[wrong[0]]:.3g}; it must be 1')
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    if len(positions):
        poses[:, :3, :3] = Rotation.from_quat(quaternions).as_matrix()
    poses[:, :3, 3] = positions
    return poses


def position_and_quaternion(pose: Array) -> tuple[float, ...]:
    """Return (x, y, z, qx, qy, qz, qw), with qw >= 0, of a pose (4, 4)."""
    quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True)
    return (*pose[:3, 3].tolist(), *quaternion.tolist())


def digits(values: Iterable[float]) -> str:
    """Return numbers as text, with the fewest digits that read back to the same doubles."""
    # Adding zero turns -0.0 into 0.0.
    return ' '.join(repr(float(value) + 0.0) for value in values)
