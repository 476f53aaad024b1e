"""The live odometry node: its topics and services, on any middleware."""

from __future__ import annotations

from dataclasses import replace

from djet_ros.config.sections import Config
from djet_ros.live.base_node import input_profile, LiveNode
from djet_ros.live.middleware import FRAMES_PROFILE, Middleware
from djet_ros.live.session import Session
from djet_ros.live.topics import AUXILIARY_TYPES, odometry_outputs, SPEED_TYPES
from djet_ros.odometry.moving_frames import TOPIC as TF
from djet_ros.odometry.static_frames import TOPIC as TF_STATIC, TYPE as TF_TYPE
from djet_ros.odometry.tracker import Tracker
from djet_ros.recordings.mask_files import static_mask

# History depths for the time in which Python does not get to run: of imu, guess and tf (seconds of
# the fastest IMU), and of masks, which are as large and as frequent as images.
_DEPTH, _MASKS_DEPTH = 2000, 100


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
        self._speed_subscribed = self._guess_tf_subscribed = False
        self._auxiliary_topics: set[str] = set()
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
        odometry = config.odometry
        enabled = {'imu': odometry.imu, 'mask': odometry.mask,
                   'guess': odometry.guess_by_topic}
        for topic in enabled:
            if enabled[topic] and topic not in self._auxiliary_topics:
                self.listen(self._middleware.resolve(topic), AUXILIARY_TYPES[topic],
                            getattr(self.session, topic),
                            replace(input_profile(config.ros),
                                    depth=_MASKS_DEPTH if topic == 'mask' else _DEPTH),
                            many=topic == 'imu')
                self._auxiliary_topics.add(topic)
        if odometry.guess_by_tf and not self._guess_tf_subscribed:
            self.listen(self._middleware.resolve(TF), TF_TYPE, self.session.tf,
                        replace(input_profile(config.ros), depth=_DEPTH), many=True)
            self.listen(self._middleware.resolve(TF_STATIC), TF_TYPE, self.session.tf_static,
                        FRAMES_PROFILE, as_configured=False)
            self._guess_tf_subscribed = True
        if config.odometry.scale == 'speed' and not self._speed_subscribed:
            for topic, kind in SPEED_TYPES.items():
                self.listen(self._middleware.resolve(topic), kind, self.session.speed,
                            input_profile(config.ros))
            self._speed_subscribed = True
