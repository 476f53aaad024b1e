"""Integration of pairwise motions to a trajectory, with step lengths of the ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math
from pathlib import Path

from djet_ros.core.types import Array
from djet_ros.lab.pairs import PairRecord
from djet_ros.lab.sequences import Dataset, opened
from djet_ros.recordings.trajectories import TumWriter
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class StampedTrajectory:
    """Poses (N, 4, 4) of the camera in its first frame, in metres, at stamps (N,) in ns."""

    stamps_ns: NDArray[np.int64]
    poses: Array

    def write_tum(self, path: Path) -> None:
        """Write or replace a file in TUM's format."""
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        with TumWriter(path) as writer:
            for stamp, pose in zip(self.stamps_ns.tolist(), self.poses):
                writer.write(stamp, pose)


def true_trajectory(dataset: Dataset, records: Sequence[PairRecord]) -> StampedTrajectory:
    """Return the ground truth over the longest run of consecutive pairs of one method."""
    sequence, frames = opened(dataset), _frames(_longest_run(records))
    assert sequence.poses is not None  # datasets without poses are refused at the start
    poses = sequence.poses[frames]
    return StampedTrajectory(sequence.stamps_ns[frames], np.linalg.inv(poses[0]) @ poses)


def estimated_trajectory(dataset: Dataset, records: Sequence[PairRecord]) -> StampedTrajectory:
    """
    Integrate the motions of one method over the longest run of consecutive pairs.

    Each unit translation is scaled to its true length, which a single camera cannot observe.
    Pairs without a pose contribute no motion.
    """
    truth = true_trajectory(dataset, records)
    lengths = np.linalg.norm(np.diff(truth.poses[:, :3, 3], axis=0), axis=1)
    poses = [np.eye(4)]
    for record, length in zip(_longest_run(records), lengths.tolist()):
        poses.append(poses[-1] @ _camera_motion(record, length))
    return StampedTrajectory(truth.stamps_ns, np.array(poses))


def _camera_motion(record: PairRecord, length: float) -> Array:
    """Return the pose (4, 4) of the current camera in the previous one."""
    motion = np.eye(4)
    if math.isfinite(record.rotation_error_deg):
        motion[:3, :3] = Rotation.from_rotvec(record.rotation).as_matrix()
        motion[:3, 3] = length * np.array(record.translation)
    return motion


def _longest_run(records: Sequence[PairRecord]) -> list[PairRecord]:
    runs: list[list[PairRecord]] = []
    for record in records:
        if runs and runs[-1][-1].pair + 1 == record.pair:
            runs[-1].append(record)
        else:
            runs.append([record])
    return max(runs, key=len)


def _frames(run: Sequence[PairRecord]) -> list[int]:
    return [run[0].previous, *(record.current for record in run)]
