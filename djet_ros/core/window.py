"""
A sliding window of keyframes and shared landmarks, which ties the lengths of steps together.

A landmark has an inverse depth in its anchor, the frame that created it, and the descriptor of its
patch there. Each later frame samples the landmark's surface again (`core.sighting`): features are
not detected again, so tracks do not drift. `djet_ros.core.bundle` refines poses and depths
jointly. A frame that leaves the window is marginalised into a prior on the others, with its
landmarks (Leutenegger et al., "Keyframe-based visual-inertial odometry using nonlinear
optimization", IJRR 2015). So is a frame between keyframes, with the landmarks that it was the last
to observe: after a large rotation these may be the only link between the lengths of the steps
before and after.
"""

from __future__ import annotations

from copy import copy, deepcopy
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from djet_ros.core.bundle import (
    eliminate,
    Landmarks,
    noise_scale,
    observe,
    Observed,
    points_in_frame,
    PosePrior,
    Poses,
    PriorCost,
    projected,
    Reduced,
)
from djet_ros.core.correction import motion_shift, OF_CAMERA
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.geometry import (
    inverse_depths,
    norms,
    rays,
    rotation_exp,
    rotation_log,
    skew,
    sphere_tangents,
    unit,
)
from djet_ros.core.jet import LEAST_CURVATURE, Loss, robust_scale
from djet_ros.core.known_depths import KnownDepths, Lengths
from djet_ros.core.landmark_choice import choose_landmarks
from djet_ros.core.paraboloid import median
from djet_ros.core.radial import undistort_image
from djet_ros.core.self_calibration import SelfCalibration
from djet_ros.core.sighting import Sighting
from djet_ros.core.slants import slopes
from djet_ros.core.surfaces import DescriptorDistances
from djet_ros.core.types import Array, Pose, RelativePose, View
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class WindowTuning:
    """Constants of the window, each with its source ("chosen" means not searched)."""

    # chosen for the cost: twice as many of either changed the drift on real streets only by noise
    keyframes: int = 6
    landmarks: int = 160
    # pixels: median displacement of landmarks since the last keyframe, without that by rotation,
    # that makes a frame a keyframe; 10 costs a third more and drifts as much
    parallax: float = 25.0
    # chosen: share of the landmarks that are lost that makes a frame a keyframe
    lost: float = 0.4
    # chosen: side of the cells that landmarks are spread over, relative to cells of one landmark
    # each
    cell: float = 0.75
    # chosen: Gauss-Newton steps for each frame; four give the same result
    steps: int = 2
    # chosen: halvings of a step that would increase the cost: where the camera hardly moved, or
    # rotated by much, depths are so uncertain that a full step may lead anywhere
    max_halvings: int = 6
    # robust standard deviations beyond which an observation is an outlier, and the scale of the
    # loss
    outlier: float = 4.0
    loss_scale: float = 3.0
    # pixels; chosen, below the noise on rendered streets, which is 0.04
    least_scale: float = 0.02
    # pixels; chosen: error of inliers that slants are fitted to
    slant_noise: float = 0.1
    # rad; chosen: negative parallax of a step that noise may give to a point at infinity
    negative_parallax: float = 0.01
    # chosen: fewer landmarks do not determine a length
    min_landmarks: int = 8
    # standard deviations, the usual three, that the median inverse depth of a pair has to exceed
    depth_over_noise: float = 3.0
    # chosen: relative standard deviations of the length of a pair: from depths around it, and of a
    # guess; landmarks that both frames observe determine it far better
    length_sigma: float = 0.02
    guess_sigma: float = 0.5
    # chosen: and up to which a less certain length still bounds the guess. Beyond, it may be all
    # error: with a rolling shutter lengths would shrink ever more
    bounding_sigma: float = 0.67
    # chosen: share of the larger image side within which points have about the same depth, and the
    # relative standard deviation of a length by such neighbours, besides that of its noise: after
    # a frame between, lengths differed by 1 to 2 % on streets and indoors
    around: float = 0.05
    around_sigma: float = 0.1
    # chosen: share of the previous frame's refinement that a step corrects. With all of it the
    # track would jump; with none it would drift twice as much over a hundred frames
    correction_share: float = 0.2
    # chosen: most drift of the logarithm of lengths that a correction of the camera takes back
    most_drift: float = 0.5


WINDOW_TUNING = WindowTuning()

# Relative standard deviation of the first length, which is the unit of the track.
_UNIT_SIGMA = 1e-4

# Information on the rotation of a pair without parallax, which has no covariance: 1 mrad.
_ROTATION_INFORMATION = 1e6


@dataclass(frozen=True)
class WindowStep:
    """
    Motion of the newest frame as the window estimates it, with its length.

    R (3, 3), t (3,) in the unit of the track: x_new = R x_before + t; sigma: standard deviation of
    the length, given the poses of the frames before, and covariance (6, 6) of the motion, over R
    -> exp([w]_x) R and t + dt. corrected_motion: (4, 4) pose of the newest camera in the previous
    one as that was published: it includes a share of the refinement of the previous pose since.
    """

    R: Array
    t: Array
    length: float
    sigma: float
    covariance: Array
    corrected_motion: Array


class _Measured(NamedTuple):
    """A length and its standard deviation; noise may make a length of nearly zero negative."""

    length: float
    sigma: float

    @property
    def share(self) -> float:
        """Return the standard deviation relative to the length."""
        return self.sigma / self.length if self.length > 0 else np.inf

    def fused(self, other: _Measured) -> float:
        """Return the mean of both lengths, weighted by their variances."""
        weight = self.sigma**2 / (self.sigma**2 + other.sigma**2)
        return self.length + weight * (other.length - self.length)


class Window:
    """
    Poses of keyframes and of the newest frame, and the inverse depths of their landmarks.

    The unit is the length of the first pair that is added. Holds at most `keyframes` + 1 images.

    final_landmarks: (M, 3) landmarks, in the newest frame, that were refined for the last time;
    calibration: estimate of what that of the camera gets wrong.
    """

    def __init__(self, config: EstimatorConfig, tuning: WindowTuning = WINDOW_TUNING) -> None:
        self._config, self._tuning = config, tuning
        self._distances = DescriptorDistances(config)

    def start(self, view: View, calibration: SelfCalibration | None = None,
              turn: Array | None = None) -> None:
        """
        Reset everything but the estimate of the camera; this frame is the first.

        turn: rotation (3, 3) from the newest frame before, if both were taken at about the same
        place: depths around its landmarks then give the length of the next pair.
        """
        self._scene = None if turn is None else self._scene_after(turn)
        self._K, self._views = view.K, [view]
        self.calibration = calibration or SelfCalibration.unknown(view.K, view.gray.shape)
        self._poses = Poses(np.eye(3)[None], np.zeros((1, 3)))
        self._is_keyframe, self._has_landmarks = [True], [False]
        # Whether the newest frame would be a keyframe, but has no parallax; and whether the one
        # before it has just become one.
        self._is_due = self._became_keyframe = False
        self._landmarks = Landmarks.at(np.empty((0, 2)), np.empty(0), 0, 1)
        self._prior = PosePrior.holding(self._poses)
        self._scale = 1.0
        # Derivatives of the logarithm of the newest length by what may be wrong with the camera.
        self._length_by_camera = np.zeros(OF_CAMERA)
        # The newest camera as it was published, in the frame of the oldest keyframe; its pose may
        # have been refined since.
        self._published = np.eye(4)
        # The newest pair and its length, if it has a direction.
        self._latest: tuple[RelativePose, float] | None = None
        # The pair whose length was last requested, and its lengths by landmarks.
        self._cached_lengths: tuple[RelativePose, Lengths] | None = None
        self.final_landmarks = np.empty((0, 3))

    def copied(self) -> Window:
        """Return a window that goes on by itself; images are shared."""
        window = copy(self)
        for name in ('_views', '_is_keyframe', '_has_landmarks'):
            setattr(window, name, list(getattr(self, name)))
        for name in ('_landmarks', '_prior', '_published'):
            setattr(window, name, deepcopy(getattr(self, name)))
        return window

    @property
    def is_new(self) -> bool:
        """Return whether there is only one frame, so that the next pair defines the unit."""
        return len(self._views) == 1

    @property
    def needs_parallax(self) -> bool:
        """
        Return whether landmarks are to be created from the newest frame and the next one.

        Which needs parallax between the two.
        """
        return self.is_new or self._is_due

    @property
    def is_keyframe(self) -> bool:
        """Return whether the newest frame is a keyframe, or has made the one before it one."""
        return self._is_keyframe[-1] or self._became_keyframe

    def add(self, view: View, relative: RelativePose, guess: float) -> WindowStep:
        """
        Add the next frame and its pair with the newest one, and refine.

        guess: length of the pair, used if landmarks do not determine it. The first pair always
        takes it, and must have a direction.
        """
        # Predict by the pair, with a length from known depths.
        first = self.is_new
        length, expected = ((guess, _Measured(guess, _UNIT_SIGMA * guess)) if first
                            else self._length(view, relative, guess))
        self._cached_lengths = None
        # New landmarks are created from a keyframe and a frame after it, with parallax.
        self._became_keyframe = bool(self._is_due and relative.t.any())
        self._is_keyframe[-1] |= self._became_keyframe
        self._append(view, relative, length)
        self._add_pair(relative, length, expected)
        # Observe old and new landmarks in the frame; then refine all.
        if self._is_keyframe[-2] and not self._has_landmarks[-2] and relative.t.any():
            self._create_landmarks(relative, length)
        self._observe_landmarks()
        before = self._poses.camera(0)[:3, 3]
        H = self._refine()
        # A shift of the window as a whole is no motion of the step. Its position is a gauge
        # freedom; the prior of marginalised frames is only first-order, and its remainder moves
        # the window, the more, the farther it is from its start and the less it is held there.
        self._published[:3, 3] += self._poses.camera(0)[:3, 3] - before
        addition = self._newest_motion(H)
        if first:  # by definition
            addition = replace(addition, length=length)
        # Marginalise the previous frame unless it is a keyframe, and the oldest keyframe beyond
        # the limit.
        self.final_landmarks = np.empty((0, 3))
        if len(self._views) > 2 and not self._is_keyframe[-2]:
            observed = self._landmarks.observed
            self._marginalise_landmarks(observed[:, -2] & ~observed[:, -1])
            self._marginalise_frame(len(self._views) - 2)
        if sum(self._is_keyframe) > self._tuning.keyframes:
            self._update_calibration()
            self._marginalise_landmarks(self._landmarks.anchors == 0)
            self._marginalise_frame(0)
        # Without parallax new keyframes would only drop landmarks.
        lacking = not self._is_keyframe[-1] and self._lacks_landmarks()
        self._is_keyframe[-1] |= bool(lacking and relative.t.any())
        self._is_due = lacking and not self._is_keyframe[-1]
        self._latest = (relative, addition.length) if relative.t.any() else None
        return addition

    def record_published(self, motion: Array) -> None:
        """Record the motion (4, 4) published for the newest step, in the unit of the track."""
        self._published = self._published @ motion

    def correct_images(self, newest: View) -> float:
        """
        Continue with images of the camera as it is expected to be, of which newest is the first.

        Poses and landmarks become those that the corrected images would have given, from the start
        of the track on, and observations are moved to where these would show them. Returns the
        ratio of the length of the newest step to what it was.
        """
        length = self._newest_length
        before = self._K, self.calibration.corrected.k1
        corrected = self.calibration.after_correction()
        self._adapt_to(np.subtract(corrected.corrected, self.calibration.corrected))
        self._K, self.calibration = newest.K, corrected
        after = self._K, self.calibration.corrected.k1
        self._views = [*(self._corrected(view, before) for view in self._views[:-1]), newest]
        moved = self._landmarks.with_corrected_images(before, after)
        # Patches that leave the image are dropped.
        inside = self._distances.describable(moved.anchor_pixels, newest.surface_gray.shape)
        self._landmarks = moved.of(inside)
        self._latest = None
        return self._newest_length / length if length > 0 else 1.0

    @property
    def _newest_length(self) -> float:
        return float(np.linalg.norm(self._poses.relative_motions[1][-1, -2]))

    def _adapt_to(self, change: Array) -> None:
        """Move poses and landmarks by what a change (4,) of the camera makes of them."""
        published = np.linalg.inv(self._poses.camera(-1)) @ self._published
        reduced = self._reduced(self._observed())
        by_camera = self._poses_by_camera(reduced)
        # To first order, so long lengths must not become negative.
        drift = abs(float(self._newest_by_camera(by_camera) @ change))
        change = change * min(self._tuning.most_drift / max(drift, 1e-9), 1.0)
        step = by_camera @ change
        self._landmarks = self._landmarks.moved(reduced.change(np.concatenate([change, step])))
        self._poses = self._poses.moved(step)
        self._prior = self._prior.with_corrected_camera(change)
        # What is published already stays; the path goes on from there.
        self._published = self._poses.camera(-1) @ published

    def _corrected(self, view: View, before: tuple[Array, float]) -> View:
        """
        Correct a view that was undistorted with another camera matrix and k1 before.

        Only its images that are still needed: landmarks are not created in it again.
        """
        gray, _ = undistort_image(view.gray, self._K, self.calibration.corrected.k1,
                                  before=before)
        return replace(view, gray=gray, K=self._K, surface_gray=self._distances.smoothed(gray))

    def landmarks(self) -> Array:
        """Return the reliable landmarks as points (M, 3) in the newest frame."""
        return self._places(np.ones(len(self._landmarks), bool))

    def _places(self, chosen: NDArray[np.bool_]) -> Array:
        """Return the reliable ones of landmarks (N,), as points (M, 3) in the newest frame."""
        reliable = self._landmarks.of(np.asarray(
            chosen & (self._landmarks.observed.sum(1) > 1) & (self._landmarks.rho > 0)))
        places = points_in_frame(self._K, self._poses, reliable, len(self._views) - 1)
        return np.asarray(places / reliable.rho[:, None])

    def _length(self, view: View, relative: RelativePose, guess: float
                ) -> tuple[float, _Measured]:
        """
        Return the length at which to search for landmarks in a view, and the expected one.

        By landmarks with a match nearby; if too few of them are in view, by the matches of the
        previous pair, and then by matches around landmarks. Where these hardly determine it, the
        guess is expected. But next to a standstill it may be far too long, and hardly any landmark
        where it predicts them; then they are sought at the mean of both lengths.
        """
        by_guess = _Measured(guess, self._tuning.guess_sigma * guess)
        measured = self._measured(relative) if relative.t.any() else None
        if measured is None:
            return guess, by_guess
        if measured.share < self._tuning.guess_sigma:
            return measured.length, measured
        if measured.share > self._tuning.bounding_sigma:
            return guess, by_guess
        mean = measured.fused(by_guess)
        found = [self._count_found(view, relative, length) for length in (guess, mean)]
        return guess if found[0] > found[1] / 2 else mean, by_guess

    def _count_found(self, view: View, relative: RelativePose, length: float) -> int:
        """Count the landmarks that are found in a view after a pair of some length."""
        poses = self._poses.joined(*self._moved(relative, length))
        sighted = Sighting(self._distances, self._K, [*self._views, view], poses,
                           self._landmarks.with_frame()).observe(self._config.window // 2)
        return 0 if sighted is None else len(sighted.indices)

    def _moved(self, relative: RelativePose, length: float) -> tuple[Array, Array]:
        """Return the pose R (3, 3), t (3,) after a pair of some length."""
        R, t = self._poses.R[-1], self._poses.t[-1]
        return relative.R @ R, relative.R @ t + length * relative.t

    def _measured(self, relative: RelativePose) -> _Measured | None:
        """Return the length by points of known depth; None for few of them."""
        lengths = self._lengths_by_landmarks(relative)
        if len(lengths.values) < self._tuning.min_landmarks and self._latest is not None:
            lengths = KnownDepths.of_pair(self._K, *self._latest).lengths(relative)
        if len(lengths.values) < self._tuning.min_landmarks:
            return self._measured_around(self._known_depths(), relative)
        return self._median(lengths, self._tuning.length_sigma)

    def _scene_after(self, turn: Array) -> KnownDepths | None:
        """Return the depths around the newest frame as seen after a rotation (3, 3) of it."""
        scene = self._scene if self.is_new else self._known_depths()
        if (scene is None or len(scene.rho) < self._tuning.min_landmarks) and self._latest:
            scene = KnownDepths.of_pair(self._K, *self._latest)
        return None if scene is None else scene.rotated(turn)

    def first_length(self, relative: RelativePose) -> tuple[float, float] | None:
        """
        Return the length of a first pair and its relative standard deviation; None if unknown.

        By the depths around the landmarks of the window before: the scene stays where it was.
        """
        measured = None if self._scene is None else self._measured_around(self._scene, relative)
        if measured is None or measured.share >= self._tuning.guess_sigma:
            return None
        return measured.length, measured.share

    def _measured_around(self, known: KnownDepths, relative: RelativePose) -> _Measured | None:
        """Return the length by points nearby, as the pair may have no match of the known ones."""
        radius = self._tuning.around * max(self._views[-1].gray.shape)
        return self._median(known.lengths(relative, radius), self._tuning.around_sigma)

    def _median(self, lengths: Lengths, share: float) -> _Measured | None:
        """Return the median with its standard deviation, at least a share; None for few points."""
        if len(lengths.values) < self._tuning.min_landmarks:
            return None
        length = lengths.median()
        return _Measured(length, float(np.hypot(share * length, lengths.noise())))

    def pair_length(self, relative: RelativePose) -> tuple[float, float] | None:
        """
        Return the length of a pair by landmarks and its standard error; None if there are too few.

        For a translation of zero the depths of the pair are noise, and the length is zero within
        its standard error.
        """
        lengths = self._lengths_by_landmarks(relative)
        if len(lengths.values) < self._tuning.min_landmarks:
            return None
        return lengths.median(), lengths.standard_error()

    def length_of_displacement(self, pixels: float) -> float:
        """
        Return the length of a translation that displaces landmarks by so much, the median of them.

        Across the viewing direction. Zero if there are too few.
        """
        rho = self._known_depths().rho
        if len(rho) < self._tuning.min_landmarks:
            return 0.0
        return float(pixels / (self._K[0, 0] * median(rho)))

    def count_agreeing(self, pose: Pose, x: Array, y: Array) -> tuple[int, int]:
        """
        Count the landmarks that agree with a motion, and those that were tested.

        pose: from the newest frame to another one, the sign of t is free; x, y: (N, 2) matched
        pixels of the two. Landmarks are tested that have a match and more than two observations,
        so that their depths do not come from one pair.
        """
        finite = np.isfinite(y).all(1)
        return self._known_depths(self._landmarks.observation_counts > 2).count_agreeing(
            pose, x[finite], y[finite])

    def _lengths_by_landmarks(self, relative: RelativePose) -> Lengths:
        """Return the lengths of a pair by each landmark with a match."""
        # Needed twice for a pair: whether the camera moved, and how far.
        if self._cached_lengths is None or self._cached_lengths[0] is not relative:
            self._cached_lengths = relative, self._known_depths().lengths(relative)
        return self._cached_lengths[1]

    def _known_depths(self, chosen: NDArray[np.bool_] | None = None) -> KnownDepths:
        """Return the landmarks that the newest frame observes, or the chosen (N,) ones of them."""
        observed = self._landmarks.observed[:, -1]
        return KnownDepths.of_landmarks(
            self._K, self._poses,
            self._landmarks.of(observed if chosen is None else observed & chosen),
            len(self._views) - 1)

    def _lacks_landmarks(self) -> bool:
        """Return whether landmarks have moved since the last keyframe, or were lost."""
        newest = len(self._views) - 1
        last = max(index for index, chosen in enumerate(self._is_keyframe) if chosen)
        visible = self._landmarks.of(self._landmarks.observed[:, newest])
        if len(visible) < (1 - self._tuning.lost) * self._tuning.landmarks:
            return True
        R = self._poses.R[newest] @ self._poses.R[last].T
        rotated, moved = (projected(self._K, places) for places in (
            points_in_frame(self._K, self._poses, visible, last) @ R.T,
            points_in_frame(self._K, self._poses, visible, newest)))
        return bool(median(norms(moved - rotated)) > self._tuning.parallax)

    def _append(self, view: View, relative: RelativePose, length: float) -> None:
        new = self._moved(relative, length)
        self._poses, self._prior = self._poses.joined(*new), self._prior.with_frame(*new)
        # The second frame is a keyframe, since it defines the unit.
        self._is_keyframe.append(self.is_new)
        self._has_landmarks.append(False)
        self._views.append(view)
        self._landmarks = self._landmarks.with_frame()

    def _add_pair(self, relative: RelativePose, length: float, expected: _Measured) -> None:
        """
        Add the rotation and translation direction of the pair to the prior.

        And its expected length: if landmarks hardly determine it, a prior linearised elsewhere
        would move it arbitrarily. length: at which the newest frame is now.
        """
        R, t = relative.R, length * relative.t
        # With steps (omega, upsilon) of the previous frame and of the new one, the motion rotates
        # by omega_new - R omega_before and shifts by upsilon_new - [t]x omega_new - R
        # upsilon_before.
        J = np.zeros((6, 12))
        J[:3, :3], J[3:, 3:6] = -R, -R
        J[:3, 6:9], J[3:, 6:9], J[3:, 9:] = np.eye(3), -skew(t), np.eye(3)
        if relative.t.any():
            J_pair = np.concatenate([-motion_shift(relative, self._K), np.concatenate(
                [J[:3], sphere_tangents(relative.t).T @ J[3:] / length])], axis=1)
            # The expected length is that of earlier steps, and depends on the camera as they do.
            along = np.concatenate([-length * self._length_by_camera,
                                    relative.t @ J[3:]]) / expected.sigma
            information = (J_pair.T @ np.linalg.inv(relative.covariance_5) @ J_pair
                           + np.outer(along, along))
            gradient = along * (length - expected.length) / expected.sigma
        else:
            by_poses = np.concatenate([np.zeros((3, OF_CAMERA)), J[:3]], axis=1)
            information = by_poses.T @ by_poses * _ROTATION_INFORMATION
            gradient = np.zeros(OF_CAMERA + 12)
        H, g = np.zeros_like(self._prior.H), np.zeros_like(self._prior.g)
        # The camera comes first, the newest two frames last.
        places = np.r_[:OF_CAMERA, len(g) - 12:len(g)]
        H[np.ix_(places, places)], g[places] = information, gradient
        self._prior.add(H, g, self._poses)

    def has_depths(self, relative: RelativePose) -> bool:
        """
        Return whether most depths of a pair with a direction are more than noise of its matches.

        Otherwise landmarks would be those that noise brings nearer: behind the camera, where it
        brings the others, there are none.
        """
        _, rho, sigma = self._triangulated(relative)
        return self._exceed_noise(relative, rho, sigma)

    def _exceed_noise(self, relative: RelativePose, rho: Array, sigma: Array) -> bool:
        noise = robust_scale(relative.residuals[relative.inliers]) / self._K[0, 0]
        return bool(median(rho / sigma) > self._tuning.depth_over_noise * noise)

    def _triangulated(self, relative: RelativePose) -> tuple[Array, Array, Array]:
        """Return pixels (M, 2) of a pair's inliers, their inverse depths and their deviations."""
        x, y = relative.x[relative.inliers], relative.y_opt[relative.inliers]
        return x, *inverse_depths(relative.R, relative.t, rays(self._K, x), rays(self._K, y))

    def _create_landmarks(self, relative: RelativePose, length: float) -> None:
        """Create landmarks from a keyframe and the frame after it, unless depths are noise."""
        tuning, anchor = self._tuning, len(self._views) - 2
        x, rho, sigma = self._triangulated(relative)
        if not self._exceed_noise(relative, rho, sigma):
            return
        self._has_landmarks[anchor] = True
        ahead, noise = rho > 0, tuning.slant_noise / self._K[0, 0] * sigma
        surfaces = x[ahead], rho[ahead], noise[ahead]
        usable = (rho > 0) & self._distances.describable(x, self._views[anchor].surface_gray.shape)
        x, rho = x[usable], rho[usable]
        visible = self._landmarks.of(self._landmarks.observed[:, anchor])
        present = projected(self._K, points_in_frame(self._K, self._poses, visible, anchor))
        side = tuning.cell * np.sqrt(self._views[anchor].surface_gray.size / tuning.landmarks)
        chosen = choose_landmarks(x, rho, present, side, tuning.landmarks - len(visible))
        x, rho = x[chosen], rho[chosen]
        self._landmarks = self._landmarks.joined(Landmarks.at(
            x, rho / length, anchor, len(self._views), slopes(*surfaces, x),
            self._distances.strengths(self._views[anchor].surface_gray,
                                      np.rint(x).astype(np.int64))))

    def _observe_landmarks(self) -> None:
        """Observe landmarks in the newest frame."""
        sighted = Sighting(self._distances, self._K, self._views, self._poses,
                           self._landmarks).observe(self._config.window // 2)
        if sighted is not None:
            self._landmarks.minima[sighted.indices, -1] = sighted.places
            self._landmarks.roots[sighted.indices, -1] = sighted.roots
            self._landmarks.observed[sighted.indices, -1] = True
            self._landmarks.observation_counts[sighted.indices] += 1

    def _refine(self) -> Array:
        """Refine poses and depths by Gauss-Newton; returns the Hessian over the poses."""
        self._normalise_roots()
        observed, prior = self._observed(), self._prior.at(self._poses)
        for _ in range(self._tuning.steps):
            reduced = self._reduced(observed)
            H = self._prior.of_poses + reduced.H[OF_CAMERA:, OF_CAMERA:]
            step = -_solved(H, prior.gradient + reduced.g[OF_CAMERA:])
            observed, prior = self._line_search(observed, prior, step, reduced.change(
                np.concatenate([np.zeros(OF_CAMERA), step])))
        self._length_by_camera = self._newest_by_camera(self._poses_by_camera(reduced))
        outliers = norms(observed.residuals) > self._tuning.outlier * self._scale
        self._landmarks.observed[observed.landmark[outliers], observed.frame[outliers]] = False
        np.subtract.at(self._landmarks.observation_counts, observed.landmark[outliers], 1)
        # Relative to the newest step: the unit may be much longer or shorter.
        in_front = self._landmarks.rho * self._newest_length > -self._tuning.negative_parallax
        self._landmarks = self._landmarks.of(
            np.asarray(self._landmarks.observed.any(1) & in_front))
        return H

    def _poses_by_camera(self, reduced: Reduced) -> Array:
        """Return how the poses depend on the camera, (6 F, 4)."""
        over_poses = (self._prior.H + reduced.H)[OF_CAMERA:]
        return -_solved(over_poses[:, OF_CAMERA:], over_poses[:, :OF_CAMERA])

    def _newest_by_camera(self, by_camera: Array) -> Array:
        """
        Return how the logarithm of the newest length depends on the camera, (4,).

        by_camera: (6 F, 4) of the poses. Without a length it is that of the step before.
        """
        R, t = (motions[-1, -2] for motions in self._poses.relative_motions)
        squared = float(t @ t)
        if not squared:
            return self._length_by_camera
        by_poses = np.concatenate([-t @ R, t]) / squared
        return np.asarray(by_poses @ by_camera[[-9, -8, -7, -3, -2, -1]])

    def _line_search(self, observed: Observed, prior: PriorCost, step: Array, change: Array
                     ) -> tuple[Observed, PriorCost]:
        """Apply a step of poses and landmarks, halved until the cost does not grow."""
        poses, landmarks, scale = self._poses, self._landmarks, self._scale
        cost = self._cost(observed, scale) + prior.cost
        for _ in range(self._tuning.max_halvings + 1):
            self._poses, self._landmarks = poses.moved(step), landmarks.moved(change)
            moved, moved_prior = self._observed(), self._prior.at(self._poses)
            if self._cost(moved, scale) + moved_prior.cost <= cost:
                return moved, moved_prior
            step, change = step / 2, change / 2
        self._poses, self._landmarks, self._scale = poses, landmarks, scale
        return observed, prior

    def _cost(self, observed: Observed, scale: float) -> float:
        """Return the robust cost of observations with a noise `scale`."""
        losses, _ = self._robust_losses(observed, scale)
        return float((losses.sum() + (observed.anchor_residuals**2).sum()) / (2 * scale**2))

    def _robust_losses(self, observed: Observed, scale: float) -> tuple[Array, Array]:
        """Return the losses (M,) of observations with a noise `scale`, and their weights."""
        return self._loss(scale)((observed.residuals**2).sum(1))

    def _loss(self, scale: float) -> Loss:
        return Loss('geman_mcclure', self._tuning.loss_scale * scale)

    def _normalise_roots(self) -> None:
        """Scale the roots of precision in the newest frame to a median of one pixel."""
        observed = self._landmarks.observed[:, -1]
        roots = self._landmarks.roots[observed, -1]
        if len(roots):
            sizes = np.linalg.norm(roots, axis=(1, 2)) / np.sqrt(2)
            self._landmarks.roots[observed, -1] = roots / median(sizes)
            # The anchor's patch is as noisy as the first one that observes it.
            new = observed & ~self._landmarks.anchor_roots.any((1, 2))
            self._landmarks.anchor_roots[new] = self._landmarks.roots[new, -1]

    def _observed(self) -> Observed:
        """Return all observations, and update the noise scale."""
        observed = observe(self._K, self._poses, self._landmarks)
        if len(observed.residuals):
            self._scale = max(noise_scale(observed), self._tuning.least_scale)
        return observed

    def _reduced(self, observed: Observed) -> Reduced:
        """Weight observations robustly and eliminate landmarks."""
        _, weights = self._robust_losses(observed, self._scale)
        weight = self._scale**-2
        return eliminate(observed, weights * weight, weight, len(self._views))

    def _newest_motion(self, H: Array) -> WindowStep:
        """Return the newest motion, and the uncertainty of its length."""
        R = self._poses.R[-1] @ self._poses.R[-2].T
        t = self._poses.t[-1] - R @ self._poses.t[-2]
        length = float(np.linalg.norm(t))
        # Conditional on the other frames: the inverse of the block, not a block of the inverse, so
        # that the drift of the unit before is not included.
        block = H[-6:, -6:]
        covariance = np.linalg.inv(block + np.diag(1e-12 * np.diag(block)))
        variance = float(unit(t) @ covariance[3:, 3:] @ unit(t))
        # A frame's step also rotates its translation.
        J = np.eye(6)
        J[3:, :3] = -skew(t)
        # Rounding may leave no positive variance.
        return WindowStep(R, t, length, np.sqrt(variance) if variance > 0 else np.inf,
                          J @ covariance @ J.T, self._corrected_motion())

    def _corrected_motion(self) -> Array:
        """
        Return the newest camera (4, 4) relative to the previous one as it was published.

        The step to the newest frame, with a share of the previous frame's refinement: it reduces
        drift without a jump.
        """
        before, newest = self._poses.camera(-2), self._poses.camera(-1)
        refined = np.linalg.inv(self._published) @ before
        correction, share = np.eye(4), self._tuning.correction_share
        correction[:3, :3] = rotation_exp(share * rotation_log(refined[:3, :3]))
        correction[:3, 3] = share * refined[:3, 3]
        return np.asarray(correction @ np.linalg.inv(before) @ newest)

    def _update_calibration(self) -> None:
        """
        Update the estimate of the camera, before the oldest keyframe is marginalised.

        Each landmark is in as many windows as there are keyframes, so each window's information is
        divided by that number. A robust loss curves less than its weights say (Huber, Robust
        Statistics, section 7.6), for residuals of two numbers by half as much on average: a step
        by the weights would be too short.
        """
        observed = observe(self._K, self._poses, self._landmarks)
        if not len(observed.residuals):
            return
        H, g = self._reduced(observed).of_camera()
        loss, squared = self._loss(self._scale), (observed.residuals**2).sum(1)
        _, weights = loss(squared)
        flattened = max(float((1 + loss.curvature(squared).sum() / weights.sum()) / 2),
                        LEAST_CURVATURE)
        # Per observation, and in pixels.
        share = self._scale**2 / weights.sum()
        self.calibration = self.calibration.update(
            share * H, share / flattened * g, self._tuning.keyframes * share / flattened**2)

    def _marginalise_landmarks(self, chosen: NDArray[np.bool_]) -> None:
        """Marginalise the chosen landmarks (N,) into the prior, before a frame is removed."""
        landmarks = self._landmarks
        self.final_landmarks = np.concatenate([self.final_landmarks, self._places(chosen)])
        self._landmarks = landmarks.of(chosen)
        reduced = self._reduced(observe(self._K, self._poses, self._landmarks))
        self._prior.add(reduced.H, reduced.g, self._poses)
        self._landmarks = landmarks.of(~chosen)

    def _marginalise_frame(self, frame: int) -> None:
        """Marginalise a frame, and remove it with its landmarks."""
        self._poses = self._poses.without_frame(frame)
        self._prior = self._prior.without_frame(frame)
        self._landmarks = self._landmarks.without_frame(frame)
        self._landmarks = self._landmarks.of(np.asarray(self._landmarks.observed.any(1)))
        lists: tuple[list[Any], ...] = (
            self._views, self._is_keyframe, self._has_landmarks)
        for per_frame in lists:
            del per_frame[frame]


def _solved(H: Array, right: Array) -> Array:
    """Solve equations over poses, whose position and scale next to nothing may determine."""
    return np.asarray(np.linalg.solve(H + np.diag(1e-9 * np.diag(H)), right), float)
