"""
Errors of estimated pairs against ground truth (paper, "Evaluation metrics").

Each pair is held against the true motion between the very two frames that it relates, which are
neighbours unless a bad frame lies between them. The rules:
* rotation: angle of the rotation between truth and estimate (Rodrigues), for every pair whose
  motion was estimated (OK, NO_PARALLAX);
* translation: angle between the true and the estimated direction, for every pair with status OK
  whose true length is at least 1 cm: below that the direction of the truth is noise;
* a pair whose motion was not estimated has no error: it is counted as a failure, and so is, for
  translation, a pair called NO_PARALLAX although the camera went further than that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from djet_ros.core.geometry import direction_angle, rotation_angle
from djet_ros.core.types import Array, Status
from djet_ros.posegraph.steps import Step
import numpy as np
from numpy.typing import NDArray

_SHORTEST_LENGTH = 0.01


@dataclass(frozen=True)
class PairErrors:
    """
    Errors of N pairs in degrees, NaN where there is none by the rules of this module.

    rotation_deg, translation_deg: (N,); compared: pairs with ground truth at both ends;
    failures: how many of them have no rotation; translation_failures: how many of those whose
    true length is large enough have no direction.
    """

    rotation_deg: NDArray[np.float64]
    translation_deg: NDArray[np.float64]
    compared: int
    failures: int
    translation_failures: int


def motion_errors(status: Status, motion: Array, true_motion: Array) -> tuple[float, float]:
    """Errors of the rotation and of the direction of one motion (4, 4), in degrees, or NaN."""
    if status not in (Status.OK, Status.NO_PARALLAX):
        return float('nan'), float('nan')
    rotation, direction = angles_off(motion, true_motion)
    return rotation, direction if status is Status.OK else float('nan')


def angles_off(motion: Array, true_motion: Array) -> tuple[float, float]:
    """
    By what angles, in degrees, the rotation and the direction of a motion (4, 4) are off.

    The latter is NaN where the true motion has no direction.
    """
    rotation = float(np.degrees(rotation_angle(true_motion[:3, :3], motion[:3, :3])))
    direction = float(np.degrees(direction_angle(true_motion[:3, 3], motion[:3, 3])))
    return rotation, direction if has_direction(true_motion) else float('nan')


def has_direction(true_motion: Array) -> bool:
    """Tell whether a true motion (4, 4) goes far enough for its direction to mean something."""
    return bool(np.linalg.norm(true_motion[:3, 3]) >= _SHORTEST_LENGTH)


def pair_errors(pairs: Sequence[Step], previous_truth: Array, truth: Array) -> PairErrors:
    """Compare N pairs with the true poses (N, 4, 4) at their two ends, NaN where not known."""
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
    """Mean, median, 95th percentile and maximum of the errors there are; None without any."""
    known = errors[np.isfinite(errors)]
    if not known.size:
        return None
    return {'mean': float(known.mean()), 'median': float(np.median(known)),
            'p95': float(np.percentile(known, 95)), 'max': float(known.max())}
