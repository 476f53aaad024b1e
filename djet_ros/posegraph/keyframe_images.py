"""Storage of the images and features of keyframes."""

from __future__ import annotations

from collections.abc import Iterator, MutableMapping
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryFile
from typing import NamedTuple

from djet_ros.core.types import Features
from djet_ros.errors import DjetError
from djet_ros.odometry.frame import Frame
from djet_ros.recordings.closing import Closing
import numpy as np

# Feature arrays that are stored.
_FEATURES = 'points', 'octaves', 'angles', 'responses', 'descriptors'


class KeyframeImage(NamedTuple):
    """The image and features of a keyframe."""

    frame: Frame
    features: Features


class KeyframeFile(MutableMapping[int, KeyframeImage], Closing):
    """
    Keyframes in an unnamed temporary file, so that thousands of them take no memory.

    folder: folder of the file, None for the system's temporary folder. The file disappears when
    it is closed or the process ends in any way. Raises DjetError if the disk is full.
    """

    def __init__(self, folder: Path | None = None) -> None:
        """Create the file."""
        # Everything but the arrays is small and stays in memory.
        self._kept: dict[int, _Kept] = {}
        try:
            self._file = TemporaryFile(dir=folder)  # noqa: SIM115 (closed by close)
        except OSError as error:
            raise DjetError(f'no temporary file for keyframe images could be created in '
                            f'{folder or "the temporary folder"}: {error.strerror}') from error

    def __setitem__(self, number: int, image: KeyframeImage) -> None:
        """Write a keyframe at the end of the file."""
        frame = image.frame
        try:
            offset = self._file.seek(0, 2)
            left_out = np.empty((0, 0), bool) if frame.left_out is None else frame.left_out
            for array in (frame.gray, frame.K, left_out,
                          *(getattr(image.features, name) for name in _FEATURES)):
                np.save(self._file, array, allow_pickle=False)
            self._file.flush()
        except OSError as error:
            raise DjetError('the images of keyframes could not be written to a temporary file: '
                            f'{error.strerror}; free disk space, or select fewer keyframes '
                            '(--keyframes distance --keyframe-distance)') from error
        self._kept[number] = _Kept(offset, frame.stamp_ns, frame.frame_id)

    def __getitem__(self, number: int) -> KeyframeImage:
        """Read a keyframe."""
        kept = self._kept[number]
        self._file.seek(kept.offset)
        gray, K, left_out, *features = (np.load(self._file, allow_pickle=False)
                                        for _ in range(3 + len(_FEATURES)))
        return KeyframeImage(Frame(gray, K, kept.stamp_ns, kept.frame_id,
                                   left_out if left_out.size else None),
                             Features.with_descriptors(**dict(zip(_FEATURES, features))))

    def __contains__(self, number: object) -> bool:
        """Return whether there is such a keyframe, without reading it."""
        return number in self._kept

    def __delitem__(self, number: int) -> None:
        """Remove a keyframe; its space in the file is not reused."""
        del self._kept[number]

    def __iter__(self) -> Iterator[int]:
        """Iterate over the numbers of the keyframes."""
        return iter(self._kept)

    def __len__(self) -> int:
        """Return the number of keyframes."""
        return len(self._kept)

    def close(self) -> None:
        """Close the file, which deletes it."""
        # It has what did not fit on the disk, and fails once more.
        with suppress(OSError):
            self._file.close()


class _Kept(NamedTuple):
    """The file offset of a keyframe's arrays, and the stamp and the name of its frame."""

    offset: int
    stamp_ns: int
    frame_id: str
