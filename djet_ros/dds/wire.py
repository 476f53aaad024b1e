"""
ROS's messages as DDS carries them.

The topic /camera/image_raw of type sensor_msgs/msg/Image is on the wire the DDS topic
rt/camera/image_raw of type sensor_msgs::msg::dds_::Image_, and its samples are plain CDR. rosbags
reads and writes that CDR, so that messages are the same objects as in a replay; to Cyclone they
are bytes. Its own reading of a uint8[] goes byte by byte in Python.
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
    Make the class of samples of a DDS type: ``data`` is CDR with its encapsulation header.

    Cyclone checks samples against the type that it is told. It is told of a single octet, which
    all samples begin with: whether the rest is right is for rosbags to judge, which can tell.
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

        # What comes where a publisher has gone; ROS's topics have no keys.
        deserialize_key = deserialize

    return Sample


def dds_type_name(ros_name: str) -> str:
    """Give the DDS type name of a ROS type such as 'sensor_msgs/msg/Image'."""
    package, kind, name = ros_name.split('/')
    return f'{package}::{kind}::dds_::{name}_'


def encode(message: Any) -> bytes:
    """Write a message of rosbags as CDR."""
    return bytes(jazzy().serialize_cdr(message, message.__msgtype__))


def decode(data: bytes, ros_name: str) -> Any:
    """Read CDR as a message of rosbags; DjetError where it is none."""
    # rosbags reads by generated code, which fails on rubbish in as many ways as there are types.
    try:
        return jazzy().deserialize_cdr(data, ros_name)
    except Exception as error:
        raise DjetError(f'{len(data)} bytes are no {ros_name}: {one_line(error)[:120]}') from error
