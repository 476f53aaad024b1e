"""Integration of motions to the pose of the camera, with its covariance."""

from __future__ import annotations

from dataclasses import dataclass, field

from djet_ros.core.types import Array
from djet_ros.odometry.result import camera_motion
from djet_ros.odometry.structure import Step
from djet_ros.odometry.uncertainty import motion_covariance, PathCovariance
import numpy as np


@dataclass(frozen=True)
class Trajectory:
    """Newest pose (4, 4) of a trajectory in its first camera; path: its covariance."""

    pose: Array = field(default_factory=lambda: np.eye(4))
    path: PathCovariance = field(default_factory=PathCovariance)

    def stayed(self, covariance: Array) -> Trajectory:
        """Return the trajectory after a standstill with a covariance (6, 6)."""
        return Trajectory(self.pose, self.path.moved(self.pose, np.eye(4), covariance))

    def moved(self, motion: Array, covariance: Array) -> Trajectory:
        """Return the trajectory after a motion (4, 4) with an independent error (6, 6)."""
        return Trajectory(self.pose @ motion, self.path.moved(self.pose, motion, covariance))

    def moved_by_step(self, step: Step) -> Trajectory:
        """Return the trajectory after an estimated step."""
        covariance, common = motion_covariance(step.relative, step.length.own), step.length.common
        if step.window_motion is not None:
            # Landmarks that are seen in both of two pairs correct the errors that these share.
            return Trajectory(self.pose @ step.window_motion, self.path.moved(
                self.pose, step.window_motion, covariance, common))
        motion = camera_motion(step.relative, step.length.value)
        return Trajectory(self.pose @ motion, self.path.moved_by_pair(
            self.pose, motion, covariance, common))
