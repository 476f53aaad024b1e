"""The wiring of a live node, whatever carries its messages."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from difflib import get_close_matches
from threading import Event
from time import monotonic
from typing import Any, Protocol

from djet_ros.config.sections import NodeConfig
from djet_ros.core.types import Array
from djet_ros.live.middleware import Middleware, Offer, Profile, Publisher, Subscription
from djet_ros.live.topics import full_name, image_topics, IMAGE_TYPES, INFO_TYPE
from djet_ros.odometry.messages import seconds_and_rest
from djet_ros.odometry.tracker import Outgoing

_TICK = 1.0

# Seconds to wait for messages at most: with room for images, and until there is.
_PAUSE, _MOMENT = 0.1, 0.005

_IMAGE = IMAGE_TYPES['raw']


class LiveSession(Protocol):
    """What a node has its work done by, in a thread of its own."""

    def start(self) -> None:
        """Begin to work."""

    def stop(self) -> None:
        """Publish nothing more."""

    @property
    def failed(self) -> bool:
        """Whether the work ended by an error."""

    def tick(self) -> None:
        """Say what no message makes it say; called once a second."""

    @property
    def wants_frames(self) -> bool:
        """Whether tf is still to be asked how anything is mounted."""

    @property
    def has_room(self) -> bool:
        """Whether an image would be taken at once."""

    def image(self, message: Any) -> None:
        """Take an Image or a CompressedImage."""

    def camera_info(self, message: Any) -> None:
        """Take a CameraInfo."""

    def count_lost(self, number: int) -> None:
        """Count images that were sent and never came."""


class Face:
    """A node around a session, to which it is the wiring: it publishes from its thread."""

    # To be made by a subclass, before it listens.
    session: LiveSession

    # To be had by ``listen_to_camera``, before it runs.
    _info_topic: str
    _images: Subscription

    def __init__(self, middleware: Middleware) -> None:
        self._middleware = middleware
        self._outputs: dict[str, Publisher] = {}
        self._inputs: list[Subscription] = []
        # ROS types of what is heard, by topic.
        self._kinds: dict[str, str] = {}
        self._refused: list[Subscription] = []
        # Topics whose quality of service is as our parameters say.
        self._as_configured: set[str] = set()
        self._latched = self._follows_frames = False
        self._remedy = 'ros.qos_reliability to best_effort'
        self._last_tick = -float('inf')

    def run(self, stop: Event) -> int:
        """Work until stop is set; 1 where the work ended by an error."""
        self.session.start()
        try:
            while not stop.is_set():
                # Nothing wakes it up where an image has been worked on, and others wait for room.
                self._middleware.spin(_PAUSE if self._takes_images() else _MOMENT)
                if self.session.failed:
                    return 1
                if monotonic() - self._last_tick >= _TICK:
                    self._last_tick = monotonic()
                    self._tick()
            return 0
        finally:
            self.session.stop()

    # What a session asks for

    def publish(self, outgoing: Sequence[Outgoing]) -> None:
        """Publish messages; diagnostics are of now, all others of their image's time."""
        for topic, message in outgoing:
            if topic == '/diagnostics':
                stamp = message.header.stamp
                stamp.sec, stamp.nanosec = seconds_and_rest(self._middleware.now_ns())
            if not self._outputs[topic].publish(message):
                self.log('warning', f'a message on {topic} was not sent: a subscription does not '
                                    'keep up')

    def log(self, level: str, text: str) -> None:
        """Log a line."""
        self._middleware.log(level, text)

    def why_silent(self, topic: str) -> str:
        """Say what is seen of a topic over which nothing comes, and what may help."""
        wanted = self._kinds[topic]
        offers = self._middleware.offers(topic)
        if kinds := {offer.kind for offer in offers} - {wanted}:
            return f'it is published as {", ".join(sorted(kinds))}, and not as {wanted}' + (
                _transport_remedy(kinds))
        if offers:
            return f'{len(offers)} publish it, none sends{self._loss_remedy(topic, offers)}'
        if _IMAGE in (wanted, *kinds) and self._middleware.offers(f'{topic}/compressed'):
            return (f'nobody publishes it, but {topic}/compressed; set '
                    'ros.image_transport:=compressed')
        own = {self._middleware.resolve(full_name(output)) for output in self._outputs}
        # What an odometry draws for people is no camera.
        elsewhere = sorted(name for name in set(self._middleware.published(wanted)).difference(
            self._kinds, own) if not name.endswith('/debug_image'))
        near = get_close_matches(topic, elsewhere, n=1, cutoff=0.0)
        if not near:
            return 'nobody publishes it'
        # By the image's name alone only compressed images with the usual ending can be had.
        how = ('' if wanted != IMAGE_TYPES['compressed'] or near[0].endswith('/compressed')
               else f' remap {topic}:={near[0]}')
        return f'nobody publishes it; did you mean {near[0]}?{how}'

    def _loss_remedy(self, topic: str, offers: Sequence[Offer]) -> str:
        """Say what helps images that do not come whole, of which middlewares tell nothing."""
        images = self._images
        if topic != images.topic or images.profile.reliable:
            return ''
        reliable = all(offer.profile.reliable for offer in offers)
        return (', or its images are too large to come whole by best effort: '
                + 'set ros.qos_reliability to reliable, or ' * reliable
                + 'give the middleware larger socket buffers')

    def wants(self, topic: str) -> bool:
        """Tell whether anybody subscribes to an output."""
        output = self._outputs.get(topic)
        return output is not None and bool(output.listeners)

    def transform(self, parent: str, child: str) -> Array | None:
        """Give a frame in another (4, 4), or None where tf does not know it yet."""
        return self._middleware.transform(parent, child)

    # Inputs and outputs

    def image_topics(self, config: NodeConfig) -> tuple[str, str]:
        """Resolve the names of the images and of their CameraInfo."""
        if config.queue_policy == 'every':
            # It subscribes reliably, whatever the other one says.
            self._remedy = 'ros.queue_policy to latest'
        return image_topics(self._middleware.resolve, self._middleware.is_remapped,
                            config.image_transport)

    def advertise(self, outputs: Mapping[str, str]) -> None:
        """Make the publishers of topics with their types that are not there yet."""
        for topic in outputs.keys() - self._outputs.keys():
            self._outputs[topic] = self._middleware.advertise(
                self._middleware.resolve(full_name(topic)), outputs[topic])

    def listen(self, topic: str, kind: str, callback: Callable[[Any], None],
               profile: Profile, ready: Callable[[], bool] | None = None, *,
               as_configured: bool = True) -> Subscription:
        """
        Subscribe to a resolved topic; a publisher that does not fit is reported.

        as_configured: whether its profile is that of ``input_profile``, which a parameter mends.
        """
        self._kinds[topic] = kind
        if as_configured:
            self._as_configured.add(topic)
        self._inputs.append(self._middleware.listen(topic, kind, callback, profile, ready))
        return self._inputs[-1]

    def listen_to_camera(self, image: str, info: str, transport: str, profile: Profile) -> None:
        """Subscribe to images and their CameraInfo, which may be latched; the last inputs."""
        self._info_topic = info
        # CameraInfo first: of two that wait, it is to be taken before its image; and none that
        # belongs to an image that has to wait. What comes beside them must not wait.
        self.listen(info, INFO_TYPE, self.session.camera_info, profile, self._takes_images)
        self._images = self.listen(image, IMAGE_TYPES[transport], self.session.image, profile,
                                   self._takes_images)

    def _takes_images(self) -> bool:
        """Tell whether images are to come now: always, where none waits without being lost."""
        return not self._middleware.senders_wait or self.session.has_room

    def follow_frames_while_wanted(self) -> None:
        """Hear tf until what is asked of it is known: all that robots send there costs time."""
        wanted = self.session.wants_frames
        if wanted == self._follows_frames:
            return
        self._follows_frames = wanted
        if wanted:
            self._middleware.follow_frames()
        else:
            self._middleware.forget_frames()

    # Once a second

    def _tick(self) -> None:
        self.follow_frames_while_wanted()
        self.session.count_lost(self._images.new_losses())
        # Who publishes is known by name a little after it is refused.
        refused = [one for one in self._inputs if one.new_refusals()]
        for subscription in self._refused:
            self._report_mismatch(subscription)
        self._refused = refused
        self._listen_for_latched()
        self.session.tick()

    def _listen_for_latched(self) -> None:
        """Hear a CameraInfo that was sent before this node was there, where it was latched."""
        # To ask everybody for it would keep those away that do not latch.
        if self._latched:
            return
        for _, _, offered in self._middleware.offers(self._info_topic):
            if offered.latched:
                self._latched = True
                self._middleware.listen(self._info_topic, INFO_TYPE, self.session.camera_info,
                                        Profile(offered.reliable, 1, latched=True))
                return

    def _report_mismatch(self, subscription: Subscription) -> None:
        topic, ours = subscription.topic, subscription.profile
        for who, _, offered in self._middleware.offers(topic):
            if ours.incompatible_with(offered):
                self.log('error', f'incompatible QoS on {topic}: {who} offers {offered}, '
                         f'{self._middleware.node} asks for {ours}. Nothing is received from it; '
                         + self._qos_remedy(topic, ours))

    def _qos_remedy(self, topic: str, ours: Profile) -> str:
        overrides = self._middleware.qos_remedy.format(topic=topic)
        if topic in self._as_configured:
            return ' or '.join(filter(None, [f'set {self._remedy}', overrides]))
        # What is latched is asked for as it is offered, whatever overrides say.
        return f'have it offer {ours}' + (
            f', or set {overrides}' if overrides and not ours.latched else '')


def _transport_remedy(kinds: Collection[str]) -> str:
    """Name the parameter by which images are heard that come in another transport."""
    found = [transport for transport, kind in IMAGE_TYPES.items() if kind in kinds]
    return f'; set ros.image_transport:={found[0]}' if found else ''


def input_profile(config: NodeConfig) -> Profile:
    """Profile of the inputs; to lose nothing takes a sender that repeats, and one that waits."""
    every = config.queue_policy == 'every'
    return Profile(reliable=every or config.qos_reliability == 'reliable',
                   depth=None if every else config.qos_depth)
