"""
Where places of one view are in the next by the flow of the image (Lucas and Kanade, IJCAI 1981).

It needs no corner there, and is exact to a tenth of a pixel; it only goes astray where the image
moves farther than its windows reach, or by its lighting.
"""

from __future__ import annotations

import cv2
from djet_ros.core.hamming import match_distances
from djet_ros.core.types import Array, View
import numpy as np
from numpy.typing import NDArray

# Side of the window in pixels: the smaller the more exact, and OpenCV takes so many at once.
_WINDOW = 8

# Levels of the pyramid on the way there, each twice as coarse: where places are foreseen, and
# where they are not.
NEAR, FAR = 2, 3

# Steps at each level at most, and pixels of a step that is the last. Patches refine it: more of
# them add nothing.
_STEPS, _LAST_STEP = 4, 0.1

# The way back only has to tell whether it leads near the beginning, by as many pixels.
_STEPS_BACK, _LAST_STEP_BACK, _THERE_AND_BACK = 3, 0.1, 1.0

# Bits in which both places differ at most: those that have nothing to do with one another differ
# by 128.
_ALIKE = 80


def reach_of_levels(levels: int) -> float:
    """Tell to how many pixels from where it starts the flow leads."""
    return _WINDOW / 2 * float(2**levels)


def follow(previous: View, current: View, start: Array, reach: float, levels: int = FAR
           ) -> tuple[Array, Array]:
    """
    Follow the features of the previous view from where they may be seen, pixels `start` (N, 2).

    levels: of the pyramid, NEAR or FAR. Gives the pixels (N, 2) where they are, and the bits (N,)
    in which descriptors differ there: infinitely many for those that are lost, which are farther
    than `reach` from the start, do not lead back, or look otherwise.
    """
    points = previous.features.points
    bits = np.full(len(points), np.inf)
    x, at_first = (places.astype(np.float32)[:, None] for places in (points, start))
    y, seen = _flow(previous.gray, current.gray, x, at_first, levels, _STEPS, _LAST_STEP)
    near = np.flatnonzero(seen & _within(reach, y, at_first))
    began = x.take(near, axis=0)
    back, seen_back = _flow(current.gray, previous.gray, y.take(near, axis=0), began, 0,
                            _STEPS_BACK, _LAST_STEP_BACK)
    good = near[seen_back & _within(_THERE_AND_BACK, back, began)]
    places = y[:, 0].astype(np.float64)
    bits[good] = match_distances(previous.smoothed, points.take(good, axis=0), current.smoothed,
                                 places.take(good, axis=0))
    # Not a number where a descriptor would leave the image.
    bits[~(bits <= _ALIKE)] = np.inf
    return places, bits


def _within(reach: float, places: NDArray[np.float32], others: NDArray[np.float32]
            ) -> NDArray[np.bool_]:
    """(N,) bool mask of the places (N, 1, 2) that are nearer than a reach to others."""
    x, y = (places - others)[:, 0].T
    return np.asarray(np.sqrt(x * x + y * y) < reach)


def _flow(before: NDArray[np.uint8], after: NDArray[np.uint8], points: NDArray[np.float32],
          start: NDArray[np.float32], levels: int, steps: int, last_step: float,
          ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Give where points (N, 1, 2) lead from where they may be, and (N,) whether they are seen."""
    if not len(points):
        return points, np.zeros(0, bool)
    found, seen, _ = cv2.calcOpticalFlowPyrLK(
        before, after, points, start.copy(), winSize=(_WINDOW, _WINDOW), maxLevel=levels,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, steps, last_step),
        # In place of the eigenvalues, which it has, it would compare all patches once more.
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW | cv2.OPTFLOW_LK_GET_MIN_EIGENVALS)
    return np.asarray(found, np.float32), np.asarray(seen).ravel() > 0
