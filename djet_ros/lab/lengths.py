"""
How far lengths drift, and whether they are as sure as they say: rendered ways, against the truth.

Each way is gone twice over the same pictures. Once by images alone: the first step is the unit.
Once with the camera's height in metres, and for a stretch without any ground in sight, as behind a
lorry or before a wall: there landmarks have to carry the scale.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
from djet_ros.config.sections import OdometryConfig
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.geometry import rotation_log
from djet_ros.core.types import Array
from djet_ros.lab.scenes import make_scene
from djet_ros.lab.scenes.sequence import FRAME_PERIOD
from djet_ros.odometry.frame import Frame
from djet_ros.odometry.uncertainty import compose
from djet_ros.odometry.visual_odometry import OdometryResult, TRACKED, VisualOdometry
from djet_ros.replay.drift import drift, one_factor, scale_change
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

# Height of the rendered cars' cameras in metres, and from where on, as a share of the picture, all
# below is hidden: above the nearest ground that is used.
HEIGHT = 1.65
_HORIZON = 0.55

# Frames before the ground goes out of sight, and after which the factor to metres is known.
_LEAD = 60

# Steps to either side that a step's length is held against, and metres of a stretch.
_NEIGHBOURS, _STRETCH = 5, 100.0

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
    against its neighbours, of the turn after 100 m, of the pose there in the way's best unit;
    hidden_length: length over the truth with the camera's height, where no ground was seen.
    NaN where nothing is told.
    """

    scene: str
    seed: int
    frames: int
    tracked: int
    scale_change: float
    translation_percent: float
    rotation_deg_per_100m: float
    step_square: float
    turn_square: float
    pose_square: float
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
    turns, stretches = _after_stretches(truth, alone, unit)
    return Way(
        chunk.scene, chunk.seed, len(truth), sum(one.status in TRACKED for one in alone),
        scale_change(found[:, :3, 3], truth[:, :3, 3]),
        told.translation_percent if told else float('nan'),
        told.rotation_deg_per_100m if told else float('nan'),
        _median(step_squares(truth, alone), 1), _median(turns, 3), _median(stretches, 6),
        float(ways.sum() / true_ways.sum()) if chunk.hidden and true_ways.any() else float('nan'))


def step_squares(truth: Array, results: Sequence[OdometryResult]) -> Array:
    """
    Squared errors of lengths over their variances, (M,), each against its neighbours.

    What the scale has drifted by before is no error of a step, so the factor between lengths and
    the truth is that of the steps before and after.
    """
    moved = [(index, result) for index, result in enumerate(results)
             if index and result.status in TRACKED and result.motion[:3, 3].any()]
    if len(moved) <= 2 * _NEIGHBOURS:
        return np.empty(0)
    true = np.array([np.linalg.norm(truth[index, :3, 3] - truth[index - 1, :3, 3])
                     for index, _ in moved])
    lengths = np.array([np.linalg.norm(result.motion[:3, 3]) for _, result in moved])
    ways = np.array([result.motion[:3, 3] for _, result in moved]) / lengths[:, None]
    variances = np.einsum('ni,nij,nj->n', ways, np.array(
        [result.motion_covariance[:3, :3] for _, result in moved]), ways) / lengths**2
    ratios = np.log(lengths / true)
    kernel = np.ones(2 * _NEIGHBOURS + 1) / (2 * _NEIGHBOURS)
    kernel[_NEIGHBOURS] = 0.0
    inner = slice(_NEIGHBOURS, -_NEIGHBOURS)
    off = ratios[inner] - np.convolve(ratios, kernel, 'valid')
    return np.asarray(off**2 / (variances[inner] + np.convolve(variances, kernel**2, 'valid')))


def _after_stretches(truth: Array, results: Sequence[OdometryResult], unit: float
                     ) -> tuple[Array, Array]:
    """Normalised squares (M,) of turns, and of poses, after 100 m from every tenth frame on."""
    gone = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1)))
    scaled = np.diag([unit] * 3 + [1.0] * 3)
    squares = []
    for first in range(0, len(truth), _EVERY):
        last = int(np.searchsorted(gone, gone[first] + _STRETCH))
        if last >= len(truth):
            break
        pose, covariance = np.eye(4), np.zeros((6, 6))
        for result in results[first + 1:last + 1]:
            motion = result.motion.copy()
            motion[:3, 3] *= unit
            covariance = compose(pose, covariance, motion,
                                 scaled @ result.motion_covariance @ scaled)
            pose = pose @ motion
        true = np.linalg.inv(truth[first]) @ truth[last]
        off = np.concatenate([true[:3, 3] - pose[:3, 3],
                              rotation_log(true[:3, :3] @ pose[:3, :3].T)])
        squares.append([off[3:] @ np.linalg.solve(covariance[3:, 3:], off[3:]),
                        off @ np.linalg.solve(covariance, off)])
    turns, poses = np.array(squares).reshape(-1, 2).T
    return turns, poses


def _median(squares: NDArray[Any], degrees: int) -> float:
    return float(np.median(squares) / chi2.median(degrees)) if len(squares) else float('nan')
