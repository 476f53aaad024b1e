"""From the graph of all frames to the graph of a few of them, and back."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from djet_ros.config.sections import SlamConfig
from djet_ros.core.types import Array
from djet_ros.odometry.uncertainty import compose
from djet_ros.posegraph.graph import Edge, PoseGraph
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class Keyframes:
    """
    Keyframes and how all frames hang on them.

    graph: vertices are the keyframes; keyframe: (N,) which one each frame hangs on;
    offsets: (N, 4, 4) each frame in its keyframe.
    """

    graph: PoseGraph
    keyframe: NDArray[np.int64]
    offsets: Array

    def all_poses(self, poses: Array) -> Array:
        """Poses (N, 4, 4) of all frames for poses (M, 4, 4) of the keyframes."""
        return np.asarray(poses[self.keyframe] @ self.offsets)


@dataclass(frozen=True)
class Hanging:
    """
    How a frame hangs on its keyframe.

    keyframe: its number; offset (4, 4): the frame in the keyframe; covariance (6, 6) of the
    offset, along the keyframe's axes; scale_known: whether its length is in metres.
    """

    keyframe: int
    offset: Array = field(default_factory=lambda: np.eye(4))
    covariance: Array = field(default_factory=lambda: np.zeros((6, 6)))
    scale_known: bool = True

    def then(self, motion: Array, covariance: Array, scale_known: bool) -> Hanging:
        """Tell how the next frame hangs there: its motion (4, 4), with covariance (6, 6)."""
        return Hanging(self.keyframe, self.offset @ motion,
                       compose(self.offset, self.covariance, motion, covariance),
                       self.scale_known and scale_known)

    def is_far(self, config: SlamConfig) -> bool:
        """Tell whether the frame should be a keyframe itself."""
        turn = np.degrees(Rotation.from_matrix(self.offset[:3, :3]).magnitude())
        way = np.linalg.norm(self.offset[:3, 3])
        return bool(way >= config.keyframe_distance or turn >= config.keyframe_turn)


def without_common_length(frames: PoseGraph, uncertainty: float, noise: float) -> PoseGraph:
    """
    Take that part of the lengths' variances away that is an error common to all of them.

    uncertainty: standard deviation of each known length as a share of it, as the edges have it;
    noise: what of it is each length's own. If all lengths of a graph are too large alike, and with
    them those of the loops, which come from them, then the graph is as consistent as before, only
    larger: such an error must not make lengths look as if they could give way one by one.
    """
    common = uncertainty**2 - noise**2
    if common <= 0:
        return frames
    edges = []
    for edge in frames.edges:
        if edge.scale_known:
            way = np.pad(edge.motion[:3, 3], (0, 3))
            edge = replace(edge, covariance=edge.covariance - common * np.outer(way, way))
        edges.append(edge)
    return replace(frames, edges=tuple(edges))


def choose_keyframes(frames: PoseGraph, config: SlamConfig) -> Keyframes:
    """
    Choose keyframes by way and turn, and compose the edges between them.

    frames: every vertex but the first has one edge, from a vertex before it, as the odometry
    makes them. A frame about whose motion nothing is known is a keyframe.
    """
    hanging = [Hanging(0)] * len(frames.poses)
    chosen: list[int] = [0]
    edges: list[Edge] = []
    for edge in frames.edges:
        there = hanging[edge.source].then(edge.motion, edge.covariance, edge.scale_known)
        if edge.kind == 'unknown' or there.is_far(config):
            edges.append(Edge(there.keyframe, len(chosen), there.offset, there.covariance,
                              edge.kind, there.scale_known))
            there = Hanging(len(chosen))
            chosen.append(edge.target)
        hanging[edge.target] = there
    graph = PoseGraph(frames.stamps_ns[chosen], frames.poses[chosen], tuple(edges))
    return Keyframes(graph, np.array([one.keyframe for one in hanging]),
                     np.array([one.offset for one in hanging]))
