"""Covariance of the estimated pose."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from djet_ros.core.cells import beginnings
from djet_ros.core.geometry import rotation_log, sphere_tangents
from djet_ros.core.jet import LEAST_CURVED, Loss, Residuals
from djet_ros.core.types import Array, Pose
import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

# Matches in one cell of this side (pixels) are taken to err together: corners are found in several
# sizes, and neighbours share what is wrong with a surface (an occlusion edge, leaves).
CELL = 32

# Into so many cells the matches are cut too: none of these may hold all that is known either.
LARGE_CELLS = 20

# What two small cells err alike, by whether they share one of 64, 128, 256 or 512 pixels. Chosen:
# it halves from one to the next; on scenes rendered with seeds 0-4 it fell to 0.2 to 0.55.
_FARTHER = np.array([1, 1 / 2, 1 / 4, 1 / 8])

# Squared errors over a covariance that v normal errors tell are Hotelling's T^2: its bound of 99.9
# % in five directions is that of chi^2 times 1 + 13 / v + 220 / v^2 + 4e6 / v^6, to a tenth of
# what is above 1, where v is above 8. C cells that are alike tell v = 5 C errors; their shares of
# the whole, squared and summed up, are 1 / C = 5 / v.
_HOTELLING = 13 / 5, 220 / 5**2, 4e6 / 5**6

# chosen: errors with longer tails than normal ones tell a variance as fewer of those would; 1.5
# times fewer where the kurtosis is 4, not 3.
_LONG_TAILS = 1.5

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

    The noise is that of the residuals themselves, in whichever of the two images it arose. Small
    cells tell how large it is, and of what shape, see `_jackknife`; how much these err alike is
    told by their errors, see `_alike`. Where few decide about a direction, it is less sure than
    they say: see `_hardly_told`.
    """
    J = residuals.jacobian
    squared = residuals.r**2
    _, weights = loss(squared)
    H = (J * weights) @ J.T
    if not np.isfinite(H).all() or np.linalg.cond(H) > 1e12:
        return UNKNOWN
    flattened = _flattened(H, (J * loss.curvature(squared)) @ J.T)
    cells = _Cells.of(H, places, J, weights, residuals.r)
    large = cells.in_larger(np.sqrt(np.ptp(places, axis=0).prod() / LARGE_CELLS))
    if flattened is None or cells.without is None or large.without is None:
        return UNKNOWN
    moves = np.einsum('cij,jc->ic', cells.without, cells.gradients)
    size = cells.size(moves)
    by_itself = _jackknife(cells, cells.without, moves)
    noise = float((weights * squared).sum() / weights.sum())
    covariance = by_itself + _alike(cells, by_itself, size, noise)
    growth = float(np.trace(np.linalg.solve(by_itself, covariance))) / 5
    covariance += growth * size * _hardly_told(cells, growth)
    covariance = flattened @ covariance @ flattened.T
    covariance = (covariance + covariance.T) / 2
    # t and -t share their essential matrix: where one moves forwards, the other moves back.
    turned = lift(-residuals.tangents if flipped else residuals.tangents)
    covariance_6 = turned @ covariance @ turned.T
    basis = lift(sphere_tangents(t))
    return basis.T @ covariance_6 @ basis, covariance_6


def _flattened(H: Array, curvature: Array) -> Array | None:
    """
    Give what a pose moves by (5, 5) over what it would by H, the loss's weights (5, 5).

    A robust loss curves less than its weights say (Huber, Robust Statistics, section 7.6), and
    least along a direction that uncertain matches tell. None where it does not curve upwards.
    """
    root = np.linalg.cholesky(H)
    inverse = np.linalg.inv(root)
    shares, axes = np.linalg.eigh(inverse @ curvature @ inverse.T)
    if shares.sum() <= 0:
        return None
    return np.asarray(inverse.T @ (axes / np.maximum(shares, LEAST_CURVED)) @ axes.T @ root.T)


@dataclass(frozen=True)
class _Cells:
    """
    What the matches of C cells tell together.

    whole: (5, 5) H of all, and its inverse; places: (C, 2) pixels in them; sums: (27, C), one row
    after the other the upper triangle of H (5, 5) of their loss, its gradient (5,), how that
    changes where all residuals of a cell grow alike (5,), and their weighted residuals and
    weights.
    """

    whole: Array
    inverse: Array
    places: Array
    sums: Array

    @classmethod
    def of(cls, H: Array, places: Array, J: Array, weights: Array, r: Array) -> _Cells:
        """Sum matches at pixels (N, 2) by small cells, with their J (5, N), weights and r (N,)."""
        order, first = _by_cell(places, CELL)
        J, weights, r = J.take(order, axis=1), weights[order], r[order]
        weighed = J * weights
        rows, columns = _UPPER
        terms = np.concatenate([J[rows] * weighed[columns], weighed * r, weighed,
                                [weights * r, weights]])
        return cls(H, np.asarray(np.linalg.inv(H)),
                   (places[order[first]] // CELL + 0.5) * CELL,
                   np.add.reduceat(terms, first, axis=1))

    def in_larger(self, side: float) -> _Cells:
        """Give larger cells, each made of whole small ones; places are those of one of them."""
        side = max(side, CELL)
        order, first = _by_cell(self.places, side)
        return _Cells(self.whole, self.inverse, self.places[order[first]],
                      np.add.reduceat(self.sums.take(order, axis=1), first, axis=1))

    def __len__(self) -> int:
        return len(self.places)

    @cached_property
    def H(self) -> Array:
        """Give (C, 5, 5)."""
        return self.sums[_WHOLE].T.reshape(-1, 5, 5)

    @property
    def gradients(self) -> Array:
        """Give (5, C)."""
        return self.sums[15:20]

    @property
    def pulls(self) -> Array:
        """Give (5, C)."""
        return self.sums[20:25]

    @cached_property
    def without(self) -> Array | None:
        """
        Inverses (C, 5, 5) of what is left of the whole without each cell.

        None where cells are too few, or one alone decides.
        """
        if len(self) <= 5:  # so many are gone with the pose's own freedom
            return None
        # The traces bound the shares, to within rounding, and hardly any cell comes near to all.
        weighty = self.H[self.H.reshape(-1, 25) @ self.inverse.ravel() > _WEIGHTY]
        if len(weighty):
            whitening = np.linalg.inv(np.linalg.cholesky(self.whole))
            shares = np.linalg.eigvalsh(whitening @ weighty @ whitening.T)
            if (shares > 1 - _LEAST_SUPPORT).any():
                return None
        return np.asarray(np.linalg.inv(self.whole - self.H))

    def pairs(self) -> tuple[Array, Array]:
        """Sum products of residuals, of weights (2,) and of pulls (5, 5) within the same cell."""
        return (self.sums[25:]**2).sum(1), self.pulls @ self.pulls.T

    def size(self, moves: Array) -> float:
        """
        Size of the covariance that is told, over H^-1, on average over the five directions.

        moves: (5, C) of the pose without the matches of each cell. Where cells err by themselves,
        it is the same for any size of them: by (H - H_c)^-1 in place of H^-1 it has no bias (Bell
        and McCaffrey, Survey Methodology 2002).
        """
        return float((moves * self.gradients).sum()) / 5 + _LEAST_VARIANCE


def difference(R: Array, t: Array, other: Pose) -> Array:
    """
    How another motion differs (5,) from (R, t), in the parameters of a covariance of that.

    Matches tell t up to its sign, so it is the nearer of both signs that differs, by its chord.
    """
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
    return _lifted(covariance + probability * np.outer(apart, apart), t)


def widened(covariance: Array, t: Array, other: Array) -> tuple[Array, Array]:
    """
    Widen a covariance (5, 5) by that of another pose (6, 6), over (rotation vector, t).

    Where that may as well be the true one, which is spanned, the truth is as far from it as it
    says. Gives it as ``spanning`` does; as it was where the other is not determined.
    """
    if np.isfinite(other).all():
        basis = lift(sphere_tangents(t))
        covariance = covariance + basis.T @ other @ basis
    return _lifted(covariance, t)


def _lifted(covariance: Array, t: Array) -> tuple[Array, Array]:
    """Give a covariance (5, 5), and the same over (rotation vector, t), (6, 6)."""
    basis = lift(sphere_tangents(t))
    return covariance, basis @ covariance @ basis.T


def lift(tangents: Array) -> Array:
    """Lift (6, 5) of steps (rotation, two tangents) to (rotation, direction)."""
    lifted = np.zeros((6, 5))
    lifted[:3, :3], lifted[3:, 3:] = np.eye(3), tangents
    return lifted


def _jackknife(cells: _Cells, without: Array, moves: Array) -> Array:
    """
    Covariance (5, 5) from how far the pose would move without the matches of a cell, cell by cell.

    without: (C, 5, 5), see ``_Cells``; moves: (5, C). A delete-a-group jackknife, to first order
    (Bell and McCaffrey, Survey Methodology 2002). Where few cells decide about a direction, their
    moves say little; so the mean is taken of the moves that are seen and of those that noise would
    make, which are large there, at the size that has the seen ones on average.
    """
    seen = moves @ moves.T + _LEAST_VARIANCE * cells.inverse
    by_noise = without.sum(0) - len(cells) * cells.inverse
    by_noise *= np.trace(np.linalg.solve(by_noise, seen)) / 5
    return np.asarray((1 - 1 / len(cells)) * (seen + by_noise) / 2)


def _alike(cells: _Cells, by_itself: Array, size: float, noise: float) -> Array:
    """
    Covariance (5, 5) of what small cells err alike, over that of each by itself (5, 5).

    Residuals of pairs of cells are multiplied; as the pose follows what all have in common, too
    little is left of that, by what its covariance and its own share make of the pulls. The product
    over its weight falls with distance as `_FARTHER` has it; how large it is, one number, is told
    with an error that is about normal, and it is not below zero: of that the mean is taken, so
    that pairs are less sure where few cells tell it. noise: variance of a match, which bounds it.
    """
    larger = [cells, *(cells.in_larger(2 * CELL * 2**k) for k in range(len(_FARTHER)))]
    products, pulls = (np.diff(parts, axis=0) for parts in zip(*(one.pairs() for one in larger)))
    field = np.tensordot(_FARTHER, pulls, 1)
    left = cells.inverse @ field @ cells.inverse
    found = products[:, 0] + (pulls * by_itself).sum((1, 2))
    expected = _FARTHER * products[:, 1] - (pulls * left).sum((1, 2))
    weighed = expected / np.maximum(2 * size**2 * products[:, 1], 1e-300)
    known = float(weighed @ expected)
    if known <= 0:
        return np.zeros((5, 5))
    return min(_mean_above_zero(float(weighed @ found) / known, known**-0.5), noise) * left


def _mean_above_zero(value: float, deviation: float) -> float:
    """Give the mean of a normal distribution, cut off below zero."""
    x = value / deviation
    return float(value + deviation * np.exp(-x * x / 2 - log_ndtr(x)) / np.sqrt(2 * np.pi))


def _hardly_told(cells: _Cells, growth: float) -> Array:
    """
    Give by what (5, 5), over a size of one, few cells make a covariance less sure.

    growth: by what the variances grow as cells err alike; chosen: that leaves its root fewer.
    """
    shares = cells.inverse @ cells.H
    few = _LONG_TAILS * np.sqrt(growth) * (shares @ shares).sum(0)
    first, second, sixth = _HOTELLING
    square = few @ few
    return np.asarray((first * few + second * square + sixth * square @ square @ square)
                      @ cells.inverse)


def summed_by_cell(places: Array, values: Array) -> Array:
    """Sum values (V, N) of matches at pixels (N, 2) over the C small cells in use, (V, C)."""
    order, first = _by_cell(places, CELL)
    return np.asarray(np.add.reduceat(values.take(order, axis=1), first, axis=1))


def _by_cell(places: Array, side: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Give the order of points (N, 2) by cells of a side, and where each cell begins in that."""
    columns, rows = np.floor(places / side).astype(np.int64).T
    cell = columns * 2**32 + rows
    order = np.argsort(cell, kind='stable')
    return order, beginnings(cell[order])
