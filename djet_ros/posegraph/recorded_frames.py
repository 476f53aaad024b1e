"""Frames of a recording as the odometry processed them, for offline use."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

from djet_ros.config.sections import Config
from djet_ros.errors import DjetError
from djet_ros.odometry.camera import Camera, is_rectified
from djet_ros.odometry.frame import Frame
from djet_ros.odometry.images import BadMessage, gray_image
from djet_ros.odometry.masks import Masks
from djet_ros.odometry.messages import frame_of, stamp_ns
from djet_ros.recordings.mask_files import static_mask
from djet_ros.recordings.recording import Recording

# Time of the recording, in ns, for which an image waits for its auxiliary inputs: gyro rates,
# guess and mask; and number of images that may wait, should that time stand still: more than the
# fastest camera has in it.
AUXILIARY_TIMEOUT_NS = 10**9
MOST_WAITING = 500


def frame_finder(recording: Recording, config: Config) -> Callable[[int], Frame]:
    """
    Return a function from stamps to frames, to be called in the order of the recording.

    It raises DjetError if the recording has no image with a stamp, or not in this order.
    """
    masks = Masks(static_mask(config.odometry.mask_file))
    images = _images(recording, config, masks)

    def frame_at(stamp: int) -> Frame:
        for camera, message in images:
            if stamp_ns(message.header) == stamp:
                raw = gray_image(message, config.odometry.gray_limits())
                return Frame(camera.corrected(raw), camera.K, stamp, frame_of(message.header),
                             masks.of(stamp, raw.shape, camera))
        raise DjetError(f'the recording has no image with stamp {stamp} ns, which is in the '
                        'results; give the recording that was replayed')
    return frame_at


def _images(recording: Recording, config: Config, masks: Masks) -> Iterator[tuple[Camera, Any]]:
    """Yield the images of a recording with their cameras, once masks has their masks."""
    rectified = is_rectified(config.odometry.rectified, recording.image_topic)
    camera: Camera | None = None
    mask_topic = recording.auxiliary.get('mask', '') if config.odometry.mask else ''
    waiting: deque[tuple[int, Camera, Any]] = deque()
    for topic, recorded, message in recording.messages(
            {recording.image_topic, recording.info_topic, mask_topic}):
        if topic == recording.info_topic:
            camera = _camera(message, rectified, config)
        elif topic == recording.image_topic and camera is not None:
            waiting.append((recorded, camera, message))
        elif topic == mask_topic:
            masks.add(message)
        while waiting and (not mask_topic or len(waiting) > MOST_WAITING
                           or recorded - waiting[0][0] >= AUXILIARY_TIMEOUT_NS
                           or masks.has(stamp_ns(waiting[0][2].header))):
            yield waiting.popleft()[1:]
    for _, of_image, message in waiting:
        yield of_image, message


def _camera(info: Any, rectified: bool, config: Config) -> Camera | None:
    """Return the camera of a CameraInfo; None if it is invalid, as for the odometry."""
    try:
        return Camera.from_info(info, rectified, config.odometry.residual_k1)
    except BadMessage:
        return None
