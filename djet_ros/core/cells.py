"""Cells of an image: what makes points spread over it, and which of them err together."""

from __future__ import annotations

from typing import Any

from djet_ros.core.types import Array
import numpy as np
from numpy.typing import NDArray

# Matches in one cell of this side (pixels) are taken to err together: corners are found in several
# sizes, and neighbours share what is wrong with a surface (an occlusion edge, leaves).
CELL = 32

# Where cells are summed without a jackknife: over the ground, and in the length of a loop. It is
# what the pose's was before patches were warped, and has not been measured anew.
CAUTIOUS_INFLATION = 4.0


def cells_of(points: NDArray[Any], side: float) -> NDArray[np.int64]:
    """Give the numbers (N,) of the cells of a side in pixels in which points (N, 2) lie."""
    return np.asarray(np.floor(points / side).astype(np.int64) @ (1, 2**20))


def rank_in_cells(cells: NDArray[Any]) -> NDArray[np.int64]:
    """Tell of each of N points how many of its cell come before it; cells: (N,) their numbers."""
    order = np.argsort(cells, kind='stable')
    first = beginnings(cells[order])
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order)) - np.repeat(first, np.diff(first, append=len(order)))
    return rank


def beginnings(ordered: NDArray[Any]) -> NDArray[np.int64]:
    """Give the indices at which another number begins among ordered ones (N,)."""
    begins = np.ones(len(ordered), bool)
    np.not_equal(ordered[1:], ordered[:-1], out=begins[1:])
    return np.flatnonzero(begins)


def short(numbers: NDArray[np.int64]) -> NDArray[Any]:
    """Give numbers from 0 on in as few bytes as hold them: sorted ten times as fast."""
    return numbers.astype(np.min_scalar_type(numbers.max(initial=0)))


def summed_by_cell(places: Array, values: Array) -> Array:
    """Sum values (V, N) of matches at pixels (N, 2) over the C small cells in use, (V, C)."""
    order, first = by_cell(places, CELL)
    return np.asarray(np.add.reduceat(values.take(order, axis=1), first, axis=1))


def by_cell(places: Array, side: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Give the order of points (N, 2) by cells of a side, and where each cell begins in that."""
    columns, rows = np.floor(places / side).astype(np.int64).T
    columns, rows = columns - columns.min(initial=0), rows - rows.min(initial=0)
    cell = short(columns * (rows.max(initial=0) + 1) + rows)
    order = np.argsort(cell, kind='stable')
    return order, beginnings(cell[order])
