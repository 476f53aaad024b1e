"""
Scale drift and consistency of the covariances of lengths, on rendered drives.

The odometry runs twice on the same images: from images alone, with the first step as unit; and
with the scale from the camera's height, while the ground is masked for some time, as if hidden by
a lorry or a wall, so that landmarks have to propagate the scale.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cv2
from djet_ros.config.sections import OdometryConfig
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.geometry import rotation_log
from djet_ros.core.types import Array, TRACKED
from djet_ros.lab.scenes import make_scene
from djet_ros.lab.scenes.sequence import FRAME_PERIOD
from djet_ros.odometry.frame import Frame
from djet_ros.odometry.result import OdometryResult
from djet_ros.odometry.scale import Common
from djet_ros.odometry.uncertainty import PathCovariance
from djet_ros.odometry.visual_odometry import VisualOdometry
from djet_ros.replay.drift import drift, path_scale, scale_change
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.stats import chi2

# Camera height of the rendered cars in metres.
HEIGHT = 1.65
# Share of the image height below which everything is masked, to hide all ground that is used.
_HORIZON = 0.55

# Frames before the ground is masked, in which the metric scale is determined.
_LEAD = 60

# Steps to either side that a step's length is compared with, and segment lengths in metres.
_NEIGHBOURS, SEGMENTS_M = 5, (25, 50, 100)

# Frames between the starts of segments.
_EVERY = 10


@dataclass(frozen=True)
class DriveChunk:
    """A drive through a scene, by its seed."""

    scene: str
    seed: int
    size: tuple[int, int] | None
    frames: int
    hidden: int

    @property
    def name(self) -> str:
        """Return a name that is the same in every run."""
        return f'{self.scene}:{self.seed}'

    @property
    def count(self) -> int:
        """Return the number of pairs."""
        return self.frames - 1


@dataclass(frozen=True)
class Drive:
    """
    Results of a drive.

    tracked: pairs with a motion; scale_change: scale of the last tenth over that of the first;
    translation_percent, rotation_deg_per_100m: drift after scale alignment; *_square_*: median
    NEES over the median of its distribution, of the length of a step relative to its neighbours,
    and of rotation and pose after 25, 50 and 100 m (see ``segment_squares``); hidden_length:
    estimated over true path length with the camera's height, while no ground is visible. NaN if
    undetermined.
    """

    scene: str
    seed: int
    frames: int
    tracked: int
    scale_change: float
    translation_percent: float
    rotation_deg_per_100m: float
    step_square: float
    turn_square_25: float
    turn_square_50: float
    turn_square_100: float
    pose_square_25: float
    pose_square_50: float
    pose_square_100: float
    hidden_length: float


def run_drive(chunk: DriveChunk, config: EstimatorConfig) -> list[Drive]:
    """Render a drive, and run the odometry from images alone and with the camera's height."""
    cv2.setNumThreads(1)
    scene = make_scene(chunk.scene, chunk.seed, chunk.size)
    poses = scene.trajectory(chunk.frames)
    visual = VisualOdometry(config)
    metric = VisualOdometry(config, OdometryConfig(scale='camera_height', camera_height=HEIGHT))
    ground = np.zeros(scene.size[::-1], bool)
    ground[int(_HORIZON * len(ground)):] = True
    results: tuple[list[OdometryResult], list[OdometryResult]] = [], []
    for index, pose in enumerate(poses):
        gray, stamp = scene.render(pose, index), round(index * FRAME_PERIOD * 1e9)
        covered = _LEAD <= index < _LEAD + chunk.hidden
        results[0].append(visual.process(Frame(gray, scene.K, stamp)))
        results[1].append(metric.process(Frame(
            gray, scene.K, stamp, left_out=ground if covered else None)))
    return [drive_results(chunk, poses, *results)]


def drive_results(chunk: DriveChunk, truth: Array, visual: Sequence[OdometryResult],
                  metric: Sequence[OdometryResult]) -> Drive:
    """Compare two runs over the same frames with true poses (N, 4, 4)."""
    poses = np.array([result.pose for result in visual])
    unit = path_scale(poses[:, :3, 3], truth[:, :3, 3])
    poses[:, :3, 3] *= unit
    drifted = drift(truth, poses)
    hidden = slice(_LEAD, _LEAD + chunk.hidden)
    steps, true_steps = (np.linalg.norm(np.diff(path[:, :3, 3], axis=0), axis=1)[hidden]
                         for path in (np.array([result.pose for result in metric]), truth))
    segments = [segment_squares(truth, visual, metres) for metres in SEGMENTS_M]
    rotations, pose_medians = ([_median(squares[kind], degrees) for squares in segments]
                               for kind, degrees in ((0, 3), (1, 6)))
    return Drive(
        chunk.scene, chunk.seed, len(truth), sum(one.status in TRACKED for one in visual),
        scale_change(poses[:, :3, 3], truth[:, :3, 3]),
        drifted.translation_percent if drifted else float('nan'),
        drifted.rotation_deg_per_100m if drifted else float('nan'),
        _median(step_squares(truth, visual), 1),
        rotations[0], rotations[1], rotations[2],
        pose_medians[0], pose_medians[1], pose_medians[2],
        float(steps.sum() / true_steps.sum()) if chunk.hidden and true_steps.any()
        else float('nan'))


def step_squares(truth: Array, results: Sequence[OdometryResult]) -> Array:
    """
    Return the squared errors of lengths over their variances (M,), relative to neighbouring steps.

    Scale drift before a step is not its error, so lengths are compared with those of the steps
    before and after. A part of each step's error persists in all later steps, as a random walk of
    the scale (see ``Common``); it cancels as far as neighbours share it. With errors x_j, of which
    w_j persists, the error of the logarithm of a length is x_i + sum_(j<i) w_j. The weighted sum,
    with weights c_i of 1 for the step and in total -1 for its neighbours, then has the error

        sum_j (c_j x_j + (sum_(i>j) c_i) w_j) .
    """
    moved = [(index, result) for index, result in enumerate(results)
             if index and result.status in TRACKED and result.motion[:3, 3].any()]
    if len(moved) <= 2 * _NEIGHBOURS:
        return np.empty(0)
    true = np.array([np.linalg.norm(truth[index, :3, 3] - truth[index - 1, :3, 3])
                     for index, _ in moved])
    ratios = np.log(np.array([_length(result) for _, result in moved]) / true)
    sigmas = np.array([_own_sigma(result) for _, result in moved])
    wandered = np.array([_walk_variance(result) for _, result in moved])
    stay = np.sqrt(np.maximum(np.diff(wandered, prepend=0.0), 0.0))
    weights = np.full(2 * _NEIGHBOURS + 1, -1 / (2 * _NEIGHBOURS))
    weights[_NEIGHBOURS] = 1.0
    after = np.cumsum(weights[::-1])[::-1] - weights
    ratios, sigmas, stay = (sliding_window_view(values, len(weights))
                            for values in (ratios, sigmas, stay))
    # An error and its persistent part are fully correlated: add before squaring.
    variances = ((weights * sigmas + after * stay)**2).sum(1)
    return np.asarray((ratios @ weights)**2 / variances)


def segment_squares(truth: Array, results: Sequence[OdometryResult], metres: float
                    ) -> tuple[Array, Array]:
    """
    Return the NEES (M,) of rotations and (M,) of poses over segments of a length in metres.

    Segments start at every tenth frame. Their scale is that of the steps before the start, whose
    variance is included: scale drift before a segment is not its error.
    """
    distances = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1)))
    squares = []
    for first in range(_EVERY, len(truth), _EVERY):
        last = int(np.searchsorted(distances, distances[first] + metres))
        if last >= len(truth):
            break
        pose, path = _integrated(results[first:last + 1], *_unit_before(first, distances, results))
        true = np.linalg.inv(truth[first]) @ truth[last]
        errors = np.concatenate([true[:3, 3] - pose[:3, 3],
                                 rotation_log(true[:3, :3] @ pose[:3, :3].T)])
        squares.append([errors[3:] @ np.linalg.solve(path.pose[3:, 3:], errors[3:]),
                        errors @ np.linalg.solve(path.pose, errors)])
    rotations, poses = np.array(squares).reshape(-1, 2).T
    return rotations, poses


def _unit_before(first: int, distances: Array, results: Sequence[OdometryResult]
                 ) -> tuple[float, float, float]:
    """Return (log scale, its variance, variance of the scale's walk) of the steps to a frame."""
    before = [index for index in range(first - _EVERY + 1, first + 1)
              if _length(results[index]) > 0 and distances[index] > distances[index - 1]]
    if not before:
        return 0.0, 0.0, 0.0
    logs = [np.log((distances[index] - distances[index - 1]) / _length(results[index]))
            for index in before]
    wandered = np.array([_walk_variance(results[index]) for index in before])
    current = _walk_variance(results[first])
    variance = sum(_own_sigma(results[index])**2 for index in before) / len(before)**2
    # The variance of a mean of random walks is two thirds of the mean of their variances.
    return float(np.mean(logs)), variance + 2 / 3 * float((current - wandered).mean()), current


def _integrated(results: Sequence[OdometryResult], unit: float, variance: float, wandered: float
                ) -> tuple[Array, PathCovariance]:
    """
    Integrate motions from the first result on; return the pose (4, 4) and its covariance.

    unit, variance: logarithm of the scale, and its variance; wandered: variance of the scale's
    random walk at the start.
    """
    scaled = np.diag([np.exp(unit)] * 3 + [1.0] * 3)
    pose, path = np.eye(4), PathCovariance()
    for before, result in pairwise(results):
        motion = np.linalg.inv(before.pose) @ result.pose
        motion[:3, 3] *= np.exp(unit)
        common = result.common and Common(np.array(
            [variance + max(_walk_variance(result) - wandered, 0.0), 0.0]), np.ones(2))
        path = path.moved(pose, motion, scaled @ result.motion_covariance @ scaled, common)
        pose = pose @ motion
    return pose, path


def _walk_variance(result: OdometryResult) -> float:
    return 0.0 if result.common is None else float(result.common.variances[0])


def _length(result: OdometryResult) -> float:
    return float(np.linalg.norm(result.motion[:3, 3]))


def _own_sigma(result: OdometryResult) -> float:
    """Return the standard deviation of a length, as a share of it."""
    along = result.motion[:3, 3] / _length(result)
    return float(np.sqrt(along @ result.motion_covariance[:3, :3] @ along)) / _length(result)


def _median(squares: NDArray[Any], degrees: int) -> float:
    return float(np.median(squares) / chi2.median(degrees)) if len(squares) else float('nan')
