"""``djet echo``: what a live odometry says, in a terminal."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field
from difflib import get_close_matches
import sys
from threading import Event
from time import monotonic
from typing import Any

from djet_ros.cli import terminal
from djet_ros.cli.graph_options import add_remappings, ENVIRONMENT, stop_by_signal
from djet_ros.config.sections import NODE_NAME
import numpy as np
from rich.live import Live
from rich.table import Table
from rich.text import Text

DESCRIPTION = f"""\
Show the integrated poses of a live odometry (djet live, or vo_node under ROS), a line each; with
--diagnostics its state, rate, latency and path length, as a view that changes or, where the
output is no terminal, as lines.
{ENVIRONMENT}"""

# Of the diagnostics, what is worth a glance.
_SHOWN = ('rate (Hz)', 'latency, median (ms)', 'latency, 95 % (ms)', 'frames received',
          'frames processed', 'frames dropped', 'frames rejected', 'frames lost on the way',
          'matches', 'inliers', 'median residual (px)')

_ODOMETRY = 'nav_msgs/msg/Odometry'

# Seconds without a message after which it is said what is waited for.
_PATIENCE_S = 2.0

_UNITS = {'metric': 'm', 'relative': 'lengths of the first step'}

_COLOURS = {0: 'green', 1: 'yellow', 2: 'red', 3: 'red'}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('--diagnostics', action='store_true',
                        help='state, rate, latency and path length instead of poses')
    parser.add_argument('--node', default=NODE_NAME, metavar='NAME',
                        help='name of the node, with its namespace if it has one '
                        '(default: %(default)s)')
    add_remappings(parser)


def run(args: argparse.Namespace) -> int:
    """Show what comes until SIGINT or SIGTERM."""
    stop = stop_by_signal()

    from djet_ros.dds.graph import Graph
    from djet_ros.dds.names import Names
    namespace, _, node = args.node.strip('/').rpartition('/')
    names = Names(node, [*args.remap, *([f'__ns:=/{namespace}'] if namespace else [])])
    view, topic = Monitor(names.full_node.strip('/')), names.resolve('~/odometry')

    def pose(message: Any) -> None:
        view.odometry(message)
        if not args.diagnostics:
            _print_pose(message)

    with Graph() as graph:
        graph.listen(topic, _ODOMETRY, pose)
        waiting = _Waiting(view, graph, topic)
        if args.diagnostics:
            graph.listen(names.resolve('/diagnostics'), 'diagnostic_msgs/msg/DiagnosticArray',
                         view.diagnostics)
            _show(view, graph, stop, waiting)
        while not stop.is_set():
            graph.spin(0.1)
            waiting.say()
    return 0


@dataclass
class Monitor:
    """What is known of the odometry, from its messages so far."""

    node: str
    path_length: float = 0.0
    poses: int = 0
    summary: str = 'nothing heard yet'
    level: int = 3
    values: dict[str, str] = field(default_factory=dict)
    news: bool = False
    _last: Any = None

    def odometry(self, message: Any) -> None:
        """Add a step to the path; a pose back at the origin begins a new one."""
        at = message.pose.pose.position
        position = np.array([at.x, at.y, at.z])
        self.poses += 1
        if self._last is None or not position.any():
            self.path_length = 0.0
        else:
            self.path_length += float(np.linalg.norm(position - self._last))
        self._last = position

    def diagnostics(self, message: Any) -> None:
        """Take the status of the node, if it is its."""
        for status in message.status:
            if status.name == f'{self.node}: visual odometry':
                self.values = {pair.key: pair.value for pair in status.values}
                self.summary, self.news = status.message, True
                self.level = int(status.level)

    @property
    def length(self) -> str:
        """Length of the path, in metres where they are known."""
        unit = _UNITS.get(self.values.get('scale', ''), 'steps of unit length')
        return f'{self.path_length:.1f} {unit}'

    def table(self) -> Table:
        """Show it all."""
        table = Table(title=self.node, show_header=False, min_width=48)
        table.add_row('state', Text(self.summary, _COLOURS.get(self.level, 'red')))
        table.add_row('path', self.length)
        for name in _SHOWN:
            table.add_row(name, Text(self.values.get(name, '–')))
        return table

    def line(self) -> str:
        """Say it all in a line."""
        shown = '; '.join(f'{name}: {self.values[name]}' for name in _SHOWN if name in self.values)
        return f'{self.summary}; path: {self.length}; {shown}'


class _Waiting:
    """Says once, if nothing is heard for a while, over which topic nothing comes."""

    def __init__(self, view: Monitor, graph: Any, topic: str) -> None:
        self._view, self._graph, self._topic = view, graph, topic
        self._end: float | None = monotonic() + _PATIENCE_S

    def say(self) -> None:
        if self._end is None or monotonic() < self._end:
            return
        self._end = None
        if not self._view.poses and not self._view.values:
            print(f'waiting for {self._topic}: {self._why()}', file=sys.stderr, flush=True)

    def _why(self) -> str:
        if offers := self._graph.offers(self._topic):
            return f'{len(offers)} publish it, none sends'
        near = get_close_matches(self._topic, self._graph.published(_ODOMETRY), n=1, cutoff=0.0)
        return 'nobody publishes it' + (f'; did you mean {near[0]}?' if near else '')


def _print_pose(message: Any) -> None:
    """Stamp, position and orientation as in a TUM file."""
    stamp, pose = message.header.stamp, message.pose.pose
    at, turn = pose.position, pose.orientation
    print(f'{stamp.sec}.{stamp.nanosec:09d} {at.x:.6f} {at.y:.6f} {at.z:.6f} '
          f'{turn.x:.6f} {turn.y:.6f} {turn.z:.6f} {turn.w:.6f}', flush=True)


def _show(view: Monitor, graph: Any, stop: Event, waiting: _Waiting) -> None:
    """Keep a terminal up to date, or print a line for each diagnostics message."""
    console = terminal.console()
    if console.is_terminal:
        with Live(view.table(), console=console, auto_refresh=False) as live:
            while not stop.is_set():
                graph.spin(0.2)
                waiting.say()
                live.update(view.table(), refresh=True)
        return
    while not stop.is_set():
        graph.spin(0.2)
        waiting.say()
        if view.news:
            view.news = False
            print(view.line(), flush=True)
