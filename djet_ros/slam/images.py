"""The images of keyframes out of a recording."""

from __future__ import annotations

from collections.abc import Iterator

from djet_ros.config import Config
from djet_ros.data.sources import Source
from djet_ros.errors import DjetError
from djet_ros.odometry.camera import Camera, means_rectified
from djet_ros.odometry.frame import Frame
from djet_ros.odometry.images import gray_image
from djet_ros.odometry.messages import stamp_ns
import numpy as np
from numpy.typing import NDArray


def frames_at(source: Source, config: Config, stamps_ns: NDArray[np.int64]) -> Iterator[Frame]:
    """
    Yield the frames of some stamps (N,), in the order of recording, as the odometry had them.

    DjetError where the recording does not hold them all.
    """
    rectified = means_rectified(config.odometry.rectified, source.image_topic)
    wanted = iter(stamps_ns.tolist())
    stamp = next(wanted, None)
    camera: Camera | None = None
    for message in source.messages({source.image_topic, source.info_topic}):
        if message.topic == source.info_topic:
            camera = Camera(message.message, rectified)
        elif message.topic == source.image_topic and camera is not None \
                and stamp_ns(message.message.header) == stamp:
            gray = camera.undistort(gray_image(message.message))
            yield Frame(gray, camera.K, stamp, message.message.header.frame_id)
            stamp = next(wanted, None)
        if stamp is None:
            return
    if stamp is not None:
        raise DjetError(f'the recording has no image of {stamp} ns, which its results speak of; '
                        'give the recording that was replayed')
