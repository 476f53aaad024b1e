"""
Landmarks in a new frame: where their surfaces, and gray levels around these, have them.

A landmark's surface is sampled where pose and depth let it be expected, seen through the warp that
they imply from the frame that saw it first, its anchor. The warp is that of a surface that leans
as depths around the landmark say (`core.slants`): were all taken to face the camera, a road's
places would be off by up to half a pixel, alike in all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from djet_ros.core.bundle import in_frame, Landmarks, Poses, projected
from djet_ros.core.geometry import inverses, patch_warp, slant_warp
from djet_ros.core.joining import joined_places
from djet_ros.core.masks import at
from djet_ros.core.paraboloid import Paraboloids
from djet_ros.core.patches import place_all, Placed
from djet_ros.core.surfaces import (
    CLOSE,
    comparable,
    contrasts_of,
    DescriptorDistances,
    no_paraboloids,
    with_minimum,
)
from djet_ros.core.types import Array, View
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Sighted:
    """Which landmarks (M,) are seen, at which pixels (M, 2), and roots (M, 2, 2) of how surely."""

    which: NDArray[np.int64]
    places: Array
    roots: Array


@dataclass(frozen=True)
class Sighting:
    """
    Looks for landmarks in the newest of some views, by those that saw them first.

    K: (3, 3); views: one for each of the poses.
    """

    distances: DescriptorDistances
    K: Array
    views: Sequence[View]
    poses: Poses
    landmarks: Landmarks

    def look(self, reach: int) -> Sighted | None:
        """Look within a reach in pixels of where landmarks are expected; None where none is."""
        here, distances = self.views[-1], self.distances
        mine, expected, warps = self._expected(reach)
        # Wide paraboloids say in which direction a minimum lies, but a quarter too far off, as
        # what undoes the locking is made for close ones: all would swing about where they were
        # expected. Close ones around it do not.
        mine, fits = self._around(mine, warps[mine], expected[mine], reach)
        close = fits.minima()
        good = ~at(here.mask, close) & distances.describable(close, here.tested.shape, CLOSE // 2)
        mine = mine[good]
        mine, fits = self._around(mine, warps[mine], close[good], CLOSE // 2)
        if not len(mine):
            return None
        minima = fits.minima()
        # As in any least squares, what the best fit leaves over tells the noise.
        left = np.maximum(fits.values(minima), 1e-3)
        places, spread = joined_places(minima, fits.inverses * left[:, None, None],
                                       self._placed(mine, warps[mine], minima))
        halves = np.asarray(np.linalg.cholesky(inverses(spread)), float)
        return Sighted(mine, places, halves.transpose(0, 2, 1))

    def _expected(self, reach: int) -> tuple[NDArray[np.int64], Array, Array]:
        """
        Tell which landmarks (M,) to look for, ordered by their anchors.

        Gives with them where all are expected, (N, 2), and through which warps (N, 3, 2).
        """
        landmarks, newest = self.landmarks, len(self.views) - 1
        places = in_frame(self.K, self.poses, landmarks, newest)
        expected = projected(self.K, places, self.poses.k1)
        here = self.views[newest]
        wanted = (places[:, 2] > 0) & ~at(here.mask, expected) & self.distances.describable(
            expected, here.tested.shape, reach)
        # One that neither of the last two frames saw is gone.
        wanted &= landmarks.seen[:, -3:-1].any(1) | (landmarks.anchors == newest - 1)
        which = np.argsort(landmarks.anchors, kind='stable')
        which = which[wanted[which]]
        R, t = (motions[newest, landmarks.anchors[which]] for motions in self.poses.between)
        seen = expected[which], 1 / places[which, 2]
        lean = landmarks.rho[which, None] * landmarks.slopes[which]
        warps = np.empty((len(landmarks), 3, 2))
        warps[which] = patch_warp(self.K, R, *seen) + slant_warp(self.K, t, *seen, lean)
        return which[comparable(warps[which])], expected, warps

    def _around(self, mine: NDArray[np.int64], warps: Array, places: Array, radius: int
                ) -> tuple[NDArray[np.int64], Paraboloids]:
        """
        Sample surfaces of landmarks (M,) around places (M, 2) in the newest view.

        They come ordered by their anchors, for images are sampled one by one, surfaces at once.
        Gives those that have a minimum within the window, and their paraboloids.
        """
        if not len(mine):
            return mine, no_paraboloids(0)
        here, (anchors, counts) = self.views[-1].tested, self._anchored(mine)
        # Of where they are sampled: that of where they were expected would bend the scale.
        strengths = self.distances.strengths(here, np.rint(places).astype(np.int64))
        contrasts = contrasts_of(strengths, self.landmarks.strengths[mine], counts)
        references = self.distances.shifted(
            [(self.views[anchor].tested, count) for anchor, count in zip(anchors, counts)],
            self.landmarks.found[mine], places, warps, contrasts)
        fits, _ = with_minimum(self.distances.around(references, here, places, radius), 'drop')
        good = fits.usable & fits.minimum_within(radius)
        return mine[good], fits.of(good)

    def _placed(self, mine: NDArray[np.int64], warps: Array, places: Array) -> Placed:
        """Tell where gray levels have landmarks (M,), ordered by their anchors, next to places."""
        images = [(self.views[anchor].gray, count)
                  for anchor, count in zip(*self._anchored(mine))]
        return place_all(images, self.landmarks.found[mine], warps, self.views[-1].gray, places)

    def _anchored(self, mine: NDArray[np.int64]
                  ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Give the anchors of landmarks (M,), which they are ordered by, and how many each has."""
        counts = np.bincount(self.landmarks.anchors[mine])
        anchors = np.flatnonzero(counts)
        return anchors, counts[anchors]
