"""ROS parameters of the nodes: declared from the schema, and validated on each change."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from importlib import import_module
from pathlib import Path
import sys
from typing import Any

from djet_ros.config.flat import flat, FlatParameter, from_flat, why_unknown
from djet_ros.config.sections import Config
from djet_ros.config.yaml_files import is_ros_own, why_unused
from djet_ros.errors import DjetError, one_line
from djet_ros.live.parameters import (
    FIXED_PARAMETERS,
    live_choices,
    ODOMETRY_PARAMETERS,
    SHARED_PARAMETERS,
    tf_reason,
    with_live_values,
)
from djet_ros.odometry.scale import check_scale
from djet_ros.ros.command_line import option_values
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter


class Parameters:
    """
    Parameters of the odometry node, which must declare parameters from overrides automatically.

    config: their values. Raises DjetError if a value given at the start is invalid; unknown names
    only give a warning, because a file may serve several nodes.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        given = _given(node)
        self.config = _possible(with_live_values(Config(), given))
        _declare(node, (item for item in flat(self.config).values()
                        if item.name in ODOMETRY_PARAMETERS), given)

    def call_on_change(self, prepare: Callable[[Config], None],
                       apply: Callable[[Config], None]) -> None:
        """
        Accept changes from now on.

        prepare: called with a new configuration, raises DjetError to reject it; apply: called
        with each accepted configuration.
        """
        self._prepare, self._apply = prepare, apply
        self._node.add_pre_set_parameters_callback(self._complete)
        self._node.add_on_set_parameters_callback(self._check)
        self._node.add_post_set_parameters_callback(self._take)

    def _complete(self, parameters: list[Parameter]) -> list[Parameter]:
        """Convert integers to floats, and add the values that a preset sets."""
        values = _values(parameters)
        try:
            config = self._with(values)
        except DjetError:
            # _check rejects them with the reason.
            return parameters
        before = flat(self.config)
        return [Parameter(item.name, value=item.value) for item in flat(config).values()
                if item.name in values or item.value != before[item.name].value
                ] + [one for one in parameters if one.name not in ODOMETRY_PARAMETERS]

    def _check(self, parameters: list[Parameter]) -> SetParametersResult:
        values = _values(parameters)
        try:
            config = _possible(self._with(values))
            # Not for parameters that topics declare, such as qos_overrides.
            if values:
                self._prepare(config)
        except DjetError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _take(self, parameters: list[Parameter]) -> None:
        if values := _values(parameters):
            config = self._with(values)
            self._apply(config)
            self.config = config

    def _with(self, values: Mapping[str, Any]) -> Config:
        """
        Return the configuration with values changed; the current preset is not applied again.

        ``ros2 param load`` sets the parameters one by one, the preset after the estimator.
        """
        return with_live_values(self.config, {
            name: value for name, value in values.items()
            if name != 'preset' or value != self.config.preset})


def graph_parameters(node: Node) -> Config:
    """
    Declare the parameters of the pose graph node, all read-only, and return their values.

    Those that it shares with the odometry may come from the same file. Raises DjetError if a
    value is invalid; unknown names only give a warning.
    """
    given = _given(node)
    config = from_flat(given)
    if config.slam.publish_tf:
        _require('tf2_msgs', 'tf2-msgs', 'slam.publish_tf is true')
    if config.odometry.base_frame:
        _require_frames(config)
    _declare(node, (item for item in flat(config).values() if item.name in SHARED_PARAMETERS
                    or item.name.startswith(('estimator.', 'slam.'))), given, read_only=True)
    return config


def _given(node: Node) -> dict[str, Any]:
    """Return the values given at the start, for the names in the schema; warn about others."""
    known = flat(Config())
    for path in map(Path, option_values(sys.argv, '--params-file')):
        if why := why_unused(path, node.get_fully_qualified_name()):
            node.get_logger().warning(why)
    values = {name: one.value for name, one in node.get_parameters_by_prefix('').items()}
    for name in values:
        if name not in known and not is_ros_own(name):
            node.get_logger().warning(why_unknown(name))
    return {name: value for name, value in values.items() if name in known}


def _declare(node: Node, items: Iterable[FlatParameter], given: Mapping[str, Any], *,
             read_only: bool = False) -> None:
    """Declare parameters with the types, ranges and descriptions that overrides lack."""
    for item in items:
        if item.name in given:
            node.undeclare_parameter(item.name)
        node.declare_parameter(item.name, item.value, descriptor(item, read_only=read_only),
                               ignore_override=True)


def descriptor(item: FlatParameter, *, read_only: bool = False) -> ParameterDescriptor:
    """Return the ROS descriptor of a parameter: text, range, choices, read-only."""
    says, choices = item.description, live_choices(item)
    result = ParameterDescriptor(
        description=says.text, read_only=read_only or item.name in FIXED_PARAMETERS,
        additional_constraints=f'one of: {", ".join(choices)}' if choices else '')
    if says.minimum is None or says.maximum is None:
        return result
    if item.kind is int:
        result.integer_range = [IntegerRange(
            from_value=int(says.minimum), to_value=int(says.maximum), step=2 if says.odd else 1)]
    elif item.kind is float:
        result.floating_point_range = [FloatingPointRange(
            from_value=float(says.minimum), to_value=float(says.maximum))]
    return result


def _possible(config: Config) -> Config:
    """Raise DjetError for a missing ROS package, and for a scale without its length."""
    check_scale(config.odometry)
    if config.ros.publish_tf:
        _require('tf2_msgs', 'tf2-msgs', 'ros.publish_tf is true')
    if config.odometry.guess_frame:
        _require('tf2_msgs', 'tf2-msgs', 'odometry.guess_frame is set')
    _require_frames(config)
    return config


def _require_frames(config: Config) -> None:
    if asked := tf_reason(config.odometry):
        # Jazzy's package tf2_ros is C++ alone.
        _require('tf2_ros', 'tf2-ros-py', asked)


def _require(module: str, package: str, asked: str) -> None:
    """Raise DjetError if a Python module of ROS that a setting needs cannot be imported."""
    try:
        import_module(module)
    except ImportError as error:
        raise DjetError(f'{asked}, which needs the Python module {module}: sudo apt install '
                        f'ros-$ROS_DISTRO-{package} ({one_line(error)})') from error


def _values(parameters: list[Parameter]) -> dict[str, Any]:
    return {one.name: one.value for one in parameters if one.name in ODOMETRY_PARAMETERS}
