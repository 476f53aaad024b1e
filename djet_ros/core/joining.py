"""
Fusion of each match's minimum on its residual surface with its position by patch alignment.

An addition to the paper. Both measure one position: the minimum y* with covariance S, and the
aligned y with covariance T. The sum of their squared residuals is, up to a constant, that of

    y* - S (S + T)^-1 (y* - y)   with the covariance   S - S (S + T)^-1 S.
"""

from __future__ import annotations

from dataclasses import replace

from djet_ros.core.geometry import inverse_intrinsics, rays
from djet_ros.core.jet import (
    clipped_scale,
    entries,
    epipolar_residuals,
    JetProblem,
    ray_covariances,
    Solution,
)
from djet_ros.core.medians import median, quantile
from djet_ros.core.patches import Aligned
from djet_ros.core.types import Array
import numpy as np

# chosen: inflation of S for correlated errors. A surface and gray levels see the same pixels, and
# their errors have a correlation of a third. If one has 1.6 times the error of the other, this
# halves its weight.
_CORRELATION_INFLATION = 2.0

# Ratio of the actual variance of aligned positions to the one that they state: their errors are
# about twice as large.
_ALIGNMENT_INFLATION = 4.0

# chosen: heterogeneity of the noise over matches, relative to what the difference of the two
# positions shows. Errors common to both do not show in it.
_HETEROGENEITY = 2.0

# Share of the upper quartile below which a median counts as zero; far below observed ones.
_NEGLIGIBLE = 1e-12


def fuse_alignment(problem: JetProblem, solution: Solution, K: Array, placed: Aligned
                   ) -> JetProblem:
    """
    Fuse the N surface measurements of a problem with patch alignment.

    The absolute scale of each covariance is estimated from its distances to the epipolar lines of
    the solution, which is that of the surfaces alone. The difference of the two positions
    estimates the noise of each match: at the edge of near objects they see different things. See
    `_relative_noise`. Matches without a minimum stay unchanged.
    """
    aligned = replace(problem, rays_y=rays(K, placed.places).T,
                      covariances=ray_covariances(K, entries(placed.covariances)),
                      blur=np.zeros(len(placed.places)))
    residuals = epipolar_residuals(aligned, solution.R, solution.t).r
    S, T = (clipped_scale(r)**2 * measured.covariances
            for measured, r in ((problem, solution.residuals.r), (aligned, residuals)))
    indices = np.flatnonzero((S[0] > 0) & (S[0] * S[2] > S[1]**2))  # matches with a minimum
    rays_y, fused = problem.rays_y.copy(), S.copy()
    shifts, fused[:, indices] = fuse(*(values.take(indices, axis=1) for values in (
        aligned.rays_y[:2] - rays_y[:2], S, T)))
    rays_y[:2, indices] += shifts
    # Residuals are in pixels for a match of median curvature again.
    G = inverse_intrinsics(K)[:2, :2]
    width = np.trace(G @ G.T)
    covariances = fused * (width / max(median(np.abs(fused[0] + fused[2])), 1e-300))
    before, after = (np.abs(S[0] + S[2]) for S in (problem.covariances, covariances))
    blur = problem.blur * (after / np.maximum(before, 1e-300))
    return replace(problem, rays_y=rays_y, covariances=covariances, blur=blur)


def fuse(differences: Array, S: Array, T: Array) -> tuple[Array, Array]:
    """
    Fuse two measurements of N positions: by surfaces, with S (3, N), and by alignment, with T.

    Covariances are given as entries 11, 12, 22; differences: (2, N) from the former to the latter.
    Returns the displacement (2, N) from the former to the fused position, and its covariance (3,
    N), scaled by the noise of each match.
    """
    if not S.size:
        return differences, S
    S = _CORRELATION_INFLATION * S
    inverse = _inverse(S + T)
    pull = _multiply(inverse, differences)
    fused = S - np.array([_form(S[:2], inverse, S[:2]), _form(S[:2], inverse, S[1:]),
                         _form(S[1:], inverse, S[1:])])
    return _multiply(S, pull), fused * _relative_noise((differences * pull).sum(0))


def fuse_positions(minima: Array, covariances: Array, placed: Aligned) -> tuple[Array, Array]:
    """
    Fuse minima (N, 2) of surfaces with aligned positions, without a pose to calibrate them by.

    covariances: (N, 2, 2) covariances of the minima up to a common factor, which is estimated from
    the differences of both positions. These contain the alignment's errors, but not those common
    to both; the two are taken to cancel. Minima are not taken for more accurate than alignment.
    Returns positions (N, 2) and covariances (N, 2, 2) in square pixels.
    """
    S, T = entries(covariances), _ALIGNMENT_INFLATION * entries(placed.covariances)
    differences = (placed.places - minima).T
    if len(minima):
        squared = (differences * _multiply(_inverse(S), differences)).sum(0)
        S = S * max(median(squared) / (2 * np.log(2)),
                    median(T[0] + T[2]) / median(S[0] + S[2]))
    shifts, fused = fuse(differences, S, T)
    return minima + shifts.T, fused[[0, 1, 1, 2]].T.reshape(-1, 2, 2)


def _inverse(S: Array) -> Array:
    """Return the entries 11, 12, 22 (3, N) of the inverses of symmetric matrices, from theirs."""
    area = S[0] * S[2] - S[1]**2
    # Exact matches have a singular covariance.
    return np.array([S[2], -S[1], S[0]]) / np.where(area != 0, area, 1e-300)


def _multiply(S: Array, v: Array) -> Array:
    """Multiply symmetric matrices, by their entries (3, N), with vectors (2, N)."""
    return np.asarray(S[:2] * v[0] + S[1:] * v[1])


def _form(u: Array, S: Array, v: Array) -> Array:
    """Return the values u^T S v (N,) of vectors (2, N) and matrices by their entries (3, N)."""
    return np.asarray((u * _multiply(S, v)).sum(0))


def _relative_noise(squared: Array) -> Array:
    """
    Return the expected noise variance (N,) of matches, relative, by their squared differences d^2.

    Model: the variance of a match is inverse-gamma distributed with nu degrees of freedom, so
    errors follow a Student distribution. A share p of all d^2 is below nu ((1 - p)^(-2 / nu) - 1),
    so that the upper quartile over the median is 2^(2 / nu) + 1, and the posterior variance of a
    match is (nu + d^2) / (nu + 2). With equal variances the ratio is two.
    """
    middle, upper = median(squared), quantile(squared, 0.75)
    ratio = upper / max(middle, _NEGLIGIBLE * upper, 1e-300)
    variation = np.log2(max(ratio - 1, 1.0)) * _HETEROGENEITY  # 2 / nu
    return np.asarray((1 + variation / 2 * squared) / (1 + variation))
