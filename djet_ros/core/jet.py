"""
Joint epipolar tracking (JET): one least-squares optimiser over (R, t) for every residual surface.

With y* = y - A'^-1 b the minimum of a paraboloid and l = (g, l_3) = F x the epipolar line, the
least value of the paraboloid on the line is

    Q(v_opt) = Q(y*) + (y*^T l)^2 / (g^T A'^-1 g),

so the summed loss of the paper is a least-squares problem with one residual per match: the
distance of y* from its epipolar line, divided by its standard deviation under the covariance A'^-1
(a Sampson distance for errors of y alone, which makes it exact). A robust loss acts on this
residual, not on Q(y*), which does not depend on the pose. R is updated on SO(3) from the left, t
on the unit sphere.
"""

from __future__ import annotations

from dataclasses import dataclass

from djet_ros import compiled
from djet_ros.core.geometry import (
    GENERATORS,
    inverse_intrinsics,
    rays,
    rotation_exp,
    skew,
    sphere_tangents,
)
from djet_ros.core.medians import median, median_of_sorted, medians
from djet_ros.core.paraboloid import Paraboloids
from djet_ros.core.types import Array, Pose
import numpy as np
from numpy.typing import NDArray

MAX_STEPS = 30
INITIAL_DAMPING = 1e-4
_STEP_TOLERANCE = 1e-6  # rad; the best poses are accurate to a hundred times as much
_GAIN_TOLERANCE = 1e-6
_MAX_DAMPING = 1e6

# chosen: least curvature of a match in the Hessian, as a share of its IRLS weight. With the
# weights alone (as in iteratively reweighted least squares) steps are too short; with the second
# derivative of the robust loss alone they are too long where many matches are outliers. This
# takes three quarters of the steps.
LEAST_CURVATURE = 0.3

# In the order of the arguments of djet_minimise.
_LIMITS = np.array([_STEP_TOLERANCE, _GAIN_TOLERANCE, _MAX_DAMPING, LEAST_CURVATURE])
_LOSSES = ('none', 'huber', 'cauchy', 'geman_mcclure')

# Cut-off of `clipped_scale` in robust standard deviations, and its rounds (chosen).
_CLIPPING, _CLIPPING_ROUNDS = 2.5, 8

# Standard deviation over median absolute deviation of a normal distribution.
_SIGMA_OVER_MAD = 1.4826

# Floor of a surface's value at its minimum, as a share of the median: the value is a noisy
# estimate of the variance of the match.
_LEAST_VALUE = 0.25


@dataclass(frozen=True)
class JetProblem:
    """
    Matches as the optimiser sees them; the last axis runs over the N matches.

    rays_x, rays_y: (3, N) viewing rays of x and of the minima y* of the paraboloids; covariances:
    (3, N) entries 11, 12, 22 of K^-1 A'^-1 K^-T, the covariance of y* up to scale, in units of
    rays. Residuals are in pixels for a surface of median curvature. blur: (N,) variance added to
    g^T A'^-1 g, which down-weights matches near the epipole.
    """

    rays_x: Array
    rays_y: Array
    covariances: Array
    blur: Array

    def subset(self, chosen: NDArray[np.bool_] | NDArray[np.int64] | slice) -> JetProblem:
        """Return the problem with some of the matches only."""
        # Fancy indexing would return arrays with points first in memory, and slow down all that
        # follows.
        places = np.arange(len(self.blur))[chosen]
        return JetProblem(*(values.take(places, axis=-1) for values in self.matches))

    def with_camera(self, K: Array, other: Array) -> JetProblem:
        """Return the problem with the same pixels under another camera matrix than K."""
        A = inverse_intrinsics(other) @ K
        return JetProblem(A @ self.rays_x, A @ self.rays_y,
                          ray_covariances(inverse_intrinsics(K) @ other, self.covariances),
                          np.linalg.det(A)**2 * self.blur)

    @property
    def pixel(self) -> float:
        """Return one unit of the residuals in units of rays, for a surface of median curvature."""
        return float(np.sqrt(median(np.abs(self.covariances[0] + self.covariances[2])) / 2))

    @property
    def matches(self) -> tuple[Array, Array, Array, Array]:
        """Return all arrays of the problem."""
        return self.rays_x, self.rays_y, self.covariances, self.blur


@dataclass(frozen=True)
class Residuals:
    """
    Whitened epipolar distances r (N,), signs of their curvature (N,), and the Jacobian (5, N).

    The loss of a match is ``sign * r^2``; sign is -1 only for indefinite surfaces under the policy
    'keep'. tangents: (3, 2) basis of the tangent plane in which the last two parameters move t.
    """

    r: Array
    sign: Array
    jacobian: Array
    tangents: Array


@dataclass(frozen=True)
class Solution:
    """Estimated pose (R, t) with the residuals there."""

    R: Array
    t: Array
    residuals: Residuals

    @property
    def pose(self) -> Pose:
        """Return (R, t) without the residuals."""
        return Pose(self.R, self.t)


@dataclass(frozen=True)
class Loss:
    """Robust loss rho(r), by name; `scale` is its tuning constant in units of the residuals."""

    name: str = 'none'
    scale: float = 1.0

    def __call__(self, squared: Array) -> tuple[Array, Array]:
        """Return rho(r) and the IRLS weight rho'(r) / 2r, both (N,), of squared residuals."""
        u = squared / self.scale**2
        if self.name == 'none':
            return squared, np.ones_like(squared)
        if self.name == 'cauchy':
            return self.scale**2 * np.log1p(u), 1 / (1 + u)
        if self.name == 'geman_mcclure':
            flat = 1 / (1 + u)
            return squared * flat, flat * flat
        if self.name == 'huber':
            root = np.sqrt(np.maximum(u, 1.0))
            return self.scale**2 * np.where(u <= 1, u, 2 * root - 1), 1 / root
        raise ValueError(f"loss is '{self.name}'; choose none, huber, cauchy or geman_mcclure")

    @property
    def encoded(self) -> tuple[int, float]:
        """Return the index of the loss, as compiled code takes it, and its scale."""
        return _LOSSES.index(self.name), self.scale

    def curvature(self, squared: Array) -> Array:
        """Return rho''(r) / 2 (N,), the contribution of each residual to the Hessian."""
        u = squared / self.scale**2
        if self.name == 'cauchy':
            return (1 - u) / (1 + u)**2
        if self.name == 'geman_mcclure':
            flat = 1 / (1 + u)
            return (1 - 3 * u) * flat * flat * flat
        return np.where(u <= 1, 1.0, 0.0) if self.name == 'huber' else np.ones_like(squared)


def jet_problem(K: Array, x: Array, paraboloids: Paraboloids, epipole_blur: float = 0.0,
                by_fit: bool = False) -> JetProblem:
    """
    Set up the problem for matches x (N, 2) and the paraboloids around their y.

    Paraboloids are divided by their median curvature; this keeps the optimum and gives residuals
    in pixels, so that losses of different surfaces can be compared. epipole_blur: distance from
    the epipole, in pixels, within which epipolar lines are uncertain; 0 is the paper's loss.
    by_fit: scale the variance of each match by the value of its surface at the minimum.
    """
    minima, covariances = paraboloids.minima(), entries(paraboloids.inverses)
    if by_fit and len(minima):
        covariances *= _floored_minimum_values(paraboloids, minima)
    widths = np.abs(covariances[0] + covariances[2]) / 2
    covariances /= max(median(widths), 1e-12) if len(minima) else 1.0
    covariances = ray_covariances(K, covariances)
    # |g| grows with the sine of the angle from the epipole, so that a distance there is an angle.
    pixel = np.linalg.det(inverse_intrinsics(K)[:2, :2])
    blur = epipole_blur**2 * pixel * np.abs(covariances[0] + covariances[2]) / 2
    return JetProblem(rays(K, x).T, rays(K, minima).T, covariances, blur)


def entries(S: Array) -> Array:
    """Return the entries 11, 12, 22 (3, N) of symmetric matrices (N, 2, 2)."""
    return np.array([S[:, 0, 0], S[:, 0, 1], S[:, 1, 1]])


def ray_covariances(K: Array, covariances: Array) -> Array:
    """Convert covariances of pixels to covariances of rays, both as entries 11, 12, 22 (3, N)."""
    (a, b), (c, d) = inverse_intrinsics(K)[:2, :2]
    return np.asarray(np.array([[a * a, 2 * a * b, b * b], [a * c, a * d + b * c, b * d],
                                [c * c, 2 * c * d, d * d]]) @ covariances)


def _floored_minimum_values(paraboloids: Paraboloids, minima: Array) -> Array:
    """
    Return the surface values (N,) at the minima, floored at a share of their median.

    The residual of a least-squares fit estimates its noise variance.
    """
    values = paraboloids.values(minima)
    usual = median(values)
    return np.maximum(values, _LEAST_VALUE * usual) if usual > 0 else np.ones(len(values))


def epipolar_residuals(problem: JetProblem, R: Array, t: Array) -> Residuals:
    """Return the residuals at (R, t) with their analytic Jacobian over 3 + 2 parameters."""
    if compiled.library is not None:
        return Residuals(*compiled.minimise(problem.matches, Loss().encoded, 0, INITIAL_DAMPING,
                                            _LIMITS, R, t)[2])
    tangents = sphere_tangents(t)
    # t and the two tangent directions in which it moves.
    frame = np.empty((3, 3))
    frame[0], frame[1:] = t, tangents.T
    by_direction = skew(frame) @ R
    x, y, covariances = problem.rays_x, problem.rays_y, problem.covariances
    lines = by_direction[0] @ x
    e = (y * lines).sum(0)
    # Covariance of y* times the line's normal g.
    M = covariances[:2] * lines[0] + covariances[1:] * lines[1]
    variance = (lines[:2] * M).sum(0)  # g^T A'^-1 g
    sign = np.where(variance < 0, -1.0, 1.0)
    size = np.abs(variance)
    size += problem.blur
    np.maximum(size, 1e-24, out=size)
    root = np.sqrt(size)
    # dr = w^T dE x; w includes the derivative of the variance.
    w = y / root
    r = e / root
    w[:2] -= r * sign / size * M
    slopes = np.empty((5, 3, 3))
    slopes[:3], slopes[3:] = skew(t) @ (GENERATORS @ R), by_direction[1:]
    jacobian = slopes.reshape(5, 9) @ (w[:, None] * x).reshape(9, -1)
    return Residuals(r, sign, jacobian, tangents)


def minimise(problem: JetProblem, R: Array, t: Array, loss: Loss,
             max_steps: int = MAX_STEPS, residuals: Residuals | None = None) -> Solution:
    """
    Minimise the summed loss from an initial pose by Levenberg-Marquardt.

    The result never costs more than the initial pose. t must have unit length; residuals: those at
    the initial pose, if they have been computed already.
    """
    if compiled.library is not None:
        R, t, left = compiled.minimise(problem.matches, loss.encoded, max_steps,
                                       INITIAL_DAMPING, _LIMITS, R, t)
        return Solution(R, t, Residuals(*left))
    residuals = residuals or epipolar_residuals(problem, R, t)
    cost, weights = _cost(residuals, loss)
    damping = INITIAL_DAMPING
    for _ in range(max_steps):
        step = _step(residuals, weights, loss, damping)
        if step is None:
            break
        R_new, t_new = retract(R, t, residuals.tangents, step)
        trial = epipolar_residuals(problem, R_new, t_new)
        trial_cost, trial_weights = _cost(trial, loss)
        if trial_cost < cost:
            gain = cost - trial_cost
            R, t, residuals, cost, weights = R_new, t_new, trial, trial_cost, trial_weights
            damping = max(damping / 10, 1e-9)
            if np.linalg.norm(step) < _STEP_TOLERANCE or gain < _GAIN_TOLERANCE * abs(cost):
                break
        else:
            damping *= 10
            if damping > _MAX_DAMPING or np.linalg.norm(step) < _STEP_TOLERANCE:
                break
    return Solution(R, t, residuals)


def retract(R: Array, t: Array, tangents: Array, step: Array) -> tuple[Array, Array]:
    """Apply a step (5,) to a pose: a rotation vector from the left, in rad; t along the sphere."""
    t = t + tangents @ step[3:]  # a tangential step never shortens t
    return rotation_exp(step[:3]) @ R, t / np.sqrt(t @ t)


def robust_scale(residuals: Array) -> float:
    """Return the standard deviation of the inliers, from the median absolute residual."""
    return _SIGMA_OVER_MAD * median(np.abs(residuals)) if len(residuals) else 1.0


def robust_scales(residuals: Array) -> Array:
    """Return `robust_scale` (S,) of each row of residuals (S, N)."""
    if not residuals.shape[1]:
        return np.ones(len(residuals))
    return _SIGMA_OVER_MAD * medians(np.abs(residuals))


def clipped_scale(residuals: Array) -> float:
    """
    Return the standard deviation of the inliers by iterated clipping, even if they are a minority.

    The median absolute residual suffices where most matches are inliers. Over wide baselines most
    are outliers, far from their epipolar lines; each round drops residuals beyond a multiple of
    the current scale. Returns 0 where more than half of the remaining residuals are exactly zero.
    """
    # After sorting, the inliers come first.
    ordered = np.sort(np.abs(residuals))
    count = len(ordered)
    for _ in range(1 + _CLIPPING_ROUNDS):
        scale = _SIGMA_OVER_MAD * median_of_sorted(ordered, count) if count else 1.0
        before, count = count, int(ordered.searchsorted(_CLIPPING * scale))
        if count == before or not scale:
            break
    return scale


def _cost(residuals: Residuals, loss: Loss) -> tuple[float, Array]:
    """Return the summed loss and the weights (N,)."""
    values, weights = loss(residuals.r**2)
    return float(residuals.sign @ values), weights


def _step(residuals: Residuals, weights: Array, loss: Loss, damping: float) -> Array | None:
    """
    Return a damped Newton step, or None if the Hessian is zero or not finite.

    Indefinite surfaces contribute their sign to the gradient, but always positive curvature: that
    of the robust loss, or a share of the match's weight if that is more.
    """
    J, r = residuals.jacobian, residuals.r
    H = (J * np.maximum(loss.curvature(r * r), LEAST_CURVATURE * weights)) @ J.T
    gradient = J @ (weights * residuals.sign * r)
    diagonal = H.diagonal()
    if not np.isfinite(H).all() or not diagonal.any():
        return None
    H.ravel()[::6] += damping * diagonal + 1e-12 * diagonal.max()
    return np.asarray(-np.linalg.solve(H, gradient))
