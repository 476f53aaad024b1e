"""
Length of a pair's translation, by points of known depth.

A pair triangulates inverse depths in units of its own translation. The ratio of such a depth to
the known one of the same point is the length of the translation in the unit of the track.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from djet_ros.core.bundle import Landmarks, points_in_frame, Poses, projected
from djet_ros.core.geometry import (
    depths_in_second,
    inverse_depths,
    norms,
    rays,
    sphere_tangents,
)
from djet_ros.core.medians import median, weighted_median
from djet_ros.core.prediction import nearest
from djet_ros.core.sketch import moved_all
from djet_ros.core.types import Array, Pose, RelativePose
import numpy as np
from numpy.typing import NDArray

# chosen: pixels between a known point and a match of a pair up to which they are the same point.
_MATCH_RADIUS = 1.5

# Cosine of the angle to the optical axis up to which a point is seen after a rotation.
_LEAST_AHEAD = 0.1

# Robust standard deviations beyond which a depth disagrees; chosen: largest error of an inlier
# match, in pixels; and largest relative error of a landmark's depth.
_OUTLIER, _MATCH_ERROR, _DEPTH_ERROR = 4.0, 0.4, 0.15


class Lengths(NamedTuple):
    """
    Lengths (M,) of a pair by each of some points, and their weights (M,).

    by_pose: (5, M) the same if the pose of the pair is one standard deviation off, along each axis
    of its covariance.
    """

    values: Array
    weights: Array
    by_pose: Array

    def median(self) -> float:
        """Return the weighted median."""
        return weighted_median(self.values, self.weights)

    def standard_error(self) -> float:
        """Return the standard error of the median, for the effective number of weights."""
        deviations = np.abs(self.values - self.median())
        sigma = 1.25 * 1.4826 * weighted_median(deviations, self.weights)
        return sigma * float(np.sqrt((self.weights**2).sum()) / self.weights.sum())

    def noise(self) -> float:
        """
        Return the standard deviation of the median, also due to the pose.

        A rotation that is a pixel off changes the parallax of all points by that pixel, however
        well they agree.
        """
        length = self.median()
        common = [weighted_median(values, self.weights) - length for values in self.by_pose]
        return float(np.linalg.norm([*common, self.standard_error()]))


@dataclass(frozen=True)
class KnownDepths:
    """
    Points of a frame: pixels (P, 2), and inverse depths rho (P,) in the unit of the track.

    K: (3, 3).
    """

    pixels: Array
    rho: Array
    K: Array

    @classmethod
    def of_landmarks(cls, K: Array, poses: Poses, landmarks: Landmarks, frame: int) -> KnownDepths:
        """Return landmarks as points of a frame, if they are in front of it."""
        landmarks = landmarks.of(landmarks.rho > 0)
        points = points_in_frame(K, poses, landmarks, frame)
        ahead = points[:, 2] > 0
        return cls(projected(K, points[ahead]), landmarks.rho[ahead] / points[ahead, 2], K)

    @classmethod
    def of_pair(cls, K: Array, pair: RelativePose, length: float) -> KnownDepths:
        """Return the inliers of a pair of known length as points of its second frame."""
        y = pair.y_opt[pair.inliers]
        rays_x = rays(K, pair.x[pair.inliers])
        rho, _ = inverse_depths(pair.R, pair.t, rays_x, rays(K, y))
        depths = depths_in_second(pair.R, pair.t, rays_x, rho)
        ahead = (rho > 0) & (depths > 0)
        return cls(y[ahead], rho[ahead] / (depths[ahead] * length), K)

    def rotated(self, R: Array) -> KnownDepths:
        """Return the points as they are seen after a rotation (3, 3) of the camera on the spot."""
        turned = rays(self.K, self.pixels) @ R.T
        ahead = turned[:, 2] > _LEAST_AHEAD
        turned = turned[ahead]
        return KnownDepths(projected(self.K, turned), self.rho[ahead] / turned[:, 2], self.K)

    def lengths(self, pair: RelativePose, radius: float = _MATCH_RADIUS) -> Lengths:
        """
        Return the lengths of a pair that starts at the frame, by points with an inlier.

        radius: pixels between the two; those far from each other have about the same depth.
        """
        rho, rays_x, rays_y = self._matched(pair.x[pair.inliers], pair.y_opt[pair.inliers], radius)
        scaled, sigma = inverse_depths(pair.R, pair.t, rays_x, rays_y)
        variances, axes = np.linalg.eigh(pair.covariance_5)
        steps = (axes * np.sqrt(np.maximum(variances, 0.0))).T
        moved = moved_all(pair.R, pair.t, sphere_tangents(pair.t), steps)
        return Lengths(scaled / rho, rho / sigma, inverse_depths(*moved, rays_x, rays_y)[0] / rho)

    def count_agreeing(self, pose: Pose, x: Array, y: Array) -> tuple[int, int]:
        """
        Count the points that agree with a motion, and those that have a match.

        pose: from the frame to another one, the sign of t is free; x, y: (N, 2) matched pixels of
        the two. The length of the motion is the one that most of the points agree with.
        """
        rho, rays_x, rays_y = self._matched(x, y)
        if not len(rho):
            return 0, 0
        scaled, sigma = inverse_depths(pose.R, pose.t, rays_x, rays_y)
        ratios = scaled / rho
        # By near points, which have most parallax but may be of another body, or by all with equal
        # weight.
        lengths = np.array([[weighted_median(ratios, rho / sigma)], [median(ratios)]])
        noise = _MATCH_ERROR / self.K[0, 0] * sigma
        agree = np.abs(scaled - lengths * rho) < (
            _OUTLIER * noise + _DEPTH_ERROR * np.abs(lengths) * rho)
        return int(agree.sum(1).max()), len(rho)

    def _matched(self, x: Array, y: Array, radius: float = _MATCH_RADIUS
                 ) -> tuple[Array, Array, Array]:
        """Return the inverse depths (M,) of points with a match in x, y (N, 2), and its rays."""
        near, match = same_points(self.pixels, x, radius)
        rays_x, rays_y = (rays(self.K, pixels[match]) for pixels in (x, y))
        return self.rho[near], rays_x, rays_y


def same_points(pixels: Array, x: Array, radius: float = _MATCH_RADIUS
                ) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """
    Match pixels (P, 2) of one pair or of landmarks with those of another pair, x (N, 2).

    Returns the mask (P,) of those that have one of the same point, and its index (M,) in x.
    """
    if not len(pixels) or not len(x):
        return np.zeros(len(pixels), bool), np.empty(0, np.int64)
    match = nearest(x, pixels)
    near = norms(x[match] - pixels) < radius
    return near, match[near]
