"""The live node on DDS: the wiring of a session to topics and services."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
import sys
from threading import Event
from time import monotonic, time_ns
from typing import Any

from djet_ros.config.sections import Config
from djet_ros.dds.graph import Graph, Profile, Subscription
from djet_ros.dds.names import Names
from djet_ros.dds.trigger import TriggerServer
from djet_ros.errors import DjetError
from djet_ros.live.session import Session
from djet_ros.live.topics import (
    full_name,
    image_topics,
    IMAGE_TYPES,
    INFO_TYPE,
    odometry_outputs,
    SPEED_TYPES,
)
from djet_ros.odometry.messages import ns_of_time, seconds_and_rest
from djet_ros.odometry.tracker import Outgoing, Tracker
from djet_ros.recordings.decoding import message_type

_TICK = 1.0
_GARBAGE_LOG_PERIOD = 5.0


class LiveNode:
    """
    The odometry on the graph; what arrives is taken in by the thread that calls ``spin``.

    use_sim_time: diagnostics are stamped by /clock. Raises DjetError where the configuration
    asks for what a live graph does not have.
    """

    def __init__(self, graph: Graph, config: Config, names: Names,
                 use_sim_time: bool = False) -> None:
        if config.odometry.scale == 'ground_truth':
            raise DjetError("odometry.scale is 'ground_truth', which only a recording has; "
                            'choose none, constant or speed')
        self._graph = graph
        self._names = names
        self._clock: int | None = None
        self._last_garbage = self._last_tick = -float('inf')
        image, self._info_topic = image_topics(names.resolve, names.expand,
                                               config.ros.image_transport)
        self._session = Session(Tracker(config, message_type, image_topic=image), self,
                                {'image': image, 'camera_info': self._info_topic})
        self._outputs = {topic: graph.advertise(names.resolve(full_name(topic)), kind)
                         for topic, kind in odometry_outputs(config.ros).items()}
        self._inputs = self._listen(config, image, use_sim_time)
        self._images = self._inputs[-1]
        self._latched: Subscription | None = None
        self._services = [TriggerServer(graph, names.resolve(f'~/{name}'), action)
                          for name, action in (('reset', self._session.reset),
                                               ('pause', self._session.pause),
                                               ('resume', self._session.resume))]
        self.log('info', f'images from {image}, camera_info from {self._info_topic}, queue '
                         f'policy {config.ros.queue_policy}')

    def run(self, stop: Event) -> int:
        """Work until stop is set; 1 where the odometry ended by an error."""
        self._session.start()
        try:
            while not stop.is_set():
                self._graph.spin(0.1)
                if self._session.failed:
                    return 1
                if monotonic() - self._last_tick >= _TICK:
                    self._last_tick = monotonic()
                    self._tick()
            return 0
        finally:
            self._session.stop()

    # What the session asks for

    def publish(self, outgoing: Sequence[Outgoing]) -> None:
        """Publish messages; diagnostics are of now, all others of their image's time."""
        for topic, message in outgoing:
            if topic == '/diagnostics':
                now = time_ns() if self._clock is None else self._clock
                stamp = message.header.stamp
                stamp.sec, stamp.nanosec = seconds_and_rest(now)
            if not self._outputs[topic].publish(message):
                self.log('warning', f'a message on {topic} was not sent: a subscription does not '
                                    'keep up')

    def log(self, level: str, text: str) -> None:
        """Log a line, in the form of ROS's log."""
        name = {'info': 'INFO', 'warning': 'WARN', 'error': 'ERROR'}[level]
        seconds, rest = seconds_and_rest(time_ns())
        print(f'[{name}] [{seconds}.{rest:09d}] [{self._names.node}]: {text}',
              file=sys.stderr, flush=True)

    def count_publishers(self, topic: str) -> int:
        """Count who publishes a topic."""
        return len(self._graph.offers(topic))

    def wants_debug_image(self) -> bool:
        """Tell whether anybody subscribes to the debug image."""
        return bool(self._outputs['debug_image'].listeners)

    # Inputs and outputs

    def _listen(self, config: Config, image: str, use_sim_time: bool) -> list[Subscription]:
        """Subscribe to all inputs, the images last: what belongs to one is taken before it."""
        every = config.ros.queue_policy == 'every'
        profile = Profile(reliable=every or config.ros.qos_reliability == 'reliable',
                          depth=None if every else config.ros.qos_depth)
        listen = partial(self._graph.listen, profile=profile, garbage=self._note_garbage)
        session, resolve = self._session, self._names.resolve
        inputs = [listen(self._info_topic, INFO_TYPE, session.camera_info)]
        if config.odometry.scale == 'speed':
            inputs += [listen(resolve(topic), kind, session.speed)
                       for topic, kind in SPEED_TYPES.items()]
        if use_sim_time:
            self._clock = 0
            inputs.append(self._graph.listen('/clock', 'rosgraph_msgs/msg/Clock',
                                             self._take_clock, Profile(False, 1)))
        # One at a time: 'image' waits where the queue is full, and the services need their turn.
        inputs.append(self._graph.listen(
            image, IMAGE_TYPES[config.ros.image_transport], session.image, profile, batch=1,
            garbage=self._lose_garbage))
        return inputs

    def _take_clock(self, message: Any) -> None:
        self._clock = ns_of_time(message.clock)

    def _lose_garbage(self, reason: str) -> None:
        """Count an image that can't be read as one that never came."""
        self._session.count_lost(1)
        self._note_garbage(reason)

    def _note_garbage(self, reason: str) -> None:
        if monotonic() - self._last_garbage >= _GARBAGE_LOG_PERIOD:
            self._last_garbage = monotonic()
            self.log('warning', reason)

    # Once a second

    def _tick(self) -> None:
        self._session.count_lost(self._images.new_losses())
        for subscription in self._inputs:
            if subscription.new_refusals():
                self._report_mismatch(subscription)
        self._listen_for_latched()
        self._session.tick()

    def _listen_for_latched(self) -> None:
        """Hear a CameraInfo that was sent before this node was there, where it was latched."""
        # To ask everybody for it would keep those away that do not latch.
        if self._latched is None:
            for _, offered in self._graph.offers(self._info_topic):
                if offered.latched:
                    self._latched = self._graph.listen(
                        self._info_topic, INFO_TYPE, self._session.camera_info,
                        Profile(offered.reliable, 1, latched=True), garbage=self._note_garbage)
                    return

    def _report_mismatch(self, subscription: Subscription) -> None:
        topic, ours = subscription.topic, subscription.profile
        for who, offered in self._graph.offers(topic):
            if ours.incompatible_with(offered):
                self.log('error', f'incompatible QoS on {topic}: participant {who} offers '
                                  f'{offered}, {self._names.full_node} asks for {ours}. Nothing '
                                  'is received from it; set ros.qos_reliability')
