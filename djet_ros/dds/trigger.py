"""
A service of type std_srvs/srv/Trigger, as ROS has it on Cyclone DDS (rmw_cyclonedds_cpp).

Requests come on the topic rq/<name>Request and answers go out on rr/<name>Reply; both begin with
16 bytes that name the client and count its requests, and that come back as they came.

Fast DDS (rmw_fastrtps_cpp) tells a request by its place in the writer's history, and wants that
beside the answer, outside of its bytes, where Cyclone lets nobody write. So its clients can't be
answered, and must not take the service for one that is there.
"""

from __future__ import annotations

from collections.abc import Callable
import re
import secrets
import struct
from time import monotonic, sleep
from typing import Any

from djet_ros.dds.graph import Graph
from djet_ros.live.middleware import Profile

_HEADER = slice(4, 20)
_PREFIX = 'std_srvs::srv::dds_::Trigger_'

_REMEDY = 'call it with RMW_IMPLEMENTATION=rmw_cyclonedds_cpp'

# Seconds that an answer waits for its client's subscription to be seen.
_PATIENCE = 0.1


class TriggerServer:
    """
    Calls an action on each request, and answers that it succeeded and what it did.

    complain is told of requests that can't be answered, and why.
    """

    def __init__(self, graph: Graph, name: str, action: Callable[[], str],
                 complain: Callable[[str], None]) -> None:
        self._name = name
        self._action = action
        self._complain = complain
        # By this a client knows that both topics belong to one server.
        own = f'serviceid={".".join(f"{byte:x}" for byte in secrets.token_bytes(16))};'
        profile = Profile(depth=10)
        self._graph = graph
        self._reply = f'rr{name}Reply'
        self._answers = graph.advertise_raw(self._reply, f'{_PREFIX}Response_', profile, own)
        # rmw_fastrtps takes a service for absent that has not as many writers as readers; for
        # rmw_cyclonedds the two that name the same service count.
        self._odd_one = graph.advertise_raw(self._reply, f'{_PREFIX}Response_', profile, '')
        self._strangers: set[str] = set()
        self._requests = graph.listen_raw(f'rq{name}Request', f'{_PREFIX}Request_', self._serve,
                                          profile, own)

    def look_for_strangers(self) -> None:
        """Complain of each new client that can't be answered."""
        for who in self._graph.listeners_without(self._reply, 'clientid=') - self._strangers:
            self._strangers.add(who)
            self._complain(f'a client on another middleware waits for {self._name}, which only '
                           f'those on Cyclone DDS can have; {_REMEDY}')

    def _serve(self, data: bytes, info: Any) -> None:
        header = data[_HEADER]
        if len(header) < 16:
            # Of others, what tells one request from another is nowhere that Cyclone shows.
            self._complain(f'a request for {self._name} came in the form of another middleware, '
                           f'and can not be answered; {_REMEDY}')
            return
        text = self._action().encode() + b'\0'
        client = re.search('clientid=[^;]*;', self._requests.user_data_of(info))
        if client:
            end = monotonic() + _PATIENCE
            while not self._answers.listens(client[0]) and monotonic() < end:
                sleep(0.005)
        self._answers.send(data[:4] + header + struct.pack(
            '<B3xI' if data[1] & 1 else '>B3xI', True, len(text)) + text)
