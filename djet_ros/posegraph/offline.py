"""From the results of a replay to an optimised trajectory: the map, fed from results."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from djet_ros.config.sections import Config
from djet_ros.core.types import Array
from djet_ros.odometry.scale import Scale
from djet_ros.posegraph.backend import OptimisedGraph
from djet_ros.posegraph.keyframe_images import KeyframeFile
from djet_ros.posegraph.keyframe_map import KeyframeMap, KeyframeOffset
from djet_ros.posegraph.pose_graph import PoseGraph
from djet_ros.posegraph.recorded_frames import frame_finder
from djet_ros.posegraph.steps import graph_of, scale_of, Step
from djet_ros.posegraph.units import in_unit
from djet_ros.recordings.recording import Recording
import numpy as np

# What the offline SLAM goes by, of the section slam; the rest is for live use.
PARAMETERS = tuple(f'slam.{name}' for name in (
    'keyframes', 'keyframe_distance', 'keyframe_turn', 'links', 'length_noise', 'loop_gap',
    'loop_votes', 'loop_candidates', 'loop_inliers', 'loop_share'))


@dataclass(frozen=True)
class Slam:
    """
    What came of a run.

    frames: graph of all frames, as the odometry made it; offsets: of each frame from its keyframe;
    optimised: the graph of the keyframes with links and loops; scale: what lengths are in.
    """

    frames: PoseGraph
    offsets: Sequence[KeyframeOffset]
    optimised: OptimisedGraph
    scale: Scale

    @property
    def metric(self) -> bool:
        """Whether the odometry's lengths are in metres."""
        return self.scale is Scale.METRIC

    def before(self) -> Array:
        """Poses (N, 4, 4) of all frames by odometry."""
        return self.frames.poses

    def after(self) -> Array:
        """Poses (N, 4, 4) of all frames, each moved with its keyframe."""
        keyframes, factors = self.optimised.graph.poses, self.optimised.factors
        return np.array([keyframes[offset.keyframe] @ in_unit(
            offset.motion, factors[offset.keyframe]) for offset in self.offsets])


def run_slam(steps: Sequence[Step], recording: Recording, config: Config,
             progress: Callable[[int, int], None] | None = None,
             scratch: Path | None = None) -> Slam:
    """
    Take keyframes, find links and loops in the recording's images, and optimise.

    steps: at least one, of the recording's replay with the configuration; progress is called with
    (frames done, frames in all); scratch: a folder with room for the images of the keyframes,
    while it lasts. Raises DjetError.
    """
    frames, offsets = graph_of(steps), []
    # Composed with others, what is wrong with a motion would no longer be seen.
    frames.check()
    frame_at = frame_finder(recording, config)
    with KeyframeFile(scratch) as kept:
        growing = KeyframeMap(config, kept)
        for number, step in enumerate(steps, 1):
            growing.extend(step, frame_at)
            growing.seek()
            assert growing.newest is not None
            offsets.append(growing.newest)
            if progress is not None:
                progress(number, len(steps))
        return Slam(frames, offsets, growing.optimise(), scale_of(steps))


def travelled(poses: Array) -> float:
    """Length of the trajectory through poses (N, 4, 4)."""
    return float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())
