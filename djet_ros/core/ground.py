"""
The ground under a moving camera: how far it went over it, in heights of the camera.

Points X of a plane with m.X = 1 have the inverse depth m.x along their ray x, so that two views
with X' = R X + t see it as y ~ (R + t m^T) x (Faugeras and Lustman, 1988). With t of length one,
|m| is the length of the translation in heights of the camera over the plane, and m / |m| is its
normal. All pixels where level ground would be are aligned directly, because roads have few
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
    """Constants of the ground, each with where it comes from ("chosen" was not searched)."""

    # What is looked at, in heights of the camera over level ground; chosen for a car's lane:
    # from so near, and to either side
    near: float = 1.0
    aside: float = 1.5
    # roads bend up and down, so that only the nearest is flat: up to so far, or where the nearest
    # that is seen is far already, to so many times that, but not beyond the last
    flat: float = 6.0
    times: float = 1.5
    far: float = 14.0

    # Pixels. Chosen: fewer than this see too little; more than this only cost time
    least_pixels: int = 400
    pixels: int = 4000
    # of an image, from which those are chosen; chosen: the size of a car's camera
    candidates: int = 500_000

    # The search. Lengths of a translation in heights; chosen, from a crawl to the fastest car
    lengths: tuple[float, float] = (0.02, 4.0)
    # of the logarithm of a length: makes steps of a pixel or two
    step: float = 0.03
    # correlation with which ground is seen again; chosen: walls and cars that are taken for
    # ground have less
    seen: float = 0.6
    # chosen: correlation with which images about whose motion nothing is known are of one place
    same: float = 0.95
    # chosen: another length must correlate by so much less, if it is no neighbour by so many steps
    clearly: float = 0.1
    neighbours: int = 6
    # pixels; chosen: ground that moves by less, while other things show that the camera moves,
    # is none: something that moves with the camera hides it
    least_shift: float = 1.0

    # The texture. Gray levels at which contrast is noise, a camera's usual
    noise: float = 2.0
    # pixels over which contrast is evened out; chosen. Nearer than half of that to the rim of
    # the image, what lies beyond would have to be invented
    side: int = 25
    rim: int = side // 2 + 2

    # The fit. Standard deviation in rad of the normals considered, about level ground's: the 2
    # degrees to which the pitch is to be given, and a road's own on top
    lean: float = math.radians(3.0)
    # pixels that cells of flat ground are off at most, in the median; chosen: walls are off more
    uneven: float = 0.6
    # chosen: rounds of Gauss-Newton, and the share of the plane by which it moves at rest
    rounds: int = 10
    rests: float = 1e-3


_TUNING = GroundTuning()

# Heights of the camera for which a place on the ground stays in sight, as the camera goes on.
SIGHT = _TUNING.flat - _TUNING.near


@dataclass(frozen=True)
class GroundMotion:
    """
    What a pair of views says of the ground.

    value: (3,) length of the translation in heights of the camera, and pitch (down is positive)
    and roll in rad of the previous view's camera against the ground; covariance: (3, 3).
    """

    value: Array
    covariance: Array


class Ground:
    """
    Where a camera sees the ground, if that is level.

    K: (3, 3) camera matrix; shape: (height, width) of its images; pitch: in rad, by which it looks
    down. Roll is taken to be small.
    """

    def __init__(self, K: Array, shape: tuple[int, ...], pitch: float) -> None:
        """Choose the pixels that see ground."""
        self._normal = np.array([0.0, np.cos(pitch), np.sin(pitch)])
        self._forward = np.array([0.0, -np.sin(pitch), np.cos(pitch)])
        self._reach = _TUNING.far
        # Of large images every second row and column, and so on, are more than enough.
        every = max(math.isqrt(shape[0] * shape[1] // _TUNING.candidates), 1)
        columns, rows = np.meshgrid(np.arange(_TUNING.rim, shape[1] - _TUNING.rim, every),
                                    np.arange(_TUNING.rim, shape[0] - _TUNING.rim, every))
        pixels = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float64)
        towards = rays(K, pixels)
        seen = self._sees(towards)
        if seen.any():
            nearest = float(self._ahead(towards[seen]).min())
            self._reach = max(_TUNING.flat, _TUNING.times * nearest)
        chosen = np.flatnonzero(self._sees(towards))
        self.is_in_view = len(chosen) >= _TUNING.least_pixels
        if not self.is_in_view:
            return
        some = np.linspace(0, len(chosen) - 1, min(len(chosen), _TUNING.pixels)).astype(np.int64)
        self._pixels, self._rays = pixels[chosen[some]], towards[chosen[some]]
        # Above the ground nothing is looked at, but for what the filters reach.
        self._top = max(int(self._pixels[:, 1].min()) - _TUNING.side, 0)
        self._K = K - [[0, 0, 0], [0, 0, self._top], [0, 0, 0]]
        self._pixels[:, 1] -= self._top
        _, self._cells = np.unique((self._pixels // CELL) @ [1, 1 << 16], return_inverse=True)

    def _ahead(self, towards: Array) -> Array:
        """Give how far ahead, in heights, rays (N, 3) meet level ground; infinite above it."""
        inverse = towards @ self._normal
        ahead = np.where(inverse > 1e-9, towards @ self._forward, np.inf)
        return np.asarray(ahead / np.maximum(inverse, 1e-9))

    def _sees(self, towards: Array) -> NDArray[np.bool_]:
        """(N,) bool mask of the rays (N, 3) that meet level ground that is looked at."""
        ahead = self._ahead(towards)
        aside = np.abs(towards[:, 0]) / np.maximum(towards @ self._normal, 1e-9)
        return np.asarray((ahead > _TUNING.near) & (ahead < min(self._reach, _TUNING.far))
                          & (aside < _TUNING.aside))

    def motion(self, previous: View, current: View, relative: RelativePose,
               lengths: tuple[float, float] = _TUNING.lengths) -> GroundMotion | None:
        """
        Find how the ground moves between two views, from the motion between them.

        lengths: from which to which one, in heights, is searched first. None where no ground is
        seen, or where it does not tell.
        """
        if not self.is_in_view:
            return None
        here, there = self._texture(previous), self._texture(current)
        wanted = _sampled(here, self._pixels)
        if relative.status is not Status.OK:
            return self._standing(wanted, there, relative)
        start = self._search(wanted, there, relative, lengths)
        if start is None:
            start = self._search(wanted, there, relative, _TUNING.lengths)
        return None if start is None else self._fit(wanted, there, relative, start)

    def _texture(self, view: View) -> Image:
        """Image whose contrast is alike everywhere, from the highest row looked at."""
        gray = cv2.GaussianBlur(view.gray[self._top:], (0, 0), 1.0).astype(np.float32)
        detail = gray - cv2.blur(gray, (_TUNING.side, _TUNING.side))
        # The running sums of a filter may end a little below zero.
        power = np.maximum(cv2.blur(detail**2, (_TUNING.side, _TUNING.side)), 0.0)
        inner, rim = np.full(gray.shape, np.nan, np.float32), _TUNING.side // 2
        inner[rim:-rim, rim:-rim] = (detail / (np.sqrt(power) + _TUNING.noise))[rim:-rim, rim:-rim]
        if view.mask is not None:
            inner[view.mask[self._top:]] = np.nan
        return inner

    def _seen_again(self, R: Array, t: Array, m: Array) -> Array:
        """Pixels (N, 2) of the points of a plane m in the current view."""
        seen = (self._rays @ R.T + np.outer(self._rays @ m, t)) @ self._K.T
        return np.asarray(seen[:, :2] / np.maximum(seen[:, 2:], 1e-9))

    def _standing(self, wanted: Array, there: Image,
                  relative: RelativePose) -> GroundMotion | None:
        """Tell whether the ground is where a rotation alone would bring it, or where it was."""
        turned = relative.status is Status.NO_PARALLAX
        R = relative.R if turned else np.eye(3)
        correlation = _correlation(
            wanted, _sampled(there, self._seen_again(R, np.zeros(3), self._normal)))
        if correlation < (_TUNING.seen if turned else _TUNING.same):
            return None
        least = _TUNING.least_shift / (self._K[0, 0] * float(np.median(self._rays @ self._normal)))
        return GroundMotion(np.zeros(3), np.diag([least**2, np.pi**2, np.pi**2]))

    def _search(self, wanted: Array, there: Image, relative: RelativePose,
                lengths: tuple[float, float]) -> Array | None:
        """Plane (3,) of the length at which level ground correlates best, if one stands out."""
        step, (least, most) = _TUNING.step, _TUNING.lengths
        low, high = max(lengths[0], least), min(lengths[1], most)
        tried = np.exp(np.arange(np.log(low) - step, np.log(max(low, high)) + 2 * step, step))
        found = np.array([_correlation(wanted, _sampled(there, self._seen_again(
            relative.R, relative.t, length * self._normal))) for length in tried])
        best = int(found.argmax())
        if found[best] < _TUNING.seen or best in (0, len(found) - 1):
            return None
        # Textures that repeat have several peaks; slow ground has one, but a broad one.
        peaks = found == maximum_filter1d(found, 2 * _TUNING.neighbours + 1, mode='nearest')
        if (peaks & (found > found[best] - _TUNING.clearly)).sum() > 1:
            return None
        return np.asarray(tried[best] * self._normal)

    def _fit(self, wanted: Array, there: Image, relative: RelativePose,
             m: Array) -> GroundMotion | None:
        """
        Fit the plane by Gauss-Newton, together with the motion as far as that is uncertain.

        Robust (Cauchy) residuals of intensity; their noise is taken from their sums over cells, as
        for the pose, so that the covariance holds however rough the texture is.
        """
        known = np.zeros((8, 8))
        known[3:, 3:] = np.linalg.inv(relative.covariance_5 + 1e-12 * np.eye(5))
        tangents, theta = sphere_tangents(relative.t), np.zeros(5)
        gradients = [np.asarray(cv2.Scharr(there, -1, *axis, scale=1 / 32), np.float32)
                     for axis in ((1, 0), (0, 1))]
        for _ in range(_TUNING.rounds):
            R = rotation_exp(theta[:3]) @ relative.R
            t = relative.t + tangents @ theta[3:]
            places = self._seen_again(R, t, m)
            found = _sampled(there, places)
            r = found - wanted
            J = self._jacobian([_sampled(g, places) for g in gradients], R, t, m, tangents)
            inside = np.isfinite(r) & np.isfinite(J).all(axis=1)
            if inside.sum() < _TUNING.least_pixels:
                return None
            J, r = np.where(inside[:, None], J, 0.0), np.where(inside, r, 0.0)
            hessian, gradient, spread = self._normal_equations(J, r, inside)
            lean, offset = _leaning(m, self._normal)
            prior = known.copy()
            prior[:3, :3] += lean.T @ lean
            # The noise that makes residuals and priors comparable.
            noise = max(float(np.trace(np.linalg.solve(hessian + 1e-9 * np.eye(8), spread))) / 8,
                        1e-9)
            total = hessian / noise + prior
            gradient /= noise
            gradient[:3] += lean.T @ offset
            gradient[3:] += known[3:, 3:] @ theta
            step = -np.linalg.solve(total, gradient)
            m, theta = m + step[:3], theta + step[3:]
            if np.linalg.norm(step[:3]) < _TUNING.rests * np.linalg.norm(m):
                break
        shift = float(np.median(np.linalg.norm(
            places - self._seen_again(R, np.zeros(3), m), axis=1)))
        correlation = _correlation(wanted, found)
        if correlation < _TUNING.seen or shift < _TUNING.least_shift or m @ self._normal <= 0 \
                or not self._unevenness(r, J, R, t, m) <= _TUNING.uneven:
            return None
        back = np.linalg.inv(total)
        covariance = (back @ (spread / noise**2 + prior) @ back)[:3, :3]
        return _described(m, covariance)

    def _unevenness(self, r: Array, J: Array, R: Array, t: Array, m: Array) -> float:
        """
        Median shift in pixels by which cells are still off along their flow.

        A wall may move much as ground does, but not everywhere.
        """
        longer = (self._seen_again(R, t, 1.01 * m) - self._seen_again(R, t, m)) / 0.01
        slope = (J[:, :3] @ m) / np.maximum(np.linalg.norm(longer, axis=1), 1e-9)
        sums, squares = (np.bincount(self._cells, values) for values in (slope * r, slope**2))
        told = squares > 0.2 * float(np.median(squares[squares > 0]))
        return float(np.median(np.abs(sums[told] / squares[told])))

    def _jacobian(self, gradients: list[Array], R: Array, t: Array, m: Array,
                  tangents: Array) -> Array:
        """Differentiate intensities by plane, rotation and direction of translation, (N, 8)."""
        turned, inverse = self._rays @ R.T, self._rays @ m
        y = turned + np.outer(inverse, t)
        flow = np.stack(gradients, axis=1) @ self._K[:2, :2]
        by_point = np.column_stack([flow, -(flow * y[:, :2]).sum(1) / y[:, 2]]) / y[:, 2:]
        return np.column_stack([
            (by_point @ t)[:, None] * self._rays, np.cross(turned, by_point),
            (by_point @ tangents) * inverse[:, None]])

    def _normal_equations(self, J: Array, r: Array,
                          inside: NDArray[np.bool_]) -> tuple[Array, Array, Array]:
        """Hessian (8, 8), gradient (8,), and the covariance (8, 8) that noise gives the latter."""
        scale = robust_scale(r[inside]) + 1e-6
        weights = 1 / (1 + (r / (2 * scale))**2)
        scores = np.stack([np.bincount(self._cells, column)
                           for column in (J * (weights * r)[:, None]).T])
        parameters, cells = scores.shape
        inflation = CAUTIOUS_INFLATION * cells / max(cells - parameters, 1)
        return ((J * weights[:, None]).T @ J, scores.sum(axis=1),
                inflation * scores @ scores.T)


def _sampled(image: Image, pixels: Array) -> Array:
    """Values (N,) at pixels (N, 2), NaN outside."""
    x, y = pixels.T.astype(np.float32)
    values = cv2.remap(image, x[None], y[None], cv2.INTER_LINEAR,
                       borderMode=cv2.BORDER_CONSTANT, borderValue=float('nan'))
    return np.asarray(values[0], np.float64)


def _correlation(a: Array, b: Array) -> float:
    """Correlation of two samples (N,) where both are there; 0 if that is too little."""
    there = np.isfinite(a) & np.isfinite(b)
    if there.sum() < max(_TUNING.least_pixels, len(b) / 4):
        return 0.0
    a, b = a[there], b[there]
    power = float(a @ a) * float(b @ b)
    return float(a @ b) / np.sqrt(power) if power > 0 else 0.0


def _leaning(m: Array, normal: Array) -> tuple[Array, Array]:
    """
    Tell how a plane leans against level ground, in its usual deviations.

    Gives the derivative (2, 3) by the plane, and the lean (2,) itself.
    """
    across = np.stack([[1.0, 0.0, 0.0], np.cross([1.0, 0.0, 0.0], normal)]) / _TUNING.lean
    length = float(np.linalg.norm(m))
    n = m / length
    return across @ (np.eye(3) - np.outer(n, n)) / length, across @ n


def _described(m: Array, covariance: Array) -> GroundMotion:
    """Length, pitch and roll of a plane m (3,) and of its covariance (3, 3)."""
    length = float(np.linalg.norm(m))
    lean, by_plane = _lean(m)
    J = np.vstack([m / length, by_plane])
    return GroundMotion(np.array([length, *lean]), J @ covariance @ J.T)


def _lean(m: Array) -> tuple[Array, Array]:
    """Pitch and roll (2,) in rad of a plane m (3,), and their derivative (2, 3) by it."""
    length = float(np.linalg.norm(m))
    x, y, z = (m / length).tolist()
    upright = np.hypot(y, z)
    J = np.array([[0.0, -z / upright**2, y / upright**2],
                  [upright, -x * y / upright, -x * z / upright]]) / length
    return np.array([np.arctan2(z, y), np.arctan2(x, upright)]), J


def turned(lean: Array, R: Array, covariance: Array) -> tuple[Array, Array, Array]:
    """
    Tell how a plane at rest leans against a camera that turns.

    lean: (2,) pitch and roll in rad before; R: (3, 3) rotation, ``x_after = R x_before``, with
    the covariance (3, 3) of its rotation vector. Gives the lean (2,) after, its derivative (2, 2)
    by that before, and the covariance (2, 2) that comes of the rotation.
    """
    pitch, roll = lean
    normal = np.array([np.sin(roll), np.cos(roll) * np.cos(pitch), np.cos(roll) * np.sin(pitch)])
    _, before = _lean(normal)
    after, J = _lean(R @ normal)
    by_turn = -J @ skew(R @ normal)
    # A lean moves the normal across itself, as the pseudoinverse does.
    return after, J @ R @ np.linalg.pinv(before), by_turn @ covariance @ by_turn.T
