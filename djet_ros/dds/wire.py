"""
ROS messages on DDS.

The ROS topic /camera/image_raw of type sensor_msgs/msg/Image is the DDS topic rt/camera/image_raw
of type sensor_msgs::msg::dds_::Image_, with samples in CDR. rosbags (de)serialises them, so that
messages are the same objects as in a replay; to Cyclone they are bytes, as its own reading of
uint8[] is byte by byte in Python.
"""

from __future__ import annotations

from functools import cache
from typing import Any, Self

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import uint8
from djet_ros.errors import DjetError, one_line
from djet_ros.recordings.decoding import jazzy


@cache
def sample_type(dds_name: str) -> Any:
    """
    Return the sample class of a DDS type; ``data`` is CDR with its encapsulation header.

    Cyclone validates samples against their declared type. The type is declared as a single octet,
    which every sample has, and rosbags validates the rest.
    """
    class Sample(IdlStruct, typename=dds_name):  # type: ignore[call-arg]
        octet: uint8

        def __init__(self, data: bytes) -> None:
            self.data = data

        def serialize(self, **_: Any) -> bytes:
            return self.data

        @classmethod
        def deserialize(cls, data: bytes, **_: Any) -> Self:
            return cls(data)

        # Called when a publisher is disposed; ROS topics have no keys.
        deserialize_key = deserialize

    return Sample


def dds_type_name(ros_name: str) -> str:
    """Return the DDS type name of a ROS type such as 'sensor_msgs/msg/Image'."""
    package, kind, name = ros_name.split('/')
    return f'{package}::{kind}::dds_::{name}_'


def encode(message: Any) -> bytes:
    """Serialise a rosbags message to CDR."""
    return bytes(jazzy().serialize_cdr(message, message.__msgtype__))


def decode(data: bytes, ros_name: str) -> Any:
    """Deserialise CDR to a rosbags message; DjetError if it is not one."""
    # The generated code of rosbags raises exceptions of any kind on invalid data.
    try:
        return jazzy().deserialize_cdr(data, ros_name)
    except Exception as error:
        raise DjetError(f'{len(data)} bytes are not a valid {ros_name}: '
                        f'{one_line(error)[:120]}') from error
