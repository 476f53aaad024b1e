"""The messages of a recording with the image after the next, which can be prepared ahead."""

from __future__ import annotations

from collections.abc import Iterator

from djet_ros.errors import DjetError
from djet_ros.recordings.bags import BagMessage
from djet_ros.recordings.recording import Recording

# Messages read ahead at most to find the next image: those of a fast IMU with a slow camera.
_MAX_PIECE = 1000


def with_next_image(recording: Recording) -> Iterator[tuple[BagMessage, BagMessage | None]]:
    """
    Yield all messages of a recording, each with the second image from it on (lookahead).

    The image is None if it is far ahead or at the end. An error of the recording is raised after
    the messages before it.
    """
    pieces, problem = _pieces(recording), None
    piece = next(pieces, [])
    while piece:
        following: list[BagMessage] = []
        try:
            following = next(pieces, [])
        except DjetError as error:
            problem = error
        image = following[-1] if following and following[-1].topic == recording.image_topic \
            else None
        for message in piece:
            yield message, image
        piece = following
    if problem is not None:
        raise problem


def _pieces(recording: Recording) -> Iterator[list[BagMessage]]:
    """Split the messages after each image, or after _MAX_PIECE messages without one."""
    piece: list[BagMessage] = []
    try:
        for message in recording.messages():
            piece.append(message)
            if message.topic == recording.image_topic or len(piece) == _MAX_PIECE:
                yield piece
                piece = []
    except DjetError:
        if piece:
            yield piece
        raise
    if piece:
        yield piece
