"""Which points become landmarks: near ones first, spread over the image."""

from __future__ import annotations

from djet_ros.core.cells import cells_of, rank_in_cells
from djet_ros.core.types import Array
import numpy as np
from numpy.typing import NDArray

# Side in pixels of a patch, by which its landmark is told: points nearer than that err alike.
PATCH = 26

# chosen: octaves of depth that count as equally near
_CLASSES = 2.0


def choose_landmarks(x: Array, rho: Array, present: Array, side: float, room: int
                     ) -> NDArray[np.int64]:
    """
    Choose of pixels x (N, 2), with inverse depths rho (N,) > 0, those that become landmarks.

    present: (M, 2) where there are some; side: of cells, in pixels, and the first in each comes
    before others; room: for so many. Gives their indices.
    """
    # Near ones tell most, but by their own noisy depths those would be chosen that err most, and
    # each step come out shorter: by 6 % in 300 small pictures. Others tell where is near.
    nearest = np.argsort(-np.floor(around_patches(x, np.log2(rho)) / _CLASSES), kind='stable')
    cells, taken = (cells_of(points, side) for points in (x[nearest], present))
    rank = rank_in_cells(cells) + np.isin(cells, taken)
    return np.asarray(nearest[np.argsort(rank, kind='stable')[:max(room, 0)]])


def around_patches(points: Array, values: Array) -> Array:
    """
    Means (N,) of the values of other points (N, 2) next to each, but beyond its own patch.

    The mean of all where there are none.
    """
    cells = np.floor((points - points.min(0, initial=0.0)) / PATCH).astype(np.int64) + 2
    shape = *(cells.max(0, initial=0) + 3), 2
    sums = np.zeros(shape)
    np.add.at(sums, (cells[:, 0], cells[:, 1]), np.stack([values, np.ones_like(values)], axis=1))
    total = np.cumsum(np.cumsum(np.pad(sums, ((3, 2), (3, 2), (0, 0))), axis=0), axis=1)
    x, y = cells.T + 2

    def within(reach: int) -> Array:
        """Sum up, and count, what is in a square of cells around each, (N, 2)."""
        return np.asarray(total[x + reach + 1, y + reach + 1] - total[x - reach, y + reach + 1]
                          - total[x + reach + 1, y - reach] + total[x - reach, y - reach])

    there, count = (within(2) - within(1)).T
    return np.where(count > 0, there / np.maximum(count, 1), values.mean() if len(values) else 0)
