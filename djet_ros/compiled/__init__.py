"""
Optional C implementations of the core's inner loops, for packages built with a C compiler.

Each function has a NumPy implementation in the core, which is the reference; a test compares both.
They agree to rounding. Arguments have the documented shapes and any memory layout; results are
contiguous. `library` is None if there is no build, or ``DJET_COMPILED=0`` is set.
"""

from __future__ import annotations

from collections.abc import Sequence
import ctypes
from ctypes import c_char, c_double, c_float, c_int, c_void_p
from importlib.util import find_spec
import os
from typing import Any
from warnings import warn

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Gray = NDArray[np.float32]

# Images (H, W) of one size, each with the number of points in it.
Images = Sequence[tuple[NDArray[Any], int]]

# Version of the C interface, see interface.c: an editable install may have newer sources than its
# build.
_INTERFACE = 13

_NO_BYTES = c_char * 0
_FLOAT64 = np.dtype(np.float64)

# Rows of scratch memory of the optimiser, and the most padding of a row.
_ROWS, _PADDING = 28, 3

# Rows of scratch memory for corner slopes, and for planes in squares.
_CORNER_ROWS, _PLANE_ROWS = 12, 14

# Radius of the largest windows that `graded_surfaces` has room for, as in surfaces.c.
MOST_RADIUS = 7

# Terms summed over the matches of a cell.
_TERMS = 27

# Parameters of a correction of the camera, as in bundle.c.
_OF_CAMERA = 4


def _loaded() -> ctypes.CDLL | None:
    spec = find_spec('djet_ros.compiled._loops')
    if spec is None or spec.origin is None or os.environ.get('DJET_COMPILED') == '0':
        return None
    try:
        # ctypes releases the GIL during calls.
        library = ctypes.CDLL(spec.origin)
    except OSError as error:  # built for another machine, or damaged
        warn(f'{error}; ignored, reinstall djet_ros', stacklevel=2)
        return None
    if not hasattr(library, 'djet_interface') or library.djet_interface() != _INTERFACE:
        warn(f'{spec.origin} is built of other sources; ignored, reinstall djet_ros',
             stacklevel=2)
        return None
    return library


library = _loaded()


def in_use() -> str:
    """Return for display which implementation runs: 'compiled' or 'NumPy'."""
    return 'NumPy' if library is None else 'compiled'


def align(images: Images, current: NDArray[np.uint8], points: Gray, inverse: Gray, start: Array,
          inside: NDArray[np.bool_], tuning: Array) -> tuple[Array, Array, Array]:
    """
    Align N patches of some gray images with another one (H, W): `core.patches.Templates.align`.

    points: (N, 2) in the images, in their order; inverse: (N, 2, 2) inverses of their warps;
    start: (N, 2) initial positions in `current`, with room for the patches and all steps; inside:
    (N,) those that may move; tuning: (4,) regularisation, least noise, number of steps and largest
    displacement. Returns positions (N, 2), variances (N,) of a pixel, and inverse normal matrices
    (N, 2, 2).
    """
    n = len(points)
    places, variances, inverses = np.empty((n, 2)), np.empty(n), np.empty((n, 2, 2))
    _call('djet_align', *_images(images, np.uint8), _ptr(current, np.uint8),
          c_int(current.shape[1]), _ptr(points, np.float32), _ptr(inverse, np.float32),
          _ptr(start), _ptr(inside, np.bool_), *map(_ptr, (tuning, places, variances, inverses)))
    return places, variances, inverses


def warped_grades(images: Images, warps: tuple[Gray, Gray], points: Gray, contrast: Gray,
                  ends: tuple[Gray, NDArray[np.int64]], reach: int, max_depth_ratio: float
                  ) -> NDArray[np.int16]:
    """
    Return grades (T, N) of tests on patches seen through warps: `core.graded.warped_grades`.

    warps: (N, 2, 2) their inverses, and (N, 2) relative changes of depth per pixel; points:
    (N, 2) in the images, ordered by image; contrast: (N,); ends: (2, E) distinct test points, and
    (2, T) the indices of each test; reach: the largest grade; max_depth_ratio: limit of the depth
    ratio.
    """
    n, tests = len(points), ends[1].shape[1]
    grades = np.empty((tests, n), np.int16)
    _call('djet_warped_grades', *_images(images, np.int16), c_int(n),
          _ptr(warps[0], np.float32), _ptr(warps[1], np.float32), c_float(max_depth_ratio),
          _ptr(points, np.float32), _ptr(contrast, np.float32), c_int(ends[0].shape[1]),
          _ptr(ends[0].T, np.float32), c_int(tests), _ptr(ends[1], np.int64), c_int(reach),
          _ptr(grades, np.int16))
    return grades


def graded_surfaces(reference: NDArray[np.int16], image: NDArray[np.int16],
                    centres: NDArray[np.int64], radius: int, tests: NDArray[np.int64],
                    far: int, reach: int) -> Gray:
    """
    Return distances (P, P, N) of graded tests, P = 2 radius + 1: `core.graded.graded_surfaces`.

    reference: (T, N); centres: (N, 2) pixels of the image (H, W), with room for windows and tests
    (T, 4), which reach at most `far` pixels; radius: at most MOST_RADIUS; reach: the largest
    grade.
    """
    n, side = len(centres), 2 * radius + 1
    distances = np.empty((side, side, n), np.float32)
    _call('djet_graded_surfaces', _ptr(reference, np.int16), _ptr(image, np.int16),
          c_int(image.shape[1]), c_int(n), _ptr(centres, np.int64), c_int(radius),
          c_int(len(tests)), _ptr(tests, np.int64), c_int(far), c_int(reach),
          _ptr(distances, np.float32))
    return distances


def corner_slopes(image: NDArray[np.uint8], least_ratio: float, unit: float
                  ) -> tuple[Gray, Gray]:
    """
    Return mean square gradients (H / 2, W / 2) of blocks: `core.corners.corner_slopes`.

    image: (H, W), both even and at least 4; least_ratio: of the weakest to the strongest
    direction; unit: of the result.
    """
    height, width = image.shape
    slopes, steepness = np.empty((2, height // 2, width // 2), np.float32)
    _call('djet_corner_slopes', _ptr(image, np.uint8), c_int(height), c_int(width),
          c_float(least_ratio), c_float(unit),
          _ptr(np.empty((_CORNER_ROWS, width // 2 + 1), np.int32), np.int32),
          _ptr(np.empty((4, width + 2), np.int16), np.int16),
          *(_ptr(each, np.float32) for each in (slopes, steepness)))
    return slopes, steepness


def peaks(slopes: Gray, least: float, margin: int, after: tuple[int, int]
          ) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """
    Find local maxima of slopes (H, W): `core.corners._peaks`.

    least: lower bound of the slopes; margin: first column and row; after: column and row after the
    last. Returns indices (M,) into the flat array, and a mask (M,) of the maxima of their wider
    neighbourhood.
    """
    places, strongest = np.empty(slopes.size, np.int64), np.empty(slopes.size, np.bool_)
    count = _call('djet_peaks', _ptr(slopes, np.float32), c_int(slopes.shape[1]),
                  c_float(least), c_int(margin), *map(c_int, after),
                  _ptr(np.empty(slopes.shape[1], np.uint8), np.uint8),
                  _ptr(places, np.int64), _ptr(strongest, np.bool_))
    return places[:count], strongest[:count]


def exact_peaks(slopes: Gray, places: NDArray[np.int64]) -> Array:
    """
    Return pixels (N, 2) of sub-pixel maxima of slopes (H, W): `core.corners._exact_peaks`.

    places: (N,) indices of peaks in the flat array.
    """
    points = np.empty((len(places), 2))
    _call('djet_exact_peaks', _ptr(slopes, np.float32), c_int(slopes.shape[1]),
          c_int(len(places)), _ptr(places, np.int64), _ptr(points))
    return points


def spread_out(points: NDArray[np.int64], by_strength: NDArray[np.int64],
               first: NDArray[np.bool_], side: int, most: int) -> NDArray[np.int64]:
    """
    Choose at most `most` of points (N, 2), spread over cells, in order: `core.corners.spread_out`.

    by_strength: (N,) order of strength; first: (N,) points preferred to all others; side: of a
    cell in pixels. Needs at least one point.
    """
    n, (columns, rows) = len(points), (points.max(0) // side + 1).tolist()
    chosen, memory = np.empty(n, np.int64), np.empty(2 * columns * rows + 3 * n, np.int32)
    count = _call('djet_spread_out', c_int(n), _ptr(points, np.int64),
                  _ptr(by_strength, np.int64), _ptr(first, np.bool_), c_int(side),
                  c_int(columns), c_int(columns * rows), c_int(most), _ptr(memory, np.int32),
                  _ptr(chosen, np.int64))
    return chosen[:count]


def block_curvatures(image: NDArray[np.uint8], side: int, spacing: int) -> NDArray[np.int32]:
    """
    Sum absolute curvatures in blocks (B,) of an image (H, W): `core.corners._block_curvatures`.

    side: of blocks in pixels; the image has room for one; spacing: rows from one row of blocks to
    the next.
    """
    height, width = image.shape
    rows, columns = -(-(height - side - 1) // spacing), width // side
    sums, memory = np.empty(rows * columns, np.int32), np.empty((2, width + 2), np.int32)
    _call('djet_block_curvatures', _ptr(image, np.uint8),
          *map(c_int, (width, rows, spacing, side, columns)), _ptr(memory, np.int32),
          _ptr(sums, np.int32))
    return sums


def nearest(points: Array, queries: Array) -> NDArray[np.int64]:
    """Return indices (M,) of the nearest of points (N, 2), N > 0, to each of queries (M, 2)."""
    indices = np.empty(len(queries), np.int64)
    memory = np.empty(4 * len(points) + 2, np.int32)
    _call('djet_nearest', c_int(len(points)), _ptr(points), c_int(len(queries)), _ptr(queries),
          _ptr(memory, np.int32), _ptr(indices, np.int64))
    return indices


def describe(image: NDArray[np.uint8], pixels: NDArray[np.int64], tests: NDArray[np.int64]
             ) -> NDArray[np.uint8]:
    """
    Return descriptors (N, 32) at pixels (N, 2) of an image: `core.hamming.dense_descriptors`.

    tests: (256, 4); all test points lie in the image (H, W).
    """
    descriptors = np.empty((len(pixels), len(tests) // 8), np.uint8)
    _call('djet_describe', _ptr(image, np.uint8), c_int(image.shape[1]), c_int(len(pixels)),
          _ptr(pixels, np.int64), _ptr(tests, np.int64), _ptr(descriptors, np.uint8))
    return descriptors


def match_distances(previous: NDArray[np.uint8], x: Array, current: NDArray[np.uint8], y: Array,
                    tests: NDArray[np.int64], reach: int) -> Array:
    """
    Return Hamming distances (N,) between two images of one size: `core.hamming.match_distances`.

    x, y: (N, 2); tests: (256, 4), which reach at most `reach` pixels.
    """
    n = len(x)
    distances = np.empty(n)
    _call('djet_match_distances', _ptr(previous, np.uint8), _ptr(current, np.uint8),
          *map(c_int, previous.shape), c_int(n), _ptr(x), _ptr(y), _ptr(tests, np.int64),
          c_int(reach), _ptr(distances))
    return distances


def most_similar(strips: NDArray[np.int64], previous: tuple[NDArray[np.uint8], Array],
                 current: tuple[NDArray[np.uint8], Array]
                 ) -> tuple[NDArray[np.int64], Gray, Gray]:
    """
    Find the most similar features in strips of two images: `core.features.most_similar`.

    strips: (S, 4); previous, current: descriptors (N, 32) and positions (N, 2) of each.
    """
    strips, (n, m) = strips.reshape(-1, 4), (len(previous[0]), len(current[0]))
    nearest, best_previous = np.empty(n, np.int64), np.empty(n, np.float32)
    best_current = np.empty(m, np.float32)
    _call('djet_most_similar', c_int(len(strips)), _ptr(strips, np.int64), c_int(n), c_int(m),
          _ptr(previous[0], np.uint8), _ptr(previous[1], np.float32), _ptr(current[0], np.uint8),
          _ptr(current[1], np.float32), _ptr(nearest, np.int64), _ptr(best_previous, np.float32),
          _ptr(best_current, np.float32))
    return nearest, best_previous, best_current


def minimise(matches: tuple[Array, Array, Array, Array], loss: tuple[int, float], steps: int,
             damping: float, limits: Array, R: Array, t: Array
             ) -> tuple[Array, Array, tuple[Array, Array, Array, Array]]:
    """
    Minimise the summed loss from an initial pose: `core.jet.minimise`.

    matches: a JetProblem's rays_x, rays_y, spread (3, N) and blur (N,); loss: index among none,
    huber, cauchy, geman_mcclure, and scale; damping: initial; limits: (4,) least step, least
    relative gain, largest damping, and least curvature. Returns R, t, and the fields of Residuals.
    """
    n = len(matches[3])
    R, t = np.array(R, float, order='C'), np.array(t, float)
    left = np.empty(n), np.empty(n), np.empty((5, n)), np.empty((2, 3))
    _call('djet_minimise', c_int(n), *map(_ptr, matches), c_int(loss[0]), c_double(loss[1]),
          c_int(steps), c_double(damping), *map(_ptr, (limits, R, t, *left, _memory(n))))
    return R, t, (*left[:3], left[3].T)


def refine_all(matches: tuple[Array, Array, Array, Array], loss: tuple[int, float], steps: int,
               damping: float, R: Array, t: Array) -> tuple[Array, Array, Array, Array, Array]:
    """
    Refine each of S poses R (S, 3, 3), t (S, 3) by some steps: `core.sketch.refine_all`.

    As `minimise`. Returns the fields of a Sketch.
    """
    n, starts = len(matches[3]), len(R)
    R, t = np.array(R, float, order='C'), np.array(t, float, order='C')
    costs, r, sign = np.empty(starts), np.empty((starts, n)), np.empty((starts, n))
    _call('djet_refine_all', c_int(n), *map(_ptr, matches), c_int(loss[0]), c_double(loss[1]),
          c_int(steps), c_double(damping), c_int(starts),
          *map(_ptr, (R, t, costs, r, sign, _memory(n))))
    return R, t, costs, r, sign


def losses_in_front(matches: tuple[Array, Array, Array, Array], loss: tuple[int, float],
                    poses: tuple[Array, Array], residuals: tuple[Array, Array],
                    signs: Sequence[float]) -> Array:
    """
    Return losses (S, N) with points in front of both cameras: `core.sketch.losses_in_front`.

    matches, loss: as in `minimise`; poses: R (S, 3, 3), t (S, 3); residuals: (S, N), and their
    signs of curvature; signs: of t to try.
    """
    n, starts = len(matches[3]), len(poses[0])
    losses = np.empty((starts, n))
    _call('djet_losses_in_front', c_int(n), *map(_ptr, matches), c_int(loss[0]),
          c_double(loss[1]), c_int(starts), *map(_ptr, poses), *map(_ptr, residuals),
          c_int(len(signs)), _ptr(np.array(signs, float)), _ptr(losses),
          _ptr(np.empty((3, n))))
    return losses


def fit_rotation(rays_x: Array, rays_y: Array, rounds: int) -> Array:
    """Fit the rotation (3, 3) from rays (N, 3) to others: `core.geometry.fit_rotation`."""
    R, memory = np.empty((3, 3)), np.empty((9, len(rays_x)))
    _call('djet_fit_rotation', c_int(len(rays_x)), _ptr(rays_x), _ptr(rays_y), c_int(rounds),
          _ptr(R), _ptr(memory))
    return R


def planes(u: Array, v: Array, r: Array, trusted: Array, rounds: int, prior_slope: float
           ) -> tuple[Array, Array, Array]:
    """
    Fit planes to values r (N,) at points u, v >= 0 (N,): `core.slants.planes_at`.

    trusted: (N,) inverse variances of r; prior_slope: standard deviation of the slopes, relative
    to the mean value. Returns planes (N, 4), squared residuals (N,), and numbers of inliers (N,).
    """
    n, columns, rows = len(u), int(u.max()) + 3, int(v.max()) + 3
    squared, fitted, counts = np.empty(n), np.empty((n, 4)), np.empty(n)
    _call('djet_planes', c_int(n), *map(_ptr, (u, v, r, trusted)), c_int(columns), c_int(rows),
          c_int(rounds), c_double(prior_slope), _ptr(np.empty((_PLANE_ROWS, rows * columns))),
          *map(_ptr, (squared, fitted, counts)))
    return fitted, squared, counts


def sums_of_cells(J: Array, weights: Array, r: Array, order: NDArray[np.int64],
                  codes: NDArray[np.uint64], sides: int, small: int
                  ) -> tuple[Array, NDArray[np.int64], Array, Array]:
    """
    Sum the terms of N matches over nested cells: `core.covariance.sums_of_cells`.

    J: (5, N); weights, r: (N,); order, codes: (N,) from `core.covariance._morton_order`; sides:
    number of cell sizes; small: index of the size whose sums are returned. Returns the sums (27,
    C) of these cells and the index (C,) of their first match in order; and for each size pulls (S,
    5, 5) and products (S, 2).
    """
    n = len(r)
    sums, first = np.empty((n, _TERMS)), np.empty(n, np.int64)
    pulls, products = np.empty((sides, 5, 5)), np.empty((sides, 2))
    count = _call('djet_sums_of_cells', c_int(n), *map(_ptr, (J, weights, r)),
                  _ptr(order, np.int64), _ptr(codes, np.uint64), c_int(sides), c_int(small),
                  _ptr(sums), _ptr(first, np.int64), _ptr(pulls), _ptr(products))
    return sums[:count].T, first[:count], pulls, products


def leave_one_out(H: Array, sums: Array) -> tuple[Array, Array]:
    """
    Leave out each of C cells in turn: `core.covariance.leave_one_out`.

    H: (5, 5) of all matches; sums: (27, C). Returns the shifts (5, C) of the pose, and the sum
    (5, 5) of inverse Hessians.
    """
    shifts, inverses = np.empty((sums.shape[1], 5)), np.empty((5, 5))
    _call('djet_leave_one_out', c_int(len(shifts)), *map(_ptr, (H, sums.T, shifts, inverses)))
    return shifts.T, inverses


def observe(observations: tuple[NDArray[np.int64], NDArray[np.int64]], anchors: NDArray[np.int64],
            between: tuple[Array, Array], landmarks: tuple[Array, ...], K: tuple[Array, Array],
            limits: Sequence[float]) -> tuple[NDArray[np.int64], tuple[Array, ...]]:
    """
    Return residuals of M observations of N landmarks by F frames: `core.bundle.observe`.

    observations: landmark and frame of each (M,); anchors: (N,); between: R (F, F, 3, 3) and t (F,
    F, 3); landmarks: points (N, 2), rho (N,), minima (N, F, 2), roots (N, F, 2, 2), anchor_roots
    (N, 2, 2) and anchor_pixels (N, 2); K: (3, 3) and its inverse; limits: least depth, and bound
    of pixels. Returns anchors (M,), and an Observed's residuals, anchor_residuals, normalised, R,
    t, ray, rho, place and root.
    """
    m, n, frames = len(observations[0]), len(anchors), len(between[0])
    anchor = np.empty(m, np.int64)
    results = tuple(np.empty(shape) for shape in (
        (m, 2), (n, 2), (n, 2), (m, 3, 3), (m, 3), (m, 3), m, (m, 3), (m, 2, 2)))
    _call('djet_observe', c_int(m), c_int(n), c_int(frames),
          *(_ptr(one, np.int64) for one in (*observations, anchors)), *map(_ptr, between),
          *map(_ptr, landmarks), *map(_ptr, K), _ptr(np.array(limits, float)),
          _ptr(anchor, np.int64), *map(_ptr, results))
    return anchor, results


def eliminate(indices: tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]],
              observed: tuple[Array, ...], points: tuple[Array, Array, Array, float],
              K: tuple[Array, Array], limits: Sequence[float], depth_information: float,
              frames: int) -> tuple[Array, Array, Array, Array, Array]:
    """
    Sum the normal equations of M observations, and eliminate N landmarks: `core.bundle.eliminate`.

    indices: landmark, frame and anchor of each (M,), sorted by landmark; observed: residuals (M,
    2), R (M, 3, 3), t, ray (M, 3), rho (M,), place (M, 3), root (M, 2, 2) and weights (M,);
    points: normalised (N, 2), anchor_roots (N, 2, 2), anchor_residuals (N, 2) and their weight;
    K, limits: as in `observe`; depth_information: added to a landmark; frames: F. Returns the
    arrays of a Reduced.
    """
    *of_points, weight = points
    n, size = len(of_points[0]), _OF_CAMERA + 6 * frames
    H, g = np.zeros((size, size)), np.zeros(size)
    coupling, variances = np.zeros((n, 3, size)), np.empty((n, 3, 3))
    slopes, gain = np.zeros((n, 3)), np.empty((3, size))
    _call('djet_eliminate', c_int(len(indices[0])), c_int(n), c_int(frames),
          *(_ptr(one, np.int64) for one in indices), *map(_ptr, observed),
          *map(_ptr, of_points), c_double(weight), *map(_ptr, K),
          _ptr(np.array(limits, float)), c_double(depth_information),
          *map(_ptr, (H, g, coupling, variances, slopes, gain)))
    return H, g, coupling, variances, slopes


def _ptr(array: NDArray[Any], dtype: Any = _FLOAT64) -> Any:
    """Return a pointer to an array in C order and of a dtype, which keeps it alive."""
    ordered = np.ascontiguousarray(array, dtype)
    try:
        # Four times as fast as `ctypes`; there are hundreds of calls per frame.
        # NumPy's types say that arrays are buffers for Python 3.12 and newer only.
        return _NO_BYTES.from_buffer(ordered)  # type: ignore[arg-type]
    except TypeError:  # read-only arrays
        return ordered.ctypes


def _images(images: Images, dtype: Any) -> tuple[Any, ...]:
    """Return the number of images, their pointers, points in each, and size (H, W)."""
    kept = [np.ascontiguousarray(image, dtype) for image, _ in images]
    places = (c_void_p * len(kept))(*(image.ctypes.data for image in kept))
    # The pointers keep the images alive.
    places.kept = kept  # type: ignore[attr-defined]
    counts = np.array([count for _, count in images], np.int64)
    return c_int(len(kept)), places, _ptr(counts, np.int64), *map(c_int, kept[0].shape)


def _memory(n: int) -> Array:
    return np.empty((_ROWS, n + _PADDING))


def _call(name: str, *arguments: Any) -> int:
    return int(getattr(library, name)(*arguments))
