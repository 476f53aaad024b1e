"""Summary of the records of pairs to rows of a table."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
import math

from djet_ros.core.types import Array
from djet_ros.lab.integration import StampedTrajectory
from djet_ros.lab.pairs import PairRecord
from djet_ros.replay.drift import drift
from djet_ros.replay.pair_errors import statistics
import numpy as np


@dataclass(frozen=True)
class TableRow:
    """
    Summary of one method on one sequence: errors in degrees, Hamming distances in bits.

    Means, medians and 95th percentiles are over the pairs with an estimate and ground truth, whose
    number is in the ``told`` fields; failures (see pairs.FAILURE) are counted over all pairs. NaN
    if there is no such pair.
    """

    sequence: str
    method: str
    preset: str
    change: str
    pairs: int
    failures: int
    rotation_told: int
    rotation_mean_deg: float
    rotation_median_deg: float
    rotation_p95_deg: float
    translation_told: int
    translation_mean_deg: float
    translation_median_deg: float
    translation_p95_deg: float
    hamming_mean: float
    ms_per_pair: float


@dataclass(frozen=True)
class DriftRow:
    """
    Drift of the trajectory integrated from the pairs of one method; see ``replay.drift.Drift``.

    Step lengths are those of the ground truth: translation_percent depends on directions and
    rotations only.
    """

    sequence: str
    method: str
    preset: str
    translation_percent: float
    rotation_deg_per_100m: float
    segments: int
    longest: int


def table_rows(records: Iterable[PairRecord]) -> list[TableRow]:
    """Summarise records by sequence, preset, change and method, in the order of their first."""
    groups: dict[tuple[str, ...], list[PairRecord]] = {}
    for record in records:
        key = (record.sequence, record.preset, record.change, record.method)
        groups.setdefault(key, []).append(record)
    return [_row(group) for group in groups.values()]


def _row(records: Sequence[PairRecord]) -> TableRow:
    first = records[0]
    rotation, translation, hamming, ms = (
        spread_of([getattr(record, name) for record in records])
        for name in ('rotation_error_deg', 'translation_error_deg', 'hamming_mean',
                     'milliseconds'))
    return TableRow(
        first.sequence, first.method, first.preset, first.change, len(records),
        sum(record.failed for record in records),
        _count_finite(records, 'rotation_error_deg'),
        rotation['mean'], rotation['median'], rotation['p95'],
        _count_finite(records, 'translation_error_deg'),
        translation['mean'], translation['median'], translation['p95'],
        hamming['mean'], ms['mean'])


def _count_finite(records: Iterable[PairRecord], name: str) -> int:
    return sum(math.isfinite(getattr(record, name)) for record in records)


def common_errors(records: Sequence[PairRecord], others: Sequence[PairRecord]) -> dict[str, Array]:
    """
    Return the errors (N, 2) of records and others, in degrees, on the pairs that both estimated.

    By 'rotation' and 'direction', each in the order of records.
    """
    at = {(other.sequence, other.pair): other for other in others}
    paired = [(record, at[record.sequence, record.pair]) for record in records
              if (record.sequence, record.pair) in at]
    found = {}
    for what, name in (('rotation', 'rotation_error_deg'), ('direction', 'translation_error_deg')):
        errors = np.array([[getattr(one, name) for one in both] for both in paired],
                          float).reshape(-1, 2)
        found[what] = errors[np.isfinite(errors).all(axis=1)]
    return found


def drift_row(sequence: str, method: str, preset: str, truth: StampedTrajectory,
              estimate: StampedTrajectory) -> DriftRow | None:
    """Return the drift of a trajectory, or None if the true one is not over 100 m long."""
    found = drift(truth.poses, estimate.poses)
    return DriftRow(sequence, method, preset, **asdict(found)) if found else None


def spread_of(values: Sequence[float]) -> dict[str, float]:
    """Return statistics of the finite values, NaN if there are none."""
    return statistics(np.array(values)) or dict.fromkeys(('mean', 'median', 'p95'), float('nan'))
