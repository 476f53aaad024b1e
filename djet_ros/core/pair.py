"""The input of the estimation of one pair: views, matches and prior knowledge."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

from djet_ros.core.paraboloid import Paraboloids
from djet_ros.core.rivals import PreviousMotion
from djet_ros.core.starts import KnownMotion
from djet_ros.core.types import Array, Pose, View
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Round:
    """
    One round of Algorithm 1 on N matches, as passed to an observer.

    keypoints: (N, 2) pixels around which the surfaces were sampled; fits: the paraboloids there;
    warp: (N, 3, 2) patch warps under which the reference patches were sampled, None if unwarped;
    pose: the pose estimated on them; optimum: (N, 2) the places y + v_opt on its epipolar lines.
    """

    keypoints: Array
    fits: Paraboloids
    warp: Array | None
    pose: Pose
    optimum: Array


Observer = Callable[[Round], None]


@dataclass(frozen=True)
class Pair:
    """
    Two views, their matches, and prior knowledge of their motion.

    x, y: (N, 2) matched pixels of the previous and the current view, the most reliable first;
    prior: the previous motion; known: measurements from other sources than the images; predicted:
    a motion from which the matches were predicted, around which basins are sought in place of
    other starts (t may be zeros); bits: (N,) descriptor distances at x and y, if known already;
    covariances: (N, 2, 2) of y up to a common factor, which weight re-projection errors, all alike
    if None; sought: number of features that were searched, see ``RelativePose``; outliers: number
    of matches removed before as outliers of a starting pose; start: the only one to start from, if
    the basin is known; observe: called with each round of Algorithm 1; timings: receives the
    seconds of each stage.
    """

    previous: View
    current: View
    x: Array
    y: Array
    prior: PreviousMotion | None = None
    known: KnownMotion = field(default_factory=KnownMotion)
    predicted: PreviousMotion | None = None
    bits: Array | None = None
    covariances: Array | None = None
    sought: int = 0
    outliers: int = 0
    start: Pose | None = None
    observe: Observer | None = None
    timings: dict[str, float] = field(default_factory=dict)

    def of(self, chosen: NDArray[np.bool_]) -> Pair:
        """Return the pair with some (N,) of its matches, and the others as outliers."""
        def of_chosen(values: Array | None) -> Array | None:
            return None if values is None else values[chosen]

        return replace(self, x=self.x[chosen], y=self.y[chosen], bits=of_chosen(self.bits),
                       covariances=of_chosen(self.covariances),
                       outliers=self.outliers + int((~chosen).sum()))

    def without(self, removed: NDArray[np.bool_]) -> Pair:
        """Return the pair without some (N,) of its matches, as outliers, and not predicted."""
        return replace(self.of(~removed), predicted=None)
