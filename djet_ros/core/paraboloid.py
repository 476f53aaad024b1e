"""
Local paraboloids: the quadratic fit of the paper's Appendix, and their minima on epipolar lines.

A paraboloid is Q(v) = v^T A' v + 2 v^T b + c with v relative to its centre, in pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, reduce
from typing import Any

from djet_ros.core.geometry import inverses
from djet_ros.core.medians import median
from djet_ros.core.types import Array
import numpy as np
from numpy.typing import NDArray

# Floor of the eigenvalues of projected paraboloids, as a share of the median of all: a flat
# direction stays weak but invertible.
_CURVATURE_FLOOR = 0.02


@dataclass(frozen=True)
class Paraboloids:
    """
    One paraboloid per match: v^T A' v + 2 v^T b + c with v = y - centre.

    centres: (N, 2) pixels; A: (N, 2, 2) per square pixel; b: (N, 2) per pixel; c: (N,). usable:
    (N,) bool, False if there is no paraboloid, and A, b, c are meaningless.
    """

    centres: Array
    A: Array
    b: Array
    c: Array
    usable: NDArray[np.bool_]

    def minima(self) -> Array:
        """Return the stationary points y* = centre - A'^-1 b (N, 2)."""
        return np.asarray(self.centres + self.minimum_offsets)

    @cached_property
    def inverses(self) -> Array:
        """Return the inverse of each A, (N, 2, 2)."""
        return inverse_2x2(self.A)

    @cached_property
    def minimum_offsets(self) -> Array:
        """Return the displacements (N, 2) from the centres to the minima."""
        return -times(self.inverses, self.b)

    def of(self, chosen: NDArray[Any]) -> Paraboloids:
        """Return a subset, by a mask (N,) bool or indices."""
        # np.take is three to six times as fast as indexing for arrays of several axes.
        places = np.arange(len(self.c))[chosen]
        subset = Paraboloids(*(values.take(places, axis=0) for values in (
            self.centres, self.A, self.b, self.c, self.usable)))
        # Cached properties are kept.
        vars(subset).update((name, value.take(places, axis=0))
                            for name, value in vars(self).items()
                            if name in ('inverses', 'minimum_offsets'))
        return subset

    def minimum_within(self, radius: float) -> NDArray[np.bool_]:
        """Return a mask (N,) of those with a minimum within `radius` along either axis."""
        return np.asarray(largest(self.minimum_offsets) <= radius)

    def values(self, y: Array) -> Array:
        """Evaluate the paraboloids at pixels y (N, 2); returns (N,)."""
        v = y - self.centres
        return np.asarray(np.einsum('ni,ni->n', v, times(self.A, v) + 2 * self.b) + self.c)


@lru_cache(maxsize=32)
def fit_operator(window: int, sigma: float) -> Array:
    """
    Return the least-squares operator (6, window^2) of z = D a (Appendix), samples row-major.

    The coefficients a are a_11, a_22, a_12, a_1, a_2, a_0. With sigma > 0 pixels, samples have
    Gaussian weights: the outer part of a Hamming surface is not quadratic.
    """
    radius = window // 2
    x2, x1 = np.mgrid[-radius:radius + 1, -radius:radius + 1].reshape(2, -1).astype(float)
    D = np.stack([x1**2, x2**2, x1 * x2, x1, x2, np.ones_like(x1)], axis=1)
    root = np.exp(-(x1**2 + x2**2) / (4 * sigma**2)) if sigma > 0 else np.ones_like(x1)
    operator = np.linalg.pinv(D * root[:, None]) * root
    operator.setflags(write=False)
    return np.asarray(operator)


def fit_paraboloids(surfaces: NDArray[Any], centres: Array, sigma: float) -> Paraboloids:
    """Fit paraboloids to sampled surfaces (P, P, N), indexed [v_y, v_x, k], at centres (N, 2)."""
    window, _, count = surfaces.shape
    a = fit_operator(window, sigma) @ surfaces.reshape(window**2, count).astype(float)
    a11, a22, a12, a1, a2, a0 = a
    A = np.stack([a11, a12 / 2, a12 / 2, a22], axis=1).reshape(-1, 2, 2)
    return Paraboloids(centres, A, np.stack([a1, a2], axis=1) / 2, a0, np.ones(count, bool))


def indefinite(paraboloids: Paraboloids) -> NDArray[np.bool_]:
    """Return a mask (N,) of the paraboloids without a minimum."""
    A = paraboloids.A
    determinant = A[:, 0, 0] * A[:, 1, 1] - A[:, 0, 1]**2
    return np.asarray((determinant <= 0) | (A[:, 0, 0] + A[:, 1, 1] <= 0))


def project_to_positive(paraboloids: Paraboloids) -> Paraboloids:
    """Raise the eigenvalues of A' to a small positive floor: every surface gets a minimum."""
    A = paraboloids.A
    mean = (A[:, 0, 0] + A[:, 1, 1]) / 2
    spread = np.hypot((A[:, 0, 0] - A[:, 1, 1]) / 2, A[:, 0, 1])
    # The entries of unusable paraboloids are left out.
    eigenvalues = np.concatenate([mean - spread, mean + spread])[np.tile(paraboloids.usable, 2)]
    positive = eigenvalues[eigenvalues > 0]
    floor = _CURVATURE_FLOOR * (median(positive) if len(positive) else 1.0)
    low = np.flatnonzero(mean - spread < floor)
    if not len(low):
        return paraboloids
    least, most = (mean - spread)[low], (mean + spread)[low]
    # The projection onto the weak direction is (most I - A) / (most - least).
    both_low, width = most < floor, np.maximum(most - least, 1e-300)
    weak = (most[:, None, None] * np.eye(2) - A[low]) / width[:, None, None]
    raised = A.copy()
    raised[low] = np.where(both_low[:, None, None], floor * np.eye(2),
                           A[low] + (floor - least)[:, None, None] * weak)
    return replace(paraboloids, A=raised)


def times(A: Array, v: Array) -> Array:
    """Return the products (N, 2) of matrices (N, 2, 2) and vectors (N, 2)."""
    return np.asarray(np.einsum('nij,nj->ni', A, v))


def largest(values: Array) -> Array:
    """Return the largest absolute value (N,) of each of (N, ...), faster than ``max``."""
    return np.asarray(reduce(np.maximum, np.abs(values).reshape(len(values), -1).T))


def inverse_2x2(A: Array) -> Array:
    """Invert (N, 2, 2) symmetric matrices; singular ones get a huge, finite inverse."""
    a, b, d = A[:, 0, 0], A[:, 0, 1], A[:, 1, 1]
    flat = np.abs(a * d - b * b) < 1e-12
    if flat.any():
        # a small curvature where there is none, so that a flat surface has next to no weight
        trace = np.where(flat, np.copysign(1e-6, a + d), 0.0)
        A = A + trace[:, None, None] * np.eye(2)
    return inverses(A)


def constrained_minimum(A: Array, b: Array, g: Array, h: Array) -> Array:
    """
    Return the minima v_opt (N, 2) of v^T A' v + 2 v^T b + c on the epipolar lines g . v = h.

    Paper: the closed form of "Epipolar Constrained Tracking". Its v_2 divides by g_2, which
    vanishes for vertical lines; here the minimum is found along the line, from the foot of the
    perpendicular. g: (N, 2) first components of the lines; h: (N,) equals -(y, 1) F (x, 1)^T.
    """
    # Components first: a third of the time.
    (g1, g2), (a, c, d) = g.T, (A[:, 0, 0], A[:, 0, 1], A[:, 1, 1])
    norm = np.maximum(np.sqrt(g1 * g1 + g2 * g2), 1e-300)
    n1, n2, distance = g1 / norm, g2 / norm, h / norm
    foot1, foot2 = n1 * distance, n2 * distance
    # The line runs along (-n2, n1).
    slope = n1 * (c * foot1 + d * foot2 + b[:, 1]) - n2 * (a * foot1 + c * foot2 + b[:, 0])
    curvature = a * n2 * n2 - 2 * c * n1 * n2 + d * n1 * n1
    # A surface that is flat along the line does not move the point along it.
    flat = np.abs(curvature) < 1e-12
    shift = np.where(flat, 0.0, -slope / np.where(flat, 1.0, curvature))
    return np.stack([foot1 - shift * n2, foot2 + shift * n1], axis=1)
