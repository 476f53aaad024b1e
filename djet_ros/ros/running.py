"""Running of a ROS 2 node until a signal, with one-line errors."""

from __future__ import annotations

from collections.abc import Callable
import re
from threading import Event

from djet_ros.errors import DjetError, one_line
from djet_ros.live.base_node import LiveNode
import rclpy
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

# Exceptions of rclpy for invalid ROS arguments.
_REFUSALS = (rclpy_implementation.RCLError, rclpy_implementation.UnknownROSArgsError,
             NameValidationException, ParameterException)


def non_ros_arguments() -> list[str]:
    """Return the non-ROS arguments of the command line; DjetError if ROS's are invalid."""
    try:
        return list(remove_ros_args()[1:])
    except _REFUSALS as error:
        raise _refused(error) from None


# What rcl reads besides the command line, which non_ros_arguments has checked.
_ENVIRONMENT = ('ROS_DOMAIN_ID, RMW_IMPLEMENTATION, ROS_LOG_DIR and the settings of the '
                'middleware such as CYCLONEDDS_URI or FASTRTPS_DEFAULT_PROFILES_FILE')


def run_node(name: str, make: Callable[[Node], LiveNode], stop: Event) -> int:
    """
    Run a node until stop is set; return the exit code, 1 if its worker thread failed.

    Raises DjetError if the command line or the environment does not allow a node.
    """
    # The context must outlive the last publication, so rclpy must not handle the signals.
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        node = Node(name, automatically_declare_parameters_from_overrides=True)
    except rclpy_implementation.RCLError as error:
        rclpy.try_shutdown()
        raise DjetError(f'the ROS node could not be created: {_reason(error)}; check the log '
                        f'lines above, if any, and the environment: {_ENVIRONMENT}') from None
    except _REFUSALS as error:
        rclpy.try_shutdown()
        raise _refused(error) from None
    try:
        return make(node).run(stop)
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


def _refused(error: Exception) -> DjetError:
    return DjetError(f'invalid ROS arguments: {_reason(error)}; check the arguments after '
                     '--ros-args')


def _reason(error: Exception) -> str:
    """Return ROS's error message without source locations and 'error not set'."""
    text = re.sub(r', at [^ ]+:\d+', '', one_line(error))
    return re.sub(r'(\. Error)?: error not set', '', text)
