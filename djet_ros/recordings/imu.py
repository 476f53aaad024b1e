"""Samples of an IMU, read from files."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from djet_ros.core.types import Array
from djet_ros.recordings.text import stamped_rows, whole_nanoseconds
import numpy as np
from numpy.typing import NDArray


class ImuTrack(NamedTuple):
    """
    Samples of an IMU as recorded; stamps may be out of order.

    stamps_ns: (M,); rates: (M, 3) in rad/s and accelerations: (M, 3) in m/s², in the IMU's axes;
    to_camera: (3, 3) rotation from these axes to those of the camera.
    """

    stamps_ns: NDArray[np.int64]
    rates: Array
    accelerations: Array
    to_camera: Array


def read_asl_imu(path: Path, to_camera: Array, offset_ns: int = 0) -> ImuTrack:
    """
    Read a CSV of EuRoC or TUM-VI: stamp in ns, three rates in rad/s, three accelerations in m/s².

    offset_ns is added to the stamps. Raises DjetError.
    """
    stamps, rows = stamped_rows(path, 7, whole_nanoseconds)
    return ImuTrack(stamps + offset_ns, rows[:, :3], rows[:, 3:], to_camera)
