"""Point clouds as PLY files, for CloudCompare, MeshLab and Open3D."""

from __future__ import annotations

from pathlib import Path

from djet_ros.core.types import Array

# Fixed width of the number of points, so that it can be overwritten as the cloud grows.
_DIGITS = 12


class PointFile:
    """
    A new binary PLY file that points are added to.

    The header is updated after each addition, so that the file is valid at any time, even if the
    process is killed. Creating, writing and closing raise OSError.
    """

    def __init__(self, path: Path, comment: str) -> None:
        """Create the file, which must not exist; comment: a line for its header."""
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
        """Close the file."""
        self._file.close()
