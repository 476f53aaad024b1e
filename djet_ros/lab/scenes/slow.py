"""A slower camera: more steps on the same path."""

from __future__ import annotations

from dataclasses import dataclass

from djet_ros.core.types import Array
from djet_ros.lab.scenes.route import Trajectory
import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp


@dataclass(frozen=True)
class Slower:
    """
    A path with so many steps in place of each of another one.

    Positions between those of that path are on a Catmull-Rom spline through them, rotations on the
    shortest arc.
    """

    path: Trajectory
    steps: int

    @property
    def limit(self) -> int:
        """Return the maximum number of frames."""
        return (self.path.limit - 1) * self.steps + 1

    def pose(self, index: int) -> Array:
        """Pose (4, 4), camera to level axes, of one frame."""
        whole, part = divmod(index, self.steps)
        before = self.path.pose(whole)
        if part == 0:
            return before
        after, share = self.path.pose(whole + 1), part / self.steps
        around = np.array([self.path.pose(min(max(near, 0), self.path.limit - 1))[:3, 3]
                           for near in range(whole - 1, whole + 3)])
        pose = np.eye(4)
        turns = Rotation.from_matrix([before[:3, :3], after[:3, :3]])
        pose[:3, :3] = Slerp([0, 1], turns)(share).as_matrix()
        velocities = (around[2:] - around[:-2]) / 2
        pose[:3, 3] = CubicHermiteSpline([0, 1], around[1:3], velocities)(share)
        return pose
