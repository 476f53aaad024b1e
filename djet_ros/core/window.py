"""
A sliding window of keyframes and shared landmarks, which ties the lengths of steps together.

A landmark has an inverse depth in its anchor, the frame that created it, and the descriptor of its
patch there. Each later frame samples the landmark's surface again (`core.sighting`): features are
not detected again, so tracks do not drift. `core.joint_problem` refines poses and depths jointly.
A frame that leaves the window is marginalised into a prior on the others, with its landmarks. So
is a frame between keyframes, with the landmarks that it was the last to observe: after a large
rotation these may be the only link between the lengths of the steps before and after.
"""

from __future__ import annotations

from copy import copy, deepcopy
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from djet_ros.core.bundle import Landmarks, projected
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.geometry import (
    fit_rotation,
    inlier_rays,
    inverse_depths,
    norms,
    rays,
    rotation_exp,
    rotation_log,
    skew,
    unit,
)
from djet_ros.core.jet import robust_scale
from djet_ros.core.joint_problem import JointProblem
from djet_ros.core.known_depths import KnownDepths, Lengths
from djet_ros.core.landmark_choice import choose_landmarks
from djet_ros.core.medians import median
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
    """Constants of the window; "chosen" is by judgement or trial, not derived."""

    # chosen for the cost: with ten, scales drift as much
    keyframes: int = 6
    # chosen: with 160, a wrong calibration is known later in a turn, and KITTI 03 drifted twice as
    # much in the mean over small changes; 320 are no better
    landmarks: int = 240
    # pixels: median displacement of landmarks since the last keyframe, without that by rotation,
    # that makes a frame a keyframe; 10 costs a third more and drifts as much
    parallax: float = 25.0
    # chosen: share of the landmarks that are lost that makes a frame a keyframe
    lost: float = 0.4
    # chosen: side of the cells that landmarks are spread over, relative to cells of one landmark
    # each
    cell: float = 0.75
    # pixels; chosen: error of inliers that slants are fitted to
    slant_noise: float = 0.1
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


WINDOW_TUNING = WindowTuning()

# Relative standard deviation of the first length, which is the unit of the track.
_UNIT_SIGMA = 1e-4


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
        self._joint, self._views = JointProblem.of_first_frame(view.K), [view]
        self.calibration = calibration or SelfCalibration.unknown(view.K, view.gray.shape)
        self._is_keyframe, self._has_landmarks = [True], [False]
        # Whether the newest frame would be a keyframe, but has no parallax; and whether the one
        # before it has just become one.
        self._is_due = self._became_keyframe = False
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
        for name in ('_joint', '_published'):
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
    def determines_translation(self) -> bool:
        """Return whether the newest frame observes three landmarks: two outvote a wrong one."""
        return int(self._joint.landmarks.observed[:, -1].sum()) > 2

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
        self._joint.add_pair(relative, length, *expected)
        # Observe old and new landmarks in the frame; then refine all.
        if self._is_keyframe[-2] and not self._has_landmarks[-2] and relative.t.any():
            self._create_landmarks(relative, length)
        self._observe_landmarks()
        before = self._joint.poses.camera(0)[:3, 3]
        H = self._joint.refine()
        # A shift of the window as a whole is no motion of the step. Its position is a gauge
        # freedom; the prior of marginalised frames is only first-order, and its remainder moves
        # the window, the more, the farther it is from its start and the less it is held there.
        self._published[:3, 3] += self._joint.poses.camera(0)[:3, 3] - before
        addition = self._newest_motion(H)
        if first:  # by definition
            addition = replace(addition, length=length)
        # Marginalise the previous frame unless it is a keyframe, and the oldest keyframe beyond
        # the limit.
        self.final_landmarks = np.empty((0, 3))
        if len(self._views) > 2 and not self._is_keyframe[-2]:
            observed = self._joint.landmarks.observed
            self._marginalise_landmarks(observed[:, -2] & ~observed[:, -1])
            self._marginalise_frame(len(self._views) - 2)
        if sum(self._is_keyframe) > self._tuning.keyframes:
            self._update_calibration()
            self._marginalise_landmarks(self._joint.landmarks.anchors == 0)
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
        length = self._joint.newest_length
        before = self._joint.K, self.calibration.corrected.k1
        corrected = self.calibration.after_correction()
        published = np.linalg.inv(self._joint.poses.camera(-1)) @ self._published
        self._joint.adapt_to(np.subtract(corrected.corrected, self.calibration.corrected))
        # What is published already stays; the path goes on from there.
        self._published = self._joint.poses.camera(-1) @ published
        self._joint.K, self.calibration = newest.K, corrected
        after = self._joint.K, self.calibration.corrected.k1
        self._views = [*(self._corrected(view, before) for view in self._views[:-1]), newest]
        moved = self._joint.landmarks.with_corrected_images(before, after)
        # Patches that leave the image are dropped.
        inside = self._distances.describable(moved.anchor_pixels, newest.surface_gray.shape)
        self._joint.landmarks = moved.of(inside)
        self._latest = None
        return self._joint.newest_length / length if length > 0 else 1.0

    def _corrected(self, view: View, before: tuple[Array, float]) -> View:
        """
        Correct a view that was undistorted with another camera matrix and k1 before.

        Only its images that are still needed: landmarks are not created in it again.
        """
        K, k1 = self._joint.K, self.calibration.corrected.k1
        gray, _ = undistort_image(view.gray, K, k1, before=before)
        return replace(view, gray=gray, K=K, surface_gray=self._distances.smoothed(gray))

    def landmarks(self) -> Array:
        """Return the reliable landmarks as points (M, 3) in the newest frame."""
        return self._places(np.ones(len(self._joint.landmarks), bool))

    def _places(self, chosen: NDArray[np.bool_]) -> Array:
        """Return the reliable ones of landmarks (N,), as points (M, 3) in the newest frame."""
        landmarks = self._joint.landmarks
        reliable = landmarks.of(np.asarray(
            chosen & (landmarks.observed.sum(1) > 1) & (landmarks.rho > 0)))
        places = self._joint.points_in(len(self._views) - 1, reliable)
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
        poses = self._joint.poses.joined(*self._moved(relative, length))
        sighted = Sighting(self._distances, self._joint.K, [*self._views, view], poses,
                           self._joint.landmarks.with_frame()).observe(self._config.window // 2)
        return 0 if sighted is None else len(sighted.indices)

    def _moved(self, relative: RelativePose, length: float) -> tuple[Array, Array]:
        """Return the pose R (3, 3), t (3,) after a pair of some length."""
        R, t = self._joint.poses.R[-1], self._joint.poses.t[-1]
        turn = relative.R if relative.t.any() else self._turn(relative)
        return turn @ R, turn @ t + length * relative.t

    def _turn(self, relative: RelativePose) -> Array:
        """
        Return the rotation (3, 3) that brings landmarks to where they are after a pair without t.

        Which the pair's rotation may not do, if there is a small translation: a rotation alone
        absorbs that.
        """
        if not relative.inliers.any():
            return relative.R
        return fit_rotation(*inlier_rays(relative, self._joint.K))

    def _measured(self, relative: RelativePose) -> _Measured | None:
        """Return the length by points of known depth; None for few of them."""
        lengths = self._lengths_by_landmarks(relative)
        if len(lengths.values) < self._tuning.min_landmarks and self._latest is not None:
            lengths = KnownDepths.of_pair(self._joint.K, *self._latest).lengths(relative)
        if len(lengths.values) < self._tuning.min_landmarks:
            return self._measured_around(self._known_depths(), relative)
        return self._median(lengths, self._tuning.length_sigma)

    def _scene_after(self, turn: Array) -> KnownDepths | None:
        """Return the depths around the newest frame as seen after a rotation (3, 3) of it."""
        scene = self._scene if self.is_new else self._known_depths()
        if (scene is None or len(scene.rho) < self._tuning.min_landmarks) and self._latest:
            scene = KnownDepths.of_pair(self._joint.K, *self._latest)
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
        return float(pixels / (self._joint.K[0, 0] * median(rho)))

    def count_agreeing(self, pose: Pose, x: Array, y: Array) -> tuple[int, int]:
        """
        Count the landmarks that agree with a motion, and those that were tested.

        pose: from the newest frame to another one, the sign of t is free; x, y: (N, 2) matched
        pixels of the two. Landmarks are tested that have a match and more than two observations,
        so that their depths do not come from one pair.
        """
        finite = np.isfinite(y).all(1)
        return self._known_depths(self._joint.landmarks.observation_counts > 2).count_agreeing(
            pose, x[finite], y[finite])

    def _lengths_by_landmarks(self, relative: RelativePose) -> Lengths:
        """Return the lengths of a pair by each landmark with a match."""
        # Needed twice for a pair: whether the camera moved, and how far.
        if self._cached_lengths is None or self._cached_lengths[0] is not relative:
            self._cached_lengths = relative, self._known_depths().lengths(relative)
        return self._cached_lengths[1]

    def _known_depths(self, chosen: NDArray[np.bool_] | None = None) -> KnownDepths:
        """Return the landmarks that the newest frame observes, or the chosen (N,) ones of them."""
        observed = self._joint.landmarks.observed[:, -1]
        return KnownDepths.of_landmarks(
            self._joint.K, self._joint.poses,
            self._joint.landmarks.of(observed if chosen is None else observed & chosen),
            len(self._views) - 1)

    def _lacks_landmarks(self) -> bool:
        """Return whether landmarks have moved since the last keyframe, or were lost."""
        newest = len(self._views) - 1
        last = max(index for index, chosen in enumerate(self._is_keyframe) if chosen)
        visible = self._joint.observed_in(newest)
        if len(visible) < (1 - self._tuning.lost) * self._tuning.landmarks:
            return True
        R = self._joint.poses.R[newest] @ self._joint.poses.R[last].T
        rotated = projected(self._joint.K, self._joint.points_in(last, visible) @ R.T)
        moved = self._joint.pixels_in(newest, visible)
        return bool(median(norms(moved - rotated)) > self._tuning.parallax)

    def _append(self, view: View, relative: RelativePose, length: float) -> None:
        self._joint.add_frame(*self._moved(relative, length))
        # The second frame is a keyframe, since it defines the unit.
        self._is_keyframe.append(self.is_new)
        self._has_landmarks.append(False)
        self._views.append(view)

    def has_depths(self, relative: RelativePose) -> bool:
        """
        Return whether most depths of a pair with a direction are more than noise of its matches.

        Otherwise landmarks would be those that noise brings nearer: behind the camera, where it
        brings the others, there are none.
        """
        _, rho, sigma = self._triangulated(relative)
        return self._exceed_noise(relative, rho, sigma)

    def _exceed_noise(self, relative: RelativePose, rho: Array, sigma: Array) -> bool:
        noise = robust_scale(relative.residuals[relative.inliers]) / self._joint.K[0, 0]
        return bool(median(rho / sigma) > self._tuning.depth_over_noise * noise)

    def _triangulated(self, relative: RelativePose) -> tuple[Array, Array, Array]:
        """Return pixels (M, 2) of a pair's inliers, their inverse depths and their deviations."""
        x, y = relative.x[relative.inliers], relative.y_opt[relative.inliers]
        rays_x, rays_y = (rays(self._joint.K, pixels) for pixels in (x, y))
        return x, *inverse_depths(relative.R, relative.t, rays_x, rays_y)

    def _create_landmarks(self, relative: RelativePose, length: float) -> None:
        """Create landmarks from a keyframe and the frame after it, unless depths are noise."""
        tuning, anchor = self._tuning, len(self._views) - 2
        x, rho, sigma = self._triangulated(relative)
        if not self._exceed_noise(relative, rho, sigma):
            return
        self._has_landmarks[anchor] = True
        ahead, noise = rho > 0, tuning.slant_noise / self._joint.K[0, 0] * sigma
        surfaces = x[ahead], rho[ahead], noise[ahead]
        usable = (rho > 0) & self._distances.describable(x, self._views[anchor].surface_gray.shape)
        x, rho = x[usable], rho[usable]
        visible = self._joint.observed_in(anchor)
        present = self._joint.pixels_in(anchor, visible)
        side = tuning.cell * np.sqrt(self._views[anchor].surface_gray.size / tuning.landmarks)
        chosen = choose_landmarks(x, rho, present, side, tuning.landmarks - len(visible))
        x, rho = x[chosen], rho[chosen]
        self._joint.landmarks = self._joint.landmarks.joined(Landmarks.at(
            x, rho / length, anchor, len(self._views), slopes(*surfaces, x),
            self._distances.strengths(self._views[anchor].surface_gray,
                                      np.rint(x).astype(np.int64))))

    def _observe_landmarks(self) -> None:
        """Observe landmarks in the newest frame."""
        sighted = Sighting(self._distances, self._joint.K, self._views, self._joint.poses,
                           self._joint.landmarks).observe(self._config.window // 2)
        if sighted is not None:
            self._joint.landmarks.minima[sighted.indices, -1] = sighted.places
            self._joint.landmarks.roots[sighted.indices, -1] = sighted.roots
            self._joint.landmarks.observed[sighted.indices, -1] = True
            self._joint.landmarks.observation_counts[sighted.indices] += 1

    def _newest_motion(self, H: Array) -> WindowStep:
        """Return the newest motion, and the uncertainty of its length."""
        R = self._joint.poses.R[-1] @ self._joint.poses.R[-2].T
        t = self._joint.poses.t[-1] - R @ self._joint.poses.t[-2]
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
        before, newest = self._joint.poses.camera(-2), self._joint.poses.camera(-1)
        refined = np.linalg.inv(self._published) @ before
        correction, share = np.eye(4), self._tuning.correction_share
        correction[:3, :3] = rotation_exp(share * rotation_log(refined[:3, :3]))
        correction[:3, 3] = share * refined[:3, 3]
        return np.asarray(correction @ np.linalg.inv(before) @ newest)

    def _update_calibration(self) -> None:
        """Update the estimate of the camera, before the oldest keyframe is marginalised."""
        # Each landmark is in as many windows as there are keyframes.
        told = self._joint.camera_information(self._tuning.keyframes)
        if told is not None:
            self.calibration = self.calibration.update(*told)

    def _marginalise_landmarks(self, chosen: NDArray[np.bool_]) -> None:
        """Marginalise the chosen landmarks (N,) into the prior, before a frame is removed."""
        self.final_landmarks = np.concatenate([self.final_landmarks, self._places(chosen)])
        self._joint.marginalise_landmarks(chosen)

    def _marginalise_frame(self, frame: int) -> None:
        """Marginalise a frame, and remove it with its landmarks."""
        self._joint.marginalise_frame(frame)
        lists: tuple[list[Any], ...] = (
            self._views, self._is_keyframe, self._has_landmarks)
        for per_frame in lists:
            del per_frame[frame]
