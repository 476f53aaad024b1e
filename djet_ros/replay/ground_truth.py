"""Ground truth: true poses of a camera at some stamps."""

from __future__ import annotations

from djet_ros.core.types import Array
from djet_ros.odometry.interpolation import poses_at
from djet_ros.odometry.messages import pose_of
from djet_ros.recordings.datasets import LONGEST_GAP_NS
from djet_ros.recordings.recording import Recording, refuse, up_to_damage, Warn
import numpy as np
from numpy.typing import NDArray


class GroundTruth:
    """Stamped poses (4, 4) of the camera in a fixed frame, added in any order."""

    def __init__(self) -> None:
        self._poses: dict[int, Array] = {}

    @classmethod
    def of(cls, recording: Recording, warn: Warn = refuse) -> GroundTruth:
        """Read the ground truth of a recording, up to its damage; warn: called with that."""
        truth = cls()
        if (topic := recording.ground_truth_topic) is not None:
            for message in up_to_damage(recording.messages({topic}), warn):
                truth.add(*pose_of(message.message))
        return truth

    def add(self, stamp_ns: int, pose: Array) -> None:
        """Add a pose, unless it is not finite."""
        if np.isfinite(pose).all():
            self._poses[stamp_ns] = pose

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self._poses)

    def known(self) -> tuple[NDArray[np.int64], Array]:
        """Return increasing stamps (M,) and their poses (M, 4, 4)."""
        stamps = sorted(self._poses)
        return (np.array(stamps, np.int64),
                np.array([self._poses[stamp] for stamp in stamps]).reshape(-1, 4, 4))

    def at(self, stamps_ns: NDArray[np.int64]) -> Array:
        """
        Return the poses (N, 4, 4) at some stamps (N,), NaN if unknown.

        They are interpolated between poses at most 0.1 s apart.
        """
        return poses_at(*self.known(), stamps_ns, LONGEST_GAP_NS)
