"""
A process on the ROS graph that publishes, subscribes and calls on request by standard input.

Each line in is a JSON object with the name of a function in 'do' and its arguments; the answer
is a line {"answer": ...}. What is heard comes as lines {"topic": ..., "data": ...}. Messages are
bytes as on the wire, in base64, so that whoever drives this process needs no ROS.
"""

from __future__ import annotations

from base64 import b64decode, b64encode
from contextlib import suppress
from importlib import import_module
import json
import sys
from threading import Lock, Thread
from time import monotonic, sleep

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import QoSDurabilityPolicy, QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy

# Longer than the lease of a participant of Fast DDS that left without notice.
PATIENCE = 45.0


class Peer:
    """The functions that can be called."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._publishers = {}
        self._subscriptions = {}
        self._stdout = Lock()

    def advertise(self, topic, kind, **qos):
        self._publishers[topic] = self._node.create_publisher(ros_type(kind), topic, profile(qos))

    def matched(self, topic, count=1):
        """Wait for a number of subscriptions."""
        self._until(lambda: self._publishers[topic].get_subscription_count() >= count)

    def alone(self, topic):
        """Wait until there are no subscriptions any more."""
        self._until(lambda: not self._publishers[topic].get_subscription_count())

    def send(self, topic, data):
        self._publishers[topic].publish(b64decode(data))

    def subscribe(self, topic, kind, **qos):
        self._subscriptions[topic] = self._node.create_subscription(
            ros_type(kind), topic,
            lambda data: self.say(topic=topic, data=b64encode(data).decode()),
            profile(qos), raw=True)

    def unsubscribe(self, topic):
        self._node.destroy_subscription(self._subscriptions.pop(topic))

    def published(self, topic, count=1):
        """Wait for a number of publishers."""
        self._until(lambda: self._node.count_publishers(topic) == count)

    def call(self, service, kind):
        client = self._node.create_client(ros_type(kind), service)
        assert client.wait_for_service(PATIENCE), f'no service {service}'
        answer = self._result(client.call_async(ros_type(kind).Request()))
        return {name: getattr(answer, name) for name in answer.get_fields_and_field_types()}

    def configure(self, node, values):
        """Set parameters one by one; returns (successful, reason) for each."""
        client = AsyncParameterClient(self._node, node)
        assert client.wait_for_services(PATIENCE), f'no parameters of {node}'
        answer = self._result(client.set_parameters(
            [Parameter(name, value=value) for name, value in values.items()]))
        return [(one.successful, one.reason) for one in answer.results]

    def configured(self, node, names):
        client = AsyncParameterClient(self._node, node)
        assert client.wait_for_services(PATIENCE), f'no parameters of {node}'
        return [rclpy.parameter.parameter_value_to_python(value)
                for value in self._result(client.get_parameters(names)).values]

    def say(self, **what):
        with self._stdout:
            print(json.dumps(what), flush=True)

    def _result(self, future):
        self._until(future.done)
        return future.result()

    @staticmethod
    def _until(condition):
        end = monotonic() + PATIENCE
        while not condition():
            assert monotonic() < end, 'nothing happened'
            sleep(0.01)


def ros_type(name):
    package, kind, short = name.split('/')
    return getattr(import_module(f'{package}.{kind}'), short)


def profile(qos):
    return QoSProfile(
        history=QoSHistoryPolicy[qos.get('history', 'keep_last').upper()],
        depth=qos.get('depth', 100),
        reliability=QoSReliabilityPolicy[qos.get('reliability', 'reliable').upper()],
        durability=QoSDurabilityPolicy[qos.get('durability', 'volatile').upper()])


def spin(node):
    with suppress(ExternalShutdownException):
        rclpy.spin(node)


def main():
    rclpy.init()
    node = rclpy.create_node(sys.argv[1])
    peer = Peer(node)
    thread = Thread(target=spin, args=[node])
    thread.start()
    for line in sys.stdin:
        command = json.loads(line)
        try:
            answer = getattr(peer, command.pop('do'))(**command)
            peer.say(answer=answer)
        except AssertionError as error:
            peer.say(error=str(error))
    rclpy.shutdown()
    thread.join()


if __name__ == '__main__':
    main()
