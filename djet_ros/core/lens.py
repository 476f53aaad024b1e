"""
What a calibration leaves of a lens's distortion, told by the epipolar lines of many pairs.

The pose of a pair takes up most of what a wrong coefficient k1 does to its matches. What remains
are distances from epipolar lines, in pairs whose motion carries points across the image: turns,
above all. All pairs together tell k1 by least squares, each with a pose of its own:

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

from djet_ros.core.geometry import fit_rotation, inverses, rays, rotation_log
from djet_ros.core.jet import core_scale, epipolar_residuals, JetProblem, Loss, minimise
from djet_ros.core.paraboloid import times
from djet_ros.core.tracking import TUNING
from djet_ros.core.types import Array, Pose, RelativePose
import numpy as np

# Matches of a pair that are kept, evenly among the surest and the least sure.
MOST_MATCHES = 300

# chosen: of a distortion's pixels, what a pair's pose has to leave over for the pair to tell it.
# On straight roads, where it is less, what is wrong otherwise looks like a distortion.
LEAST_SHARE = 0.005

# chosen: times that parallax has to exceed noise, twice what makes it be believed at all. Where it
# does not, a way sideways passes for a turn, and a distortion makes it pass better.
_OUT_OF_NOISE = 6.0

# chosen: rounds, of which three are enough, and what k1 may still move then, in standard errors.
_ROUNDS, _SETTLED = 10, 0.01

# Newton's steps to a point that a lens shows at a pixel, from where it is by the calibration.
_INVERSIONS = 3

# Step of k1 by which residuals are differentiated.
_STEP = 1e-4

# Robust standard deviations where the loss bends, as in the odometry.
_BEND = 3.0

# Of the curvature that a loss has by its weights alone; it is two thirds with normal noise.
_LEAST_CURVED = 0.3

# Pixels; matches that are off by less are exact, and must not divide by nothing.
_LEAST_NOISE = 1e-4

# Groups of pairs in a row of which the jackknife leaves out one at a time.
_GROUPS = 10

# Pairs by which a standard error can be told at all.
_FEW = 5


class Lens(Protocol):
    """A camera whose first coefficient of radial distortion may be another."""

    @property
    def k1(self) -> float:
        """Give the coefficient as it was calibrated."""

    def pixels(self, places: Array, k1: float) -> tuple[Array, Array]:
        """
        Tell where points X/Z, Y/Z (N, 2) are seen.

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

        Where gray levels have them, which go by no epipolar lines. All that voted and not
        its inliers, as these are what the calibration at hand agrees with.
        """
        voting = np.flatnonzero(relative.voting)
        some = voting[::-(-len(voting) // MOST_MATCHES)]
        x, y = (rays(K, points[some])[:, :2] for points in (relative.x, relative.placed))
        return cls(x, y, Pose(relative.R, relative.t))

    @property
    def angle(self) -> float:
        """By how much the camera turned, in rad."""
        return float(np.linalg.norm(rotation_log(self.pose.R)))


class Told(NamedTuple):
    """
    What a pair tells of k1 once its pose is eliminated.

    share: how much of a distortion its pose can't take up, as residuals over the pixels by which
    matches move; noise: robust standard deviation in pixels of what no k1 explains; by_match:
    (2, N) of half the summed loss in units of noise, by k1, its second derivative and its first.
    """

    pair: MatchedPair
    share: float
    noise: float
    by_match: Array


@dataclass(frozen=True)
class LensFit:
    """
    The coefficient k1 that suits all pairs best, and its standard error.

    told: what each pair tells at k1; disagreement: by how many standard errors the pairs that
    tell most differ from the others. Noise does not make them; something that is the same in many
    pairs, and is no k1, is larger in those that tell least.
    """

    k1: float
    sigma: float
    told: tuple[Told, ...]
    disagreement: float

    @property
    def noise(self) -> float:
        """Give the usual distance of matches from their epipolar lines, in pixels."""
        return float(np.median([one.noise for one in self.told]))


def fit_lens(pairs: Sequence[MatchedPair], lens: Lens) -> LensFit:
    """Find k1 from pairs in the order of their recording, twice _FEW or more."""
    k1 = lens.k1
    for _ in range(_ROUNDS):
        told = [tell(pair, lens, k1) for pair in pairs]
        pairs = [one.pair for one in told]
        curvature, gradient = np.array([one.by_match.sum(1) for one in told]).T
        step = -gradient.sum() / curvature.sum()
        sigma = _standard_error(curvature, gradient)
        k1 += float(step)
        if abs(step) < _SETTLED * sigma:
            break
    return LensFit(k1, sigma, tuple(told), _disagreement(told))


def by_radius(fit: LensFit, edges: Array) -> Array:
    """
    Give k1 and its standard error (2, B) by matches between two radii X/Z of edges (B + 1,) each.

    All else is as it was fitted. NaN where there are none.
    """
    rows = []
    for inner, outer in pairwise(edges):
        chosen = [one.by_match[:, (radii >= inner) & (radii < outer)].sum(1) for one in fit.told
                  for radii in [np.linalg.norm(one.pair.y, axis=1)]]
        curvature, gradient = np.array([sums for sums in chosen if sums[0] > 0]).reshape(-1, 2).T
        rows.append([fit.k1 - gradient.sum() / curvature.sum(),
                     _standard_error(curvature, gradient)]
                    if len(curvature) >= _FEW else [np.nan, np.nan])
    return np.array(rows).T


def tells(pair: MatchedPair, lens: Lens) -> bool:
    """Tell whether a pair can say something of k1, by the calibration at hand."""
    told = tell(pair, lens, lens.k1)
    return told.share > LEAST_SHARE and _parallax(pair, lens) > _OUT_OF_NOISE * told.noise


def tell(pair: MatchedPair, lens: Lens, k1: float) -> Told:
    """Tell what a pair says at some k1, from its own best pose there."""
    problem = _problem(pair, lens, k1)
    R, t = pair.pose.R, pair.pose.t
    noise = max(core_scale(epipolar_residuals(problem, R, t).r), _LEAST_NOISE)
    loss = Loss('geman_mcclure', _BEND * noise)
    solution = minimise(problem, R, t, loss)
    r, J = solution.residuals.r, solution.residuals.jacobian
    more, less = (epipolar_residuals(_problem(pair, lens, k1 + way), solution.R, solution.t).r
                  for way in (_STEP, -_STEP))
    by_k1 = (more - less) / (2 * _STEP)
    weights = loss(r * r)[1]
    # What the pose can't follow.
    weighed = J * weights
    left = by_k1 - np.linalg.lstsq(weighed @ J.T, weighed @ by_k1, rcond=None)[0] @ J
    squares = np.stack([left * left, left * r]) * weights
    by_own_k1 = r - left * (squares[1].sum() / max(squares[0].sum(), 1e-300))
    # A robust loss curves less than its weights say (Huber, Robust Statistics, section 7.6).
    squares[0] *= max(loss.curvature(r * r).sum() / weights.sum(), _LEAST_CURVED)
    moved = _displacements(problem.rays_y[:2].T, lens, k1)
    share = np.sqrt((weights * left * left).sum() / max((weights * moved * moved).sum(), 1e-300))
    return Told(replace(pair, pose=solution.pose), float(share), core_scale(by_own_k1),
                squares / noise**2)


def _problem(pair: MatchedPair, lens: Lens, k1: float) -> JetProblem:
    """Pose the pair's problem at some k1, with noise of a pixel in y as it comes."""
    x, _ = _undistorted(pair.x, lens, k1)
    y, by_pixel = _undistorted(pair.y, lens, k1)
    S = by_pixel @ by_pixel.transpose(0, 2, 1)
    spread = np.stack([S[:, 0, 0], S[:, 0, 1], S[:, 1, 1]])
    width = (spread[0] + spread[2]) / 2
    rays_x, rays_y = (np.vstack([one.T, np.ones(len(one))]) for one in (x, y))
    return JetProblem(rays_x, rays_y, spread, TUNING.epipole_blur**2 * width**2)


def _undistorted(places: Array, lens: Lens, k1: float) -> tuple[Array, Array]:
    """
    Move points (N, 2) to where they are if the coefficient is k1; what is seen stays.

    Also gives how they move with the pixels at which they are seen, (N, 2, 2).
    """
    seen, _ = lens.pixels(places, lens.k1)
    for _ in range(_INVERSIONS):
        there, slopes = lens.pixels(places, k1)
        by_pixel = inverses(slopes)
        places = places + times(by_pixel, seen - there)
    return places, by_pixel


def _parallax(pair: MatchedPair, lens: Lens) -> float:
    """Give the usual distance in pixels of matches from where a turn alone would bring them."""
    rays_x, rays_y = (np.column_stack([one, np.ones(len(one))]) for one in (pair.x, pair.y))
    turned = rays_x @ fit_rotation(rays_x, rays_y).T
    there, here = (lens.pixels(places, lens.k1)[0]
                   for places in (turned[:, :2] / turned[:, 2:], pair.y))
    return float(np.median(np.linalg.norm(there - here, axis=1)))


def _displacements(places: Array, lens: Lens, k1: float) -> Array:
    """By how many pixels (N,) points (N, 2) move over k1."""
    more, less = (lens.pixels(places, k1 + way)[0] for way in (_STEP, -_STEP))
    return np.asarray(np.linalg.norm(more - less, axis=1) / (2 * _STEP))


def _disagreement(told: Sequence[Told]) -> float:
    """Compare the pairs that tell most with the others: half of what is known by each."""
    sums = np.array([one.by_match.sum(1) for one in told]).T
    order = np.argsort([one.share for one in told], kind='stable')
    known = np.cumsum(sums[0, order])
    first = int(np.clip(np.searchsorted(known, known[-1] / 2), _FEW, len(told) - _FEW))
    # Neighbours have to stay neighbours.
    halves = [sums[:, np.sort(half)] for half in (order[:first], order[first:])]
    off = [gradient.sum() / curvature.sum() for curvature, gradient in halves]
    one, other = (_standard_error(*half) for half in halves)
    return float(abs(off[0] - off[1]) / np.hypot(one, other))


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
