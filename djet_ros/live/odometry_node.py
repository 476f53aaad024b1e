"""The live odometry node: its topics and services, on any middleware."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from djet_ros.config.sections import Config
from djet_ros.live.base_node import input_profile, LiveNode
from djet_ros.live.middleware import FRAMES_PROFILE, Middleware, Profile
from djet_ros.live.session import Session
from djet_ros.live.topics import AUXILIARY_TYPES, odometry_outputs, SPEED_TYPES
from djet_ros.odometry.moving_frames import TOPIC as TF
from djet_ros.odometry.static_frames import TOPIC as TF_STATIC, TYPE as TF_TYPE
from djet_ros.odometry.tracker import Tracker
from djet_ros.recordings.mask_files import static_mask

# History depths for the time in which Python does not get to run: of imu, guess and tf (seconds of
# the fastest IMU), and of masks, which are as large and as frequent as images.
_DEPTH, _MASKS_DEPTH = 2000, 100

_INPUT_TYPES = {**AUXILIARY_TYPES, **SPEED_TYPES, TF: TF_TYPE, TF_STATIC: TF_TYPE}


class OdometryNode(LiveNode):
    """
    The live odometry on a middleware.

    Raises DjetError if the configuration needs what only a recording has.
    """

    def __init__(self, middleware: Middleware, config: Config) -> None:
        super().__init__(middleware)
        image, info = self.image_topics(config.ros)
        self.session: Session = Session(
            Tracker(config, middleware.message_type, image_topic=image,
                    node=middleware.node.strip('/'),
                    speed_topics=' or '.join(map(middleware.resolve, SPEED_TYPES)),
                    static_mask=static_mask(config.odometry.mask_file)), self,
            {'image': image, 'camera_info': info})
        self._subscribed: set[str] = set()
        self.connect(config)
        self.update_tf_subscription()
        self.listen_to_camera(image, info, config.ros.image_transport, input_profile(config.ros))
        for name in ('reset', 'pause', 'resume'):
            middleware.serve(f'~/{name}', getattr(self.session, name))
        self.log('info', f'images from {image}, camera_info from {info}, queue policy '
                         f'{config.ros.queue_policy}')

    def configure(self, config: Config) -> None:
        """Change parameters from the next image on; ``connect`` must have accepted them."""
        self.session.configure(config)

    def connect(self, config: Config) -> None:
        """Create the publishers and subscriptions of a configuration; may raise DjetError."""
        self.advertise(odometry_outputs(config.ros))
        odometry, profile, session = config.odometry, input_profile(config.ros), self.session
        deep, tf = replace(profile, depth=_DEPTH), odometry.guess_by_tf
        self._listen_once(odometry.imu, 'imu', session.imu, deep, many=True)
        self._listen_once(odometry.mask, 'mask', session.mask,
                          replace(profile, depth=_MASKS_DEPTH))
        self._listen_once(odometry.guess_by_topic, 'guess', session.guess, deep)
        self._listen_once(tf, TF, session.tf, deep, many=True)
        self._listen_once(tf, TF_STATIC, session.tf_static, FRAMES_PROFILE, as_configured=False)
        for topic in SPEED_TYPES:
            self._listen_once(odometry.scale == 'speed', topic, session.speed, profile)

    def _listen_once(self, wanted: bool, topic: str, callback: Callable[[Any], None],
                     profile: Profile, *, as_configured: bool = True, many: bool = False) -> None:
        """Subscribe to an input if it is wanted and was not before; see ``listen``."""
        if wanted and topic not in self._subscribed:
            self.listen(self._middleware.resolve(topic), _INPUT_TYPES[topic], callback, profile,
                        as_configured=as_configured, many=many)
            self._subscribed.add(topic)
