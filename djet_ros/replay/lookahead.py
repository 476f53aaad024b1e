"""The messages of a recording with the image after the next, which can be prepared ahead."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import chain, pairwise

from djet_ros.errors import DjetError
from djet_ros.recordings.bags import BagMessage
from djet_ros.recordings.recording import Recording, up_to_damage

# Messages read ahead at most to find the next image: those of a fast IMU with a slow camera.
_MAX_PIECE = 1000


def with_next_image(recording: Recording) -> Iterator[tuple[BagMessage, BagMessage | None]]:
    """
    Yield all messages of a recording, each with the second image from it on (lookahead).

    The image is None if it is far ahead or at the end. An error of the recording is raised after
    the messages before it.
    """
    damages: list[str] = []
    pieces = _pieces(up_to_damage(recording.messages(), damages.append), recording.image_topic)
    for piece, following in pairwise(chain(pieces, [[]])):
        image = following[-1] if following and following[-1].topic == recording.image_topic \
            else None
        for message in piece:
            yield message, image
    if damages:
        raise DjetError(damages[0])


def _pieces(messages: Iterable[BagMessage], image_topic: str) -> Iterator[list[BagMessage]]:
    """Split messages after each image, or after _MAX_PIECE messages without one."""
    piece: list[BagMessage] = []
    for message in messages:
        piece.append(message)
        if message.topic == image_topic or len(piece) == _MAX_PIECE:
            yield piece
            piece = []
    if piece:
        yield piece
