"""
A window of frames and of the landmarks that they share: what ties the lengths of steps together.

A landmark keeps the descriptor of the frame that saw it first, its anchor, and its inverse depth
there. Each later frame samples the landmark's surface anew (`core.sighting`): nothing is detected
again, so nothing wanders.
`djet_ros.core.bundle` refines poses and depths together. A frame that leaves the window leaves
what it told about the others behind as a prior, its landmarks eliminated with it (Leutenegger et
al., "Keyframe-based visual-inertial odometry using nonlinear optimization", IJRR 2015). So does
one between keyframes, with those that it was the last to see: where the camera turns by much, they
alone may tell how long the steps before and after it are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from djet_ros.core.bundle import (
    eliminate,
    in_frame,
    Landmarks,
    noise_scale,
    observe,
    Observed,
    OfPrior,
    PosePrior,
    Poses,
    projected,
    Reduced,
)
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.geometry import (
    inverse_depths,
    rotation_exp,
    rotation_log,
    skew,
    sphere_tangents,
    unit,
)
from djet_ros.core.jet import Loss
from djet_ros.core.landmark_choice import choose_landmarks
from djet_ros.core.paraboloid import median
from djet_ros.core.radial import straight_image, straight_rays, straightened
from djet_ros.core.self_calibration import SelfCalibration
from djet_ros.core.sighting import Sighting
from djet_ros.core.slants import slopes
from djet_ros.core.surfaces import DescriptorDistances
from djet_ros.core.types import Array, Pose, RelativePose, View
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree


@dataclass(frozen=True)
class WindowTuning:
    """Constants of the window, each with where it comes from ("chosen" was not searched)."""

    # chosen for the price: twice as many of either changed the drift on real streets by noise
    keyframes: int = 6
    landmarks: int = 160
    # pixels, in the median, by which landmarks have moved beyond what the turn alone moved them
    # where a frame becomes a keyframe; 10 costs a third more and drifts as much
    parallax: float = 25.0
    # chosen: share of the landmarks that are seen no more, where it becomes one too
    gone: float = 0.4
    # chosen: side of the cells over which landmarks spread, as a share of that with one in each
    cell: float = 0.75
    # chosen: Gauss-Newton steps for each frame; four come to the same
    steps: int = 2
    # chosen: how often a step that would cost more is halved: where the camera hardly moved, or
    # turned by much, depths are told so badly that a full one may lead anywhere
    halvings: int = 6
    # robust standard deviations beyond which an observation is false, and where the loss bends
    outlier: float = 4.0
    bend: float = 3.0
    # pixels; chosen, below the noise of rendered streets, which is 0.04
    least_scale: float = 0.02
    # chosen: pixels between a landmark and a match of a pair that are taken for one another
    beside: float = 1.5
    # pixels; chosen: what a match is off at most, but for false ones; and the share by which the
    # depth of a landmark may be
    matched: float = 0.4
    known: float = 0.15
    # pixels; chosen: what right matches are off, where surfaces are fitted to them
    off: float = 0.1
    # rad; chosen: parallax of a step, negative, to which noise takes what is infinitely far
    beyond: float = 0.01
    # chosen: so few landmarks do not tell a length
    few: int = 8
    # chosen: shares by which the length of a pair may be off that depths around it tell, and one
    # that nothing tells; landmarks that are measured in both frames are far surer
    told: float = 0.02
    guessed: float = 0.5
    # chosen: share of the way to where the frame before is by now that a step makes up for. By
    # all of it the track would jump, by none drift two times as much over a hundred frames
    mended: float = 0.2


WINDOW_TUNING = WindowTuning()

# By which share the first length may be off, which is the unit of the track.
_EXACT = 1e-4

# Information about the rotation of a pair without parallax, which has no covariance: 1 mrad.
_ROTATION_ALONE = 1e6


@dataclass(frozen=True)
class Addition:
    """
    What a window says of its newest frame: its motion from the one before, and how long it is.

    R (3, 3), t (3,) with its length in the unit of the track: x_new = R x_before + t; sigma:
    standard deviation of the length, as if the frames before stood where the window has them, and
    covariance (6, 6) of all of it, over R -> exp([w]_x) R and t + dt. onward: (4, 4) the newest
    camera in the one before as that was told: with a part of what has become known of it since.
    """

    R: Array
    t: Array
    length: float
    sigma: float
    covariance: Array
    onward: Array


class Window:
    """
    Poses of keyframes and of the newest frame, and the inverse depths of their landmarks.

    The unit is the length of the first pair that is added. Holds at most `keyframes` + 1 images.

    settled: (M, 3) places, in the newest frame, of landmarks that it was the last to refine; lens:
    what is known of the distortion of its images.
    """

    def __init__(self, config: EstimatorConfig, tuning: WindowTuning = WINDOW_TUNING) -> None:
        self._config, self._tuning = config, tuning
        self._distances = DescriptorDistances(config)

    def start(self, view: View, lens: SelfCalibration | None = None) -> None:
        """Forget everything, but what is known of the lens; this frame is the first."""
        self._K, self._views = view.K, [view]
        self.lens = lens or SelfCalibration.unknown(view.K, view.gray.shape)
        self._poses = Poses(np.eye(3)[None], np.zeros((1, 3)), self.lens.left)
        self._is_keyframe, self._has_landmarks = [True], [False]
        self._landmarks = Landmarks.at(np.empty((0, 2)), np.empty(0), 0, 1)
        self._prior = PosePrior.holding(self._poses)
        self._scale = 1.0
        # The newest camera as it was told, seen from the oldest keyframe; its pose may have been
        # refined since.
        self._told = np.eye(4)
        # The newest pair and its length, where it has a direction.
        self._latest: tuple[RelativePose, float] | None = None
        # The pair that was last asked for its length, and what landmarks say of it.
        self._asked: tuple[RelativePose, tuple[Array, Array]] | None = None
        self.settled = np.empty((0, 3))

    @property
    def is_new(self) -> bool:
        """Whether there is one frame alone, so that the next pair makes the unit."""
        return len(self._views) == 1

    @property
    def is_keyframe(self) -> bool:
        """Whether the newest frame stays as a keyframe when others come."""
        return self._is_keyframe[-1]

    def add(self, view: View, relative: RelativePose, guess: float) -> Addition:
        """
        Take the next frame and the pair of the newest one with it.

        guess: length of the pair, where landmarks do not tell. The first pair has it in any case,
        and must have a direction.
        """
        # What the pair says, in a length by depths that the window knows.
        first = self.is_new
        length, share = (guess, _EXACT) if first else self._length(relative, guess)
        self._asked = None
        self._append(view, relative, length)
        self._add_pair(relative, length, share)
        # Landmarks, old and new, are measured in the frame; then all is refined together.
        if self._is_keyframe[-2] and not self._has_landmarks[-2] and relative.t.any():
            self._found(relative, length)
        self._measure()
        stood = self._poses.camera(0)[:3, 3]
        H = self._refine()
        # How far the window slid as a whole says nothing of the step. No frame tells where it
        # lies; what frames that are gone told is known to first order alone, and what that leaves
        # over pushes the window along, the farther from its start, the less holds it there.
        self._told[:3, 3] += self._poses.camera(0)[:3, 3] - stood
        addition = self._addition(H)
        if first:  # by definition
            addition = replace(addition, length=length)
        # What is no keyframe goes, and so does the oldest where there are too many.
        self.settled = np.empty((0, 3))
        if len(self._views) > 2 and not self._is_keyframe[-2]:
            self._settle(self._landmarks.seen[:, -2] & ~self._landmarks.seen[:, -1])
            self._forget(len(self._views) - 2)
        if sum(self._is_keyframe) > self._tuning.keyframes:
            self._learn_lens()
            self._settle(self._landmarks.anchors == 0)
            self._forget(0)
        if relative.t.any():
            self._choose_keyframe()
        self._latest = (relative, addition.length) if relative.t.any() else None
        return addition

    def tell(self, motion: Array) -> None:
        """Take note of what was told of the newest step, (4, 4), in the unit of the track."""
        self._told = self._told @ motion

    def straighten(self, newest: View) -> None:
        """
        Go on with images without the k1 that is to be expected, of which newest is the first.

        What was seen in images by now is where these would have shown it.
        """
        before, self.lens = self.lens.undone, self.lens.straightened()
        self._views = [*(self._straight(view, before) for view in self._views[:-1]), newest]
        moved = self._landmarks.seen_otherwise(self._K, before, self.lens.undone)
        # What comes to lie beyond an image tells nothing any more.
        inside = self._distances.describable(moved.found, newest.tested.shape)
        self._landmarks = moved.of(inside)
        self._poses = replace(self._poses, k1=self.lens.left)
        self._latest = None

    def _straight(self, view: View, before: float) -> View:
        """
        Give a view without the k1 that is to be expected, which was without another before.

        As far as it is asked for: where landmarks were found in it, nothing is looked for anew.
        """
        gray, _ = straight_image(view.gray, self._K, self.lens.undone, before=before)
        return replace(view, gray=gray, tested=self._distances.seen(gray))

    def landmarks(self) -> Array:
        """Places (M, 3) of landmarks in the newest frame, in the unit of the track."""
        return self._places(np.ones(len(self._landmarks), bool))

    def _places(self, chosen: NDArray[np.bool_]) -> Array:
        """Places (M, 3), in the newest frame, of those of some landmarks (N,) that are sure."""
        sure = self._landmarks.of(np.asarray(
            chosen & (self._landmarks.seen.sum(1) > 1) & (self._landmarks.rho > 0)))
        places = in_frame(self._K, self._poses, sure, len(self._views) - 1)
        return np.asarray(places / sure.rho[:, None])

    def _projected(self, places: Array) -> Array:
        """Project places (N, 3) in a camera to pixels (N, 2) as its lens shows them."""
        return projected(self._K, places, self._poses.k1)

    def _rays(self, pixels: Array) -> Array:
        """Take pixels (N, 2) as the lens shows them to their viewing rays (N, 3), with z = 1."""
        return straight_rays(self._K, pixels, self._poses.k1)

    def _length(self, relative: RelativePose, guess: float) -> tuple[float, float]:
        """
        Length of the pair, and by which share it may be off.

        A robust mean over landmarks beside which it has a match; where the camera turned past
        them, over the matches of the pair before.
        """
        unknown = guess, self._tuning.guessed
        if not relative.t.any():
            return unknown
        ratios, weights = self._ratios(relative)
        if len(ratios) < self._tuning.few and self._latest is not None:
            ratios, weights = self._ratios_by(relative, *self._near(
                relative.x[relative.inliers], *self._depths_of(*self._latest)))
        if len(ratios) < self._tuning.few:
            return unknown
        length = _weighted_median(ratios, weights)
        return (length, self._tuning.told) if length > 0 else unknown

    def told_length(self, relative: RelativePose) -> tuple[float, float] | None:
        """
        Length of a pair by landmarks, and its standard error by how much these differ.

        None where there are too few. Of a translation that is none, noise in place of depths is
        left, and the length is nothing to within its error.
        """
        ratios, weights = self._ratios(relative)
        if len(ratios) < self._tuning.few:
            return None
        length = _weighted_median(ratios, weights)
        # Of a median, with as many as these weights are worth.
        spread = 1.25 * 1.4826 * _weighted_median(np.abs(ratios - length), weights)
        return length, spread * float(np.sqrt((weights**2).sum()) / weights.sum())

    def _ratios(self, relative: RelativePose) -> tuple[Array, Array]:
        """Lengths (M,) of a pair by landmarks beside its matches, one by one, and weights."""
        # Asked twice of a pair: whether it went anywhere, and how far.
        if self._asked is None or self._asked[0] is not relative:
            x = relative.x[relative.inliers]
            self._asked = relative, self._ratios_by(
                relative, *self._beside(x, self._landmarks.seen[:, -1]))
        return self._asked[1]

    def _ratios_by(self, relative: RelativePose, rho: Array, match: NDArray[np.int64]
                   ) -> tuple[Array, Array]:
        """Tell the same by inverse depths rho (M,) that are known of some inliers (M,)."""
        x, y = relative.x[relative.inliers][match], relative.y_opt[relative.inliers][match]
        in_units, sigma = inverse_depths(relative.R, relative.t, self._rays(x), self._rays(y))
        return in_units / rho, rho / sigma

    def _depths_of(self, relative: RelativePose, length: float) -> tuple[Array, Array]:
        """Pixels (N, 2) of a pair's inliers in its second frame, and inverse depths (N,) there."""
        y = relative.y_opt[relative.inliers]
        rays_x = self._rays(relative.x[relative.inliers])
        rho, _ = inverse_depths(relative.R, relative.t, rays_x, self._rays(y))
        depths = (rays_x @ relative.R.T + rho[:, None] * relative.t)[:, 2]
        ahead = (rho > 0) & (depths > 0)
        return y[ahead], rho[ahead] / (depths[ahead] * length)

    def _beside(self, x: Array, chosen: NDArray[np.bool_]) -> tuple[Array, NDArray[np.int64]]:
        """
        Tell which of the pixels x (N, 2) of the newest frame lie beside some of the landmarks.

        Gives inverse depths (M,) there of those that do, and indices (M,) into x.
        """
        before = self._landmarks.of(np.asarray(chosen & (self._landmarks.rho > 0)))
        places = in_frame(self._K, self._poses, before, len(self._views) - 1)
        ahead = places[:, 2] > 0
        return self._near(x, self._projected(places[ahead]),
                          before.rho[ahead] / places[ahead, 2])

    def _near(self, x: Array, points: Array, rho: Array) -> tuple[Array, NDArray[np.int64]]:
        """Tell the same of pixels x beside points (P, 2) of some inverse depths (P,)."""
        if not len(points) or not len(x):
            return np.empty(0), np.empty(0, np.int64)
        # Built in half the time of a balanced one, and asked as fast.
        tree = cKDTree(x, balanced_tree=False, compact_nodes=False)
        away, match = tree.query(points, distance_upper_bound=self._tuning.beside)
        near = np.isfinite(away)
        return rho[near], match[near]

    def agreement(self, pose: Pose, x: Array, y: Array) -> tuple[int, int]:
        """
        Count landmarks that lie where a motion has them, and all that were asked.

        pose: from the newest frame to another one, the sign of t open; x, y: (N, 2) matched pixels
        of the two. Asked are landmarks with a match beside them that were seen more than twice, so
        that their depths do not come from one pair. The motion's length is the one that serves
        them best.
        """
        newest = self._landmarks.seen[:, -1] & (self._landmarks.sightings > 2)
        finite = np.isfinite(y).all(1)
        x, y = x[finite], y[finite]
        known, match = self._beside(x, newest)
        if not len(known):
            return 0, 0
        in_units, sigma = inverse_depths(pose.R, pose.t, self._rays(x[match]),
                                         self._rays(y[match]))
        ratios = in_units / known
        # By what is near, which tells most but may be another body, or by all alike.
        lengths = np.array([[_weighted_median(ratios, known / sigma)], [median(ratios)]])
        noise = self._tuning.matched / self._K[0, 0] * sigma
        off = np.abs(in_units - lengths * known)
        agree = off < self._tuning.outlier * noise + self._tuning.known * np.abs(lengths) * known
        return int(agree.sum(1).max()), len(known)

    def _choose_keyframe(self) -> None:
        """
        Make the newest frame a keyframe where landmarks moved since the last, or are gone.

        To be asked where the camera moved: while it does not, no landmarks can be found anew, and
        keyframes that go by would take those away that there are.
        """
        if self._is_keyframe[-1]:
            return
        newest = len(self._views) - 1
        last = max(index for index, chosen in enumerate(self._is_keyframe) if chosen)
        here = self._landmarks.of(self._landmarks.seen[:, newest])
        few = len(here) < (1 - self._tuning.gone) * self._tuning.landmarks
        if not few:
            turn = self._poses.R[newest] @ self._poses.R[last].T
            turned, moved = (self._projected(places) for places in (
                in_frame(self._K, self._poses, here, last) @ turn.T,
                in_frame(self._K, self._poses, here, newest)))
            few = median(np.linalg.norm(moved - turned, axis=1)) > self._tuning.parallax
        self._is_keyframe[-1] = few

    def _append(self, view: View, relative: RelativePose, length: float) -> None:
        R, t = self._poses.R[-1], self._poses.t[-1]
        new = relative.R @ R, relative.R @ t + length * relative.t
        self._poses, self._prior = self._poses.joined(*new), self._prior.with_frame(*new)
        # The second frame stays, for the unit is told by it.
        self._is_keyframe.append(self.is_new)
        self._has_landmarks.append(False)
        self._views.append(view)
        self._landmarks = self._landmarks.with_frame()

    def _add_pair(self, relative: RelativePose, length: float, share: float) -> None:
        """
        Add what all matches of the pair tell of its rotation and direction to the prior.

        And its length, which may be off by a share: where landmarks tell next to nothing of it,
        it would go wherever a prior drives it that was linearised elsewhere.
        """
        R, t = relative.R, length * relative.t
        # With steps (omega, upsilon) of the frame before and of the new one, the motion turns by
        # omega_new - R omega_before and shifts by upsilon_new - [t]x omega_new - R upsilon_before.
        J = np.zeros((6, 12))
        J[:3, :3], J[3:, 3:6] = -R, -R
        J[:3, 6:9], J[3:, 6:9], J[3:, 9:] = np.eye(3), -skew(t), np.eye(3)
        if relative.t.any():
            J_pair = np.concatenate([J[:3], sphere_tangents(relative.t).T @ J[3:] / length])
            along = relative.t @ J[3:] / (share * length)
            information = (J_pair.T @ np.linalg.inv(relative.covariance_5) @ J_pair
                           + np.outer(along, along))
        else:
            information = J[:3].T @ J[:3] * _ROTATION_ALONE
        H = np.zeros_like(self._prior.H)
        H[-12:, -12:] = information
        self._prior.add(H, np.zeros(len(H)), self._poses)

    def _found(self, relative: RelativePose, length: float) -> None:
        """Make landmarks of the matches of a keyframe with the frame after it."""
        tuning, anchor = self._tuning, len(self._views) - 2
        self._has_landmarks[anchor] = True
        x, y = relative.x[relative.inliers], relative.y_opt[relative.inliers]
        rho, sigma = inverse_depths(relative.R, relative.t, self._rays(x), self._rays(y))
        ahead, off = rho > 0, tuning.off / self._K[0, 0] * sigma
        surfaces = x[ahead], rho[ahead], off[ahead]
        usable = (rho > 0) & self._distances.describable(x, self._views[anchor].tested.shape)
        x, rho = x[usable], rho[usable]
        here = self._landmarks.of(self._landmarks.seen[:, anchor])
        present = self._projected(in_frame(self._K, self._poses, here, anchor))
        side = tuning.cell * np.sqrt(self._views[anchor].tested.size / tuning.landmarks)
        chosen = choose_landmarks(x, rho, present, side, tuning.landmarks - len(here))
        x, rho = x[chosen], rho[chosen]
        self._landmarks = self._landmarks.joined(Landmarks.at(
            x, rho / length, anchor, len(self._views),
            straightened(self._K, x, self._poses.k1), slopes(*surfaces, x),
            self._distances.strengths(self._views[anchor].tested, np.rint(x).astype(np.int64))))

    def _measure(self) -> None:
        """Look for landmarks in the newest frame, and take where they are seen as observations."""
        sighted = Sighting(self._distances, self._K, self._views, self._poses,
                           self._landmarks).look(self._config.window // 2)
        if sighted is not None:
            self._landmarks.minima[sighted.which, -1] = sighted.places
            self._landmarks.roots[sighted.which, -1] = sighted.roots
            self._landmarks.seen[sighted.which, -1] = True
            self._landmarks.sightings[sighted.which] += 1

    def _refine(self) -> Array:
        """Move poses and depths by Gauss-Newton steps; gives the Hessian over the poses."""
        self._equalise()
        observed, prior = self._observed(), self._prior.at(self._poses)
        for _ in range(self._tuning.steps):
            reduced = self._reduced(observed)
            H, g = self._prior.H + reduced.H, prior.slope + reduced.g
            step = np.asarray(-np.linalg.solve(H + np.diag(1e-9 * np.diag(H)), g), float)
            observed, prior = self._moved(observed, prior, step, reduced.change(step))
        false = np.linalg.norm(observed.residuals, axis=1) > self._tuning.outlier * self._scale
        self._landmarks.seen[observed.landmark[false], observed.frame[false]] = False
        np.subtract.at(self._landmarks.sightings, observed.landmark[false], 1)
        # Of the newest step, as the unit may be a far longer or shorter one.
        length = float(np.linalg.norm(self._poses.between[1][-1, -2]))
        self._landmarks = self._landmarks.of(np.asarray(
            self._landmarks.seen.any(1) & (self._landmarks.rho * length > -self._tuning.beyond)))
        return H

    def _moved(self, observed: Observed, prior: OfPrior, step: Array, change: Array
               ) -> tuple[Observed, OfPrior]:
        """Go a step of the poses and its change of the landmarks, or as much as costs no more."""
        poses, landmarks, scale = self._poses, self._landmarks, self._scale
        cost = self._cost(observed, scale) + prior.cost
        for _ in range(self._tuning.halvings + 1):
            self._poses, self._landmarks = poses.moved(step), landmarks.moved(change)
            moved, there = self._observed(), self._prior.at(self._poses)
            if self._cost(moved, scale) + there.cost <= cost:
                return moved, there
            step, change = step / 2, change / 2
        self._poses, self._landmarks, self._scale = poses, landmarks, scale
        return observed, prior

    def _cost(self, observed: Observed, scale: float) -> float:
        """Tell what observations of a noise cost, robustly."""
        losses, _ = self._robustly(observed, scale)
        return float((losses.sum() + (observed.off**2).sum()) / (2 * scale**2))

    def _robustly(self, observed: Observed, scale: float) -> tuple[Array, Array]:
        """Losses (M,) of observations of a noise, and their weights."""
        return Loss('geman_mcclure', self._tuning.bend * scale)((observed.residuals**2).sum(1))

    def _equalise(self) -> None:
        """Scale the roots in the newest frame so that a typical one is of a pixel."""
        seen = self._landmarks.seen[:, -1]
        roots = self._landmarks.roots[seen, -1]
        if len(roots):
            sizes = np.linalg.norm(roots, axis=(1, 2)) / np.sqrt(2)
            self._landmarks.roots[seen, -1] = roots / median(sizes)
            # The patch where a landmark was found has as much noise as the first that shows it.
            anew = seen & ~self._landmarks.held.any((1, 2))
            self._landmarks.held[anew] = self._landmarks.roots[anew, -1]

    def _observed(self) -> Observed:
        """All observations; their scale is told anew."""
        observed = observe(self._K, self._poses, self._landmarks)
        if len(observed.residuals):
            self._scale = max(noise_scale(observed), self._tuning.least_scale)
        return observed

    def _reduced(self, observed: Observed, lens: bool = False) -> Reduced:
        """Weigh observations robustly, and eliminate the depths; lens: with k1 beside poses."""
        _, weights = self._robustly(observed, self._scale)
        weight = self._scale**-2
        return eliminate(observed, weights * weight, weight, len(self._views), lens)

    def _addition(self, H: Array) -> Addition:
        """Read the newest motion off the window, and how sure its length is."""
        R = self._poses.R[-1] @ self._poses.R[-2].T
        t = self._poses.t[-1] - R @ self._poses.t[-2]
        length = float(np.linalg.norm(t))
        # Of the newest frame alone, the others held: an inverse of the block, not a block of the
        # inverse, so that what the unit has drifted by before is not in it.
        block = H[-6:, -6:]
        covariance = np.linalg.inv(block + np.diag(1e-12 * np.diag(block)))
        variance = float(unit(t) @ covariance[3:, 3:] @ unit(t))
        # A frame's step turns its translation too.
        J = np.eye(6)
        J[3:, :3] = -skew(t)
        # Where rounding leaves less than nothing, nobody knows.
        return Addition(R, t, length, np.sqrt(variance) if variance > 0 else np.inf,
                        J @ covariance @ J.T, self._onward())

    def _onward(self) -> Array:
        """
        Go on (4, 4) from where the camera before was told to be.

        By the step to the newest frame, and a part of what the one before has been refined by: a
        track drifts less by it, but need not jump.
        """
        before, newest = self._poses.camera(-2), self._poses.camera(-1)
        refined = np.linalg.inv(self._told) @ before
        mended, share = np.eye(4), self._tuning.mended
        mended[:3, :3] = rotation_exp(share * rotation_log(refined[:3, :3]))
        mended[:3, 3] = share * refined[:3, 3]
        return np.asarray(mended @ np.linalg.inv(before) @ newest)

    def _learn_lens(self) -> None:
        """
        Ask the window which k1 suits it, before its oldest keyframe goes.

        As each landmark is in as many windows as there are keyframes, each of them tells so much
        less. What frames that are gone told stays as it was with the k1 of then.
        """
        observed = observe(self._K, self._poses, self._landmarks)
        told = self._reduced(observed, lens=True).of_k1()
        _, weights = self._robustly(observed, self._scale)
        if told.curvature > 0:
            self.lens = self.lens.told(
                self._poses.k1 + told.step, self._tuning.keyframes / told.curvature,
                self._scale * np.sqrt(told.curvature / weights.sum()))
            self._poses = replace(self._poses, k1=self.lens.left)

    def _settle(self, chosen: NDArray[np.bool_]) -> None:
        """Take what some landmarks tell into the prior, and drop them, before a frame goes."""
        everything = self._landmarks
        self.settled = np.concatenate([self.settled, self._places(chosen)])
        self._landmarks = everything.of(chosen)
        reduced = self._reduced(observe(self._K, self._poses, self._landmarks))
        self._prior.add(reduced.H, reduced.g, self._poses)
        self._landmarks = everything.of(~chosen)

    def _forget(self, frame: int) -> None:
        """Eliminate a frame from the prior, and drop it with its landmarks."""
        self._poses = self._poses.without_frame(frame)
        self._prior = self._prior.without_frame(frame)
        self._landmarks = self._landmarks.without_frame(frame)
        self._landmarks = self._landmarks.of(np.asarray(self._landmarks.seen.any(1)))
        lists: tuple[list[Any], ...] = (
            self._views, self._is_keyframe, self._has_landmarks)
        for things in lists:
            del things[frame]


def _weighted_median(values: Array, weights: Array) -> float:
    order = np.argsort(values, kind='stable')
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, total[-1] / 2)])
