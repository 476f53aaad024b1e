"""Options that the commands on the graph share, and their end by a signal."""

from __future__ import annotations

from _thread import start_new_thread
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
    """
    Give an event that SIGINT, SIGTERM and SIGHUP set, instead of ending the process.

    Another thread sets it: a signal may come while the main thread holds the event's lock, as it
    does at each look, and a handler that waits for that would wait for itself.
    """
    stop = Event()
    numbers = [signal.SIGINT, signal.SIGTERM]
    # With nohup a terminal may close.
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    for number in numbers:
        signal.signal(number, lambda *_: stop.is_set() or start_new_thread(stop.set, ()))
    return stop
