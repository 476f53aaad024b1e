"""
What a gyro and a mask are good for: rendered scenes with and without them, held against the truth.

Each trial is a way through a scene that cameras alone have trouble with, or none; all aids of a
trial see the same pictures. The gyro has the errors of a MEMS in a telephone, and its bias is not
known at the start. The mask is exact: what moves by itself is left out.
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
from djet_ros.odometry.visual_odometry import OdometryResult, VisualOdometry
from djet_ros.replay.pair_errors import angles_off
import numpy as np
from numpy.typing import NDArray

# Metres that are none.
_NOWHERE = 1e-9

NOTHING, GYRO, MASK = 'nothing', 'gyro', 'mask'


@dataclass(frozen=True)
class Trial:
    """A way through a scene: how many frames, which of them are black, and what is at hand."""

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
    """A trial in one place, up to a number of frames."""

    trial: str
    seed: int
    most: int

    @property
    def name(self) -> str:
        """Name that is the same in every run."""
        return f'{self.trial}:{self.seed}'

    @property
    def frames(self) -> int:
        """How many frames there are."""
        return min(TRIALS[self.trial].frames, self.most)

    @property
    def count(self) -> int:
        """How many frames have a pair."""
        return self.frames - 1


@dataclass(frozen=True)
class Moment:
    """
    What became of a frame, by its pair and by all of the way to it.

    dark: whether it or what it is related to is black; tracked: whether a motion was told; stood:
    whether that was none;
    failed: see ``pairs.FAILURE``; errors of the pair in degrees, NaN where there is none;
    dark_off_deg: of the turn in the dark up to a black frame; surprise: its square over its
    covariance, 3 on average if that is true; bias_off: of the gyro's bias, as a share of it.
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
    A trial with one aid, all seeds together.

    pairs: not counting those with a black image; failed: how many of them, wrong: how many of
    these were told as if they were right; stood: pairs that were told as no motion; errors: mean
    and largest in degrees; dark_off_deg and dark_surprise: the largest of all black frames;
    bias_off: at the end, by seed.
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
    """Render the frames of a trial one by one, and show each to all aids."""
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
    """An odometry with one aid."""

    def __init__(self, chunk: TrialChunk, which: str, config: EstimatorConfig, felt: FeltMotion,
                 poses: Array) -> None:
        self._chunk, self._aid, self._felt, self._poses = chunk, which, felt, poses
        self._gyro: Gyro | None = None
        self._heard = 0
        # The newest frame that was not black.
        self._light: tuple[int, OdometryResult]
        if which == GYRO:
            self._gyro = Gyro(GyroNoise(Mems.gyro, Mems.gyro_walk))
            self._gyro.mount(felt.to_camera)
        self._odometry = VisualOdometry(config, gyro=self._gyro)

    def see(self, index: int, gray: NDArray[np.uint8], K: Array, moving: NDArray[np.bool_] | None
            ) -> Moment | None:
        """Take a frame; the first has no pair."""
        stamp = round(index * FRAME_PERIOD * 1e9)
        self._listen(stamp)
        result = self._odometry.process(Frame(
            gray, K, stamp, left_out=moving if self._aid == MASK else None))
        if result.relative is None or result.previous_stamp_ns is None:
            return None
        return self._moment(index, result, round(result.previous_stamp_ns / FRAME_PERIOD * 1e-9))

    def _listen(self, stamp_ns: int) -> None:
        """Hear the gyro up to a stamp."""
        end = int(np.searchsorted(self._felt.stamps_ns, stamp_ns, 'right'))
        if self._gyro is not None:
            for number in range(self._heard, end):
                self._gyro.add(int(self._felt.stamps_ns[number]), self._felt.rates[number])
        self._heard = end

    def _moment(self, index: int, result: OdometryResult, previous: int) -> Moment:
        true_motion = np.linalg.inv(self._poses[previous]) @ self._poses[index]
        tracked = result.status in TRACKED
        rotation, direction = angles_off(result.motion, true_motion)
        if not tracked:
            rotation = float('nan')
        if not tracked or not result.motion[:3, 3].any():
            direction = float('nan')
        black = TRIALS[self._chunk.trial].dark
        dark = index in black or previous in black
        off, surprise = self._off_since_light(index, result) if dark else (float('nan'),) * 2
        if not dark:
            self._light = index, result
        # A way that was told where there was none is wrong, whatever its rotation.
        stands = not (np.abs(true_motion[:3, 3]) > _NOWHERE).any()
        invented = tracked and stands and bool(result.motion[:3, 3].any())
        return Moment(
            self._chunk.trial, self._chunk.seed, self._aid, index, result.status.value,
            dark, tracked, result.stationary,
            invented or has_failed(rotation, direction, true_motion), rotation, direction, off,
            surprise, self._bias_off())

    def _off_since_light(self, index: int, result: OdometryResult) -> tuple[float, float]:
        """Give the error in degrees of the turn since it was light, and its surprise."""
        before, light = self._light
        told = result.pose[:3, :3] @ light.pose[:3, :3].T
        true = self._poses[index][:3, :3] @ self._poses[before][:3, :3].T
        # Both along the axes of the first camera, as the covariances are.
        start = light.pose[:3, :3] @ self._poses[before][:3, :3].T
        off = rotation_log(start @ true @ start.T @ told.T)
        covariance = (result.pose_covariance - light.pose_covariance)[3:, 3:]
        return (float(np.degrees(np.linalg.norm(off))),
                float(off @ np.linalg.solve(covariance, off)))

    def _bias_off(self) -> float:
        if self._gyro is None:
            return float('nan')
        true = self._felt.rate_biases[self._heard - 1]
        return float(np.linalg.norm(self._gyro.bias - true) / np.linalg.norm(true))


def _moving(scene: Scene, still: Scene, pose: Array, index: int) -> NDArray[np.bool_]:
    """(H, W) bool, where something is seen that moves by itself."""
    return np.asarray(scene.depth(pose, index) < still.depth(pose, index))


def trial_rows(moments: Iterable[Moment]) -> list[Row]:
    """Sum up moments by trial and aid, in the order of their first."""
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
    """Tell whether a pair failed, and was told as if it had not."""
    return moment.failed and moment.tracked


def _mean_and_largest(values: Sequence[float]) -> tuple[float, float]:
    known: Any = np.array(values)[np.isfinite(values)]
    return (float(known.mean()), float(known.max())) if len(known) else (float('nan'),) * 2
