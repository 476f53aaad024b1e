"""The images of keyframes, and where they are kept."""

from __future__ import annotations

from collections.abc import Iterator, MutableMapping
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryFile
from typing import NamedTuple

from djet_ros.core.types import Features
from djet_ros.errors import DjetError
from djet_ros.odometry.frame import Frame
from djet_ros.recordings.closing import Closing
import numpy as np

# What is kept of them.
_FEATURES = 'points', 'octaves', 'angles', 'responses', 'descriptors'


class KeyframeImage(NamedTuple):
    """A keyframe's image and its features."""

    frame: Frame
    features: Features


class KeyframeFile(MutableMapping[int, KeyframeImage], Closing):
    """
    Keyframes in a file without a name, so that thousands of them take no memory.

    folder: where the file is made, None for the system's temporary one. It is gone when it is
    closed or the process ends, however that ends. DjetError where the disk is full.
    """

    def __init__(self, folder: Path | None = None) -> None:
        """Make the file."""
        # What is no array is small, and stays in memory.
        self._kept: dict[int, _Kept] = {}
        try:
            self._file = TemporaryFile(dir=folder)  # noqa: SIM115 (closed by close)
        except OSError as error:
            raise DjetError(f'no temporary file could be made in {folder}: '
                            f'{error.strerror}') from error

    def __setitem__(self, number: int, image: KeyframeImage) -> None:
        """Write a keyframe at the end of the file."""
        frame = image.frame
        try:
            offset = self._file.seek(0, 2)
            left_out = np.empty((0, 0), bool) if frame.left_out is None else frame.left_out
            for array in (frame.gray, frame.K, left_out,
                          *(getattr(image.features, name) for name in _FEATURES)):
                np.save(self._file, array, allow_pickle=False)
        except OSError as error:
            raise DjetError('the images of keyframes could not be written to a temporary file: '
                            f'{error.strerror}; make room, or take fewer keyframes '
                            '(--keyframes distance --keyframe-distance)') from error
        nothing = np.empty((0, 0), np.uint8)
        self._kept[number] = _Kept(offset, replace(frame, gray=nothing, left_out=None))

    def __getitem__(self, number: int) -> KeyframeImage:
        """Read a keyframe."""
        offset, frame = self._kept[number]
        self._file.seek(offset)
        gray, K, left_out, *features = (np.load(self._file, allow_pickle=False)
                                        for _ in range(3 + len(_FEATURES)))
        return KeyframeImage(replace(frame, gray=gray, K=K,
                                     left_out=left_out if left_out.size else None),
                             Features.described(**dict(zip(_FEATURES, features))))

    def __contains__(self, number: object) -> bool:
        """Tell whether there is such a keyframe, without reading it."""
        return number in self._kept

    def __delitem__(self, number: int) -> None:
        """Forget a keyframe; the file keeps its place."""
        del self._kept[number]

    def __iter__(self) -> Iterator[int]:
        """Give the numbers of all keyframes."""
        return iter(self._kept)

    def __len__(self) -> int:
        """Count the keyframes."""
        return len(self._kept)

    def close(self) -> None:
        """Close the file, which is its end."""
        self._file.close()


class _Kept(NamedTuple):
    """Where the arrays of a keyframe begin, and the frame without its image."""

    offset: int
    frame: Frame
