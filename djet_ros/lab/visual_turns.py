"""Rotations of a recording from its images alone, and the rates of its gyro."""

from __future__ import annotations

from collections.abc import Callable

from djet_ros.config.sections import Config
from djet_ros.core.types import Array, TRACKED
from djet_ros.lab.imu_offset import VisualRotations
from djet_ros.odometry.messages import stamp_ns
from djet_ros.odometry.tracker import Tracker
from djet_ros.recordings.decoding import message_type
from djet_ros.recordings.recording import Recording
import numpy as np
from numpy.typing import NDArray


def rotations_and_rates(recording: Recording, config: Config, advance: Callable[[], None]
                        ) -> tuple[VisualRotations, NDArray[np.int64], Array]:
    """Return the rotations between images, and stamps (M,) in ns and rates (M, 3) of the gyro."""
    tracker = Tracker(config, message_type, image_topic=recording.image_topic)
    ends: list[tuple[int, int]] = []
    rotations, stamps, rates = [], [], []
    for topic, _, message in recording.messages():
        if topic == recording.info_topic:
            tracker.camera_info(message)
        elif topic == recording.auxiliary['imu']:
            rate = message.angular_velocity
            stamps.append(stamp_ns(message.header))
            rates.append((rate.x, rate.y, rate.z))
        elif topic == recording.image_topic:
            processed = tracker.counts.processed
            tracker.image(message)
            advance()
            last = tracker.last
            if tracker.counts.processed > processed and last is not None \
                    and last.status in TRACKED and last.since_ns is not None:
                ends.append((last.since_ns, last.stamp_ns))
                rotations.append(last.motion[:3, :3].T)
    start, end = np.array(ends, np.int64).reshape(-1, 2).T
    return (VisualRotations(start, end, np.array(rotations).reshape(-1, 3, 3)),
            np.array(stamps, np.int64), np.array(rates, np.float64).reshape(-1, 3))
