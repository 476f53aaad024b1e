"""Sequences with ground truth for an evaluation, in any supported layout."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
import hashlib
from itertools import chain
from pathlib import Path
from typing import Any

from djet_ros.core.types import Array
from djet_ros.errors import DjetError
from djet_ros.lab.bag_frames import extract, ExtractedSequence, is_extracted
from djet_ros.lab.scenes.sequence import rendered_scene
from djet_ros.recordings.bags import is_bag
from djet_ros.recordings.datasets import open_sequence
from djet_ros.recordings.frame_sequence import FrameSequence
from djet_ros.recordings.recording import BagRecording, refuse, Warn
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Selection:
    """Frames start, start + stride, … < end of a sequence; consecutive ones are pairs."""

    start: int = 0
    end: int | None = None
    stride: int = 1


@dataclass(frozen=True)
class Dataset:
    """
    A sequence of an evaluation.

    name: printed name, unique in a run; benchmark: public name, or ''; folder: of the frames,
    readable by every worker; frames: indices of the frames used; content: digest of camera, truth
    and some pixels.
    """

    name: str
    benchmark: str
    folder: Path
    frames: range
    content: str

    @property
    def pairs(self) -> int:
        """Return the number of pairs of consecutive frames."""
        return len(self.frames) - 1

    def settings(self) -> dict[str, Any]:
        """Return everything that decides the results, as plain values."""
        frames = [self.frames.start, self.frames.stop, self.frames.step]
        return {'name': self.name, 'frames': frames, 'content': self.content}


def open_datasets(paths: Iterable[Path], selection: Selection, workspace: Path,
                  warn: Warn = refuse) -> list[Dataset]:
    """
    Open datasets, each sequence of a KITTI folder separately, and check that all are usable.

    The frames of bags are extracted to the workspace, for random access. warn: called with the
    damage of a bag, which ends there. Raises DjetError on paths that are no dataset, or have no
    ground truth or too few frames.
    """
    datasets: list[Dataset] = []
    for path in chain.from_iterable(map(_sequences, paths)):
        name = _unused(plain_name(path), {dataset.name for dataset in datasets})
        datasets.append(_dataset(path, name, selection, workspace, warn))
    return datasets


@lru_cache(maxsize=2)
def opened(dataset: Dataset) -> FrameSequence:
    """Open the frames of a dataset; cached, for consecutive chunks of the same one."""
    return _frames_in(dataset.folder)


def _frames_in(folder: Path) -> FrameSequence:
    if is_extracted(folder):
        return ExtractedSequence(folder)
    return open_sequence(folder)


def pair_of_frames(path: Path, index: int, workspace: Path, warn: Warn = refuse
                   ) -> tuple[NDArray[np.uint8], NDArray[np.uint8], Array]:
    """Return the images (H, W) of frames index and index + 1 of any dataset, and K (3, 3)."""
    sequence = readable_frames(path, workspace, warn)
    if len(sequence) < 2:
        raise DjetError(f'{path} has one image; name a recording with two or more')
    if not 0 <= index < len(sequence) - 1:
        raise DjetError(f'--pair is {index}; {path} has pairs 0 to {len(sequence) - 2}')
    return sequence.image(index), sequence.image(index + 1), sequence.K


def readable_frames(path: Path, workspace: Path, warn: Warn = refuse) -> FrameSequence:
    """
    Open any dataset for random access; frames of a bag are extracted to the workspace.

    warn: called with the damage of a bag, which ends there.
    """
    return _frames_in(_readable(path, workspace / 'frames', warn))


def _readable(path: Path, place: Path, warn: Warn) -> Path:
    """Return a folder with random access to the frames; those of a bag are extracted there."""
    if not is_bag(path):
        return path.resolve()
    with BagRecording(path) as recording:
        return extract(recording, place, warn)


def _dataset(path: Path, name: str, selection: Selection, workspace: Path, warn: Warn) -> Dataset:
    folder = _readable(path, workspace / name, warn)
    sequence = _frames_in(folder)
    frames = _selected(path, sequence, selection)
    if sequence.poses is None or not _has_true_pair(sequence.poses[frames]):
        raise DjetError(f'{path} has no ground truth for two consecutive frames; it is needed for '
                        'errors (KITTI: ../../poses/NN.txt, TUM: groundtruth.txt, bags: a pose '
                        'topic with ground_truth in its name)')
    # Rendered sequences have KITTI's layout and numbers, but no published results.
    benchmark = '' if rendered_scene(folder) else sequence.name
    return Dataset(name, benchmark, folder, frames, _digest(sequence, frames))


def _sequences(path: Path) -> Iterator[Path]:
    """Yield the sequences of a benchmark folder or of its folder sequences, or the path itself."""
    inner = sorted(image_folder.parent for form in ('sequences/*/image_0', '*/image_0')
                   for image_folder in path.glob(form))
    yield from inner or [path]


def plain_name(path: Path) -> str:
    """Return the printed name of a dataset: the scene of a rendered one, or the folder."""
    resolved = path.resolve()
    return rendered_scene(resolved) or (resolved.stem if resolved.is_file() else resolved.name)


def _unused(name: str, used: set[str]) -> str:
    candidates = [name, *(f'{name}-{number}' for number in range(2, len(used) + 2))]
    return next(candidate for candidate in candidates if candidate not in used)


def _selected(path: Path, sequence: FrameSequence, selection: Selection) -> range:
    end = len(sequence) if selection.end is None else min(selection.end, len(sequence))
    if selection.start < 0 or selection.stride < 1:
        raise DjetError(f'--start is {selection.start} and --stride {selection.stride}; start '
                        'must be at least 0, stride at least 1')
    frames = range(selection.start, end, selection.stride)
    if len(frames) < 2:
        raise DjetError(f'{path} has {len(sequence)} frames, of which --start, --end and --stride '
                        f'select {len(frames)}; at least two are needed')
    return frames


def _has_true_pair(poses: Array) -> bool:
    known = np.asarray(np.isfinite(poses).all(axis=(1, 2)))
    return bool((known[1:] & known[:-1]).any())


def _digest(sequence: FrameSequence, frames: range) -> str:
    """Return a digest that distinguishes recordings of the same name."""
    digest = hashlib.sha256()
    for values in (sequence.K, sequence.poses, sequence.stamps_ns, sequence.image(frames[0]),
                   sequence.image(frames[-1])):
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()[:16]
