"""
Benefit of a gyro and of a mask: errors on rendered scenes with and without them.

Each trial is a trajectory through a scene, most of them hard for a camera alone; all aids of a
trial get the same images. The gyro has the errors of a MEMS in a telephone, and its bias is
unknown at the start. The mask excludes exactly the moving objects.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.geometry import rotation_log
from djet_ros.core.types import Array, TRACKED
from djet_ros.lab.pairs import has_failed
from djet_ros.lab.scenes import make_scene, Scene
from djet_ros.lab.scenes.imu import feel, FeltMotion, Mems
from djet_ros.lab.scenes.panel import World
from djet_ros.lab.scenes.sequence import FRAME_PERIOD
from djet_ros.odometry.frame import Frame
from djet_ros.odometry.inertial import Gyro, GyroNoise
from djet_ros.odometry.result import OdometryResult
from djet_ros.odometry.visual_odometry import VisualOdometry
from djet_ros.replay.pair_errors import angle_errors
import numpy as np
from numpy.typing import NDArray

# Translations below this, in metres, count as zero.
_NO_TRANSLATION_M = 1e-9

NOTHING, GYRO, MASK = 'nothing', 'gyro', 'mask'


@dataclass(frozen=True)
class Trial:
    """A trajectory through a scene; dark: frames with a black image; aids: to compare."""

    scene: str
    frames: int
    dark: range = range(0)
    aids: tuple[str, ...] = (NOTHING, GYRO)


TRIALS = {
    'whip': Trial('whip', 61),
    'dark': Trial('road', 61, range(31, 51)),
    'lorry': Trial('moving_object', 41, aids=(NOTHING, GYRO, MASK)),
    'traffic': Trial('traffic', 61, aids=(NOTHING, GYRO, MASK)),
    'street': Trial('road', 61),
    'hand-held': Trial('handheld', 301),
}


@dataclass(frozen=True)
class TrialChunk:
    """A trial with one seed, of at most ``most`` frames."""

    trial: str
    seed: int
    most: int

    @property
    def name(self) -> str:
        """Return a name that is the same in every run."""
        return f'{self.trial}:{self.seed}'

    @property
    def frames(self) -> int:
        """Return the number of frames."""
        return min(TRIALS[self.trial].frames, self.most)

    @property
    def count(self) -> int:
        """Return the number of pairs."""
        return self.frames - 1


@dataclass(frozen=True)
class Moment:
    """
    Result of one frame: errors of its pair, and of the trajectory up to it.

    dark: whether one of the pair's images is black; tracked: whether a motion was estimated;
    stood: whether that is no motion; failed: see ``pairs.FAILURE``; errors of the pair in degrees,
    NaN if there is no estimate; dark_off_deg: rotation error since the last frame that was not
    black; surprise: its NEES, expectation 3; bias_off: relative error of the gyro bias.
    """

    trial: str
    seed: int
    aid: str
    frame: int
    status: str
    dark: bool
    tracked: bool
    stood: bool
    failed: bool
    rotation_error_deg: float
    direction_error_deg: float
    dark_off_deg: float
    surprise: float
    bias_off: float


@dataclass(frozen=True)
class Row:
    """
    Summary of a trial with one aid, over all seeds.

    pairs: without those with a black image; failed: number of failed pairs, wrong: of these,
    those reported as tracked; stood: pairs estimated as no motion; errors: (mean, maximum) in
    degrees; dark_off_deg and dark_surprise: maxima over all black frames; bias_off: final errors,
    by seed.
    """

    trial: str
    aid: str
    pairs: int
    failed: int
    wrong: int
    stood: int
    rotation_deg: tuple[float, float]
    direction_deg: tuple[float, float]
    dark_off_deg: float
    dark_surprise: float
    bias_off: tuple[float, ...]


def run_trial(chunk: TrialChunk, config: EstimatorConfig) -> list[Moment]:
    """Render the frames of a trial, and process each with all aids."""
    cv2.setNumThreads(1)
    trial, scene = TRIALS[chunk.trial], make_scene(TRIALS[chunk.trial].scene, chunk.seed)
    still = replace(scene, world=World(scene.world.panels))
    poses = scene.trajectory(chunk.frames)
    felt = feel(poses, FRAME_PERIOD, Mems(), chunk.seed, scene.level)
    runs = [_Run(chunk, one, config, felt, poses) for one in trial.aids]
    moments = []
    for index, pose in enumerate(poses):
        gray = scene.render(pose, index)
        if index in trial.dark:
            gray = np.zeros_like(gray)
        moving = _moving(scene, still, pose, index) if MASK in trial.aids else None
        moments += [one.see(index, gray, scene.K, moving) for one in runs]
    return [moment for moment in moments if moment is not None]


class _Run:
    """The odometry with one aid."""

    def __init__(self, chunk: TrialChunk, which: str, config: EstimatorConfig, felt: FeltMotion,
                 poses: Array) -> None:
        self._chunk, self._aid, self._felt, self._poses = chunk, which, felt, poses
        self._gyro: Gyro | None = None
        self._samples = 0
        # The last frame that was not black.
        self._light: tuple[int, OdometryResult]
        if which == GYRO:
            self._gyro = Gyro(GyroNoise(Mems.gyro, Mems.gyro_walk))
            self._gyro.mount(felt.to_camera)
        self._odometry = VisualOdometry(config, gyro=self._gyro)

    def see(self, index: int, gray: NDArray[np.uint8], K: Array, moving: NDArray[np.bool_] | None
            ) -> Moment | None:
        """Process a frame and return its result; the first has none."""
        stamp = round(index * FRAME_PERIOD * 1e9)
        self._add_samples(stamp)
        result = self._odometry.process(Frame(
            gray, K, stamp, left_out=moving if self._aid == MASK else None))
        if result.relative is None or result.previous_stamp_ns is None:
            return None
        return self._moment(index, result, round(result.previous_stamp_ns / FRAME_PERIOD * 1e-9))

    def _add_samples(self, stamp_ns: int) -> None:
        """Pass on the samples of the gyro up to a stamp."""
        end = int(np.searchsorted(self._felt.stamps_ns, stamp_ns, 'right'))
        if self._gyro is not None:
            for number in range(self._samples, end):
                self._gyro.add(int(self._felt.stamps_ns[number]), self._felt.rates[number])
        self._samples = end

    def _moment(self, index: int, result: OdometryResult, previous: int) -> Moment:
        true_motion = np.linalg.inv(self._poses[previous]) @ self._poses[index]
        tracked = result.status in TRACKED
        rotation, direction = angle_errors(result.motion, true_motion)
        if not tracked:
            rotation = float('nan')
        if not tracked or not result.motion[:3, 3].any():
            direction = float('nan')
        black = TRIALS[self._chunk.trial].dark
        dark = index in black or previous in black
        off, surprise = self._off_since_light(index, result) if dark else (float('nan'),) * 2
        if not dark:
            self._light = index, result
        # A translation of a stationary camera is a failure, whatever its rotation.
        stands = not (np.abs(true_motion[:3, 3]) > _NO_TRANSLATION_M).any()
        invented = tracked and stands and bool(result.motion[:3, 3].any())
        return Moment(
            self._chunk.trial, self._chunk.seed, self._aid, index, result.status.value,
            dark, tracked, result.stationary,
            invented or has_failed(rotation, direction, true_motion), rotation, direction, off,
            surprise, self._bias_off())

    def _off_since_light(self, index: int, result: OdometryResult) -> tuple[float, float]:
        """Return the rotation error in deg since the last frame not black, and its NEES."""
        before, light = self._light
        estimated = result.pose[:3, :3] @ light.pose[:3, :3].T
        true = self._poses[index][:3, :3] @ self._poses[before][:3, :3].T
        # Both in the axes of the first camera, like the covariances.
        start = light.pose[:3, :3] @ self._poses[before][:3, :3].T
        off = rotation_log(start @ true @ start.T @ estimated.T)
        covariance = (result.pose_covariance - light.pose_covariance)[3:, 3:]
        return (float(np.degrees(np.linalg.norm(off))),
                float(off @ np.linalg.solve(covariance, off)))

    def _bias_off(self) -> float:
        if self._gyro is None:
            return float('nan')
        true = self._felt.rate_biases[self._samples - 1]
        return float(np.linalg.norm(self._gyro.bias - true) / np.linalg.norm(true))


def _moving(scene: Scene, still: Scene, pose: Array, index: int) -> NDArray[np.bool_]:
    """Return the pixels (H, W) of moving objects."""
    return np.asarray(scene.depth(pose, index) < still.depth(pose, index))


def trial_rows(moments: Iterable[Moment]) -> list[Row]:
    """Summarise results by trial and aid, in the order of their first."""
    groups: dict[tuple[str, str], list[Moment]] = {}
    for moment in moments:
        groups.setdefault((moment.trial, moment.aid), []).append(moment)
    return [_row(trial, which, group) for (trial, which), group in groups.items()]


def _row(trial: str, which: str, moments: Sequence[Moment]) -> Row:
    lit, dark = ([one for one in moments if one.dark is black] for black in (False, True))
    at_end = {one.seed: one.bias_off for one in moments}
    return Row(
        trial, which, len(lit), sum(one.failed for one in lit), sum(map(is_wrong, lit)),
        sum(one.stood for one in lit),
        _mean_and_largest([one.rotation_error_deg for one in lit]),
        _mean_and_largest([one.direction_error_deg for one in lit]),
        max((one.dark_off_deg for one in dark), default=float('nan')),
        max((one.surprise for one in dark), default=float('nan')),
        tuple(at_end.values()) if which == GYRO else ())


def is_wrong(moment: Moment) -> bool:
    """Return whether a pair failed, but was reported as tracked."""
    return moment.failed and moment.tracked


def _mean_and_largest(values: Sequence[float]) -> tuple[float, float]:
    known: Any = np.array(values)[np.isfinite(values)]
    return (float(known.mean()), float(known.max())) if len(known) else (float('nan'),) * 2
