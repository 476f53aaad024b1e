"""The paper's Figure 1: Hamming distances of a keypoint's descriptor to those around it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.hamming import describable, descriptor_bits, hamming_surfaces, smooth
from djet_ros.core.paraboloid import fit_paraboloids, Paraboloids
from djet_ros.core.types import Array, View
from djet_ros.errors import DjetError
from djet_ros.lab import panels
from djet_ros.lab.style import figure
from djet_ros.recordings.frame_sequence import ImageFiles
import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.int64]
Gray = NDArray[np.uint8]

# Largest distance of a chosen point from the nearest keypoint with a match, in pixels.
_REACH = 20.0


@dataclass(frozen=True)
class Similarity:
    """
    Hamming surfaces of some keypoints, and the paraboloids fitted to their centres.

    x: (N, 2) integer pixels of the keypoints in the first image; y: (N, 2) centres of the surfaces
    in the second image (equal to x for self-similarity); surfaces: (P, P, N) in bits; window:
    side of the fitted window.
    """

    x: Pixels
    y: Pixels
    surfaces: NDArray[np.uint16]
    fits: Paraboloids
    window: int


def read_image(path: Path) -> Gray:
    """Read a PNG or JPEG file as gray image (H, W). Raises DjetError."""
    return ImageFiles([path]).gray(0)


def self_similarity(gray: Gray, points: Array | None, count: int, radius: int,
                    config: EstimatorConfig) -> Similarity:
    """
    Compare the descriptors of points with those around them in the same image (H, W).

    points: (N, 2) pixels, or None for the ``count`` strongest keypoints with a distance of more
    than ``radius``. Raises DjetError if a point is too close to the border, or none is found.
    """
    if points is None:
        features = TwoViewEstimator(config).features(gray)
        strongest = features.points[np.argsort(-features.responses, kind='stable')]
        points = _apart(strongest, strongest, gray, gray, radius, count)
    x = np.rint(points).astype(np.int64)
    _require_room(x, gray, radius)
    return _similarity(gray, gray, x, x, radius, config)


def cross_similarity(gray: Gray, other: Gray, points: Array | None, count: int, radius: int,
                     config: EstimatorConfig) -> Similarity:
    """
    Compare the descriptors of keypoints with those around their matches in another image.

    points: (N, 2) pixels near keypoints, or None for the ``count`` strongest with a distance of
    more than ``radius``. Raises DjetError if no match is near a point, or one is too close to the
    border.
    """
    from_x, to_y = _matches(gray, other, config)
    if points is None:
        points = _apart(from_x, to_y, gray, other, radius, count)
    chosen = [_nearest(from_x, point) for point in points]
    x, y = (np.rint(places[chosen]).astype(np.int64) for places in (from_x, to_y))
    _require_room(x, gray, 0)
    _require_room(y, other, radius)
    return _similarity(gray, other, x, y, radius, config)


def draw_similarity(path: Path, gray: Gray, other: Gray, similarity: Similarity) -> None:
    """Draw patches of the first image, and below them heat maps over the second image."""
    count, radius = len(similarity.x), len(similarity.surfaces) // 2
    with figure(path, 2.1 * count + 1.4, 5.3) as drawing:
        grid = drawing.subplots(2, count, squeeze=False)
        for index in range(count):
            x, y = similarity.x[index], similarity.y[index]
            upper, lower = grid[:, index]
            panels.draw_patch(upper, gray, x, _visible(x, gray, radius))
            panels.limit(upper, x, radius)
            panels.draw_point(upper, x, 'o', '#E69F00', 5)
            upper.set_title(f'x = {x[0]}, {x[1]}')
            panels.draw_patch(lower, other, y, radius)
            panels.draw_heat(lower, similarity.surfaces[:, :, index], y, 0.7)
            panels.draw_paraboloid(lower, similarity.fits, index, similarity.window)
            lower.set_title(f'y = {y[0]}, {y[1]}')
        panels.add_scale(drawing, grid)
        drawing.suptitle(f'Hamming distances within {radius} px\n(contours: paraboloid fitted to '
                         f'{similarity.window}×{similarity.window}, +: its minimum)')


def _similarity(gray: Gray, other: Gray, x: Pixels, y: Pixels, radius: int,
                config: EstimatorConfig) -> Similarity:
    bits = descriptor_bits(smooth(gray), x)
    surfaces = hamming_surfaces(bits, smooth(other), y, radius)
    inner = slice(radius - config.window // 2, radius + config.window // 2 + 1)
    fits = fit_paraboloids(surfaces[inner, inner], y.astype(float), config.window_sigma)
    return Similarity(x, y, surfaces, fits, config.window)


def _matches(gray: Gray, other: Gray, config: EstimatorConfig) -> tuple[Array, Array]:
    """Return matches x, y (N, 2) in pixels of two images, strongest keypoints first."""
    estimator = TwoViewEstimator(config)
    # Matching uses the camera only to predict rotations; any ordinary field of view will do.
    height, width = gray.shape
    K = np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]])
    views: Sequence[View] = [estimator.view(image, K) for image in (gray, other)]
    x, y = estimator.match(views[0], views[1])
    if not len(x):
        raise DjetError('the two images have no matches; choose images of the same scene')
    features = views[0].features.with_additional
    strength = dict(zip(map(tuple, features.points.tolist()), features.responses.tolist()))
    order = np.argsort([-strength[tuple(point)] for point in x.tolist()], kind='stable')
    return x[order], y[order]


def _apart(x: Array, y: Array, gray: Gray, other: Gray, radius: int, count: int) -> Array:
    """Return the first points x that have room around x and y, and are not close to another."""
    room = (describable(np.rint(x).astype(np.int64), gray.shape)
            & describable(np.rint(y).astype(np.int64), other.shape, radius))
    taken: list[Array] = []
    for point in x[room]:
        if all(np.abs(point - other_point).max() > radius for other_point in taken):
            taken.append(point)
        if len(taken) == count:
            break
    if not taken:
        raise DjetError(f'no keypoint has {radius} pixels of image around it; choose a smaller '
                        '--radius, or points with --points')
    return np.array(taken)


def _nearest(x: Array, point: Array) -> int:
    distances = np.linalg.norm(x - point, axis=1)
    nearest = int(distances.argmin())
    if distances[nearest] > _REACH:
        raise DjetError(f'no keypoint with a match is within {_REACH:g} pixels of '
                        f'{point[0]:g},{point[1]:g}; the nearest is at '
                        f'{x[nearest][0]:.0f},{x[nearest][1]:.0f}; choose that one')
    return nearest


def _require_room(points: Pixels, gray: Gray, radius: int) -> None:
    for point in points[~describable(points, gray.shape, radius)]:
        raise DjetError(f'point {point[0]},{point[1]} is too close to the border of an image of '
                        f'{gray.shape[1]}x{gray.shape[0]}, or outside; choose another one, or a '
                        'smaller --radius')


def _visible(point: Pixels, gray: Gray, radius: int) -> int:
    """Return the radius up to which the patch around a point is inside the image."""
    room = [*point.tolist(), gray.shape[1] - 1 - int(point[0]), gray.shape[0] - 1 - int(point[1])]
    return int(min(radius, *room))
