"""The values that travel through the core: features, views, poses, and what vouches for them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum, unique
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@unique
class Status(StrEnum):
    """What became of a frame or of a pair of frames."""

    OK = 'OK'
    FIRST_FRAME = 'FIRST_FRAME'
    TOO_FEW_MATCHES = 'TOO_FEW_MATCHES'
    NO_PARALLAX = 'NO_PARALLAX'
    DEGENERATE = 'DEGENERATE'
    TOO_FEW_INLIERS = 'TOO_FEW_INLIERS'
    AMBIGUOUS = 'AMBIGUOUS'
    TWO_MOTIONS = 'TWO_MOTIONS'
    TIME_JUMP = 'TIME_JUMP'
    SIZE_CHANGED = 'SIZE_CHANGED'


# Statuses under which the motion of a pair was estimated.
TRACKED = (Status.OK, Status.NO_PARALLAX)

# Statuses of pairs whose images are good, and tell two motions: from the newest image on it may be
# told again, while over two steps what the bodies have in common is gone.
UNDECIDED = (Status.AMBIGUOUS, Status.TWO_MOTIONS)

# Statuses of a frame at which the odometry started or restarted, without a pair.
STARTED = (Status.FIRST_FRAME, Status.TIME_JUMP, Status.SIZE_CHANGED)


@dataclass(frozen=True)
class Features:
    """
    Features of one image.

    points: (N, 2) pixels on level 0, pixel centres at integers; octaves: (N,) sizes;
    angles: (N,) degrees; responses: (N,); describe: gives the descriptors, which are made when
    they are first asked for, as pairs that go on like the one before do without; others: gives
    more features, in the same way, which only views that are far apart are worth.
    """

    points: Array
    octaves: NDArray[np.int32]
    angles: NDArray[np.float32]
    responses: NDArray[np.float32]
    describe: Callable[[], NDArray[np.uint8]]
    others: Callable[[], Features] | None = None

    @classmethod
    def together(cls, parts: Sequence[Features]) -> Features:
        """Put features of one image together, but for their others."""
        # Not the parts: one that keeps what it is part of would stay in memory.
        describe = [part.describe for part in parts]
        return cls(np.concatenate([part.points for part in parts]),
                   np.concatenate([part.octaves for part in parts]),
                   np.concatenate([part.angles for part in parts]),
                   np.concatenate([part.responses for part in parts]),
                   lambda: np.concatenate([one() for one in describe]))

    @classmethod
    def described(cls, points: Array, octaves: NDArray[np.int32], angles: NDArray[np.float32],
                  responses: NDArray[np.float32], descriptors: NDArray[np.uint8]) -> Features:
        """Give features whose descriptors are known already."""
        return cls(points, octaves, angles, responses, lambda: descriptors)

    def __len__(self) -> int:
        return len(self.points)

    @cached_property
    def descriptors(self) -> NDArray[np.uint8]:
        """Descriptors (N, 32), for matching only."""
        return self.describe()

    @cached_property
    def with_others(self) -> Features:
        """Give these features, and the others if there are any."""
        return self if self.others is None else Features.together([self, self.others()])


class Picture(Protocol):
    """What a camera shows: gray (H, W), and K (3, 3) its camera matrix."""

    @property
    def gray(self) -> NDArray[np.uint8]:
        """Give the gray levels."""

    @property
    def K(self) -> Array:
        """Give the camera matrix."""


def of_one_camera(one: Picture, other: Picture) -> bool:
    """Whether two pictures have one size and one camera matrix, as those of a pair have to."""
    return one.gray.shape == other.gray.shape and np.array_equal(one.K, other.K)


@dataclass(frozen=True)
class View:
    """
    One image as the estimator wants it.

    gray: (H, W) uint8, free of distortion; K: (3, 3) its camera matrix; features: its
    features; smoothed: (H, W) uint8, gray as ORB's binary tests see it; tested: (H, W), as the
    tests of the descriptor surfaces do; mask: (H, W) bool, True where neither a feature nor a
    surface may stand, or None.
    """

    gray: NDArray[np.uint8]
    K: Array
    features: Features
    smoothed: NDArray[np.uint8]
    tested: NDArray[Any]
    mask: NDArray[np.bool_] | None = None


@dataclass(frozen=True)
class Pose:
    """A relative pose: R (3, 3), and t (3,) of unit length."""

    R: Array
    t: Array


@dataclass(frozen=True)
class RelativePose:
    """
    The motion between two frames, ``x_current = R x_previous + t``, and what vouches for it.

    R: (3, 3) rotation; t: (3,) unit direction, or zeros where the translation can't be estimated
    (status NO_PARALLAX and all failures). Three statuses hold a best guess, whose covariance
    spans what else it may be: AMBIGUOUS, where a motion far off explains the matches as well;
    TWO_MOTIONS, where two bodies move and nothing tells which of them is the world; and
    TOO_FEW_INLIERS, where no more matches agree than false ones might. covariance_5: (5, 5) over
    (rotation vector in rad, two coordinates of t in the basis ``sphere_tangents(t)``);
    covariance_6: (6, 6) over (rotation vector, t), of rank 5 because the length of t is fixed.
    Where t is zeros only the rotation's (3, 3) of either tells anything: the rest is of the
    direction that was fitted first, which is not told.

    x, y: (N, 2) matched pixels in the previous and the current image, as used; y_opt: (N, 2)
    the place of y after its final step onto the epipolar line; inliers: (N,) bool; voting: (N,)
    bool, those that took part in the pose, whether they agree with it or not; placed: (N, 2)
    where gray levels have y, seen through the pose and the depths, or y itself;
    placed_covariances: (N, 2, 2) of these in square pixels, up to a common factor (see
    `core.patches`), all alike where gray levels were not asked;
    residuals: (N,) signed distances in pixels of y to its epipolar line, for which the t that was
    fitted first stands in where t is zeros;
    hamming: (N,) descriptor distances at the final place in bits (NaN off the image);
    losses: (N,) each match's loss on its surface, the last known one where it was culled;
    culled: how many matches had no surface in the end; indefinite: how many surfaces had no
    minimum; iterations: rounds of Algorithm 1; timings: stage -> seconds; rivals: other motions
    that were considered, the signs of their t open; sought: how many features of the previous
    image were looked for, 0 where matches were given.
    """

    status: Status
    R: Array = field(default_factory=lambda: np.eye(3))
    t: Array = field(default_factory=lambda: np.zeros(3))
    covariance_5: Array = field(default_factory=lambda: np.full((5, 5), np.nan))
    covariance_6: Array = field(default_factory=lambda: np.full((6, 6), np.nan))
    x: Array = field(default_factory=lambda: np.empty((0, 2)))
    y: Array = field(default_factory=lambda: np.empty((0, 2)))
    placed: Array = field(default_factory=lambda: np.empty((0, 2)))
    placed_covariances: Array = field(default_factory=lambda: np.empty((0, 2, 2)))
    y_opt: Array = field(default_factory=lambda: np.empty((0, 2)))
    inliers: NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, bool))
    voting: NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, bool))
    residuals: Array = field(default_factory=lambda: np.empty(0))
    hamming: Array = field(default_factory=lambda: np.empty(0))
    losses: Array = field(default_factory=lambda: np.empty(0))
    culled: int = 0
    indefinite: int = 0
    iterations: int = 0
    timings: dict[str, float] = field(default_factory=dict)
    rivals: tuple[Pose, ...] = ()
    sought: int = 0
