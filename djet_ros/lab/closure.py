"""
Rotation closure error of frame triplets: a measure of accuracy without ground truth.

With exact rotations R(i, i+2) (R(i+1, i+2) R(i, i+1))^T is the identity. Its deviation is a lower
bound of the error of the estimates: errors common to all three, such as those of a wrong camera
matrix, cancel, and so do in part errors of a frame that two pairs share.
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
from djet_ros.odometry.result import camera_motion
from djet_ros.recordings.frame_sequence import FrameSequence
from djet_ros.replay.pair_errors import motion_errors
import numpy as np
from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class Triangle:
    """
    Closure of frames first, first + 1 and first + 2 by one method; angles in degrees.

    angle: of the closure error; claimed: its standard deviation by the covariances;
    normalised_square: its NEES, with expectation 3 if the covariances are correct and the three
    errors independent; error: of the first rotation against ground truth, or NaN without it.
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
    Return the triplets of the first frames of a sequence by method, None if a pose has failed.

    Methods use the preset ``best``, with the previous motion as prior, as in the odometry. Raises
    DjetError if there are fewer than three frames.
    """
    frames = min(frames, len(sequence))
    if frames < 3:
        raise DjetError(f'{frames} frames are too few for a triplet; at least three are needed')
    estimators = {name: TwoViewEstimator(preset('best', method=name)) for name in methods}
    triangles: dict[str, list[Triangle | None]] = {name: [] for name in methods}
    # All methods share the features: detection does not depend on the method.
    detector = estimators[methods[0]]
    a, b = (sequence.frame(i).view(detector) for i in (0, 1))
    before = {name: one.estimate(a, b) for name, one in estimators.items()}
    for first in range(frames - 2):
        c = sequence.frame(first + 2).view(detector)
        for name, one in estimators.items():
            after = one.estimate(b, c, before[name])
            direct = one.estimate(a, c, before[name])
            triangles[name].append(_triangle(first, before[name], after, direct, sequence.poses))
            before[name] = after
        a, b = b, c
        progress(first + 1)
    return triangles


def _triangle(first: int, before: RelativePose, after: RelativePose, direct: RelativePose,
              poses: Array | None) -> Triangle | None:
    if any(one.status is not Status.OK for one in (before, after, direct)):
        return None
    closure, covariance = closure_rotation(before, after, direct)
    return Triangle(
        first, float(np.degrees(np.linalg.norm(closure))),
        float(np.degrees(np.sqrt(np.trace(covariance)))),
        float(closure @ np.linalg.solve(covariance, closure)),
        _error(before, poses, first))


def closure_rotation(before: RelativePose, after: RelativePose,
                     direct: RelativePose) -> tuple[Array, Array]:
    """
    Return the rotation vector (3,) of the closure error in rad, and its covariance (3, 3).

    before, after: motions from the first to the second view, and from the second to the third;
    direct: from the first to the third. Their errors are taken to be independent.
    """
    closure = Rotation.from_matrix(direct.R @ (after.R @ before.R).T).as_rotvec()
    C_before, C_after, C_direct = (one.covariance_5[:3, :3] for one in (before, after, direct))
    return closure, C_direct + C_after + after.R @ C_before @ after.R.T


def summary(triangles: Sequence[Triangle | None]) -> dict[str, Any]:
    """Summarise one method: angles in degrees; 'without': triplets without all three poses."""
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
