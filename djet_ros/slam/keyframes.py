"""From the graph of all frames to the graph of a few of them, and back."""

from __future__ import annotations

from dataclasses import dataclass

from djet_ros.core.types import Array
from djet_ros.data.pose_graph import Edge, PoseGraph
from djet_ros.odometry.uncertainty import compose
from djet_ros.slam.config import SlamConfig
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


def choose_keyframes(frames: PoseGraph, config: SlamConfig) -> Keyframes:
    """
    Choose keyframes by way and turn, and compose the edges between them.

    frames: every vertex but the first has one edge, from a vertex before it, as the odometry
    makes them. A frame about whose motion nothing is known is a keyframe.
    """
    count = len(frames.poses)
    keyframe = np.zeros(count, np.int64)
    offsets, covariances = np.tile(np.eye(4), (count, 1, 1)), np.zeros((count, 6, 6))
    scaled = np.ones(count, bool)
    chosen, edges = [0], []
    for edge in frames.edges:
        source, target = edge.source, edge.target
        motion = offsets[source] @ edge.motion
        covariance = compose(offsets[source], covariances[source], edge.motion, edge.covariance)
        known = bool(scaled[source] and edge.scale_known)
        keyframe[target] = keyframe[source]
        if edge.kind == 'unknown' or _is_far(motion, config):
            edges.append(Edge(int(keyframe[source]), len(chosen), motion, covariance, edge.kind,
                              known))
            keyframe[target] = len(chosen)
            chosen.append(target)
        else:
            offsets[target], covariances[target], scaled[target] = motion, covariance, known
    graph = PoseGraph(frames.stamps_ns[chosen], frames.poses[chosen], tuple(edges))
    return Keyframes(graph, keyframe, offsets)


def _is_far(motion: Array, config: SlamConfig) -> bool:
    turn = np.degrees(Rotation.from_matrix(motion[:3, :3]).magnitude())
    way = np.linalg.norm(motion[:3, 3])
    return bool(way >= config.keyframe_distance or turn >= config.keyframe_turn)
