"""
What the pair before tells of a pair: which of several motions is the true one.

Two views of a plane fit two motions (see `core.rivals.planar_twin`), and no match tells which is
true. The two give the points different depths, and the next pair triangulates the same points
again: only the true motions of both pairs give depths in one ratio.
"""

from __future__ import annotations

from itertools import product

from djet_ros.core.geometry import depths_in_second, inverse_depths, rays
from djet_ros.core.jet import Loss, robust_scale
from djet_ros.core.known_depths import same_points
from djet_ros.core.medians import weighted_median
from djet_ros.core.rivals import preferences, SIGNIFICANT_PREFERENCE
from djet_ros.core.types import Array, Pose, RelativePose, Status
import numpy as np
from numpy.typing import NDArray

# chosen: fewer shared points do not decide.
_MIN_POINTS = 30

# chosen: largest noise of the displacements along epipolar lines, relative to that of the matches
# across them, at which depths agree. With the true motions it is 0.6 to 1.2, as either is that of
# the same matches; it is 2 and more if the shutter rolls.
_MAX_NOISE = 1.5

# Preference that decides what the matches of the pair leave open, or against their choice; as for
# basins before they have converged. Where a camera is slow, a step of a hundredth of the depth is
# hardly more than noise, and preferences of 3 to 7 for the wrong motion were common; for the right
# one of a plane they are 12 and more if it is fast.
_CLEAR_PREFERENCE = 5.0

# Robust standard deviations beyond which a point is an outlier.
_OUTLIER = 4.0


def consistent_motion(before: RelativePose, current: RelativePose, K: Array) -> Pose | None:
    """
    Return the motion of a pair, its pose or one of its rivals, that agrees with the pair before.

    before: the pair that ends where the other begins, with rivals of its own; K: (3, 3). Compares
    all combinations of their motions by Vuong's test, see `rivals.preferences`. None if it does
    not decide, if the best combination does not agree either, or if the pairs share too few
    points.
    """
    if not before.t.any() or not current.t.any():
        return None
    x, y = (places[current.inliers] for places in (current.x, current.y))
    shared, match = same_points(before.y[before.inliers], x)
    x, y = x[match], y[match]
    if len(x) < _MIN_POINTS:
        return None
    motions = _motions_of(current)
    known = [_depths_after(before, motion, K, shared)
             for motion in _motions_of(before)]
    seen = [inverse_depths(motion.R, motion.t, rays(K, x), rays(K, y)) for motion in motions]
    errors = K[0, 0] * np.stack([_disagreement(depths, triangulated)
                                 for depths, triangulated in product(known, seen)])
    noise = min(map(robust_scale, errors))
    losses, _ = Loss('geman_mcclure', _OUTLIER * noise)(errors**2)
    best = int(losses.sum(1).argmin())
    allowed = _MAX_NOISE * robust_scale(current.residuals[current.inliers])
    # NaN, as of a point in the plane of the camera, decides nothing.
    if not robust_scale(errors[best]) <= allowed:
        return None
    chosen = best % len(motions)
    others = np.arange(len(errors)) % len(motions) != chosen
    confirmed = chosen == 0 and current.status is Status.OK
    least = SIGNIFICANT_PREFERENCE if confirmed else _CLEAR_PREFERENCE
    decided = (preferences(losses, x, best)[others] >= least).all()
    return motions[chosen] if decided else None


def _motions_of(pair: RelativePose) -> list[Pose]:
    return [Pose(pair.R, pair.t), *(rival.pose for rival in pair.rivals)]


def _depths_after(pair: RelativePose, motion: Pose, K: Array, shared: NDArray[np.bool_]
                  ) -> tuple[Array, Array]:
    """
    Return inverse depths (N,) of points of a pair in its second view, by one of its motions.

    shared: the mask of these points among the inliers. In units of the translation, and with their
    standard deviations (N,) as `inverse_depths`. The opposite t gives them the opposite sign.
    """
    rays_x, rays_y = (rays(K, places[pair.inliers][shared]) for places in (pair.x, pair.y))
    rho, sigma = inverse_depths(motion.R, motion.t, rays_x, rays_y)
    depths = depths_in_second(motion.R, motion.t, rays_x, rho)
    return rho / depths, sigma / np.abs(depths)


def _disagreement(known: tuple[Array, Array], triangulated: tuple[Array, Array]) -> Array:
    """
    Return the differences (N,) of inverse depths from known ones, in errors of a ray.

    known, triangulated: with their standard deviations, (N,) each. They are in different units,
    whose ratio is their weighted median.
    """
    (known_rho, known_sigma), (rho, sigma) = known, triangulated
    ratio = weighted_median(rho / known_rho, np.abs(known_rho) / sigma)
    return np.asarray((rho - ratio * known_rho) / np.hypot(sigma, ratio * known_sigma))
