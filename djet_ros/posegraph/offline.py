"""From the results of a replay to an optimised trajectory: the offline SLAM on one screen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from djet_ros.config.sections import Config
from djet_ros.core.types import Array
from djet_ros.posegraph.backend import optimise, Solution
from djet_ros.posegraph.graph import PoseGraph
from djet_ros.posegraph.images import frames_at, SeenFile
from djet_ros.posegraph.keyframes import choose_keyframes, Keyframes, without_common_length
from djet_ros.posegraph.loops import EdgeFinder
from djet_ros.recordings.recording import Recording
import numpy as np

# What the offline SLAM goes by, of the section slam; the rest is for live use.
PARAMETERS = tuple(f'slam.{name}' for name in (
    'keyframe_distance', 'keyframe_turn', 'links', 'length_noise', 'loop_gap', 'loop_votes',
    'loop_candidates', 'loop_inliers', 'loop_share'))


@dataclass(frozen=True)
class Slam:
    """
    What came of a run.

    frames: graph of all frames, as the odometry made it; keyframes; solution: the graph of the
    keyframes with links and loops, optimised.
    """

    frames: PoseGraph
    keyframes: Keyframes
    solution: Solution

    @property
    def scale_known(self) -> bool:
        """Whether the odometry's lengths are in metres."""
        return all(edge.scale_known for edge in self.frames.edges if edge.kind == 'odometry')

    def before(self) -> Array:
        """Poses (N, 4, 4) of all frames by odometry."""
        return self.frames.poses

    def after(self) -> Array:
        """Poses (N, 4, 4) of all frames, each moved with its keyframe."""
        return self.keyframes.all_poses(self.solution.graph.poses)

    def rejected(self, kind: str) -> int:
        """Count the edges of a kind that the robust kernel trusts by less than a half."""
        return sum(bool(edge.kind == kind and trust < 0.5)
                   for edge, trust in zip(self.solution.graph.edges, self.solution.trust))


def run_slam(frames: PoseGraph, recording: Recording, config: Config,
             progress: Callable[[int, int], None] | None = None,
             scratch: Path | None = None) -> Slam:
    """
    Choose keyframes, find links and loops in the recording's images, and optimise.

    frames: the graph of the recording's replay with the configuration; progress is called with
    (keyframes done, keyframes in all); scratch: a folder with room for the images of the
    keyframes, while it lasts. Raises DjetError.
    """
    # Composed with others, what is wrong with an edge would no longer be seen.
    frames.check()
    slam = config.slam
    keyframes = choose_keyframes(without_common_length(
        frames, config.odometry.scale_uncertainty, slam.length_noise), slam)
    graph = keyframes.graph
    edges = [*graph.edges]
    images = frames_at(recording, config, graph.stamps_ns)
    with SeenFile(scratch) as seen:
        finder = EdgeFinder(config.estimator, slam, seen)
        for number, (frame, before) in enumerate(zip(images, (None, *graph.edges))):
            finder.add(frame, before)
            edges += [*finder.links(number), *finder.loops(number)]
            if progress is not None:
                progress(number + 1, len(graph.poses))
    return Slam(frames, keyframes, optimise(replace(graph, edges=tuple(edges))))


def travelled(poses: Array) -> float:
    """Length of the way through poses (N, 4, 4)."""
    return float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())
