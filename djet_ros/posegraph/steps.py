"""
From the odometry's messages to the steps of its way.

An Odometry says where the camera is, and the relative pose of the same stamp how it came there
and how sure that is. Neither says from which frame: that is the newest one at which the camera
was not standing still, or the odometry says by its covariance that something is missing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from djet_ros.core.types import Array
from djet_ros.errors import DjetError
from djet_ros.odometry.messages import begins_anew, OPTICAL_TO_BODY, pose_of
from djet_ros.odometry.scale import UNKNOWN_LENGTH_SIGMA
from djet_ros.odometry.uncertainty import rotated, UNKNOWN_MOTION
from djet_ros.posegraph.graph import Edge, PoseGraph
import numpy as np

# Messages of one topic that may wait for their like on the other.
_WAITING = 1000

# An integrated rotation gets this variance (trace, rad^2) where nothing was known of a motion.
_HOLE = float(np.trace(UNKNOWN_MOTION[3:, 3:]))

# By which two ways to compute one pose may differ, in metres per metre and in radians.
_ROUNDING = 1e-6


@dataclass(frozen=True)
class Step:
    """
    A frame that the odometry has told of, along optical axes.

    pose (4, 4): the camera in the odometry's frame; edge: the motion from the frame at which the
    camera last was, kind 'odometry', or 'unknown' where nothing is known of it; None for the
    first frame of all. anew: whether the odometry began anew, so that its frame may be another
    than before; standing: whether the next motion will be told from the frame before this one.
    """

    stamp_ns: int
    odom_frame: str
    pose: Array
    edge: Edge | None
    anew: bool = False
    standing: bool = False


class Steps:
    """
    Pairs Odometry and PoseWithCovarianceStamped of one stamp.

    convention: 'optical' or 'body', of the axes in messages. missing: how many relative poses
    did not come.
    """

    def __init__(self, convention: str) -> None:
        self._turn = np.eye(4)
        if convention == 'body':
            self._turn[:3, :3] = OPTICAL_TO_BODY.T
        self.reset()

    def reset(self) -> None:
        """Forget everything; the next frame is the first."""
        self.missing = 0
        self._odometries: dict[int, Any] = {}
        self._relatives: dict[int, Any] = {}
        # Where the next motion is told from.
        self._pose: Array | None = None
        self._rotation_variance = 0.0
        self._newest_odometry = self._newest_relative = -1

    def goes_back(self, odometry: Any) -> bool:
        """Tell of an Odometry whether it is of an earlier time than the last one."""
        return pose_of(odometry)[0] < self._newest_odometry

    def relative_pose(self, message: Any) -> list[Step]:
        """Take a relative pose, and give the step that is complete by it."""
        stamp, _ = pose_of(message)
        if stamp < self._newest_relative:
            self._relatives.clear()
        self._newest_relative = stamp
        _keep(self._relatives, stamp, message)
        return self._complete(stamp)

    def odometry(self, message: Any) -> list[Step]:
        """Take an Odometry that does not go back in time, and give the step that it completes."""
        stamp, pose = pose_of(message)
        if stamp == self._newest_odometry:
            return []
        self._newest_odometry = stamp
        if not np.isfinite(pose).all():
            raise DjetError(f'the odometry of {stamp} ns holds no pose')
        _keep(self._odometries, stamp, message)
        return [self._start(stamp)] if begins_anew(message) else self._complete(stamp)

    def _complete(self, stamp: int) -> list[Step]:
        if stamp not in self._odometries or stamp not in self._relatives:
            return []
        relative = self._relatives[stamp]
        odometry = self._taken(stamp)
        _, pose = pose_of(odometry)
        _, motion = pose_of(relative)
        if not np.isfinite(motion).all():
            raise DjetError(f'the relative pose of {stamp} ns holds no pose')
        covariance = _covariance(relative)
        here = self._turn @ pose @ self._turn.T
        variance = float(np.trace(_covariance(odometry)[3:, 3:]))
        edge = self._edge(stamp, here, self._turn @ motion @ self._turn.T,
                          rotated(self._turn[:3, :3], covariance),
                          variance - float(np.trace(covariance[3:, 3:])))
        standing = bool(edge and edge.kind == 'odometry' and np.allclose(
            motion, np.eye(4), rtol=0, atol=_ROUNDING**2))
        self._pose, self._rotation_variance = here, variance
        return [Step(stamp, odometry.header.frame_id, here, edge, standing=standing)]

    def _edge(self, stamp: int, here: Array, motion: Array, covariance: Array,
              variance_before: float) -> Edge | None:
        if self._pose is None:
            return None
        # Names the stamp of a covariance that is none.
        edge = Edge(0, 1, motion, covariance, 'odometry', _is_length_known(covariance))
        PoseGraph(np.array([0, stamp]), np.array([np.eye(4), motion]), (edge,)
                  ).body_covariance(edge)
        told = self._pose @ motion
        off = np.linalg.inv(told) @ here - np.eye(4)
        reach = _ROUNDING * (1 + np.linalg.norm(here[:3, 3]))
        if np.abs(off[:3, :3]).max() < _ROUNDING and np.abs(off[:3, 3]).max() < reach \
                and variance_before - self._rotation_variance < _HOLE / 2:
            return edge
        return _unknown(np.linalg.inv(self._pose) @ here)

    def _start(self, stamp: int) -> Step:
        """Begin anew: the odometry tells of no motion, and may have another frame."""
        odometry = self._taken(stamp)
        here = self._turn @ pose_of(odometry)[1] @ self._turn.T
        edge = None if self._pose is None else _unknown(np.eye(4))
        self._pose = here
        self._rotation_variance = float(np.trace(_covariance(odometry)[3:, 3:]))
        return Step(stamp, odometry.header.frame_id, here, edge, anew=True)

    def _taken(self, stamp: int) -> Any:
        """Give the Odometry of a stamp; what waits from before it waits in vain."""
        odometry = self._odometries.pop(stamp)
        self._relatives = {at: one for at, one in self._relatives.items() if at > stamp}
        self.missing += sum(at < stamp for at in self._odometries)
        self._odometries = {at: one for at, one in self._odometries.items() if at > stamp}
        return odometry


def _unknown(guess: Array) -> Edge:
    return Edge(0, 1, guess, UNKNOWN_MOTION, 'unknown', False)


def _keep(waiting: dict[int, Any], stamp: int, message: Any) -> None:
    waiting[stamp] = message
    if len(waiting) > _WAITING:
        del waiting[next(iter(waiting))]


def _covariance(message: Any) -> Array:
    return np.asarray(message.pose.covariance, np.float64).reshape(6, 6)


def _is_length_known(covariance: Array) -> bool:
    return bool(np.sqrt(np.trace(covariance[:3, :3])) < UNKNOWN_LENGTH_SIGMA / 2)
