"""Extraction of the frames of a bag to files, for random access."""

from __future__ import annotations

from pathlib import Path

import cv2
from djet_ros.core.types import Array
from djet_ros.errors import DjetError
from djet_ros.lab.corrected_images import corrected_images, CorrectedImage
from djet_ros.recordings.frame_sequence import FrameSequence, ImageFiles, Intrinsics
from djet_ros.recordings.recording import BagRecording, refuse, Warn
from djet_ros.replay.ground_truth import GroundTruth
import numpy as np
from numpy.typing import NDArray

_INDEX = 'frames.npz'


class ExtractedSequence(FrameSequence):
    """Images of a bag, rectified when they were extracted."""

    def __init__(self, folder: Path) -> None:
        images = ImageFiles(sorted(folder.glob('*.png')))
        with np.load(folder / _INDEX, allow_pickle=False) as index:
            poses: Array = index['poses']
            super().__init__(folder.name, images, Intrinsics(index['K']), index['stamps_ns'],
                             poses if len(poses) else None)
            unseen = index['unseen']
        self._left_out: NDArray[np.bool_] | None = unseen if unseen.size else None

    def _unseen(self) -> NDArray[np.bool_] | None:
        """Return the rectified pixels (H, W) that the images of the bag do not show, or None."""
        return self._left_out


def is_extracted(folder: Path) -> bool:
    """Return whether a folder holds the extracted frames of a bag."""
    return (folder / _INDEX).exists()


def extract(recording: BagRecording, folder: Path, warn: Warn = refuse) -> Path:
    """
    Extract the frames of a bag, rectified, to a new folder, with the ground truth at their stamps.

    warn: called with the damage of a bag, which ends there. Returns the folder; raises DjetError
    if the bag has no usable frames.
    """
    folder.mkdir(parents=True)
    found: CorrectedImage | None = None
    stamps: list[int] = []
    truth = GroundTruth()
    for found in corrected_images(recording, warn, truth):
        (folder / f'{len(stamps):06d}.png').write_bytes(_png(found.gray))
        stamps.append(found.stamp_ns)
    if found is None:
        raise DjetError(f'{recording.bag.path} has no image after its first CameraInfo; record '
                        'CameraInfo from the start')
    stamps_ns = np.array(stamps, np.int64)
    poses = truth.at(stamps_ns) if len(truth) else np.empty((0, 4, 4))
    unseen = found.camera.unseen(found.gray.shape)
    np.savez(folder / _INDEX, K=found.camera.K, stamps_ns=stamps_ns, poses=poses,
             unseen=np.empty((0, 0), bool) if unseen is None else unseen)
    return folder


def _png(image: NDArray[np.uint8]) -> bytes:
    # Fast compression: the files are temporary.
    _, data = cv2.imencode('.png', image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    return data.tobytes()
