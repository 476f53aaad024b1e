"""The odometry as a live node: its topics and services, whatever carries them."""

from __future__ import annotations

from djet_ros.config.sections import Config
from djet_ros.live.face import Face, input_profile
from djet_ros.live.middleware import Middleware
from djet_ros.live.parameters import for_a_live_graph
from djet_ros.live.session import Session
from djet_ros.live.topics import odometry_outputs, SPEED_TYPES
from djet_ros.odometry.tracker import Tracker


class OdometryFace(Face):
    """
    The odometry on a graph.

    Raises DjetError where the configuration asks for what a live graph does not have.
    """

    def __init__(self, middleware: Middleware, config: Config) -> None:
        super().__init__(middleware)
        for_a_live_graph(config)
        if config.odometry.base_frame:
            middleware.follow_frames()
        image, info = self.image_topics(config.ros)
        self.session: Session = Session(
            Tracker(config, middleware.message_type, image_topic=image,
                    node=middleware.node.strip('/'),
                    speed_topics=' or '.join(map(middleware.resolve, SPEED_TYPES))), self,
            {'image': image, 'camera_info': info})
        self._hears_speed = False
        self._connect(config)
        self.listen_to_camera(image, info, config.ros.image_transport, input_profile(config.ros))
        for name in ('reset', 'pause', 'resume'):
            middleware.serve(f'~/{name}', getattr(self.session, name))
        self.log('info', f'images from {image}, camera_info from {info}, queue policy '
                         f'{config.ros.queue_policy}')

    def configure(self, config: Config) -> None:
        """Take other parameters from the next image on."""
        self._connect(config)
        self.session.configure(config)

    def _connect(self, config: Config) -> None:
        """Make the publishers and the speed subscriptions that a configuration asks for."""
        self.advertise(odometry_outputs(config.ros))
        if config.odometry.scale == 'speed' and not self._hears_speed:
            self._hears_speed = True
            for topic, kind in SPEED_TYPES.items():
                self.listen(self._middleware.resolve(topic), kind, self.session.speed,
                            input_profile(config.ros))
