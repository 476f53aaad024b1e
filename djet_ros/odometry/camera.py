"""
Camera model of a CameraInfo: camera matrix of the undistorted image, and undistortion.

Rectified images have the camera matrix in P and no distortion, raw ones K and D. Messages do not
say which they are; the parameter ``odometry.rectified`` does, and its value ``auto`` decides by
the name of the image topic, see ``is_rectified``. Images without distortion by that may have a
residual one, ``odometry.residual_k1``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
from djet_ros.core.types import Array
from djet_ros.odometry.images import BadMessage, Gray
from djet_ros.odometry.png import LARGEST_IMAGE_PIXELS
from djet_ros.odometry.sensor_defects import without_defects
import numpy as np
from numpy.typing import NDArray

# Numbers of coefficients of OpenCV's polynomial models.
_POLYNOMIAL = (4, 5, 8, 12, 14)
_MODELS = {'plumb_bob': _POLYNOMIAL, 'rational_polynomial': _POLYNOMIAL, 'equidistant': (4,)}

# Bounds in image sides of the focal length, and of the principal point's distance from the centre:
# beyond every lens, yet nothing computed with them overflows.
_SHORTEST, _LONGEST, _FARTHEST = 1e-2, 1e3, 10.0

# Least share of the undistorted image that the raw image has to show, and the points along each
# side by which it is measured.
_LEAST_SEEN, _GRID = 0.1, 16

# Remedies for a distortion that leaves less.
_CALIBRATE = 'recalibrate the camera'
_OF_PARAMETER = 'it is odometry.residual_k1; set that to what djet lens finds, or to 0'

# Directions from the optical axis, and points along each, to find where the distortion folds over.
_DIRECTIONS, _ALONG = 32, 1000

# Words in the name of an image topic that say whether it is rectified, and the names that
# image_transport and its plugins append.
_RECTIFIED, _NOT_RECTIFIED = {'rect', 'rectified'}, {'raw', 'unrect', 'unrectified'}
_TRANSPORTS = {'raw', 'compressed', 'compressedDepth', 'theora', 'zstd', 'ffmpeg', 'foxglove',
               'h264', 'h265', 'avif'}


class _Undistortion(NamedTuple):
    """Undistortion of images of a shape (H, W): OpenCV's maps, and the pixels without content."""

    shape: tuple[int, ...]
    maps: tuple[Any, Any]
    unseen: NDArray[np.bool_] | None


class Camera:
    """
    A camera, and the undistortion of its images to those of a pinhole camera.

    K: (3, 3) camera matrix of undistorted images; raw_K: (3, 3) of raw ones; size: (width, height)
    of raw images, or None if unknown.
    """

    def __init__(self, K: Array, D: Array, size: tuple[int, int] | None,
                 model: str = 'plumb_bob', pinhole: Array | None = None,
                 remedy: str = _CALIBRATE) -> None:
        """
        Create it from the camera matrix K (3, 3) of the raw images; raises BadMessage.

        D: distortion coefficients of OpenCV's model; pinhole: (3, 3) camera matrix of the
        undistorted images, by default K; remedy: text for a D that leaves hardly any image.
        """
        _check_camera(K)
        self.raw_K, self.K, self.size = K, K if pinhole is None else pinhole, size
        self._distortion = checked_distortion(model, D) if is_distorted(model, D) else None
        if self._distortion is not None and K[0, 1]:
            raise BadMessage('bad_calibration', (
                f'the skew {K[0, 1]:g} of images with a distortion is not known to OpenCV; '
                'calibrate the camera without it, or rectify its images'))
        self._remedy = remedy
        self._undistorting: _Undistortion | None = None

    @classmethod
    def from_info(cls, info: Any, rectified: bool, residual_k1: float = 0.0) -> Camera:
        """
        Return the camera of a CameraInfo; raises BadMessage.

        residual_k1: distortion of images that have none by it; an error if it has its own.
        """
        K = _numbers(info, 'k', 9).reshape(3, 3)
        projection = _numbers(info, 'p', 12).reshape(3, 4)[:, :3]
        D, size = _numbers(info, 'd', None), _image_size(info)
        if rectified:
            # Drivers without a calibration leave zeros; some rectifiers fill in only P, or only K.
            K = projection if projection.any() else K
        _check_camera(K)
        check_lens(K, _whole_size(info))
        model = info.distortion_model or 'plumb_bob'
        if rectified or not is_distorted(model, D):
            return cls(_of_image(K, info), np.array([residual_k1, 0, 0, 0, 0]), size,
                       remedy=_OF_PARAMETER)
        if residual_k1:
            raise BadMessage('bad_calibration', (
                f'odometry.residual_k1 is {residual_k1:g}, but the calibration has a distortion '
                f'of its own, {_words(D)}; set the parameter to 0 and add the residual to that, '
                'as lens.yaml of djet lens does, or set odometry.rectified to true if images are'))
        pinhole = K
        if projection.any() and not _turned(info):
            _check_camera(projection)
            check_lens(projection, _whole_size(info))
            pinhole = projection
        return cls(_of_image(K, info), D, size, model, _of_image(pinhole, info))

    def corrected(self, raw: Gray) -> Gray:
        """Return an image (H, W) `without_defects` and undistorted: what all poses are from."""
        return self.undistort(without_defects(raw))

    def undistort(self, gray: Gray) -> Gray:
        """Return an undistorted image (H, W); raises BadMessage if its size is another one."""
        height, width = gray.shape
        if self.size is not None and self.size != (width, height):
            raise BadMessage('size_mismatch', f'image is {width}x{height} pixels, CameraInfo '
                             f'(with its binning and ROI) is for {self.size[0]}x{self.size[1]}; '
                             'take the CameraInfo of this image topic (remap camera_info, '
                             '--info-topic), or calibrate at this size')
        if self.size is None:
            check_lens(self.raw_K, (width, height))
        if self._distortion is None:
            return gray
        # A black border would be an edge that moves with the camera.
        return np.asarray(cv2.remap(gray, *self._undistortion(gray.shape).maps, cv2.INTER_LINEAR,
                                    borderMode=cv2.BORDER_REPLICATE), dtype=np.uint8)

    def unseen(self, shape: tuple[int, ...]) -> NDArray[np.bool_] | None:
        """
        Return the pixels (H, W) bool of an undistorted image that the raw image does not show.

        They are outside the raw image, or beyond the radius at which the distortion folds over and
        repeats what is nearer to the axis. None if there are none.
        """
        return None if self._distortion is None else self._undistortion(shape).unseen

    @property
    def k1(self) -> float:
        """Return the first coefficient of the radial distortion."""
        return float(self.distortion[1][0])

    @property
    def distortion(self) -> tuple[str, Array]:
        """Return the model and its coefficients, zeros if the images have no distortion."""
        return self._distortion or ('plumb_bob', np.zeros(5))

    def pixels(self, places: Array, k1: float) -> tuple[Array, Array]:
        """
        Project points X/Z, Y/Z (N, 2) to raw images, with another coefficient k1.

        Returns pixels (N, 2), and their Jacobians by the points (N, 2, 2).
        """
        model, D = self.distortion
        points = np.column_stack([places, np.ones(len(places))])[:, None]
        project, first = ((cv2.fisheye.projectPoints, 11) if model == 'equidistant'
                          else (cv2.projectPoints, 3))
        pixels, slopes = project(points, np.zeros(3), np.zeros(3), self.raw_K,
                                 np.append(k1, D[1:]))
        # At a depth of one the Jacobian by the camera's translation is that by the point.
        return (np.asarray(pixels, float).reshape(-1, 2),
                np.asarray(slopes[:, first:first + 2], float).reshape(-1, 2, 2))

    def _undistortion(self, shape: tuple[int, ...]) -> _Undistortion:
        """Return the undistortion of images (H, W); cached, as sizes rarely change."""
        if self._undistorting is None or self._undistorting.shape != shape:
            height, width = shape
            model, D = self.distortion
            folded = self._folded(width, height)
            self._check_distortion(folded)
            module = cv2.fisheye if model == 'equidistant' else cv2
            maps, (x, y) = (module.initUndistortRectifyMap(
                self.raw_K, D, np.eye(3), self.K, (width, height), kind)
                for kind in (cv2.CV_16SC2, cv2.CV_32FC1))
            # An image reaches half a pixel beyond the centres of its outermost pixels.
            seen = (np.abs(x - (width - 1) / 2) <= width / 2) \
                & (np.abs(y - (height - 1) / 2) <= height / 2)
            unseen = ~seen | folded
            unseen.setflags(write=False)  # all frames share it
            self._undistorting = _Undistortion(shape, maps, unseen if unseen.any() else None)
        return self._undistorting

    def _folded(self, width: int, height: int) -> NDArray[np.bool_]:
        """
        Return the pixels (H, W) bool at or beyond the radius at which the distortion folds over.

        There its Jacobian is singular. Tangential coefficients make that curve no exact circle;
        its smallest radius counts.
        """
        # Columns and rows are added: the rays of all pixels of large images take gigabytes.
        x, y = np.arange(width), np.arange(height)[:, None]
        away = np.hypot(*(by_x * x + (by_y * y + offset)
                          for by_x, by_y, offset in np.linalg.inv(self.K)[:2]))
        step = away.max() / _ALONG
        radii = step * np.arange(1, _ALONG + 1)
        angles = 2 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
        places = radii[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        # Overflow counts as folded.
        with np.errstate(all='ignore'):
            _, slopes = self.pixels(places.reshape(-1, 2), self.k1)
            unfolded = np.linalg.det(slopes).reshape(_ALONG, _DIRECTIONS) > 0
        folded = np.flatnonzero(~unfolded.all(1))
        fold = folded[0] * step if len(folded) else np.inf
        return np.asarray(away > fold)

    def _check_distortion(self, folded: NDArray[np.bool_]) -> None:
        """Raise BadMessage if hardly any of the undistorted image is in the raw image."""
        height, width = folded.shape
        x, y = np.meshgrid(*((np.arange(_GRID) + 0.5) * side / _GRID for side in (width, height)))
        rays = np.linalg.inv(self.K) @ np.stack([x.ravel(), y.ravel(), np.ones(x.size)])
        # Overflow counts as not seen.
        with np.errstate(all='ignore'):
            pixels, _ = self.pixels(np.asarray(rays[:2].T), self.k1)
        inside = ((pixels >= 0) & (pixels < (width, height))).all(axis=1)
        inside &= ~folded[y.astype(int), x.astype(int)].ravel()
        if inside.mean() < _LEAST_SEEN:
            raise BadMessage('bad_calibration', (
                f'the distortion {_words(self.distortion[1])} ({self.distortion[0]}) leaves '
                f'{inside.mean():.0%} of an image of {width}x{height} pixels; '
                f'{self._remedy}'))


def is_rectified(rectified: str, image_topic: str) -> bool:
    """
    Return whether images are rectified, by the parameter or, for 'auto', by the topic.

    The words of its last name decide (image_rect_color), or of the one before (rect/image), after
    suffixes of transports (image_rect/compressed) are removed.
    """
    if rectified != 'auto':
        return rectified == 'true'
    names = [name for name in image_topic.split('/') if name]
    while names and names[-1] in _TRANSPORTS:
        names.pop()
    for words in (set(name.split('_')) for name in reversed(names[-2:])):
        if words & (_RECTIFIED | _NOT_RECTIFIED):
            # Drivers have image_rect_raw, which is rectified.
            return bool(words & _RECTIFIED)
    return False


def is_distorted(model: str, D: Array) -> bool:
    """
    Return whether coefficients D of a model make an image other than a pinhole's.

    For a fisheye zeros do, too: r = f theta, not r = f tan(theta).
    """
    return bool(D.any()) or (model == 'equidistant' and len(D) > 0)


def same_camera(a: Any, b: Any) -> bool:
    """Return whether two CameraInfo are equal, but for their headers."""
    return _identity(a) == _identity(b)


def _identity(info: Any) -> tuple[object, ...]:
    roi = info.roi
    return (info.width, info.height, info.distortion_model, *map(tuple, (info.k, info.d, info.r,
            info.p)), info.binning_x, info.binning_y, roi.x_offset, roi.y_offset, roi.width,
            roi.height)


def _numbers(info: Any, name: str, count: int | None) -> Array:
    values = np.asarray(getattr(info, name), dtype=np.float64).ravel()
    if count is not None and len(values) != count:
        raise BadMessage('bad_calibration',
                         f'CameraInfo {name} has {len(values)} numbers, it needs {count}')
    if not np.isfinite(values).all():
        raise BadMessage('bad_calibration', f'CameraInfo {name} has a number that is not finite')
    return values


def _turned(info: Any) -> bool:
    """Return whether there is a rectifying rotation, which would rotate poses off the camera."""
    R = _numbers(info, 'r', 9).reshape(3, 3)
    return bool(R.any()) and not np.allclose(R, np.eye(3), atol=1e-6)


def _check_camera(K: Array) -> None:
    if not K.any():
        raise BadMessage('uncalibrated', 'CameraInfo k is all zeros: the camera is not '
                         'calibrated; calibrate it, or set its camera_info_url')
    if not (K[0, 0] > 0 and K[1, 1] > 0 and K[2].tolist() == [0, 0, 1]):
        raise BadMessage('bad_calibration', 'CameraInfo holds no camera matrix: focal lengths '
                         f'{K[0, 0]:g} and {K[1, 1]:g}, last row {K[2].tolist()}')


def check_lens(K: Array, size: tuple[int, int]) -> None:
    """
    Raise BadMessage if no lens has a camera matrix (3, 3) with images of (width, height) pixels.

    A size of zeros is unknown, and not checked.
    """
    side = max(size)
    if not side:
        return
    focal, offset = np.diag(K)[:2], K[:2, 2] - np.array(size) / 2
    if not ((_SHORTEST * side <= focal) & (focal <= _LONGEST * side)).all():
        raise BadMessage('bad_calibration', (
            f'no lens has focal lengths of {focal[0]:g} and {focal[1]:g} pixels for an image of '
            f'{size[0]}x{size[1]}; {_CALIBRATE}'))
    if not (np.abs(offset) <= _FARTHEST * side).all():
        raise BadMessage('bad_calibration', (
            f'the principal point {K[0, 2]:g}, {K[1, 2]:g} is far off an image of '
            f'{size[0]}x{size[1]} pixels; {_CALIBRATE}'))
    if abs(K[0, 1]) > focal[0] or K[1, 0]:
        raise BadMessage('bad_calibration', (
            f'no sensor has the skew {K[0, 1]:g}, {K[1, 0]:g}; {_CALIBRATE}'))


def checked_distortion(model: str, D: Array) -> tuple[str, Array]:
    """Return a model and its coefficients; raise BadMessage if it has not so many."""
    counts: Sequence[int] = _MODELS.get(model, ())
    if len(D) not in counts:
        raise BadMessage('unknown_distortion', f"distortion model '{model:.40}' with {len(D)} "
                         f'numbers is not known; {", ".join(_MODELS)} are')
    return model, D


def _words(D: Array) -> str:
    """Return coefficients as text."""
    return ' '.join(f'{value:g}' for value in D)


def _binning(info: Any) -> tuple[int, int]:
    """Return the binning in x and y; zero means one."""
    return max(int(info.binning_x), 1), max(int(info.binning_y), 1)


def _whole_size(info: Any) -> tuple[int, int]:
    """Return the size at full resolution, to which the matrices refer; zeros if unknown."""
    roi = info.roi
    return (max(int(info.width), int(roi.x_offset) + int(roi.width)),
            max(int(info.height), int(roi.y_offset) + int(roi.height)))


def _image_size(info: Any) -> tuple[int, int] | None:
    """Return the size of the images: of the ROI (zeros: everything), divided by the binning."""
    binning_x, binning_y = _binning(info)
    whole = not (info.roi.width and info.roi.height)
    width, height = ((info.width, info.height) if whole
                     else (info.roi.width, info.roi.height))
    size = int(width) // binning_x, int(height) // binning_y
    if size[0] * size[1] > LARGEST_IMAGE_PIXELS:
        raise BadMessage('too_large', f'CameraInfo is for {size[0]}x{size[1]} pixels, at most '
                         f'{LARGEST_IMAGE_PIXELS} are taken')
    return size if all(size) else None


def _of_image(K: Array, info: Any) -> Array:
    """
    Return the camera matrix of the image, from that at full resolution.

    First the ROI is subtracted, in pixels of full resolution, then the binning divides, as in
    image_geometry.
    """
    result = K.copy()
    result[0, 2] -= info.roi.x_offset
    result[1, 2] -= info.roi.y_offset
    binning_x, binning_y = _binning(info)
    result[0] /= binning_x
    result[1] /= binning_y
    return result
