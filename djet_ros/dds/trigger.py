"""
A std_srvs/srv/Trigger service, compatible with ROS on Cyclone DDS (rmw_cyclonedds_cpp).

Requests arrive on topic rq/<name>Request, and responses go to rr/<name>Reply. Both begin with 16
bytes, the client's id and request number, which the response repeats.

Fast DDS (rmw_fastrtps_cpp) identifies a request by its sequence number in the writer, and expects
it in the metadata of the response, which Cyclone does not let users set. Its clients cannot be
answered, so the service must appear absent to them.
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

# Seconds for which a response waits for the discovery of its client's subscription.
_DISCOVERY_TIMEOUT = 0.1


class TriggerServer:
    """
    Calls an action on each request, and responds with success and the text it returns.

    complain: called with the reason for each request that cannot be answered.
    """

    def __init__(self, graph: Graph, name: str, action: Callable[[], str],
                 complain: Callable[[str], None]) -> None:
        self._name = name
        self._action = action
        self._complain = complain
        # Tells clients that both topics belong to one server.
        own = f'serviceid={".".join(f"{byte:x}" for byte in secrets.token_bytes(16))};'
        profile = Profile(depth=10)
        self._graph = graph
        self._reply = f'rr{name}Reply'
        self._answers = graph.advertise_raw(self._reply, f'{_PREFIX}Response_', profile, own)
        # A second writer: to rmw_fastrtps a service whose numbers of writers and readers differ is
        # absent; rmw_cyclonedds counts only those with the same service id.
        self._second_writer = graph.advertise_raw(self._reply, f'{_PREFIX}Response_', profile, '')
        self._unsupported: set[str] = set()
        self._requests = graph.listen_raw(f'rq{name}Request', f'{_PREFIX}Request_', self._serve,
                                          profile, own)

    def report_unsupported_clients(self) -> None:
        """Complain once of each client that cannot be answered."""
        for who in self._graph.listeners_without(self._reply, 'clientid=') - self._unsupported:
            self._unsupported.add(who)
            self._complain(f'a client of {self._name} uses another middleware, and only clients '
                           f'on Cyclone DDS can be answered; {_REMEDY}')

    def _serve(self, data: bytes, info: Any) -> None:
        header = data[_HEADER]
        if len(header) < 16:
            # Cyclone does not expose how other middlewares identify a request.
            self._complain(f'a request for {self._name} came from another middleware, and cannot '
                           f'be answered; {_REMEDY}')
            return
        text = self._action().encode() + b'\0'
        client = re.search('clientid=[^;]*;', self._requests.user_data_of(info))
        if client:
            end = monotonic() + _DISCOVERY_TIMEOUT
            while not self._answers.listens(client[0]) and monotonic() < end:
                sleep(0.005)
        self._answers.send(data[:4] + header + struct.pack(
            '<B3xI' if data[1] & 1 else '>B3xI', True, len(text)) + text)
