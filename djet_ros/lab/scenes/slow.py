"""A slower camera: more steps on the same path."""

from __future__ import annotations

from dataclasses import dataclass

from djet_ros.core.types import Array
from djet_ros.lab.scenes.route import Trajectory
import numpy as np
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
        around = [self.path.pose(max(whole - 1, 0)), before, after,
                  self.path.pose(min(whole + 2, self.path.limit - 1))]
        pose = np.eye(4)
        turns = Rotation.from_matrix([before[:3, :3], after[:3, :3]])
        pose[:3, :3] = Slerp([0, 1], turns)(share).as_matrix()
        pose[:3, 3] = _spline(share) @ [each[:3, 3] for each in around]
        return pose


def _spline(share: float) -> Array:
    """
    Return the weights (4,) of four points for a share of the way from the second to the third.

    Catmull and Rom, "A class of local interpolating splines", 1974.
    """
    powers = share ** np.arange(4.0)
    return np.asarray(powers @ [[0, 1, 0, 0], [-0.5, 0, 0.5, 0], [1, -2.5, 2, -0.5],
                                [-0.5, 1.5, -1.5, 0.5]])
