"""What a recording says of one topic, and what every storage offers and raises."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import NamedTuple, Protocol

# No piece that is unpacked or read at once may be larger: an uncompressed 6000x5000 colour
# image fits, and a file that declares more is hostile or damaged.
LARGEST_PIECE = 128 << 20


class BrokenFile(Exception):
    """The bytes of a recording make no sense; the message says how, the caller knows the file."""


class Connection(NamedTuple):
    """
    A topic with its type as recorded.

    msgtype: 'package/msg/Name'; encoding: 'cdr' (ROS 2) or 'ros1'; definition: the text of the
    message definition, or '' where the file holds none.
    """

    number: int
    topic: str
    msgtype: str
    encoding: str
    definition: str
    message_count: int


class Storage(Protocol):
    """One file of a recording. Opening it raises BrokenFile where there is no sense in it."""

    connections: list[Connection]

    def messages(self, wanted: Collection[int]) -> Iterator[tuple[int, int, memoryview]]:
        """
        Yield (connection number, stamp in ns, serialised message) in the order of stamps.

        After the last message before a break in the file, raises BrokenFile.
        """


def ros2_name(msgtype: str) -> str:
    """Name of a message type in ROS 2 style: sensor_msgs/Image -> sensor_msgs/msg/Image."""
    package, _, name = msgtype.rpartition('/')
    return msgtype if package.endswith('/msg') else f'{package}/msg/{name}'
