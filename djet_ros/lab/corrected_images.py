"""The images of a recording in order, as the odometry sees them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from djet_ros.odometry.camera import Camera, is_rectified
from djet_ros.odometry.images import gray_image
from djet_ros.odometry.messages import pose_of, stamp_ns
from djet_ros.recordings.recording import Recording, refuse, up_to_damage, Warn
from djet_ros.replay.ground_truth import GroundTruth
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class CorrectedImage:
    """An undistorted gray image (H, W) without sensor defects, its stamp, and its camera."""

    gray: NDArray[np.uint8]
    stamp_ns: int
    camera: Camera


def corrected_images(recording: Recording, warn: Warn = refuse, truth: GroundTruth | None = None
                     ) -> Iterator[CorrectedImage]:
    """
    Yield the images of a recording from its first CameraInfo on, with increasing stamps.

    warn: called with the damage of a recording, which ends there; truth: takes the ground truth
    met on the way.
    """
    camera, last = None, None
    for topic, _, message in up_to_damage(recording.messages(), warn):
        if topic == recording.info_topic:
            camera = camera or Camera.from_info(
                message, is_rectified('auto', recording.image_topic))
        elif topic == recording.ground_truth_topic:
            if truth is not None:
                truth.add(*pose_of(message))
        elif camera is not None:
            stamp = stamp_ns(message.header)
            if last is None or stamp > last:
                yield CorrectedImage(camera.corrected(gray_image(message)), stamp, camera)
                last = stamp
