"""The sections of the one configuration: everything that somebody would turn."""

from __future__ import annotations

from dataclasses import dataclass, field
import math

from djet_ros.core.estimator_config import EstimatorConfig, PRESETS
from djet_ros.core.parameter import check, parameter

NODE_NAME, GRAPH_NAME = 'vo_node', 'pose_graph_node'


def _without_slashes(config: OdometryConfig | SlamConfig, *frames: str) -> None:
    """Write names of frames as tf2 has them; those of ROS 1 have a slash in front."""
    for frame in frames:
        object.__setattr__(config, frame, getattr(config, frame).lstrip('/'))


def _words(numbers: str) -> list[str]:
    """Cut a text of several numbers, which may be written as a list."""
    return numbers.strip().removeprefix('[').removesuffix(']').replace(',', ' ').split()


@dataclass(frozen=True)
class OdometryConfig:
    """How pairs become a trajectory. Raises ValueError on a value outside its description."""

    max_gap: float = parameter(
        1.0, 'seconds between two frames beyond which they are not related to one another',
        minimum=1e-3, maximum=3600.0)
    max_backwards: float = parameter(
        0.5, 'seconds by which an image may be older than the newest one and count as late: it is '
        'dropped; where the stamps go back further, as in a bag that loops, or stay back, '
        'everything begins anew', minimum=0.0, maximum=3600.0)
    max_lost: int = parameter(
        3, 'bad pairs in a row after which the reference frame is given up for the newest frame',
        minimum=1, maximum=1000)
    standstill: float = parameter(
        0.3, 'median displacement of the matches, in pixels, below which the camera stands still '
        'and the reference frame stays', minimum=0.0, maximum=10.0)
    scale: str = parameter(
        'structure', 'where the length of a translation comes from: structure (one unit along the '
        'track, by what frames share), none (unit length), constant (scale_value), speed (a speed '
        'topic), camera_height (the height over the ground that the images show), guess (another '
        'odometry), ground_truth (offline only)',
        choices=('structure', 'none', 'constant', 'speed', 'camera_height', 'guess',
                 'ground_truth'))
    scale_value: float = parameter(
        0.0, 'length of each translation in metres, which scale constant needs; 0 says none',
        minimum=0.0, maximum=1e6)
    scale_uncertainty: float = parameter(
        0.05, 'standard deviation of a known length, as a share of it; for scale camera_height '
        'that of the height, and what the images leave uncertain comes on top',
        minimum=1e-6, maximum=10.0)
    camera_height: float = parameter(
        0.0, 'metres from flat ground up to the camera, which scale camera_height needs; 0 says '
        'none', minimum=0.0, maximum=1000.0)
    camera_pitch: float = parameter(
        0.0, 'degrees by which the camera looks down, to within 2, for scale camera_height; it '
        'must not roll', minimum=-30.0, maximum=80.0)
    imu: bool = parameter(
        False, 'whether the gyro of an IMU (topic imu) helps: it tells how the camera turns where '
        'the images do not, and is weighed into what they tell')
    imu_rotation: str = parameter(
        '', "rotation of the IMU's axes to those of the camera (optical: z forward, x right, y "
        "down), as a quaternion 'x y z w'; empty asks tf", numbers=True)
    imu_offset: float = parameter(
        0.0, "seconds by which the IMU's clock is ahead of that of the images (t_imu = t_image + "
        'offset); djet lab imu-offset finds it', minimum=-10.0, maximum=10.0)
    imu_noise: float = parameter(
        2e-4, 'density of the white noise of the gyro, in rad/s per root of Hz, as a data sheet '
        'has it', minimum=1e-8, maximum=1.0)
    imu_bias_walk: float = parameter(
        2e-5, "random walk of the gyro's bias, in rad/s² per root of Hz", minimum=0.0,
        maximum=1.0)
    guess: bool = parameter(
        False, 'whether another odometry (topic guess, nav_msgs/Odometry) says where to begin to '
        'look for a motion; its length is taken by scale guess')
    guess_frame: str = parameter(
        '', 'frame on tf that stands still, such as odom: the guess is then how the frame of the '
        'camera moves in it, through whatever is between them on /tf and /tf_static; empty takes '
        'topic guess')
    mask: bool = parameter(
        False, 'whether each image waits a moment for its mask (topic mask, mono8, by the same '
        'stamp), of which pixels below 128 are left out')
    mask_file: str = parameter(
        '', 'PNG or JPEG file of the size of the images, as they come; pixels darker than 128, '
        'such as those of the own bonnet, are left out')
    rectified: str = parameter(
        'auto', 'whether images come rectified: true (camera is P), false (camera is K, D), auto '
        "(true where the image topic's last name, or else the one before it, has the word 'rect' "
        "or 'rectified', as image_rect_color and rect/image do, else false)",
        choices=('auto', 'true', 'false'))
    residual_k1: float = parameter(
        0.0, 'radial distortion (k1 of a CameraInfo) that images still have where they have none '
        'by their calibration, such as rectified ones; djet lens finds it, and it is undone',
        minimum=-1e3, maximum=1e3)
    gray_range: str = parameter(
        '0 65535', "'low high': of images of 16 bits, the values that become black and white; all "
        'others go in equal steps between them. A camera of 12 bits wants 0 4095. Images of 8 '
        'bits stay as they are', numbers=True)
    frame_convention: str = parameter(
        'body', 'axes of all poses in messages: body (x forward, y left, z up, as REP 103 has it '
        'for what moves) or optical (z forward, x right, y down, as it has it for images)',
        choices=('body', 'optical'))
    camera_frame: str = parameter(
        '', "frame id of the camera in messages, along these axes; empty makes it of the image's: "
        'with optical as it is, with body camera_optical_frame becomes camera_frame, and camera '
        'becomes camera_body')
    odom_frame: str = parameter('odom', 'frame id in which the integrated pose is given')
    base_frame: str = parameter(
        '', 'frame id of the vehicle that carries the camera: its pose and velocity (x forward, y '
        "left, z up) are then given instead of the camera's, by the mounting that tf knows, or "
        '/tf_static of a recording; empty gives those of the camera')

    def __post_init__(self) -> None:
        """Refuse values outside their described range."""
        check(self)
        _without_slashes(self, 'guess_frame', 'camera_frame', 'odom_frame', 'base_frame')
        if not self.odom_frame:
            raise ValueError("odom_frame is ''; name a frame")
        self.imu_quaternion()
        self.gray_limits()

    def imu_quaternion(self) -> tuple[float, ...] | None:
        """Give the quaternion x y z w of imu_rotation, of length one; None where tf is asked."""
        if not self.imu_rotation.strip():
            return None
        try:
            values = [float(word) for word in _words(self.imu_rotation)]
        except ValueError:
            values = []
        length = math.hypot(*values)
        if len(values) != 4 or not 0.9 < length < 1.1:
            raise ValueError(f"imu_rotation is '{self.imu_rotation:.80}'; give a quaternion "
                             "'x y z w' of length 1, or nothing")
        return tuple(value / length for value in values)

    @property
    def guess_by_topic(self) -> bool:
        """Whether another odometry is gone by that comes on a topic."""
        return self._goes_by_guess and not self.guess_frame

    @property
    def guess_by_tf(self) -> bool:
        """Whether another odometry is gone by that is made of what tf tells of guess_frame."""
        return self._goes_by_guess and bool(self.guess_frame)

    @property
    def _goes_by_guess(self) -> bool:
        return self.guess or self.scale == 'guess'

    def gray_limits(self) -> tuple[int, int]:
        """Give the two values of gray_range."""
        words = _words(self.gray_range)
        values = [int(word) for word in words if word.isdecimal() and len(word) < 6]
        if len(values) != len(words) or len(values) != 2 or not values[0] < values[1] < 65536:
            raise ValueError(f"gray_range is '{self.gray_range:.80}'; give 'low high', whole "
                             'numbers from 0 to 65535 such as 0 4095')
        return values[0], values[1]


@dataclass(frozen=True)
class SlamConfig:
    """How loops are closed, offline and live. Raises ValueError like its sisters."""

    keyframes: str = parameter(
        'odometry', 'odometry (those by which it carries its scale; by distance where it has '
        'none) or distance (by the two parameters below)',
        choices=('odometry', 'distance'))
    keyframe_distance: float = parameter(
        2.0, 'distance after which a frame becomes a keyframe, in metres or in units of the '
        'trajectory', minimum=1e-6, maximum=1e6)
    keyframe_turn: float = parameter(
        10.0, 'turn after which a frame becomes a keyframe, in degrees', minimum=0.1, maximum=180)
    links: int = parameter(
        1, 'to how many keyframes before it a keyframe is linked; beyond the last one, by direct '
        'estimates', minimum=1, maximum=10)
    length_noise: float = parameter(
        0.02, 'standard deviation by which known lengths differ from one another, as a share; '
        "what the odometry's scale_uncertainty says beyond it is common to all of them (the "
        'radius of a wheel, the height of a camera) and bends nothing', minimum=1e-6, maximum=10.0)
    loop_gap: float = parameter(
        20.0, 'seconds that must lie between two keyframes that close a loop',
        minimum=0.0, maximum=1e6)
    loop_votes: int = parameter(
        20, 'features that must look alike before a loop is verified; a large number closes no '
        'loops', minimum=1, maximum=1_000_000)
    loop_candidates: int = parameter(
        2, 'most alike keyframes that are verified for each keyframe', minimum=1, maximum=100)
    loop_inliers: int = parameter(
        60, 'inliers that verify a loop', minimum=8, maximum=10000)
    loop_share: float = parameter(
        0.5, 'share of inliers among the matches that verifies a loop', minimum=0.05, maximum=1.0)
    max_keyframes: int = parameter(
        1000, 'keyframes that are kept, with their images; beyond it the oldest is forgotten, and '
        'what was known by it becomes a fixed part of the rest', minimum=2, maximum=1_000_000)
    image_buffer: int = parameter(
        50, 'newest images that wait for their odometry', minimum=1, maximum=10_000)
    optimise_period: float = parameter(
        2.0, 'seconds between two optimisations while new loops are found',
        minimum=0.0, maximum=3600.0)
    path_period: float = parameter(
        1.0, 'seconds between two paths', minimum=0.0, maximum=3600.0)
    map_frame: str = parameter('map', 'frame id in which the optimised poses are given')
    publish_tf: bool = parameter(
        True, 'whether map_frame -> odom_frame is published on tf')

    def __post_init__(self) -> None:
        """Refuse values outside their described range."""
        check(self)
        _without_slashes(self, 'map_frame')


@dataclass(frozen=True)
class NodeConfig:
    """What is between the odometry and the graph. Raises ValueError like its sisters."""

    image_transport: str = parameter(
        'raw', 'raw (image) or compressed (image/compressed, JPEG or PNG)',
        choices=('raw', 'compressed'))
    qos_reliability: str = parameter(
        'best_effort', 'of the subscriptions; best_effort hears every publisher (queue_policy '
        'every subscribes reliably in any case)', choices=('best_effort', 'reliable'))
    qos_depth: int = parameter(
        5, 'messages that the middleware keeps for each subscription (queue_policy every has a '
        'number of its own)', minimum=1, maximum=1000)
    queue_policy: str = parameter(
        'latest', 'latest (under load old frames are dropped and counted) or every (none is '
        'dropped unless 500 MB of them wait: for a bag played into the node)',
        choices=('latest', 'every'))
    queue_size: int = parameter(
        2, 'frames that may wait with queue_policy latest; beyond it the oldest is dropped',
        minimum=1, maximum=1000)
    max_rate: float = parameter(
        0.0, 'images a second, by their stamps, that are worked on at most; of a faster camera '
        'the others are left out before they wait, and counted; 0 leaves out none',
        minimum=0.0, maximum=1000.0)
    publish_tf: bool = parameter(
        False, 'whether the integrated pose is also published as odom_frame -> camera frame on tf')
    publish_path: bool = parameter(
        False, 'whether the integrated poses are also published as a path')
    path_period: float = parameter(
        1.0, 'seconds between two paths', minimum=0.0, maximum=3600.0)
    path_length: int = parameter(
        5000, 'newest poses that a path keeps', minimum=1, maximum=1_000_000)

    def __post_init__(self) -> None:
        """Refuse values outside their described range."""
        check(self)


@dataclass(frozen=True)
class Config:
    """
    All parameters, in the four sections that the flat names begin with.

    ``preset`` names where the values of ``estimator`` started from; ``with_values`` keeps the two
    in step.
    """

    preset: str = parameter(
        'best', 'defaults of the estimator: best (everything known to help), fast (fewer '
        'matches in about 0.65 of the time, for small computers) or paper (the algorithm as '
        'printed); values given for the estimator come on top', choices=PRESETS)
    estimator: EstimatorConfig = field(default_factory=EstimatorConfig)
    odometry: OdometryConfig = field(default_factory=OdometryConfig)
    slam: SlamConfig = field(default_factory=SlamConfig)
    ros: NodeConfig = field(default_factory=NodeConfig)

    def __post_init__(self) -> None:
        """Refuse an unknown preset, and a guess that would be our own echo."""
        check(self)
        if self.ros.publish_tf and self.odometry.guess_frame == self.odometry.odom_frame:
            raise ValueError(f"odometry.guess_frame is '{self.odometry.guess_frame}', which is "
                             'what this odometry publishes on tf itself; give it another '
                             'odometry.odom_frame, or no ros.publish_tf')


SECTIONS = ('estimator', 'odometry', 'slam', 'ros')
