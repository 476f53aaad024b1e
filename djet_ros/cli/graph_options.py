"""Options of the commands that join a ROS 2 graph, and how signals stop them."""

from __future__ import annotations

from _thread import start_new_thread
import argparse
import signal
from threading import Event

ENVIRONMENT = """\
ROS_DOMAIN_ID selects the ROS 2 domain. ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST restricts discovery
to this machine, and works without multicast. Settings of CYCLONEDDS_URI are applied on top.
"""


def add_remappings(parser: argparse.ArgumentParser) -> None:
    """Add -r from:=to."""
    parser.add_argument('-r', '--remap', action='append', default=[], metavar='FROM:=TO',
                        help='remap a topic or service, or the node (__node, __ns); may be '
                        'repeated')


def stop_by_signal() -> Event:
    """
    Return an event that SIGINT, SIGTERM and SIGHUP set instead of ending the process.

    The handler sets it from another thread: a signal may arrive while the main thread holds the
    event's lock (as in each ``is_set``), and a handler that waited for it would deadlock.
    """
    stop = Event()
    numbers = [signal.SIGINT, signal.SIGTERM]
    # nohup ignores SIGHUP; keep that.
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    for number in numbers:
        signal.signal(number, lambda *_: stop.is_set() or start_new_thread(stop.set, ()))
    return stop
