"""Recorded image sequences, and the image files beneath them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
import struct
from typing import Any

import cv2
from djet_ros.core.types import Array
from djet_ros.errors import DjetError
from djet_ros.odometry.camera import Camera
from djet_ros.odometry.png import LARGEST_IMAGE_PIXELS, PNG_START, whole_png
import numpy as np
from numpy.typing import NDArray


class FrameSequence:
    """
    Images of one moving camera in files, with stamps and perhaps ground truth.

    name: for people; K: (3, 3) camera matrix in pixels, pixel centres at integers; distortion:
    (5,) OpenCV's k1, k2, p1, p2 and k3, zeros where the images are rectified;
    size: (width, height); frame_paths: the files; stamps_ns: (N,) int64, strictly increasing,
    never 0; poses: (N, 4, 4), camera in the first known one's frame, rows of NaN where the ground
    truth does not reach, or None where there is none.
    """

    def __init__(self, name: str, images: ImageFiles, K: Array, stamps_ns: NDArray[np.int64],
                 poses: Array | None, distortion: Sequence[float] = ()) -> None:
        self.name = name
        self.K = K
        self.distortion = np.array([*distortion, *[0.0] * 5][:5])
        self.size, self.frame_paths = images.size, images.paths
        self.stamps_ns = stamps_ns
        self.poses = poses
        self._images = images
        self._camera = Camera(K, self.distortion, images.size)

    def __len__(self) -> int:
        """Count the frames."""
        return len(self.stamps_ns)

    def raw(self, index: int) -> NDArray[np.uint8]:
        """Gray pixels (H, W) of a frame as its file has them."""
        return self._images.gray(index)

    def image(self, index: int) -> NDArray[np.uint8]:
        """Gray pixels (H, W) of a frame without its distortion."""
        return self._camera.undistort(self.raw(index))


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
    PNG files of one size, decoded one at a time.

    The headers of all files are checked at once, so that a wrong file is found before the work
    begins and no declared size is believed before it was compared.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        """Check that all are PNG images of one size; DjetError names the first that isn't."""
        self.paths = tuple(paths)
        self.size = png_size(self.paths[0])
        for path in self.paths[1:]:
            if (size := png_size(path)) != self.size:
                raise DjetError(f'{path} is {size[0]}x{size[1]}, the images before it are '
                                f'{self.size[0]}x{self.size[1]}; one size is needed')

    def gray(self, index: int) -> NDArray[np.uint8]:
        """Image (H, W) uint8 of a file; colours become gray."""
        path = self.paths[index]
        image: NDArray[Any] | None = None
        try:
            data = path.read_bytes()
            if whole_png(data):
                image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
        except OSError as error:
            raise DjetError(f'{path} could not be read: {error.strerror}') from error
        except cv2.error:
            image = None
        if image is None or image.shape != self.size[::-1]:
            raise DjetError(f'{path} is a damaged PNG image; replace it or leave its frame out '
                            'with --start and --end')
        return np.asarray(image, dtype=np.uint8)


def png_size(path: Path) -> tuple[int, int]:
    """Give (width, height) from the header of a PNG file, else DjetError."""
    try:
        with path.open('rb') as file:
            header = file.read(24)
    except OSError as error:
        raise DjetError(f'{path} could not be read: {error.strerror}') from error
    if header[:8] != PNG_START or header[12:16] != b'IHDR' or len(header) < 24:
        raise DjetError(f'{path} is not a PNG image')
    width, height = struct.unpack('>II', header[16:])
    if not 0 < width * height <= LARGEST_IMAGE_PIXELS:
        raise DjetError(f'{path} declares {width}x{height} pixels, at most '
                        f'{LARGEST_IMAGE_PIXELS} are decoded')
    return width, height
