"""Covariance of the estimated pose."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from djet_ros import compiled
from djet_ros.core.cells import CELL, group_by_cell, in_few_bytes
from djet_ros.core.geometry import rotation_log, sphere_log, sphere_tangents
from djet_ros.core.jet import epipolar_residuals, JetProblem, LEAST_CURVATURE, Loss, Residuals
from djet_ros.core.sketch import moved_all, refine_all
from djet_ros.core.types import Array, Pose
import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, fdtri

# Number of large cells into which the matches are also divided: none of them may hold all
# information either.
LARGE_CELLS = 20

# Errors are most correlated where patches overlap. Pairs of matches are classed by the smallest
# cell that they share, of a side of 8, 16, 32, 64, 128, 256 or 512 pixels.
_SMALLEST_SIDE, _SIDE_COUNT = 8, 7

# Index of the small cells among these sides.
_SMALL_CELLS = (CELL // _SMALLEST_SIDE).bit_length() - 1

# chosen: decay of the error correlation from one side to the next, as the distance to the power of
# -1.5. On scenes rendered with seeds 0-4 residuals decorrelate faster from 32 pixels on, on KITTI
# more slowly up to 128; and errors common to the whole image do not show in them, as the pose
# absorbs these.
_DECAY = 2**-1.5

# Side index from which on the correlation is estimated in turn: from all pairs, from those that
# share no small cell, and then from farther and farther.
_FROM_SCALE = np.array([0, _SMALL_CELLS, _SMALL_CELLS + 1, _SMALL_CELLS + 2])

# Correlation (4, 6) relative to that side; nearer pairs are not used.
_DECAYS = np.where(np.arange(_SIDE_COUNT - 1) < _FROM_SCALE[:, None], 0.0,
                   _DECAY**(np.arange(_SIDE_COUNT - 1.0) - _FROM_SCALE[:, None]))

# Confidence at which bounds are those of Fisher's F of (5, v) in place of chi^2; it is the highest
# that is promised.
_CONFIDENCE = 0.999

# Quantiles of chi^2 with five degrees of freedom.
CHI2_999, _CHI2_95 = float(chdtri(5, 1 - _CONFIDENCE)), float(chdtri(5, 0.05))

# chosen: factor by which heavy tails reduce the degrees of freedom of a variance estimate; 1.5 for
# a kurtosis of 4 in place of 3.
_KURTOSIS_FACTOR = 1.5

# chosen: lower bound of the rise of the loss over that of its parabola, so that no standard
# deviation grows by a factor of more than 20.
_MIN_RISE = 0.05

# rad^2; a nanoradian, far below any noise, against division by zero on perfect data.
_MIN_VARIANCE = 1e-18

# rad; step of the differences of gradients: half of the digits of a float.
_DIFFERENCE = 1e-7

# Covariances of a pose that is not determined.
UNDETERMINED = np.full((5, 5), np.nan), np.full((6, 6), np.nan)
for _unknown in UNDETERMINED:
    _unknown.setflags(write=False)  # results share them

# Share of the information in any direction of the pose that has to remain without the matches of
# one cell.
_MIN_SUPPORT = 1e-6

# Indices of the upper triangle of a (5, 5), and for all 25 entries their position in it.
_UPPER = np.triu_indices(5)
_FULL = [i * (9 - i) // 2 + j for i, j in map(sorted, np.ndindex(5, 5))]

# chosen: least share of the variance by independent errors that correlated ones leave. Cells that
# pull in opposite directions make it less; but their correlation is a model, and a coarse one for
# errors that are no noise, as where the pose is not at the minimum: by it variances got negative.
_LEAST_LEFT = 0.01

# chosen: share of a cell in the information, summed over the five directions, from which on its
# eigenvalues are checked.
_HEAVY = 0.9


def pose_covariance(residuals: Residuals, loss: Loss, places: Array, t: Array,
                    flipped: bool, curved: Array | None = None) -> tuple[Array, Array]:
    """
    Return the covariance of (rotation vector in rad from the left, direction of t) at the minimum.

    places: (N, 2) pixels of the matches; t: (3,) the final direction, `flipped` if it is opposite
    to the optimiser's; curved: (5, 5) as of `curvature_at`, if known. Returns the covariance
    (5, 5) in the basis ``sphere_tangents(t)``, and (6, 6) over (rotation vector, t), of rank 5
    because t has unit length. All NaN if the matches do not determine the pose, if only those of
    one cell do, or if they lie in too few cells.

    The noise is estimated from the residuals, so it includes that of both images. Its size and
    shape come from a jackknife over small cells (`_jackknife`), the correlation of errors between
    cells from products of residuals (`_correlated`). A direction that few cells determine is
    widened for the small sample (`_small_sample_widening`).
    """
    J = residuals.jacobian
    squared = residuals.r**2
    _, weights = loss(squared)
    curved = curvature_at(residuals, loss) if curved is None else curved
    if curved is None:
        return UNDETERMINED
    H = (J * weights) @ J.T
    cells, pulls, products = _summed_by_cell(H, places, J, weights, residuals.r)
    large = cells.in_larger(max(np.sqrt(np.ptp(places, axis=0).prod() / LARGE_CELLS), CELL))
    if not (cells.determine_pose() and large.determine_pose()):
        return UNDETERMINED
    shifts, inverses_left = leave_one_out(H, cells.sums)
    size = cells.size(shifts)
    independent = _jackknife(cells, inverses_left, shifts)
    noise = float((weights * squared).sum() / weights.sum())
    covariance = _at_least(_LEAST_LEFT, independent, independent + _correlated(
        pulls, products, cells.inverse, independent, size, noise))
    # By rounding it may be less, if a direction is hardly determined.
    growth = max(float(np.trace(np.linalg.solve(independent, covariance))) / 5, 1.0)
    covariance += growth * size * _small_sample_widening(cells, growth)
    # Ratio of the step of a pose to that by H, in which the loss counts by its weights.
    flattened = np.linalg.solve(curved, H)
    covariance = flattened @ covariance @ flattened.T
    covariance = (covariance + covariance.T) / 2
    # t and -t have the same essential matrix: their tangents move in opposite directions.
    turned = lift(-residuals.tangents if flipped else residuals.tangents)
    covariance_6 = turned @ covariance @ turned.T
    basis = lift(sphere_tangents(t))
    return basis.T @ covariance_6 @ basis, covariance_6


def loss_hessian(problem: JetProblem, pose: Pose, residuals: Residuals, loss: Loss) -> Array:
    """
    Return half of the Hessian (5, 5) of the summed loss at its minimum, with these residuals.

    It includes their second derivatives. To J J^T the noise of a match along its epipolar line is
    parallax, and so information about t; the second derivatives take that off again. Of a slow
    camera along a wall, whose own parallax tells little of t, it would be most of the information.
    """
    def gradient(at: Residuals) -> Array:
        return at.jacobian @ (loss(at.r**2)[1] * at.r)

    none, basis, steps = gradient(residuals), residuals.tangents, _DIFFERENCE * np.eye(5)
    changes = np.empty((5, 5))
    for row, R, t in zip(changes, *moved_all(pose.R, pose.t, basis, steps)):
        moved = epipolar_residuals(problem, R, t)
        # In the tangents that the moved t has, which may be others.
        there = gradient(moved)
        row[:3], row[3:] = there[:3], basis.T @ moved.tangents @ there[3:]
    changes = (changes - none) / _DIFFERENCE
    return np.asarray(changes + changes.T) / 2


def widened_by_profile(covariance: Array, problem: JetProblem, pose: Pose, loss: Loss,
                       residuals: Residuals, curved: Array) -> Array:
    """
    Widen a covariance (5, 5) where the loss rises less than its curvature at the minimum predicts.

    Noise displaces a pose until the loss balances it, so the mean curvature on its path counts.
    A redescending loss flattens where matches become outliers, and few may determine a direction.
    So the loss is evaluated where each axis of the ellipsoid meets the 95 % bound, on both sides:
    if it has risen by a share of what a parabola would have on either side, the standard deviation
    is divided by that share. (Profile likelihoods, as in Bates and Watts, Nonlinear Regression
    Analysis, chapter 6.) residuals: those at the pose; curved: (5, 5), see `curvature_at`.
    """
    variances, axes = np.linalg.eigh(covariance)
    if variances[0] <= 0:
        return covariance
    ends = (axes * np.sqrt(_CHI2_95 * variances)).T
    displaced = map(Pose, *moved_all(pose.R, pose.t, residuals.tangents,
                                     np.concatenate([ends, -ends])))
    costs = refine_all(problem, [pose, *displaced], loss, 0).costs
    rises = (costs[1:] - costs[0]).reshape(2, 5).min(0)
    share = np.clip(rises / (ends @ curved * ends).sum(1), _MIN_RISE, 1.0)
    return np.asarray((axes * variances / share**2) @ axes.T)


def calibration_covariance(problem: JetProblem, K: Array, pose: Pose, residuals: Residuals,
                           loss: Loss, sigma: float, flipped: bool) -> Array:
    """
    Return the covariance (6, 6) over (rotation vector, t) due to errors of the camera matrix.

    residuals: those at the pose; sigma: standard deviation in pixels of the focal length (common
    to fx and fy), and of each coordinate of the principal point; flipped: whether t is opposite to
    that of the pose. If one of these is off by dk, residuals change by dr, and weighted least
    squares shifts the pose by -(J W J^T)^-1 J W dr (implicit function theorem at the minimum).
    """
    J = residuals.jacobian
    weighted = J * loss(residuals.r**2)[1]
    steps = np.zeros((3, 3, 3))
    steps[0, :2, :2], steps[1, 0, 2], steps[2, 1, 2] = sigma * np.eye(2), sigma, sigma
    changes = [epipolar_residuals(problem.with_camera(K, K + step), pose.R, pose.t).r - residuals.r
               for step in steps]
    shifts = np.linalg.solve(weighted @ J.T, weighted @ np.transpose(changes))
    lifted = lift(-residuals.tangents if flipped else residuals.tangents) @ shifts
    return np.asarray(lifted @ lifted.T)


def curvature_at(residuals: Residuals, loss: Loss, hessian: Array | None = None) -> Array | None:
    """
    Return the curvature (5, 5) of a loss at a pose, None if the matches do not determine that.

    Or if it is not positive by the inliers. hessian: (5, 5) as of `loss_hessian`, without the
    second derivatives of the residuals if None. They do not make a minimum of what is none by the
    inliers. And of a pose that was not optimised they may leave none, where the inliers have one
    nearby.
    """
    J, squared = residuals.jacobian, residuals.r**2
    H = (J * loss(squared)[1]) @ J.T
    if not np.isfinite(H).all():
        return None
    eigenvalues = np.linalg.eigvalsh(H)
    if eigenvalues[0] <= 1e-12 * eigenvalues[-1]:
        return None
    curved = _loss_curvature(H, (J * loss.curvature(squared)) @ J.T)
    if curved is None or hessian is None:
        return curved
    with_second = _loss_curvature(H, hessian)
    return curved if with_second is None else with_second


def _loss_curvature(H: Array, curvature: Array) -> Array | None:
    """
    Return the curvature (5, 5) of a loss from its Hessian and its weighted H, (5, 5) each.

    A robust loss curves less than its weights say (Huber, Robust Statistics, section 7.6), most of
    all in a direction that uncertain matches determine. None if the curvature is not positive.
    """
    root = np.asarray(np.linalg.cholesky(H))
    shares, at_least = _with_least(LEAST_CURVATURE, root, curvature)
    return at_least if shares.sum() > 0 else None


def _with_least(share: float, root: Array, matrix: Array) -> tuple[Array, Array]:
    """
    Return the shares (5,) of a matrix in another, and it with none of them below a least one.

    root: (5, 5), a square root C of the other one, C C^T; the shares are eigenvalues of the
    matrix whitened by it.
    """
    inverse = np.linalg.inv(root)
    shares, axes = np.linalg.eigh(inverse @ matrix @ inverse.T)
    half = root @ axes
    return shares, np.asarray((half * np.maximum(shares, share)) @ half.T)


@dataclass(frozen=True)
class _Cells:
    """
    Sums over the matches of C cells.

    H_of_all: (5, 5) H of all matches, and its inverse; places: (C, 2) pixels in the cells; sums:
    (27, C), by rows the upper triangle of H (5, 5) of the loss, its gradient (5,), the derivative
    of the gradient by a common shift of all residuals of the cell (5,), and the sums of the
    weighted residuals and of the weights.
    """

    H_of_all: Array
    inverse: Array
    places: Array
    sums: Array

    def in_larger(self, side: float) -> _Cells:
        """Merge the small cells into larger ones; places are those of one of them."""
        order, first = group_by_cell(self.places, side)
        return _Cells(self.H_of_all, self.inverse, self.places[order[first]],
                      np.add.reduceat(self.sums.take(order, axis=1), first, axis=1))

    def __len__(self) -> int:
        return len(self.places)

    @cached_property
    def H(self) -> Array:
        """Return H of each cell, (C, 5, 5)."""
        return self.sums[_FULL].T.reshape(-1, 5, 5)

    @property
    def gradients(self) -> Array:
        """Return the gradient of each cell, (5, C)."""
        return self.sums[15:20]

    def determine_pose(self) -> bool:
        """Return whether there are enough cells, and no single one is indispensable."""
        if len(self) <= 5:  # the pose has 5 degrees of freedom
            return False
        # The traces bound the eigenvalues, to within rounding, and are small for nearly all cells.
        heavy = self.H[self.H.reshape(-1, 25) @ self.inverse.ravel() > _HEAVY]
        if not len(heavy):
            return True
        whitening = np.linalg.inv(np.linalg.cholesky(self.H_of_all))
        shares = np.linalg.eigvalsh(whitening @ heavy @ whitening.T)
        return bool((shares <= 1 - _MIN_SUPPORT).all())

    def size(self, shifts: Array) -> float:
        """
        Return the ratio of the variances to H^-1, on average over the five directions.

        shifts: (5, C) shifts of the pose without the matches of each cell. If errors are
        independent between cells, it does not depend on the size of the cells: with (H - H_c)^-1
        in place of H^-1 it is unbiased (Bell and McCaffrey, Survey Methodology 2002).
        """
        return float((shifts * self.gradients).sum()) / 5 + _MIN_VARIANCE


def pose_difference(R: Array, t: Array, other: Pose) -> Array:
    """
    Return the difference (5,) of another motion from (R, t), in the parameters of its covariance.

    Matches determine t up to its sign, so the nearer of both signs counts, by its arc.
    """
    return np.asarray(pose_differences(R, t, other.R[None], other.t[None])[0])


def pose_differences(R: Array, t: Array, other_R: Array, other_t: Array) -> Array:
    """Return the differences (S, 5) of S motions, R (S, 3, 3) and t (S, 3), from one."""
    nearer = np.where(other_t @ t >= 0, 1.0, -1.0)[:, None] * other_t
    return signed_differences(R, t, other_R, nearer)


def signed_differences(R: Array, t: Array, other_R: Array, other_t: Array) -> Array:
    """
    Return the differences (..., 5) of motions whose signs of t are known from one, (R, t).

    other_R: (..., 3, 3); other_t: (..., 3). These are the parameters of all covariances (5, 5):
    the rotation vector from the left, and the arc of t.
    """
    return np.concatenate([rotation_log(other_R @ R.T), sphere_log(t, other_t)], axis=-1)


def squared_distance(covariance: Array, offset: Array) -> float:
    """Squared Mahalanobis distance of a difference of poses (5,); finite even for perfect data."""
    variances, axes = np.linalg.eigh(covariance)
    return float(((axes.T @ offset)**2 / np.maximum(variances, _MIN_VARIANCE)).sum())


def is_within(covariance: Array, offset: Array) -> bool:
    """Return whether a difference of poses (5,) is within the 99.9 % ellipsoid; no if unknown."""
    return bool(np.isfinite(covariance).all()) and squared_distance(covariance, offset) < CHI2_999


def widened_to_span(covariance: Array, offset: Array, probability: float) -> Array:
    """
    Widen a covariance (5, 5) by a rival at an offset (5,) that is true with a probability.

    Returns C + p a a^T, the expected squared error of the pose.
    """
    return np.asarray(covariance + probability * np.outer(offset, offset))


def widened(covariance: Array, t: Array, other: Array) -> Array:
    """
    Add to a covariance (5, 5) another one (6, 6) over (rotation vector, t), of independent errors.

    Such as that of the calibration; or that of a rival, which may be the true motion, and is as
    uncertain as its own covariance says. Unchanged if the other is not determined.
    """
    if not np.isfinite(other).all():
        return covariance
    basis = lift(sphere_tangents(t))
    return np.asarray(covariance + basis.T @ other @ basis)


def lifted_covariance(covariance: Array, t: Array) -> Array:
    """Return a covariance (5, 5) over (rotation vector, t), (6, 6) of rank 5."""
    basis = lift(sphere_tangents(t))
    return np.asarray(basis @ covariance @ basis.T)


def lift(tangents: Array) -> Array:
    """Return the matrix (6, 5) from (rotation, two tangents) to (rotation, direction)."""
    lifted = np.zeros((6, 5))
    lifted[:3, :3], lifted[3:, 3:] = np.eye(3), tangents
    return lifted


def _jackknife(cells: _Cells, inverses_left: Array, shifts: Array) -> Array:
    """
    Covariance (5, 5) by a delete-a-group jackknife over cells, to first order.

    inverses_left: (5, 5) sum of the inverses of H without each cell; shifts: (5, C) shifts of the
    pose without each cell (Bell and McCaffrey, Survey Methodology 2002). If few cells determine a
    direction, their shifts are a poor estimate; so the observed shifts are averaged with those
    expected from noise, which are large there, at the scale that matches the observed ones on
    average.
    """
    observed = shifts @ shifts.T + _MIN_VARIANCE * cells.inverse
    by_noise = inverses_left - len(cells) * cells.inverse
    by_noise *= np.trace(np.linalg.solve(by_noise, observed)) / 5
    return np.asarray((1 - 1 / len(cells)) * (observed + by_noise) / 2)


def _correlated(pulls: Array, products: Array, inverse: Array, independent: Array, size: float,
                noise: float) -> Array:
    """
    Covariance (5, 5) due to correlated errors of cells, in addition to that of independent ones.

    Errors of matches i and j at a distance d are modelled by E[r_i r_j] = a f(d), with f as in
    _DECAYS. The residuals are less correlated, as the pose absorbs what all have in common:

        E[r_i r_j] = a f(d) - J_i^T C J_j - a J_i^T H^-1 (sum_kl f w_k J_k J_l^T w_l) H^-1 J_j,

    with C the covariance of independent errors. Overlapping patches determine a best; then pairs
    farther and farther apart, by what exceeds the correlation already explained.

    pulls, products: of cells of each side, from the smallest on, see `sums_of_cells`; inverse:
    (5, 5) that of H; independent: the covariance C; size: see `_Cells.size`; noise: variance of a
    match, an upper bound of a.
    """
    pulls, products = np.diff(pulls, axis=0), np.diff(products, axis=0)
    observed = products[:, 0] + (pulls * independent).sum((1, 2))
    left = inverse @ _weighted_sum(_DECAYS, pulls) @ inverse
    expected = _DECAYS * products[:, 1] - left.reshape(-1, 25) @ pulls.reshape(-1, 25).T
    weighted = (_DECAYS > 0) * expected / np.maximum(2 * size**2 * products[:, 1], 1e-300)
    information, coefficients = (weighted * expected).sum(1), np.zeros(len(pulls))
    for nearest in np.flatnonzero(information > 0):
        coefficient = min(max(weighted[nearest] @ observed / information[nearest], 0.0), noise)
        coefficients += coefficient * _DECAYS[nearest]
        observed -= coefficient * expected[nearest]
    total = _weighted_sum(coefficients[_SMALL_CELLS:], pulls[_SMALL_CELLS:])
    return np.asarray(inverse @ total @ inverse)


def _at_least(share: float, independent: Array, covariance: Array) -> Array:
    """Return a covariance (5, 5), in no direction below a share of the independent one."""
    variances, axes = np.linalg.eigh(independent)
    root = axes * np.sqrt(np.maximum(variances, 1e-14 * variances[-1]))
    shares, at_least = _with_least(share, root, covariance)
    return covariance if shares[0] >= share else at_least


def _weighted_sum(shares: Array, parts: Array) -> Array:
    """Sum up parts (S, 5, 5) with weights (..., S), (..., 5, 5)."""
    return np.asarray(shares @ parts.reshape(-1, 25)).reshape(*shares.shape[:-1], 5, 5)


def _small_sample_widening(cells: _Cells, growth: float) -> Array:
    """
    Return the widening (5, 5), over a size of one, of a covariance that few cells determine.

    The variance is estimated from v errors, and the squared error over it follows Fisher's F of
    (5, v), whose bounds are wider than those of chi^2. C equal cells give v = 5 C errors; their
    squared shares of the whole sum up to 1 / C. growth: factor of the variances due to correlated
    errors; chosen: it reduces v by its square root.
    """
    root = np.linalg.cholesky(cells.inverse)
    # Shares of all cells, root^T H root, one below the other: two large products are three times
    # as fast as many small ones.
    half = (cells.H.reshape(-1, 5) @ root).reshape(-1, 5, 5)
    shares = half.transpose(0, 2, 1).reshape(-1, 5) @ root
    few, axes = np.linalg.eigh(_KURTOSIS_FACTOR * np.sqrt(growth) * (shares.T @ shares))
    # At least one degree of freedom.
    freedom = 5 / np.clip(few, 1e-9, 5.0)
    wider = 5 * fdtri(5, freedom, _CONFIDENCE) / CHI2_999
    turned = root @ axes
    return np.asarray((turned * (wider - 1)) @ turned.T)


def _summed_by_cell(H: Array, places: Array, J: Array, weights: Array, r: Array
                    ) -> tuple[_Cells, Array, Array]:
    """Return small cells, and pulls and products of cells of all sides: see `sums_of_cells`."""
    order, codes = _morton_order(places)
    sums, first, pulls, products = sums_of_cells(J, weights, r, order, codes)
    middles = (places[order[first]] // CELL + 0.5) * CELL
    return _Cells(H, np.asarray(np.linalg.inv(H)), middles, sums), pulls, products


def sums_of_cells(J: Array, weights: Array, r: Array, order: NDArray[np.int64],
                  codes: NDArray[np.uint64]) -> tuple[Array, NDArray[np.int64], Array, Array]:
    """
    Sum up the terms of matches over nested cells.

    J (5, N), weights and r (N,) of matches; order, codes: (N,) from `_morton_order`. Returns for
    small cells their sums (27, C), see `_Cells`, and the first (C,) of their matches in order; and
    for cells of each side, from the smallest on, sums of products: pulls (S, 5, 5) of the
    derivatives of the gradients by a common shift of a cell's residuals, and squares (S, 2) of
    weighted residuals and of weights.
    """
    if compiled.library is not None:
        return compiled.sums_of_cells(J, weights, r, order, codes, _SIDE_COUNT, _SMALL_CELLS)
    terms = _match_terms(J.take(order, axis=1), weights[order], r[order])
    # Two places are in the same cell of a side if their codes agree in all bits above it.
    differing = np.append(np.uint64(2**64 - 1), codes[1:] ^ codes[:-1])
    nested = [np.flatnonzero(differing >= 4**side) for side in range(_SIDE_COUNT)]
    by_side = [np.add.reduceat(terms[20:], first, axis=1) for first in nested]
    return (np.add.reduceat(terms, nested[_SMALL_CELLS], axis=1), nested[_SMALL_CELLS],
            np.array([sums[:5] @ sums[:5].T for sums in by_side]),
            np.array([(sums[5:]**2).sum(1) for sums in by_side]))


def leave_one_out(H: Array, sums: Array) -> tuple[Array, Array]:
    """
    Return the shifts of the pose without the matches of each of C cells, to first order.

    H: (5, 5) of all matches; sums: (27, C), see `_Cells`. H without any cell has to be positive
    definite. Returns the shifts (5, C), and the sum (5, 5) of the inverses of H without each cell.
    """
    if compiled.library is not None:
        return compiled.leave_one_out(H, sums)
    left = np.asarray(np.linalg.inv(H - sums[_FULL].T.reshape(-1, 5, 5)))
    return np.einsum('cij,jc->ic', left, sums[15:20]), left.sum(0)


def _match_terms(J: Array, weights: Array, r: Array) -> Array:
    """Return the terms (27, N) that ``_Cells`` sums up, from J (5, N), weights and r (N,)."""
    weighted, (rows, columns) = J * weights, _UPPER
    return np.concatenate([J[rows] * weighted[columns], weighted * r, weighted,
                           [weights * r, weights]])


def _morton_order(places: Array) -> tuple[NDArray[np.int64], NDArray[np.uint64]]:
    """
    Order points (N, 2) by nested cells; returns the order, and the sorted codes (N,).

    Along the Morton curve, which interleaves the bits of columns and rows, points of one cell of
    any side are contiguous.
    """
    cells = np.floor(places / _SMALLEST_SIDE).astype(np.int64)
    # Relative to the corner of a cell of the largest side, codes are short.
    cells -= cells.min(0) >> _SIDE_COUNT - 1 << _SIDE_COUNT - 1
    for shift, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        cells = (cells | cells << shift) & mask
    code = in_few_bytes(cells[:, 0] | cells[:, 1] << 1)
    order = np.argsort(code, kind='stable')
    return order, code[order].astype(np.uint64)
