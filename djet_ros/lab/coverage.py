"""
Calibration of the covariances of poses: coverage of their ellipsoids, and NEES.

With the error e of rotation and translation direction and its covariance C, e^T C^-1 e has a
chi-squared distribution of five degrees of freedom if C is correct (normalised estimation error
squared, NEES; Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and
Navigation, section 5.4). So a share q of all poses must be inside the ellipsoid of probability q.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
import sys

import cv2
from djet_ros.core.covariance import signed_differences
from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.geometry import unit
from djet_ros.core.types import Array, RelativePose, Status, TRACKED
from djet_ros.lab.pairs import GROSS_ROTATION, has_failed, PairChunk
from djet_ros.lab.runner import chunks_of
from djet_ros.lab.scenes.sequence import rendered_scene
from djet_ros.lab.sequences import Dataset, opened, plain_name
from djet_ros.odometry.result import camera_motion
from djet_ros.odometry.visual_odometry import VisualOdometry
from djet_ros.replay.pair_errors import angle_errors
import numpy as np
from scipy.stats import beta, chi2

# Probabilities of the ellipsoids.
LEVELS = (0.5, 0.9, 0.95, 0.99, 0.999)

# Standard deviations of rotation and translation direction in degrees, below which a failed pair
# is overconfident.
SURE_ROTATION, SURE_DIRECTION = 0.3, 3.0

# How pairs are started: each by itself, or in the odometry, with the previous motion as prior.
ALONE, IN_A_ROW = 'alone', 'in a row'

# Independent pairs that are estimated together.
_PAIRS_PER_CHUNK = 20


@dataclass(frozen=True)
class Coverage:
    """
    Errors and standard deviations of one pair of frames.

    scene: without its seed; start: ALONE or IN_A_ROW; previous, current: indices of the frames;
    errors and standard deviations ('claim') in degrees, NaN if there is none; square: e^T C^-1 e;
    failed: see ``pairs.FAILURE``, of the best estimate if no pose was accepted; stood: whether the
    camera did not translate at all.
    """

    scene: str
    sequence: str
    start: str
    previous: int
    current: int
    status: str
    failed: bool
    rotation_error_deg: float
    direction_error_deg: float
    rotation_claim_deg: float
    direction_claim_deg: float
    square: float
    matches: int
    inliers: int
    stood: bool = False

    @property
    def has_nees(self) -> bool:
        """Return whether rotation and direction were estimated and compared with the truth."""
        return self.status == Status.OK.value and bool(np.isfinite(self.square))

    @property
    def tracked(self) -> bool:
        """Return whether a motion was accepted."""
        return self.status in (s.value for s in TRACKED)

    @property
    def wrong_rotation(self) -> bool:
        """Return whether a pair was tracked whose rotation failed, and alone can be compared."""
        return (self.tracked and not self.has_nees
                and not self.rotation_error_deg <= GROSS_ROTATION)

    @property
    def missed_direction(self) -> bool:
        """Return whether the pair was tracked without a direction, although the camera moved."""
        return self.tracked and not self.has_nees and self.failed and not self.wrong_rotation

    @property
    def invented(self) -> bool:
        """Return whether the pose has a direction of motion, although the camera had none."""
        return (self.stood and self.status == Status.OK.value
                and self.direction_claim_deg < SURE_DIRECTION)

    @property
    def overconfident(self) -> bool:
        """Return whether the pose failed with small standard deviations."""
        wrong = self.has_nees and self.failed and self.direction_claim_deg < SURE_DIRECTION
        return ((wrong or self.invented or self.wrong_rotation)
                and self.rotation_claim_deg < SURE_ROTATION)

    @property
    def rejected_correct(self) -> bool:
        """
        Return whether no pose was accepted, although the best estimate was correct.

        That of a camera that does not translate has no direction to be correct in.
        """
        return not (self.tracked or self.failed or self.stood)


@dataclass(frozen=True)
class CoverageRow:
    """
    Summary of the pairs of one scene and start.

    told: pairs with a NEES; failed, wrong_and_sure: failed and overconfident ones among these, the
    ``Coverage.invented`` and those of ``wrong_rotation``; untold: tracked without a direction, see
    ``Coverage.missed_direction``; given_up: without a pose, needlessly: of these, with a correct
    best estimate; median: of the NEES, over the median of its distribution; inside: by LEVELS, the
    share of these pairs inside the ellipsoid, with its 95 % confidence interval (Clopper and
    Pearson, Biometrika 1934). Each failed pair is counted in one of failed, untold and given_up.
    """

    scene: str
    start: str
    pairs: int
    told: int
    failed: int
    untold: int
    given_up: int
    needlessly: int
    wrong_and_sure: int
    median: float
    inside: tuple[tuple[float, float, float], ...]


@dataclass(frozen=True)
class StartedChunk(PairChunk):
    """Pairs of a dataset that are started in the same way: ALONE or IN_A_ROW."""

    start: str

    @property
    def name(self) -> str:
        """Return a name that is the same in every run."""
        return f'{super().name}, {self.start}'


def started_chunks(datasets: Sequence[Dataset]) -> list[StartedChunk]:
    """
    Return all pairs to estimate, in chunks.

    In a row each sequence is a whole, as it is for the odometry: begun anew in the middle, with a
    lorry in view that was seen coming, it would know less than the odometry does there.
    """
    return [StartedChunk(chunk.dataset, chunk.first, chunk.count, start)
            for start, most in ((ALONE, _PAIRS_PER_CHUNK), (IN_A_ROW, sys.maxsize))
            for chunk in chunks_of(datasets, most)]


def cover_chunk(chunk: StartedChunk, config: EstimatorConfig) -> list[Coverage]:
    """Estimate the pairs of a chunk each by itself, or in sequence with the odometry."""
    cv2.setNumThreads(1)
    return list(_alone(chunk, config) if chunk.start == ALONE
                else _in_a_row(chunk.dataset, config))


def _alone(chunk: PairChunk, config: EstimatorConfig) -> Iterator[Coverage]:
    sequence, frames = opened(chunk.dataset), chunk.dataset.frames
    estimator = TwoViewEstimator(config)
    previous = None
    for pair in range(chunk.first, chunk.first + chunk.count):
        previous = previous or sequence.frame(frames[pair]).view(estimator)
        current = sequence.frame(frames[pair + 1]).view(estimator)
        pose = estimator.estimate(previous, current)
        yield from _covered(chunk.dataset, ALONE, frames[pair], frames[pair + 1], pose)
        previous = current


def _in_a_row(dataset: Dataset, config: EstimatorConfig) -> Iterator[Coverage]:
    sequence = opened(dataset)
    odometry, stamps = VisualOdometry(config), sequence.stamps_ns
    for current in dataset.frames:
        result = odometry.process(sequence.frame(current))
        if result.relative and result.previous_stamp_ns is not None:
            previous = int(np.searchsorted(stamps, result.previous_stamp_ns))
            pair = result.relative
            if result.stationary:
                pair = replace(pair, status=result.status, R=np.eye(3), t=np.zeros(3))
            yield from _covered(dataset, IN_A_ROW, previous, current, pair)


def _covered(dataset: Dataset, start: str, previous: int, current: int,
             pose: RelativePose) -> Iterator[Coverage]:
    """Yield the record of a pose, if there is ground truth."""
    poses = opened(dataset).poses
    assert poses is not None  # datasets without poses are refused at the start
    true_motion = np.linalg.inv(poses[previous]) @ poses[current]
    if not np.isfinite(true_motion).all():
        return
    rotation, direction = angle_errors(camera_motion(pose), true_motion)
    if not len(pose.x):
        rotation = float('nan')
    if not pose.t.any():
        direction = float('nan')
    claims = np.degrees(np.sqrt([np.trace(pose.covariance_5[:3, :3]),
                                 np.trace(pose.covariance_5[3:, 3:])]))
    yield Coverage(
        _scene(dataset), dataset.name, start, previous, current,
        pose.status.value, has_failed(rotation, direction, true_motion), rotation, direction,
        float(claims[0]), float(claims[1]),
        normalised_square(pose, true_motion) if np.isfinite(direction) else float('nan'),
        len(pose.x), int(pose.inliers.sum()), bool(np.allclose(true_motion[:3, 3], 0)))


def _scene(dataset: Dataset) -> str:
    """Return the scene; recorded ones are marked, to distinguish them from rendered ones."""
    return rendered_scene(dataset.folder) or f'{plain_name(dataset.folder)} (recorded)'


def normalised_square(pose: RelativePose, true_motion: Array) -> float:
    """
    Return the NEES of a pose with its covariance (5, 5); its expectation is 5.

    true_motion: (4, 4) pose of the current camera in the previous one.
    """
    R = true_motion[:3, :3].T
    t = unit(-R @ true_motion[:3, 3])
    error = signed_differences(pose.R, pose.t, R, t)
    return float(error @ np.linalg.solve(pose.covariance_5, error))


def coverage_rows(records: Iterable[Coverage]) -> list[CoverageRow]:
    """Summarise records by scene and start, in the order of their first."""
    groups: dict[tuple[str, str], list[Coverage]] = {}
    for record in records:
        groups.setdefault((record.scene, record.start), []).append(record)
    return [_row(scene, start, group) for (scene, start), group in groups.items()]


def _row(scene: str, start: str, records: Sequence[Coverage]) -> CoverageRow:
    squares = np.array([record.square for record in records if record.has_nees])
    return CoverageRow(
        scene, start, len(records), len(squares),
        sum((record.failed and record.has_nees) or record.invented or record.wrong_rotation
            for record in records),
        sum(record.missed_direction for record in records),
        sum(not record.tracked for record in records),
        sum(record.rejected_correct for record in records),
        sum(record.overconfident for record in records),
        float(np.median(squares) / chi2.median(5)) if len(squares) else float('nan'),
        tuple(share_with_bounds(int((squares <= chi2.ppf(level, 5)).sum()), len(squares))
              for level in LEVELS))


def share_with_bounds(hits: int, tries: int) -> tuple[float, float, float]:
    """Return the share of hits with its 95 % confidence interval, all NaN without a try."""
    if not tries:
        return (float('nan'),) * 3
    tail = 0.025
    return (hits / tries,
            float(beta.ppf(tail, hits, tries - hits + 1)) if hits else 0.0,
            float(beta.ppf(1 - tail, hits + 1, tries - hits)) if hits < tries else 1.0)


def draw_reliability(records: Sequence[Coverage], path: Path) -> None:
    """
    Plot the share of poses inside their ellipsoids against its probability, by scene.

    On the right the share outside, with logarithmic axes, for the tails: outliers break back ends.
    """
    from djet_ros.lab.style import figure
    from matplotlib import colormaps
    scenes = list(dict.fromkeys(record.scene for record in records))
    with figure(path, 9.0, 4.0) as empty:
        left, right = empty.subplots(1, 2)
        for index, scene in enumerate(scenes):
            squares = np.sort([r.square for r in records if r.scene == scene and r.has_nees])
            if not len(squares):
                continue
            claimed, observed = chi2.cdf(squares, 5), np.arange(1, len(squares) + 1) / len(squares)
            style = {'label': f'{scene} ({len(squares)})', 'color': colormaps['tab20'](index % 20)}
            left.step(claimed, observed, where='post', **style)
            right.step(np.maximum(chi2.sf(squares, 5), 1e-6), 1 - observed + 1 / len(squares),
                       **style)
        left.plot([0, 1], [0, 1], 'k:', lw=1)
        right.plot([1e-6, 1], [1e-6, 1], 'k:', lw=1)
        left.set(xlabel='probability of the ellipsoid', ylabel='share of poses inside',
                 xlim=(0, 1), ylim=(0, 1))
        right.set(xlabel='probability of an error outside', xscale='log', yscale='log',
                  ylabel='share of poses', xlim=(1e-6, 1), ylim=(1e-4, 1))
        # In the corner that calibrated covariances leave empty; without a pose there is no curve.
        if any(record.has_nees for record in records):
            left.legend(fontsize=6, loc='lower right')
