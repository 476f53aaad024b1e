"""
What a calibration leaves of a lens's distortion, told by the epipolar lines of many pairs.

The pose of a pair takes up most of what a wrong coefficient k1 does to its matches. What remains
are distances from epipolar lines, in pairs whose motion carries points across the image: turns,
above all. k1 is found from all pairs together by least squares, each with a pose of its own:

    min over k1 and all (R, t) of   sum over pairs and matches of rho(r^2).

The poses are eliminated from the normal equations (variable projection; Golub and Pereyra, Inverse
Problems 2003). r is the distance in pixels of the images as they come. Among undistorted points it
would not do: a coefficient that shrinks the image shrinks all distances there, and noise alone
would seem to tell one.
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
    core_scale,
    epipolar_residuals,
    JetProblem,
    LEAST_CURVED,
    Loss,
    minimise,
    Solution,
)
from djet_ros.core.paraboloid import times
from djet_ros.core.starts import thinned
from djet_ros.core.types import Array, Pose, RelativePose
import numpy as np

# Matches of a pair that are kept, evenly among the surest and the least sure.
MOST_MATCHES = 300

# chosen: of a distortion's pixels, what a pair's pose has to leave over for the pair to take part.
# On straight roads, where it is less, what is wrong otherwise looks like a distortion.
LEAST_SHARE = 0.005

# chosen: times that parallax has to exceed noise, twice what makes it be believed at all. Where it
# does not, a way sideways passes for a turn, and a distortion makes it pass better.
_OUT_OF_NOISE = 6.0

# chosen: rounds, of which three are enough where k1 is small; and what k1 may still move in the
# last one, in standard errors. It may tremble by half of that, as each tells the noise anew.
_ROUNDS, _SETTLED = 20, 0.1

# What a step of k1 may move the outermost matches by, as a share of their distance from the
# middle. Without distortion, -k1 r^2 = 4/27 folds the image there; a step is a quarter of that.
_LONGEST = 1 / 27

# Newton's steps to a point that a lens shows at a pixel, from where it is by the calibration:
# three are enough far from a fold. They end with steps of so little in X/Z, and have arrived where
# the pixel is met.
_INVERSIONS, _NEXT_TO_NOTHING, _MET = 12, 1e-10, 1e-6

# Distances are taken to first order. Over so large a share of the radius, the area that a pixel
# sees may grow by a quarter at most: half of that is by what such a distance is off.
_FARTHER, _EVEN = 0.01, 1.25

# Step of k1 by which residuals are differentiated.
_STEP = 1e-4

# Robust standard deviations where the loss bends, as in the odometry.
_BEND = 3.0

# Pixels; matches that are off by less are exact, and must not divide by nothing.
_LEAST_NOISE = 1e-4

# chosen: what an image's sampling, its lens and its rolling rows shift all that is seen in a large
# cell by, in all pairs alike, as a share of the noise of a match.
SHIFT = 0.12

# Groups of pairs in a row of which the jackknife leaves out one at a time.
_GROUPS = 10

# Pairs that a standard error needs at least.
_FEW = 5


class Lens(Protocol):
    """A camera whose first coefficient of radial distortion may be another."""

    @property
    def k1(self) -> float:
        """Give the coefficient as it was calibrated."""

    def pixels(self, places: Array, k1: float) -> tuple[Array, Array]:
        """
        Project points X/Z, Y/Z (N, 2).

        Gives pixels (N, 2), and how these move with the points (N, 2, 2).
        """


@dataclass(frozen=True)
class MatchedPair:
    """
    Matches of two views, and about where the camera went between them.

    x, y: (N, 2) points X/Z, Y/Z, undistorted as the calibration has it; pose: the motion from x
    to y.
    """

    x: Array
    y: Array
    pose: Pose

    @classmethod
    def of(cls, relative: RelativePose, K: Array) -> MatchedPair:
        """
        Take what the odometry found in undistorted images with a camera matrix K (3, 3).

        Uses ``placed``, which is measured without the epipolar line. Takes all voting matches:
        inliers were selected with the calibration under test.
        """
        voting = np.flatnonzero(relative.voting)
        some = voting[thinned(len(voting), MOST_MATCHES)]
        x, y = (rays(K, points[some])[:, :2] for points in (relative.x, relative.placed))
        return cls(x, y, Pose(relative.R, relative.t))

    @property
    def angle(self) -> float:
        """By how much the camera turned, in rad."""
        return float(np.linalg.norm(rotation_log(self.pose.R)))


class Linearised(NamedTuple):
    """
    A pair about some k1, once its pose is eliminated.

    share: how much of a distortion its pose can't take up, as residuals over the pixels by which
    matches move; noise: robust standard deviation in pixels of what no k1 explains; by_match:
    (2, N): second and first derivative of half the loss by k1, over noise^2; pulls: (N, 2) by how
    much the first derivative changes where a match is seen farther in x and y by the noise.
    """

    pair: MatchedPair
    share: float
    noise: float
    by_match: Array
    pulls: Array


@dataclass(frozen=True)
class LensFit:
    """
    The coefficient k1 that suits all pairs best, and its standard error.

    about: a k1 next to it; linearised: the pairs about that; disagreement: by how many standard
    errors the more informative pairs differ from the others. Noise does not make them; something
    that is the same in many pairs, and is no k1, is larger in those that are less informative.
    """

    k1: float
    sigma: float
    about: float
    linearised: tuple[Linearised, ...]
    disagreement: float

    @property
    def noise(self) -> float:
        """Give the usual distance of matches from their epipolar lines, in pixels."""
        return float(np.median([one.noise for one in self.linearised]))


def fit_lens(pairs: Sequence[MatchedPair], lens: Lens) -> LensFit | None:
    """
    Find k1 from pairs in the order of their recording, twice _FEW or more.

    None where steps lead to where the image folds, or go on and on.
    """
    rim, k1 = outermost(pairs), lens.k1
    if not _is_even(rim, lens, k1):
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
        k1 += _shortened(step, rim, lens, k1)
    return None


def outermost(pairs: Sequence[MatchedPair]) -> Array:
    """Give the points X/Z, Y/Z (2P, 2) farthest from the middle in both views of P pairs."""
    return np.array([points[np.argmax((points**2).sum(1))]
                     for pair in pairs for points in (pair.x, pair.y)])


def displacements(places: Array, lens: Lens, k1: float) -> Array:
    """By how many pixels (N,) points (N, 2) move over k1."""
    more, less = (lens.pixels(places, k1 + way)[0] for way in (_STEP, -_STEP))
    return np.asarray(np.linalg.norm(more - less, axis=1) / (2 * _STEP))


def by_radius(fit: LensFit, edges: Array) -> Array:
    """
    Give k1 and its standard error (2, B) by matches between two radii X/Z of edges (B + 1,) each.

    All else is as it was fitted. NaN where there are none.
    """
    rows = []
    for inner, outer in pairwise(edges):
        chosen = [one.by_match[:, (radii >= inner) & (radii < outer)].sum(1)
                  for one in fit.linearised for radii in [np.linalg.norm(one.pair.y, axis=1)]]
        curvature, gradient = np.array([sums for sums in chosen if sums[0] > 0]).reshape(-1, 2).T
        rows.append([fit.about - gradient.sum() / curvature.sum(),
                     _standard_error(curvature, gradient)]
                    if len(curvature) >= _FEW else [np.nan, np.nan])
    return np.array(rows).T


def is_informative(pair: MatchedPair, lens: Lens) -> bool:
    """Whether a pair's pose leaves enough of a k1 to be seen, by the calibration at hand."""
    linearised = linearise(pair, lens, lens.k1)
    return (linearised.share > LEAST_SHARE
            and _parallax(pair, lens) > _OUT_OF_NOISE * linearised.noise)


def linearise(pair: MatchedPair, lens: Lens, k1: float) -> Linearised:
    """Linearise a pair about some k1, at its own best pose there."""
    problem, by_pixel = _problem(pair, lens, k1)
    R, t = pair.pose.R, pair.pose.t
    noise = max(core_scale(epipolar_residuals(problem, R, t).r), _LEAST_NOISE)
    loss = Loss('geman_mcclure', _BEND * noise)
    solution = minimise(problem, R, t, loss)
    r = solution.residuals.r
    weights = loss(r * r)[1]
    left = _left_over(pair, lens, k1, solution, weights)
    squares = np.stack([left * left, left * r]) * weights
    by_own_k1 = r - left * (squares[1].sum() / max(squares[0].sum(), 1e-300))
    # A robust loss curves less than its weights say (Huber, Robust Statistics, section 7.6): two
    # thirds of that with normal noise.
    squares[0] *= max(loss.curvature(r * r).sum() / weights.sum(), LEAST_CURVED)
    moved = displacements(problem.rays_y[:2].T, lens, k1)
    share = np.sqrt((weights * left * left).sum() / max((weights * moved * moved).sum(), 1e-300))
    pulls = (weights * left / noise)[:, None] * _across(problem, solution, by_pixel)
    return Linearised(replace(pair, pose=solution.pose), float(share), core_scale(by_own_k1),
                      squares / noise**2, pulls)


def _left_over(pair: MatchedPair, lens: Lens, k1: float, solution: Solution, weights: Array
               ) -> Array:
    """By how many pixels (N,) residuals move over k1, as far as the pose can't follow."""
    more, less = (epipolar_residuals(_problem(pair, lens, k1 + way)[0], solution.R, solution.t).r
                  for way in (_STEP, -_STEP))
    by_k1, J = (more - less) / (2 * _STEP), solution.residuals.jacobian
    weighed = J * weights
    followed = np.linalg.lstsq(weighed @ J.T, weighed @ by_k1, rcond=None)[0]
    return np.asarray(by_k1 - followed @ J)


def _across(problem: JetProblem, solution: Solution, by_pixel: Array) -> Array:
    """Directions (N, 2) in the image across the epipolar lines."""
    lines = essential(solution.R, solution.t) @ problem.rays_x
    return unit(np.einsum('kn,nki->ni', lines[:2], by_pixel))


def _problem(pair: MatchedPair, lens: Lens, k1: float) -> tuple[JetProblem, Array]:
    """
    Pose the pair's problem at some k1, with noise of a pixel in y as it comes.

    Also gives how points y move with the pixels at which they are seen, (N, 2, 2).
    """
    x, _ = _undistorted(pair.x, lens, k1)
    y, by_pixel = _undistorted(pair.y, lens, k1)
    S = by_pixel @ by_pixel.transpose(0, 2, 1)
    spread = np.stack([S[:, 0, 0], S[:, 0, 1], S[:, 1, 1]])
    width = (spread[0] + spread[2]) / 2
    rays_x, rays_y = (np.vstack([one.T, np.ones(len(one))]) for one in (x, y))
    blur = EstimatorConfig.epipole_blur**2 * width**2
    return JetProblem(rays_x, rays_y, spread, blur), by_pixel


def _undistorted(places: Array, lens: Lens, k1: float) -> tuple[Array, Array]:
    """
    Move points (N, 2) to where they are if the coefficient is k1; what is seen stays.

    Also gives how they move with the pixels at which they are seen, (N, 2, 2).
    """
    return _shown_at(lens.pixels(places, lens.k1)[0], places, lens, k1)


def _shown_at(seen: Array, places: Array, lens: Lens, k1: float) -> tuple[Array, Array]:
    """Give the points that a lens shows at pixels (N, 2), from next to them, and their slopes."""
    for _ in range(_INVERSIONS):
        there, slopes = lens.pixels(places, k1)
        by_pixel = inverses(slopes)
        step = times(by_pixel, seen - there)
        places = places + step
        if np.abs(step).max() < _NEXT_TO_NOTHING:
            break
    return places, by_pixel


def _is_even(rim: Array, lens: Lens, k1: float) -> bool:
    """
    Whether k1 shows points (N, 2), the outermost of all, far enough from where the image folds.

    There (1 + 3 k1 r^2 = 0) points move without bound from pixel to pixel. So does the noise that
    they are said to have, and all residuals vanish: a minimum that is none.
    """
    seen, middle = lens.pixels(rim, lens.k1)[0], lens.pixels(np.zeros((1, 2)), k1)[0]
    areas = []
    # Beyond a fold, where there is no such point, numbers run away.
    with np.errstate(all='ignore'):
        for farther in (0.0, _FARTHER):
            pixels = seen + farther * (seen - middle)
            places, by_pixel = _shown_at(pixels, rim, lens, k1)
            if not np.abs(lens.pixels(places, k1)[0] - pixels).max() < _MET:
                return False
            areas.append(np.linalg.det(by_pixel))
        return bool((areas[0] > 0).all() and (areas[1] > 0).all()
                    and (areas[1] / areas[0]).max() < _EVEN)


def _shortened(step: float, rim: Array, lens: Lens, k1: float) -> float:
    """Shorten a step of k1 to what moves the outermost points (N, 2) a little, without a fold."""
    radii = np.linalg.norm(lens.pixels(rim, k1)[0] - lens.pixels(np.zeros((1, 2)), k1)[0], axis=1)
    longest = _LONGEST * float((radii / displacements(rim, lens, k1)).min())
    step = float(np.clip(step, -longest, longest))
    while not _is_even(rim, lens, k1 + step):
        step /= 2
    return step


def _parallax(pair: MatchedPair, lens: Lens) -> float:
    """Give the usual distance in pixels of matches from where a turn alone would bring them."""
    rays_x, rays_y = (np.column_stack([one, np.ones(len(one))]) for one in (pair.x, pair.y))
    turned = rays_x @ fit_rotation(rays_x, rays_y).T
    there, here = (lens.pixels(places, lens.k1)[0]
                   for places in (turned[:, :2] / turned[:, 2:], pair.y))
    return float(np.median(np.linalg.norm(there - here, axis=1)))


def _disagreement(linearised: Sequence[Linearised]) -> float:
    """Compare the more informative pairs with the others: half of what is known by each."""
    sums = np.array([one.by_match.sum(1) for one in linearised]).T
    order = np.argsort([one.share for one in linearised], kind='stable')
    known = np.cumsum(sums[0, order])
    first = int(np.clip(np.searchsorted(known, known[-1] / 2), _FEW, len(linearised) - _FEW))
    # Neighbours have to stay neighbours.
    halves = [sums[:, np.sort(half)] for half in (order[:first], order[first:])]
    off = [gradient.sum() / curvature.sum() for curvature, gradient in halves]
    one, other = (_standard_error(*half) for half in halves)
    return float(abs(off[0] - off[1]) / np.hypot(one, other))


def _shift_error(linearised: Sequence[Linearised], lens: Lens) -> float:
    """
    Give the standard error of k1 by what no residual shows: all that is seen in a cell is shifted.

    It is so in all pairs alike, as sampling and the lens go with the place in the image.
    """
    seen = np.concatenate([lens.pixels(one.pair.y, lens.k1)[0] for one in linearised])
    side = max(float(np.sqrt(np.ptp(seen, axis=0).prod() / LARGE_CELLS)), 1.0)
    _, cell = np.unique(cells_of(seen, side), return_inverse=True)
    together = np.array([np.bincount(cell, along) for along in
                         np.concatenate([one.pulls for one in linearised]).T])
    curvature = sum(one.by_match[0].sum() for one in linearised)
    return float(SHIFT * np.sqrt((together**2).sum()) / curvature)


def _standard_error(curvature: Array, gradient: Array) -> float:
    """
    Give the standard error of k1 from how it moves without some of the pairs.

    Without each group of pairs in a row, as neighbours err alike; or without each alone, where
    the few groups agree better than that by chance.
    """
    group = np.arange(len(gradient)) * _GROUPS // len(gradient)
    by_group = group == np.arange(_GROUPS)[:, None]
    return max(_jackknife(by_group @ curvature, by_group @ gradient),
               _jackknife(curvature, gradient))


def _jackknife(curvature: Array, gradient: Array) -> float:
    """Give the standard error from parts (N,), each left out once."""
    without = -(gradient.sum() - gradient) / (curvature.sum() - curvature)
    return float(np.sqrt((1 - 1 / len(without)) * ((without - without.mean())**2).sum()))
