"""Medians and quantiles of residuals: on small arrays several times as fast as those of NumPy."""

from __future__ import annotations

from djet_ros.core.types import Array
import numpy as np
from numpy.typing import NDArray


def median(values: Array) -> float:
    """Return the median of (N,) values, three times as fast as ``np.median``."""
    return float(medians(values))


def medians(values: Array) -> Array:
    """Return the median of each of (..., N) values, (...,)."""
    half, is_odd = divmod(values.shape[-1], 2)
    ordered = np.partition(values, half if is_odd else (half - 1, half))
    return np.asarray(
        ordered[..., half] if is_odd else (ordered[..., half - 1] + ordered[..., half]) / 2)


def medians_of_parts(values: Array, counts: NDArray[np.int64]) -> Array:
    """Return the medians (P,) of consecutive parts of (N,) values, with `counts` >= 1 of each."""
    ordered = values[np.lexsort((values, np.repeat(np.arange(len(counts)), counts)))]
    first = np.cumsum(counts) - counts
    return np.asarray((ordered[first + (counts - 1) // 2] + ordered[first + counts // 2]) / 2)


def weighted_median(values: Array, weights: Array) -> float:
    """Return the weighted median of (N,) values."""
    order = np.argsort(values, kind='stable')
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, total[-1] / 2)])


def quantile(values: Array, share: float) -> float:
    """Return a quantile of (N,) values, as `np.quantile` does, three times as fast."""
    place = share * (len(values) - 1)
    below, above = int(place), min(int(place) + 1, len(values) - 1)
    ordered = np.partition(values, (below, above))
    return float(ordered[below] + (place - below) * (ordered[above] - ordered[below]))


def median_of_sorted(ordered: Array, count: int) -> float:
    """Return the median of the first `count` of (N,) sorted values."""
    return (ordered.item((count - 1) // 2) + ordered.item(count // 2)) / 2
