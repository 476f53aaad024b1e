"""
The ground under a moving camera: the translation in heights of the camera.

Points X of a plane with m.X = 1 have the inverse depth m.x along their ray x, so that two views
with X' = R X + t see it by the homography y ~ (R + t m^T) x (Faugeras and Lustman, 1988). With t
of length one, |m| is the translation in heights of the camera over the plane, and m / |m| is its
normal. All pixels that would see level ground are aligned directly, because roads have few
corners.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import cv2
from djet_ros.core.cells import CAUTIOUS_INFLATION, CELL
from djet_ros.core.geometry import rays, rotation_exp, skew, sphere_tangents
from djet_ros.core.jet import robust_scale
from djet_ros.core.types import Array, RelativePose, Status, View
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

Image = NDArray[np.float32]


@dataclass(frozen=True)
class GroundTuning:
    """Constants of the ground; "chosen" is by judgement or trial, not derived."""

    # Region of the ground, in heights of the camera over level ground; chosen for a car's lane:
    # least distance ahead, and to either side
    near: float = 1.0
    aside: float = 1.5
    # roads bend up and down, so that only the nearest part is flat: farthest distance, or if the
    # nearest visible ground is far already, its multiple, but not beyond the last
    flat: float = 6.0
    flat_factor: float = 1.5
    far: float = 14.0

    # Pixels. Chosen: fewer are not enough; more only cost time
    least_pixels: int = 400
    pixels: int = 4000
    # of an image, to select from; chosen: the size of a car's camera
    candidates: int = 500_000

    # The search. Lengths of a translation in heights; chosen, from a crawl to the fastest car
    lengths: tuple[float, float] = (0.02, 4.0)
    # of the logarithm of a length: a step of a pixel or two
    step: float = 0.03
    # least correlation of ground; chosen: walls and cars mistaken for ground have less
    min_correlation: float = 0.6
    # chosen: least correlation of images without known motion to be of the same place
    same_place: float = 0.95
    # chosen: distinctness of the best length: others, beyond so many neighbouring steps, have a
    # correlation lower by this
    distinctness: float = 0.1
    neighbours: int = 6
    # pixels; chosen: ground that moves by less, while other points show that the camera moves, is
    # an object that moves with the camera and hides the ground
    least_shift: float = 1.0

    # The texture. Gray levels at which contrast is noise, typical of a camera
    noise: float = 2.0
    # pixels over which contrast is normalised; chosen. Nearer than half of that to the image
    # border it is undefined
    side: int = 25
    rim: int = side // 2 + 2

    # The fit. Standard deviation in rad of the normal about that of level ground: the 2 degrees to
    # which the pitch has to be given, and the road's own slope
    tilt: float = math.radians(3.0)
    # pixels; largest median displacement of cells of flat ground; chosen: walls have more
    max_unevenness: float = 0.6
    # chosen: rounds of Gauss-Newton, and the relative step of the plane at convergence
    rounds: int = 10
    converged: float = 1e-3


_TUNING = GroundTuning()

# Heights of the camera over which a point on the ground stays in view.
SIGHT = _TUNING.flat - _TUNING.near


@dataclass(frozen=True)
class GroundMotion:
    """
    Estimate of the ground from a pair of views.

    value: (3,) length of the translation in heights of the camera, and pitch (positive down) and
    roll in rad of the previous camera against the ground; covariance: (3, 3).
    """

    value: Array
    covariance: Array


class Ground:
    """
    The part of an image that sees level ground, and its alignment over pairs.

    K: (3, 3) camera matrix; shape: (height, width) of its images; pitch: in rad, positive down.
    Roll is taken to be small.
    """

    def __init__(self, K: Array, shape: tuple[int, ...], pitch: float) -> None:
        """Select the pixels that see the ground."""
        self._normal = np.array([0.0, np.cos(pitch), np.sin(pitch)])
        self._forward = np.array([0.0, -np.sin(pitch), np.cos(pitch)])
        self._reach = _TUNING.far
        # Large images are subsampled.
        every = max(math.isqrt(shape[0] * shape[1] // _TUNING.candidates), 1)
        columns, rows = np.meshgrid(np.arange(_TUNING.rim, shape[1] - _TUNING.rim, every),
                                    np.arange(_TUNING.rim, shape[0] - _TUNING.rim, every))
        pixels = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float64)
        towards = rays(K, pixels)
        visible = self._sees(towards)
        if visible.any():
            nearest = float(self._ahead(towards[visible]).min())
            self._reach = max(_TUNING.flat, _TUNING.flat_factor * nearest)
        chosen = np.flatnonzero(self._sees(towards))
        self.is_in_view = len(chosen) >= _TUNING.least_pixels
        if not self.is_in_view:
            return
        subset = np.linspace(0, len(chosen) - 1, min(len(chosen), _TUNING.pixels)).astype(np.int64)
        self._pixels, self._rays = pixels[chosen[subset]], towards[chosen[subset]]
        # Rows above the ground are cropped, except for the support of the filters.
        self._top = max(int(self._pixels[:, 1].min()) - _TUNING.side, 0)
        self._K = K - [[0, 0, 0], [0, 0, self._top], [0, 0, 0]]
        self._pixels[:, 1] -= self._top
        _, self._cells = np.unique((self._pixels // CELL) @ [1, 1 << 16], return_inverse=True)

    def _ahead(self, towards: Array) -> Array:
        """Return how far ahead (N,), in heights, rays (N, 3) meet level ground, or infinity."""
        inverse = towards @ self._normal
        ahead = np.where(inverse > 1e-9, towards @ self._forward, np.inf)
        return np.asarray(ahead / np.maximum(inverse, 1e-9))

    def _sees(self, towards: Array) -> NDArray[np.bool_]:
        """Return a mask (N,) of the rays (N, 3) that meet level ground within the region."""
        ahead = self._ahead(towards)
        sideways = np.abs(towards[:, 0]) / np.maximum(towards @ self._normal, 1e-9)
        return np.asarray((ahead > _TUNING.near) & (ahead < min(self._reach, _TUNING.far))
                          & (sideways < _TUNING.aside))

    def motion(self, previous: View, current: View, relative: RelativePose,
               lengths: tuple[float, float] = _TUNING.lengths) -> GroundMotion | None:
        """
        Estimate how the ground moves between two views, given the relative pose.

        lengths: range of lengths, in heights, to search first. None if no ground is visible or it
        does not determine the length.
        """
        if not self.is_in_view:
            return None
        previous_texture, texture = self._texture(previous), self._texture(current)
        template = _sampled(previous_texture, self._pixels)
        if relative.status is not Status.OK:
            return self._zero_motion(template, texture, relative)
        start = self._search(template, texture, relative, lengths)
        if start is None:
            start = self._search(template, texture, relative, _TUNING.lengths)
        return None if start is None else self._fit(template, texture, relative, start)

    def _texture(self, view: View) -> Image:
        """Return the image with normalised contrast, from the highest row used."""
        gray = cv2.GaussianBlur(view.gray[self._top:], (0, 0), 1.0).astype(np.float32)
        detail = gray - cv2.blur(gray, (_TUNING.side, _TUNING.side))
        # Running sums of a filter may end slightly below zero.
        power = np.maximum(cv2.blur(detail**2, (_TUNING.side, _TUNING.side)), 0.0)
        inner, rim = np.full(gray.shape, np.nan, np.float32), _TUNING.side // 2
        inner[rim:-rim, rim:-rim] = (detail / (np.sqrt(power) + _TUNING.noise))[rim:-rim, rim:-rim]
        if view.mask is not None:
            inner[view.mask[self._top:]] = np.nan
        return inner

    def _project(self, R: Array, t: Array, m: Array) -> Array:
        """Return the pixels (N, 2) of the points of a plane m in the current view."""
        points = (self._rays @ R.T + np.outer(self._rays @ m, t)) @ self._K.T
        return np.asarray(points[:, :2] / np.maximum(points[:, 2:], 1e-9))

    def _zero_motion(self, template: Array, texture: Image,
                     relative: RelativePose) -> GroundMotion | None:
        """Return zero motion if the ground is where a pure rotation, or none, predicts it."""
        turned = relative.status is Status.NO_PARALLAX
        R = relative.R if turned else np.eye(3)
        correlation = _correlation(
            template, _sampled(texture, self._project(R, np.zeros(3), self._normal)))
        if correlation < (_TUNING.min_correlation if turned else _TUNING.same_place):
            return None
        least = _TUNING.least_shift / (self._K[0, 0] * float(np.median(self._rays @ self._normal)))
        return GroundMotion(np.zeros(3), np.diag([least**2, np.pi**2, np.pi**2]))

    def _search(self, template: Array, texture: Image, relative: RelativePose,
                lengths: tuple[float, float]) -> Array | None:
        """Return level ground (3,) for the length of best correlation, if that is distinct."""
        step, (least, most) = _TUNING.step, _TUNING.lengths
        low, high = max(lengths[0], least), min(lengths[1], most)
        candidates = np.exp(np.arange(np.log(low) - step, np.log(max(low, high)) + 2 * step, step))
        correlations = np.array([_correlation(template, _sampled(texture, self._project(
            relative.R, relative.t, length * self._normal))) for length in candidates])
        best = int(correlations.argmax())
        if correlations[best] < _TUNING.min_correlation or best in (0, len(correlations) - 1):
            return None
        # Repetitive textures have several peaks; slow ground has one, but a broad one.
        peaks = correlations == maximum_filter1d(
            correlations, 2 * _TUNING.neighbours + 1, mode='nearest')
        if (peaks & (correlations > correlations[best] - _TUNING.distinctness)).sum() > 1:
            return None
        return np.asarray(candidates[best] * self._normal)

    def _fit(self, template: Array, texture: Image, relative: RelativePose,
             m: Array) -> GroundMotion | None:
        """
        Fit the plane by Gauss-Newton, jointly with the pose within its covariance.

        Cauchy loss on intensities; the noise is estimated from sums of scores over cells, as for
        the pose, so that the covariance holds for any texture.
        """
        known = np.zeros((8, 8))
        known[3:, 3:] = np.linalg.inv(relative.covariance_5 + 1e-12 * np.eye(5))
        tangents, theta = sphere_tangents(relative.t), np.zeros(5)
        gradients = [np.asarray(cv2.Scharr(texture, -1, *axis, scale=1 / 32), np.float32)
                     for axis in ((1, 0), (0, 1))]
        for _ in range(_TUNING.rounds):
            R = rotation_exp(theta[:3]) @ relative.R
            t = relative.t + tangents @ theta[3:]
            places = self._project(R, t, m)
            values = _sampled(texture, places)
            r = values - template
            J = self._jacobian([_sampled(g, places) for g in gradients], R, t, m, tangents)
            inside = np.isfinite(r) & np.isfinite(J).all(axis=1)
            if inside.sum() < _TUNING.least_pixels:
                return None
            J, r = np.where(inside[:, None], J, 0.0), np.where(inside, r, 0.0)
            hessian, gradient, spread = self._normal_equations(J, r, inside)
            tilt, offset = _whitened_tilt(m, self._normal)
            prior = known.copy()
            prior[:3, :3] += tilt.T @ tilt
            # The noise variance that relates residuals to priors.
            noise = max(float(np.trace(np.linalg.solve(hessian + 1e-9 * np.eye(8), spread))) / 8,
                        1e-9)
            total = hessian / noise + prior
            gradient /= noise
            gradient[:3] += tilt.T @ offset
            gradient[3:] += known[3:, 3:] @ theta
            step = -np.linalg.solve(total, gradient)
            m, theta = m + step[:3], theta + step[3:]
            if np.linalg.norm(step[:3]) < _TUNING.converged * np.linalg.norm(m):
                break
        shift = float(np.median(np.linalg.norm(
            places - self._project(R, np.zeros(3), m), axis=1)))
        correlation = _correlation(template, values)
        if correlation < _TUNING.min_correlation or shift < _TUNING.least_shift \
                or m @ self._normal <= 0 \
                or not self._unevenness(r, J, R, t, m) <= _TUNING.max_unevenness:
            return None
        back = np.linalg.inv(total)
        covariance = (back @ (spread / noise**2 + prior) @ back)[:3, :3]
        return _motion_of_plane(m, covariance)

    def _unevenness(self, r: Array, J: Array, R: Array, t: Array, m: Array) -> float:
        """
        Return the median displacement in pixels that remains in cells, along their flow.

        A wall may resemble ground in its motion, but not everywhere.
        """
        longer = (self._project(R, t, 1.01 * m) - self._project(R, t, m)) / 0.01
        slope = (J[:, :3] @ m) / np.maximum(np.linalg.norm(longer, axis=1), 1e-9)
        sums, squares = (np.bincount(self._cells, values) for values in (slope * r, slope**2))
        textured = squares > 0.2 * float(np.median(squares[squares > 0]))
        return float(np.median(np.abs(sums[textured] / squares[textured])))

    def _jacobian(self, gradients: list[Array], R: Array, t: Array, m: Array,
                  tangents: Array) -> Array:
        """Differentiate intensities by plane, rotation and translation direction, (N, 8)."""
        turned, inverse = self._rays @ R.T, self._rays @ m
        y = turned + np.outer(inverse, t)
        flow = np.stack(gradients, axis=1) @ self._K[:2, :2]
        by_point = np.column_stack([flow, -(flow * y[:, :2]).sum(1) / y[:, 2]]) / y[:, 2:]
        return np.column_stack([
            (by_point @ t)[:, None] * self._rays, np.cross(turned, by_point),
            (by_point @ tangents) * inverse[:, None]])

    def _normal_equations(self, J: Array, r: Array,
                          inside: NDArray[np.bool_]) -> tuple[Array, Array, Array]:
        """Return Hessian (8, 8), gradient (8,), and the latter's covariance (8, 8) by noise."""
        scale = robust_scale(r[inside]) + 1e-6
        weights = 1 / (1 + (r / (2 * scale))**2)
        scores = np.stack([np.bincount(self._cells, column)
                           for column in (J * (weights * r)[:, None]).T])
        parameters, cells = scores.shape
        inflation = CAUTIOUS_INFLATION * cells / max(cells - parameters, 1)
        return ((J * weights[:, None]).T @ J, scores.sum(axis=1),
                inflation * scores @ scores.T)


def _sampled(image: Image, pixels: Array) -> Array:
    """Return values (N,) at pixels (N, 2), NaN outside."""
    x, y = pixels.T.astype(np.float32)
    values = cv2.remap(image, x[None], y[None], cv2.INTER_LINEAR,
                       borderMode=cv2.BORDER_CONSTANT, borderValue=float('nan'))
    return np.asarray(values[0], np.float64)


def _correlation(a: Array, b: Array) -> float:
    """Return the correlation of two samples (N,) where both are finite; 0 if these are too few."""
    finite = np.isfinite(a) & np.isfinite(b)
    if finite.sum() < max(_TUNING.least_pixels, len(b) / 4):
        return 0.0
    a, b = a[finite], b[finite]
    power = float(a @ a) * float(b @ b)
    return float(a @ b) / np.sqrt(power) if power > 0 else 0.0


def _whitened_tilt(m: Array, normal: Array) -> tuple[Array, Array]:
    """
    Return the tilt of a plane against level ground, whitened.

    Returns its derivative (2, 3) by the plane, and the tilt (2,) itself.
    """
    across = np.stack([[1.0, 0.0, 0.0], np.cross([1.0, 0.0, 0.0], normal)]) / _TUNING.tilt
    length = float(np.linalg.norm(m))
    n = m / length
    return across @ (np.eye(3) - np.outer(n, n)) / length, across @ n


def _motion_of_plane(m: Array, covariance: Array) -> GroundMotion:
    """Return length, pitch and roll of a plane m (3,), with their covariance from its (3, 3)."""
    length = float(np.linalg.norm(m))
    tilt, by_plane = _tilt(m)
    J = np.vstack([m / length, by_plane])
    return GroundMotion(np.array([length, *tilt]), J @ covariance @ J.T)


def _tilt(m: Array) -> tuple[Array, Array]:
    """Return pitch and roll (2,) in rad of a plane m (3,), and their derivative (2, 3) by it."""
    length = float(np.linalg.norm(m))
    x, y, z = (m / length).tolist()
    upright = np.hypot(y, z)
    J = np.array([[0.0, -z / upright**2, y / upright**2],
                  [upright, -x * y / upright, -x * z / upright]]) / length
    return np.array([np.arctan2(z, y), np.arctan2(x, upright)]), J


def rotate_tilt(tilt: Array, R: Array, covariance: Array) -> tuple[Array, Array, Array]:
    """
    Propagate pitch and roll of a plane through a rotation of the camera.

    tilt: (2,) pitch and roll in rad before; R: (3, 3) rotation, ``x_after = R x_before``, with the
    covariance (3, 3) of its rotation vector. Returns the (2,) after, their derivative (2, 2) by
    those before, and their covariance (2, 2) by the rotation.
    """
    pitch, roll = tilt
    normal = np.array([np.sin(roll), np.cos(roll) * np.cos(pitch), np.cos(roll) * np.sin(pitch)])
    _, before = _tilt(normal)
    after, J = _tilt(R @ normal)
    by_turn = -J @ skew(R @ normal)
    # Pitch and roll move the normal orthogonally to itself, as the pseudoinverse does.
    return after, J @ R @ np.linalg.pinv(before), by_turn @ covariance @ by_turn.T
