"""Processes on a separate ROS graph: the node under test, and its peers."""

from __future__ import annotations

from base64 import b64decode, b64encode
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
from threading import Condition, Thread
from time import monotonic
from typing import Any

from ros_messages import serialised, STORE

HERE = Path(__file__).parent
NODE = '/vo_node'
PATIENCE = 60.0

# Not the graph of a robot that happens to be near.
ENVIRONMENT = {**os.environ, 'ROS_DOMAIN_ID': str(1 + os.getpid() % 100),
               'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', 'OMP_NUM_THREADS': '1',
               'PYTHONPATH': os.pathsep.join(filter(None, [
                   str(HERE.parent), os.environ.get('PYTHONPATH', '')]))}


def command(node: str, before: str = '') -> list[str]:
    """Return the command that runs a node; before: Python code to run first."""
    return [sys.executable, '-c', f'{before}import sys; from djet_ros.cli.nodes import {node}; '
            f'sys.exit({node}())']


class Peer:
    """A process that publishes, subscribes or calls; see ros_peer.py."""

    def __init__(self, name: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, str(HERE / 'ros_peer.py'), name], env=ENVIRONMENT, text=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self._changed = Condition()
        self._answers: list[dict[str, Any]] = []
        self._ended = False
        self.received: dict[str, list[Any]] = defaultdict(list)
        self._types: dict[str, str] = {}
        Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for line in self._process.stdout or ():
            said = json.loads(line)
            with self._changed:
                if 'topic' in said:
                    kind = self._types[said['topic']]
                    self.received[said['topic']].append(
                        STORE.deserialize_cdr(b64decode(said['data']), kind))
                else:
                    self._answers.append(said)
                self._changed.notify_all()
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def ask(self, do: str, **arguments: Any) -> Any:
        """Call a function of the peer, and return its answer."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps({'do': do, **arguments}) + '\n')
        self._process.stdin.flush()
        with self._changed:
            assert self._changed.wait_for(lambda: self._answers or self._ended, PATIENCE)
            assert self._answers, f'the peer ended on {do}'
            said = self._answers.pop(0)
        assert 'answer' in said, f'{do} {arguments}: {said}'
        return said['answer']

    def advertise(self, topic: str, kind: str, listeners: int = 1, **qos: Any) -> None:
        """Publish from now on, and wait for a number of subscriptions."""
        self.ask('advertise', topic=topic, kind=kind, **qos)
        self.ask('matched', topic=topic, count=listeners)

    def send(self, topic: str, message: Any) -> None:
        """Publish a message."""
        self.ask('send', topic=topic, data=b64encode(serialised(message)).decode())

    def listen(self, topic: str, kind: str, **qos: Any) -> None:
        """Collect in ``heard`` what is published."""
        self._types[topic] = kind
        self.ask('subscribe', topic=topic, kind=kind, **qos)

    def wait(self, what: str, condition: Callable[[dict[str, list[Any]]], Any],
             seconds: float = PATIENCE) -> Any:
        """Wait until a condition of the received messages holds, and return its value."""
        with self._changed:
            value = self._changed.wait_for(lambda: condition(self.received), seconds)
            counts = {topic: len(messages) for topic, messages in self.received.items()}
            said = self.received.get('/diagnostics', [])[-1:]
            assert value, f'{what} did not come; received {counts}, last {said}'
        return value

    def call(self, service: str, node: str = NODE) -> Any:
        """Call a service of the node under test."""
        return self.ask('call', service=f'{node}/{service}', kind='std_srvs/srv/Trigger')

    def kill(self) -> None:
        """Kill the process, as a crash would."""
        self._process.kill()
        self._process.wait()

    def close(self) -> None:
        """End the process."""
        if self._process.poll() is not None:
            return
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()


class NodeProcess:
    """The node under test in another process, with its log."""

    def __init__(self, log: Path, ros_arguments: Sequence[str], parameters: Mapping[str, Any],
                 name: str = 'vo_node', before: str = '') -> None:
        """Start it with arguments for ROS, such as remappings, and with parameters by name."""
        self.path = log
        values = [word for name, value in parameters.items()
                  for word in ('-p', f'{name}:={json.dumps(value)}')]
        with log.open('w') as file:
            self.process = subprocess.Popen(
                [*command(name, before), '--ros-args', *ros_arguments, *values],
                env=ENVIRONMENT, stdout=file, stderr=subprocess.STDOUT)

    @property
    def log(self) -> str:
        """Return the log of the node so far."""
        return self.path.read_text()

    def end(self, number: int = signal.SIGINT) -> tuple[int, float]:
        """Send a signal; returns the exit code and the seconds until the end."""
        start = monotonic()
        self.process.send_signal(number)
        code = self.process.wait(10)
        return code, monotonic() - start


@contextmanager
def peer(name: str, topics: Mapping[str, str] | None = None) -> Iterator[Peer]:
    """Return a peer that listens to topics by type, and end it."""
    one = Peer(name)
    for topic, kind in (topics or {}).items():
        one.listen(topic, kind)
    yield one
    one.close()


@contextmanager
def nodes(folder: Path, image: str) -> Iterator[Callable[..., NodeProcess]]:
    """Return a function that starts a node on images, and end all of them with clean logs."""
    started: list[NodeProcess] = []

    def start(*ros_arguments: str, name: str = 'vo_node', before: str = '',
              **parameters: Any) -> NodeProcess:
        log = folder / f'{name}_{len(started)}.log'
        started.append(NodeProcess(log, [*ros_arguments, '-r', f'image:={image}'], parameters,
                                   name, before))
        return started[-1]

    yield start
    for one in started:
        if one.process.poll() is None:
            code, _ = one.end()
            assert code == 0, one.log
        assert 'Traceback' not in one.log, one.log
