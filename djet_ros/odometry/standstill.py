"""Whether the camera stands still: where nothing moves, and where only others do."""

from __future__ import annotations

from djet_ros.core.types import Array, RelativePose, Status, TRACKED
import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

# Side of a cell of the image in pixels, and share of the matches, and of the cells that have some,
# that are where they were if the camera stands in front of traffic; chosen: and if it has stood
# before, as most do where they begin.
_CELL, _STILL, _STILL_AS_BEFORE = 32, 0.2, 0.05

# Times the displacement of what stands still up to which something hardly moves.
_HARDLY = 3

# chosen: share of the displacement up to which a camera stands, from which on it creeps; and how
# improbable it is that noise makes it seem so.
_CREEPS, _BY_CHANCE = 0.1, 1e-3

# chosen: so many features that stood before tell that they still do; false matches of a thousand
# features end within a third of a pixel of where they began less than once in a hundred pairs.
_WITNESSES = 10


class Standstill:
    """
    Remembers of a reference view what stood in it, while the camera did.

    Features are told by their pixels, which are the same in all pairs with one reference.
    """

    def __init__(self) -> None:
        self._stood: bool | None = None
        self._world = np.empty(0, np.complex128)

    def refer(self) -> None:
        """Take another reference view, of which nothing is known yet."""
        self._world = np.empty(0, np.complex128)

    def moved(self) -> None:
        """Take that the camera moved."""
        self._stood = False

    def may_stand(self, relative: RelativePose, most: float) -> bool:
        """
        Tell whether a camera that feels nothing is more likely to stand than to have set off.

        Where nobody knows yet whether it stood, some things have to be where they were.
        """
        if self._stood is not None:
            return self._stood
        still, hardly = _still_and_hardly(relative, most)
        return bool(still.sum() >= max(_WITNESSES, hardly.sum()))

    def stay(self, relative: RelativePose, most: float) -> None:
        """Take that the camera stood; most: pixels by which what stands is displaced at most."""
        self._stood = True
        features = _named(relative.x)
        still = _displacements(relative.x, relative.y) < most
        self._world = np.union1d(np.setdiff1d(self._world, features), features[still])

    def crept(self, relative: RelativePose, most: float) -> bool:
        """
        Tell whether a camera that stands by ``told`` is not quite where the reference view was.

        Then it creeps, and one day will have moved. What others do is told by the most, too.
        """
        y = _refined(relative)
        still = _displacements(relative.x, y) < most
        return _drifted(relative.x[still], y[still], _CREEPS * most)

    def told(self, relative: RelativePose, most: float, at_rest: bool) -> bool:
        """
        Tell whether the camera stands still in a pair with the reference view.

        most: as for ``stay``; at_rest: whether a gyro felt nothing.
        """
        if not len(relative.x):
            return False
        if _nothing_moved(relative, most):
            return True
        if not at_rest:
            return False
        still, hardly = _still_and_hardly(relative, most)
        return (self._only_others_moved(relative, still, hardly)
                or self._world_stands(relative, still, hardly))

    def _only_others_moved(self, relative: RelativePose, still: NDArray[np.bool_],
                           hardly: NDArray[np.bool_]) -> bool:
        """
        Tell traffic from a motion of the camera: much did not move.

        A part of the matches all over the image has to be where it was; a smaller one will do for
        a camera that stood before. To one that moves, some things hardly move and more of them
        move a little; before one that stands, things move or do not. Slow motion does not pass for
        standstill for long, as the reference view stays and displacements add up.
        """
        cells = np.floor_divide(relative.x, _CELL)
        spread = len(np.unique(cells[still], axis=0)) / len(np.unique(cells, axis=0))
        least = _STILL if self._stood is False else _STILL_AS_BEFORE
        return bool(still.mean() > least and spread > least and still.sum() > hardly.sum())

    def _world_stands(self, relative: RelativePose, still: NDArray[np.bool_],
                      hardly: NDArray[np.bool_]) -> bool:
        """
        Tell whether what stood before still does, however little is seen of it behind a lorry.

        What the lorry hides is matched falsely, all over the search area. If it were the camera
        that moved, all but the furthest of what stood would be displaced a little, or agree with
        the motion that the pair tells; so more has to be where it was than either.
        """
        world = np.isin(_named(relative.x), self._world)
        moved = np.zeros(len(world), bool)
        if len(relative.inliers):
            moved = relative.inliers & ~still
        standing = (world & still).sum()
        return bool(standing >= _WITNESSES and standing > (world & hardly).sum()
                    and standing > (world & moved).sum())


def _nothing_moved(relative: RelativePose, most: float) -> bool:
    # Two equal images are DEGENERATE to most estimators, for want of any residual.
    if relative.status not in (*TRACKED, Status.DEGENERATE):
        return False
    return float(np.median(_displacements(relative.x, _refined(relative)))) < most


def _refined(relative: RelativePose) -> Array:
    """Give matched pixels (N, 2), as exact as they are known for all."""
    refined = len(relative.y_opt) == len(relative.x) and np.isfinite(relative.y_opt).all()
    return relative.y_opt if refined else relative.y


def _drifted(x: Array, y: Array, least: float) -> bool:
    """
    Tell whether pixels moved together from x to y (N, 2) by more, as a root mean square.

    Together: by an affine map. Its six parameters take their share of the noise, so an F-test asks
    for more than that; few pixels tell nothing.
    """
    freedom = 2 * len(x) - 6
    if freedom <= 0:
        return False
    around = x - x.mean(0)
    design = np.column_stack([around / max(np.abs(around).max(), 1.0), np.ones(len(x))])
    fit = design @ np.linalg.lstsq(design, y - x, rcond=None)[0]
    together, noise = float((fit**2).sum()), float(((y - x - fit)**2).sum()) / freedom
    return bool(together - 6 * noise > len(x) * least**2
                and fdtrc(6, freedom, together / max(6 * noise, 1e-12)) < _BY_CHANCE)


def _still_and_hardly(relative: RelativePose, most: float
                      ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(N,) bool masks of the matches that are where they were, and that are off by a little."""
    shift = _displacements(relative.x, relative.y)
    return shift < most, (shift >= most) & (shift < _HARDLY * most)


def _displacements(x: Array, y: Array) -> Array:
    return np.asarray(np.linalg.norm(y - x, axis=1))


def _named(x: Array) -> NDArray[np.complex128]:
    """Make one number (N,) of each of some pixels (N, 2)."""
    return np.asarray(x[:, 0] + 1j * x[:, 1], np.complex128)
