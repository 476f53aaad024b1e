"""Recorded image sequences, and the image files beneath them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
import struct
from typing import Any

from djet_ros.core.types import Array
from djet_ros.errors import DjetError
from djet_ros.odometry.camera import Camera, check_lens, distorts
from djet_ros.odometry.frame import Frame
from djet_ros.odometry.images import BadMessage, decoded, jpeg_size, narrowed
from djet_ros.odometry.png import LARGEST_IMAGE_PIXELS, PNG_START
from djet_ros.recordings.imu import ImuTrack
import numpy as np
from numpy.typing import NDArray

# A JPEG file may show a thumbnail and a colour profile before it tells its size.
_LONGEST_JPEG_HEADER = 1 << 20

_JPEG_START = b'\xff\xd8'


class DamagedImage(DjetError):
    """A file that began like an image, and can't be decoded; path: of the file."""

    def __init__(self, path: Path, why: BadMessage) -> None:
        """Keep the path beside the text."""
        super().__init__(f'{path} is a damaged image ({why}); replace it, or leave its frame out')
        self.path = path


class FrameSequence:
    """
    Images of one moving camera in files, with stamps and perhaps ground truth.

    name: for people; K: (3, 3) camera matrix in pixels, pixel centres at integers; distortion:
    as OpenCV has it for the model ('plumb_bob': k1, k2, p1, p2 and k3, zeros where the images
    are rectified; or 'equidistant': k1 to k4); size: (width, height); frame_paths: the files;
    stamps_ns: (N,) int64, strictly increasing, never 0; poses: (N, 4, 4), camera in the first
    known one's frame, rows of NaN where the ground truth does not reach, or None where there is
    none; imu: what an IMU beside the camera felt, or None.
    """

    def __init__(self, name: str, images: ImageFiles, K: Array, stamps_ns: NDArray[np.int64],
                 poses: Array | None, distortion: Sequence[float] = (),
                 model: str = 'plumb_bob', imu: ImuTrack | None = None) -> None:
        self.name = name
        self.K = K
        self.model = model
        padded = [*distortion, *[0.0] * 5]
        self.distortion = np.array(padded[:4 if model == 'equidistant' else 5])
        self.size, self.frame_paths = images.size, images.paths
        self.stamps_ns = stamps_ns
        self.poses = poses
        self.imu = imu
        self._images = images
        try:
            check_lens(K, images.size)
        except BadMessage as error:
            raise DjetError(f'{name}: {error}') from None
        self._camera = Camera(K, self.distortion, images.size, model)

    def __len__(self) -> int:
        """Count the frames."""
        return len(self.stamps_ns)

    @property
    def distorted(self) -> bool:
        """Whether the files show what a pinhole would not."""
        return distorts(self.model, self.distortion)

    def raw(self, index: int) -> NDArray[Any]:
        """Gray pixels (H, W) of a frame as its file has them, uint8 or uint16; DamagedImage."""
        return self._images.pixels(index)

    def image(self, index: int) -> NDArray[np.uint8]:
        """Gray pixels (H, W) of a frame without its distortion."""
        return self._camera.undistort(self._images.gray(index))

    def frame(self, index: int) -> Frame:
        """Give a frame as an odometry takes it, from which is left out what no image shows."""
        return Frame(self.image(index), self.K, int(self.stamps_ns[index]),
                     left_out=self._unseen())

    def _unseen(self) -> NDArray[np.bool_] | None:
        """(H, W) bool, pixels without distortion that the files do not show, or None."""
        return self._camera.unseen(self.size[::-1])


def from_first(poses: Array) -> Array | None:
    """
    Express poses (N, 4, 4) in the frame of the first that is known, the others being NaN.

    An identity there changes no bit. None where none is known.
    """
    known = np.isfinite(poses).all(axis=(1, 2))
    if not known.any():
        return None
    first = poses[known.argmax()]
    return poses if np.array_equal(first, np.eye(4)) else np.asarray(np.linalg.inv(first) @ poses)


class ImageFiles:
    """
    PNG or JPEG files of one size, decoded one at a time.

    The headers of all files are checked at once, so that a wrong file is found before the work
    begins and no declared size is believed before it was compared.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        """Check that all are images of one size; DjetError names the first that isn't."""
        self.paths = tuple(paths)
        self.size = image_size(self.paths[0])
        for path in self.paths[1:]:
            if (size := image_size(path)) != self.size:
                raise DjetError(f'{path} is {size[0]}x{size[1]}, the images before it are '
                                f'{self.size[0]}x{self.size[1]}; one size is needed')

    def gray(self, index: int) -> NDArray[np.uint8]:
        """Image (H, W) uint8 of a file; of 16 bits the upper 8."""
        return narrowed(self.pixels(index))

    def pixels(self, index: int) -> NDArray[Any]:
        """Image (H, W), uint8 or uint16, of a file; colours become gray."""
        path = self.paths[index]
        try:
            image = decoded(np.frombuffer(path.read_bytes(), np.uint8))
        except OSError as error:
            raise DjetError(f'{path} could not be read: {error.strerror}') from error
        except BadMessage as error:
            raise DamagedImage(path, error) from error
        if image.shape != self.size[::-1]:
            raise DjetError(f'{path} has changed its size since the work began')
        return image


def image_size(path: Path) -> tuple[int, int]:
    """Give (width, height) from the header of a PNG or JPEG file, else DjetError."""
    try:
        with path.open('rb') as file:
            header = file.read(24)
            if header.startswith(_JPEG_START):
                header += file.read(_LONGEST_JPEG_HEADER)
    except OSError as error:
        raise DjetError(f'{path} could not be read: {error.strerror}') from error
    if header.startswith(_JPEG_START):
        try:
            width, height = jpeg_size(header)
        except BadMessage as error:
            raise DjetError(f'{path}: {error}') from error
    elif header[:8] == PNG_START and header[12:16] == b'IHDR' and len(header) == 24:
        width, height = struct.unpack('>II', header[16:])
    else:
        raise DjetError(f'{path} is neither a PNG nor a JPEG image')
    if not 0 < width * height <= LARGEST_IMAGE_PIXELS:
        raise DjetError(f'{path} declares {width}x{height} pixels, at most '
                        f'{LARGEST_IMAGE_PIXELS} are decoded')
    return width, height
