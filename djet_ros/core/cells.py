"""Cells of an image: what makes points spread over it."""

from __future__ import annotations

from typing import Any

from djet_ros import compiled
from djet_ros.core.types import Array
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

# chosen: points in a cell in which the nearest ones are looked for, were they spread evenly.
_IN_CELL = 2.0


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


def nearest(sites: Array, points: Array) -> NDArray[np.int64]:
    """Tell which of some sites (M, 2), one at least, is next to each of points (N, 2)."""
    if compiled.library is None:
        return np.asarray(cKDTree(sites).query(points)[1])
    corner, size = sites.min(0), np.ptp(sites, axis=0)
    # Cells are no narrower than that as many as there are sites hold all of these.
    side = max(float(np.sqrt(size.prod() * _IN_CELL / len(sites))),
               float(size.max()) / len(sites), 1e-9)
    columns, rows = (size / side).astype(int).tolist()
    return compiled.nearest(sites, points, corner, side, (columns + 1, rows + 1))
