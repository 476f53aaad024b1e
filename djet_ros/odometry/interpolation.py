"""Poses of a camera between the stamps at which they are known."""

from __future__ import annotations

from djet_ros.core.types import Array
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Stamps = NDArray[np.int64]


def positions_at(known_ns: Stamps, positions: Array, stamps_ns: Stamps, longest_gap_ns: int
                 ) -> Array:
    """
    Return positions (N, 3) at stamps (N,), from those (M, 3) known at increasing stamps (M,).

    Interpolated linearly between two that are at most longest_gap_ns apart, exact at known stamps,
    NaN elsewhere.
    """
    if not len(known_ns):
        return np.full((len(stamps_ns), 3), np.nan)
    before, after, share = _neighbours(known_ns, stamps_ns, longest_gap_ns)
    share = share[:, None]
    return np.asarray((1 - share) * positions[before] + share * positions[after])


def poses_at(known_ns: Stamps, poses: Array, stamps_ns: Stamps, longest_gap_ns: int) -> Array:
    """Return poses (N, 4, 4) as ``positions_at``, with rotations interpolated by slerp."""
    result = np.full((len(stamps_ns), 4, 4), np.nan)
    if not len(known_ns):
        return result
    before, after, share = _neighbours(known_ns, stamps_ns, longest_gap_ns)
    exact, between = share == 1, share < 1
    result[exact] = poses[after[exact]]
    result[between] = np.eye(4)
    result[between, :3, 3] = positions_at(known_ns, poses[:, :3, 3], stamps_ns[between],
                                          longest_gap_ns)
    if between.any():
        start = Rotation.from_matrix(poses[before[between], :3, :3])
        turn = (start.inv() * Rotation.from_matrix(poses[after[between], :3, :3])).as_rotvec()
        turned = start * Rotation.from_rotvec(share[between, None] * turn)
        result[between, :3, :3] = turned.as_matrix()
    return result


def _neighbours(known_ns: Stamps, stamps_ns: Stamps, longest_gap_ns: int
                ) -> tuple[Stamps, Stamps, Array]:
    """Return indices (N,) before and after, and the share between them, NaN if unknown."""
    place = np.searchsorted(known_ns, stamps_ns)
    after = np.minimum(place, len(known_ns) - 1)
    before = np.maximum(after - 1, 0)
    gap = known_ns[after] - known_ns[before]
    inside = (place > 0) & (place < len(known_ns)) & (gap <= longest_gap_ns)
    share = np.where(inside, (stamps_ns - known_ns[before]) / np.maximum(gap, 1), np.nan)
    return before, after, np.where(known_ns[after] == stamps_ns, 1.0, share)
