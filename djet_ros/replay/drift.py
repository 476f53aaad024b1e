"""
Drift over segments of 100 to 800 m, as defined by the KITTI odometry benchmark.

A segment starts at every tenth frame, for each length in LENGTHS, and ends at the first frame
beyond that length along the true path. Its error is ``E = D_estimate^-1 D_truth`` of the relative
poses, per nominal length: |t(E)| in percent, and the angle of R(E) in degrees per 100 m. Both are
averaged over all segments (A. Geiger, P. Lenz, R. Urtasun, "Are we ready for autonomous
driving?", CVPR 2012, and its development kit).
"""

from __future__ import annotations

from dataclasses import dataclass

from djet_ros.core.types import Array
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

LENGTHS = (100, 200, 300, 400, 500, 600, 700, 800)
_EVERY = 10

# Ratio of two path lengths below which the shorter one counts as a standstill.
_STANDSTILL_RATIO = 1e-3


@dataclass(frozen=True)
class Drift:
    """
    Mean drift of an estimated trajectory over its segments.

    translation_percent: KITTI's t_rel, meaningful only if the estimate has true lengths;
    rotation_deg_per_100m: KITTI's r_rel; segments: number of segments; longest: length of the
    longest segment in metres.
    """

    translation_percent: float
    rotation_deg_per_100m: float
    segments: int
    longest: int


def drift(truth: Array, estimate: Array) -> Drift | None:
    """
    Return the drift of a trajectory, from poses (N, 4, 4) of the camera in metres, frame by frame.

    The two trajectories may have different frames. None if the true path is not longer than
    100 m. Raises ValueError if the shapes differ or a pose is not finite.
    """
    if truth.shape != estimate.shape or truth.shape[1:] != (4, 4):
        raise ValueError(f'trajectories are {truth.shape} and {estimate.shape}; both must be '
                         '(N, 4, 4)')
    if not (np.isfinite(truth).all() and np.isfinite(estimate).all()):
        raise ValueError('a pose is not finite; give the frames that both trajectories have')
    first, last, length = _segments(truth[:, :3, 3])
    if not len(first):
        return None
    error = np.linalg.inv(_between(estimate, first, last)) @ _between(truth, first, last)
    angle = np.degrees(Rotation.from_matrix(error[:, :3, :3]).magnitude())
    gap = np.linalg.norm(error[:, :3, 3], axis=1)
    return Drift(float(100 * (gap / length).mean()), float(100 * (angle / length).mean()),
                 len(first), int(length.max()))


def path_length(places: Array) -> float:
    """Return the length of a path through places (N, 3)."""
    return float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())


def path_scale(places: Array, truth: Array) -> float:
    """
    Return the factor that scales a path (N, 3) to the true one (N, 3), by their spread.

    1 if it stands still.
    """
    spread, true_spread = (np.linalg.norm(path - path.mean(0)) for path in (places, truth))
    # The spread of equal places is the rounding of their mean.
    return float(true_spread / spread) if np.ptp(places, axis=0).any() else 1.0


def scale_change(places: Array, truth: Array) -> float:
    """
    Return the scale of a path (N, 3) in the last tenth of the true path over that in the first.

    Scales are ratios of summed step lengths. 1 without scale drift; NaN if the path stands still
    in one of the two, or the true path altogether.
    """
    steps, true_steps = (np.linalg.norm(np.diff(path, axis=0), axis=1) for path in (places, truth))
    distances = np.cumsum(true_steps)
    # At least one step each: the one in which the first tenth ends or the last begins.
    first, last = distances - true_steps <= 0.1 * distances[-1], distances >= 0.9 * distances[-1]
    start, end = steps[first].sum(), steps[last].sum()
    if min(start, end) <= _STANDSTILL_RATIO * max(start, end) or not true_steps.any():
        return float('nan')
    return float(end / true_steps[last].sum() / (start / true_steps[first].sum()))


def _segments(places: Array) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.int64]]:
    """Return first and last frames (M,) and lengths (M,) of all segments of a path (N, 3)."""
    distances = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1)))
    first, length = (grid.ravel() for grid in np.meshgrid(
        np.arange(0, len(places), _EVERY), LENGTHS, indexing='ij'))
    last = np.searchsorted(distances, distances[first] + length, side='right')
    complete = last < len(places)
    return first[complete], last[complete], length[complete]


def _between(poses: Array, first: NDArray[np.intp], last: NDArray[np.intp]) -> Array:
    """Return the poses (M, 4, 4) of the last frames in the first ones."""
    return np.asarray(np.linalg.inv(poses[first]) @ poses[last])
