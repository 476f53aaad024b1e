"""
Joint epipolar tracking: one optimiser over (R, t) for every residual surface.

With y* = y - A'^-1 b the minimum of a paraboloid and l = (g, l_3) = F x its epipolar line, the
least value of the paraboloid on the line is

    Q(v_opt) = Q(y*) + (y*^T l)^2 / (g^T A'^-1 g),

so the summed loss of "Joint Epipolar Tracking" is a least-squares problem with one residual per
match: the distance of y* to its epipolar line, weighed by the match's own 2x2 precision.
R is moved on SO(3) from the left, t on the unit sphere.
"""

from __future__ import annotations

from dataclasses import dataclass

from djet_ros import compiled
from djet_ros.core.geometry import (
    GENERATORS,
    inverse_of,
    rays,
    rotation_exp,
    skew,
    sphere_tangents,
)
from djet_ros.core.paraboloid import median, medians, middle_of, Paraboloids
from djet_ros.core.types import Array, Pose
import numpy as np
from numpy.typing import NDArray

MAX_STEPS = 30
DAMPING_AT_FIRST = 1e-4
_STEP_TOLERANCE = 1e-6  # rad, a hundredth of what the best camera pose is good for
_GAIN_TOLERANCE = 1e-6
_MAX_DAMPING = 1e6

# chosen: by its weight alone, as if all others were right, a match makes steps too short; by the
# bend of its loss, too long where many are false. Half way takes three steps of four.
LEAST_CURVED = 0.3

# As those of it that are compiled take them.
_LIMITS = np.array([_STEP_TOLERANCE, _GAIN_TOLERANCE, _MAX_DAMPING, LEAST_CURVED])
_LOSSES = ('none', 'huber', 'cauchy', 'geman_mcclure')

# Robust standard deviations beyond which residuals do not belong together; chosen: rounds in which
# these are left out.
_CORE, _CORE_ROUNDS = 2.5, 8

# Standard deviation of normal residuals over the median of their absolute values.
_NORMAL = 1.4826

# What is left over at a minimum is noise itself: a match has at least this share of the usual.
_LEAST_LEFT = 0.25


@dataclass(frozen=True)
class JetProblem:
    """
    Matches as the optimiser sees them; the last axis runs over the N matches.

    rays_x, rays_y: (3, N) viewing rays of x and of the paraboloids' minima y*;
    spread: (3, N) the entries 11, 12, 22 of K^-1 A'^-1 K^-T, so that g^T A'^-1 g is taken in
    viewing-ray units. Residuals are in pixels for a surface of typical sharpness.
    blur: (N,) added to that variance, so that matches around the epipole count for little.
    """

    rays_x: Array
    rays_y: Array
    spread: Array
    blur: Array

    def subset(self, chosen: NDArray[np.bool_] | NDArray[np.int64] | slice) -> JetProblem:
        """Give the same problem on some of the matches."""
        # Indexed, they would come points first, and all that is done with them take longer.
        places = np.arange(len(self.blur))[chosen]
        return JetProblem(*(values.take(places, axis=-1) for values in self.matches))

    def seen_with(self, K: Array, other: Array) -> JetProblem:
        """Give the same pixels as a camera has them whose matrix is another one, not K."""
        A = inverse_of(other) @ K
        return JetProblem(A @ self.rays_x, A @ self.rays_y,
                          spread_of_rays(inverse_of(K) @ other, self.spread),
                          np.linalg.det(A) * self.blur)

    @property
    def matches(self) -> tuple[Array, Array, Array, Array]:
        """Give all of its arrays."""
        return self.rays_x, self.rays_y, self.spread, self.blur


@dataclass(frozen=True)
class Residuals:
    """
    Weighed epipolar distances r (N,), their signs of curvature (N,) and Jacobian (5, N).

    The match's loss is ``sign * r^2``; sign is -1 only for indefinite surfaces kept as printed.
    tangents: (3, 2) the basis in which the last two parameters move t.
    """

    r: Array
    sign: Array
    jacobian: Array
    tangents: Array


@dataclass(frozen=True)
class Solution:
    """A pose (R, t), and the residuals there."""

    R: Array
    t: Array
    residuals: Residuals

    @property
    def pose(self) -> Pose:
        """Give (R, t) by itself."""
        return Pose(self.R, self.t)


@dataclass(frozen=True)
class Loss:
    """Robust loss rho(r) by name, with its bend at `scale` (in the unit of the residuals)."""

    name: str = 'none'
    scale: float = 1.0

    def __call__(self, squared: Array) -> tuple[Array, Array]:
        """Give rho(r) and the weight rho'(r) / 2r, both (N,), for squared residuals."""
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
    def numbers(self) -> tuple[int, float]:
        """Give its number among all of them, and its bend."""
        return _LOSSES.index(self.name), self.scale

    def curvature(self, squared: Array) -> Array:
        """Give the second derivative rho''(r) / 2, (N,): what a residual adds to the Hessian."""
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
    Pose the problem for matches x (N, 2) with their paraboloids around y.

    Paraboloids are divided by their typical (median) curvature, which leaves the optimum where
    it is and gives residuals in pixels, so that losses compare across surfaces. epipole_blur:
    distance from the epipole, in pixels, within which lines are not trusted; 0 is as printed.
    by_fit: take the variance of a match to be in proportion to what is left at its minimum.
    """
    minima, spread = paraboloids.minima(), entries(paraboloids.inverses)
    if by_fit and len(minima):
        spread *= _left_over(paraboloids, minima)
    widths = np.abs(spread[0] + spread[2]) / 2
    spread /= max(median(widths), 1e-12) if len(minima) else 1.0
    spread = spread_of_rays(K, spread)
    # |g| grows like the sine of the angle from the epipole, so that a distance is an angle there.
    pixel = np.linalg.det(inverse_of(K)[:2, :2])
    blur = epipole_blur**2 * pixel * np.abs(spread[0] + spread[2]) / 2
    return JetProblem(rays(K, x).T, rays(K, minima).T, spread, blur)


def entries(S: Array) -> Array:
    """Give the entries 11, 12, 22 (3, N) of symmetric matrices (N, 2, 2)."""
    return np.array([S[:, 0, 0], S[:, 0, 1], S[:, 1, 1]])


def spread_of_rays(K: Array, spread: Array) -> Array:
    """Give covariances of rays by those of their pixels, both by entries 11, 12, 22 (3, N)."""
    (a, b), (c, d) = inverse_of(K)[:2, :2]
    return np.asarray(np.array([[a * a, 2 * a * b, b * b], [a * c, a * d + b * c, b * d],
                                [c * c, 2 * c * d, d * d]]) @ spread)


def _left_over(paraboloids: Paraboloids, minima: Array) -> Array:
    """
    Give the values (N,) at the minima, none of them much less than is usual.

    As in any least squares, what the best fit leaves over tells the noise.
    """
    values = paraboloids.values(minima)
    usual = median(values)
    return np.maximum(values, _LEAST_LEFT * usual) if usual > 0 else np.ones(len(values))


def epipolar_residuals(problem: JetProblem, R: Array, t: Array) -> Residuals:
    """Residuals at the pose (R, t) with their analytic Jacobian over 3 + 2 parameters."""
    if compiled.library is not None:
        return Residuals(*compiled.minimise(problem.matches, Loss().numbers, 0, DAMPING_AT_FIRST,
                                            _LIMITS, R, t)[2])
    tangents = sphere_tangents(t)
    # Of t, and of the two directions in which it moves.
    frame = np.empty((3, 3))
    frame[0], frame[1:] = t, tangents.T
    by_direction = skew(frame) @ R
    x, y, spread = problem.rays_x, problem.rays_y, problem.spread
    lines = by_direction[0] @ x
    e = (y * lines).sum(0)
    # The first two components of the lines, times the covariances of their points.
    M = spread[:2] * lines[0] + spread[1:] * lines[1]
    variance = (lines[:2] * M).sum(0)  # g^T A'^-1 g
    sign = np.where(variance < 0, -1.0, 1.0)
    size = np.abs(variance)
    size += problem.blur
    np.maximum(size, 1e-24, out=size)
    root = np.sqrt(size)
    # dr = w^T dE x, with the variance's own change in w.
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
    Minimise the summed loss from a starting pose by Levenberg-Marquardt steps.

    Never ends above the cost of the start. t must have unit length; residuals: those at the start,
    where they are known.
    """
    if compiled.library is not None:
        R, t, left = compiled.minimise(problem.matches, loss.numbers, max_steps,
                                       DAMPING_AT_FIRST, _LIMITS, R, t)
        return Solution(R, t, Residuals(*left))
    residuals = residuals or epipolar_residuals(problem, R, t)
    cost, weights = _cost(residuals, loss)
    damping = DAMPING_AT_FIRST
    for _ in range(max_steps):
        step = _step(residuals, weights, loss, damping)
        if step is None:
            break
        R_new, t_new = moved(R, t, residuals.tangents, step)
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


def moved(R: Array, t: Array, tangents: Array, step: Array) -> tuple[Array, Array]:
    """Move a pose by a step (5,): rotation vector in rad from the left, then along the sphere."""
    t = t + tangents @ step[3:]  # not shorter than before
    return rotation_exp(step[:3]) @ R, t / np.sqrt(t @ t)


def robust_scale(residuals: Array) -> float:
    """Give the standard deviation of the inliers, from the median absolute residual."""
    return _NORMAL * median(np.abs(residuals)) if len(residuals) else 1.0


def robust_scales(residuals: Array) -> Array:
    """Give the same (S,) of each row of (S, N)."""
    if not residuals.shape[1]:
        return np.ones(len(residuals))
    return _NORMAL * medians(np.abs(residuals))


def core_scale(residuals: Array) -> float:
    """
    Give the standard deviation of the residuals that belong together, which may be few.

    The median tells it where most are right. Over wide baselines most matches are false, and far
    from their epipolar lines; they are left out round by round. Where more than half of what is
    left fits exactly it is 0.
    """
    # Of ordered ones, those that belong together come first.
    ordered = np.sort(np.abs(residuals))
    count = len(ordered)
    for _ in range(1 + _CORE_ROUNDS):
        scale = _NORMAL * middle_of(ordered, count) if count else 1.0
        before, count = count, int(ordered.searchsorted(_CORE * scale))
        if count == before or not scale:
            break
    return scale


def _cost(residuals: Residuals, loss: Loss) -> tuple[float, Array]:
    """Sum up the loss, and give the weights (N,)."""
    values, weights = loss(residuals.r**2)
    return float(residuals.sign @ values), weights


def _step(residuals: Residuals, weights: Array, loss: Loss, damping: float) -> Array | None:
    """
    Damped Newton step; indefinite surfaces pull with their sign, but curve upwards.

    A match curves as much as its robust loss does, or as a share of what its weight makes it.
    """
    J, r = residuals.jacobian, residuals.r
    H = (J * np.maximum(loss.curvature(r * r), LEAST_CURVED * weights)) @ J.T
    gradient = J @ (weights * residuals.sign * r)
    diagonal = H.diagonal()
    if not np.isfinite(H).all() or not diagonal.any():
        return None
    H.ravel()[::6] += damping * diagonal + 1e-12 * diagonal.max()
    return np.asarray(-np.linalg.solve(H, gradient))
