"""Where frames are on one another, as /tf_static tells it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from djet_ros.core.types import Array
from djet_ros.odometry.messages import pose_of
import numpy as np

TOPIC, TYPE = '/tf_static', 'tf2_msgs/msg/TFMessage'

# Gives a frame, by its name, in another, its first argument, (4, 4); None where nobody knows.
Transform = Callable[[str, str], Array | None]

# Frames that are kept: more than any robot has.
MOST = 10_000


class StaticFrames:
    """A forest of frames that do not move on one another; who is told last counts."""

    def __init__(self) -> None:
        # By frame: its parent, and itself in it (4, 4).
        self._parents: dict[str, tuple[str, Array]] = {}

    def add(self, message: Any) -> None:
        """Take a TFMessage; what holds no pose is left out."""
        for one in message.transforms:
            _, pose = pose_of(one)
            # tf of ROS 1 had names with a slash in front.
            child, parent = (name.lstrip('/') for name in (
                one.child_frame_id, one.header.frame_id))
            if np.isfinite(pose).all() and (child in self._parents or len(self._parents) < MOST):
                self._parents[child] = parent, pose

    def transform(self, parent: str, child: str) -> Array | None:
        """Give a frame in another (4, 4), or None where they are not of one tree."""
        above = dict(upwards(parent, self.above, np.eye(4)))
        for frame, pose in upwards(child, self.above, np.eye(4)):
            if frame in above:
                return np.asarray(np.linalg.inv(above[frame]) @ pose)
        return None

    def above(self, frame: str) -> tuple[str, Array] | None:
        """Give what a frame stands on, and itself in that (4, 4)."""
        return self._parents.get(frame)


def upwards(frame: str, above: Callable[[str], tuple[str, Array] | None], itself: Array
            ) -> Iterator[tuple[str, Array]]:
    """
    Yield a frame and those it stands on, each with the first one in it.

    above: gives what a frame stands on, and itself in that (4, 4) or, at several times,
    (N, 4, 4); itself: the first frame in itself, of that shape.
    """
    frame, pose, seen = frame.lstrip('/'), itself, set[str]()
    # Who publishes nonsense may close a circle.
    while frame not in seen:
        yield frame, pose
        seen.add(frame)
        if (step := above(frame)) is not None:
            frame, pose = step[0], step[1] @ pose
