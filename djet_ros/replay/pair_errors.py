"""
Errors of estimated pairs against ground truth (paper, "Evaluation metrics").

Each pair is compared with the true motion between its two frames, which are consecutive unless
failed frames lie between them:
* rotation: angle of the rotation between truth and estimate, for every pair with an estimated
  motion (OK, NO_PARALLAX);
* translation: angle between the true and the estimated direction, for every pair with status OK
  and a true length of at least 1 cm, below which the true direction is noise;
* a pair without an estimated motion has no error and counts as a failure; a NO_PARALLAX pair with
  a true length of at least 1 cm counts as a failure of the translation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from djet_ros.core.geometry import direction_angle, rotation_angle
from djet_ros.core.types import Array, Status
from djet_ros.posegraph.steps import Step
import numpy as np
from numpy.typing import NDArray

# Shortest true translation, in metres, whose direction is compared.
_MIN_LENGTH = 0.01


@dataclass(frozen=True)
class PairErrors:
    """
    Errors of N pairs in degrees, NaN for pairs without an error by the rules of this module.

    rotation_deg, translation_deg: (N,); compared: number of pairs with ground truth at both ends;
    failures: those of them without a rotation; translation_failures: those of them with a
    sufficient true length and no estimated direction.
    """

    rotation_deg: NDArray[np.float64]
    translation_deg: NDArray[np.float64]
    compared: int
    failures: int
    translation_failures: int


def motion_errors(status: Status, motion: Array, true_motion: Array) -> tuple[float, float]:
    """Return the errors of rotation and direction of a motion (4, 4) in degrees, or NaN."""
    if status not in (Status.OK, Status.NO_PARALLAX):
        return float('nan'), float('nan')
    rotation, direction = angle_errors(motion, true_motion)
    return rotation, direction if status is Status.OK else float('nan')


def angle_errors(motion: Array, true_motion: Array) -> tuple[float, float]:
    """
    Return the angular errors of rotation and direction of a motion (4, 4), in degrees.

    The latter is NaN if the true motion is too short to have a direction.
    """
    rotation = float(np.degrees(rotation_angle(true_motion[:3, :3], motion[:3, :3])))
    direction = float(np.degrees(direction_angle(true_motion[:3, 3], motion[:3, 3])))
    return rotation, direction if has_direction(true_motion) else float('nan')


def has_direction(true_motion: Array) -> bool:
    """Return whether a true motion (4, 4) is long enough for its direction to be compared."""
    return bool(np.linalg.norm(true_motion[:3, 3]) >= _MIN_LENGTH)


def pair_errors(pairs: Sequence[Step], previous_truth: Array, truth: Array) -> PairErrors:
    """Compare N pairs with the true poses (N, 4, 4) at their two ends, NaN if unknown."""
    rotation, translation = np.full((2, len(pairs)), np.nan)
    compared = failures = translation_failures = 0
    for i, (pair, start, end) in enumerate(zip(pairs, previous_truth, truth, strict=True)):
        if not (np.isfinite(start).all() and np.isfinite(end).all()):
            continue
        compared += 1
        true_motion = np.linalg.inv(start) @ end
        rotation[i], translation[i] = motion_errors(pair.status, pair.motion, true_motion)
        failures += int(np.isnan(rotation[i]))
        translation_failures += int(np.isnan(translation[i]) and has_direction(true_motion))
    return PairErrors(rotation, translation, compared, failures, translation_failures)


def statistics(errors: NDArray[np.float64]) -> dict[str, float] | None:
    """Return mean, median, 95th percentile and maximum of the finite errors; None without any."""
    known = errors[np.isfinite(errors)]
    if not known.size:
        return None
    return {'mean': float(known.mean()), 'median': float(np.median(known)),
            'p95': float(np.percentile(known, 95)), 'max': float(known.max())}
