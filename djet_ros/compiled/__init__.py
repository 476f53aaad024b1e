"""
Inner loops of the core in C, where the package was built with a C compiler.

The core does without: each has its like there in NumPy, which says what it does, and a test holds
both together. They are the same to rounding. What goes in is of the shapes that are told, of any
layout; what comes out is contiguous. `library` is None where there is none, and where the
environment says ``DJET_COMPILED=0``.
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

# Images (H, W) of one size, each with how many of the points are in it.
Images = Sequence[tuple[NDArray[Any], int]]

# That of what is built, see interface.c: sources in place may be newer than it.
_INTERFACE = 9

_NOTHING = c_char * 0

# Rows of memory that the optimiser asks for, and by how much these may be longer than others.
_ROWS, _FILLED_UP = 28, 3

# Rows of sums that slopes of corners ask for, and planes in squares.
_SUMS, _OF_SQUARES = 12, 14

# What is summed up of the matches of a cell.
_TERMS = 27


def _loaded() -> ctypes.CDLL | None:
    found = find_spec('djet_ros.compiled._loops')
    if found is None or found.origin is None or os.environ.get('DJET_COMPILED') == '0':
        return None
    try:
        # It has no Python in it, and so lets others run meanwhile.
        built = ctypes.CDLL(found.origin)
    except OSError as error:  # built for another machine, or damaged
        warn(f'{error}, and left out; install djet_ros anew', stacklevel=2)
        return None
    if not hasattr(built, 'djet_interface') or built.djet_interface() != _INTERFACE:
        warn(f'{found.origin} is of other sources, and left out; install djet_ros anew',
             stacklevel=2)
        return None
    return built


library = _loaded()


def in_use() -> str:
    """Say for people which inner loops run: 'compiled' ones, or those in 'NumPy'."""
    return 'NumPy' if library is None else 'compiled'


def place(there: Images, here: NDArray[np.uint8], points: Gray, inverse: Gray, began: Array,
          inside: NDArray[np.bool_], tuning: Array) -> tuple[Array, Array, Array]:
    """
    Find N patches of some gray images in another one (H, W): `core.patches.Expected.stepped`.

    points: (N, 2) in `there`, one image after the other; inverse: (N, 2, 2) of their warps;
    began: (N, 2) in `here`, with room for the patches and all steps; inside: (N,) those that may
    move; tuning: (4,) least slope, least noise, steps and the farthest. Gives places (N, 2),
    variances (N,) of a pixel, and inverses (N, 2, 2).
    """
    n = len(points)
    places, variances, inverses = np.empty((n, 2)), np.empty(n), np.empty((n, 2, 2))
    _call('djet_place', *_images(there, np.uint8), _given(here, np.uint8), c_int(here.shape[1]),
          _given(points, np.float32), _given(inverse, np.float32), _given(began),
          _given(inside, np.bool_), _given(tuning), _given(places), _given(variances),
          _given(inverses))
    return places, variances, inverses


def grades_through(images: Images, looks: tuple[Gray, Gray], points: Gray, contrast: Gray,
                   ends: tuple[Gray, NDArray[np.int64]], reach: int, most_nearer: float
                   ) -> NDArray[np.int16]:
    """
    Grades (T, N) of tests on patches seen through warps: `core.graded.grades_through`.

    looks: (N, 2, 2) inverse warps, and (N, 2) by which share depths grow a pixel; points: (N, 2)
    in the images, one after the other; contrast: (N,); ends: (2, E) places at which tests look,
    and (2, T) which a test has; reach: the largest grade; most_nearer: by which factor depths grow
    at most.
    """
    n, tests = len(points), ends[1].shape[1]
    grades = np.empty((tests, n), np.int16)
    _call('djet_grades_through', *_images(images, np.int16), c_int(n),
          _given(looks[0], np.float32), _given(looks[1], np.float32), c_float(most_nearer),
          _given(points, np.float32), _given(contrast, np.float32), c_int(ends[0].shape[1]),
          _given(ends[0].T, np.float32), c_int(tests), _given(ends[1], np.int64), c_int(reach),
          _given(grades, np.int16))
    return grades


def graded_surfaces(reference: NDArray[np.int16], image: NDArray[np.int16],
                    centres: NDArray[np.int64], radius: int, tests: NDArray[np.int64],
                    far: int, reach: int) -> Gray:
    """
    Distances (P, P, N) of graded tests, P = 2 radius + 1: `core.graded.graded_surfaces`.

    reference: (T, N); centres: (N, 2) pixels of the image (H, W), with room for windows and tests
    (T, 4), which look at most `far` pixels away; reach: the largest grade.
    """
    n, side = len(centres), 2 * radius + 1
    distances = np.empty((side, side, n), np.float32)
    _call('djet_graded_surfaces', _given(reference, np.int16), _given(image, np.int16),
          c_int(image.shape[1]), c_int(n), _given(centres, np.int64), c_int(radius),
          c_int(len(tests)), _given(tests, np.int64), c_int(far), c_int(reach),
          _given(distances, np.float32))
    return distances


def corner_slopes(image: NDArray[np.uint8], least_ratio: float, unit: float) -> Gray:
    """
    Mean square slopes (H / 2, W / 2) of blocks: `core.corners.corner_slopes`.

    image: (H, W), both even and at least 4; least_ratio: of the weakest to the strongest
    direction; unit: that slopes are told in.
    """
    height, width = image.shape
    slopes = np.empty((height // 2, width // 2), np.float32)
    _call('djet_corner_slopes', _given(image, np.uint8), c_int(height), c_int(width),
          c_float(least_ratio), c_float(unit),
          _given(np.empty((_SUMS, width // 2 + 1), np.int32), np.int32),
          _given(np.empty((4, width + 2), np.int16), np.int16), _given(slopes, np.float32))
    return slopes


def peaks(slopes: Gray, least: float, margin: int, after: tuple[int, int]
          ) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """
    Find the strongest of all slopes (H, W) that are so near: `core.corners._peaks`.

    least: that they are above; margin: where the first of them may be, along both axes; after:
    column and row after the last. Gives places (M,) in the flat array, and (M,) whether they are
    the strongest of their wider surroundings.
    """
    places, around = np.empty(slopes.size, np.int64), np.empty(slopes.size, np.bool_)
    count = _call('djet_peaks', _given(slopes, np.float32), c_int(slopes.shape[1]),
                  c_float(least), c_int(margin), *map(c_int, after),
                  _given(np.empty(slopes.shape[1], np.uint8), np.uint8),
                  _given(places, np.int64), _given(around, np.bool_))
    return places[:count], around[:count]


def exact_peaks(slopes: Gray, places: NDArray[np.int64]) -> Array:
    """
    Pixels (N, 2) at which slopes (H, W) are highest: `core.corners._exact_peaks`.

    places: (N,) of peaks in the flat array.
    """
    points = np.empty((len(places), 2))
    _call('djet_exact_peaks', _given(slopes, np.float32), c_int(slopes.shape[1]),
          c_int(len(places)), _given(places, np.int64), _given(points))
    return points


def spread_out(points: NDArray[np.int64], by_strength: NDArray[np.int64],
               first: NDArray[np.bool_], side: int, most: int) -> NDArray[np.int64]:
    """
    Choose, in order, at most so many of points (N, 2), at least one: `core.corners.spread_out`.

    by_strength: (N,) their order; first: (N,); side: of a cell in pixels.
    """
    n, (columns, rows) = len(points), (points.max(0) // side + 1).tolist()
    chosen, memory = np.empty(n, np.int64), np.empty(2 * columns * rows + 3 * n, np.int32)
    count = _call('djet_spread_out', c_int(n), _given(points, np.int64),
                  _given(by_strength, np.int64), _given(first, np.bool_), c_int(side),
                  c_int(columns), c_int(columns * rows), c_int(most), _given(memory, np.int32),
                  _given(chosen, np.int64))
    return chosen[:count]


def curved_blocks(image: NDArray[np.uint8], side: int, apart: int) -> NDArray[np.int32]:
    """
    Sum up curvatures in blocks (B,) of an image (H, W): `core.corners._curved_blocks`.

    side: of blocks in pixels, for one of which there is room; apart: from one row of them to the
    next.
    """
    height, width = image.shape
    rows, across = -(-(height - side - 1) // apart), width // side
    sums, memory = np.empty(rows * across, np.int32), np.empty((2, width + 2), np.int32)
    _call('djet_curved_blocks', _given(image, np.uint8), c_int(width), c_int(rows), c_int(apart),
          c_int(side), c_int(across), _given(memory, np.int32), _given(sums, np.int32))
    return sums


def nearest(points: Array, others: Array) -> NDArray[np.int64]:
    """Tell which of points (N, 2), one at least, is next to others (M, 2), (M,)."""
    indices = np.empty(len(others), np.int64)
    memory = np.empty(4 * len(points) + 2, np.int32)
    _call('djet_nearest', c_int(len(points)), _given(points), c_int(len(others)), _given(others),
          _given(memory, np.int32), _given(indices, np.int64))
    return indices


def describe(image: NDArray[np.uint8], pixels: NDArray[np.int64], tests: NDArray[np.int64]
             ) -> NDArray[np.uint8]:
    """
    Descriptors (N, 32) at pixels (N, 2) of an image (H, W): `core.hamming.dense_descriptors`.

    tests: (256, 4); all that they see lies in the image.
    """
    descriptors = np.empty((len(pixels), len(tests) // 8), np.uint8)
    _call('djet_describe', _given(image, np.uint8), c_int(image.shape[1]), c_int(len(pixels)),
          _given(pixels, np.int64), _given(tests, np.int64), _given(descriptors, np.uint8))
    return descriptors


def match_distances(there: NDArray[np.uint8], x: Array, here: NDArray[np.uint8], y: Array,
                    tests: NDArray[np.int64], reach: int) -> Array:
    """
    Distances (N,) of descriptors in two images of one size: `core.hamming.match_distances`.

    x, y: (N, 2); tests: (256, 4), which look at most `reach` pixels away.
    """
    n = len(x)
    distances = np.empty(n)
    _call('djet_match_distances', _given(there, np.uint8), _given(here, np.uint8),
          *map(c_int, there.shape), c_int(n), _given(x), _given(y), _given(tests, np.int64),
          c_int(reach), _given(distances))
    return distances


def most_similar(strips: NDArray[np.int64], there: tuple[NDArray[np.uint8], Array],
                 here: tuple[NDArray[np.uint8], Array]
                 ) -> tuple[NDArray[np.int64], Gray, Gray]:
    """
    Find the most similar features in strips of two images: `core.features.most_similar`.

    strips: (S, 4); there, here: descriptors (N, 32) and places (N, 2) of each.
    """
    strips, (n, m) = strips.reshape(-1, 4), (len(there[0]), len(here[0]))
    nearest, best_there, best_here = np.empty(n, np.int64), np.empty(n, np.float32), np.empty(
        m, np.float32)
    _call('djet_most_similar', c_int(len(strips)), _given(strips, np.int64), c_int(n), c_int(m),
          _given(there[0], np.uint8), _given(there[1], np.float32), _given(here[0], np.uint8),
          _given(here[1], np.float32), _given(nearest, np.int64), _given(best_there, np.float32),
          _given(best_here, np.float32))
    return nearest, best_there, best_here


def minimise(matches: tuple[Array, Array, Array, Array], loss: tuple[int, float], steps: int,
             damping: float, limits: Array, R: Array, t: Array
             ) -> tuple[Array, Array, tuple[Array, Array, Array, Array]]:
    """
    Minimise the summed loss from a pose: `core.jet.minimise`.

    matches: a JetProblem's rays_x, rays_y, spread (3, N) and blur (N,); loss: which of none,
    huber, cauchy, geman_mcclure, and where it bends; damping: that of the first step; limits: (4,)
    of steps, of gains, of the damping, and the least share of curvature. Gives R, t, and the
    residuals' fields.
    """
    n = len(matches[3])
    R, t = np.array(R, float, order='C'), np.array(t, float)
    left = np.empty(n), np.empty(n), np.empty((5, n)), np.empty((2, 3))
    _call('djet_minimise', c_int(n), *map(_given, matches), c_int(loss[0]), c_double(loss[1]),
          c_int(steps), c_double(damping), *map(_given, (limits, R, t, *left, _memory(n))))
    return R, t, (*left[:3], left[3].T)


def refine_all(matches: tuple[Array, Array, Array, Array], loss: tuple[int, float], steps: int,
               damping: float, R: Array, t: Array) -> tuple[Array, Array, Array, Array, Array]:
    """
    Make some steps from each of S poses R (S, 3, 3), t (S, 3): `core.sketch.refine_all`.

    As in `minimise`. Gives a Sketch's fields.
    """
    n, starts = len(matches[3]), len(R)
    R, t = np.array(R, float, order='C'), np.array(t, float, order='C')
    costs, r, sign = np.empty(starts), np.empty((starts, n)), np.empty((starts, n))
    _call('djet_refine_all', c_int(n), *map(_given, matches), c_int(loss[0]), c_double(loss[1]),
          c_int(steps), c_double(damping), c_int(starts),
          *map(_given, (R, t, costs, r, sign, _memory(n))))
    return R, t, costs, r, sign


def losses_in_front(matches: tuple[Array, Array, Array, Array], loss: tuple[int, float],
                    poses: tuple[Array, Array], residuals: tuple[Array, Array],
                    signs: Sequence[float]) -> Array:
    """
    Losses (S, N) of points in front of both cameras: `core.sketch.losses_in_front`.

    matches, loss: as in `minimise`; poses: R (S, 3, 3), t (S, 3); residuals: (S, N), and their
    signs of curvature; signs: of t that are tried.
    """
    n, starts = len(matches[3]), len(poses[0])
    losses = np.empty((starts, n))
    _call('djet_losses_in_front', c_int(n), *map(_given, matches), c_int(loss[0]),
          c_double(loss[1]), c_int(starts), *map(_given, poses), *map(_given, residuals),
          c_int(len(signs)), _given(np.array(signs, float)), _given(losses),
          _given(np.empty((3, n))))
    return losses


def fit_rotation(rays_x: Array, rays_y: Array, rounds: int) -> Array:
    """Find the rotation (3, 3) from rays (N, 3) to others: `core.geometry.fit_rotation`."""
    R, memory = np.empty((3, 3)), np.empty((9, len(rays_x)))
    _call('djet_fit_rotation', c_int(len(rays_x)), _given(rays_x), _given(rays_y), c_int(rounds),
          _given(R), _given(memory))
    return R


def planes(u: Array, v: Array, r: Array, trusted: Array, rounds: int, usual: float
           ) -> tuple[Array, Array, Array]:
    """
    Fit planes to values r (N,) around points at u, v >= 0 (N,): `core.slants.planes_at`.

    trusted: (N,) over their variances; usual: slopes that are nothing out of the ordinary, as
    shares of the level. Gives planes (N, 4), squares (N,), and how many points fit (N,).
    """
    n, columns, rows = len(u), int(u.max()) + 3, int(v.max()) + 3
    off, found, fitting = np.empty(n), np.empty((n, 4)), np.empty(n)
    _call('djet_planes', c_int(n), *map(_given, (u, v, r, trusted)), c_int(columns), c_int(rows),
          c_int(rounds), c_double(usual), _given(np.empty((_OF_SQUARES, rows * columns))),
          *map(_given, (off, found, fitting)))
    return found, off, fitting


def sums_of_cells(J: Array, weights: Array, r: Array, order: NDArray[np.int64],
                  codes: NDArray[np.uint64], sides: int, small: int
                  ) -> tuple[Array, NDArray[np.int64], Array, Array]:
    """
    Sum up what N matches tell by cells in cells: `core.covariance.sums_of_cells`.

    J: (5, N); weights, r: (N,); order, codes: (N,) from `core.covariance._along_curve`; sides: so
    many, the number of the small ones among them. Gives of small cells their sums (27, C) and the
    first (C,) of their matches in order; and of cells of each side pulls (S, 5, 5) and products
    (S, 2).
    """
    n = len(r)
    sums, first = np.empty((n, _TERMS)), np.empty(n, np.int64)
    pulls, products = np.empty((sides, 5, 5)), np.empty((sides, 2))
    count = _call('djet_sums_of_cells', c_int(n), *map(_given, (J, weights, r)),
                  _given(order, np.int64), _given(codes, np.uint64), c_int(sides), c_int(small),
                  _given(sums), _given(first, np.int64), _given(pulls), _given(products))
    return sums[:count].T, first[:count], pulls, products


def without_each(whole: Array, sums: Array) -> tuple[Array, Array]:
    """
    Tell how a pose would move without each of C cells: `core.covariance.without_each`.

    whole: (5, 5); sums: (27, C). Gives moves (5, C), and the sum (5, 5) of inverses.
    """
    moves, inverses = np.empty((sums.shape[1], 5)), np.empty((5, 5))
    _call('djet_without_each', c_int(len(moves)), *map(_given, (whole, sums.T, moves, inverses)))
    return moves.T, inverses


def observe(seen: tuple[NDArray[np.int64], NDArray[np.int64]], anchors: NDArray[np.int64],
            between: tuple[Array, Array], landmarks: tuple[Array, ...], K: tuple[Array, Array],
            tuning: Sequence[float]) -> tuple[NDArray[np.int64], tuple[Array, ...]]:
    """
    Residuals of M observations of N landmarks by F frames: `core.bundle.observe`.

    seen: landmark and frame of each (M,); anchors: (N,); between: R (F, F, 3, 3) and t (F, F, 3);
    landmarks: points (N, 2), rho (N,), minima (N, F, 2), roots (N, F, 2, 2), held (N, 2, 2) and
    found (N, 2); K: (3, 3) and its inverse; tuning: k1, the nearest place, by how much k1 moves
    points at most, and pixels beyond which nothing is told apart. Gives anchors (M,), and an
    Observed's residuals, off, straight, R, t, ray, rho, place and root.
    """
    m, n, frames = len(seen[0]), len(anchors), len(between[0])
    anchor = np.empty(m, np.int64)
    told = tuple(np.empty(shape) for shape in (
        (m, 2), (n, 2), (n, 2), (m, 3, 3), (m, 3), (m, 3), m, (m, 3), (m, 2, 2)))
    _call('djet_observe', c_int(m), c_int(n), c_int(frames),
          *(_given(one, np.int64) for one in (*seen, anchors)), *map(_given, between),
          *map(_given, landmarks), *map(_given, K), _given(np.array(tuning, float)),
          _given(anchor, np.int64), *map(_given, told))
    return anchor, told


def eliminate(which: tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]],
              observed: tuple[Array, ...], points: tuple[Array, Array, Array, float],
              with_k1: bool, K: tuple[Array, Array], tuning: Sequence[float], trace: float,
              frames: int) -> tuple[Array, Array, Array, Array, Array]:
    """
    Sum up M observations of N landmarks by F frames, and eliminate these: `core.bundle.eliminate`.

    which: landmark, frame and anchor of each (M,), sorted by landmark; observed: residuals (M, 2),
    R (M, 3, 3), t, ray (M, 3), rho (M,), place (M, 3), root (M, 2, 2) and weights (M,); points:
    straight (N, 2), held (N, 2, 2), off (N, 2) and their weight; with_k1: whether that is among
    the equations; K, tuning: as in `observe`; trace: information about a landmark. Gives a
    Reduced's arrays.
    """
    *of_points, weight = points
    n, size = len(of_points[0]), with_k1 + 6 * frames
    H, g = np.zeros((size, size)), np.zeros(size)
    coupling, variances = np.zeros((n, 3, size)), np.empty((n, 3, 3))
    slopes, gain = np.zeros((n, 3)), np.empty((3, size))
    _call('djet_eliminate', c_int(len(which[0])), c_int(n), c_int(frames), c_int(with_k1),
          *(_given(one, np.int64) for one in which), *map(_given, observed),
          *map(_given, of_points), c_double(weight), *map(_given, K),
          _given(np.array(tuning, float)), c_double(trace),
          *map(_given, (H, g, coupling, variances, slopes, gain)))
    return H, g, coupling, variances, slopes


def _given(array: NDArray[Any], dtype: Any = np.float64) -> Any:
    """Give where an array lies, in C's order and of a type; what is given keeps it there."""
    ordered = np.ascontiguousarray(array, dtype)
    try:
        # In a third of the time: hundreds are given a frame.
        return _NOTHING.from_buffer(ordered.data)
    except TypeError:  # what may only be read
        return ordered.ctypes


def _images(images: Images, dtype: Any) -> tuple[Any, ...]:
    """Give how many images there are, where they lie, how many points each has, and their size."""
    kept = [np.ascontiguousarray(image, dtype) for image, _ in images]
    places = (c_void_p * len(kept))(*(image.ctypes.data for image in kept))
    # As long as these are given, so are the images.
    places.kept = kept  # type: ignore[attr-defined]
    counts = np.array([count for _, count in images], np.int64)
    return c_int(len(kept)), places, _given(counts, np.int64), *map(c_int, kept[0].shape)


def _memory(n: int) -> Array:
    return np.empty((_ROWS, n + _FILLED_UP))


def _call(name: str, *arguments: Any) -> int:
    return int(getattr(library, name)(*arguments))
