"""The camera of a folder of images, from its calibration file in one of several formats."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from djet_ros.config.safe_files import read_yaml
from djet_ros.core.types import Array
from djet_ros.errors import DjetError, one_line
from djet_ros.odometry.camera import checked_distortion
from djet_ros.odometry.images import BadMessage
from djet_ros.recordings.frame_sequence import Intrinsics
from djet_ros.recordings.kitti import check_rigid
from djet_ros.recordings.text import lines, numbers
import numpy as np

# Files beside the images: of numbers alone, and as the camera_calibration of ROS writes it.
PLAIN, YAML = 'calibration.txt', 'calibration.yaml'

# Numbers in the former: fx fy cx cy, with four or five coefficients of the distortion.
_PLAIN_COUNTS = 4, 8, 9

# Size (width, height) of the images that the published cameras of data sets are of.
_PUBLISHED_SIZE = 640, 480

# Names of OpenCV's two distortion models in ASL and Kalibr files, and numbers of coefficients.
_ASL_MODELS = {'radial-tangential': ('plumb_bob', (0, 4, 5)), 'radtan': ('plumb_bob', (4,)),
               'none': ('plumb_bob', (0,)), 'equidistant': ('equidistant', (4,))}

# What reading a value of another type, or of none, out of YAML may raise.
_UNFIT = (AttributeError, KeyError, OverflowError, TypeError, ValueError)


def camera_beside(folder: Path, size: tuple[int, int], published: Sequence[float] = ()
                  ) -> Intrinsics:
    """
    Return the camera of calibration.txt or calibration.yaml in a folder of images.

    The text is "fx fy cx cy [k1 k2 p1 p2 [k3]]", and so is `published`, which holds without any
    file, for images of _PUBLISHED_SIZE. The YAML is that of ROS's camera_calibration, or of
    OpenCV. size: (width, height) of the images. Raises DjetError if there is no camera, or an
    invalid one.
    """
    plain, ros = folder / PLAIN, folder / YAML
    if ros.exists():
        if plain.exists():
            raise DjetError(f'{folder} has {PLAIN} and {YAML}; remove the one that is not of '
                            'these images')
        return _of_yaml(ros, size)
    values = _of_text(plain) if plain.exists() else tuple(published)
    if published and not plain.exists() and size != _PUBLISHED_SIZE:
        raise DjetError(f'{folder}: the published camera is of {_words(_PUBLISHED_SIZE)} pixels, '
                        f"the images have {_words(size)}; write 'fx fy cx cy' of these into "
                        f'{plain}')
    if not values:
        raise DjetError(f"{folder} has no known camera; write 'fx fy cx cy', perhaps with "
                        f"'k1 k2 p1 p2 k3', into {plain}, or name a file of ROS's "
                        f'camera_calibration {YAML}')
    return Intrinsics(_matrix(values[:4], values[4:], plain), values[4:])


def _of_text(path: Path) -> tuple[float, ...]:
    """Return the numbers of a calibration.txt; more lines may be of another format."""
    must = ("it must hold one line 'fx fy cx cy' in pixels, perhaps with 'k1 k2 p1 p2' or 'k1 k2 "
            "p1 p2 k3'")
    try:
        rows = [numbers(text) for _, text in lines(path)]
    except ValueError as error:
        raise DjetError(f'{path}: {error}; {must}') from error
    if len(rows) != 1 or len(rows[0]) not in _PLAIN_COUNTS:
        where = 'one line' if len(rows) == 1 else f'{len(rows)} lines'
        raise DjetError(f'{path} holds {sum(map(len, rows))} numbers in {where}; {must}')
    return tuple(rows[0])


def _of_yaml(path: Path, size: tuple[int, int]) -> Intrinsics:
    content = read_yaml(path)
    try:
        matrix = np.array(content['camera_matrix']['data'], dtype=np.float64).reshape(9)
        distortion = np.array(content['distortion_coefficients']['data'], np.float64).ravel()
        # OpenCV's sample does not name the model, but says whether it is that of a fisheye.
        unnamed = 'equidistant' if content.get('fisheye_model') else 'plumb_bob'
        model = str(content.get('distortion_model', unnamed))
        calibrated = int(content['image_width']), int(content['image_height'])
    except _UNFIT as error:
        raise DjetError(f'{path} is no calibration of ROS (camera_matrix, distortion_coefficients,'
                        f' image_width, image_height): {one_line(error)}') from error
    _check_size(path, calibrated, size)
    fx, skew, cx, *_, fy, cy = matrix[:6]
    if [skew, *matrix[[3, 6, 7, 8]]] != [0, 0, 0, 0, 1]:
        raise DjetError(f'{path}: camera_matrix is {one_line(matrix.tolist())}; it must be fx 0 '
                        'cx 0 fy cy 0 0 1')
    if len(distortion):
        try:
            checked_distortion(model, distortion)
        except BadMessage as error:
            raise DjetError(f'{path}: {error}') from error
    return Intrinsics(_matrix((fx, fy, cx, cy), distortion.tolist(), path), distortion.tolist(),
                      model)


def _check_size(path: Path, calibrated: tuple[int, ...], size: tuple[int, int]) -> None:
    """Raise DjetError if a calibration is of another size (width, height) than the images."""
    if calibrated != size:
        raise DjetError(f'{path} is of {_words(calibrated)} pixels, the images have '
                        f'{_words(size)}; calibrate at this size')


def _words(size: tuple[int, ...]) -> str:
    return one_line('x'.join(map(str, size)), 40)


def asl_camera(path: Path, size: tuple[int, int]) -> tuple[Intrinsics, Array]:
    """
    Return the camera of a sensor.yaml, and its pose (4, 4) in the body.

    size: (width, height) of the images.
    """
    sensor, camera_in_body = _asl_sensor(path)
    try:
        named = sensor.get('distortion_model', 'radial-tangential')
        intrinsics = [float(value) for value in sensor['intrinsics']]
        distortion = [float(value) for value in sensor.get('distortion_coefficients', [])]
        calibrated = _resolution(sensor, size)
    except _UNFIT as error:
        raise DjetError(f'{path} is no ASL camera description (intrinsics, resolution): '
                        f'{one_line(error)}') from error
    _check_size(path, calibrated, size)
    return _with_model(path, named, intrinsics, distortion), camera_in_body


def asl_mounting(path: Path) -> Array:
    """Return the pose (4, 4) of a sensor in the body, from its sensor.yaml."""
    return _asl_sensor(path)[1]


def _asl_sensor(path: Path) -> tuple[dict[str, Any], Array]:
    """Return a sensor.yaml, and the pose (4, 4) of the sensor in the body."""
    sensor = read_yaml(path)
    try:
        sensor_in_body = _rigid(sensor['T_BS']['data'])
    except _UNFIT as error:
        raise DjetError(f'{path} is no ASL sensor description: it has no T_BS of 16 numbers; '
                        'replace the file, which may be truncated') from error
    check_rigid(sensor_in_body[None], path)
    return sensor, sensor_in_body


def kalibr_camera(path: Path, size: tuple[int, int]) -> tuple[Intrinsics, Array]:
    """Do the same for cam0 of a Kalibr camera chain, whose T_cam_imu is the inverse pose."""
    chain = read_yaml(path)
    try:
        camera = chain['cam0']
        named = camera['distortion_model']
        intrinsics = [float(value) for value in camera['intrinsics']]
        distortion = [float(value) for value in camera['distortion_coeffs']]
        body_in_camera = _rigid(camera['T_cam_imu'])
        calibrated = _resolution(camera, size)
    except _UNFIT as error:
        raise DjetError(f'{path} is no Kalibr camera chain (cam0: intrinsics, T_cam_imu, '
                        f'resolution): {one_line(error)}') from error
    _check_size(path, calibrated, size)
    check_rigid(body_in_camera[None], path)
    camera_in_body = np.asarray(np.linalg.inv(body_in_camera))
    return _with_model(path, named, intrinsics, distortion), camera_in_body


def _resolution(camera: dict[str, Any], size: tuple[int, int]) -> tuple[int, ...]:
    """Return the size of which the camera of a file is; that of the images if it has none."""
    return tuple(int(side) for side in camera.get('resolution', size))


def _rigid(values: object) -> Array:
    return np.array(values, dtype=np.float64).reshape(4, 4)


def _with_model(path: Path, named: object, intrinsics: Sequence[float],
                distortion: Sequence[float]) -> Intrinsics:
    """Return the camera of a file of ASL or Kalibr, with OpenCV's name of its model."""
    model, counts = _ASL_MODELS.get(str(named), ('', ()))
    if len(intrinsics) != 4 or len(distortion) not in counts:
        raise DjetError(f"{path}: distortion model '{one_line(named, 40)}' with "
                        f'{len(intrinsics)} intrinsics and {len(distortion)} coefficients; '
                        'supported are radial-tangential and equidistant, with 4 and 4')
    return Intrinsics(_matrix(intrinsics, distortion, path), distortion, model)


def _matrix(intrinsics: Sequence[float], distortion: Sequence[float], path: Path) -> Array:
    fx, fy, cx, cy = intrinsics
    if not (fx > 0 and fy > 0 and np.isfinite([*intrinsics, *distortion]).all()):
        raise DjetError(f'{path}: fx fy cx cy = {fx:g} {fy:g} {cx:g} {cy:g} is no valid camera; '
                        'focal lengths must be positive')
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
