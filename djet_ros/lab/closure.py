"""
How well the rotations of three frames agree with one another: a measure without ground truth.

Of the rotations between frames i, i + 1 and i + 2 each follows from the other two. What remains of
R(i, i+2) (R(i+1, i+2) R(i, i+1))^T is error of the estimates. It is a lower bound of their error:
what all three have in common, such as a wrong camera matrix, cancels, and so does part of what is
wrong with a frame that two of them share.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.estimator_config import preset
from djet_ros.core.types import Array, RelativePose, Status
from djet_ros.errors import DjetError
from djet_ros.lab.summary import spread_of
from djet_ros.odometry.visual_odometry import camera_motion
from djet_ros.recordings.frame_sequence import FrameSequence
from djet_ros.replay.pair_errors import motion_errors
import numpy as np
from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class Triangle:
    """
    What a method makes of frames `first`, first + 1 and first + 2; angles in degrees.

    angle: of the rotation that remains; claimed: its standard deviation by the covariances;
    normalised_square: 3 on average if those are true and the three errors independent; error: of
    the first rotation against the ground truth, NaN where there is none.
    """

    first: int
    angle: float
    claimed: float
    normalised_square: float
    error: float


def closures(sequence: FrameSequence, methods: Sequence[str], frames: int,
             progress: Callable[[int], None] = lambda done: None
             ) -> dict[str, list[Triangle | None]]:
    """
    Give the triangles of the first frames of a sequence; None where a pose was not found.

    Methods start with the preset ``best`` and from the motion before, as in the odometry. Raises
    DjetError where there are not three frames.
    """
    frames = min(frames, len(sequence))
    if frames < 3:
        raise DjetError(f'there are {frames} frames to use; a triangle needs three')
    estimators = {name: TwoViewEstimator(preset('best', method=name)) for name in methods}
    found: dict[str, list[Triangle | None]] = {name: [] for name in methods}
    # All methods see the same features: detection has no parameter of theirs.
    detector = estimators[methods[0]]
    a, b = (sequence.frame(i).view(detector) for i in (0, 1))
    before = {name: one.estimate(a, b) for name, one in estimators.items()}
    for first in range(frames - 2):
        c = sequence.frame(first + 2).view(detector)
        for name, one in estimators.items():
            after = one.estimate(b, c, before[name])
            across = one.estimate(a, c, before[name])
            found[name].append(_triangle(first, before[name], after, across, sequence.poses))
            before[name] = after
        a, b = b, c
        progress(first + 1)
    return found


def _triangle(first: int, before: RelativePose, after: RelativePose, across: RelativePose,
              poses: Array | None) -> Triangle | None:
    if any(one.status is not Status.OK for one in (before, after, across)):
        return None
    remains, covariance = remaining_rotation(before, after, across)
    return Triangle(
        first, float(np.degrees(np.linalg.norm(remains))),
        float(np.degrees(np.sqrt(np.trace(covariance)))),
        float(remains @ np.linalg.solve(covariance, remains)),
        _error(before, poses, first))


def remaining_rotation(before: RelativePose, after: RelativePose,
                       across: RelativePose) -> tuple[Array, Array]:
    """
    Give the rotation vector (3,) in rad that three motions leave, and its covariance (3, 3).

    before, after: the motions from the first to the second view, and from that to the third;
    across: that from the first to the third. Their errors are taken to be independent.
    """
    remains = Rotation.from_matrix(across.R @ (after.R @ before.R).T).as_rotvec()
    C_before, C_after, C_across = (one.covariance_5[:3, :3] for one in (before, after, across))
    return remains, C_across + C_after + after.R @ C_before @ after.R.T


def summary(triangles: Sequence[Triangle | None]) -> dict[str, Any]:
    """Sum up one method: angles in degrees, 'without' counts triangles with a pose missing."""
    closed = [triangle for triangle in triangles if triangle is not None]

    def spread(name: str) -> dict[str, float]:
        return spread_of([getattr(triangle, name) for triangle in closed])

    return {'triangles': len(closed), 'without': len(triangles) - len(closed),
            'median_deg': spread('angle')['median'], 'p95_deg': spread('angle')['p95'],
            'claimed_median_deg': spread('claimed')['median'],
            'normalised_square_mean': spread('normalised_square')['mean'],
            'error_median_deg': spread('error')['median']}


def _error(pose: RelativePose, poses: Array | None, first: int) -> float:
    if poses is None or not np.isfinite(poses[[first, first + 1]]).all():
        return float('nan')
    true_motion = np.linalg.inv(poses[first]) @ poses[first + 1]
    return motion_errors(pose.status, camera_motion(pose), true_motion)[0]
