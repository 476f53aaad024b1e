"""
Bundle adjustment over several frames: poses and inverse depths, from paraboloids at observations.

The paper's joint epipolar tracking has one residual per match, because with two frames an inverse
depth can slide along the epipolar line without cost. If more frames observe a landmark, each does
so at a minimum y* with curvature A', and the residual has two components: the displacement from y*
to the projection of the landmark, whitened by A'. Landmarks are eliminated by the Schur
complement, so that the system to solve has the size of the poses.

All observations of a landmark compare with its patch in the anchor, the frame that created it, so
the noise of that patch is common to them. Therefore the position in the anchor is an observation
too: the landmark's ray there is free, with a residual like the others. With a fixed ray the depth
would have to absorb that noise, and steps would be biased short, ever more.

Poses are world to camera, ``X_camera = R X_world + t``, perturbed from the left: a step (omega,
upsilon) makes them ``exp(omega) R`` and ``exp(omega) t + upsilon``. All frames share one camera,
whose deviation from its calibration (`core.correction`) is among the parameters.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

from djet_ros import compiled
from djet_ros.core.correction import displacements, OF_CAMERA
from djet_ros.core.geometry import inverse_intrinsics, rays, rotation_exp, rotation_log
from djet_ros.core.medians import median
from djet_ros.core.paraboloid import times
from djet_ros.core.radial import distort, distortion_jacobian, undistort
from djet_ros.core.types import Array
import numpy as np
from numpy.typing import NDArray

# Least depth of a projection, in units of the landmark's depth in its anchor.
_MIN_DEPTH = 1e-3

# Bound of projected pixels; it fits into an integer.
_MAX_PIXEL = 1e6

# Limits of projections, as compiled code takes them.
_LIMITS = _MIN_DEPTH, _MAX_PIXEL

# Information that fixes a pose.
_FIXED = 1e10

# Information added where there is none, so that a frame can be eliminated.
_WEAK = 1e-6

# Information added to an inverse depth, so that there always is some.
_DEPTH_INFORMATION = 1e-9

# Information added to poses that observations leave undetermined, relative to theirs.
_GAUGE = 1e-7


@dataclass(frozen=True)
class Poses:
    """Poses of F frames: R (F, 3, 3), t (F, 3)."""

    R: Array
    t: Array

    @cached_property
    def relative_motions(self) -> tuple[Array, Array]:
        """Return motions from frame a to frame f: R (F, F, 3, 3), t (F, F, 3), indexed [f, a]."""
        R = np.einsum('fij,akj->faik', self.R, self.R)
        return R, self.t[:, None] - np.einsum('faij,aj->fai', R, self.t)

    def camera(self, frame: int) -> Array:
        """Return the pose of a frame's camera in the world, (4, 4)."""
        camera = np.eye(4)
        camera[:3, :3] = self.R[frame].T
        camera[:3, 3] = -self.R[frame].T @ self.t[frame]
        return camera

    def joined(self, R: Array, t: Array) -> Poses:
        """Return the poses with one more, R (3, 3) and t (3,)."""
        return Poses(np.concatenate([self.R, R[None]]), np.concatenate([self.t, t[None]]))

    def without_frame(self, frame: int) -> Poses:
        """Return the poses without a frame."""
        return Poses(np.delete(self.R, frame, axis=0), np.delete(self.t, frame, axis=0))

    def moved(self, step: Array) -> Poses:
        """Return the poses perturbed by a step (6 F,)."""
        step = step.reshape(-1, 6)
        rotations = rotation_exp(step[:, :3])
        return Poses(rotations @ self.R, times(rotations, self.t) + step[:, 3:])

    def step_from(self, other: Poses) -> Array:
        """Return the step (6 F,) that takes other poses to these, to first order."""
        rotations = self.R @ other.R.transpose(0, 2, 1)
        shifts = self.t - np.einsum('fij,fj->fi', rotations, other.t)
        return np.concatenate([rotation_log(rotations), shifts], axis=1).ravel()


class PriorCost(NamedTuple):
    """Cost of poses under a prior, and its gradient (6 F,)."""

    cost: float
    gradient: Array


@dataclass
class PosePrior:
    """
    Prior on a camera and F poses, in addition to their landmarks.

    It costs 1/2 d^T H d + g^T d, with d (4 + 6 F,) the fields of a `Correction`, and the step from
    the poses `linearised_at`. The camera is fixed while poses are refined, but how poses depend on
    it is kept (a "consider" parameter; Schmidt, 1966): once more is known of the camera, they are
    corrected, even for what frames since removed had said.
    """

    H: Array
    g: Array
    linearised_at: Poses

    @classmethod
    def holding(cls, pose: Poses) -> PosePrior:
        """Return a prior that fixes the first pose."""
        return cls(np.diag(np.repeat([0.0, _FIXED], [OF_CAMERA, 6])), np.zeros(OF_CAMERA + 6),
                   pose)

    @property
    def of_poses(self) -> Array:
        """Return the Hessian (6 F, 6 F) over the poses."""
        return self.H[OF_CAMERA:, OF_CAMERA:]

    def at(self, poses: Poses) -> PriorCost:
        """Return the cost of poses and its gradient."""
        step, g = poses.step_from(self.linearised_at), self.g[OF_CAMERA:]
        pull = self.of_poses @ step
        return PriorCost(float(step @ (pull / 2 + g)), np.asarray(g + pull))

    def add(self, H: Array, g: Array, poses: Poses) -> None:
        """Add information H (4 + 6 F, 4 + 6 F), g linearised at `poses`."""
        self.H += H
        self.g += g - H[:, OF_CAMERA:] @ poses.step_from(self.linearised_at)

    def with_corrected_camera(self, change: Array) -> PosePrior:
        """Return the prior relative to a camera that is corrected by a change (4,)."""
        return replace(self, g=self.g + self.H[:, :OF_CAMERA] @ change)

    def with_frame(self, R: Array, t: Array) -> PosePrior:
        """Return the prior with one more pose, without information on it."""
        return PosePrior(np.pad(self.H, (0, 6)), np.pad(self.g, (0, 6)),
                         self.linearised_at.joined(R, t))

    def without_frame(self, frame: int) -> PosePrior:
        """Return the prior with a frame marginalised out."""
        removed = np.zeros(len(self.H), bool)
        removed[OF_CAMERA + 6 * frame:][:6] = True
        block, coupling = self.H[np.ix_(removed, removed)], self.H[np.ix_(~removed, removed)]
        # After a pure rotation, only the rotation of a frame may be constrained.
        block = block + np.diag(1e-9 * np.diag(block) + _WEAK)
        gain = np.linalg.solve(block, coupling.T).T
        H = self.H[np.ix_(~removed, ~removed)] - gain @ coupling.T
        return PosePrior((H + H.T) / 2, self.g[~removed] - gain @ self.g[removed],
                         self.linearised_at.without_frame(frame))


@dataclass
class Landmarks:
    """
    N landmarks, and their observations by F frames.

    anchors: (N,) frames that created them; anchor_pixels: (N, 2) observed there, the centres of
    their patches; anchor_roots: (N, 2, 2) roots of the precision of these; points: (N, 2)
    estimated pixels there; rho: (N,) inverse depths there; slopes: (N, 2) relative
    slopes of the inverse depth around them, per pixel; strengths: (N,) texture strengths of their
    patches; observation_counts: (N,) also by frames since removed; minima: (N, F, 2) pixels y*;
    roots: (N, F, 2, 2) of their precision, so that ``root (y - y*)`` is white; observed: (N, F)
    whether the last two are valid.
    """

    anchors: NDArray[np.int64]
    anchor_pixels: Array
    anchor_roots: Array
    points: Array
    rho: Array
    slopes: Array
    strengths: Array
    observation_counts: NDArray[np.int64]
    minima: Array
    roots: Array
    observed: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.rho)

    @classmethod
    def at(cls, anchor_pixels: Array, rho: Array, anchor: int, frames: int,
           slopes: Array | None = None, strengths: Array | None = None) -> Landmarks:
        """Create landmarks without observations; fronto-parallel ones without slopes."""
        n = len(rho)
        return cls(np.full(n, anchor, np.int64), anchor_pixels, np.zeros((n, 2, 2)),
                   anchor_pixels.copy(), rho,
                   np.zeros((n, 2)) if slopes is None else slopes,
                   np.ones(n) if strengths is None else strengths, np.zeros(n, np.int64),
                   np.zeros((n, frames, 2)), np.zeros((n, frames, 2, 2)),
                   np.zeros((n, frames), bool))

    def of(self, chosen: NDArray[np.bool_]) -> Landmarks:
        """Return a subset of the landmarks."""
        # np.take is three to six times as fast as indexing for arrays of several axes.
        places = np.flatnonzero(chosen)
        return Landmarks(*(array.take(places, axis=0) for array in vars(self).values()))

    def joined(self, other: Landmarks) -> Landmarks:
        """Return these landmarks and others of the same frames."""
        return Landmarks(*(np.concatenate(pair) for pair in zip(
            vars(self).values(), vars(other).values(), strict=True)))

    def with_frame(self) -> Landmarks:
        """Return the landmarks with room for the observations of one more frame."""
        return Landmarks(*self._by_anchor(), *(
            np.concatenate([array, np.zeros_like(array[:, :1])], axis=1)
            for array in self._by_frame()))

    def without_frame(self, frame: int) -> Landmarks:
        """Return the landmarks with other anchors, without the observations of a frame."""
        left = self.of(self.anchors != frame)
        return Landmarks(left.anchors - (left.anchors > frame), *left._by_anchor()[1:],
                         *(np.delete(array, frame, axis=1) for array in left._by_frame()))

    def moved(self, step: Array) -> Landmarks:
        """Return the landmarks moved by a step (N, 3) of their inverse depths and points."""
        return replace(self, rho=self.rho + step[:, 0], points=self.points + step[:, 1:])

    def with_corrected_images(self, before: tuple[Array, float], after: tuple[Array, float]
                              ) -> Landmarks:
        """
        Convert observations in images corrected in one way to images corrected in another.

        before, after: camera matrix (3, 3) and k1 by which they are undistorted. The viewing rays
        of the points stay.
        """
        def moved(pixels: Array) -> tuple[Array, Array]:
            """Return pixels (N, 2) in the new image, and Jacobians of the old by the new ones."""
            (K, k1), (new_K, new_k1) = before, after
            corrected = undistort(new_K, distort(K, pixels, k1), new_k1)
            back = distortion_jacobian(K, rays(K, pixels)[:, :2], k1)
            by_new = np.linalg.solve(back, distortion_jacobian(
                new_K, rays(new_K, corrected)[:, :2], new_k1))
            return corrected, np.asarray(by_new, float)

        anchor_pixels, by_anchor = moved(self.anchor_pixels)
        minima, by_minima = moved(self.minima.reshape(-1, 2))
        return replace(
            self, anchor_pixels=anchor_pixels, anchor_roots=self.anchor_roots @ by_anchor,
            points=rays(before[0], self.points) @ after[0][:2].T,
            slopes=times(by_anchor.transpose(0, 2, 1), self.slopes),
            minima=minima.reshape(self.minima.shape),
            roots=self.roots @ by_minima.reshape(self.roots.shape))

    def _by_anchor(self) -> tuple[Any, ...]:
        return self.anchors, self.anchor_pixels, self.anchor_roots, self.points, self.rho, \
            self.slopes, self.strengths, self.observation_counts

    def _by_frame(self) -> tuple[Any, ...]:
        return self.minima, self.roots, self.observed


def points_in_frame(K: Array, poses: Poses, landmarks: Landmarks, frame: int) -> Array:
    """Return landmarks (N, 3) in a frame, times their inverse depths in their anchors."""
    R, t = poses.relative_motions
    rotations = R[frame, landmarks.anchors]
    places = times(rotations, rays(K, landmarks.points))
    return np.asarray(places + landmarks.rho[:, None] * t[frame, landmarks.anchors])


def projected(K: Array, places: Array) -> Array:
    """Project points (N, 3) in a camera to pixels (N, 2); those behind it are moved far out."""
    u = places[:, :2] / np.maximum(places[:, 2:], _MIN_DEPTH)
    return np.clip(u @ K[:2, :2].T + K[:2, 2], -_MAX_PIXEL, _MAX_PIXEL)


@dataclass(frozen=True)
class Observed:
    """
    M observations of N landmarks: see ``observe``.

    landmark, frame, anchor: (M,), sorted by landmark; residuals: (M, 2); anchor_residuals: (N, 2)
    of the points in their anchors, anchor_roots: (N, 2, 2) of their precision. R (M, 3, 3), t (M,
    3), ray (M, 3), rho (M,): motion from the anchor to the frame, and the landmark in the anchor;
    place (M, 3): R ray + rho t; root: (M, 2, 2) of the precision; normalised: (N, 2) X/Z, Y/Z of
    the points.
    """

    landmark: NDArray[np.int64]
    frame: NDArray[np.int64]
    anchor: NDArray[np.int64]
    residuals: Array
    anchor_residuals: Array
    anchor_roots: Array
    K: Array
    normalised: Array
    R: Array
    t: Array
    ray: Array
    rho: Array
    place: Array
    root: Array


def observe(K: Array, poses: Poses, landmarks: Landmarks) -> Observed:
    """Return the residuals of all observations, whitened by their roots of precision."""
    landmark, frame = np.nonzero(landmarks.observed)
    if compiled.library is not None:
        anchor, (residuals, anchor_residuals, normalised, *at_places) = compiled.observe(
            (landmark, frame), landmarks.anchors, poses.relative_motions,
            (landmarks.points, landmarks.rho, landmarks.minima, landmarks.roots,
             landmarks.anchor_roots, landmarks.anchor_pixels),
            (K, inverse_intrinsics(K)), _LIMITS)
        return Observed(landmark, frame, anchor, residuals, anchor_residuals,
                        landmarks.anchor_roots, K, normalised, *at_places)
    anchor, rho = landmarks.anchors[landmark], landmarks.rho[landmark]
    R, t = (motions[frame, anchor] for motions in poses.relative_motions)
    rays_of_points = rays(K, landmarks.points)
    ray = rays_of_points[landmark]
    place = times(R, ray) + rho[:, None] * t
    root = landmarks.roots[landmark, frame]
    return Observed(
        landmark, frame, anchor,
        times(root, projected(K, place) - landmarks.minima[landmark, frame]),
        times(landmarks.anchor_roots, projected(K, rays_of_points) - landmarks.anchor_pixels),
        landmarks.anchor_roots, K, rays_of_points[:, :2], R, t, ray, rho, place, root)


@dataclass(frozen=True)
class Jacobians:
    """
    Jacobians of the residuals of M observations and N points: see ``jacobians``.

    by_frame, by_anchor: (M, 2, 6) by the steps of the two poses; by_own: (M, 2, 3) by those of the
    landmark's inverse depth and point; by_camera: (M, 2, 4) by the fields of a `Correction`. Those
    of the points by their own steps (N, 2, 2), and by the camera (N, 2, 4).
    """

    by_frame: Array
    by_anchor: Array
    by_own: Array
    by_camera: Array
    points_by_own: Array
    points_by_camera: Array


def _by_camera(K: Array, u: Array, roots: Array) -> Array:
    """Return the Jacobians (N, 2, 4) of residuals at X/Z, Y/Z (N, 2) by a `Correction`."""
    return np.asarray(roots @ K[:2, :2] @ displacements(u))


def jacobians(observed: Observed) -> Jacobians:
    """Return the analytic Jacobians of the residuals of observations and points."""
    K, R, place, ray = observed.K, observed.R, observed.place, observed.ray
    depths = np.maximum(place[:, 2:], _MIN_DEPTH)
    scaled = observed.root @ K[:2, :2] / depths[:, :, None]
    # Projection: d(x / z) = (dx - x / z dz) / z.
    ahead = -times(scaled, place[:, :2]) / depths
    by_place = np.concatenate([scaled, ahead[:, :, None]], axis=2)
    by_ray = by_place @ R
    weight = observed.rho[:, None, None]
    by_frame, by_anchor = np.empty((2, len(place), 2, 6))
    # Rotation by omega: d(X) = omega x X, and a . (omega x X) = omega . (X x a).
    _cross(place[:, None], by_place, by_frame[:, :, :3])
    _cross(by_ray, ray[:, None], by_anchor[:, :, :3])
    np.multiply(by_place, weight, out=by_frame[:, :, 3:])
    np.multiply(by_ray, -weight, out=by_anchor[:, :, 3:])
    by_own = np.empty((len(place), 2, 3))
    by_own[:, :, 0] = times(by_place, observed.t)
    np.matmul(by_ray, inverse_intrinsics(K)[:, :2], out=by_own[:, :, 1:])
    return Jacobians(
        by_frame, by_anchor, by_own, _by_camera(K, place[:, :2] / depths, observed.root),
        observed.anchor_roots, _by_camera(K, observed.normalised, observed.anchor_roots))


def _cross(a: Array, b: Array, out: Array) -> None:
    """Write cross products to an array (…, 3): components first, which is cheaper."""
    (a1, a2, a3), (b1, b2, b3) = (np.moveaxis(v, -1, 0) for v in (a, b))
    out[..., 0] = a2 * b3 - a3 * b2
    out[..., 1] = a3 * b1 - a1 * b3
    out[..., 2] = a1 * b2 - a2 * b1


def noise_scale(observed: Observed) -> float:
    """
    Return the robust standard deviation of observations in the unit of their roots.

    A landmark that m frames observe besides its anchor has 2 m + 2 residuals and three parameters,
    so 2 m - 1 degrees of freedom. Without that correction, new landmarks, whose parameters absorb
    nearly all residuals, would make the noise seem little more than half as large, and ordinary
    errors would be rejected as outliers. The parameters of poses are neglected. Needs at least one
    observation.
    """
    n = len(observed.anchor_residuals)
    count = np.bincount(observed.landmark, minlength=n)
    squares = (observed.anchor_residuals**2).sum(1) + np.bincount(
        observed.landmark, (observed.residuals**2).sum(1), minlength=n)
    observed_once = count > 0
    # Wilson and Hilferty's median of the chi-square distribution.
    freedom = 2 * count[observed_once] - 1
    medians = freedom * (1 - 2 / (9 * freedom))**3
    return float(np.sqrt(median(squares[observed_once] / medians)))


class CameraEquations(NamedTuple):
    """Normal equations over the fields of a `Correction`: H (4, 4) and gradient g (4,)."""

    H: Array
    g: Array


@dataclass(frozen=True)
class Reduced:
    """Normal equations over camera and poses, landmarks eliminated: H (4 + 6 F, 4 + 6 F), g."""

    H: Array
    g: Array
    _coupling: Array
    _variances: Array
    _slopes: Array

    def of_camera(self) -> CameraEquations:
        """Marginalise the poses too, without any prior on them."""
        H, coupling = self.H[OF_CAMERA:, OF_CAMERA:], self.H[OF_CAMERA:, :OF_CAMERA]
        # Position and scale are gauge freedoms.
        gain = np.linalg.solve(H + np.diag(_GAUGE * np.diag(H) + _WEAK), coupling).T
        reduced = self.H[:OF_CAMERA, :OF_CAMERA] - gain @ coupling
        return CameraEquations((reduced + reduced.T) / 2,
                               self.g[:OF_CAMERA] - gain @ self.g[OF_CAMERA:])

    def change(self, step: Array) -> Array:
        """Return the steps (N, 3) of the landmarks for a step (4 + 6 F,) of camera and poses."""
        return np.asarray(-np.einsum('nij,nj->ni', self._variances,
                                     self._slopes + self._coupling @ step))


def _by_poses(observed: Observed, by_frame: Array, by_anchor: Array, frames: int) -> Array:
    """Return the Jacobians (M, 2, 6 F) of observations by all poses, by those by two."""
    count = len(by_frame)
    rows, by_poses = np.arange(count), np.zeros((count, 2, frames, 6))
    by_poses[rows, :, observed.frame], by_poses[rows, :, observed.anchor] = by_frame, by_anchor
    return by_poses.reshape(count, 2, 6 * frames)


def eliminate(observed: Observed, weights: Array, weight: float, frames: int) -> Reduced:
    """
    Sum the normal equations of observations, and eliminate the landmarks.

    weights: (M,) of the observations; weight: of the residuals in the anchors.
    """
    if compiled.library is not None:
        o = observed
        return Reduced(*compiled.eliminate(
            (o.landmark, o.frame, o.anchor),
            (o.residuals, o.R, o.t, o.ray, o.rho, o.place, o.root, weights),
            (o.normalised, o.anchor_roots, o.anchor_residuals, weight),
            (o.K, inverse_intrinsics(o.K)), _LIMITS, _DEPTH_INFORMATION, frames))
    n, linear = len(observed.anchor_residuals), jacobians(observed)
    size = OF_CAMERA + 6 * frames
    root = np.sqrt(weights)[:, None, None]
    by_frame, by_anchor = linear.by_frame * root, linear.by_anchor * root
    e, back = observed.residuals * root[:, 0], (linear.by_own * root).transpose(0, 2, 1)
    by_camera = linear.by_camera * root
    flat = np.concatenate([by_camera, _by_poses(observed, by_frame, by_anchor, frames)],
                          axis=2).reshape(-1, size)
    H, g = flat.T @ flat, flat.T @ e.ravel()
    points_by_own, points_by_camera = linear.points_by_own, linear.points_by_camera
    information, slopes = np.tile(np.eye(3) * _DEPTH_INFORMATION, (n, 1, 1)), np.zeros((n, 3))
    transposed = points_by_own.transpose(0, 2, 1) * weight
    information[:, 1:, 1:] += transposed @ points_by_own
    slopes[:, 1:] = times(transposed, observed.anchor_residuals)
    with_camera, coupling = np.zeros((n, 3, OF_CAMERA)), np.zeros((n, frames, 3, 6))
    with_camera[:, 1:] = transposed @ points_by_camera
    H[:OF_CAMERA, :OF_CAMERA] += weight * np.einsum(
        'nia,nib->ab', points_by_camera, points_by_camera)
    g[:OF_CAMERA] += weight * np.einsum(
        'nia,ni->a', points_by_camera, observed.anchor_residuals)
    # Each frame observes a landmark once, and each landmark has one anchor.
    coupling[observed.landmark, observed.frame] = back @ by_frame
    first = np.flatnonzero(np.diff(observed.landmark, prepend=-1))
    landmark, anchor = observed.landmark[first], observed.anchor[first]
    coupling[landmark, anchor] = np.add.reduceat(back @ by_anchor, first)
    information[landmark] += np.add.reduceat(back @ back.transpose(0, 2, 1), first)
    slopes[landmark] += np.add.reduceat((back @ e[:, :, None])[:, :, 0], first)
    with_camera[landmark] += np.add.reduceat(back @ by_camera, first)
    coupled = np.concatenate(
        [with_camera, coupling.transpose(0, 2, 1, 3).reshape(n, 3, 6 * frames)], axis=2)
    variances = np.asarray(np.linalg.inv(information), float)
    gain = (variances @ coupled).reshape(-1, size).T
    return Reduced(H - gain @ coupled.reshape(-1, size), g - gain @ slopes.ravel(),
                   coupled, variances, slopes)
