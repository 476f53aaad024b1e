"""
Observation of landmarks in a new frame, by their descriptor surfaces and by patch alignment.

The surface of a landmark is sampled where pose and depth predict it, through the warp from its
anchor (the keyframe that created it). The warp includes the slant of the surface, from depths
around the landmark (`core.slants`): with fronto-parallel patches, landmarks on a road would be
biased by up to half a pixel, all in the same direction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from djet_ros.core.bundle import Landmarks, points_in_frame, Poses, projected
from djet_ros.core.geometry import inverses, patch_warp, slant_warp
from djet_ros.core.joining import fuse_positions
from djet_ros.core.masks import masked_at
from djet_ros.core.paraboloid import Paraboloids
from djet_ros.core.patches import align_all, Aligned
from djet_ros.core.surfaces import (
    contrast_ratios,
    DescriptorDistances,
    has_moderate_stretch,
    no_paraboloids,
    resolve_indefinite,
    SMALL_WINDOW,
)
from djet_ros.core.types import Array, View
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class LandmarkObservations:
    """Observed landmarks: indices (M,), pixels (M, 2), and roots (M, 2, 2) of their precision."""

    indices: NDArray[np.int64]
    places: Array
    roots: Array


@dataclass(frozen=True)
class Sighting:
    """
    Search for landmarks in the newest view, by the views that they are anchored in.

    K: (3, 3); views: one for each of the poses.
    """

    distances: DescriptorDistances
    K: Array
    views: Sequence[View]
    poses: Poses
    landmarks: Landmarks

    def observe(self, reach: int) -> LandmarkObservations | None:
        """Observe landmarks within `reach` pixels of their prediction; None if none is found."""
        newest, distances = self.views[-1], self.distances
        indices, expected, warps = self._predict(reach)
        # A wide paraboloid finds the direction to the minimum but overshoots by a quarter, since
        # the correction of pixel locking is made for small windows; landmarks would oscillate
        # about their prediction. A second, small window around the first estimate does not.
        indices, fits = self._around(indices, warps[indices], expected[indices], reach)
        close = fits.minima()
        usable = distances.describable(close, newest.surface_gray.shape, SMALL_WINDOW // 2)
        usable &= ~masked_at(newest.mask, close)
        indices = indices[usable]
        indices, fits = self._around(indices, warps[indices], close[usable], SMALL_WINDOW // 2)
        if not len(indices):
            return None
        minima = fits.minima()
        # The residual of a least-squares fit estimates its noise variance.
        residual = np.maximum(fits.values(minima), 1e-3)
        places, covariances = fuse_positions(minima, fits.inverses * residual[:, None, None],
                                             self._aligned(indices, warps[indices], minima))
        halves = np.asarray(np.linalg.cholesky(inverses(covariances)), float)
        return LandmarkObservations(indices, places, halves.transpose(0, 2, 1))

    def _predict(self, reach: int) -> tuple[NDArray[np.int64], Array, Array]:
        """
        Predict which landmarks (M,) are visible, ordered by their anchors.

        Also returns the predicted pixels (N, 2) and warps (N, 3, 2) of all landmarks.
        """
        landmarks, newest = self.landmarks, len(self.views) - 1
        places = points_in_frame(self.K, self.poses, landmarks, newest)
        expected = projected(self.K, places)
        view = self.views[newest]
        visible = (places[:, 2] > 0) & ~masked_at(view.mask, expected)
        visible &= self.distances.describable(expected, view.surface_gray.shape, reach)
        # A landmark that neither of the last two frames observed is lost.
        visible &= landmarks.observed[:, -3:-1].any(1) | (landmarks.anchors == newest - 1)
        indices = np.argsort(landmarks.anchors, kind='stable')
        indices = indices[visible[indices]]
        anchors = landmarks.anchors[indices]
        R, t = (motions[newest, anchors] for motions in self.poses.relative_motions)
        projection = expected[indices], 1 / places[indices, 2]
        slope = landmarks.rho[indices, None] * landmarks.slopes[indices]
        warps = np.empty((len(landmarks), 3, 2))
        warps[indices] = (patch_warp(self.K, R, *projection)
                          + slant_warp(self.K, t, *projection, slope))
        return indices[has_moderate_stretch(warps[indices])], expected, warps

    def _around(self, indices: NDArray[np.int64], warps: Array, places: Array, radius: int
                ) -> tuple[NDArray[np.int64], Paraboloids]:
        """
        Sample surfaces of landmarks (M,) around places (M, 2) in the newest view.

        Landmarks are ordered by their anchors, since images are sampled one by one. Returns those
        with a minimum within the window, and their paraboloids.
        """
        if not len(indices):
            return indices, no_paraboloids(0)
        newest, (anchors, counts) = self.views[-1].surface_gray, self._anchor_counts(indices)
        # Contrast at the sampled places; that at the prediction would bias the scale.
        strengths = self.distances.strengths(newest, np.rint(places).astype(np.int64))
        contrasts = contrast_ratios(strengths, self.landmarks.strengths[indices], counts)
        references = self.distances.shifted_references(
            [(self.views[anchor].surface_gray, count) for anchor, count in zip(anchors, counts)],
            self.landmarks.anchor_pixels[indices], places, warps, contrasts)
        fits = self.distances.fit_around(references, newest, places, radius)
        fits, _ = resolve_indefinite(fits, 'drop')
        usable = fits.usable & fits.minimum_within(radius)
        return indices[usable], fits.of(usable)

    def _aligned(self, indices: NDArray[np.int64], warps: Array, places: Array) -> Aligned:
        """Align patches of landmarks (M,), ordered by their anchors, from places (M, 2)."""
        images = [(self.views[anchor].gray, count)
                  for anchor, count in zip(*self._anchor_counts(indices))]
        return align_all(images, self.landmarks.anchor_pixels[indices], warps, self.views[-1].gray,
                         places)

    def _anchor_counts(self, indices: NDArray[np.int64]
                       ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the distinct anchors of landmarks (M,), ordered by them, and their counts."""
        counts = np.bincount(self.landmarks.anchors[indices])
        anchors = np.flatnonzero(counts)
        return anchors, counts[anchors]
