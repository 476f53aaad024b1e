"""Options that the commands on the graph share, and their end by a signal."""

from __future__ import annotations

import argparse
import signal
from threading import Event

ENVIRONMENT = """\
The graph is that of ROS_DOMAIN_ID; ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST keeps to this machine,
also where it has no multicast. What CYCLONEDDS_URI says comes on top.
"""


def add_remappings(parser: argparse.ArgumentParser) -> None:
    """Add -r from:=to."""
    parser.add_argument('-r', '--remap', action='append', default=[], metavar='FROM:=TO',
                        help='another name for a topic or service, or for the node (__node, '
                        '__ns); may be repeated')


def stop_by_signal() -> Event:
    """Give an event that SIGINT and SIGTERM set, instead of ending the process."""
    stop = Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    return stop
