"""
Tracking of features by pyramidal optical flow (Lucas and Kanade, IJCAI 1981).

It needs no corner in the second image and is accurate to a tenth of a pixel; it fails if the
displacement exceeds the reach of its windows. It takes gray levels to be those of before: if an
exposure is a twentieth longer, half of the features may be lost. Then images are compared without
their local mean, and with equal contrast.
"""

from __future__ import annotations

import cv2
from djet_ros.core.geometry import norms
from djet_ros.core.hamming import match_distances
from djet_ros.core.medians import median
from djet_ros.core.types import Array, View
import numpy as np
from numpy.typing import NDArray

# Side of the window in pixels: a smaller one is more accurate; OpenCV processes 8 pixels at once.
_WINDOW = 8

# Gray levels; chosen: median change of those of the features from which the exposure has changed.
_OTHER_EXPOSURE = 4.0

# Side in pixels of the neighbourhood whose mean is subtracted then. Chosen: what is larger does
# not guide coarse levels any more, so long displacements are lost.
_LOCAL = 31

# Pyramid levels above full resolution: with predicted places, and without.
NEAR_LEVELS, FAR_LEVELS = 2, 3

# Maximum number of steps at each level, and the step in pixels at which it converges. Patch
# alignment refines the result: more steps do not help.
_STEPS, _LAST_STEP = 4, 0.1

# The same for tracking back, which only has to return within _MAX_ROUND_TRIP pixels of the start.
_STEPS_BACK, _LAST_STEP_BACK, _MAX_ROUND_TRIP = 3, 0.1, 1.0

# Maximum descriptor distance in bits; unrelated places differ by 128.
_MAX_BITS = 80


def flow_reach(levels: int) -> float:
    """Return the largest displacement in pixels that the flow can follow."""
    return _WINDOW / 2 * float(2**levels)


def track_features(previous: View, current: View, start: Array, reach: float,
                   levels: int = FAR_LEVELS) -> tuple[Array, Array]:
    """
    Track the features of the previous view from their expected pixels `start` (N, 2).

    levels: of the pyramid, NEAR_LEVELS or FAR_LEVELS. Returns the pixels (N, 2) in the current
    view, and the descriptor distances (N,) in bits, infinite for features that are lost: farther
    than `reach` from the start, not tracked back to where they came from, or too different.
    """
    points = previous.features.points
    before, after = previous.gray, current.gray
    if _is_exposed_otherwise(previous.smoothed, current.smoothed, points, start):
        before, after = _equally_exposed(before, after)
    bits = np.full(len(points), np.inf)
    x, at_first = (places.astype(np.float32)[:, None] for places in (points, start))
    y, tracked = _flow(before, after, x, at_first, levels, _STEPS, _LAST_STEP)
    near = np.flatnonzero(tracked & _within(reach, y, at_first))
    origins = x.take(near, axis=0)
    back, tracked_back = _flow(after, before, y.take(near, axis=0), origins, 0, _STEPS_BACK,
                               _LAST_STEP_BACK)
    returned = near[tracked_back & _within(_MAX_ROUND_TRIP, back, origins)]
    places = y[:, 0].astype(np.float64)
    bits[returned] = match_distances(previous.smoothed, points.take(returned, axis=0),
                                     current.smoothed, places.take(returned, axis=0))
    # NaN if the descriptor would leave the image.
    bits[~(bits <= _MAX_BITS)] = np.inf
    return places, bits


def _is_exposed_otherwise(before: NDArray[np.uint8], after: NDArray[np.uint8], points: Array,
                          start: Array) -> bool:
    """
    Return whether features at pixels `points` (N, 2) have other gray levels where they may be now.

    For the median they need not be exactly there.
    """
    height, width = after.shape
    inside = ((start > -0.5) & (start < (width - 0.5, height - 0.5))).all(1)
    (columns, rows), (columns_before, rows_before) = (
        np.rint(places[inside]).astype(np.int64).T for places in (start, points))
    change = after[rows, columns].astype(np.float64) - before[rows_before, columns_before]
    return bool(len(change) and abs(median(change)) > _OTHER_EXPOSURE)


def _equally_exposed(before: NDArray[np.uint8], after: NDArray[np.uint8]
                     ) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """
    Return two images (H, W) less the mean around each pixel, plus a medium gray.

    The second with the contrast of the first.
    """
    means = [cv2.blur(gray, (_LOCAL, _LOCAL)) for gray in (before, after)]
    contrasts = [float(cv2.meanStdDev(cv2.subtract(gray, mean, dtype=cv2.CV_16S))[1][0, 0])
                 for gray, mean in zip((before, after), means)]
    factor = contrasts[0] / max(contrasts[1], 1e-9)
    one, other = (np.asarray(cv2.addWeighted(gray, share, mean, -share, 128), np.uint8)
                  for gray, mean, share in zip((before, after), means, (1.0, factor)))
    return one, other


def _within(reach: float, places: NDArray[np.float32], references: NDArray[np.float32]
            ) -> NDArray[np.bool_]:
    """Return the (N,) bool mask of the places (N, 1, 2) that are nearer than a reach to others."""
    return np.asarray(norms((places - references)[:, 0]) < reach)


def _flow(before: NDArray[np.uint8], after: NDArray[np.uint8], points: NDArray[np.float32],
          start: NDArray[np.float32], levels: int, steps: int, last_step: float,
          ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return the tracked points (N, 1, 2) from expected ones, and (N,) whether they were found."""
    if not len(points):
        return points, np.zeros(0, bool)
    tracked, status, _ = cv2.calcOpticalFlowPyrLK(
        before, after, points, start.copy(), winSize=(_WINDOW, _WINDOW), maxLevel=levels,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, steps, last_step),
        # Without this flag OpenCV would compare all patches again; the eigenvalues are computed
        # anyway.
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW | cv2.OPTFLOW_LK_GET_MIN_EIGENVALS)
    return np.asarray(tracked, np.float32), np.asarray(status).ravel() > 0
