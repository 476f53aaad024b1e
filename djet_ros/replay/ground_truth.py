"""True poses of a camera, known at some moments."""

from __future__ import annotations

from djet_ros.core.types import Array
from djet_ros.recordings.datasets import LONGEST_GAP_NS
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp


class GroundTruth:
    """Stamped poses (4, 4), camera in some fixed frame, in any order."""

    def __init__(self) -> None:
        self._poses: dict[int, Array] = {}

    def add(self, stamp_ns: int, pose: Array) -> None:
        """Take a pose; one with a number that is not finite is left out."""
        if np.isfinite(pose).all():
            self._poses[stamp_ns] = pose

    def __len__(self) -> int:
        """Count the poses."""
        return len(self._poses)

    def known(self) -> tuple[NDArray[np.int64], Array]:
        """Stamps (M,), increasing, and poses (M, 4, 4)."""
        stamps = sorted(self._poses)
        return (np.array(stamps, np.int64),
                np.array([self._poses[stamp] for stamp in stamps]).reshape(-1, 4, 4))

    def at(self, stamps_ns: NDArray[np.int64]) -> Array:
        """
        Poses (N, 4, 4) at some stamps (N,), NaN where they are not known.

        Between two poses at most 0.1 s apart they are interpolated.
        """
        result = np.full((len(stamps_ns), 4, 4), np.nan)
        known, poses = self.known()
        for i, stamp in enumerate(stamps_ns.tolist()):
            after = int(np.searchsorted(known, stamp))
            if stamp in self._poses:
                result[i] = self._poses[stamp]
            elif 0 < after < len(known) and known[after] - known[after - 1] <= LONGEST_GAP_NS:
                share = (stamp - known[after - 1]) / (known[after] - known[after - 1])
                result[i] = _between(poses[after - 1], poses[after], float(share))
        return result


def _between(before: Array, after: Array, share: float) -> Array:
    pose = np.eye(4)
    turn = Slerp([0.0, 1.0], Rotation.from_matrix(np.stack([before[:3, :3], after[:3, :3]])))
    pose[:3, :3] = turn(share).as_matrix()
    pose[:3, 3] = (1 - share) * before[:3, 3] + share * after[:3, 3]
    return pose
