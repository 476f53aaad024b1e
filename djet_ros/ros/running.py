"""How a ROS 2 node is run."""

from __future__ import annotations

from collections.abc import Callable
import re
from threading import Event

from djet_ros.errors import DjetError, one_line
from djet_ros.live.face import Face
import rclpy
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

# What rclpy makes of words after --ros-args that it can't use.
_REFUSALS = (rclpy_implementation.RCLError, rclpy_implementation.UnknownROSArgsError,
             NameValidationException, ParameterException)


def own_words() -> list[str]:
    """Give the words of the command line that are not for ROS; DjetError where ROS can't read."""
    try:
        return list(remove_ros_args()[1:])
    except _REFUSALS as error:
        raise _refused(error) from None


# What rcl goes by beside the command line, which own_words has seen to be readable.
_SURROUNDINGS = ('ROS_DOMAIN_ID, RMW_IMPLEMENTATION, ROS_LOG_DIR and the settings of the '
                 'middleware such as CYCLONEDDS_URI or FASTRTPS_DEFAULT_PROFILES_FILE')


def run_node(name: str, make: Callable[[Node], Face], stop: Event) -> int:
    """
    Run a node's face until stop is set; gives the exit code, 1 where its work failed.

    DjetError where the node can't be made of the command line, or in this environment.
    """
    # The context must outlive what is being published, so rclpy does not get to see the signals.
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        node = Node(name, automatically_declare_parameters_from_overrides=True)
    except rclpy_implementation.RCLError as error:
        rclpy.try_shutdown()
        raise DjetError(f'ROS can not start a node: {_said(error)}; look at the lines above, if '
                        f'any, and at the environment: {_SURROUNDINGS}') from None
    except _REFUSALS as error:
        rclpy.try_shutdown()
        raise _refused(error) from None
    try:
        return make(node).run(stop)
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


def _refused(error: Exception) -> DjetError:
    return DjetError(f'ROS refuses the command line: {_said(error)}; see the words after '
                     '--ros-args')


def _said(error: Exception) -> str:
    """Word what ROS says, without the places in its sources and without what it does not know."""
    said = re.sub(r', at [^ ]+:\d+', '', one_line(error))
    return re.sub(r'(\. Error)?: error not set', '', said)
