"""Sequences of image files with calibration, stamps and ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
import struct
from typing import Any, NamedTuple

from djet_ros.core.types import Array
from djet_ros.errors import DjetError
from djet_ros.odometry.camera import Camera, check_lens, is_distorted
from djet_ros.odometry.frame import Frame
from djet_ros.odometry.images import BadMessage, decoded, jpeg_size, JPEG_START, to_8_bits
from djet_ros.odometry.png import LARGEST_IMAGE_PIXELS, PNG_START
from djet_ros.recordings.imu import ImuTrack
import numpy as np
from numpy.typing import NDArray

# Bytes searched for the size of a JPEG: a thumbnail and a colour profile may precede it.
_LONGEST_JPEG_HEADER = 1 << 20

# Bytes of a PNG up to its size.
_PNG_HEADER = 24

IMAGE_SUFFIXES = ('.png', '.jpg', '.jpeg')


class Intrinsics(NamedTuple):
    """
    K (3, 3) in pixels, pixel centres at integers, and the distortion by OpenCV's coefficients.

    model: 'plumb_bob' (k1, k2, p1, p2 and k3), 'rational_polynomial' (up to 14) or 'equidistant'
    (k1 to k4); fewer are filled up with zeros, as of rectified images.
    """

    K: Array
    distortion: Sequence[float] = ()
    model: str = 'plumb_bob'


class DamagedImage(DjetError):
    """An image file that is cut short or can't be decoded; path: of the file."""

    def __init__(self, path: Path, why: BadMessage) -> None:
        """Keep the path, and make the message."""
        super().__init__(f'{path} is a damaged image ({why}); replace it, or exclude its frame')
        self.path = path


class FrameSequence:
    """
    Image files of one moving camera, with stamps and optionally ground truth and an IMU.

    name: for display; K, distortion, model: see ``Intrinsics``; size: (width, height);
    frame_paths: the files; stamps_ns: (N,) int64, strictly increasing, never 0; poses: (N, 4, 4),
    camera in the frame of the first known pose, NaN for frames without ground truth, or None
    without any; imu: samples of an IMU on the camera, or None.
    """

    def __init__(self, name: str, images: ImageFiles, camera: Intrinsics,
                 stamps_ns: NDArray[np.int64], poses: Array | None,
                 imu: ImuTrack | None = None) -> None:
        self.name = name
        self.K, distortion, self.model = camera
        padding = (4 if self.model == 'equidistant' else 5) - len(distortion)
        self.distortion = np.array([*distortion, *[0.0] * padding])
        self.size, self.frame_paths = images.size, images.paths
        self.stamps_ns = stamps_ns
        self.poses = poses
        self.imu = imu
        self._images = images
        try:
            check_lens(self.K, images.size)
        except BadMessage as error:
            raise DjetError(f'{name}: {error}') from None
        self._camera = Camera(self.K, self.distortion, images.size, self.model)

    def __len__(self) -> int:
        """Count the frames."""
        return len(self.stamps_ns)

    @property
    def distorted(self) -> bool:
        """Return whether the images in the files are distorted."""
        return is_distorted(self.model, self.distortion)

    def raw(self, index: int) -> NDArray[Any]:
        """Return the gray image (H, W) of a frame as stored, uint8 or uint16."""
        return self._images.pixels(index)

    def image(self, index: int) -> NDArray[np.uint8]:
        """Return the undistorted gray pixels (H, W) of a frame."""
        return self._camera.corrected(self._images.gray(index))

    def frame(self, index: int) -> Frame:
        """Return a frame for the odometry; pixels that the file does not show are excluded."""
        return Frame(self.image(index), self.K, int(self.stamps_ns[index]),
                     left_out=self._unseen())

    def _unseen(self) -> NDArray[np.bool_] | None:
        """Return the undistorted pixels (H, W) that the files do not show, or None."""
        return self._camera.unseen(self.size[::-1])


def from_first(poses: Array) -> Array | None:
    """
    Express poses (N, 4, 4) in the frame of the first known one; unknown poses are NaN.

    Returns None if none is known. If the first is the identity, no bit changes.
    """
    known = np.isfinite(poses).all(axis=(1, 2))
    if not known.any():
        return None
    first = poses[known.argmax()]
    return poses if np.array_equal(first, np.eye(4)) else np.asarray(np.linalg.inv(first) @ poses)


class ImageFiles:
    """
    PNG or JPEG files of one size, decoded one at a time.

    The headers of all files are checked first, so that a wrong file is found before the work
    begins. A damaged file, also one that is empty or cut within its header, is found when it is
    decoded: a crashed recorder leaves one, and the others are of use.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        """Check that all are images of one size; raise DjetError for the first that is not."""
        self.paths = tuple(paths)
        self.size = self._common_size()

    def _common_size(self) -> tuple[int, int]:
        common: tuple[int, int] | None = None
        for path in self.paths:
            if (size := image_size(path)) is None:
                continue
            common = common or size
            if size != common:
                raise DjetError(f'{path} is {size[0]}x{size[1]}, the images before it are '
                                f'{common[0]}x{common[1]}; all must have the same size')
        if common is None:
            raise DjetError(f'no image has a header with its size: {self.paths[0]} is empty or '
                            'cut within it; replace it')
        return common

    def gray(self, index: int) -> NDArray[np.uint8]:
        """Return one image (H, W) uint8, the upper 8 bits of a 16-bit one."""
        return to_8_bits(self.pixels(index))

    def pixels(self, index: int) -> NDArray[Any]:
        """Return the image (H, W), uint8 or uint16, of a file; colours become gray."""
        path = self.paths[index]
        try:
            image = decoded(np.frombuffer(path.read_bytes(), np.uint8))
        except OSError as error:
            raise DjetError(f'{path} could not be read: {error.strerror}') from error
        except BadMessage as error:
            raise DamagedImage(path, error) from error
        if image.shape != self.size[::-1]:
            raise DjetError(f'{path} has changed its size during the run')
        return image


def image_size(path: Path) -> tuple[int, int] | None:
    """
    Return (width, height) from the header of a PNG or JPEG file; raise DjetError if neither.

    None if the file is damaged: empty, or without a size in its header.
    """
    try:
        with path.open('rb') as file:
            header = file.read(_PNG_HEADER)
            if header.startswith(JPEG_START):
                header += file.read(_LONGEST_JPEG_HEADER)
    except OSError as error:
        raise DjetError(f'{path} could not be read: {error.strerror}') from error
    if _is_cut(header) and path.suffix.lower() in IMAGE_SUFFIXES:
        return None
    if header.startswith(JPEG_START):
        try:
            width, height = jpeg_size(header)
        except BadMessage:
            return None
    elif header[:8] == PNG_START and header[12:16] == b'IHDR' and len(header) == _PNG_HEADER:
        width, height = struct.unpack('>II', header[16:])
    else:
        raise DjetError(f'{path} is neither a PNG nor a JPEG image')
    if not 0 < width * height <= LARGEST_IMAGE_PIXELS:
        raise DjetError(f'{path} declares {width}x{height} pixels, at most '
                        f'{LARGEST_IMAGE_PIXELS} are decoded')
    return width, height


def _is_cut(header: bytes) -> bool:
    """Return whether a file is empty or ends within its header; header: its beginning."""
    return len(header) < _PNG_HEADER and any(
        start.startswith(header[:len(start)]) for start in (PNG_START, JPEG_START))
