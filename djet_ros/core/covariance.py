"""Covariance of the estimated pose."""

from __future__ import annotations

from typing import NamedTuple

from djet_ros.core.cells import beginnings
from djet_ros.core.geometry import rotation_log, sphere_tangents
from djet_ros.core.jet import Loss, Residuals
from djet_ros.core.types import Array, Pose
import numpy as np
from numpy.typing import NDArray

# Matches in one cell of this side (pixels) are taken to err together: corners are found in several
# sizes, and neighbours share what is wrong with a surface (an occlusion edge, leaves).
CELL = 32

# Into so many cells the matches are cut too. What errs together over longer distances, such as a
# patch's perspective or a haze, is seen by these, each of which errs by itself.
_LARGE_CELLS = 20

# Sides of large cells over that; several, for a few cells tell how much they vary to a third only.
_SIDES = (2 / 3, 3 / 2)

# chosen: so many neighbouring small cells err together.
_ALIKE = 3

# Pixels; chosen: what an image's sampling, its lens and its rolling rows are good for.
_SHIFT = 0.006

# Where cells are summed without a jackknife: over the ground, and in the length of a loop. It is
# what the pose's was before patches were warped, and has not been measured anew.
CAUTIOUS_INFLATION = 4.0

# rad^2; a nanoradian, far below any noise: perfect data must not divide by nothing.
_LEAST_VARIANCE = 1e-18

# What is said of a pose that is not determined.
UNKNOWN = np.full((5, 5), np.nan), np.full((6, 6), np.nan)

# Of what is known in a direction of the pose, the matches of one cell may make up all but this.
_LEAST_SUPPORT = 1e-6

# Where the upper triangle of a (5, 5) has its entries, and which of them stands at each of all 25.
_UPPER = np.triu_indices(5)
_WHOLE = [i * (9 - i) // 2 + j for i, j in map(sorted, np.ndindex(5, 5))]

# chosen: share of a cell, summed over the five directions, from which on it is looked at closely.
_WEIGHTY = 0.9


def pose_covariance(residuals: Residuals, loss: Loss, places: Array, t: Array,
                    flipped: bool) -> tuple[Array, Array]:
    """
    Covariance of (rotation vector in rad from the left, direction of t) at the minimum.

    places: (N, 2) pixels of the matches; t: (3,) the direction that was settled on, `flipped`
    where it is the opposite of the optimiser's. Gives (5, 5) in the basis
    ``sphere_tangents(t)``, and (6, 6) over (rotation vector, t), of rank 5 because t keeps its
    length. All NaN where the matches do not determine the pose, only those of one cell do, or
    they lie in too few cells.

    The noise is that of the residuals themselves, in whichever of the two images it arose: see
    `_jackknife`. Many small cells tell the shape of the covariance. Larger ones, which hold what
    errs together from one small cell to the next, tell its size: with C of the small and C' of
    larger ones, tr(C^-1 C') / 5 is how much larger the variances are on average over the five
    directions, and 1 where the small cells err each by itself; q is its mean over the sizes of the
    larger. The image is about as many large cells wide as these are small ones, and what errs
    together all over it shows in none; its variance is taken to grow by q once more.
    The pose takes five freedoms of n independent errors, so that its variance grows by 1 + 5 / n.
    What no residual shows comes to that: all that is seen in a large cell may be shifted a little.
    """
    J = residuals.jacobian
    squared = residuals.r**2
    _, weights = loss(squared)
    # A robust loss curves less than its weights say (Huber, Robust Statistics, section 7.6).
    flattening = loss.curvature(squared).mean() / weights.mean() if len(squared) else 0.0
    H = (J * weights) @ J.T
    if not np.isfinite(H).all() or flattening <= 0 or np.linalg.cond(H) > 1e12:
        return UNKNOWN
    inverse = np.asarray(np.linalg.inv(H))
    cells = _Cells.of(places, J, weights, residuals.r)
    small_cells = _jackknife(H, inverse, cells)
    large = max(np.sqrt(np.ptp(places, axis=0).prod() / _LARGE_CELLS), CELL)
    larger = cells.in_larger(large)
    large_cells = _jackknife(H, inverse, larger)
    if small_cells is None or large_cells is None:
        return UNKNOWN
    correlated = _correlated(H, inverse, cells, small_cells, large_cells, large)
    freedoms = 1 + 5 * _ALIKE / len(cells.places)
    shifts = _SHIFT * inverse @ larger.pulls
    covariance = freedoms * (correlated / flattening)**2 * small_cells + shifts @ shifts.T
    covariance = (covariance + covariance.T) / 2
    # t and -t share their essential matrix: where one moves forwards, the other moves back.
    turned = lift(-residuals.tangents if flipped else residuals.tangents)
    covariance_6 = turned @ covariance @ turned.T
    basis = lift(sphere_tangents(t))
    return basis.T @ covariance_6 @ basis, covariance_6


class _Cells(NamedTuple):
    """
    What the matches of C cells tell together.

    places: (C, 2) middles of the cells; sums: (25, C), one row after the other the upper triangle
    of H (5, 5) of their loss, its gradient (5,), and how that changes where all residuals of a
    cell grow alike (5,).
    """

    places: Array
    sums: Array

    @classmethod
    def of(cls, places: Array, J: Array, weights: Array, r: Array) -> _Cells:
        """Sum matches at pixels (N, 2) by small cells, with their J (5, N), weights and r (N,)."""
        order, first = _by_cell(places, CELL)
        J, weights, r = J[:, order], weights[order], r[order]
        weighed = J * weights
        rows, columns = _UPPER
        terms = np.concatenate([J[rows] * weighed[columns], weighed * r, weighed])
        return cls((places[order[first]] // CELL + 0.5) * CELL,
                   np.add.reduceat(terms, first, axis=1))

    def in_larger(self, side: float) -> _Cells:
        """Give larger cells, each made of whole small ones; places are those of one of them."""
        order, first = _by_cell(self.places, side)
        return _Cells(self.places[order[first]],
                      np.add.reduceat(self.sums[:, order], first, axis=1))

    @property
    def H(self) -> Array:
        """Give (C, 5, 5)."""
        return self.sums[_WHOLE].T.reshape(-1, 5, 5)

    @property
    def gradients(self) -> Array:
        """Give (5, C)."""
        return self.sums[-10:-5]

    @property
    def pulls(self) -> Array:
        """Give (5, C)."""
        return self.sums[-5:]


def _correlated(H: Array, inverse: Array, cells: _Cells, small_cells: Array, large_cells: Array,
                large: float) -> float:
    """Give q of `pose_covariance`, by large cells of a side in pixels and by others still."""
    others = (_jackknife(H, inverse, cells.in_larger(side))
              for side in (2 * CELL, *(max(size * large, CELL) for size in _SIDES)))
    # Exact matches leave no noise at all.
    noise = small_cells + _LEAST_VARIANCE * np.eye(5)
    ratios = [np.trace(np.linalg.solve(noise, larger)) / 5
              for larger in (large_cells, *others) if larger is not None]
    return max(1.0, float(np.mean(ratios)))


def difference(R: Array, t: Array, other: Pose) -> Array:
    """How another motion differs (5,) from (R, t), in the parameters of a covariance of that."""
    sign = 1.0 if other.t @ t >= 0 else -1.0
    return np.concatenate([rotation_log(other.R @ R.T),
                           sphere_tangents(t).T @ (sign * other.t - t)])


def squared_distance(covariance: Array, apart: Array) -> float:
    """Squared Mahalanobis distance of a pose that is apart (5,); finite even of perfect data."""
    variances, axes = np.linalg.eigh(covariance)
    return float(((axes.T @ apart)**2 / np.maximum(variances, _LEAST_VARIANCE)).sum())


def spanning(covariance: Array, t: Array, apart: Array, probability: float
             ) -> tuple[Array, Array]:
    """
    Widen a covariance (5, 5) by a pose apart (5,) that is the true one with a probability.

    Gives it with that over (rotation vector, t), (6, 6): C + p a a^T, the expected square of the
    error of the pose at hand.
    """
    covariance = covariance + probability * np.outer(apart, apart)
    basis = lift(sphere_tangents(t))
    return covariance, basis @ covariance @ basis.T


def lift(tangents: Array) -> Array:
    """Lift (6, 5) of steps (rotation, two tangents) to (rotation, direction)."""
    lifted = np.zeros((6, 5))
    lifted[:3, :3], lifted[3:, 3:] = np.eye(3), tangents
    return lifted


def _jackknife(H: Array, inverse: Array, cells: _Cells) -> Array | None:
    """
    Covariance (5, 5) from how far the pose would move without the matches of a cell, cell by cell.

    H, inverse: (5, 5) of all. A delete-a-group jackknife, to first order (Bell and McCaffrey,
    Survey Methodology 2002). Where few cells decide about a direction, their moves say little; so
    the mean is taken of the moves that are seen and of those that noise would make, which are
    large there, at the size that has the seen ones on average. None where cells are too few, or
    one alone decides.
    """
    count, H_cells = len(cells.places), cells.H
    if count <= 5:  # so many are gone with the pose's own freedom
        return None
    # The traces bound the shares, to within rounding, and hardly any cell comes near to all.
    weighty = H_cells[H_cells.reshape(-1, 25) @ inverse.ravel() > _WEIGHTY]
    if len(weighty):
        whitening = np.linalg.inv(np.linalg.cholesky(H))
        if (np.linalg.eigvalsh(whitening @ weighty @ whitening.T) > 1 - _LEAST_SUPPORT).any():
            return None
    without = np.linalg.inv(H - H_cells)
    moves = np.einsum('cij,jc->ic', without, cells.gradients)
    seen = moves @ moves.T
    by_noise = without.sum(0) - count * inverse
    by_noise *= np.trace(np.linalg.solve(by_noise, seen)) / 5
    return np.asarray((1 - 1 / count) * (seen + by_noise) / 2)


def summed_by_cell(places: Array, values: Array) -> Array:
    """Sum values (V, N) of matches at pixels (N, 2) over the C small cells in use, (V, C)."""
    order, first = _by_cell(places, CELL)
    return np.asarray(np.add.reduceat(values[:, order], first, axis=1))


def _by_cell(places: Array, side: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Give the order of points (N, 2) by cells of a side, and where each cell begins in that."""
    columns, rows = np.floor(places / side).astype(np.int64).T
    cell = columns * 2**32 + rows
    order = np.argsort(cell, kind='stable')
    return order, beginnings(cell[order])
