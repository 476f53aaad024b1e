"""Interface of the readers of bag files."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import NamedTuple, Protocol

# Limit in bytes of anything read or decompressed at once: an uncompressed 6000x5000 colour image
# fits; a file that declares more is damaged or malicious.
LARGEST_PIECE = 128 << 20


class BrokenFile(Exception):
    """A damaged or unsupported file; the message has the reason, the caller adds the path."""


class Connection(NamedTuple):
    """
    A topic with its type as recorded.

    msgtype: 'package/msg/Name'; encoding: 'cdr' (ROS 2) or 'ros1'; definition: the text of the
    message definition, or '' if the file holds none.
    """

    number: int
    topic: str
    msgtype: str
    encoding: str
    definition: str
    message_count: int


class Storage(Protocol):
    """One file of a bag. Opening it raises BrokenFile if it is not readable."""

    connections: list[Connection]

    def messages(self, wanted: Collection[int]) -> Iterator[tuple[int, int, memoryview]]:
        """
        Yield (connection number, stamp in ns, serialised message) in the order of stamps.

        If the file is damaged, yields everything before the damage, then raises BrokenFile.
        """


def ros2_name(msgtype: str) -> str:
    """Return a message type in ROS 2 style: sensor_msgs/Image -> sensor_msgs/msg/Image."""
    package, _, name = msgtype.rpartition('/')
    return msgtype if package.endswith('/msg') else f'{package}/msg/{name}'
