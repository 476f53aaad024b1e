"""Static transforms between frames, from /tf_static."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from djet_ros.core.types import Array
from djet_ros.odometry.messages import pose_of
import numpy as np

TOPIC, TYPE = '/tf_static', 'tf2_msgs/msg/TFMessage'

# Returns the pose (4, 4) of a frame (second argument) in another one (first), None if unknown.
Transform = Callable[[str, str], Array | None]

# Most frames that are kept: more than any robot has.
MOST = 10_000


class StaticFrames:
    """A forest of static transforms; of several for one frame, the last counts."""

    def __init__(self) -> None:
        # By frame: its parent, and its pose (4, 4) in that.
        self._parents: dict[str, tuple[str, Array]] = {}

    def add(self, message: Any) -> None:
        """Take a TFMessage; invalid poses are ignored."""
        for one in message.transforms:
            _, pose = pose_of(one)
            # Names of ROS 1 have a slash in front.
            child, parent = (name.lstrip('/') for name in (
                one.child_frame_id, one.header.frame_id))
            if np.isfinite(pose).all() and (child in self._parents or len(self._parents) < MOST):
                self._parents[child] = parent, pose

    def transform(self, parent: str, child: str) -> Array | None:
        """Return the pose (4, 4) of a frame in another; None if they are not in one tree."""
        above = dict(upwards(parent, self.above, np.eye(4)))
        for frame, pose in upwards(child, self.above, np.eye(4)):
            if frame in above:
                return np.asarray(np.linalg.inv(above[frame]) @ pose)
        return None

    def above(self, frame: str) -> tuple[str, Array] | None:
        """Return a frame's parent, and its pose (4, 4) in that; None for a root."""
        return self._parents.get(frame)


def upwards(frame: str, above: Callable[[str], tuple[str, Array] | None], itself: Array
            ) -> Iterator[tuple[str, Array]]:
    """
    Yield a frame and its ancestors, each with the pose of the first frame in it.

    above: returns a frame's parent, and its pose in that, (4, 4) or, at N stamps, (N, 4, 4);
    itself: the identity of that shape.
    """
    frame, pose, seen = frame.lstrip('/'), itself, set[str]()
    # A faulty publisher may close a loop.
    while frame not in seen:
        yield frame, pose
        seen.add(frame)
        if (step := above(frame)) is not None:
            frame, pose = step[0], step[1] @ pose
