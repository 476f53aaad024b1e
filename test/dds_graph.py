"""A peer on a separate DDS graph, and commands that run on it as processes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from importlib.util import find_spec
import os
from pathlib import Path
import signal
import subprocess
import sys
from time import monotonic
from typing import Any

from djet_ros.live.middleware import Profile
import pytest

# For the modules that use this one. A skip at their import would end more than them: plugins
# import all modules of a folder while they collect it.
needs_dds = pytest.mark.skipif(find_spec('cyclonedds') is None,
                               reason="cyclonedds is missing: pip install '.[dds]'")

PATIENCE = 30.0
NODE = '/vo_node'
DEEP = Profile(depth=1000)
TYPES = {
    f'{NODE}/relative_pose': 'geometry_msgs/msg/PoseStamped',
    f'{NODE}/relative_pose_cov': 'geometry_msgs/msg/PoseWithCovarianceStamped',
    f'{NODE}/relative_pose_status': 'diagnostic_msgs/msg/DiagnosticArray',
    f'{NODE}/odometry': 'nav_msgs/msg/Odometry',
    '/diagnostics': 'diagnostic_msgs/msg/DiagnosticArray',
}

# Not the graph of a robot that happens to be near.
ENVIRONMENT = {
    **{name: value for name, value in os.environ.items() if name != 'CYCLONEDDS_URI'},
    'ROS_DOMAIN_ID': str(1 + os.getpid() % 100), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
    'OMP_NUM_THREADS': '1',
    'PYTHONPATH': os.pathsep.join(filter(None, [
        str(Path(__file__).parents[1]), os.environ.get('PYTHONPATH', '')]))}


class Peer:
    """Subscribes to the odometry, and publishes, in the process of the test."""

    def __init__(self) -> None:
        from djet_ros.dds.graph import Graph
        self.graph = Graph(ENVIRONMENT)
        self.received: dict[str, list[Any]] = defaultdict(list)
        for topic, kind in TYPES.items():
            self.listen(topic, kind)

    def listen(self, topic: str, kind: str) -> None:
        """Collect in ``heard`` what is published."""
        self.graph.listen(topic, kind, self.received[topic].append, DEEP)

    def advertise(self, topic: str, kind: str, profile: Profile = DEEP,
                  listeners: int = 1) -> Any:
        """Publish from now on, and wait for a number of subscriptions."""
        publisher = self.graph.advertise(topic, kind, profile)
        self.wait(f'a listener on {topic}', lambda: publisher.listeners >= listeners)
        return publisher

    def wait(self, what: str, condition: Callable[[], Any], seconds: float = PATIENCE) -> Any:
        """Take messages until a condition holds, and return its value."""
        end = monotonic() + seconds
        while not (value := condition()):
            counts = {topic: len(messages) for topic, messages in self.received.items()}
            assert monotonic() < end, f'{what} did not come; received {counts}'
            self.graph.spin(0.05)
        return value

    def spin(self, seconds: float) -> None:
        """Take messages for a while."""
        end = monotonic() + seconds
        while monotonic() < end:
            self.graph.spin(0.05)

    def diagnostics(self, **wanted: str) -> dict[str, str] | None:
        """Return the last diagnostics that have these values; underscores stand for blanks."""
        for message in reversed(self.received['/diagnostics']):
            values = {pair.key: pair.value for pair in message.status[0].values}
            values['message'] = message.status[0].message
            if all(values.get(key.replace('_', ' ')) == value for key, value in wanted.items()):
                return values
        return None


class Command:
    """A djet command in another process; before: Python code to run first."""

    def __init__(self, log: Path, *arguments: str | Path, before: str = '') -> None:
        self.path = log
        with log.open('w') as file:
            self.process = subprocess.Popen(
                [sys.executable, '-c', f'{before}from djet_ros.cli.main import main; '
                 'raise SystemExit(main())', *map(str, arguments)],
                env=ENVIRONMENT, stdout=file, stderr=subprocess.STDOUT)

    @property
    def log(self) -> str:
        """Return its output so far."""
        return self.path.read_text()

    def finish(self) -> str:
        """Wait for exit code 0, and return the output."""
        assert self.process.wait(PATIENCE) == 0, self.log
        return self.log

    def end(self, number: int = signal.SIGINT) -> tuple[int, float]:
        """Send a signal; returns the exit code and the seconds until the end."""
        start = monotonic()
        self.process.send_signal(number)
        code = self.process.wait(10)
        return code, monotonic() - start
