"""Standstill detection: no match moves, or only other objects do while a gyro is at rest."""

from __future__ import annotations

from djet_ros.core.geometry import norms
from djet_ros.core.types import Array, RelativePose, Status, TRACKED
import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

# Cell size in pixels, and least share of the matches, and of the cells with matches, that are
# still if the camera stands in front of traffic; chosen: the share if it stood before or if that
# is unknown, as most cameras stand at first.
_CELL, _STILL, _STILL_AS_BEFORE = 32, 0.2, 0.05

# A match moves slightly if its displacement is below this multiple of the standstill threshold.
_SLIGHTLY = 3

# chosen: share of the standstill threshold from which a common drift is creep, and the
# significance that it needs.
_CREEP, _SIGNIFICANCE = 0.1, 1e-3

# chosen: least number of still features that stood before. False matches of a thousand features
# end within a third of a pixel of where they began less than once in a hundred pairs.
_LEAST_STILL = 10


class Standstill:
    """
    Detects a standstill from pairs with one reference view.

    Remembers features of the reference view that were still while the camera stood, identified by
    their pixels. A match is still if its displacement in pixels is below the threshold.
    """

    def __init__(self) -> None:
        self._stood: bool | None = None
        self._static = np.empty(0, np.complex128)

    def refer(self) -> None:
        """Begin with another reference view, without known static features."""
        self._static = np.empty(0, np.complex128)

    def moved(self) -> None:
        """Note that the camera moved."""
        self._stood = False

    def stay(self, relative: RelativePose, threshold: float) -> None:
        """Note that the camera stood still in a pair, and which features did."""
        self._stood = True
        features = _identifiers(relative.x)
        still = _displacements(relative.x, relative.y) < threshold
        self._static = np.union1d(np.setdiff1d(self._static, features), features[still])

    def detect(self, relative: RelativePose, threshold: float, at_rest: bool) -> bool:
        """
        Return whether the camera stands still in a pair.

        at_rest: whether a gyro measured no rotation.
        """
        if not len(relative.x):
            return False
        if _nothing_moves(relative, threshold):
            return True
        if not at_rest:
            return False
        still, slightly = _still_and_slightly(relative, threshold)
        return (self._only_others_move(relative, still, slightly)
                or self._static_features_are_still(relative, still, slightly))

    def is_likely(self, relative: RelativePose, threshold: float) -> bool:
        """
        Return whether a camera with a gyro at rest is more likely to stand than to have started.

        It is if it stood before; if that is unknown, enough matches have to be still.
        """
        if self._stood is not None:
            return self._stood
        still, slightly = _still_and_slightly(relative, threshold)
        return bool(still.sum() >= max(_LEAST_STILL, slightly.sum()))

    def creeps(self, relative: RelativePose, threshold: float) -> bool:
        """
        Return whether the camera in a standstill is no longer quite at the reference view.

        The threshold also excludes the matches of other objects that move.
        """
        y = _refined(relative)
        still = _displacements(relative.x, y) < threshold
        return _drifted(relative.x[still], y[still], _CREEP * threshold)

    def _only_others_move(self, relative: RelativePose, still: NDArray[np.bool_],
                          slightly: NDArray[np.bool_]) -> bool:
        """
        Return whether a sufficient share of the matches, all over the image, is still.

        A smaller share is sufficient if the camera stood before. If the camera moves, few matches
        are still and more move slightly; if it stands, matches move or do not. Slow motion is
        taken for a standstill only for a short time, as displacements from the same reference view
        accumulate.
        """
        cells = np.floor_divide(relative.x, _CELL)
        spread = len(np.unique(cells[still], axis=0)) / len(np.unique(cells, axis=0))
        least = _STILL if self._stood is False else _STILL_AS_BEFORE
        return bool(still.mean() > least and spread > least and still.sum() > slightly.sum())

    def _static_features_are_still(self, relative: RelativePose, still: NDArray[np.bool_],
                                   slightly: NDArray[np.bool_]) -> bool:
        """
        Return whether static features are still, however few of them a lorry leaves visible.

        Features that the lorry hides have false matches all over the search area. If the camera
        moved, all but the most distant static features would move slightly, or be inliers of the
        pair's motion; so more have to be still than do either.
        """
        static = np.isin(_identifiers(relative.x), self._static)
        moving = np.zeros(len(static), bool)
        if len(relative.inliers):
            moving = relative.inliers & ~still
        standing = (static & still).sum()
        return bool(standing >= _LEAST_STILL and standing > (static & slightly).sum()
                    and standing > (static & moving).sum())


def _nothing_moves(relative: RelativePose, threshold: float) -> bool:
    # Most methods report two equal images as DEGENERATE, as all residuals are zero.
    if relative.status not in (*TRACKED, Status.DEGENERATE):
        return False
    return float(np.median(_displacements(relative.x, _refined(relative)))) < threshold


def _refined(relative: RelativePose) -> Array:
    """Return the matched pixels (N, 2), refined if all of them are."""
    refined = len(relative.y_opt) == len(relative.x) and np.isfinite(relative.y_opt).all()
    return relative.y_opt if refined else relative.y


def _drifted(x: Array, y: Array, least: float) -> bool:
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


def _still_and_slightly(relative: RelativePose, threshold: float
                        ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return masks (N,) of the matches that are still, and of those that move slightly."""
    shift = _displacements(relative.x, relative.y)
    return shift < threshold, (shift >= threshold) & (shift < _SLIGHTLY * threshold)


def _displacements(x: Array, y: Array) -> Array:
    return norms(y - x)


def _identifiers(x: Array) -> NDArray[np.complex128]:
    """Return pixels (N, 2) as one number each, to compare sets of them."""
    return np.asarray(x[:, 0] + 1j * x[:, 1], np.complex128)
