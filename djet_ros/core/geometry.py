"""
Two-view geometry: rotations, the essential and fundamental matrix, epipolar lines, chirality.

Convention throughout the core: x in the previous image A, y in the current image B, and ``X_B = R
X_A + t``, so that ``y^T F x = 0`` with F = K^-T [t]_x R K^-1 (paper, "Epipolar Constrained
Tracking").
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import cv2
from djet_ros import compiled
from djet_ros.core.medians import median
from djet_ros.core.types import Array, RelativePose
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

# Generators of SO(3), (3, 3, 3): [e_i]_x.
GENERATORS = np.cross(np.eye(3)[:, None], np.eye(3)[None]).transpose(0, 2, 1)

# rad^2; least variance of a match, of a five-hundredth of a pixel and far below any noise. Beside
# its inverse times the number of matches, a prior information of one is not lost in rounding.
_LEAST_SQUARE = 1e-11

# Takes the trace of a rotation (9,), and the vector (3,) of its antisymmetric part.
_TRACE_AND_VECTOR = np.column_stack([np.eye(3).ravel(), GENERATORS.reshape(3, 9).T / 2])


def skew(v: Array) -> Array:
    """Cross-product matrices [v]_x (…, 3, 3) of vectors (…, 3): [v]_x w is the product v x w."""
    return np.asarray(v @ GENERATORS.reshape(3, 9)).reshape(*v.shape, 3)


def rotation_exp(omega: Array) -> Array:
    """Rotation matrices (…, 3, 3) of rotation vectors, (3,) or (N, 3), in radians."""
    if omega.ndim == 1:  # Rodrigues' formula
        return np.asarray(cv2.Rodrigues(omega)[0])
    # For a zero rotation the quotients are 1 to the last bit.
    half = np.maximum(norms(omega) / 2, 1e-9)[:, None, None]
    turning, quotient = skew(omega), np.sin(half) / half
    # sin(a) / a and (1 - cos(a)) / a^2
    return np.asarray(np.eye(3) + quotient * np.cos(half) * turning
                      + quotient**2 / 2 * (turning @ turning))


def rotation_log(R: Array) -> Array:
    """Rotation vectors (…, 3) in radians of rotation matrices, (3, 3) or (N, 3, 3)."""
    parts = R.reshape(*R.shape[:-2], 9) @ _TRACE_AND_VECTOR
    cosines, antisymmetric = (parts[..., 0] - 1) / 2, parts[..., 1:]
    # Up to 90 degrees the antisymmetric part gives the axis, in a tenth of the time.
    if not (cosines > 0).all():
        return np.asarray(Rotation.from_matrix(R).as_rotvec())
    sines = norms(antisymmetric)
    angles = np.arctan2(sines, cosines)
    return np.asarray(antisymmetric * (angles / np.maximum(sines, 1e-300))[..., None])


def unit(v: Array) -> Array:
    """Scale vectors along the last axis to length one; zero vectors stay zero."""
    length = norms(v)[..., None]
    return np.asarray(v / np.where(length > 0, length, 1.0))


def norms(v: NDArray[Any]) -> NDArray[Any]:
    """Lengths (…) of short vectors along the last axis, by component: a third of the time."""
    v = np.asarray(v)
    total = v[..., 0]**2
    for k in range(1, v.shape[-1]):
        total += v[..., k]**2
    return np.asarray(np.sqrt(total))


def sphere_tangents(t: Array) -> Array:
    """
    Return an orthonormal basis (…, 3, 2) of the tangent plane of unit vectors t, (3,) or (N, 3).

    Duff et al., "Building an Orthonormal Basis, Revisited" (JCGT 2017): no division by zero.
    """
    x, y, z = t.T
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    return np.array([[1.0 + sign * x * x * a, b], [sign * b, sign + y * y * a],
                     [-sign * x, -y]]).transpose(*range(2, t.ndim + 1), 0, 1)


def sphere_log(t: Array, other: Array) -> Array:
    """
    Logarithm (..., 2) at t (3,) of other directions (..., 3), in the basis of its tangents.

    Its length is the arc in rad. For opposite directions that is pi, and the direction is
    arbitrary.
    """
    # Less than any rounding, but it gives the opposite direction a way to go.
    across = other @ sphere_tangents(t) + (1e-150, 0.0)
    sines = norms(across)
    return np.asarray(across * (np.arctan2(sines, other @ t) / sines)[..., None])


def inverse_intrinsics(K: Array) -> Array:
    """Return the inverse (3, 3) of a camera matrix, cached: it is used fifty times a frame."""
    return _inverse(np.asarray(K, float).tobytes())


@lru_cache(maxsize=8)
def _inverse(matrix: bytes) -> Array:
    inverse = np.asarray(np.linalg.inv(np.frombuffer(matrix).reshape(3, 3)))
    inverse.setflags(write=False)
    return inverse


def rays(K: Array, points: Array) -> Array:
    """Return the viewing rays K^-1 x (N, 3) of pixels (N, 2), with z = 1."""
    K_inv = inverse_intrinsics(K)
    # Component-major: half of the time, and the layout that most uses of them need.
    return np.asarray((K_inv[:, :2] @ points.T + K_inv[:, 2:]).T)


def essential(R: Array, t: Array) -> Array:
    """Essential matrix E = [t]_x R, (3, 3)."""
    return np.asarray(skew(t) @ R)


def fundamental(K: Array, R: Array, t: Array) -> Array:
    """Fundamental matrix F = K^-T [t]_x R K^-1, (3, 3)."""
    K_inv = inverse_intrinsics(K)
    return np.asarray(K_inv.T @ essential(R, t) @ K_inv)


def epipolar_lines(F: Array, x: Array) -> Array:
    """Epipolar lines l = F x (N, 3) in image B, of pixels x (N, 2) of image A."""
    # Component-major, as in `rays`.
    return np.asarray((F[:, :2] @ x.T + F[:, 2:]).T)


def line_distances(lines: Array, y: Array) -> Array:
    """Signed distances (N,) in pixels of points y (N, 2) to lines (N, 3)."""
    norm = np.hypot(lines[:, 0], lines[:, 1])
    return np.asarray(line_values(lines, y) / np.maximum(norm, 1e-12))


def line_values(lines: Array, y: Array) -> Array:
    """Values (N,) of lines (N, 3) at points y (N, 2): l^T y, 0 on the line."""
    return np.asarray(lines[:, 0] * y[:, 0] + lines[:, 1] * y[:, 1] + lines[:, 2])


def inlier_rays(relative: RelativePose, K: Array) -> tuple[Array, Array]:
    """Return rays (N, 3) of a pair's inliers in both images, at refined places; K: (3, 3)."""
    inliers = relative.inliers
    return rays(K, relative.x[inliers]), rays(K, relative.placed[inliers])


def fit_rotation(rays_x: Array, rays_y: Array, rounds: int = 5) -> Array:
    """
    Fit a rotation R (3, 3) that brings rays x (N, 3) to rays y (N, 3), robustly.

    Least squares over directions (Wahba's problem), reweighted by a Cauchy loss at the median
    deviation, so that near points and moving objects in part of the image do not bias it.
    """
    if compiled.library is not None:
        return compiled.fit_rotation(rays_x, rays_y, rounds)
    # Component-major: a third of the time.
    x, y = (one.T / np.sqrt(np.einsum('ij,ij->i', one, one)) for one in (rays_x, rays_y))
    R, weights, half = np.eye(3), np.ones(len(rays_x)), len(rays_x) // 2
    for _ in range(rounds):
        R = nearest_rotation((y * weights) @ x.T)
        residuals = y - R @ x
        squared = np.einsum('ij,ij->j', residuals, residuals)
        # The median of the squared deviations.
        weights = 1 / (1 + squared / max(float(np.partition(squared, half)[half]), 1e-18))
    return R


def displaced_by_turn(x: Array, y: Array) -> tuple[Array, Array]:
    """Return the derivatives (3, N) of x = X/Z, and of y = Y/Z, (N,) each, by a rotation."""
    one = np.ones_like(x)
    return (np.array([-x * y, one + x * x, -y]), np.array([-one - y * y, x * y, x]))


def turn_before_plane(rays_x: Array, rays_y: Array, rounds: int = 5) -> tuple[Array, Array]:
    """
    Return the rotation vector (3,) of a small motion in front of a plane, and its covariance.

    Rays X = (x, y, 1) move by w x X + (1 + a x + b y) v: v is the translation in units of the
    depth of the plane straight ahead, which leans by the slopes a and b (Longuet-Higgins and
    Prazdny, 1980). What the image does not determine is less than one radian, one depth, and a
    slope of one. Robust as `fit_rotation`. rays_x, rays_y: (N, 3), nearly the same.
    """
    (x, y), seen = ((towards[:, :2] / towards[:, 2:]).T for towards in (rays_x, rays_y))
    one, none = np.ones_like(x), np.zeros_like(x)
    by_turn = np.concatenate(displaced_by_turn(x, y), axis=1)
    by_shift = np.concatenate([[one, none, -x], [none, one, -y]], axis=1)
    xy, offsets = np.tile([x, y], 2), (seen - [x, y]).ravel()
    w, v, slopes = np.zeros(3), np.zeros(3), np.zeros(2)
    for _ in range(rounds):
        # Gauss-Newton: the motion of the plane is linear in w and v, and in its slopes.
        inverse_depths, shifts = 1 + slopes @ xy, v @ by_shift
        J = np.concatenate([by_turn, by_shift * inverse_depths, shifts * xy])
        residuals = offsets - w @ by_turn - shifts * inverse_depths
        squared = (residuals**2).reshape(2, -1).sum(0)
        half = max(median(squared), _LEAST_SQUARE)
        weighted = J * np.tile(1 / (half + squared), 2)
        motion = np.concatenate([w, v, slopes])
        motion += np.linalg.solve(weighted @ J.T + np.eye(8), weighted @ residuals - motion)
        w, v, slopes = np.split(motion, (3, 6))
    # Half of the squared lengths of normal errors are below 2 ln 2 variances.
    information = 2 * np.log(2) / half * J @ J.T + np.eye(8)
    return w, np.asarray(np.linalg.inv(information)[:3, :3])


def nearest_rotation(M: Array) -> Array:
    """Return the rotation (3, 3) nearest to a matrix (3, 3), in the Frobenius norm."""
    U, _, Vt = np.linalg.svd(M)
    R = U @ Vt
    if np.linalg.det(R) < 0:
        U[:, 2] = -U[:, 2]
        R = U @ Vt
    return np.asarray(R)


def in_front(R: Array, t: Array, rays_x: Array, rays_y: Array) -> NDArray[np.bool_]:
    """
    Return the (N,) bool mask of points with positive depth in both cameras (chirality).

    Only signs count, so distant points count like near ones: cv2.recoverPose ignores points beyond
    50 baselines and then decides forward motion on a handful.
    """
    depth_x, depth_y = _scaled_depths(R, t, rays_x, rays_y)
    return np.asarray((depth_x > 0) & (depth_y > 0))


def chirality_signs(R: Array, t: Array, rays_x: Array, rays_y: Array) -> Array:
    """Sign (N,) of t that brings each point in front of both cameras, 0 if neither does."""
    # The opposite t negates all depths.
    depth_x, depth_y = _scaled_depths(R, t, rays_x, rays_y)
    ahead, behind = ((depth_x > 0) & (depth_y > 0), (depth_x < 0) & (depth_y < 0))
    return ahead.astype(float) - behind


def depth_ratio(R: Array, t: Array, rays_x: Array, rays_y: Array) -> Array:
    """
    Return the depths in A over the depths in B (N,): the magnification of a point's neighbourhood.

    It depends neither on the length nor on the sign of t: close to 1 for distant points, negative
    for a point in front of one camera only, NaN if the depth is undetermined.
    """
    depth_x, depth_y = _scaled_depths(R, t, rays_x, rays_y)
    with np.errstate(divide='ignore', invalid='ignore'):
        return np.asarray(depth_x / depth_y)


def inverse_depths(R: Array, t: Array, rays_x: Array, rays_y: Array) -> tuple[Array, Array]:
    """
    Triangulate inverse depths (N,) in A of matched rays (N, 3) with z = 1, in units of 1 / |t|.

    For S poses, R (S, 3, 3) and t (S, 3), they are (S, N).

    By least squares of y x (R x + rho t) = 0, which is linear in rho: noise around zero stays
    unbiased. Also returns their standard deviations (N,) for unit noise in both x and y of the
    rays in B.

    With s = y x R x, l = y x t and d = Z_B / Z_A, so that R x + rho t = d y, an error e =
    (e_x, e_y, 0) of a ray changes s + rho l by d (e x y), and the minimum rho = -s.l / l^2 by

        -l.(d (e x y)) / l^2 = -d e.(y x l) / l^2.
    """
    # Component-wise: a third of the time of np.cross.
    m, (y1, y2, y3) = R @ rays_x.T, rays_y.T
    m1, m2, m3 = m[..., 0, :], m[..., 1, :], m[..., 2, :]
    t1, t2, t3 = t[..., 0, None], t[..., 1, None], t[..., 2, None]
    s1, s2, s3 = y2 * m3 - y3 * m2, y3 * m1 - y1 * m3, y1 * m2 - y2 * m1
    l1, l2, l3 = y2 * t3 - y3 * t2, y3 * t1 - y1 * t3, y1 * t2 - y2 * t1
    squared = np.maximum(l1 * l1 + l2 * l2 + l3 * l3, 1e-12)
    rho = -(s1 * l1 + s2 * l2 + s3 * l3) / squared
    p1, p2 = y2 * l3 - y3 * l2, y3 * l1 - y1 * l3
    # Not shorter than l, except at the epipole, where both vanish.
    pulled = np.sqrt(np.maximum(p1 * p1 + p2 * p2, squared))
    return rho, np.abs(m3 + rho * t3) * pulled / squared


def depths_in_second(R: Array, t: Array, rays_x: Array, rho: Array) -> Array:
    """
    Return the depths (N,) in B of points on rays (N, 3) of A, over their depths in A.

    rho: (N,) inverse depths in A, in units of 1 / |t|.
    """
    return np.asarray((rays_x @ R.T)[:, 2] + rho * t[2])


def patch_warp(K: Array, R: Array, y: Array, depth_ratio: Array) -> Array:
    """
    Return the local homographies (N, 3, 2) of patches that are fronto-parallel in A, as seen in B.

    R: (3, 3), or (N, 3, 3) from several cameras A; y: (N, 2) pixels in B; depth_ratio: (N,), see
    there. Depth is constant over a patch, so that with M = K R K^-1 and y = (M x Z_A + K t) / Z_B,
    a step dx leads exactly to

        dy = W dx / (1 + c^T dx),   W = Z_A / Z_B (M_12 - y m_3^T),   c = Z_A / Z_B m_3,

    with M_12 the first two rows of M and m_3 the third, of two entries each. The first two rows of
    a warp are W, the derivative dy/dx, and the third is c, the relative change of the depth in B
    per pixel.
    """
    M = K @ R @ inverse_intrinsics(K)
    warp = np.empty((len(y), 3, 2))
    warp[:, :2] = M[..., :2, :2] - y[:, :, None] * M[..., 2:, :2]
    warp[:, 2] = M[..., 2, :2]
    return np.asarray(depth_ratio[:, None, None] * warp)


def slant_warp(K: Array, t: Array, y: Array, depth_ratio: Array, slope: Array) -> Array:
    """
    Return the terms (N, 3, 2) to add to `patch_warp` for slanted patches.

    t: (3,) or (N, 3) translation to B; slope: (N, 2) derivative of the inverse depth in A, in
    units of 1 / |t|, per pixel; it is constant on a plane, so that the sum is the plane's
    homography. With y = (M x + rho K t) / (Z_B / Z_A), the derivative by rho is Z_A / Z_B
    ((K t)_12 - y t_3), and that of the denominator is t_3.
    """
    shift = t @ K.T
    by_depth = np.empty((len(y), 3))
    by_depth[:, :2] = shift[..., :2] - y * shift[..., 2:]
    by_depth[:, 2] = shift[..., 2]
    return np.asarray((depth_ratio[:, None] * by_depth)[:, :, None] * slope[:, None])


def inverses(A: Array) -> Array:
    """Invert regular matrices (N, 2, 2) in closed form: ten times as fast as one by one."""
    a, b, c, d = A[:, 0, 0], A[:, 0, 1], A[:, 1, 0], A[:, 1, 1]
    area, inverse = a * d - b * c, np.empty(A.shape)
    inverse[:, 0, 0], inverse[:, 1, 1] = d / area, a / area
    inverse[:, 0, 1], inverse[:, 1, 0] = -b / area, -c / area
    return inverse


def singular_values(warp: Array) -> tuple[Array, Array]:
    """Return the smallest and the largest singular values (N,) of matrices (N, 2, 2)."""
    size = (warp**2).sum((1, 2))
    area = np.abs(warp[:, 0, 0] * warp[:, 1, 1] - warp[:, 0, 1] * warp[:, 1, 0])
    total, difference = np.sqrt(size + 2 * area), np.sqrt(np.maximum(size - 2 * area, 0))
    return (total - difference) / 2, (total + difference) / 2


def _scaled_depths(R: Array, t: Array, rays_x: Array, rays_y: Array) -> tuple[Array, Array]:
    """Return depths (N,) in A and in B, both up to one positive factor per point."""
    # Component-wise: a third of the time of np.cross.
    (m1, m2, m3), (y1, y2, y3), (t1, t2, t3) = R @ rays_x.T, rays_y.T, t
    n1, n2, n3 = m2 * y3 - m3 * y2, m3 * y1 - m1 * y3, m1 * y2 - m2 * y1
    # (t x v) . n = v . (n x t)
    p1, p2, p3 = t2 * n3 - t3 * n2, t3 * n1 - t1 * n3, t1 * n2 - t2 * n1
    return y1 * p1 + y2 * p2 + y3 * p3, m1 * p1 + m2 * p2 + m3 * p3


def rotation_angle(Ra: Array, Rb: Array) -> float:
    """Angle in radians between two rotations (paper, "Evaluation metrics": Rodrigues)."""
    return float(norms(rotation_log(Ra.T @ Rb)))


def direction_angle(ta: Array, tb: Array) -> float:
    """Angle in radians between two directions (there: the translation error)."""
    return float(np.arctan2(np.linalg.norm(np.cross(ta, tb)), np.dot(ta, tb)))
