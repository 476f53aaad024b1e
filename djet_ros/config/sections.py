"""The sections of the one configuration: everything that somebody would turn."""

from __future__ import annotations

from dataclasses import dataclass, field

from djet_ros.core.estimator_config import EstimatorConfig, PRESETS
from djet_ros.core.parameter import check, parameter

NODE_NAME = 'vo_node'


@dataclass(frozen=True)
class OdometryConfig:
    """How pairs become a trajectory. Raises ValueError on a value outside its description."""

    max_gap: float = parameter(
        1.0, 'seconds between two frames beyond which they are not related to one another',
        minimum=1e-3, maximum=3600.0)
    max_lost: int = parameter(
        3, 'bad pairs in a row after which the reference frame is given up for the newest frame',
        minimum=1, maximum=1000)
    standstill: float = parameter(
        0.3, 'median displacement of the matches, in pixels, below which the camera stands still '
        'and the reference frame stays', minimum=0.0, maximum=10.0)
    scale: str = parameter(
        'none', 'where the length of a translation comes from: none (unit length), constant '
        '(scale_value), speed (a speed topic), camera_height (the height over the ground that the '
        'images show), ground_truth (offline only)',
        choices=('none', 'constant', 'speed', 'camera_height', 'ground_truth'))
    scale_value: float = parameter(
        1.0, 'length of each translation in metres, for scale constant',
        minimum=1e-6, maximum=1e6)
    scale_uncertainty: float = parameter(
        0.05, 'standard deviation of a known length, as a share of it; for scale camera_height '
        'that of the height, and what the images leave uncertain comes on top',
        minimum=1e-6, maximum=10.0)
    camera_height: float = parameter(
        1.0, 'metres from flat ground up to the camera, for scale camera_height',
        minimum=0.01, maximum=1000.0)
    camera_pitch: float = parameter(
        0.0, 'degrees by which the camera looks down, to within 2, for scale camera_height; it '
        'must not roll', minimum=-30.0, maximum=80.0)
    rectified: str = parameter(
        'auto', 'whether images come rectified: true (camera is P), false (camera is K, D), auto '
        "(true where the image topic's last name has 'rect' in it, else false)",
        choices=('auto', 'true', 'false'))
    frame_convention: str = parameter(
        'optical', 'axes of all poses: optical (z forward, x right, y down) or body (x forward, '
        'y left, z up)', choices=('optical', 'body'))
    camera_frame: str = parameter(
        '', "frame id of the camera in messages; empty takes the image's own")
    odom_frame: str = parameter('odom', 'frame id in which the integrated pose is given')

    def __post_init__(self) -> None:
        """Refuse values outside their described range."""
        check(self)


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
        5, 'messages that the middleware keeps for each subscription (with queue_policy every: '
        'all)', minimum=1, maximum=1000)
    queue_policy: str = parameter(
        'latest', 'latest (under load old frames are dropped and counted) or every (none is '
        'dropped: for a bag played into the node)', choices=('latest', 'every'))
    queue_size: int = parameter(
        2, 'frames that may wait; beyond it latest drops the oldest, every lets the sender wait',
        minimum=1, maximum=1000)
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
    All parameters, in the three sections that the flat names begin with.

    ``preset`` names where the values of ``estimator`` started from; ``with_values`` keeps the two
    in step.
    """

    preset: str = parameter(
        'best', 'defaults of the estimator: best (everything known to help) or paper (the '
        'algorithm as printed); values given for the estimator come on top', choices=PRESETS)
    estimator: EstimatorConfig = field(default_factory=EstimatorConfig)
    odometry: OdometryConfig = field(default_factory=OdometryConfig)
    ros: NodeConfig = field(default_factory=NodeConfig)

    def __post_init__(self) -> None:
        """Refuse an unknown preset."""
        check(self)


SECTIONS = ('estimator', 'odometry', 'ros')
