"""Cells of an image: what makes points spread over it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


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
