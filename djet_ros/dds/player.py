"""A bag player: publishes a recording on the graph at its recorded pace."""

from __future__ import annotations

from threading import Event
from time import monotonic

from djet_ros.dds.graph import Graph, Publisher
from djet_ros.dds.names import Names
from djet_ros.live.middleware import FRAMES_PROFILE, Profile
from djet_ros.odometry.static_frames import TOPIC, TYPE
from djet_ros.recordings.bags import BagMessage
from djet_ros.recordings.decoding import MAKE, message_type
from djet_ros.recordings.recording import Recording

# Waits for reliable subscriptions, and never for best-effort ones.
_STREAM = Profile(depth=None)
# CameraInfo, also for late subscribers.
_LATCHED = Profile(depth=1, latched=True)

# Seconds from the discovery of a subscription here to the discovery of this publisher there.
_DISCOVERY_TIME = 0.5


class Player:
    """
    Publishes the messages of a recording at rate times its pace; clock: publish /clock.

    images: number published so far; late: seconds by which the last message was behind schedule.
    """

    def __init__(self, graph: Graph, recording: Recording, names: Names, rate: float = 1.0,
                 clock: bool = False) -> None:
        """Advertise all topics, and publish the static frames."""
        self._graph = graph
        self._recording = recording
        self._names = names
        self._rate = rate
        self._publishers: dict[str, Publisher] = {}
        self._clock = graph.advertise('/clock', 'rosgraph_msgs/msg/Clock') if clock else None
        self.images, self.late = 0, 0.0
        self._advertise()
        self._publish_static_frames()

    def _advertise(self) -> None:
        """Advertise all topics before the first message, so that none is lost."""
        recording = self._recording
        missing = {recording.image_topic, recording.info_topic,
                   recording.ground_truth_topic, *recording.auxiliary.values()} - {None}
        for one in recording.messages():
            if one.topic in missing:
                missing.discard(one.topic)
                self._publishers[one.topic] = self._graph.advertise(
                    self._names.resolve(one.topic), one.message.__msgtype__,
                    _LATCHED if one.topic == recording.info_topic
                    else FRAMES_PROFILE if one.topic == recording.auxiliary.get('frames')
                    else _STREAM)
            if not missing:
                return

    def _publish_static_frames(self) -> None:
        """Publish the newest of each static frame, latched."""
        newest = {one.child_frame_id: one for message in self._recording.static_frames()
                  for one in message.transforms}
        if newest:
            self._frames = self._graph.advertise(TOPIC, TYPE, _LATCHED)
            self._frames.publish(message_type(TYPE)(transforms=list(newest.values())))

    @property
    def image_topic(self) -> str:
        """Return the resolved image topic."""
        return self._names.resolve(self._recording.image_topic)

    def wait_for_listener(self, stop: Event) -> None:
        """Wait until the images have a subscriber."""
        images = self._publishers[self._recording.image_topic]
        while not images.listeners:
            if stop.wait(0.05):
                return
        stop.wait(_DISCOVERY_TIME)

    def play(self, stop: Event) -> None:
        """Play once, and wait until reliable subscriptions have received everything."""
        start: float | None = None
        first = 0
        for one in self._recording.messages():
            if one.topic not in self._publishers:
                continue
            if start is None:
                start, first = monotonic(), one.stamp_ns
            due = start + (one.stamp_ns - first) / 1e9 / self._rate
            if stop.wait(max(0.0, due - monotonic())):
                return
            self._send(one, stop)
            self.late = monotonic() - due
        for publisher in self._publishers.values():
            while not (stop.is_set() or publisher.wait_until_taken(0.2)):
                pass

    def _send(self, one: BagMessage, stop: Event) -> None:
        if self._clock is not None:
            self._clock.publish(message_type('rosgraph_msgs/msg/Clock')(
                clock=MAKE.time(one.stamp_ns)))
        while not self._publishers[one.topic].publish(one.message):
            if stop.wait(0.005):
                return
        self.images += one.topic == self._recording.image_topic
