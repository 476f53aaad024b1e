"""The steps of a replay: warnings, errors against ground truth, and the plot."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path

from djet_ros.core.types import Array, Status
from djet_ros.odometry.messages import seconds_text
from djet_ros.odometry.scale import Scale
from djet_ros.posegraph.steps import scale_of, Step
from djet_ros.replay.alignment import aligned, position_rmse
from djet_ros.replay.drift import drift, path_length, path_scale, scale_change
from djet_ros.replay.pair_errors import pair_errors, PairErrors
from djet_ros.replay.results import plot_trajectory
import numpy as np
from numpy.typing import NDArray

# Advice if no pair was tracked, by the most frequent status: too few matches, or another.
_FEW_MATCHES_ADVICE = (
    'the images are dark, without texture or blurred, or do not overlap; check the exposure, for '
    '16-bit images odometry.gray_range, and the frame rate')
_NO_MOTION_ADVICE = (
    'no single motion explains the matches; check that the calibration belongs to the images '
    '(--info-topic, odometry.rectified), and mask moving objects (odometry.mask_file)')

# Minimum number of positions for an alignment: fewer fit any others.
_MIN_POSITIONS = 4


@dataclass
class StepLog:
    """The steps of a run: their warnings, errors against ground truth, and plot."""

    steps: list[Step] = field(default_factory=list)

    @property
    def scale(self) -> Scale:
        """Return the kind of scale of all lengths."""
        return scale_of(self.steps)

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """Return the stamps (N,) of all steps."""
        return np.array([step.stamp_ns for step in self.steps], np.int64)

    def pairs(self) -> list[Step]:
        """Return the steps with a reference frame, tracked or not."""
        return [step for step in self.steps if step.previous_stamp_ns is not None]

    def jumps(self) -> list[tuple[int, int]]:
        """Return the pairs of stamps at time jumps, backwards or over a gap."""
        return [(before.stamp_ns, after.stamp_ns) for before, after in pairwise(self.steps)
                if after.status is Status.TIME_JUMP]

    def advice(self, why_few: str = '') -> list[str]:
        """
        Return warnings on gaps, on pairs that were not tracked, and on mixed units.

        why_few: why there are few matches, if it is known.
        """
        return [*self._of_gaps(), *self._of_pairs(why_few or _FEW_MATCHES_ADVICE),
                *self._of_units()]

    def _of_gaps(self) -> list[str]:
        """Return a warning if gaps between images exceed odometry.max_gap."""
        gaps = [(after - before, after) for before, after in self.jumps() if after > before]
        if not gaps or not self.pairs():
            return []
        longest, after = max(gaps)
        return [f'{len(gaps)} gaps between images exceed odometry.max_gap; the longest, '
                f'{longest * 1e-9:.3f} s, ends at stamp {seconds_text(after)}; the trajectory '
                'continues at the last pose, without the motion in the gap']

    def _of_pairs(self, why_few: str) -> list[str]:
        """Return a warning if there is no pair, none was tracked, or none has a translation."""
        pairs = self.pairs()
        statuses = Counter(step.status for step in pairs)
        if len(self.steps) == 1:
            return ['only one image was used, so no motion was estimated: that takes two images']
        if not pairs:
            return [] if not self.jumps() else [
                f'none of {len(self.steps)} images could be paired with the one before: the time '
                'between them exceeds odometry.max_gap; set it to a larger value']
        if statuses[Status.NO_PARALLAX] == len(pairs):
            return [f'all {len(pairs)} pairs have no parallax (NO_PARALLAX): the camera was '
                    'stationary or only rotated, so there are rotations and no translations']
        if any(step.tracked for step in pairs):
            return []
        most = statuses.most_common(1)[0][0]
        advice = why_few if most is Status.TOO_FEW_MATCHES else _NO_MOTION_ADVICE
        return [f'none of {len(pairs)} pairs could be tracked (mostly {most.value}): {advice}']

    def _of_units(self) -> list[str]:
        """Return a warning if metric lengths follow relative ones, as when a source is late."""
        steps = [step for step in self.steps if step.status is Status.OK and step.scale_known]
        first = next((i for i, step in enumerate(steps) if step.metric), 0)
        return [] if not first else [
            f'the trajectory mixes units: its first {first} lengths are relative, those from '
            f'stamp {seconds_text(steps[first].stamp_ns)} on are metric; start the source of '
            'odometry.scale before the images, or use only the part after that stamp']

    def errors(self, truth: Array) -> PairErrors:
        """Return the errors of all pairs, of which there are some; truth: (N, 4, 4) true poses."""
        pairs = self.pairs()
        at: dict[int | None, int] = {step.stamp_ns: i for i, step in enumerate(self.steps)}
        ends = np.array([(at[p.previous_stamp_ns], at[p.stamp_ns]) for p in pairs])
        return pair_errors(pairs, truth[ends[:, 0]], truth[ends[:, 1]])

    def drift(self, truth: Array) -> dict[str, float | None] | None:
        """
        Return the drift over the frames with a true pose (N, 4, 4), or None for a short path.

        With an unknown scale only the drift of the rotation is given. A relative scale is
        multiplied by the ratio of the spreads of both paths.
        """
        known = np.isfinite(truth).all(axis=(1, 2))
        if not known.any():
            return None
        poses = np.array([step.pose for step in self.steps])[known]
        if self.scale is Scale.RELATIVE:
            poses[:, :3, 3] *= path_scale(poses[:, :3, 3], truth[known][:, :3, 3])
        found = drift(truth[known], poses)
        if found is None or not any(step.tracked for step in self.steps):
            return None
        if self.scale is Scale.UNKNOWN:
            return {**asdict(found), 'translation_percent': None}
        return asdict(found)

    def positions(self, truth: Array) -> dict[str, float | None] | None:
        """
        Return the position RMSE and the length of the true path in metres, and the scale change.

        The RMSE is after alignment with the true poses (N, 4, 4), including the scale unless it is
        metric. The scale change is that at the end over that at the start, or None if it cannot be
        determined. None if the scale is unknown or nothing was tracked.
        """
        known = np.isfinite(truth).all(axis=(1, 2))
        if not any(step.tracked for step in self.steps):
            return None
        if self.scale is Scale.UNKNOWN or known.sum() < _MIN_POSITIONS:
            return None
        way = truth[known, :3, 3]
        places = np.array([step.pose[:3, 3] for step in self.steps])[known]
        change = scale_change(places, way)
        return {'rmse_m': position_rmse(aligned(places, way, self.scale is Scale.METRIC), way),
                'way_m': path_length(way), 'scale_change': change if np.isfinite(change) else None}

    def plot(self, path: Path, truth: Array, landmarks: NDArray[np.float32], title: str) -> None:
        """
        Plot the trajectory; an unknown scale is taken from the true poses (N, 4, 4).

        landmarks: (M, 2) x and z, in the lengths of the estimate.
        """
        unit, factor = 'm', 1.0
        estimate = np.array([step.pose for step in self.steps])
        known = np.flatnonzero(np.isfinite(truth).all(axis=(1, 2)))
        if self.scale is Scale.UNKNOWN and known.size:
            estimate = self._with_true_lengths(truth)
            title += '\n(step lengths from ground truth)'
        elif self.scale is Scale.UNKNOWN:
            unit = 'steps of unit length'
        elif self.scale is Scale.RELATIVE and known.size:
            factor = path_scale(estimate[known, :3, 3], truth[known, :3, 3])
            estimate[:, :3, 3] *= factor
            title += '\n(common scale from ground truth)'
        elif self.scale is Scale.RELATIVE:
            unit = 'lengths of the first step'
        # The two coincide at the first pose of the ground truth.
        positions = (estimate[known[0]] @ np.linalg.inv(truth[known[0]]) @ truth)[:, :3, 3] \
            if known.size else None
        plot_trajectory(path, estimate[:, :3, 3], positions,
                        np.asarray(factor * landmarks, np.float32), title, unit)

    def _with_true_lengths(self, truth: Array) -> Array:
        """Return the estimated poses (N, 4, 4) with the true length of each step, if known."""
        poses: list[Array] = []
        at: dict[int | None, int] = {}
        for i, step in enumerate(self.steps):
            pose = poses[-1] if poses else np.eye(4)
            if step.tracked:
                previous = at[step.previous_stamp_ns]
                true = float(np.linalg.norm(truth[i, :3, 3] - truth[previous, :3, 3]))
                length = float(np.linalg.norm(step.motion[:3, 3]))
                motion = step.motion.copy()
                if length > 0 and np.isfinite(true):
                    motion[:3, 3] *= true / length
                pose = poses[previous] @ motion
            poses.append(pose)
            at[step.stamp_ns] = i
        return np.array(poses)
