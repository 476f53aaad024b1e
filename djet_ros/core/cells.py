"""Cells of an image: they distribute points over it, and group those with correlated errors."""

from __future__ import annotations

from typing import Any

from djet_ros.core.types import Array
import numpy as np
from numpy.typing import NDArray

# Side of a cell in pixels; errors of matches in one cell are taken to be correlated: corners are
# found at several scales, and neighbours share errors of the surface (an occlusion edge, leaves).
CELL = 32

# Variance inflation where cells are summed without a jackknife: for the ground, and for the length
# of a loop. It was that of the pose before patches were warped, and has not been measured since.
CAUTIOUS_INFLATION = 4.0


def cells_of(points: NDArray[Any], side: float) -> NDArray[np.int64]:
    """Return the numbers (N,) of the cells, of a side in pixels, of points (N, 2)."""
    return np.asarray(np.floor(points / side).astype(np.int64) @ (1, 2**20))


def rank_in_cells(cells: NDArray[Any]) -> NDArray[np.int64]:
    """Return how many points of the same cell precede each of N points; cells: (N,) numbers."""
    order = np.argsort(cells, kind='stable')
    first = run_starts(cells[order])
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order)) - np.repeat(first, np.diff(first, append=len(order)))
    return rank


def run_starts(ordered: NDArray[Any]) -> NDArray[np.int64]:
    """Return the indices where a new value begins in sorted numbers (N,)."""
    begins = np.ones(len(ordered), bool)
    np.not_equal(ordered[1:], ordered[:-1], out=begins[1:])
    return np.flatnonzero(begins)


def in_few_bytes(numbers: NDArray[np.int64]) -> NDArray[Any]:
    """Return numbers >= 0 in the smallest integer type, which sorts ten times as fast."""
    return numbers.astype(np.min_scalar_type(numbers.max(initial=0)))


def sum_by_cell(places: Array, values: Array) -> Array:
    """Sum values (V, N) of matches at pixels (N, 2) over the C occupied cells, (V, C)."""
    order, first = group_by_cell(places, CELL)
    return np.asarray(np.add.reduceat(values.take(order, axis=1), first, axis=1))


def group_by_cell(places: Array, side: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the order of points (N, 2) by cells of a side, and where each cell begins in it."""
    columns, rows = np.floor(places / side).astype(np.int64).T
    columns, rows = columns - columns.min(initial=0), rows - rows.min(initial=0)
    cell = in_few_bytes(columns * (rows.max(initial=0) + 1) + rows)
    order = np.argsort(cell, kind='stable')
    return order, run_starts(cell[order])
