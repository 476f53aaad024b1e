"""
How far lengths drift, and whether they are as sure as they say: rendered ways, against the truth.

Each way is gone twice over the same pictures. Once by images alone: the first step is the unit.
Once with the camera's height in metres, and for a stretch without any ground in sight, as behind a
lorry or before a wall: there landmarks have to carry the scale.
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
from djet_ros.odometry.scale import Common
from djet_ros.odometry.uncertainty import PathCovariance
from djet_ros.odometry.visual_odometry import OdometryResult, VisualOdometry
from djet_ros.replay.drift import drift, one_factor, scale_change
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.stats import chi2

# Height of the rendered cars' cameras in metres, and from where on, as a share of the picture, all
# below is hidden: above the nearest ground that is used.
HEIGHT = 1.65
_HORIZON = 0.55

# Frames before the ground goes out of sight, and after which the factor to metres is known.
_LEAD = 60

# Steps to either side that a step's length is held against, and metres of stretches.
_NEIGHBOURS, STRETCHES = 5, (25, 50, 100)

# A stretch begins with every so many frames.
_EVERY = 10


@dataclass(frozen=True)
class WayChunk:
    """A way through a scene, in one place."""

    scene: str
    seed: int
    size: tuple[int, int] | None
    frames: int
    hidden: int

    @property
    def name(self) -> str:
        """Name that is the same in every run."""
        return f'{self.scene}:{self.seed}'

    @property
    def count(self) -> int:
        """How many pairs there are."""
        return self.frames - 1


@dataclass(frozen=True)
class Way:
    """
    What became of a way.

    tracked: pairs with a motion; scale_change: scale of its last tenth over that of its first;
    translation_percent, rotation_deg_per_100m: its drift, in its best unit; squares of errors over
    their covariances, in the median over what that is if these are true: of the length of a step
    against its neighbours, of the turn and the pose after 25, 50 and 100 m (see
    ``stretch_squares``); hidden_length: length over the truth with the camera's height, where no
    ground was seen. NaN where nothing is told.
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


def go(chunk: WayChunk, config: EstimatorConfig) -> list[Way]:
    """Render a way, and go it by images alone and with the camera's height."""
    cv2.setNumThreads(1)
    scene = make_scene(chunk.scene, chunk.seed, chunk.size)
    poses = scene.trajectory(chunk.frames)
    alone = VisualOdometry(config)
    metric = VisualOdometry(config, OdometryConfig(scale='camera_height', camera_height=HEIGHT))
    ground = np.zeros(scene.size[::-1], bool)
    ground[int(_HORIZON * len(ground)):] = True
    results: tuple[list[OdometryResult], list[OdometryResult]] = [], []
    for index, pose in enumerate(poses):
        gray, stamp = scene.render(pose, index), round(index * FRAME_PERIOD * 1e9)
        covered = _LEAD <= index < _LEAD + chunk.hidden
        results[0].append(alone.process(Frame(gray, scene.K, stamp)))
        results[1].append(metric.process(Frame(
            gray, scene.K, stamp, left_out=ground if covered else None)))
    return [way_of(chunk, poses, *results)]


def way_of(chunk: WayChunk, truth: Array, alone: Sequence[OdometryResult],
           metric: Sequence[OdometryResult]) -> Way:
    """Hold two runs over the same frames against true poses (N, 4, 4)."""
    found = np.array([result.pose for result in alone])
    unit = one_factor(found[:, :3, 3], truth[:, :3, 3])
    found[:, :3, 3] *= unit
    told = drift(truth, found)
    hidden = slice(_LEAD, _LEAD + chunk.hidden)
    ways, true_ways = (np.linalg.norm(np.diff(way[:, :3, 3], axis=0), axis=1)[hidden]
                       for way in (np.array([result.pose for result in metric]), truth))
    stretches = [stretch_squares(truth, alone, metres) for metres in STRETCHES]
    turns, poses = ([_median(squares[which], degrees) for squares in stretches]
                    for which, degrees in ((0, 3), (1, 6)))
    return Way(
        chunk.scene, chunk.seed, len(truth), sum(one.status in TRACKED for one in alone),
        scale_change(found[:, :3, 3], truth[:, :3, 3]),
        told.translation_percent if told else float('nan'),
        told.rotation_deg_per_100m if told else float('nan'),
        _median(step_squares(truth, alone), 1),
        turns[0], turns[1], turns[2], poses[0], poses[1], poses[2],
        float(ways.sum() / true_ways.sum()) if chunk.hidden and true_ways.any() else float('nan'))


def step_squares(truth: Array, results: Sequence[OdometryResult]) -> Array:
    """
    Squared errors of lengths over their variances, (M,), each against its neighbours.

    What the scale has drifted by before is no error of a step, so the factor between lengths and
    the truth is that of the steps before and after. A part of a step's error is in all later
    steps too: by that the scale wanders, as is told (see ``Common``), and where it is in
    neighbours it cancels. With errors x_j, of which w_j stays, the logarithm of a length is off by
    x_i + sum_(j<i) w_j, and what is weighed by c_i, one for the step and sharing out minus one
    among its neighbours, by

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
    wandered = np.array([_wandered(result) for _, result in moved])
    stay = np.sqrt(np.maximum(np.diff(wandered, prepend=0.0), 0.0))
    weights = np.full(2 * _NEIGHBOURS + 1, -1 / (2 * _NEIGHBOURS))
    weights[_NEIGHBOURS] = 1.0
    after = np.cumsum(weights[::-1])[::-1] - weights
    ratios, sigmas, stay = (sliding_window_view(values, len(weights))
                            for values in (ratios, sigmas, stay))
    # An error and what stays of it are one and the same, so that they add up before the square.
    variances = ((weights * sigmas + after * stay)**2).sum(1)
    return np.asarray((ratios @ weights)**2 / variances)


def stretch_squares(truth: Array, results: Sequence[OdometryResult], metres: float
                    ) -> tuple[Array, Array]:
    """
    Squared errors of turns (M,) and poses (M,) over their covariances, after so many metres.

    From every tenth frame on, in the unit of the steps before it: what the scale has drifted by
    before is no error of a stretch, and how sure that unit is belongs to it.
    """
    gone = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1)))
    squares = []
    for first in range(_EVERY, len(truth), _EVERY):
        last = int(np.searchsorted(gone, gone[first] + metres))
        if last >= len(truth):
            break
        pose, path = _integrated(results[first:last + 1], *_unit_before(first, gone, results))
        true = np.linalg.inv(truth[first]) @ truth[last]
        off = np.concatenate([true[:3, 3] - pose[:3, 3],
                              rotation_log(true[:3, :3] @ pose[:3, :3].T)])
        squares.append([off[3:] @ np.linalg.solve(path.pose[3:, 3:], off[3:]),
                        off @ np.linalg.solve(path.pose, off)])
    turns, poses = np.array(squares).reshape(-1, 2).T
    return turns, poses


def _unit_before(first: int, gone: Array, results: Sequence[OdometryResult]
                 ) -> tuple[float, float, float]:
    """Give the unit of the steps to a frame, its variance, and how far it has wandered there."""
    before = [index for index in range(first - _EVERY + 1, first + 1)
              if _length(results[index]) > 0 and gone[index] > gone[index - 1]]
    if not before:
        return 0.0, 0.0, 0.0
    logs = [np.log((gone[index] - gone[index - 1]) / _length(results[index])) for index in before]
    wandered = np.array([_wandered(results[index]) for index in before])
    here = _wandered(results[first])
    own = sum(_own_sigma(results[index])**2 for index in before) / len(before)**2
    # The variance of a mean of random walks is two thirds of the mean of their variances.
    return float(np.mean(logs)), own + 2 / 3 * float((here - wandered).mean()), here


def _integrated(results: Sequence[OdometryResult], unit: float, variance: float, wandered: float
                ) -> tuple[Array, PathCovariance]:
    """
    Go on from the first of some results, as all were told, in a unit.

    It is given with its variance and how far the scale had wandered when it was told.
    """
    scaled = np.diag([np.exp(unit)] * 3 + [1.0] * 3)
    pose, path = np.eye(4), PathCovariance()
    for before, result in pairwise(results):
        motion = np.linalg.inv(before.pose) @ result.pose
        motion[:3, 3] *= np.exp(unit)
        common = result.common and Common(np.array(
            [variance + max(_wandered(result) - wandered, 0.0), 0.0]), np.ones(2))
        path = path.moved(pose, motion, scaled @ result.motion_covariance @ scaled, common)
        pose = pose @ motion
    return pose, path


def _wandered(result: OdometryResult) -> float:
    return 0.0 if result.common is None else float(result.common.variances[0])


def _length(result: OdometryResult) -> float:
    return float(np.linalg.norm(result.motion[:3, 3]))


def _own_sigma(result: OdometryResult) -> float:
    """Give the standard deviation of a length, as a share of it."""
    along = result.motion[:3, 3] / _length(result)
    return float(np.sqrt(along @ result.motion_covariance[:3, :3] @ along)) / _length(result)


def _median(squares: NDArray[Any], degrees: int) -> float:
    return float(np.median(squares) / chi2.median(degrees)) if len(squares) else float('nan')
