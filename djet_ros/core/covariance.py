"""Covariance of the estimated pose."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from djet_ros import compiled
from djet_ros.core.cells import by_cell, CELL, short
from djet_ros.core.geometry import rotation_log, sphere_tangents
from djet_ros.core.jet import (
    epipolar_residuals,
    JetProblem,
    LEAST_CURVED,
    Loss,
    Residuals,
)
from djet_ros.core.sketch import moved_all, refine_all
from djet_ros.core.types import Array, Pose
import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, fdtri

# Into so many cells the matches are cut too: none of these may hold all that is known either.
LARGE_CELLS = 20

# Matches err alike most where their patches overlap: pairs are told apart by whether they share a
# cell of 8, 16, 32, 64, 128, 256 or 512 pixels, and not the one before.
_SMALLEST, _SIDES = 8, 7

# Of these, the one of small cells.
_SMALL = (CELL // _SMALLEST).bit_length() - 1

# Chosen: what matches err alike falls by so much from one of these to the next, as the distance to
# the power of -1.5. On scenes rendered with seeds 0-4 residuals fall faster from 32 on; but what
# stays the same over the whole image is not seen in them, as the pose follows it.
_FALL = 2**-1.5

# From which of them on it is told in turn: from all, from those that no small cell holds, and then
# from farther and farther.
_TOLD_FROM = np.array([0, _SMALL, _SMALL + 1, _SMALL + 2])

# By what it falls from there on (4, 6); nothing is told of what is nearer.
_FALLS = np.where(np.arange(_SIDES - 1) < _TOLD_FROM[:, None], 0.0,
                  _FALL**(np.arange(_SIDES - 1.0) - _TOLD_FROM[:, None]))

# Squared Mahalanobis distance, over five degrees of freedom, that one pose of a thousand exceeds.
SURPRISING = 20.5

# Bound of chi^2 in five directions that holds 95 %.
_BOUND = float(chdtri(5, 0.05))

# At this probability, the most that is promised, bounds are those of Fisher's F of (5, v), and of
# chi^2 where v is large.
_TOLD_AT = 0.999
_BOUND_TOLD = float(chdtri(5, 1 - _TOLD_AT))

# chosen: errors with longer tails than normal ones tell a variance as fewer of those would; 1.5
# times fewer where the kurtosis is 4, not 3.
_LONG_TAILS = 1.5

# chosen: no direction is taken to be told more than twenty times as badly as the curvature says.
_LEAST_RISE = 0.05

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
    if not np.isfinite(H).all():
        return UNKNOWN
    told = np.linalg.eigvalsh(H)
    if told[0] <= 1e-12 * told[-1]:
        return UNKNOWN
    curved = _curved(H, (J * loss.curvature(squared)) @ J.T)
    cells, pulls, products = _summed_up(H, places, J, weights, residuals.r)
    large = cells.in_larger(max(np.sqrt(np.ptp(places, axis=0).prod() / LARGE_CELLS), CELL))
    if curved is None or not (cells.suffice() and large.suffice()):
        return UNKNOWN
    moves, without = without_each(H, cells.sums)
    size = cells.size(moves)
    by_itself = _jackknife(cells, without, moves)
    noise = float((weights * squared).sum() / weights.sum())
    covariance = by_itself + _alike(pulls, products, cells.inverse, by_itself, size, noise)
    growth = float(np.trace(np.linalg.solve(by_itself, covariance))) / 5
    covariance += growth * size * _hardly_told(cells, growth)
    # What a pose moves by over what it would by H, the loss's weights.
    flattened = np.linalg.solve(curved, H)
    covariance = flattened @ covariance @ flattened.T
    covariance = (covariance + covariance.T) / 2
    # t and -t share their essential matrix: where one moves forwards, the other moves back.
    turned = lift(-residuals.tangents if flipped else residuals.tangents)
    covariance_6 = turned @ covariance @ turned.T
    basis = lift(sphere_tangents(t))
    return basis.T @ covariance_6 @ basis, covariance_6


def as_far_as_claimed(covariance: Array, problem: JetProblem, pose: Pose, loss: Loss,
                      residuals: Residuals | None = None) -> tuple[Array, Array]:
    """
    Widen a covariance (5, 5) where the loss does not rise as its curvature at the minimum says.

    Noise pulls a pose until the loss pulls back as much, so that it goes by the mean curvature on
    its way. A loss that redescends bends where matches cease to agree, and those that decide about
    a direction may be few. So the loss is looked at where each axis of the ellipsoid meets the
    bound of 95 %, on both sides: where on one of them it has risen by a share of what a parabola
    would have, the pose is off by the inverse of that share. (As profiles of the likelihood are
    held against their parabolas: Bates and Watts, Nonlinear Regression Analysis, chapter 6.)
    residuals: those at the pose, where they are known. Gives it with that over (rotation vector,
    t), (6, 6).
    """
    residuals = residuals or epipolar_residuals(problem, pose.R, pose.t)
    J, squared = residuals.jacobian, residuals.r**2
    curved = _curved((J * loss(squared)[1]) @ J.T, (J * loss.curvature(squared)) @ J.T)
    variances, axes = np.linalg.eigh(covariance)
    if curved is None or variances[0] <= 0:
        return _lifted(covariance, pose.t)
    ways = (axes * np.sqrt(_BOUND * variances)).T
    around = map(Pose, *moved_all(pose.R, pose.t, residuals.tangents,
                                  np.concatenate([ways, -ways])))
    costs = refine_all(problem, [pose, *around], loss, 0).costs
    rises = (costs[1:] - costs[0]).reshape(2, 5).min(0)
    share = np.clip(rises / (ways @ curved * ways).sum(1), _LEAST_RISE, 1.0)
    return _lifted((axes * variances / share**2) @ axes.T, pose.t)


def by_calibration(problem: JetProblem, K: Array, pose: Pose, residuals: Residuals, loss: Loss,
                   sigma: float) -> Array:
    """
    Covariance (6, 6) over (rotation vector, t) that errors of the camera matrix bring about.

    residuals: those at the pose; sigma: standard deviation in pixels of the focal length, in which
    fx and fy err together, and of either coordinate of the principal point. Where one of these is
    off by dk, residuals change by dr, and weighted least squares moves the pose by
    -(J W J^T)^-1 J W dr (the implicit function theorem on the minimum).
    """
    J = residuals.jacobian
    weighed = J * loss(residuals.r**2)[1]
    steps = np.zeros((3, 3, 3))
    steps[0, :2, :2], steps[1, 0, 2], steps[2, 1, 2] = sigma * np.eye(2), sigma, sigma
    changes = [epipolar_residuals(problem.seen_with(K, K + step), pose.R, pose.t).r - residuals.r
               for step in steps]
    moves = np.linalg.solve(weighed @ J.T, weighed @ np.transpose(changes))
    lifted = lift(residuals.tangents) @ moves
    return np.asarray(lifted @ lifted.T)


def _curved(H: Array, curvature: Array) -> Array | None:
    """
    Give how a loss curves (5, 5), by its second derivatives (5, 5) and its weights H (5, 5).

    A robust loss curves less than its weights say (Huber, Robust Statistics, section 7.6), and
    least along a direction that uncertain matches tell. None where it does not curve upwards.
    """
    root = np.linalg.cholesky(H)
    inverse = np.linalg.inv(root)
    shares, axes = np.linalg.eigh(inverse @ curvature @ inverse.T)
    if shares.sum() <= 0:
        return None
    half = root @ axes
    return np.asarray((half * np.maximum(shares, LEAST_CURVED)) @ half.T)


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

    def in_larger(self, side: float) -> _Cells:
        """Give larger cells, each made of whole small ones; places are those of one of them."""
        order, first = by_cell(self.places, side)
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

    def suffice(self) -> bool:
        """Tell whether there are enough cells, and something is left without any one of them."""
        if len(self) <= 5:  # so many are gone with the pose's own freedom
            return False
        # The traces bound the shares, to within rounding, and hardly any cell comes near to all.
        weighty = self.H[self.H.reshape(-1, 25) @ self.inverse.ravel() > _WEIGHTY]
        if not len(weighty):
            return True
        whitening = np.linalg.inv(np.linalg.cholesky(self.whole))
        shares = np.linalg.eigvalsh(whitening @ weighty @ whitening.T)
        return bool((shares <= 1 - _LEAST_SUPPORT).all())

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
    return np.asarray(differences(R, t, other.R[None], other.t[None])[0])


def differences(R: Array, t: Array, other_R: Array, other_t: Array) -> Array:
    """Give how S motions, R (S, 3, 3) and t (S, 3), differ from one in that way, (S, 5)."""
    towards = np.where(other_t @ t >= 0, 1.0, -1.0)[:, None] * other_t - t
    return np.concatenate([rotation_log(other_R @ R.T), towards @ sphere_tangents(t)], axis=1)


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
    Widen a covariance (5, 5) by another one (6, 6), over (rotation vector, t), of what errs too.

    That is what a calibration does; and a rival, which is spanned and may as well be the true
    motion, is as far from the truth as its own covariance says. Gives it as ``spanning`` does; as
    it was where the other is not determined.
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

    without: (5, 5) sum of the inverses of what is left without each cell; moves: (5, C) of the
    pose without its matches. A delete-a-group jackknife, to first order
    (Bell and McCaffrey, Survey Methodology 2002). Where few cells decide about a direction, their
    moves say little; so the mean is taken of the moves that are seen and of those that noise would
    make, which are large there, at the size that has the seen ones on average.
    """
    seen = moves @ moves.T + _LEAST_VARIANCE * cells.inverse
    by_noise = without - len(cells) * cells.inverse
    by_noise *= np.trace(np.linalg.solve(by_noise, seen)) / 5
    return np.asarray((1 - 1 / len(cells)) * (seen + by_noise) / 2)


def _alike(pulls: Array, products: Array, inverse: Array, by_itself: Array, size: float,
           noise: float) -> Array:
    """
    Covariance (5, 5) of what small cells err alike, over that of each by itself (5, 5).

    Errors of matches i and j at a distance d are taken to have E[r_i r_j] = a f(d), with f as in
    _FALLS. Of residuals less is left, as the pose follows what all have in common:

        E[r_i r_j] = a f(d) - J_i^T C J_j - a J_i^T H^-1 (sum_kl f w_k J_k J_l^T w_l) H^-1 J_j,

    with C the covariance of each by itself. How large a is, is told best by patches that overlap;
    then by pairs farther and farther apart, whether there is more between these than that lets
    expect.

    pulls, products: of cells of each side, from the smallest on, see `sums_of_cells`; inverse:
    (5, 5) that of H; noise: variance of a match, which bounds what is told.
    """
    pulls, products = np.diff(pulls, axis=0), np.diff(products, axis=0)
    found = products[:, 0] + (pulls * by_itself).sum((1, 2))
    left = inverse @ _in_all(_FALLS, pulls) @ inverse
    expected = _FALLS * products[:, 1] - left.reshape(-1, 25) @ pulls.reshape(-1, 25).T
    weighed = (_FALLS > 0) * expected / np.maximum(2 * size**2 * products[:, 1], 1e-300)
    known, amounts = (weighed * expected).sum(1), np.zeros(len(pulls))
    for nearest in np.flatnonzero(known > 0):
        amount = min(max(weighed[nearest] @ found / known[nearest], 0.0), noise)
        amounts += amount * _FALLS[nearest]
        found -= amount * expected[nearest]
    return np.asarray(inverse @ _in_all(amounts[_SMALL:], pulls[_SMALL:]) @ inverse)


def _in_all(shares: Array, parts: Array) -> Array:
    """Sum up shares (..., S) of parts (S, 5, 5), (..., 5, 5)."""
    return np.asarray(shares @ parts.reshape(-1, 25)).reshape(*shares.shape[:-1], 5, 5)


def _hardly_told(cells: _Cells, growth: float) -> Array:
    """
    Give by what (5, 5), over a size of one, few cells make a covariance less sure.

    How large the noise is, v errors tell, and the squared error over what they say is Fisher's F
    of (5, v), whose bounds are wider than those of chi^2. C cells that are alike tell v = 5 C
    errors; their shares of the whole, squared and summed up, are 1 / C. growth: by what the
    variances grow as cells err alike; chosen: that leaves its root fewer.
    """
    root = np.linalg.cholesky(cells.inverse)
    shares = root.T @ cells.H @ root
    few, axes = np.linalg.eigh(_LONG_TAILS * np.sqrt(growth) * (shares @ shares).sum(0))
    # One error is the least that tells a variance.
    told = 5 / np.clip(few, 1e-9, 5.0)
    wider = 5 * fdtri(5, told, _TOLD_AT) / _BOUND_TOLD
    half = root @ axes
    return np.asarray((half * (wider - 1)) @ half.T)


def _summed_up(H: Array, places: Array, J: Array, weights: Array, r: Array
               ) -> tuple[_Cells, Array, Array]:
    """Give small cells, and pulls and products of cells of all sides: see `sums_of_cells`."""
    order, codes = _along_curve(places)
    sums, first, pulls, products = sums_of_cells(J, weights, r, order, codes)
    middles = (places[order[first]] // CELL + 0.5) * CELL
    return _Cells(H, np.asarray(np.linalg.inv(H)), middles, sums), pulls, products


def sums_of_cells(J: Array, weights: Array, r: Array, order: NDArray[np.int64],
                  codes: NDArray[np.uint64]) -> tuple[Array, NDArray[np.int64], Array, Array]:
    """
    Sum up what matches tell by cells in cells.

    J (5, N), weights and r (N,) of matches; order, codes: (N,) from `_along_curve`. Gives of small
    cells their sums (27, C), see `_Cells`, and the first (C,) of their matches in order. And of
    cells of each side, from the smallest on, sums of products: pulls (S, 5, 5) of how gradients
    change where all residuals of a cell grow alike, and squares (S, 2) of weighted residuals and
    of weights.
    """
    if compiled.library is not None:
        return compiled.sums_of_cells(J, weights, r, order, codes, _SIDES, _SMALL)
    terms = _terms(J.take(order, axis=1), weights[order], r[order])
    # Cells of a side are the same where all bits above those of the places in them are.
    differing = np.append(np.uint64(2**64 - 1), codes[1:] ^ codes[:-1])
    nested = [np.flatnonzero(differing >= 4**side) for side in range(_SIDES)]
    by_side = [np.add.reduceat(terms[20:], first, axis=1) for first in nested]
    return (np.add.reduceat(terms, nested[_SMALL], axis=1), nested[_SMALL],
            np.array([sums[:5] @ sums[:5].T for sums in by_side]),
            np.array([(sums[5:]**2).sum(1) for sums in by_side]))


def without_each(whole: Array, sums: Array) -> tuple[Array, Array]:
    """
    Tell how a pose would move without the matches of each of C cells, to first order.

    whole: (5, 5) H of all; sums: (27, C), see `_Cells`; what is left of H without any of them is
    positive definite. Gives moves (5, C), and the sum (5, 5) of the inverses of what is left.
    """
    if compiled.library is not None:
        return compiled.without_each(whole, sums)
    left = np.asarray(np.linalg.inv(whole - sums[_WHOLE].T.reshape(-1, 5, 5)))
    return np.einsum('cij,jc->ic', left, sums[15:20]), left.sum(0)


def _terms(J: Array, weights: Array, r: Array) -> Array:
    """Give what ``_Cells`` sums up (27, N) of matches, by their J (5, N), weights and r (N,)."""
    weighed, (rows, columns) = J * weights, _UPPER
    return np.concatenate([J[rows] * weighed[columns], weighed * r, weighed,
                           [weights * r, weights]])


def _along_curve(places: Array) -> tuple[NDArray[np.int64], NDArray[np.uint64]]:
    """
    Order points (N, 2) by cells in cells in cells; gives that, and codes (N,) of these in it.

    Along Morton's curve, which interleaves the bits of columns and rows, points of one cell of any
    of the sides come one after the other.
    """
    cells = np.floor(places / _SMALLEST).astype(np.int64)
    # From the corner of one of the largest on, codes are short.
    cells -= cells.min(0) >> _SIDES - 1 << _SIDES - 1
    for shift, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        cells = (cells | cells << shift) & mask
    code = short(cells[:, 0] | cells[:, 1] << 1)
    order = np.argsort(code, kind='stable')
    return order, code[order].astype(np.uint64)
