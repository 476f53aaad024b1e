"""Offline SLAM: from the results of a replay to an optimised trajectory."""

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
from djet_ros.recordings.recording import Recording
import numpy as np


@dataclass(frozen=True)
class Slam:
    """
    The result of a run.

    frames: graph of all frames by odometry; offsets: pose of each frame in its keyframe;
    optimised: graph of the keyframes with links and loops; scale: kind of scale of all lengths.
    """

    frames: PoseGraph
    offsets: Sequence[KeyframeOffset]
    optimised: OptimisedGraph
    scale: Scale

    @property
    def metric(self) -> bool:
        """Whether the odometry's lengths are in metres."""
        return self.scale is Scale.METRIC

    def optimised_poses(self) -> Array:
        """Return the optimised poses (N, 4, 4) of all frames, each fixed in its keyframe."""
        keyframes, factors = self.optimised.graph.poses, self.optimised.factors
        return np.array([
            keyframes[offset.keyframe] @ offset.motion_in_map(factors[offset.keyframe])
            for offset in self.offsets])


def run_slam(steps: Sequence[Step], recording: Recording, config: Config,
             progress: Callable[[int, int], None] | None = None,
             scratch: Path | None = None) -> Slam:
    """
    Select keyframes, find links and loops in the images of a recording, and optimise.

    steps: at least one, from a replay of the recording with this configuration; progress: called
    with (frames done, total frames); scratch: folder for the temporary file with the keyframe
    images. Raises DjetError.
    """
    frames, offsets = graph_of(steps), []
    # Before motions are composed, which would hide an invalid one.
    frames.check()
    frame_at = frame_finder(recording, config)
    with KeyframeFile(scratch) as kept:
        growing = KeyframeMap(config, kept)
        for number, step in enumerate(steps, 1):
            growing.extend(step, frame_at)
            growing.search_loops()
            assert growing.newest is not None
            offsets.append(growing.newest)
            if progress is not None:
                progress(number, len(steps))
        return Slam(frames, offsets, growing.optimise(), scale_of(steps))
