"""
What residual surfaces tell of places, joined with where gray levels have them.

The sum of two residuals of the paper: that of the surface, and the re-projection error. Both
measure one place, with covariances S and T. Of two Gaussians that is the place

    y* - S (S + T)^-1 (y* - y)   with the covariance   S - S (S + T)^-1 S.
"""

from __future__ import annotations

from dataclasses import replace

from djet_ros.core.geometry import inverse_of, rays
from djet_ros.core.jet import (
    core_scale,
    entries,
    epipolar_residuals,
    JetProblem,
    Solution,
    spread_of_rays,
)
from djet_ros.core.paraboloid import median, quantile
from djet_ros.core.patches import Placed
from djet_ros.core.types import Array
import numpy as np

# chosen: by what S counts larger than it shows itself to be. A surface and gray levels see the
# same pixels, and their errors go together by a third. Where one errs 1.6 times as much as the
# other, that halves what it adds.
_TOGETHER = 2.0

# Square of what places by gray levels err, over what they say: it is about twice as much.
_PLACED = 4.0

# chosen: how much matches differ in noise, over what the places of each tell of it. What is wrong
# with both shows in no difference.
_SHARED = 2.0

# Share of an upper quartile below which a median is as good as nothing; far below what is seen.
_NOTHING = 1e-12


def with_places(problem: JetProblem, solution: Solution, K: Array, placed: Placed) -> JetProblem:
    """
    Join what residual surfaces tell of N matches with where gray levels have these.

    How exact each is, in all, it shows by its distances from the epipolar lines of the solution,
    which is that of the surfaces alone. How far both are apart tells the noise of the match
    itself: at the edge of what is near, they see different things. See `_noise_of_each`. What has
    no minimum stays as it is.
    """
    found = replace(problem, rays_y=rays(K, placed.places).T,
                    spread=spread_of_rays(K, entries(placed.covariances)),
                    blur=np.zeros(len(placed.places)))
    off = epipolar_residuals(found, solution.R, solution.t).r
    S, T = (core_scale(r)**2 * measured.spread
            for measured, r in ((problem, solution.residuals.r), (found, off)))
    has_minimum = (S[0] > 0) & (S[0] * S[2] > S[1]**2)
    there = np.flatnonzero(has_minimum)
    rays_y, joined = problem.rays_y.copy(), S.copy()
    way, joined[:, there] = join(*(values.take(there, axis=1) for values in (
        found.rays_y[:2] - rays_y[:2], S, T)))
    rays_y[:2, there] += way
    # Residuals are in pixels for a match of typical sharpness again.
    G = inverse_of(K)[:2, :2]
    width = np.trace(G @ G.T)
    spread = joined * (width / max(median(np.abs(joined[0] + joined[2])), 1e-300))
    blur = problem.blur * (np.abs(spread[0] + spread[2])
                           / np.maximum(np.abs(problem.spread[0] + problem.spread[2]), 1e-300))
    return replace(problem, rays_y=rays_y, spread=spread, blur=blur)


def join(apart: Array, S: Array, T: Array) -> tuple[Array, Array]:
    """
    Join two measurements of N places: by surfaces, with S (3, N), and by gray levels, with T.

    Covariances are given by their entries 11, 12, 22; apart: (2, N) from the former to the latter.
    Gives the way (2, N) from the former to the place, and its covariance; the noise of each is
    told by how far both are apart.
    """
    if not S.size:
        return apart, S
    S = _TOGETHER * S
    inverse = _inverse(S + T)
    way = _times(inverse, apart)
    left = S - np.array([_form(S[:2], inverse, S[:2]), _form(S[:2], inverse, S[1:]),
                         _form(S[1:], inverse, S[1:])])
    return _times(S, way), left * _noise_of_each((apart * way).sum(0))


def joined_places(minima: Array, spread: Array, placed: Placed) -> tuple[Array, Array]:
    """
    Join minima (N, 2) of surfaces with places by gray levels, where no pose tells how exact.

    spread: (N, 2, 2) covariances of the minima up to a common factor. How far both are apart tells
    that: what gray levels err for themselves, and what both err alike, come to about the same.
    Minima are not taken for more exact than gray levels. Gives the places (N, 2) and their
    covariances (N, 2, 2) in square pixels.
    """
    S, T = entries(spread), _PLACED * entries(placed.covariances)
    apart = (placed.places - minima).T
    if len(minima):
        squared = (apart * _times(_inverse(S), apart)).sum(0)
        S = S * max(median(squared) / (2 * np.log(2)),
                    median(T[0] + T[2]) / median(S[0] + S[2]))
    way, joined = join(apart, S, T)
    return minima + way.T, joined[[0, 1, 1, 2]].T.reshape(-1, 2, 2)


def _inverse(S: Array) -> Array:
    """Entries 11, 12, 22 (3, N) of the inverses of symmetric matrices, given by theirs."""
    area = S[0] * S[2] - S[1]**2
    # Exact matches have no area at all.
    return np.array([S[2], -S[1], S[0]]) / np.where(area != 0, area, 1e-300)


def _times(S: Array, v: Array) -> Array:
    """Products (2, N) of symmetric matrices, by their entries (3, N), and vectors (2, N)."""
    return np.asarray(S[:2] * v[0] + S[1:] * v[1])


def _form(u: Array, S: Array, v: Array) -> Array:
    """Values u^T S v (N,) of vectors (2, N) and matrices by their entries (3, N)."""
    return np.asarray((u * _times(S, v)).sum(0))


def _noise_of_each(squared: Array) -> Array:
    """
    Give the noise (N,), over the usual, of matches whose two places are d^2 (N,) apart.

    Where the noise differs from match to match like an inverse gamma of nu degrees of freedom,
    errors are those of a Student distribution: a share p of all d^2 is below
    nu ((1 - p)^(-2 / nu) - 1), so that the upper quartile over the median is 2^(2 / nu) + 1, and
    the noise of one is expected to be (nu + d^2) / (nu + 2). Where all are alike, the ratio is
    two.
    """
    middle, upper = median(squared), quantile(squared, 0.75)
    ratio = upper / max(middle, _NOTHING * upper, 1e-300)
    unlike = np.log2(max(ratio - 1, 1.0)) * _SHARED  # 2 / nu
    return np.asarray((1 + unlike / 2 * squared) / (1 + unlike))
