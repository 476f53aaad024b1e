"""All that is given of a pair, before anything is estimated, and who looks on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

from djet_ros.core.paraboloid import Paraboloids
from djet_ros.core.starts import Known
from djet_ros.core.types import Array, Pose, View
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Round:
    """
    One round of Algorithm 1 on N matches, as an observer is shown it.

    keypoints: (N, 2) pixels around which the surfaces were sampled; fits: the paraboloids there;
    warp: (N, 3, 2) through which the reference patches were seen, None where they were not warped;
    pose: the one found on them; optimum: (N, 2) the places y + v_opt on its epipolar lines.
    """

    keypoints: Array
    fits: Paraboloids
    warp: Array | None
    pose: Pose
    optimum: Array


@dataclass(frozen=True)
class Limits:
    """
    What a pair has to keep to that goes on as the one before it did.

    noise: at most so large may the robust standard deviation of its matches from their epipolar
    lines be, in pixels; agreeing: more than this share of its matches have to agree.
    """

    noise: float = np.inf
    agreeing: float = 0.0


Observer = Callable[[Round], None]


@dataclass(frozen=True)
class Pair:
    """
    Two views, matches of them, and what is known of their motion.

    x, y: (N, 2) matched pixels of the previous and the current view, the surest first; before: the
    motion before this one; known: what others than the images tell; ahead: a motion from which the
    matches were followed, so that its basin will do as a start where none other comes near, its t
    may be zeros; limits: beyond these it is given up; bits: (N,) in which descriptors at x and y
    differ, where that is known already; covariances: (N, 2, 2) of y, up to a common factor, which
    re-projection errors count by, all alike where they are not told; sought: of how many features,
    see ``RelativePose``; outliers: how many matches more there were, which do not agree with a
    starting pose; observe: is shown each round of Algorithm 1; timings: gets the seconds of each
    stage.
    """

    previous: View
    current: View
    x: Array
    y: Array
    before: Pose | None = None
    known: Known = field(default_factory=Known)
    ahead: Pose | None = None
    limits: Limits = field(default_factory=Limits)
    bits: Array | None = None
    covariances: Array | None = None
    sought: int = 0
    outliers: int = 0
    observe: Observer | None = None
    timings: dict[str, float] = field(default_factory=dict)

    def without(self, some: NDArray[np.bool_]) -> Pair:
        """Give the pair without some (N,) of its matches, as outliers; its start is open."""
        def left(values: Array | None) -> Array | None:
            return None if values is None else values[~some]

        return replace(self, x=self.x[~some], y=self.y[~some], bits=left(self.bits),
                       covariances=left(self.covariances), ahead=None,
                       outliers=self.outliers + int(some.sum()))
