"""The part common to all live nodes: topics, QoS checks and the main loop, on any middleware."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from difflib import get_close_matches
from threading import Event
from time import monotonic
from typing import Any, Protocol

from djet_ros.config.sections import NodeConfig
from djet_ros.core.types import Array
from djet_ros.live.middleware import Middleware, Profile, Publisher, PublisherInfo, Subscription
from djet_ros.live.topics import full_name, image_topics, IMAGE_TYPES, INFO_TYPE
from djet_ros.odometry.messages import seconds_and_rest
from djet_ros.odometry.tracker import Outgoing

# Seconds between two calls of the periodic checks.
_TICK_PERIOD = 1.0

# Longest wait for messages in seconds: normally, and while the image queue is full.
_SPIN_TIMEOUT, _FULL_QUEUE_SPIN_TIMEOUT = 0.1, 0.005

_IMAGE = IMAGE_TYPES['raw']


class LiveSession(Protocol):
    """The worker of a node, which processes messages in its own thread."""

    def start(self) -> None:
        """Start the worker thread."""

    def stop(self) -> None:
        """Stop publishing."""

    @property
    def failed(self) -> bool:
        """Whether the worker thread ended with an error."""

    def tick(self) -> None:
        """Log and publish what is due without a message; called once a second."""

    @property
    def wants_frames(self) -> bool:
        """Whether a mounting still has to be looked up on tf."""

    @property
    def has_room(self) -> bool:
        """Whether the queue accepts an image."""

    def image(self, message: Any) -> None:
        """Take an Image or a CompressedImage."""

    def camera_info(self, message: Any) -> None:
        """Take a CameraInfo."""

    def count_lost(self, number: int) -> None:
        """Count images that were sent and did not arrive."""


class LiveNode:
    """Base class of the live nodes: connects a session with the middleware."""

    # Set by the subclass, before it subscribes.
    session: LiveSession

    # Set by ``listen_to_camera``, before ``run``.
    _info_topic: str
    _images: Subscription

    def __init__(self, middleware: Middleware) -> None:
        self._middleware = middleware
        self._outputs: dict[str, Publisher] = {}
        self._inputs: list[Subscription] = []
        # ROS types of the subscriptions, by topic.
        self._kinds: dict[str, str] = {}
        self._refused: list[Subscription] = []
        # Topics whose QoS is that of the parameters.
        self._as_configured: set[str] = set()
        self._latched = self._tf_subscribed = False
        self._remedy = 'ros.qos_reliability to best_effort'
        self._last_tick = -float('inf')

    def run(self, stop: Event) -> int:
        """Run until stop is set; return the exit code, 1 if the session failed."""
        self.session.start()
        try:
            while not stop.is_set():
                # While the image queue is full, nothing signals that it has room again.
                self._middleware.spin(_SPIN_TIMEOUT if self._takes_images()
                                      else _FULL_QUEUE_SPIN_TIMEOUT)
                if self.session.failed:
                    return 1
                if monotonic() - self._last_tick >= _TICK_PERIOD:
                    self._last_tick = monotonic()
                    self._tick()
            return 0
        finally:
            self.session.stop()

    # What a session needs (Wiring)

    def publish(self, outgoing: Sequence[Outgoing]) -> None:
        """Publish messages; diagnostics are stamped now, all others as their image."""
        for topic, message in outgoing:
            if topic == '/diagnostics':
                stamp = message.header.stamp
                stamp.sec, stamp.nanosec = seconds_and_rest(self._middleware.now_ns())
            if not self._outputs[topic].publish(message):
                self.log('warning', f'a message on {topic} was dropped: a subscriber does not '
                                    'keep up; have it subscribe with best_effort')

    def log(self, level: str, text: str) -> None:
        """Log a line."""
        self._middleware.log(level, text)

    def why_silent(self, topic: str) -> str:
        """Return why no messages may be arriving on a topic, and what to do about it."""
        wanted = self._kinds[topic]
        offers = self._middleware.publishers_of(topic)
        if kinds := {offer.kind for offer in offers} - {wanted}:
            return f'its type is {", ".join(sorted(kinds))}, not {wanted}' + (
                _transport_remedy(kinds))
        if offers:
            return (f'no messages arrive from {" and ".join(sorted({one.who for one in offers}))}'
                    + self._loss_remedy(topic, offers))
        if _IMAGE in (wanted, *kinds) and self._middleware.publishers_of(f'{topic}/compressed'):
            return (f'it has no publisher, but {topic}/compressed has; set '
                    'ros.image_transport:=compressed')
        own = {self._middleware.resolve(full_name(output)) for output in self._outputs}
        # The debug image of another odometry is not a camera.
        elsewhere = sorted(name for name in set(self._middleware.published(wanted)).difference(
            self._kinds, own) if not name.endswith('/debug_image'))
        near = get_close_matches(topic, elsewhere, n=1, cutoff=0.0)
        if not near:
            return 'it has no publisher'
        # Remapping image alone works only for compressed topics that end in /compressed.
        how = ('' if wanted != IMAGE_TYPES['compressed'] or near[0].endswith('/compressed')
               else f' remap {topic}:={near[0]}')
        return f'it has no publisher; did you mean {near[0]}?{how}'

    def _loss_remedy(self, topic: str, offers: Sequence[PublisherInfo]) -> str:
        """Return the remedy for large images that lose fragments, which no event reports."""
        images = self._images
        if topic != images.topic or images.profile.reliable:
            return ''
        reliable = all(offer.profile.reliable for offer in offers)
        return ('; large images may be lost with best-effort QoS: '
                + 'set ros.qos_reliability to reliable, or ' * reliable
                + 'increase the socket buffers of the middleware')

    def wants(self, topic: str) -> bool:
        """Return whether an output has subscribers."""
        output = self._outputs.get(topic)
        return output is not None and bool(output.listeners)

    def now_ns(self) -> int:
        """Return the time of the node's clock in nanoseconds, which may be simulated."""
        return self._middleware.now_ns()

    def transform(self, parent: str, child: str) -> Array | None:
        """Return the pose (4, 4) of frame child in parent, or None if tf does not have it yet."""
        return self._middleware.transform(parent, child)

    # Inputs and outputs

    def image_topics(self, config: NodeConfig) -> tuple[str, str]:
        """Return the resolved topics of the images and of their CameraInfo."""
        if config.queue_policy == 'every':
            # It subscribes reliably, whatever ros.qos_reliability is.
            self._remedy = 'ros.queue_policy to latest'
        return image_topics(self._middleware.resolve, self._middleware.is_remapped,
                            config.image_transport)

    def advertise(self, outputs: Mapping[str, str]) -> None:
        """Create publishers for the topics, given with their types, that have none yet."""
        for topic, kind in outputs.items():
            if topic not in self._outputs:
                self._outputs[topic] = self._middleware.advertise(
                    self._middleware.resolve(full_name(topic)), kind)

    def listen(self, topic: str, kind: str, callback: Callable[[Any], None],
               profile: Profile, ready: Callable[[], bool] | None = None, *,
               as_configured: bool = True, many: bool = False) -> Subscription:
        """
        Subscribe to a resolved topic; publishers with incompatible QoS are reported.

        as_configured: whether the profile is that of ``input_profile``, which parameters set;
        ready, many: see ``Middleware.listen``.
        """
        self._kinds[topic] = kind
        if as_configured:
            self._as_configured.add(topic)
        self._inputs.append(self._middleware.listen(topic, kind, callback, profile, ready,
                                                    many=many))
        return self._inputs[-1]

    def listen_to_camera(self, image: str, info: str, transport: str, profile: Profile) -> None:
        """Subscribe to images and their CameraInfo; to be called after all other subscriptions."""
        self._info_topic = info
        # CameraInfo first, so that it is taken before an image that arrived together with it.
        # Both wait while the image queue is full; other inputs never do.
        self.listen(info, INFO_TYPE, self.session.camera_info, profile, self._takes_images)
        self._images = self.listen(image, IMAGE_TYPES[transport], self.session.image, profile,
                                   self._takes_images)

    def _takes_images(self) -> bool:
        """Return whether to take images now: always, if publishers cannot be made to wait."""
        return not self._middleware.publishers_block or self.session.has_room

    def update_tf_subscription(self) -> None:
        """Subscribe to tf only while a mounting is unknown: a robot's tf traffic costs time."""
        wanted = self.session.wants_frames
        if wanted == self._tf_subscribed:
            return
        self._tf_subscribed = wanted
        if wanted:
            self._middleware.subscribe_tf()
        else:
            self._middleware.unsubscribe_tf()

    # Once a second

    def _tick(self) -> None:
        self.update_tf_subscription()
        self.session.count_lost(self._images.new_losses())
        # Report on the next tick: the name of a publisher is known a little later than its QoS.
        refused = [one for one in self._inputs if one.new_incompatible()]
        for subscription in self._refused:
            self._report_mismatch(subscription)
        self._refused = refused
        self._listen_for_latched()
        self.session.tick()

    def _listen_for_latched(self) -> None:
        """Subscribe to a latched CameraInfo, which may have been sent before this node started."""
        # Requesting transient_local always would be incompatible with volatile publishers.
        if self._latched:
            return
        for _, _, offered in self._middleware.publishers_of(self._info_topic):
            if offered.latched:
                self._latched = True
                self._middleware.listen(self._info_topic, INFO_TYPE, self.session.camera_info,
                                        Profile(offered.reliable, 1, latched=True))
                return

    def _report_mismatch(self, subscription: Subscription) -> None:
        topic, ours = subscription.topic, subscription.profile
        for who, _, offered in self._middleware.publishers_of(topic):
            if ours.incompatible_with(offered):
                self.log('error', f'incompatible QoS on {topic}: {who} offers {offered}, '
                         f'{self._middleware.node} requests {ours}; no messages are received from '
                         f'it; {self._qos_remedy(topic, ours)}')

    def _qos_remedy(self, topic: str, ours: Profile) -> str:
        overrides = self._middleware.qos_override_names.format(topic=topic)
        if topic in self._as_configured:
            return ' or '.join(filter(None, [f'set {self._remedy}', overrides]))
        # Overrides do not apply to latched subscriptions.
        return f'configure the publisher to offer {ours}' + (
            f', or set {overrides}' if overrides and not ours.latched else '')


def _transport_remedy(kinds: Collection[str]) -> str:
    """Return the parameter to set for images of another transport, if it is one."""
    found = [transport for transport, kind in IMAGE_TYPES.items() if kind in kinds]
    return f'; set ros.image_transport:={found[0]}' if found else ''


def input_profile(config: NodeConfig) -> Profile:
    """Return the QoS of the inputs; queue_policy 'every' needs reliable and keep-all."""
    every = config.queue_policy == 'every'
    return Profile(reliable=every or config.qos_reliability == 'reliable',
                   depth=None if every else config.qos_depth)
