"""
Estimation of residual lens distortion from the epipolar lines of many pairs.

The pose of a pair absorbs most of the effect of a wrong coefficient k1 on its matches. The rest
shows as distances from epipolar lines, above all where the camera rotates and points move across
the image. k1 is estimated from all pairs jointly by least squares, each with its own pose:

    min over k1 and all (R, t) of   sum over pairs and matches of rho(r^2).

The poses are eliminated from the normal equations (variable projection; Golub and Pereyra, Inverse
Problems 2003). r is the distance in pixels of the original images. Distances between undistorted
points would be biased: a coefficient that shrinks the image shrinks all of them, and would be
preferred on noise alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple, Protocol

from djet_ros.core.cells import cells_of
from djet_ros.core.covariance import LARGE_CELLS
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.geometry import essential, fit_rotation, inverses, rays, rotation_log, unit
from djet_ros.core.jet import (
    clipped_scale,
    entries,
    epipolar_residuals,
    JetProblem,
    LEAST_CURVATURE,
    Loss,
    minimise,
    Solution,
)
from djet_ros.core.paraboloid import times
from djet_ros.core.starts import subsampled
from djet_ros.core.types import Array, Pose, RelativePose
import numpy as np

# Most matches of a pair, evenly sampled.
MOST_MATCHES = 300

# chosen: least share of a distortion's displacement in pixels that the pair's pose leaves over,
# for the pair to be used. On straight roads, where it is less, other errors look like distortion.
LEAST_SHARE = 0.005

# chosen: least ratio of parallax to noise, twice that for which a translation is accepted. Below,
# a sideways translation passes for a rotation, and better so with a distortion.
_MIN_PARALLAX_RATIO = 6.0

# chosen: rounds, of which three are enough for small k1; and the step of k1, in standard errors,
# below which it has converged. It may fluctuate by half of that, as each round estimates the noise
# again.
_ROUNDS, _SETTLED = 20, 0.1

# Largest displacement of the outermost matches by one step of k1, relative to their radius. The
# image folds where -k1 r^2 = 4/27; a step is a quarter of that.
_MAX_STEP = 1 / 27

# Newton iterations of the undistortion, started at the calibrated point: three are enough far from
# a fold. They end with steps of so little in X/Z, and have converged if the pixel is met within
# the last value.
_INVERSIONS, _STEP_TOLERANCE, _PIXEL_TOLERANCE = 12, 1e-10, 1e-6

# Distances are first-order, so the area that a pixel covers may grow at most by this factor over
# this share of the radius; half of that is the relative error of such a distance.
_RADIUS_SHARE, _MAX_AREA_RATIO = 0.01, 1.25

# Step of k1 for numerical derivatives.
_STEP = 1e-4

# Pixels; lower bound of the noise, for exact matches.
_LEAST_NOISE = 1e-4

# chosen: systematic displacement of all points in a large cell of the image, by sampling, lens and
# rolling shutter, the same in all pairs, relative to the noise of a match.
SHIFT = 0.12

# Groups of consecutive pairs for the jackknife.
_GROUPS = 10

# Least number of pairs for a standard error.
_MIN_PAIRS = 5


class Lens(Protocol):
    """A camera with a free first coefficient of radial distortion."""

    @property
    def k1(self) -> float:
        """Return the calibrated coefficient."""

    def pixels(self, places: Array, k1: float) -> tuple[Array, Array]:
        """Project points X/Z, Y/Z (N, 2) to pixels, (N, 2), with their Jacobians (N, 2, 2)."""


@dataclass(frozen=True)
class MatchedPair:
    """
    Matches of two views with an approximate pose.

    x, y: (N, 2) points X/Z, Y/Z, undistorted with the calibration; pose: the motion from x to y.
    """

    x: Array
    y: Array
    pose: Pose

    @classmethod
    def of(cls, relative: RelativePose, K: Array) -> MatchedPair:
        """
        Return matches of the odometry, in undistorted images with a camera matrix K (3, 3).

        Uses ``placed``, which is measured without the epipolar line, and all voting matches:
        inliers were selected with the calibration under test.
        """
        voting = np.flatnonzero(relative.voting)
        chosen = voting[subsampled(len(voting), MOST_MATCHES)]
        x, y = (rays(K, points[chosen])[:, :2] for points in (relative.x, relative.placed))
        return cls(x, y, Pose(relative.R, relative.t))

    @property
    def angle(self) -> float:
        """Return the rotation angle in rad."""
        return float(np.linalg.norm(rotation_log(self.pose.R)))


class Linearised(NamedTuple):
    """
    A pair linearised at some k1, its pose eliminated.

    share: of a distortion that the pose can't absorb: residuals over the pixels by which matches
    move; noise: robust standard deviation, in pixels, of residuals that k1 does not explain;
    by_match: (2, N) second and first derivative of half the loss by k1, over noise^2; pulls: (N,
    2) change of the first derivative when a match moves in x and y by the noise.
    """

    pair: MatchedPair
    share: float
    noise: float
    by_match: Array
    pulls: Array


@dataclass(frozen=True)
class LensFit:
    """
    Least-squares k1 over all pairs, with its standard error.

    about: the linearisation point; linearised: the pairs there; disagreement: difference between
    the more informative pairs and the others in standard errors. It is large if an effect that is
    common to many pairs, and not distortion, dominates the less informative ones.
    """

    k1: float
    sigma: float
    about: float
    linearised: tuple[Linearised, ...]
    disagreement: float


def fit_lens(pairs: Sequence[MatchedPair], lens: Lens) -> LensFit | None:
    """
    Estimate k1 from at least twice _MIN_PAIRS pairs, in the order of their recording.

    None if the steps approach a fold of the image or do not converge.
    """
    rim, k1 = outermost(pairs), lens.k1
    if not _is_far_from_fold(rim, lens, k1):
        return None
    for _ in range(_ROUNDS):
        linearised = [linearise(pair, lens, k1) for pair in pairs]
        curvature, gradient = np.array([one.by_match.sum(1) for one in linearised]).T
        step = -float(gradient.sum() / curvature.sum())
        sigma = float(np.hypot(_standard_error(curvature, gradient),
                               _shift_error(linearised, lens)))
        if abs(step) < _SETTLED * sigma:
            return LensFit(k1 + step, sigma, k1, tuple(linearised), _disagreement(linearised))
        pairs = [one.pair for one in linearised]
        k1 += _limited(step, rim, lens, k1)
    return None


def outermost(pairs: Sequence[MatchedPair]) -> Array:
    """Return the points X/Z, Y/Z (2P, 2) with the largest radius in both views of P pairs."""
    return np.array([points[np.argmax((points**2).sum(1))]
                     for pair in pairs for points in (pair.x, pair.y)])


def displacements(places: Array, lens: Lens, k1: float) -> Array:
    """Return the pixels (N,) by which points (N, 2) move per unit of k1."""
    more, less = (lens.pixels(places, k1 + step)[0] for step in (_STEP, -_STEP))
    return np.asarray(np.linalg.norm(more - less, axis=1) / (2 * _STEP))


def by_radius(fit: LensFit, edges: Array) -> Array:
    """
    Return k1 and its standard error (2, B) by the matches of each range of radii.

    edges: (B + 1,) radii X/Z. All else is as fitted. NaN if there are too few.
    """
    rows = []
    for inner, outer in pairwise(edges):
        chosen = [one.by_match[:, (radii >= inner) & (radii < outer)].sum(1)
                  for one in fit.linearised for radii in [np.linalg.norm(one.pair.y, axis=1)]]
        curvature, gradient = np.array([sums for sums in chosen if sums[0] > 0]).reshape(-1, 2).T
        rows.append([fit.about - gradient.sum() / curvature.sum(),
                     _standard_error(curvature, gradient)]
                    if len(curvature) >= _MIN_PAIRS else [np.nan, np.nan])
    return np.array(rows).T


def is_informative(pair: MatchedPair, lens: Lens) -> bool:
    """Return whether a pair, linearised at the calibrated k1, determines k1 beyond its noise."""
    linearised = linearise(pair, lens, lens.k1)
    return (linearised.share > LEAST_SHARE
            and _parallax(pair, lens) > _MIN_PARALLAX_RATIO * linearised.noise)


def linearise(pair: MatchedPair, lens: Lens, k1: float) -> Linearised:
    """Linearise a pair at some k1, with its pose refined for that k1."""
    problem, by_pixel = _problem(pair, lens, k1)
    R, t = pair.pose.R, pair.pose.t
    noise = max(clipped_scale(epipolar_residuals(problem, R, t).r), _LEAST_NOISE)
    loss = Loss(EstimatorConfig.loss, EstimatorConfig.loss_scale * noise)
    solution = minimise(problem, R, t, loss)
    r = solution.residuals.r
    weights = loss(r * r)[1]
    left = _unabsorbed(pair, lens, k1, solution, weights)
    squares = np.stack([left * left, left * r]) * weights
    by_own_k1 = r - left * (squares[1].sum() / max(squares[0].sum(), 1e-300))
    # The second derivative of a robust loss is below its weights (Huber, Robust Statistics,
    # section 7.6): two thirds of them for normal noise.
    squares[0] *= max(loss.curvature(r * r).sum() / weights.sum(), LEAST_CURVATURE)
    moved = displacements(problem.rays_y[:2].T, lens, k1)
    share = np.sqrt((weights * left * left).sum() / max((weights * moved * moved).sum(), 1e-300))
    pulls = (weights * left / noise)[:, None] * _across_lines(problem, solution, by_pixel)
    return Linearised(replace(pair, pose=solution.pose), float(share), clipped_scale(by_own_k1),
                      squares / noise**2, pulls)


def _unabsorbed(pair: MatchedPair, lens: Lens, k1: float, solution: Solution, weights: Array
                ) -> Array:
    """Return derivatives (N,) of residuals by k1, in pixels, orthogonal to those by the pose."""
    more, less = (epipolar_residuals(_problem(pair, lens, k1 + step)[0], solution.R, solution.t).r
                  for step in (_STEP, -_STEP))
    by_k1, J = (more - less) / (2 * _STEP), solution.residuals.jacobian
    weighed = J * weights
    followed = np.linalg.lstsq(weighed @ J.T, weighed @ by_k1, rcond=None)[0]
    return np.asarray(by_k1 - followed @ J)


def _across_lines(problem: JetProblem, solution: Solution, by_pixel: Array) -> Array:
    """Return the directions (N, 2) across the epipolar lines, in the image."""
    lines = essential(solution.R, solution.t) @ problem.rays_x
    return unit(np.einsum('kn,nki->ni', lines[:2], by_pixel))


def _problem(pair: MatchedPair, lens: Lens, k1: float) -> tuple[JetProblem, Array]:
    """
    Set up the pair's problem at some k1, with unit noise of the original pixels of y.

    Also returns the Jacobians (N, 2, 2) of points y by these pixels.
    """
    x, _ = _undistorted(pair.x, lens, k1)
    y, by_pixel = _undistorted(pair.y, lens, k1)
    spread = entries(by_pixel @ by_pixel.transpose(0, 2, 1))
    width = (spread[0] + spread[2]) / 2
    rays_x, rays_y = (np.vstack([one.T, np.ones(len(one))]) for one in (x, y))
    blur = EstimatorConfig.epipole_blur**2 * width**2
    return JetProblem(rays_x, rays_y, spread, blur), by_pixel


def _undistorted(places: Array, lens: Lens, k1: float) -> tuple[Array, Array]:
    """
    Move points (N, 2) to another coefficient k1, with the same pixels.

    Also returns their Jacobians (N, 2, 2) by these pixels.
    """
    return _invert_projection(lens.pixels(places, lens.k1)[0], places, lens, k1)


def _invert_projection(pixels: Array, places: Array, lens: Lens, k1: float) -> tuple[Array, Array]:
    """Undistort pixels (N, 2) from nearby points; also return the Jacobians."""
    for _ in range(_INVERSIONS):
        projected, slopes = lens.pixels(places, k1)
        by_pixel = inverses(slopes)
        step = times(by_pixel, pixels - projected)
        places = places + step
        if np.abs(step).max() < _STEP_TOLERANCE:
            break
    return places, by_pixel


def _is_far_from_fold(rim: Array, lens: Lens, k1: float) -> bool:
    """
    Return whether points (N, 2), the outermost of all, are far enough from a fold of the image.

    At a fold (1 + 3 k1 r^2 = 0) points move without bound from pixel to pixel. So does their
    assumed noise, and all whitened residuals vanish: a spurious minimum.
    """
    rim_pixels, middle = lens.pixels(rim, lens.k1)[0], lens.pixels(np.zeros((1, 2)), k1)[0]
    areas = []
    # Beyond a fold there is no solution, and iterations diverge.
    with np.errstate(all='ignore'):
        for farther in (0.0, _RADIUS_SHARE):
            pixels = rim_pixels + farther * (rim_pixels - middle)
            places, by_pixel = _invert_projection(pixels, rim, lens, k1)
            if not np.abs(lens.pixels(places, k1)[0] - pixels).max() < _PIXEL_TOLERANCE:
                return False
            areas.append(np.linalg.det(by_pixel))
        return bool((areas[0] > 0).all() and (areas[1] > 0).all()
                    and (areas[1] / areas[0]).max() < _MAX_AREA_RATIO)


def _limited(step: float, rim: Array, lens: Lens, k1: float) -> float:
    """Limit a step of k1 by the displacement of the outermost points (N, 2) and any fold."""
    radii = np.linalg.norm(lens.pixels(rim, k1)[0] - lens.pixels(np.zeros((1, 2)), k1)[0], axis=1)
    longest = _MAX_STEP * float((radii / displacements(rim, lens, k1)).min())
    step = float(np.clip(step, -longest, longest))
    while not _is_far_from_fold(rim, lens, k1 + step):
        step /= 2
    return step


def _parallax(pair: MatchedPair, lens: Lens) -> float:
    """Return the median distance in pixels of matches from their prediction by rotation alone."""
    rays_x, rays_y = (np.column_stack([one, np.ones(len(one))]) for one in (pair.x, pair.y))
    turned = rays_x @ fit_rotation(rays_x, rays_y).T
    predicted, measured = (lens.pixels(places, lens.k1)[0]
                           for places in (turned[:, :2] / turned[:, 2:], pair.y))
    return float(np.median(np.linalg.norm(predicted - measured, axis=1)))


def _disagreement(linearised: Sequence[Linearised]) -> float:
    """Compare the more informative half of the pairs with the other, in standard errors."""
    sums = np.array([one.by_match.sum(1) for one in linearised]).T
    order = np.argsort([one.share for one in linearised], kind='stable')
    known = np.cumsum(sums[0, order])
    first = int(np.clip(np.searchsorted(known, known[-1] / 2), _MIN_PAIRS,
                        len(linearised) - _MIN_PAIRS))
    # The jackknife needs the order of the recording.
    halves = [sums[:, np.sort(half)] for half in (order[:first], order[first:])]
    steps = [gradient.sum() / curvature.sum() for curvature, gradient in halves]
    one, other = (_standard_error(*half) for half in halves)
    return float(abs(steps[0] - steps[1]) / np.hypot(one, other))


def _shift_error(linearised: Sequence[Linearised], lens: Lens) -> float:
    """
    Return the standard error of k1 by systematic displacements of whole cells of the image.

    They are the same in all pairs, as sampling and lens depend on the position in the image.
    """
    pixels = np.concatenate([lens.pixels(one.pair.y, lens.k1)[0] for one in linearised])
    side = max(float(np.sqrt(np.ptp(pixels, axis=0).prod() / LARGE_CELLS)), 1.0)
    _, cell = np.unique(cells_of(pixels, side), return_inverse=True)
    by_cell = np.array([np.bincount(cell, along) for along in
                        np.concatenate([one.pulls for one in linearised]).T])
    curvature = sum(one.by_match[0].sum() for one in linearised)
    return float(SHIFT * np.sqrt((by_cell**2).sum()) / curvature)


def _standard_error(curvature: Array, gradient: Array) -> float:
    """
    Return the jackknife standard error of k1 over pairs.

    It leaves out groups of consecutive pairs, whose errors are correlated, or single pairs,
    whichever gives more: few groups may agree by chance.
    """
    group = np.arange(len(gradient)) * _GROUPS // len(gradient)
    by_group = group == np.arange(_GROUPS)[:, None]
    return max(_jackknife(by_group @ curvature, by_group @ gradient),
               _jackknife(curvature, gradient))


def _jackknife(curvature: Array, gradient: Array) -> float:
    """Return the leave-one-out standard error over parts (N,)."""
    without = -(gradient.sum() - gradient) / (curvature.sum() - curvature)
    return float(np.sqrt((1 - 1 / len(without)) * ((without - without.mean())**2).sum()))
