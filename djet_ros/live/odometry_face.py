"""The live odometry node: its topics and services, on any middleware."""

from __future__ import annotations

from dataclasses import replace

from djet_ros.config.sections import Config
from djet_ros.live.face import Face, input_profile
from djet_ros.live.middleware import Middleware, Profile
from djet_ros.live.session import Session
from djet_ros.live.topics import BESIDE_TYPES, odometry_outputs, SPEED_TYPES
from djet_ros.odometry.moving_frames import TOPIC as TF
from djet_ros.odometry.static_frames import TOPIC as TF_STATIC, TYPE as TF_TYPE
from djet_ros.odometry.tracker import Tracker
from djet_ros.recordings.mask_files import still_mask

# History depths for the time in which Python does not get to run: of imu, guess and tf (seconds of
# the fastest IMU), and of masks, which are as large and as frequent as images.
_DEPTH, _MASKS_DEPTH = 2000, 100

# History depth of /tf_static: one message for each robot_state_publisher.
_FRAMES_DEPTH = 100


class OdometryFace(Face):
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
                    still_mask=still_mask(config.odometry.mask_file)), self,
            {'image': image, 'camera_info': info})
        self._hears_speed = self._hears_tf = False
        self._hears_beside: set[str] = set()
        self.connect(config)
        self.follow_frames_while_wanted()
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
        wanted = {'imu': odometry.imu, 'mask': odometry.mask,
                  'guess': odometry.guess_by_topic}
        for what in [what for what in wanted if wanted[what] and what not in self._hears_beside]:
            self.listen(self._middleware.resolve(what), BESIDE_TYPES[what],
                        getattr(self.session, what),
                        replace(input_profile(config.ros),
                                depth=_MASKS_DEPTH if what == 'mask' else _DEPTH))
            self._hears_beside.add(what)
        if odometry.guess_by_tf and not self._hears_tf:
            self.listen(self._middleware.resolve(TF), TF_TYPE, self.session.tf,
                        replace(input_profile(config.ros), depth=_DEPTH))
            self.listen(self._middleware.resolve(TF_STATIC), TF_TYPE, self.session.tf_static,
                        Profile(depth=_FRAMES_DEPTH, latched=True), as_configured=False)
            self._hears_tf = True
        if config.odometry.scale == 'speed' and not self._hears_speed:
            for topic, kind in SPEED_TYPES.items():
                self.listen(self._middleware.resolve(topic), kind, self.session.speed,
                            input_profile(config.ros))
            self._hears_speed = True
