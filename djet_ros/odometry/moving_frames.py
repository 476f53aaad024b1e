"""Transforms between frames over time, from /tf and /tf_static."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

from djet_ros.core.types import Array
from djet_ros.odometry.interpolation import Stamps
from djet_ros.odometry.messages import pose_of
from djet_ros.odometry.pose_track import PoseTrack
from djet_ros.odometry.static_frames import MOST, StaticFrames, upwards
import numpy as np

TOPIC = '/tf'

# Poses that are kept of each frame: twenty seconds at the usual rate.
_KEPT = 2_000


class _Link(NamedTuple):
    """A frame's parent, and its poses in that."""

    parent: str
    poses: PoseTrack


class MovingFrames:
    """A forest of moving and static frames."""

    def __init__(self) -> None:
        self._static = StaticFrames()
        self._moving: dict[str, _Link] = {}

    def reset(self) -> None:
        """Forget the poses of moving frames."""
        self._moving.clear()

    def go_back(self, stamp_ns: int) -> None:
        """Forget the poses from before time went back to a stamp."""
        for link in self._moving.values():
            link.poses.go_back(stamp_ns)

    def add(self, message: Any, *, static: bool) -> None:
        """Take a TFMessage of /tf or, static, of /tf_static."""
        if static:
            self._static.add(message)
            return
        for one in message.transforms:
            stamp, pose = pose_of(one)
            child, parent = one.child_frame_id.lstrip('/'), one.header.frame_id.lstrip('/')
            link = self._moving.get(child)
            if link is None or link.parent != parent:
                if link is None and len(self._moving) >= MOST:
                    continue
                link = self._moving[child] = _Link(parent, PoseTrack(_KEPT))
            link.poses.add(stamp, pose)

    def forget_before(self, stamp_ns: int) -> None:
        """Drop poses that are not needed from a stamp on."""
        for link in self._moving.values():
            link.poses.forget_before(stamp_ns)

    def covers(self, parent: str, child: str, stamp_ns: int) -> bool:
        """Return whether all moving frames between two have a pose at a stamp, or after it."""
        above = [[frame for frame, _ in self._upwards(one, np.empty(0, np.int64))]
                 for one in (parent, child)]
        return not set(above[0]).isdisjoint(above[1]) and all(
            self._moving[frame].poses.covers(stamp_ns)
            for frame in set(above[0]) ^ set(above[1]) if frame in self._moving)

    def poses(self, parent: str, child: str, stamps_ns: Stamps) -> Array:
        """Return a frame's (N, 4, 4) poses in another one at stamps (N,), NaN if unknown."""
        above = dict(self._upwards(parent, stamps_ns))
        for frame, poses in self._upwards(child, stamps_ns):
            if frame in above and np.isfinite(above[frame]).all():
                return np.asarray(np.linalg.inv(above[frame]) @ poses)
        return np.full((len(stamps_ns), 4, 4), np.nan)

    def _upwards(self, frame: str, stamps_ns: Stamps) -> Iterator[tuple[str, Array]]:
        """Yield a frame and its ancestors, each with the first frame's poses (N, 4, 4) in it."""
        def above(frame: str) -> tuple[str, Array] | None:
            link = self._moving.get(frame)
            return (link.parent, link.poses.at(stamps_ns)) if link else self._static.above(frame)

        return upwards(frame, above, np.tile(np.eye(4), (len(stamps_ns), 1, 1)))
