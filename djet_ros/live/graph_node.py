"""The live pose graph node: its topics and service, on any middleware."""

from __future__ import annotations

from dataclasses import replace

from djet_ros.config.sections import Config, NODE_NAME
from djet_ros.live.base_node import input_profile, LiveNode
from djet_ros.live.graph_session import GraphSession
from djet_ros.live.middleware import Middleware, Profile
from djet_ros.live.topics import AUXILIARY_TYPES, GRAPH_INPUTS, graph_outputs
from djet_ros.posegraph.live_slam import LiveSlam
from djet_ros.recordings.mask_files import static_mask

# History depth of the odometry's topics, for long optimisations.
_DEPTH = 1000


class PoseGraphNode(LiveNode):
    """The live pose graph on a middleware."""

    def __init__(self, middleware: Middleware, config: Config) -> None:
        super().__init__(middleware)
        image, info = self.image_topics(config.ros)
        topics = {name: middleware.resolve(f'{NODE_NAME}/{name}') for name in GRAPH_INPUTS}
        self.session: GraphSession = GraphSession(
            LiveSlam(config, middleware.message_type, image, middleware.node.strip('/'),
                     static_mask(config.odometry.mask_file)), self,
            {**topics, 'image': image, 'camera_info': info})
        self.update_tf_subscription()
        self.advertise(graph_outputs(tf=config.slam.publish_tf))
        for (name, kind), callback in zip(GRAPH_INPUTS.items(), (
                self.session.odometry, self.session.relative_pose,
                self.session.relative_pose_status)):
            self.listen(topics[name], kind, callback, Profile(depth=_DEPTH), as_configured=False)
        profile = replace(input_profile(config.ros), depth=config.slam.image_buffer)
        if config.odometry.mask:
            self.listen(middleware.resolve('mask'), AUXILIARY_TYPES['mask'], self.session.mask,
                        profile)
        self.listen_to_camera(image, info, config.ros.image_transport, profile)
        middleware.serve('~/reset', self.session.reset)
        self.log('info', f'odometry from {topics["odometry"]}, images from {image}, '
                         f'camera_info from {info}')
