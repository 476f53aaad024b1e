"""
Refinement of many starting poses at once: the problem of ``jet`` for all of them in one product.

An epipolar residual is linear in the essential matrix, e = y*^T E x = vec(x y*^T) . vec(E), and so
are its derivatives. One product of the matches' (9, N) with the (S, 6, 9) of all starts gives the
terms of a Gauss-Newton step. The variances g^T A'^-1 g are constant during a step, which is
accurate enough to reach a basin; ``jet.minimise`` then optimises exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from djet_ros import compiled
from djet_ros.core.geometry import (
    GENERATORS,
    rotation_exp,
    rotation_log,
    skew,
    sphere_tangents,
    unit,
)
from djet_ros.core.jet import INITIAL_DAMPING, JetProblem, Loss, robust_scales
from djet_ros.core.types import Array, Pose
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Sketch:
    """
    Poses R (S, 3, 3), t (S, 3) with their summed losses (S,).

    r, sign (S, N): residuals, and the signs with which their losses count.
    """

    R: Array
    t: Array
    costs: Array
    r: Array
    sign: Array

    def __len__(self) -> int:
        return len(self.R)

    def pose(self, index: int) -> Pose:
        """Return one of the poses."""
        return Pose(self.R[index], self.t[index])

    def poses(self) -> list[Pose]:
        """Return all poses."""
        return [self.pose(index) for index in range(len(self))]

    def scales(self) -> Array:
        """Return the robust standard deviations (S,) of the residuals."""
        return robust_scales(self.r)


@dataclass(frozen=True)
class _Evaluation:
    """
    Residuals and losses at S poses: costs (S,), and r, sign, weights (S, N).

    roots: (S, N) standard deviations of the residuals.
    """

    costs: Array
    r: Array
    sign: Array
    weights: Array
    roots: Array

    def restore(self, other: _Evaluation, indices: NDArray[np.int64]) -> None:
        """Take the values of some of the poses from another evaluation."""
        for name in ('costs', 'r', 'sign', 'weights', 'roots'):
            getattr(self, name)[indices] = getattr(other, name)[indices]


@dataclass(frozen=True)
class RotationPrior:
    """Cost w^T weight w of a rotation, with w (3,) its rotation vector from R (3, 3)."""

    R: Array
    weight: Array


def refine_all(problem: JetProblem, starts: Sequence[Pose], loss: Loss, steps: int,
               rotation_prior: RotationPrior | None = None) -> Sketch:
    """
    Make Levenberg-Marquardt steps from each of some poses, all at once.

    Each has its own damping and never ends above the cost of its start. rotation_prior: added to
    all costs.
    """
    R, t = np.array([start.R for start in starts]), np.array([start.t for start in starts])
    if compiled.library is not None and rotation_prior is None:
        return Sketch(*compiled.refine_all(problem.matches, loss.encoded, steps,
                                           INITIAL_DAMPING, R, t))
    products = _products(problem)
    current = _evaluate(problem, products, R, t, loss, rotation_prior)
    damping = np.full(len(R), INITIAL_DAMPING)
    for _ in range(steps):
        tangents, H, gradient = _normal_equations(products, R, t, current, rotation_prior)
        R_new, t_new = moved_all(R, t, tangents, _damped_steps(H, gradient, damping))
        trial = _evaluate(problem, products, R_new, t_new, loss, rotation_prior)
        better = trial.costs < current.costs
        damping = np.where(better, np.maximum(damping / 10, 1e-9), damping * 10)
        if not better.any():
            continue
        # Starts whose step was rejected return to where they were.
        if len(worse := np.flatnonzero(~better)):
            R_new[worse], t_new[worse] = R[worse], t[worse]
            trial.restore(current, worse)
        R, t, current = R_new, t_new, trial
    return Sketch(R, t, current.costs, current.r, current.sign)


def costs_in_front(problem: JetProblem, sketch: Sketch, loss: Loss) -> Array:
    """Return the summed losses (S,) with chirality, see ``losses_in_front``."""
    return np.asarray(losses_in_front(problem, sketch, loss).sum(1))


def losses_in_front(problem: JetProblem, sketch: Sketch, loss: Loss,
                    signs: Sequence[float] = (1.0, -1.0)) -> Array:
    """
    Return the losses (S, N) of epipolar distances with chirality.

    Epipolar lines become half-lines, which begin at the image of the point at infinity; matches
    before it also pay for their distance to it along the line. Of the given signs of t, the one
    that costs less is taken.
    """
    if compiled.library is not None:
        return compiled.losses_in_front(problem.matches, loss.encoded, (sketch.R, sketch.t),
                                        (sketch.r, sketch.sign), signs)
    t = sketch.t[:, :, None]
    m = sketch.R @ problem.rays_x
    ahead = m[:, 2] > 0
    infinite = m[:, :2] / np.where(ahead, m[:, 2], 1.0)[:, None]
    along = t[:, :2] - infinite * t[:, 2:]
    a1, a2 = along[:, 0], along[:, 1]
    s11, s12, s22 = problem.covariances
    variance = np.abs(s11 * a1**2 + 2 * s12 * a1 * a2 + s22 * a2**2) + problem.blur
    root = np.sqrt(np.maximum(variance, 1e-24))
    position = ((problem.rays_y[:2] - infinite) * along).sum(1) / root
    squared = sketch.r**2
    losses = np.stack([sketch.sign * loss(
        squared + np.where(ahead, np.minimum(sign * position, 0), 0)**2)[0] for sign in signs])
    return np.asarray(losses[losses.sum(2).argmin(0), np.arange(len(sketch))])


def losses_at(problem: JetProblem, poses: Sequence[Pose], loss: Loss) -> Array:
    """Return the losses (S, N) as ``losses_in_front`` does, at poses as they are."""
    return losses_in_front(problem, refine_all(problem, poses, loss, 0), loss)


def _products(problem: JetProblem) -> Array:
    """Entries (9, N) of x y*^T in the order of an essential matrix's rows."""
    return np.asarray((problem.rays_y[:, None] * problem.rays_x[None]).reshape(9, -1))


def _evaluate(problem: JetProblem, products: Array, R: Array, t: Array, loss: Loss,
              rotation_prior: RotationPrior | None) -> _Evaluation:
    """Evaluate residuals and costs at all poses."""
    E = skew(t) @ R
    e = E.reshape(-1, 9) @ products
    l1, l2 = (E[:, :2].transpose(1, 0, 2).reshape(-1, 3) @ problem.rays_x).reshape(2, len(R), -1)
    s11, s12, s22 = problem.covariances
    variance = (s11 * l1 + 2 * s12 * l2) * l1 + s22 * l2 * l2
    sign = np.where(variance < 0, -1.0, 1.0)
    roots = np.sqrt(np.maximum(np.abs(variance) + problem.blur, 1e-24))
    r = e / roots
    losses, weights = loss(r * r)
    costs = (sign * losses).sum(1)
    if rotation_prior is not None:
        error = rotation_log(R @ rotation_prior.R.T)
        costs += (error @ rotation_prior.weight * error).sum(1)
    return _Evaluation(costs, r, sign, weights, roots)


def _normal_equations(products: Array, R: Array, t: Array, current: _Evaluation,
                      rotation_prior: RotationPrior | None) -> tuple[Array, Array, Array]:
    """
    Tangents (S, 3, 2) of t, H (S, 5, 5) and gradients (S, 5) of the costs.

    The variances of the residuals are held constant.
    """
    tangents = sphere_tangents(t)
    by_rotation = skew(t)[:, None] @ (GENERATORS @ R[:, None])
    by_direction = skew(tangents.transpose(0, 2, 1)) @ R[:, None]
    slopes = np.concatenate([by_rotation, by_direction], axis=1).reshape(-1, 9)
    J = (slopes @ products).reshape(len(R), 5, -1) / current.roots[:, None]
    weighted = J * current.weights[:, None]
    H = weighted @ J.transpose(0, 2, 1)
    gradient = (weighted @ (current.sign * current.r)[..., None])[..., 0]
    if rotation_prior is not None:
        H[:, :3, :3] += rotation_prior.weight
        gradient[:, :3] += rotation_log(R @ rotation_prior.R.T) @ rotation_prior.weight
    return tangents, H, gradient


def _damped_steps(H: Array, gradient: Array, damping: Array) -> Array:
    """Damped Gauss-Newton steps (S, 5); zeros for a degenerate problem."""
    diagonal = H.diagonal(axis1=1, axis2=2)
    most = diagonal.max(1, keepdims=True)
    ridge = damping[:, None] * diagonal + 1e-12 * most
    H = H.copy()
    H.reshape(-1, 25)[:, ::6] += ridge
    if not (np.isfinite(H.sum()) and most.all()):
        usable = np.asarray(np.isfinite(H).all((1, 2)) & diagonal.any(1))
        H = np.where(usable[:, None, None], H, np.eye(5))
        gradient = np.where(usable[:, None], gradient, 0.0)
    return np.asarray(-np.linalg.solve(H, gradient[..., None])[..., 0])


def moved_all(R: Array, t: Array, tangents: Array, steps: Array) -> tuple[Array, Array]:
    """Move one or S poses by steps (S, 5), as ``jet.retract`` does for a single one."""
    return rotation_exp(steps[:, :3]) @ R, unit(t + (tangents @ steps[:, 3:, None])[..., 0])
