"""Rows of a results table from the records of pairs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from djet_ros.lab.pairs import PairRecord
import numpy as np


@dataclass(frozen=True)
class TableRow:
    """
    One method on one sequence: errors in degrees, Hamming distances in bits.

    Means, medians and 95th percentiles are over the pairs whose error is known; failures (see
    pairs.FAILURE) are counted over all pairs. NaN where nothing is known.
    """

    sequence: str
    method: str
    preset: str
    change: str
    pairs: int
    failures: int
    rotation_mean_deg: float
    rotation_median_deg: float
    rotation_p95_deg: float
    translation_mean_deg: float
    translation_median_deg: float
    translation_p95_deg: float
    hamming_mean: float
    ms_per_pair: float


def table_rows(records: Iterable[PairRecord]) -> list[TableRow]:
    """Summarise records by sequence, preset, change and method, in the order of their first."""
    groups: dict[tuple[str, ...], list[PairRecord]] = {}
    for record in records:
        key = (record.sequence, record.preset, record.change, record.method)
        groups.setdefault(key, []).append(record)
    return [_row(group) for group in groups.values()]


def _row(records: Sequence[PairRecord]) -> TableRow:
    first = records[0]
    return TableRow(
        first.sequence, first.method, first.preset, first.change, len(records),
        sum(record.failed for record in records),
        *_spread([record.rotation_error_deg for record in records]),
        *_spread([record.translation_error_deg for record in records]),
        _mean([record.hamming_mean for record in records]),
        _mean([record.milliseconds for record in records]))


def _spread(values: list[float]) -> tuple[float, float, float]:
    """Mean, median and 95th percentile of the known values."""
    known = _known(values)
    if not len(known):
        return float('nan'), float('nan'), float('nan')
    return float(known.mean()), float(np.median(known)), float(np.percentile(known, 95))


def _mean(values: list[float]) -> float:
    known = _known(values)
    return float(known.mean()) if len(known) else float('nan')


def _known(values: list[float]) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    array = np.array(values, dtype=np.float64)
    return array[np.isfinite(array)]
