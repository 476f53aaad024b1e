"""How far the matches of a pair are displaced in the image, and which of them move together."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

from djet_ros.core.geometry import norms, rotation_angle
from djet_ros.core.rivals import SLIGHTLY
from djet_ros.core.types import Array, RelativePose
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import fdtrc

# Cell size in pixels.
_CELL = 32

# chosen: two matches move together if their displacements differ by less than this share; false
# ones do by chance once in thirty times.
_ALIKE = 0.25

# Significance that a common drift needs.
_SIGNIFICANCE = 1e-3


@dataclass(frozen=True)
class Displaced:
    """
    Matches with their displacement.

    x, shift: (N, 2) pixels; inliers: (N,) bool, of the pair's motion; threshold: pixels below
    which they are still.
    """

    x: Array
    shift: Array
    inliers: NDArray[np.bool_]
    threshold: float

    @classmethod
    def of(cls, relative: RelativePose, threshold: float) -> Displaced:
        """Return those of a pair."""
        found = len(relative.inliers) == len(relative.x)
        return cls(relative.x, relative.y - relative.x,
                   relative.inliers if found else np.zeros(len(relative.x), bool), threshold)

    def among(self, chosen: NDArray[np.bool_]) -> Displaced:
        """Return some (N,) of the matches."""
        return Displaced(self.x[chosen], self.shift[chosen], self.inliers[chosen],
                         self.threshold)

    @cached_property
    def _distances(self) -> Array:
        return norms(self.shift)

    @property
    def still(self) -> NDArray[np.bool_]:
        """Return a mask (N,) of the matches that are still."""
        return np.asarray(self._distances < self.threshold)

    @property
    def slightly(self) -> NDArray[np.bool_]:
        """Return a mask (N,) of the matches that move slightly."""
        return self.near & ~self.still

    @property
    def near(self) -> NDArray[np.bool_]:
        """Return a mask (N,) of the matches that are still or move slightly."""
        return np.asarray(self._distances < SLIGHTLY * self.threshold)

    def without_drift(self) -> Displaced:
        """Return the same without the median displacement of those that move slightly at most."""
        if not self.near.any():
            return self
        return replace(self, shift=self.shift - np.median(self.shift[self.near], axis=0))

    def together(self) -> Array:
        """Return the x (M, 2) of those that are displaced about as their nearest neighbour is."""
        if len(self.x) < 2:
            return self.x[:0]
        neighbour = cKDTree(self.x).query(self.x, 2)[1][:, 1]
        apart = norms(self.shift - self.shift[neighbour])
        return self.x[apart < _ALIKE * self._distances]


def cells(x: Array) -> NDArray[np.complex128]:
    """Return all distinct cells of the image (M,) that pixels x (N, 2) are in."""
    return np.unique(cell_of(x))


def cell_of(x: Array) -> NDArray[np.complex128]:
    """Return the cell (N,) that each pixel is in, column + i row."""
    return identifiers(np.floor_divide(x, _CELL))


def turns(relative: RelativePose, K: Array, threshold: float) -> bool:
    """
    Return whether the rotation of a pair moves pixels by more than slightly.

    K: (3, 3) camera matrix; threshold: of the standstill in pixels.
    """
    return bool(K[0, 0] * rotation_angle(relative.R, np.eye(3)) > SLIGHTLY * threshold)


def drifted(x: Array, y: Array, least: float) -> bool:
    """
    Return whether pixels x have a common drift to y (N, 2), above a root mean square.

    Common: by an affine map, whose six parameters also fit their share of the noise; that is
    subtracted, and an F-test has to reject no drift. Too few pixels have none.
    """
    freedom = 2 * len(x) - 6
    if freedom <= 0:
        return False
    design = np.column_stack([x, np.ones(len(x))])
    fit = design @ np.linalg.lstsq(design, y - x, rcond=None)[0]
    drift, noise = float((fit**2).sum()), float(((y - x - fit)**2).sum()) / freedom
    return bool(drift - 6 * noise > len(x) * least**2
                and fdtrc(6, freedom, drift / max(6 * noise, 1e-12)) < _SIGNIFICANCE)


def identifiers(x: Array) -> NDArray[np.complex128]:
    """Return pixels (N, 2) as one number each, to compare sets of them."""
    return np.asarray(x[:, 0] + 1j * x[:, 1], np.complex128)
