"""Parameters of the SLAM that runs beside the odometry."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
import json
import textwrap
from typing import Any

from djet_ros.config.flat import explain, FlatParameter
from djet_ros.core.parameter import describe, parameter
from djet_ros.errors import DjetError
from djet_ros.posegraph.config import SlamConfig


@dataclass(frozen=True)
class LiveSlamConfig(SlamConfig):
    """Those of the offline SLAM, and what only a live one has. Raises ValueError like it."""

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


def flat_slam(config: LiveSlamConfig) -> dict[str, FlatParameter]:
    """All parameters by flat name, such as slam.keyframe_distance."""
    return {f'slam.{name}': FlatParameter(f'slam.{name}', value, type(value), description)
            for name, description in describe(config).items()
            for value in [getattr(config, name)]}


def slam_config(values: Mapping[str, Any]) -> LiveSlamConfig:
    """
    Make the configuration of some values by flat name, the others as they are by default.

    Integers are taken for floats. Raises DjetError on a value of another type or outside its
    range.
    """
    known = flat_slam(LiveSlamConfig())
    typed: dict[str, Any] = {}
    for name, value in values.items():
        kind = known[name].kind
        if kind is float and type(value) is int:
            value = float(value)
        if type(value) is not kind:
            raise DjetError(f'{name} is {value!r:.80}; it must be of type {kind.__name__}')
        typed[name.removeprefix('slam.')] = value
    try:
        return LiveSlamConfig(**typed)
    except ValueError as error:
        raise DjetError(f'slam.{error}') from None


def dump_slam_yaml() -> str:
    """Write the default values as YAML in ROS's layout, each under its description."""
    lines = ['# Parameters of pose_graph_node, beside those it shares with vo_node (see vo.yaml).',
             '# Made from djet_ros/posegraph/live_config.py by its dump_slam_yaml.',
             '/**/pose_graph_node:', '  ros__parameters:', '    slam:']
    for item in flat_slam(LiveSlamConfig()).values():
        lines += textwrap.wrap(explain(item), 97, initial_indent='      # ',
                               subsequent_indent='      # ')
        lines.append(f'      {item.name.removeprefix("slam.")}: {json.dumps(item.value)}')
    return '\n'.join(lines) + '\n'
