"""The frames of a recording as the odometry processes them, for estimates from many pairs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from djet_ros.errors import DjetError
from djet_ros.odometry.result import OdometryResult
from djet_ros.odometry.tracker import Tracker
from djet_ros.recordings.recording import Recording, up_to_damage, Warn


def processed(recording: Recording, tracker: Tracker, advance: Callable[[], None],
              take: Callable[[str, Any], None], warn: Warn
              ) -> Iterator[OdometryResult]:
    """
    Run a recording through the odometry; yield the result of each frame that it processes.

    advance: called after each image; take: called with topic and message of everything else;
    warn: called with the damage of a recording, which ends there. Raises DjetError if a CameraInfo
    is invalid, or no image comes after one.
    """
    for topic, _, message in up_to_damage(recording.messages(), warn):
        if topic != recording.image_topic:
            take(topic, message)
        if topic == recording.info_topic:
            tracker.camera_info(message)
            if tracker.counts.rejected_infos and tracker.problem is not None:
                raise tracker.problem
        elif topic == recording.image_topic:
            before = tracker.counts.processed
            tracker.image(message)
            advance()
            if tracker.counts.processed > before and tracker.last is not None:
                yield tracker.last
    if not tracker.counts.processed:
        raise tracker.problem or DjetError(
            f'none of {tracker.counts.received} images came after a CameraInfo on '
            f'{recording.info_topic}; record it too, or choose one with --info-topic')
