"""Data types of the core: features, views, poses, and the estimate of a pair."""

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
    """Outcome of a frame or of a pair of frames."""

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


# Statuses with an estimated motion.
TRACKED = (Status.OK, Status.NO_PARALLAX)

# Statuses of pairs with good images but two possible motions. A later pair that starts at the
# newer image may decide; a pair over both steps would have even fewer matches in common.
UNDECIDED = (Status.AMBIGUOUS, Status.TWO_MOTIONS)

# Statuses of a frame at which the odometry started or restarted, without a pair.
STARTED = (Status.FIRST_FRAME, Status.TIME_JUMP, Status.SIZE_CHANGED)


@dataclass(frozen=True)
class Features:
    """
    Features of one image.

    points: (N, 2) pixels at full resolution, pixel centres at integers; octaves: (N,) pyramid
    levels; angles: (N,) degrees; responses: (N,); describe: computes the descriptors, on first
    access only, as predicted pairs never need them; additional: detects additional features on
    demand, which only help if views are far apart.
    """

    points: Array
    octaves: NDArray[np.int32]
    angles: NDArray[np.float32]
    responses: NDArray[np.float32]
    describe: Callable[[], NDArray[np.uint8]]
    additional: Callable[[], Features] | None = None

    @classmethod
    def concatenated(cls, parts: Sequence[Features]) -> Features:
        """Concatenate features of one image, without their additional ones."""
        # Captures the callables only: a reference to the parts would keep all of their arrays
        # alive.
        describe = [part.describe for part in parts]
        return cls(np.concatenate([part.points for part in parts]),
                   np.concatenate([part.octaves for part in parts]),
                   np.concatenate([part.angles for part in parts]),
                   np.concatenate([part.responses for part in parts]),
                   lambda: np.concatenate([one() for one in describe]))

    @classmethod
    def with_descriptors(cls, points: Array, octaves: NDArray[np.int32],
                         angles: NDArray[np.float32], responses: NDArray[np.float32],
                         descriptors: NDArray[np.uint8]) -> Features:
        """Create features with descriptors that are computed already."""
        return cls(points, octaves, angles, responses, lambda: descriptors)

    def __len__(self) -> int:
        return len(self.points)

    @cached_property
    def descriptors(self) -> NDArray[np.uint8]:
        """Descriptors (N, 32), for matching only."""
        return self.describe()

    @cached_property
    def with_additional(self) -> Features:
        """Return these features and the additional ones, if there are any."""
        if self.additional is None:
            return self
        return Features.concatenated([self, self.additional()])


class Picture(Protocol):
    """An image with a camera: gray (H, W), and K (3, 3) the camera matrix."""

    @property
    def gray(self) -> NDArray[np.uint8]:
        """Return the gray levels."""

    @property
    def K(self) -> Array:
        """Return the camera matrix."""


def of_same_camera(one: Picture, other: Picture) -> bool:
    """Return whether two images have the same size and camera matrix, as a pair requires."""
    return one.gray.shape == other.gray.shape and np.array_equal(one.K, other.K)


def require_gray(gray: NDArray[np.uint8], K: Array,
                 left_out: NDArray[np.bool_] | None = None) -> None:
    """
    Raise ValueError unless an image is (H, W) uint8, not empty, and K (3, 3) of a camera.

    left_out: mask of the image, which has to be of its size.
    """
    if not isinstance(gray, np.ndarray) or gray.ndim != 2 or gray.dtype != np.uint8 \
            or not gray.size:
        got = (f'{gray.shape} {gray.dtype}' if isinstance(gray, np.ndarray)
               else type(gray).__name__)
        raise ValueError(f'expected a gray image (H, W) uint8, got {got}')
    if left_out is not None and np.shape(left_out) != gray.shape:
        raise ValueError(f'the mask left_out is {np.shape(left_out)}, its image {gray.shape}; '
                         'give one of the same size')
    if K.shape != (3, 3):
        raise ValueError(f'expected the camera matrix K (3, 3), got {K.shape}')
    if not (np.isfinite(K).all() and min(K[0, 0], K[1, 1]) > 0
            and np.array_equal(K[[1, 2, 2, 2], [0, 0, 1, 2]], (0, 0, 0, 1))):
        raise ValueError(f'K is {K.tolist()}; a camera matrix is [[fx, skew, cx], [0, fy, cy], '
                         '[0, 0, 1]] of finite numbers, with positive fx and fy')


@dataclass(frozen=True)
class View:
    """
    One image, prepared for the estimator.

    gray: (H, W) uint8, undistorted; K: (3, 3) camera matrix; features: its features; smoothed:
    (H, W) uint8, gray as ORB's binary tests sample it; surface_gray: (H, W), gray as the tests of
    the descriptor surfaces sample it; mask: (H, W) bool, True where neither a feature nor a
    surface may be, or None.
    """

    gray: NDArray[np.uint8]
    K: Array
    features: Features
    smoothed: NDArray[np.uint8]
    surface_gray: NDArray[Any]
    mask: NDArray[np.bool_] | None = None


@dataclass(frozen=True)
class Pose:
    """A relative pose: R (3, 3), and t (3,) of unit length."""

    R: Array
    t: Array


@dataclass(frozen=True)
class Rival:
    """Another motion, and by how many standard deviations the matches prefer the chosen one."""

    pose: Pose
    preference: float


@dataclass(frozen=True)
class RelativePose:
    """
    The estimated motion between two frames, ``x_current = R x_previous + t``, and its evidence.

    R: (3, 3) rotation; t: (3,) unit direction, or zeros if the translation is not determined
    (status NO_PARALLAX and all failures). Three statuses come with a best guess: AMBIGUOUS if a
    very different motion explains the matches as well; TWO_MOTIONS if two bodies move and nothing
    decides which of them is the static world, if the camera may stand still while one passes, or
    if one has come to fill the view; TOO_FEW_INLIERS if false matches could produce as many
    inliers. Covariances of the first two span the alternatives, or are NaN if evidence from
    outside of the pair contradicts it; those of the last take the inliers to be true.
    covariance_5: (5, 5) over (rotation vector in rad, arc of t in rad in the basis
    ``sphere_tangents(t)``); covariance_6: (6, 6) over (rotation vector, t), of rank 5 because t
    has unit length. If t is zeros, only the rotation blocks (3, 3) are meaningful: the rest
    belongs to the direction that was fitted first, which is not determined.

    x, y: (N, 2) matched pixels in the previous and the current image, as used; y_opt: (N, 2) y
    after its final step onto the epipolar line; inliers: (N,) bool; voting: (N,) bool, matches
    that took part in the optimisation, inliers or not; placed: (N, 2) y as refined by photometric
    patch alignment under the pose and the depths, or y itself; placed_covariances: (N, 2, 2) of
    these in square pixels, up to a common factor (see `core.patches`), all alike without patch
    alignment; residuals: (N,) signed distances in pixels of y from its epipolar line, by the t
    that was fitted first if t is zeros; hamming: (N,) descriptor distances at y_opt in bits (NaN
    off the image); losses: (N,) loss of each match on its surface, the last one if it was culled;
    culled: number of matches without a usable surface in the end; indefinite: number of surfaces
    without a minimum; iterations: rounds of Algorithm 1; timings: stage -> seconds; rivals: other
    motions, up to the sign of t and beyond own_covariance_5, that the matches do not exclude
    beyond doubt, and the pose with -t if they do not exclude that;
    own_covariance_5: (5, 5) covariance_5 as it is without any rival; sought: number of features of
    the previous image that were searched, 0 if matches were given; left_out: (N,) bool, matches of
    another body, which did not take part, None if there are none.
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
    rivals: tuple[Rival, ...] = ()
    own_covariance_5: Array = field(default_factory=lambda: np.full((5, 5), np.nan))
    sought: int = 0
    left_out: NDArray[np.bool_] | None = None

    def __repr__(self) -> str:
        """Sum up the pair in a line: its arrays would fill a screen."""
        angle = 2 * np.arcsin(min(np.linalg.norm(self.R - np.eye(3)) / np.sqrt(8), 1.0))
        return (f'RelativePose({self.status}, rotation {np.degrees(angle):.4f} deg, '
                f't {self.t.round(4).tolist()}, '
                f'{self.inliers.sum()} of {len(self.x)} matches agree)')

    @property
    def of_body(self) -> NDArray[np.bool_]:
        """Return the (N,) bool mask of the matches of the body that was followed: all, or most."""
        return np.ones(len(self.inliers), bool) if self.left_out is None else ~self.left_out
