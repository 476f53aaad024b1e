"""Standstill detection: no match moves, or only those of other objects do."""

from __future__ import annotations

from dataclasses import replace

from djet_ros.core.geometry import norms, rotation_log
from djet_ros.core.rivals import MAX_SLIGHTLY
from djet_ros.core.types import Array, RelativePose, Status, TRACKED
from djet_ros.odometry.displacement import cell_of, cells, Displaced, drifted, identifiers, turns
import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

# chosen: least share of the matches, and of the cells with matches, that are still if the camera
# stands in front of traffic; with a gyro at rest also the share if it stood before or if that is
# unknown, as most cameras stand at first.
_STILL, _STILL_AS_BEFORE = 0.2, 0.05

# chosen: share of the standstill threshold from which a common drift is creep.
_CREEP = 0.1

# chosen: least number of still features that stood before. False matches of a thousand features
# end within a third of a pixel of where they began less than once in a hundred pairs.
_LEAST_STILL = 10

# chosen: least share of features with another place that move together if the camera does; a
# thirtieth of false matches does.
_TOGETHER = 0.25

# chosen: least share of features that move slightly, of all that stood before, if a camera that
# does not turn has moved: false matches are few of these.
_SLIGHTLY_OF_ALL = 0.15

# chosen: share of still matches from which what stood is searched near its place.
_STATIC = 0.9

# Squared standard deviations from no rotation, of which one of a thousand pairs without has more.
_TURNED = float(chdtri(3, 1e-3))

# chosen: number of pairs in a row in which lorries may hide most of what stood still. After more,
# the camera may have left unnoticed, with a bonnet that stays in place.
_LONGEST_HIDDEN = 30


class Standstill:
    """
    Detects a standstill from pairs with one reference view.

    Remembers features of the reference view that were still while the camera stood, identified by
    their pixels. A match is still if its displacement in pixels is below the threshold.

    prior: the standstill as the previous motion, from the reference view; None if there is none,
    or if much moves.
    """

    def __init__(self) -> None:
        self._stood: bool | None = None
        # Cells of the image in which nothing moved while the camera did.
        self._attached = np.empty(0, np.complex128)
        self.refer()

    def refer(self) -> None:
        """Begin with another reference view, without known static features."""
        self._static = np.empty(0, np.complex128)
        self.prior: RelativePose | None = None
        # The most matches that were still, and pairs in a row in which half of them were not.
        self._most = self._hidden = 0

    def interrupt(self, other_camera: bool) -> None:
        """Note a gap, after which the camera may move or stand, or images of another camera."""
        self._stood = None
        if other_camera:
            self._attached = self._attached[:0]

    def stay(self, relative: RelativePose, threshold: float) -> None:
        """Note that the camera stood still in a pair, and which features did."""
        self._stood = True
        features = identifiers(relative.x)
        still = Displaced.of(relative, threshold).still
        self._static = np.union1d(np.setdiff1d(self._static, features), features[still])
        self.prior = _in_place(relative, still) if still.mean() > _STATIC else None
        self._most = max(self._most, int(still.sum()))
        self._hidden = 0 if 2 * still.sum() >= self._most else self._hidden + 1

    def detect(self, relative: RelativePose, K: Array, threshold: float,
               at_rest: bool | None) -> bool:
        """
        Return whether the camera, with the matrix K (3, 3), stands still in a pair.

        at_rest: whether a gyro measured no rotation; None without a gyro. Then what stays in place
        may be a bonnet that moves with the camera, so it has to have stood before, or be above the
        horizon.
        """
        if not len(relative.x) or (not at_rest and self._hidden > _LONGEST_HIDDEN):
            return False
        if not at_rest and (2 * _held_in_place(relative, K, threshold).sum()
                            > _is_still(relative, threshold).sum()):
            return False
        apart = self._is_apart(relative.x)
        if _nothing_moves(relative, apart, threshold):
            return True
        matches = Displaced.of(relative, threshold).among(apart)
        if at_rest is False or (at_rest is None and self._static_features_move(matches, None)):
            return False
        return (self._only_others_move(_world(matches, K, at_rest), bool(at_rest))
                or self._static_features_are_still(matches, at_rest))

    def _is_apart(self, x: Array) -> NDArray[np.bool_]:
        """Return which pixels (N, 2) are not on what is attached to the camera, nor just above."""
        cell, below = cell_of(x), 1j
        return ~(np.isin(cell, self._attached) | np.isin(cell + below, self._attached))

    def take(self, relative: RelativePose, K: Array, threshold: float) -> None:
        """
        Note a pair that is no standstill: the camera moved, unless it only vibrated.

        What stays in place below the horizon is attached to it, until something moves there.
        """
        if relative.status is not Status.OK:
            if turns(relative, K, threshold):
                self._stood = False
            return
        self._stood = False
        below = Displaced.of(relative, threshold).among(
            (relative.x[:, 1] > K[1, 2]) & ~_held_in_place(relative, K, threshold))
        self._attached = np.setdiff1d(np.union1d(self._attached, cells(below.x[below.still])),
                                      cells(below.x[~below.still]))

    @property
    def may_stand(self) -> bool:
        """Return whether the camera stood still before, or may have, as most do at first."""
        return self._stood is not False

    @property
    def stood(self) -> bool:
        """Return whether the camera stood still before, as some features of the reference did."""
        return bool(self._stood and len(self._static))

    def is_of_others(self, relative: RelativePose) -> bool:
        """Return whether a pair has the motion of something else than the features that stood."""
        static = self.is_static(relative.x[relative.inliers])
        return self.stood and bool(static.sum() < _LEAST_STILL)

    def is_static(self, x: Array) -> NDArray[np.bool_]:
        """Return which pixels (N, 2) of the reference view are of features that stood."""
        return np.isin(identifiers(x), self._static)

    def _static_features_move(self, matches: Displaced, at_rest: bool | None) -> bool:
        """
        Return whether static features move in more of the image than they stand still in.

        So they do if the camera starts: a body that starts is smaller than all else, and so is a
        bonnet that moves with the camera. What a lorry hides has false matches, few of which move
        together or slightly. If the camera starts slowly, many move slightly.
        """
        static = self._static_among(matches, at_rest)
        still, slightly = static.still, static.slightly
        if (slightly.sum() >= max(_LEAST_STILL, _SLIGHTLY_OF_ALL * len(static.x))
                and _start_slowly(static)):
            return True
        moving = static.among(~still & ~slightly)
        together = moving.together()
        return bool(len(together) >= max(_LEAST_STILL, _TOGETHER * len(moving.x))
                    and len(cells(together)) > len(cells(static.x[still])))

    def _static_among(self, matches: Displaced, at_rest: bool | None) -> Displaced:
        """
        Return the static features of some matches; if most others move, without a common drift.

        A car that waits in traffic vibrates, unless a gyro is at rest.
        """
        static = matches.among(self.is_static(matches.x))
        vibrates = not at_rest and matches.near.sum() < len(matches.x) / 2
        return static.without_drift() if vibrates else static

    def is_likely(self, relative: RelativePose, K: Array, threshold: float,
                  at_rest: bool | None) -> bool:
        """
        Return whether a camera that does not rotate more likely stands than has started to move.

        It does if it stood before, unless static features move in most of the image; if that is
        unknown, enough matches have to be still, and few others may move slightly. K, at_rest: as
        for ``detect``.
        """
        if self._stood is False:
            return False
        matches = Displaced.of(relative, threshold).among(self._is_apart(relative.x))
        if self._stood is None:
            world = _world(matches, K, at_rest)
            return bool(world.still.sum() >= _LEAST_STILL) and not _start_slowly(world)
        return not self._static_features_move(matches, at_rest)

    def creeps(self, relative: RelativePose, threshold: float) -> bool:
        """
        Return whether the camera in a standstill is no longer quite at the reference view.

        The threshold also excludes the matches of other objects that move.
        """
        y = _refined(relative)
        still = norms(y - relative.x) < threshold
        return drifted(relative.x[still], y[still], _CREEP * threshold)

    def _only_others_move(self, matches: Displaced, at_rest: bool) -> bool:
        """
        Return whether a sufficient share of the matches, all over the image, is still.

        A smaller share is sufficient if the camera stood before and a gyro is at rest. If the
        camera moves, few matches are still and others move slightly; if it stands, matches move or
        do not. Slow motion is taken for a standstill only for a short time, as displacements from
        the same reference view accumulate.
        """
        still = matches.still
        if still.sum() < _LEAST_STILL:
            return False
        spread = len(cells(matches.x[still])) / len(cells(matches.x))
        least = _STILL_AS_BEFORE if at_rest and self._stood is not False else _STILL
        return bool(still.mean() > least and spread > least
                    and (matches.slightly.sum() < still.sum() if at_rest
                         else not _start_slowly(matches)))

    def _static_features_are_still(self, matches: Displaced, at_rest: bool | None) -> bool:
        """
        Return whether static features are still, however few of them a lorry leaves visible.

        Features that the lorry hides have false matches all over the search area. If the camera
        moved, all but the most distant static features would move slightly, or be inliers of the
        pair's motion; so more have to be still than do either.
        """
        static = self._static_among(matches, at_rest)
        standing = static.still.sum()
        return bool(standing >= _LEAST_STILL and standing > static.slightly.sum()
                    and standing > (static.inliers & ~static.still).sum())


def _start_slowly(matches: Displaced) -> bool:
    """
    Return whether so many matches move slightly, as a camera that starts makes them.

    Noise does, too, but has no common drift.
    """
    near = matches.among(matches.near)
    return bool(matches.slightly.sum() >= MAX_SLIGHTLY * matches.still.sum()
                and drifted(near.x, near.x + near.shift, _CREEP * near.threshold))


def _in_place(relative: RelativePose, still: NDArray[np.bool_]) -> RelativePose:
    """Return a pair as that of a camera that stands, whose inliers stay in place."""
    return replace(relative, status=Status.NO_PARALLAX, R=np.eye(3), t=np.zeros(3), rivals=(),
                   y=relative.x, y_opt=relative.x, inliers=still, left_out=None,
                   residuals=norms(relative.y - relative.x))


def _world(matches: Displaced, K: Array, at_rest: bool | None) -> Displaced:
    """Return the matches that are not on a bonnet if they are still: all, if a gyro is at rest."""
    # The principal point is as high as a level camera.
    return matches if at_rest else matches.among(matches.x[:, 1] < K[1, 2])


def _nothing_moves(relative: RelativePose, apart: NDArray[np.bool_], threshold: float) -> bool:
    """Return whether most matches (N,), of those apart from the camera, are still."""
    # Most methods report two equal images as DEGENERATE, as all residuals are zero.
    if relative.status not in (*TRACKED, Status.DEGENERATE) or not apart.any():
        return False
    x, still = relative.x[apart], _is_still(relative, threshold)[apart]
    # In most of the image too, as a bonnet may have most of the features.
    return bool(still.mean() > 0.5 and len(cells(x[still])) > len(cells(x)) / 2)


def _held_in_place(relative: RelativePose, K: Array, threshold: float) -> NDArray[np.bool_]:
    """
    Return a mask (N,) of the matches that are still because the camera moves around them.

    It turns by more than the threshold, and its translation takes that back at their depth, such
    as that of a wall behind what it passes.
    """
    turn = rotation_log(relative.R)
    if (relative.status is not Status.OK or K[0, 0] * np.linalg.norm(turn) < threshold
            or turn @ np.linalg.solve(relative.covariance_5[:3, :3], turn) < _TURNED):
        return np.zeros(len(relative.x), bool)
    return relative.inliers & _is_still(relative, threshold)


def _is_still(relative: RelativePose, threshold: float) -> NDArray[np.bool_]:
    """Return a mask (N,) of the matches that are still, refined if all of them are."""
    return np.asarray(norms(_refined(relative) - relative.x) < threshold)


def _refined(relative: RelativePose) -> Array:
    """Return the matched pixels (N, 2), refined if all of them are."""
    refined = len(relative.y_opt) == len(relative.x) and np.isfinite(relative.y_opt).all()
    return relative.y_opt if refined else relative.y
