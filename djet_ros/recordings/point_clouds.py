"""Clouds of points as PLY, which CloudCompare, MeshLab and Open3D read."""

from __future__ import annotations

from pathlib import Path

from djet_ros.core.types import Array

# Digits of the number of points, so that it can be written over as the cloud grows.
_DIGITS = 12


class PointFile:
    """
    A new binary PLY file that points are added to.

    The number of points follows each addition, so that the file is whole at any time: a kill
    loses nothing. Creating, writing and closing raise OSError.
    """

    def __init__(self, path: Path, comment: str) -> None:
        """Create the file, which must not exist; comment: a line about the points."""
        self._file = path.open('xb', buffering=0)
        self._count = 0
        before = f'ply\nformat binary_little_endian 1.0\ncomment {comment}\nelement vertex '
        self._count_at = len(before)
        axes = ''.join(f'property float {axis}\n' for axis in 'xyz')
        self._file.write(f'{before}{0:0{_DIGITS}d}\n{axes}end_header\n'.encode('ascii'))
        self._end = self._file.tell()

    def add(self, points: Array) -> None:
        """Append points (N, 3)."""
        rest = memoryview(points.astype('<f4').tobytes())
        self._file.seek(self._end)
        while rest:
            rest = rest[self._file.write(rest):]
        self._end = self._file.tell()
        self._count += len(points)
        self._file.seek(self._count_at)
        self._file.write(f'{self._count:0{_DIGITS}d}'.encode('ascii'))

    def close(self) -> None:
        """Close the file; all has been written already."""
        self._file.close()
