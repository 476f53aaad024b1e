"""All parameters, in sections: odometry, SLAM and ROS; the estimator's are in core."""

from __future__ import annotations

from dataclasses import dataclass, field
import math

from djet_ros.core.estimator_config import EstimatorConfig, PRESETS
from djet_ros.core.parameter import check, documented, parameter

NODE_NAME, GRAPH_NAME = 'vo_node', 'pose_graph_node'


def _without_slashes(config: OdometryConfig | SlamConfig, *frames: str) -> None:
    """Strip the leading slash of ROS 1 frame ids, which tf2 rejects."""
    for frame in frames:
        object.__setattr__(config, frame, getattr(config, frame).lstrip('/'))


def _require_name(config: OdometryConfig | SlamConfig, frame: str) -> None:
    """Raise ValueError if a frame without which nothing is published has no name."""
    if not getattr(config, frame):
        raise ValueError(f"{frame} is ''; name a frame")


def _words(numbers: str) -> list[str]:
    """Split a string of several numbers, with or without list brackets and commas."""
    return numbers.strip().removeprefix('[').removesuffix(']').replace(',', ' ').split()


@documented
@dataclass(frozen=True)
class OdometryConfig:
    """Parameters of the odometry. Raises ValueError on a value outside its described range."""

    max_gap: float = parameter(
        1.0, 'longest time between two frames, in seconds, over which a relative pose is '
        'estimated; after a longer gap tracking restarts at the last pose',
        minimum=1e-3, maximum=3600.0)
    max_backwards: float = parameter(
        0.5, 'an image at most this many seconds older than the newest one is late and is '
        'dropped; stamps that go back further, as when a bag loops, or that stay back reset the '
        'odometry to the origin', minimum=0.0, maximum=3600.0)
    max_lost: int = parameter(
        3, 'consecutive failed pairs after which the newest frame replaces the reference frame',
        minimum=1, maximum=1000)
    standstill: float = parameter(
        0.3, 'displacement in pixels below which a match is still; the camera is stationary, and '
        'the reference frame is kept, if most matches are, or those that stood before',
        minimum=0.0, maximum=10.0)
    scale: str = parameter(
        'structure', 'source of the translation length: structure (relative scale, propagated by '
        'landmarks that frames share), none (unit length), constant (scale_value), speed (speed '
        'topics), camera_height (known height above the ground plane seen in the images), guess '
        '(another odometry, see guess), ground_truth (offline only)',
        choices=('structure', 'none', 'constant', 'speed', 'camera_height', 'guess',
                 'ground_truth'))
    scale_value: float = parameter(
        0.0, 'length of each translation in metres, required by scale constant; 0: not set',
        minimum=0.0, maximum=1e6)
    scale_uncertainty: float = parameter(
        0.05, 'relative standard deviation of a known length; for scale camera_height that of the '
        'height, to which the uncertainty of the measurement in the images is added',
        minimum=1e-6, maximum=10.0)
    camera_height: float = parameter(
        0.0, 'height of the camera above flat ground in metres, required by scale camera_height; '
        '0: not set', minimum=0.0, maximum=1000.0)
    camera_pitch: float = parameter(
        0.0, 'downward pitch of the camera in degrees, known to within 2, for scale '
        'camera_height; the camera must have no roll', minimum=-30.0, maximum=80.0)
    imu: bool = parameter(
        False, 'whether to use the gyro of an IMU (topic imu): it is fused with the rotation '
        'estimated from the images, and replaces it where the images do not determine one')
    imu_rotation: str = parameter(
        '', 'rotation from the axes of the IMU to those of the camera (optical: z forward, x '
        "right, y down), as a quaternion 'x y z w'; empty: looked up on tf", numbers=True)
    imu_offset: float = parameter(
        0.0, "seconds by which the IMU's clock is ahead of the images' (t_imu = t_image + "
        'offset); djet lab imu-offset estimates it', minimum=-10.0, maximum=10.0)
    imu_noise: float = parameter(
        2e-4, 'white noise density of the gyro, in rad/s/√Hz, as given in its data sheet',
        minimum=1e-8, maximum=1.0)
    imu_bias_walk: float = parameter(
        2e-5, 'random walk of the gyro bias, in rad/s²/√Hz', minimum=0.0, maximum=1.0)
    guess: bool = parameter(
        False, 'whether to use the motion of another odometry (topic guess, nav_msgs/Odometry) as '
        'an initial pose; its length is used only with scale guess')
    guess_frame: str = parameter(
        '', 'fixed frame on tf, such as odom: the guess is then the motion of the camera frame in '
        'it, through all transforms between them on /tf and /tf_static; empty: topic guess')
    mask: bool = parameter(
        False, 'whether each image waits briefly for its mask (topic mask, mono8, same stamp); '
        'pixels below 128 are excluded')
    mask_file: str = parameter(
        '', 'PNG or JPEG file with the size of the images as received; pixels below 128 are '
        'excluded, such as those of the bonnet of the vehicle')
    rectified: str = parameter(
        'auto', 'whether the images are rectified: true (camera matrix from P), false (K and D), '
        'auto (true if the last part of the image topic, or otherwise the part before it, has the '
        "word 'rect' or 'rectified', such as image_rect_color and rect/image; else false)",
        choices=('auto', 'true', 'false'))
    residual_k1: float = parameter(
        0.0, 'radial distortion (k1 as in CameraInfo) that remains in images whose calibration '
        'has no distortion, such as rectified ones; it is corrected; djet lens estimates it',
        minimum=-1e3, maximum=1e3)
    gray_range: str = parameter(
        '0 65535', "'low high': values of 16-bit images that are mapped to black and white, "
        'linear in between; 0 4095 for a 12-bit camera; 8-bit images are not changed',
        numbers=True)
    frame_convention: str = parameter(
        'body', 'axes of all poses in messages, by REP 103: body (x forward, y left, z up) or '
        'optical (z forward, x right, y down)',
        choices=('body', 'optical'))
    camera_frame: str = parameter(
        '', 'frame id of the camera in messages, with the axes of frame_convention; empty: '
        'derived from the frame_id of the images (optical: unchanged; body: camera_optical_frame '
        'becomes camera_frame, and camera becomes camera_body)')
    odom_frame: str = parameter('odom', 'frame id in which the integrated pose is published')
    base_frame: str = parameter(
        '', 'frame id of the vehicle that carries the camera, such as base_link: its pose and '
        "velocity (x forward, y left, z up) are published instead of the camera's, with the "
        'mounting from tf, or from /tf_static of a recording; empty: pose of the camera')

    def __post_init__(self) -> None:
        """Refuse values outside their described range."""
        check(self)
        _without_slashes(self, 'guess_frame', 'camera_frame', 'odom_frame', 'base_frame')
        _require_name(self, 'odom_frame')
        self.imu_quaternion()
        self.gray_limits()

    def imu_quaternion(self) -> tuple[float, ...] | None:
        """Return imu_rotation as a unit quaternion (x, y, z, w), or None if tf provides it."""
        if not self.imu_rotation.strip():
            return None
        try:
            values = [float(word) for word in _words(self.imu_rotation)]
        except ValueError:
            values = []
        length = math.hypot(*values)
        if len(values) != 4 or not 0.9 < length < 1.1:
            raise ValueError(f"imu_rotation is '{self.imu_rotation:.80}'; give a quaternion "
                             "'x y z w' of length 1, or leave it empty to look it up on tf")
        return tuple(value / length for value in values)

    @property
    def guess_by_topic(self) -> bool:
        """Whether another odometry is used, from topic guess."""
        return self._uses_guess and not self.guess_frame

    @property
    def guess_by_tf(self) -> bool:
        """Whether another odometry is used, from guess_frame on tf."""
        return self._uses_guess and bool(self.guess_frame)

    @property
    def _uses_guess(self) -> bool:
        return self.guess or self.scale == 'guess'

    def gray_limits(self) -> tuple[int, int]:
        """Return gray_range as (low, high)."""
        words = _words(self.gray_range)
        values = [int(word) for word in words if word.isdecimal() and len(word) < 6]
        if len(values) != len(words) or len(values) != 2 or not values[0] < values[1] < 65536:
            raise ValueError(f"gray_range is '{self.gray_range:.80}'; give 'low high', whole "
                             'numbers from 0 to 65535 such as 0 4095')
        return values[0], values[1]


@dataclass(frozen=True)
class SlamConfig:
    """Parameters of loop closure, offline and live. Raises ValueError like OdometryConfig."""

    keyframes: str = parameter(
        'odometry', 'keyframe selection: odometry (the keyframes that propagate its scale; by '
        'distance if it has none) or distance (by keyframe_distance and keyframe_turn)',
        choices=('odometry', 'distance'))
    keyframe_distance: float = parameter(
        2.0, 'translation after which a frame becomes a keyframe, in metres or in the relative '
        'unit of the trajectory', minimum=1e-6, maximum=1e6)
    keyframe_turn: float = parameter(
        10.0, 'rotation after which a frame becomes a keyframe, in degrees',
        minimum=0.1, maximum=180)
    links: int = parameter(
        1, 'number of preceding keyframes with an edge to each keyframe: 1 is the edge of the '
        'odometry alone, each further one is a two-view estimate', minimum=1, maximum=10)
    length_noise: float = parameter(
        0.02, 'relative standard deviation of the independent error of each known length; the '
        'rest of odometry.scale_uncertainty is an error common to all lengths (wheel radius, '
        'camera height), which loop closure leaves as it is', minimum=1e-6, maximum=10.0)
    loop_gap: float = parameter(
        20.0, 'minimum time between the two keyframes of a loop, in seconds',
        minimum=0.0, maximum=1e6)
    loop_votes: int = parameter(
        20, 'minimum number of features with a similar descriptor for a loop to be verified '
        'geometrically; a very large number disables loop closure',
        minimum=1, maximum=1_000_000)
    loop_candidates: int = parameter(
        2, 'number of most similar keyframes that are verified for each keyframe',
        minimum=1, maximum=100)
    loop_inliers: int = parameter(
        60, 'minimum number of inliers of a loop or link', minimum=8, maximum=10000)
    loop_share: float = parameter(
        0.5, 'minimum inlier ratio of a loop or link', minimum=0.05, maximum=1.0)
    max_keyframes: int = parameter(
        1000, 'maximum number of keyframes kept, with their images; beyond it the oldest is '
        'removed and its edges are transferred to the next one', minimum=2, maximum=1_000_000)
    image_buffer: int = parameter(
        50, 'number of newest images kept until their odometry arrives',
        minimum=1, maximum=10_000)
    optimise_period: float = parameter(
        2.0, 'minimum time between two optimisations while new loops are found, in seconds',
        minimum=0.0, maximum=3600.0)
    path_period: float = parameter(
        1.0, 'minimum time between two path messages, in seconds', minimum=0.0, maximum=3600.0)
    map_frame: str = parameter('map', 'frame id in which the optimised poses are published')
    publish_tf: bool = parameter(
        True, 'whether to publish map_frame -> odom_frame on tf')

    def __post_init__(self) -> None:
        """Refuse values outside their described range."""
        check(self)
        _without_slashes(self, 'map_frame')
        _require_name(self, 'map_frame')


@dataclass(frozen=True)
class NodeConfig:
    """Parameters of the ROS interface. Raises ValueError like OdometryConfig."""

    image_transport: str = parameter(
        'raw', 'image topic: raw (image) or compressed (image/compressed, JPEG or PNG)',
        choices=('raw', 'compressed'))
    qos_reliability: str = parameter(
        'best_effort', 'reliability of the subscriptions; best_effort is compatible with every '
        'publisher (queue_policy every always subscribes reliably)',
        choices=('best_effort', 'reliable'))
    qos_depth: int = parameter(
        5, 'history depth of the subscriptions in the middleware, in messages (queue_policy every '
        'sets its own)', minimum=1, maximum=1000)
    queue_policy: str = parameter(
        'latest', 'latest (under load the oldest images are dropped and counted) or every (no '
        'image is dropped until 500 MB are waiting; for a bag played into the node)',
        choices=('latest', 'every'))
    queue_size: int = parameter(
        2, 'images that may wait with queue_policy latest; beyond it the oldest is dropped',
        minimum=1, maximum=1000)
    max_rate: float = parameter(
        0.0, 'maximum rate in Hz, by image stamps, at which images are processed; the others of a '
        'faster camera are skipped before they are queued, and counted; 0: no limit',
        minimum=0.0, maximum=1000.0)
    publish_tf: bool = parameter(
        False, 'whether to publish the integrated pose on tf: odom_frame -> camera frame, or '
        'odom_frame -> base_frame if that is set')
    publish_path: bool = parameter(
        False, 'whether to publish the integrated poses as a nav_msgs/Path')
    path_period: float = parameter(
        1.0, 'minimum time between two path messages, in seconds', minimum=0.0, maximum=3600.0)
    path_length: int = parameter(
        5000, 'number of newest poses in a path message', minimum=1, maximum=1_000_000)

    def __post_init__(self) -> None:
        """Refuse values outside their described range."""
        check(self)


@dataclass(frozen=True)
class Config:
    """
    All parameters; the fields are the sections, which prefix the flat names.

    ``preset`` names the preset on which the values of ``estimator`` are based; ``with_values``
    keeps the two consistent.
    """

    preset: str = parameter(
        'best', 'default values of the estimator: best (all improvements), fast (fewer matches, '
        'about 0.8 of the time, for small computers) or paper (the algorithm as published); '
        'it is overridden by estimator parameters in the same file and by flags; as a flag it '
        'overrides those of a file', choices=PRESETS)
    estimator: EstimatorConfig = field(default_factory=EstimatorConfig)
    odometry: OdometryConfig = field(default_factory=OdometryConfig)
    slam: SlamConfig = field(default_factory=SlamConfig)
    ros: NodeConfig = field(default_factory=NodeConfig)

    def __post_init__(self) -> None:
        """Refuse an unknown preset, and a guess_frame that this odometry publishes itself."""
        check(self)
        if self.ros.publish_tf and self.odometry.guess_frame == self.odometry.odom_frame:
            raise ValueError(f"odometry.guess_frame is '{self.odometry.guess_frame}', the frame "
                             'in which this odometry publishes its own pose on tf; set another '
                             'odometry.odom_frame, or ros.publish_tf to false')


SECTIONS = ('estimator', 'odometry', 'slam', 'ros')

# Parameters of section slam that apply offline; the others are for live use.
SLAM_OFFLINE = tuple(f'slam.{name}' for name in (
    'keyframes', 'keyframe_distance', 'keyframe_turn', 'links', 'length_noise', 'loop_gap',
    'loop_votes', 'loop_candidates', 'loop_inliers', 'loop_share'))
