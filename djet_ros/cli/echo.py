"""``djet echo``: print poses or diagnostics of a running odometry."""

from __future__ import annotations

import argparse
from contextlib import nullcontext
from dataclasses import dataclass, field
from difflib import get_close_matches
import sys
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
Print the integrated poses of a running odometry (djet live, or vo_node under ROS), one line each:
time stamp, position and orientation quaternion, as in a TUM file. With --diagnostics show its
state, rate, latency and path length instead: as a table that is updated in place, or, if the
output is not a terminal, one line per message.
{ENVIRONMENT}"""

# Keys of the diagnostics that are shown.
_SHOWN = ('rate (Hz)', 'latency, median (ms)', 'latency, 95 % (ms)', 'frames received',
          'frames processed', 'frames dropped', 'frames rejected', 'frames lost on the way',
          'matches', 'inliers', 'median residual (px)')

_ODOMETRY = 'nav_msgs/msg/Odometry'

# Seconds without a message after which the silent topic is reported.
_SILENCE_WARNING_S = 2.0

_UNITS = {'metric': 'm', 'relative': 'lengths of the first step'}

_COLOURS = {0: 'green', 1: 'yellow', 2: 'red', 3: 'red'}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('--diagnostics', action='store_true',
                        help='state, rate, latency and path length instead of poses')
    parser.add_argument('--node', default=NODE_NAME, metavar='NAME',
                        help='name of the node, with its namespace if any '
                        '(default: %(default)s)')
    add_remappings(parser)


def run(args: argparse.Namespace) -> int:
    """Print messages until SIGINT or SIGTERM."""
    stop = stop_by_signal()

    from djet_ros.dds.graph import Graph
    from djet_ros.dds.names import Names
    namespace, _, node = args.node.strip('/').rpartition('/')
    names = Names(node, [*args.remap, *([f'__ns:=/{namespace}'] if namespace else [])])
    view, topic = Monitor(names.full_node.strip('/')), names.resolve('~/odometry')
    out = terminal.console()
    as_table = args.diagnostics and out.is_terminal

    def pose(message: Any) -> None:
        view.odometry(message)
        if not args.diagnostics:
            _print_pose(message)

    def diagnostics(message: Any) -> None:
        if view.diagnostics(message) and not as_table:
            print(view.line(), flush=True)

    with Graph() as graph, (Live(view.table(), console=out, auto_refresh=False) if as_table
                            else nullcontext()) as live:
        graph.listen(topic, _ODOMETRY, pose)
        if args.diagnostics:
            graph.listen(names.resolve('/diagnostics'), 'diagnostic_msgs/msg/DiagnosticArray',
                         diagnostics)
        silence = _SilenceWarning(view, graph, topic)
        while not stop.is_set():
            graph.spin(0.2)
            silence.check()
            if live is not None:
                live.update(view.table(), refresh=True)
    return 0


@dataclass
class Monitor:
    """State of the odometry, from its messages so far."""

    node: str
    path_length: float = 0.0
    poses: int = 0
    summary: str = 'no diagnostics received yet'
    level: int = 3
    values: dict[str, str] = field(default_factory=dict)
    _last: Any = None

    def odometry(self, message: Any) -> None:
        """Add a step to the path length; a pose at the origin starts a new path."""
        at = message.pose.pose.position
        position = np.array([at.x, at.y, at.z])
        self.poses += 1
        if self._last is None or not position.any():
            self.path_length = 0.0
        else:
            self.path_length += float(np.linalg.norm(position - self._last))
        self._last = position

    def diagnostics(self, message: Any) -> bool:
        """Update the state, and return True, if the message has the status of this node."""
        for status in message.status:
            if status.name == f'{self.node}: visual odometry':
                self.values = {pair.key: pair.value for pair in status.values}
                self.summary, self.level = status.message, int(status.level)
                return True
        return False

    @property
    def length(self) -> str:
        """Length of the path with its unit, metres if the scale is metric."""
        unit = _UNITS.get(self.values.get('scale', ''), 'steps of unit length')
        return f'{self.path_length:.1f} {unit}'

    def table(self) -> Table:
        """Lay out the state as a table."""
        table = Table(title=self.node, show_header=False, min_width=48)
        table.add_row('state', Text(self.summary, _COLOURS.get(self.level, 'red')))
        table.add_row('path', self.length)
        for name in _SHOWN:
            table.add_row(name, Text(self.values.get(name, '–')))
        return table

    def line(self) -> str:
        """Return the state as one line."""
        shown = '; '.join(f'{name}: {self.values[name]}' for name in _SHOWN if name in self.values)
        return f'{self.summary}; path: {self.length}; {shown}'


class _SilenceWarning:
    """Warns once, on stderr, if no message has arrived after a while, with the likely reason."""

    def __init__(self, view: Monitor, graph: Any, topic: str) -> None:
        self._view, self._graph, self._topic = view, graph, topic
        self._deadline: float | None = monotonic() + _SILENCE_WARNING_S

    def check(self) -> None:
        if self._deadline is None or monotonic() < self._deadline:
            return
        self._deadline = None
        if not self._view.poses and not self._view.values:
            print(f'waiting for {self._topic}: {self._reason()}', file=sys.stderr, flush=True)

    def _reason(self) -> str:
        if offers := self._graph.publishers_of(self._topic):
            return f'{len(offers)} publish it, none sends'
        near = get_close_matches(self._topic, self._graph.published(_ODOMETRY), n=1, cutoff=0.0)
        return 'nobody publishes it' + (f'; did you mean {near[0]}?' if near else '')


def _print_pose(message: Any) -> None:
    """Print stamp, position and orientation as a line of a TUM file."""
    stamp, pose = message.header.stamp, message.pose.pose
    p, q = pose.position, pose.orientation
    print(f'{stamp.sec}.{stamp.nanosec:09d} {p.x:.6f} {p.y:.6f} {p.z:.6f} '
          f'{q.x:.6f} {q.y:.6f} {q.z:.6f} {q.w:.6f}', flush=True)
