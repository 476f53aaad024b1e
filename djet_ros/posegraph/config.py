"""Parameters of the offline SLAM."""

from __future__ import annotations

from dataclasses import dataclass

from djet_ros.core.parameter import check, parameter


@dataclass(frozen=True)
class SlamConfig:
    """Everything that somebody would turn. Raises ValueError on a value outside its range."""

    keyframe_distance: float = parameter(
        2.0, 'way after which a frame becomes a keyframe, in metres or in units of the trajectory',
        minimum=1e-6, maximum=1e6)
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

    def __post_init__(self) -> None:
        """Refuse values outside their described range."""
        check(self)
