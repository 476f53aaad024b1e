"""
The synthetic underwater sequence VAROS (Zwilgmeyer et al., ICCV Workshops 2021).

The layout follows public programs that read the data set; it was not checked against the data set
itself. vehicle0/cam0 holds A/*.png (rendered with water and lamps), camM0_timestamps.csv (a row
per image, beginning with its stamp in ns) and camM0_poses/camM0_poses_transformation_matrix.csv
(stamp in ns and the rows of a 3x4 matrix: pose of the camera's optical frame in the world).
"""

from __future__ import annotations

from pathlib import Path

from djet_ros.core.types import Array
from djet_ros.errors import DjetError
from djet_ros.recordings.frame_sequence import FrameSequence, from_first, ImageFiles, Intrinsics
from djet_ros.recordings.kitti import check_rigid, STAMP_OFFSET_NS
from djet_ros.recordings.text import image_stamps, stamped_rows, whole_nanoseconds
import numpy as np
from numpy.typing import NDArray

# Camera of those programs: focal length in pixels, for images of this size (width, height).
FOCAL_LENGTH = 990.323
SIZE = (1280, 720)


def varos(camera: Path, name: str) -> FrameSequence:
    """
    Open cam0 of a recording of VAROS, see ``varos_camera``; name: of the recording.

    Stamps are those of the data set plus STAMP_OFFSET_NS. An image has ground truth if a pose has
    the same stamp. Raises DjetError if the folder does not have this layout.
    """
    images = ImageFiles(sorted((camera / 'A').glob('*.png')))
    if images.size != SIZE:
        raise DjetError(f'{camera / "A"} has images of {images.size[0]}x{images.size[1]}, but the '
                        f'calibration of VAROS is for {SIZE[0]}x{SIZE[1]}')
    K = np.array([[FOCAL_LENGTH, 0, (SIZE[0] - 1) / 2],
                  [0, FOCAL_LENGTH, (SIZE[1] - 1) / 2], [0, 0, 1]])
    stamps = image_stamps(camera / 'camM0_timestamps.csv',
                          lambda row: whole_nanoseconds(row.partition(',')[0].strip()),
                          len(images.paths))
    poses = _poses(camera / 'camM0_poses' / 'camM0_poses_transformation_matrix.csv', stamps)
    return FrameSequence(f'VAROS {name}', images, Intrinsics(K), stamps + STAMP_OFFSET_NS, poses)


def varos_camera(folder: Path) -> Path | None:
    """Return cam0 of a folder of a recording, of a vehicle or of cam0 itself, or None."""
    for camera in (folder / 'vehicle0' / 'cam0', folder / 'cam0', folder):
        if (camera / 'camM0_timestamps.csv').exists() and any((camera / 'A').glob('*.png')):
            return camera
    return None


def _poses(path: Path, stamps: NDArray[np.int64]) -> Array | None:
    """Return poses (N, 4, 4) at stamps (N,), relative to the first known; NaN if unknown."""
    if not path.exists():
        return None
    at, rows = stamped_rows(path, 13, whole_nanoseconds)
    known = dict(zip(at.tolist(), rows.reshape(-1, 3, 4)))
    poses = np.full((len(stamps), 4, 4), np.nan)
    for index, stamp in enumerate(stamps.tolist()):
        if stamp in known:
            poses[index, :3], poses[index, 3] = known[stamp], (0, 0, 0, 1)
    check_rigid(poses[np.isfinite(poses).all(axis=(1, 2))], path)
    return from_first(poses)
