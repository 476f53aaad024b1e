"""
Conversion of results to ROS messages and back, with all changes of frames and conventions.

Classes are looked up by type name, so that rclpy's and rosbags' messages have equal content.
rclpy's setters require plain float, int and str, covariances as a float64 array of 36, and
``array.array`` for long sequences; rosbags' writers require NumPy arrays. The values here suit
both.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from djet_ros.config.sections import NODE_NAME, OdometryConfig
from djet_ros.core.correction import AS_CALIBRATED, Correction
from djet_ros.core.geometry import rotation_log
from djet_ros.core.types import Array, STARTED, Status, TRACKED
from djet_ros.errors import DjetError
from djet_ros.odometry.mounting import pose_of_base, twist_of_base
from djet_ros.odometry.result import OdometryResult
from djet_ros.odometry.scale import Scale, UNKNOWN_LENGTH_SIGMA
from djet_ros.odometry.uncertainty import compose, of_inverse, rotated
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

MessageType = Callable[[str], Any]

# Added to all covariances: the first pose is exact, but filters invert its covariance.
LEAST_COVARIANCE = np.eye(6) * 1e-9

# The seconds of a stamp are an int32.
_LATEST_NS = 2**31 * 10**9 - 1

# Metres: longer than any drive on Earth, yet squares keep the precision of a vehicle's motion.
FARTHEST = 1e9

# The camera's axes in the body's: optical z is forward, x is right, y is down (REP 103).
OPTICAL_TO_BODY = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])

# Bounds of what a calibration can have been wrong about; that of k1 is for the longest lenses.
_LARGEST_CORRECTION = Correction(k1=1e3, focal=0.9, cx=10.0, cy=10.0)

# Values of 'keyframe' in the status of a frame; empty if no keyframes are chosen.
KEYFRAME_WORDS = {True: 'true', False: 'false', None: ''}
IS_KEYFRAME = {word: chosen for chosen, word in KEYFRAME_WORDS.items()}


def ns_of_time(time: Any) -> int:
    """Return the nanoseconds of a Time, at most the latest that a Time can hold."""
    # A sender's nanoseconds may exceed a second, and so the latest Time.
    return min(int(time.sec) * 10**9 + int(time.nanosec), _LATEST_NS)


def stamp_ns(header: Any) -> int:
    """Return the nanoseconds of a header's stamp; see ``ns_of_time``."""
    return ns_of_time(header.stamp)


def frame_of(header: Any) -> str:
    """Return the frame_id of a header, without the leading slash of ROS 1, which tf2 rejects."""
    return str(header.frame_id).lstrip('/')


def seconds_and_rest(stamp: int) -> tuple[int, int]:
    """Return whole seconds of a stamp in nanoseconds, and the remaining ones, as in a Time."""
    return divmod(int(stamp), 10**9)


def seconds_text(stamp: int) -> str:
    """Return a stamp in nanoseconds as text, in seconds with nine decimals."""
    seconds, rest = divmod(abs(int(stamp)), 10**9)
    return f'{"-" if stamp < 0 else ""}{seconds}.{rest:09d}'


def pose_of(message: Any) -> tuple[int, Array]:
    """
    Return stamp in ns and pose (4, 4) of a PoseStamped, an Odometry or a TransformStamped.

    The pose is NaN if it is invalid: far from a unit quaternion, or beyond FARTHEST.
    """
    if hasattr(message, 'transform'):
        position, orientation = message.transform.translation, message.transform.rotation
    else:
        pose = message.pose.pose if hasattr(message.pose, 'pose') else message.pose
        position, orientation = pose.position, pose.orientation
    quaternion = np.array([orientation.x, orientation.y, orientation.z, orientation.w])
    result = np.full((4, 4), np.nan)
    place = np.abs([position.x, position.y, position.z])
    if (place <= FARTHEST).all() and (np.abs(quaternion) < 2.0).all() \
            and 0.5 < np.linalg.norm(quaternion) < 2.0:
        result[:] = np.eye(4)
        result[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
        result[:3, 3] = position.x, position.y, position.z
    return stamp_ns(message.header), result


def in_convention(result: OdometryResult, convention: str) -> OdometryResult:
    """
    Return a result along optical or body axes; convention: 'optical' or 'body'.

    The body frame has its origin in the camera, with x forward, y left and z up (REP 103); both
    frames of every pose are rotated.
    """
    if convention == 'optical':
        return result
    C = np.eye(4)
    C[:3, :3] = OPTICAL_TO_BODY
    return replace(result, motion=C @ result.motion @ C.T, pose=C @ result.pose @ C.T,
                   motion_covariance=rotated(OPTICAL_TO_BODY, result.motion_covariance),
                   pose_covariance=rotated(OPTICAL_TO_BODY, result.pose_covariance),
                   since_covariance=rotated(OPTICAL_TO_BODY, result.since_covariance))


def camera_frame(config: OdometryConfig, image_frame: str) -> str:
    """
    Return the frame of the poses: the configured one, or the image's.

    With the body convention the image's optical frame is renamed: camera_optical_frame to
    camera_frame, any other name gets the suffix _body.
    """
    if config.camera_frame or config.frame_convention == 'optical' or not image_frame:
        return config.camera_frame or image_frame
    body = image_frame.replace('_optical', '', 1)
    return body if body != image_frame else f'{image_frame}_body'


def mounted_frame(config: OdometryConfig, image_frame: str) -> tuple[str, Array]:
    """
    Return the camera's frame to look up on base_frame, and the optical axes (4, 4) in it.

    It is the configured camera_frame, with axes of frame_convention, or the image's frame.
    """
    axes = np.eye(4)
    if config.camera_frame and config.frame_convention == 'body':
        axes[:3, :3] = OPTICAL_TO_BODY
    return config.camera_frame or image_frame, axes


class MessageFactory:
    """Makes messages from arrays; message_type: returns the class for a type name."""

    def __init__(self, message_type: MessageType) -> None:
        self._type = message_type

    def time(self, stamp: int) -> Any:
        """Return a Time from nanoseconds."""
        seconds, rest = seconds_and_rest(stamp)
        return self._type('builtin_interfaces/msg/Time')(sec=seconds, nanosec=rest)

    def header(self, stamp: int, frame_id: str) -> Any:
        """Return a Header with a stamp in nanoseconds."""
        return self._type('std_msgs/msg/Header')(stamp=self.time(stamp), frame_id=frame_id)

    def pose_in(self, stamp: int, frame: str, pose: Array) -> Any:
        """Return a PoseStamped of a pose (4, 4) in a frame."""
        return self._type('geometry_msgs/msg/PoseStamped')(
            header=self.header(stamp, frame), pose=self._pose(pose))

    def path(self, poses: Sequence[Any]) -> Any:
        """Return a Path of at least one PoseStamped."""
        return self._type('nav_msgs/msg/Path')(header=poses[-1].header, poses=list(poses))

    def frame(self, stamp: int, parent: str, child: str, pose: Array) -> Any:
        """Return a TFMessage with the pose (4, 4) of the frame child in parent."""
        return self._type('tf2_msgs/msg/TFMessage')(transforms=[
            self._type('geometry_msgs/msg/TransformStamped')(
                header=self.header(stamp, parent), child_frame_id=child,
                transform=self._type('geometry_msgs/msg/Transform')(
                    translation=self._vector(pose[:3, 3]),
                    rotation=self._pose(pose).orientation))])

    def camera_info(self, stamp: int, frame_id: str, K: Array, size: tuple[int, int],
                    D: Array | None = None, model: str = 'plumb_bob') -> Any:
        """Return a CameraInfo; size: (width, height); K (3, 3) also is P; D: (N,) or None."""
        roi = self._type('sensor_msgs/msg/RegionOfInterest')(
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        return self._type('sensor_msgs/msg/CameraInfo')(
            header=self.header(stamp, frame_id), height=size[1], width=size[0],
            distortion_model=model, d=np.zeros(5) if D is None else D, k=K.ravel(),
            r=np.eye(3).ravel(), p=np.hstack([K, np.zeros((3, 1))]).ravel(),
            binning_x=0, binning_y=0, roi=roi)

    def imu(self, stamp: int, frame_id: str, rate: Array, acceleration: Array) -> Any:
        """Return an Imu of a rate (3,) in rad/s and an acceleration (3,) in m/s² only."""
        unknown = np.array([-1.0, *[0.0] * 8])
        return self._type('sensor_msgs/msg/Imu')(
            header=self.header(stamp, frame_id),
            orientation=self._type('geometry_msgs/msg/Quaternion')(x=0.0, y=0.0, z=0.0, w=1.0),
            orientation_covariance=unknown, angular_velocity=self._vector(rate),
            angular_velocity_covariance=np.zeros(9),
            linear_acceleration=self._vector(acceleration),
            linear_acceleration_covariance=np.zeros(9))

    def picture(self, stamp: int, frame_id: str, pixels: NDArray[Any]) -> Any:
        """Return an Image of an array (H, W), mono8 or mono16, or (H, W, 3), bgr8."""
        image_type = self._type('sensor_msgs/msg/Image')
        height, width = pixels.shape[:2]
        gray = 'mono8' if pixels.dtype == np.uint8 else 'mono16'
        little = np.ascontiguousarray(pixels, pixels.dtype.newbyteorder('<'))
        data: Any = little.view(np.uint8).ravel()
        if hasattr(image_type, 'get_fields_and_field_types'):
            # rclpy checks a NumPy array byte by byte, but not this one.
            data = array('B', data.tobytes())
        return image_type(
            header=self.header(stamp, frame_id), height=height, width=width,
            encoding=gray if pixels.ndim == 2 else 'bgr8', is_bigendian=0,
            step=len(data) // height, data=data)

    def compressed(self, stamp: int, frame_id: str, data: bytes) -> Any:
        """Return a CompressedImage of the bytes of a PNG or JPEG file."""
        return self._type('sensor_msgs/msg/CompressedImage')(
            header=self.header(stamp, frame_id), format='', data=np.frombuffer(data, np.uint8))

    def cloud(self, stamp: int, frame_id: str, places: Array) -> Any:
        """Return a PointCloud2 of points (M, 3), float32 x, y and z."""
        cloud_type = self._type('sensor_msgs/msg/PointCloud2')
        field = self._type('sensor_msgs/msg/PointField')
        data: Any = np.ascontiguousarray(places, '<f4').view(np.uint8).ravel()
        if hasattr(cloud_type, 'get_fields_and_field_types'):
            # As for images.
            data = array('B', data.tobytes())
        return cloud_type(
            header=self.header(stamp, frame_id), height=1, width=len(places),
            fields=[field(name=name, offset=4 * number, datatype=7, count=1)
                    for number, name in enumerate('xyz')],
            is_bigendian=False, point_step=12, row_step=12 * len(places), data=data,
            is_dense=True)

    def diagnostics(self, stamp: int, name: str, level: str, summary: str,
                    values: dict[str, str], hardware: str = '', frame_id: str = '') -> Any:
        """Return a DiagnosticArray of one status; level: 'OK', 'WARN' or 'ERROR'."""
        status_type = self._type('diagnostic_msgs/msg/DiagnosticStatus')
        pair = self._type('diagnostic_msgs/msg/KeyValue')
        # The class's constant has the type of its field: bytes or int.
        status = status_type(
            level=getattr(status_type, level), name=name, message=summary, hardware_id=hardware,
            values=[pair(key=key, value=value) for key, value in values.items()])
        return self._type('diagnostic_msgs/msg/DiagnosticArray')(
            header=self.header(stamp, frame_id), status=[status])

    def _pose(self, pose: Array) -> Any:
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True).tolist()
        position = _plain(pose[:3, 3])
        return self._type('geometry_msgs/msg/Pose')(
            position=self._type('geometry_msgs/msg/Point')(
                x=position[0], y=position[1], z=position[2]),
            orientation=self._type('geometry_msgs/msg/Quaternion')(x=x, y=y, z=z, w=w))

    def _vector(self, values: Array) -> Any:
        x, y, z = _plain(values)
        return self._type('geometry_msgs/msg/Vector3')(x=x, y=y, z=z)


def correction_values(correction: Correction) -> dict[str, str]:
    """Return a correction as exact texts, keyed by its fields."""
    return {name: repr(float(value)) for name, value in correction._asdict().items()}


def correction_of(values: Mapping[str, str | None]) -> Correction:
    """
    Return the correction in ``correction_values`` among other values; what is missing is zero.

    Raises ValueError if it is no correction of any camera.
    """
    correction = Correction(*(float(values.get(name) or 0.0) for name in Correction._fields))
    if not (np.abs(correction) <= _LARGEST_CORRECTION).all():
        raise ValueError(f'the correction of the camera is {tuple(correction)}')
    return correction


class FrameStatus(NamedTuple):
    """
    What a back end needs of a frame, other than its poses; see ``Messages.status``.

    reference_ns: stamp of the reference frame, or None; scale: unit of the translation's length;
    stationary: whether the camera stood still, so that the reference frame stays; keyframe:
    whether it is a keyframe of the odometry, None if that has none or does not say;
    camera_correction: of the calibration, with which its image was processed.
    """

    stamp_ns: int
    status: Status
    reference_ns: int | None
    scale: Scale
    stationary: bool
    keyframe: bool | None = None
    camera_correction: Correction = AS_CALIBRATED


def frame_status(message: Any) -> FrameStatus:
    """Return the content of a ``Messages.status``; raises DjetError if it is none."""
    stamp = stamp_ns(message.header)
    try:
        values = {pair.key: pair.value for pair in message.status[0].values}
        reference = values['reference_stamp_ns']
        return FrameStatus(stamp, Status(values['status']), int(reference) if reference else None,
                           Scale(values['length']), values['stationary'] == 'true',
                           IS_KEYFRAME[values.get('keyframe', '')], correction_of(values))
    except (IndexError, KeyError, ValueError) as error:
        raise DjetError(f'the status of {stamp} ns lacks something: {error}') from None


class Messages(MessageFactory):
    """
    Makes messages from results.

    node: name of the node; mounting: (4, 4) the camera in base_frame, required for poses in the
    odom frame if a base_frame is configured.
    """

    def __init__(self, message_type: MessageType, config: OdometryConfig,
                 node: str = NODE_NAME, mounting: Array | None = None) -> None:
        super().__init__(message_type)
        self._mounting = mounting
        self._config = config
        self._node = node

    def relative_pose(self, result: OdometryResult) -> Any:
        """Return a PoseStamped of the current camera in the reference camera."""
        turned, frame = self._turned(result)
        return self._type('geometry_msgs/msg/PoseStamped')(
            header=self.header(result.stamp_ns, frame), pose=self._pose(turned.motion))

    def relative_pose_cov(self, result: OdometryResult) -> Any:
        """Return a PoseWithCovarianceStamped of the same."""
        turned, frame = self._turned(result)
        return self._type('geometry_msgs/msg/PoseWithCovarianceStamped')(
            header=self.header(result.stamp_ns, frame),
            pose=self._pose_with_covariance(turned.motion, turned.motion_covariance))

    def status(self, result: OdometryResult) -> Any:
        """
        Return a DiagnosticArray of what the poses of a frame do not say.

        One status: message and 'status' are the Status; 'reference_stamp_ns' is the stamp of the
        reference frame of the relative poses with the same stamp, empty without one; 'length' is
        metric, relative (to the first step of the track) or unknown; 'stationary' is true or
        false; 'keyframe' too, or empty if none are chosen; 'k1', 'focal', 'cx' and 'cy' are the
        `Correction` of the calibration, estimated from landmarks, with which the image was
        processed. Level OK: there is a relative pose; WARN: the odometry (re)started here; ERROR:
        a bad pair.
        """
        tracked = result.status in TRACKED
        level = 'OK' if tracked else 'WARN' if result.status in STARTED else 'ERROR'
        frame = camera_frame(self._config, result.frame_id)
        return self.diagnostics(
            result.stamp_ns, f'{self._node}: relative pose', level, result.status.value, {
                'status': result.status.value,
                'reference_stamp_ns': str(result.previous_stamp_ns) if tracked else '',
                'length': (result.scale_kind if tracked else Scale.UNKNOWN).value,
                'stationary': str(result.stationary).lower(),
                'keyframe': KEYFRAME_WORDS[result.keyframe],
                **correction_values(result.camera_correction)}, result.frame_id, frame)

    def odometry(self, result: OdometryResult) -> Any:
        """
        Return an Odometry: the integrated pose, and the twist of the last pair.

        Both are of base_frame if it is configured, otherwise of the camera. The odom frame is its
        first pose: of the base, or of the camera along optical or body axes as configured.
        """
        pose, pose_covariance, frame = self._integrated(result)
        velocity, covariance = self._twist(result)
        return self._type('nav_msgs/msg/Odometry')(
            header=self.header(result.stamp_ns, self._config.odom_frame), child_frame_id=frame,
            pose=self._pose_with_covariance(pose, pose_covariance),
            twist=self._type('geometry_msgs/msg/TwistWithCovariance')(
                twist=self._type('geometry_msgs/msg/Twist')(
                    linear=self._vector(velocity[:3]), angular=self._vector(velocity[3:])),
                covariance=(covariance + LEAST_COVARIANCE).ravel()))

    def landmarks(self, result: OdometryResult, places: Array) -> Any:
        """Return a PointCloud2 of points (M, 3) along the optical axes of the images' frame."""
        return self.cloud(result.stamp_ns, result.frame_id, places)

    def pose_stamped(self, result: OdometryResult) -> Any:
        """Return a PoseStamped of the integrated pose in the odom frame."""
        pose, _, _ = self._integrated(result)
        return self.pose_in(result.stamp_ns, self._config.odom_frame, pose)

    def transform(self, result: OdometryResult) -> Any:
        """Return a TFMessage from the odom frame to the camera or to base_frame."""
        pose, _, frame = self._integrated(result)
        return self.frame(result.stamp_ns, self._config.odom_frame, frame, pose)

    def _integrated(self, result: OdometryResult) -> tuple[Array, Array, str]:
        """Return the pose (4, 4) in the odom frame, its covariance (6, 6), and the child frame."""
        if self._mounting is None:
            turned, frame = self._turned(result)
            return turned.pose, turned.pose_covariance, frame
        return *pose_of_base(result.pose, result.pose_covariance, self._mounting), \
            self._config.base_frame

    def _twist(self, result: OdometryResult) -> tuple[Array, Array]:
        if self._mounting is None:
            return twist(self._turned(result)[0])
        return twist_of_base(*twist(result), self._mounting)

    def _turned(self, result: OdometryResult) -> tuple[OdometryResult, str]:
        return (in_convention(result, self._config.frame_convention),
                camera_frame(self._config, result.frame_id))

    def _pose_with_covariance(self, pose: Array, covariance: Array) -> Any:
        return self._type('geometry_msgs/msg/PoseWithCovariance')(
            pose=self._pose(pose), covariance=(covariance + LEAST_COVARIANCE).ravel())


def twist(result: OdometryResult) -> tuple[Array, Array]:
    """
    Return the mean velocity (6,) of a pair along the current camera's axes, and its covariance.

    Linear in metres (or units) per second, angular in radians per second, over the time of the
    motion, which begins where a standstill ends. If no motion was estimated, the twist is zero
    with a large covariance.
    """
    if result.since_ns is None or result.status not in TRACKED:
        return unknown_twist()
    seconds = (result.stamp_ns - result.since_ns) * 1e-9
    R, p = result.motion[:3, :3], result.motion[:3, 3]
    velocity = np.concatenate([R.T @ p, rotation_log(R)]) / seconds
    covariance = compose(np.eye(4), result.since_covariance, result.motion,
                         result.motion_covariance)
    # The velocity R^T p is opposite to the translation of the inverse motion.
    return velocity, of_inverse(result.motion, covariance) / seconds**2


def unknown_twist() -> tuple[Array, Array]:
    """Return a zero twist (6,) with the covariance (6, 6) of an unknown one."""
    return np.zeros(6), np.eye(6) * UNKNOWN_LENGTH_SIGMA**2


def _plain(values: Array) -> list[float]:
    # Adding zero turns -0.0 into 0.0.
    return [float(value) + 0.0 for value in values]
