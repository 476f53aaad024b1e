"""
The joint least-squares problem of a window: poses and landmarks, and a prior on the poses.

Each observation is a paraboloid, so this is the paper's joint epipolar tracking over more than two
frames; `djet_ros.core.bundle` has its residuals and normal equations. What leaves the window is
marginalised into the prior (Leutenegger et al., "Keyframe-based visual-inertial odometry using
nonlinear optimization", IJRR 2015).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

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
from djet_ros.core.geometry import norms, rotation_log, skew, sphere_tangents
from djet_ros.core.jet import LEAST_CURVATURE, Loss
from djet_ros.core.medians import median
from djet_ros.core.types import Array, RelativePose
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class JointTuning:
    """Constants of the problem; "chosen" is by judgement or trial, not derived."""

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
    # rad; chosen: negative parallax of a step that noise may give to a point at infinity
    negative_parallax: float = 0.01
    # chosen: most drift of the logarithm of lengths that a correction of the camera takes back
    most_drift: float = 0.5


JOINT_TUNING = JointTuning()

# rad; chosen: standard deviation added to that of the rotation of a pair without parallax, which
# landmarks of known depths tell better.
_ROTATION_SIGMA = 1e-3


class CameraInformation(NamedTuple):
    """
    What observations say of the camera's deviation: H (4, 4) and g (4,) per observation.

    In pixels; noise: factor of H^-1 in its covariance.
    """

    H: Array
    g: Array
    noise: float


@dataclass
class JointProblem:
    """
    Poses of F frames, N landmarks, and a prior, which are refined together.

    K: (3, 3) camera matrix; scale: robust standard deviation of observations in pixels;
    length_by_camera: (4,) derivatives of the logarithm of the newest length by what may be wrong
    with the camera.
    """

    K: Array
    poses: Poses
    landmarks: Landmarks
    prior: PosePrior
    scale: float = 1.0
    length_by_camera: Array = field(default_factory=lambda: np.zeros(OF_CAMERA))
    tuning: JointTuning = JOINT_TUNING

    @classmethod
    def of_first_frame(cls, K: Array) -> JointProblem:
        """Return the problem of one frame without landmarks, whose pose is fixed."""
        poses = Poses(np.eye(3)[None], np.zeros((1, 3)))
        landmarks = Landmarks.at(np.empty((0, 2)), np.empty(0), 0, 1)
        return cls(K, poses, landmarks, PosePrior.holding(poses))

    @property
    def newest_motion(self) -> tuple[Array, Array]:
        """Return the motion R (3, 3), t (3,) from the previous frame to the newest one."""
        R, t = (motions[-1, -2] for motions in self.poses.relative_motions)
        return R, t

    @property
    def newest_length(self) -> float:
        """Return the length of the newest motion."""
        return float(np.linalg.norm(self.newest_motion[1]))

    def observed_in(self, frame: int) -> Landmarks:
        """Return the landmarks that a frame observes."""
        return self.landmarks.of(self.landmarks.observed[:, frame])

    def points_in(self, frame: int, landmarks: Landmarks) -> Array:
        """Return landmarks in a frame, scaled by their inverse depths: see `points_in_frame`."""
        return points_in_frame(self.K, self.poses, landmarks, frame)

    def pixels_in(self, frame: int, landmarks: Landmarks) -> Array:
        """Return the pixels (M, 2) of landmarks in a frame."""
        return projected(self.K, self.points_in(frame, landmarks))

    def add_frame(self, R: Array, t: Array) -> None:
        """Add a frame with a pose R (3, 3), t (3,), which observes no landmark yet."""
        self.poses, self.prior = self.poses.joined(R, t), self.prior.with_frame(R, t)
        self.landmarks = self.landmarks.with_frame()

    def add_pair(self, relative: RelativePose, length: float, expected: float, sigma: float
                 ) -> None:
        """
        Add the rotation and translation direction of the newest pair to the prior.

        And its expected length with its standard deviation: if landmarks hardly determine it, a
        prior linearised elsewhere would move it arbitrarily. length: at which the newest frame is
        now.
        """
        R, t = relative.R, length * relative.t
        # With steps (omega, upsilon) of the previous frame and of the new one, the motion rotates
        # by omega_new - R omega_before and shifts by upsilon_new - [t]x omega_new - R
        # upsilon_before.
        J = np.zeros((6, 12))
        J[:3, :3], J[3:, 3:6] = -R, -R
        J[:3, 6:9], J[3:, 6:9], J[3:, 9:] = np.eye(3), -skew(t), np.eye(3)
        if relative.t.any():
            J_pair = np.concatenate([-motion_shift(relative, self.K), np.concatenate(
                [J[:3], sphere_tangents(relative.t).T @ J[3:] / length])], axis=1)
            # The expected length is that of earlier steps, and depends on the camera as they do.
            along = np.concatenate([-length * self.length_by_camera, relative.t @ J[3:]]) / sigma
            information = (J_pair.T @ np.linalg.inv(relative.covariance_5) @ J_pair
                           + np.outer(along, along))
            gradient = along * (length - expected) / sigma
        else:
            by_poses = np.concatenate([np.zeros((3, OF_CAMERA)), J[:3]], axis=1)
            weighted = np.linalg.solve(
                relative.covariance_5[:3, :3] + _ROTATION_SIGMA**2 * np.eye(3), by_poses).T
            information = weighted @ by_poses
            gradient = weighted @ rotation_log(self.newest_motion[0] @ R.T)
        H, g = np.zeros_like(self.prior.H), np.zeros_like(self.prior.g)
        # The camera comes first, the newest two frames last.
        places = np.r_[:OF_CAMERA, len(g) - 12:len(g)]
        H[np.ix_(places, places)], g[places] = information, gradient
        self.prior.add(H, g, self.poses)

    def refine(self) -> Array:
        """Refine poses and depths by Gauss-Newton; returns the Hessian over the poses."""
        self._normalise_roots()
        observed, prior = self._observed(), self.prior.at(self.poses)
        for _ in range(self.tuning.steps):
            reduced = self._reduced(observed)
            H = self.prior.of_poses + reduced.H[OF_CAMERA:, OF_CAMERA:]
            step = -_solved(H, prior.gradient + reduced.g[OF_CAMERA:])
            observed, prior = self._line_search(observed, prior, step, reduced.change(
                np.concatenate([np.zeros(OF_CAMERA), step])))
        self.length_by_camera = self._newest_by_camera(self._poses_by_camera(reduced))
        self._remove_outliers(observed)
        return H

    def adapt_to(self, change: Array) -> None:
        """Move poses and landmarks by what a change (4,) of the camera makes of them."""
        reduced = self._reduced(self._observed())
        by_camera = self._poses_by_camera(reduced)
        # To first order, so long lengths must not become negative.
        drift = abs(float(self._newest_by_camera(by_camera) @ change))
        change = change * min(self.tuning.most_drift / max(drift, 1e-9), 1.0)
        step = by_camera @ change
        self.landmarks = self.landmarks.moved(reduced.change(np.concatenate([change, step])))
        self.poses = self.poses.moved(step)
        self.prior = self.prior.with_corrected_camera(change)

    def camera_information(self, windows: int) -> CameraInformation | None:
        """
        Return what the observations say of the camera; None without observations.

        windows: number of those that each landmark is in, which share its information. A robust
        loss curves less than its weights say (Huber, Robust Statistics, section 7.6), for
        residuals of two numbers by half as much on average: a step by the weights would be too
        short.
        """
        observed = observe(self.K, self.poses, self.landmarks)
        if not len(observed.residuals):
            return None
        H, g = self._reduced(observed).of_camera()
        loss, squared = self._loss(self.scale), (observed.residuals**2).sum(1)
        _, weights = loss(squared)
        flattened = max(float((1 + loss.curvature(squared).sum() / weights.sum()) / 2),
                        LEAST_CURVATURE)
        share = self.scale**2 / weights.sum()
        return CameraInformation(share * H, share / flattened * g,
                                 windows * share / flattened**2)

    def marginalise_landmarks(self, chosen: NDArray[np.bool_]) -> None:
        """Marginalise the chosen landmarks (N,) into the prior, before a frame is removed."""
        landmarks = self.landmarks
        self.landmarks = landmarks.of(chosen)
        reduced = self._reduced(observe(self.K, self.poses, self.landmarks))
        self.prior.add(reduced.H, reduced.g, self.poses)
        self.landmarks = landmarks.of(~chosen)

    def marginalise_frame(self, frame: int) -> None:
        """Marginalise a frame, and remove it with the landmarks that no other one observes."""
        self.poses = self.poses.without_frame(frame)
        self.prior = self.prior.without_frame(frame)
        self.landmarks = self.landmarks.without_frame(frame)
        self.landmarks = self.landmarks.of(np.asarray(self.landmarks.observed.any(1)))

    def _normalise_roots(self) -> None:
        """Scale the roots of precision in the newest frame to a median of one pixel."""
        observed = self.landmarks.observed[:, -1]
        roots = self.landmarks.roots[observed, -1]
        if len(roots):
            sizes = np.linalg.norm(roots, axis=(1, 2)) / np.sqrt(2)
            self.landmarks.roots[observed, -1] = roots / median(sizes)
            # The anchor's patch is as noisy as the first one that observes it.
            new = observed & ~self.landmarks.anchor_roots.any((1, 2))
            self.landmarks.anchor_roots[new] = self.landmarks.roots[new, -1]

    def _observed(self) -> Observed:
        """Return all observations, and update the noise scale."""
        observed = observe(self.K, self.poses, self.landmarks)
        if len(observed.residuals):
            self.scale = max(noise_scale(observed), self.tuning.least_scale)
        return observed

    def _reduced(self, observed: Observed) -> Reduced:
        """Weight observations robustly and eliminate landmarks."""
        _, weights = self._robust_losses(observed, self.scale)
        weight = self.scale**-2
        return eliminate(observed, weights * weight, weight, len(self.poses.R))

    def _line_search(self, observed: Observed, prior: PriorCost, step: Array, change: Array
                     ) -> tuple[Observed, PriorCost]:
        """Apply a step of poses and landmarks, halved until the cost does not grow."""
        poses, landmarks, scale = self.poses, self.landmarks, self.scale
        cost = self._cost(observed, scale) + prior.cost
        for _ in range(self.tuning.max_halvings + 1):
            self.poses, self.landmarks = poses.moved(step), landmarks.moved(change)
            moved, moved_prior = self._observed(), self.prior.at(self.poses)
            if self._cost(moved, scale) + moved_prior.cost <= cost:
                return moved, moved_prior
            step, change = step / 2, change / 2
        self.poses, self.landmarks, self.scale = poses, landmarks, scale
        return observed, prior

    def _cost(self, observed: Observed, scale: float) -> float:
        """Return the robust cost of observations with a noise `scale`."""
        losses, _ = self._robust_losses(observed, scale)
        return float((losses.sum() + (observed.anchor_residuals**2).sum()) / (2 * scale**2))

    def _robust_losses(self, observed: Observed, scale: float) -> tuple[Array, Array]:
        """Return the losses (M,) of observations with a noise `scale`, and their weights."""
        return self._loss(scale)((observed.residuals**2).sum(1))

    def _loss(self, scale: float) -> Loss:
        return Loss('geman_mcclure', self.tuning.loss_scale * scale)

    def _remove_outliers(self, observed: Observed) -> None:
        """Remove outlying observations, and landmarks that have none left or are behind."""
        outliers = norms(observed.residuals) > self.tuning.outlier * self.scale
        self.landmarks.observed[observed.landmark[outliers], observed.frame[outliers]] = False
        np.subtract.at(self.landmarks.observation_counts, observed.landmark[outliers], 1)
        # Relative to the newest step: the unit may be much longer or shorter.
        in_front = self.landmarks.rho * self.newest_length > -self.tuning.negative_parallax
        self.landmarks = self.landmarks.of(
            np.asarray(self.landmarks.observed.any(1) & in_front))

    def _poses_by_camera(self, reduced: Reduced) -> Array:
        """Return how the poses depend on the camera, (6 F, 4)."""
        over_poses = (self.prior.H + reduced.H)[OF_CAMERA:]
        return -_solved(over_poses[:, OF_CAMERA:], over_poses[:, :OF_CAMERA])

    def _newest_by_camera(self, by_camera: Array) -> Array:
        """
        Return how the logarithm of the newest length depends on the camera, (4,).

        by_camera: (6 F, 4) of the poses. Without a length it is that of the step before.
        """
        R, t = self.newest_motion
        squared = float(t @ t)
        if not squared:
            return self.length_by_camera
        by_poses = np.concatenate([-t @ R, t]) / squared
        return np.asarray(by_poses @ by_camera[[-9, -8, -7, -3, -2, -1]])


def _solved(H: Array, right: Array) -> Array:
    """Solve equations over poses, whose position and scale next to nothing may determine."""
    return np.asarray(np.linalg.solve(H + np.diag(1e-9 * np.diag(H)), right), float)
