"""The steps of a trajectory as an odometry estimates them, and the graph of them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from djet_ros.core.types import Array, Status, TRACKED
from djet_ros.odometry.scale import Scale
from djet_ros.odometry.uncertainty import in_a_chain, symmetric, UNKNOWN_MOTION
from djet_ros.posegraph.pose_graph import Edge, Motion, PoseGraph
import numpy as np

# Variance in rad² above which a turn is as good as unknown; and the share of a pose's variances
# below which what they have grown by is rounding.
_TOLD, _ROUNDING = 1.0, 1e-12


@dataclass(frozen=True)
class Step(Motion):
    """
    A frame that the odometry processed, along optical axes.

    stamp_ns, status: of the frame; pose (4, 4): the camera in the odometry's frame;
    previous_stamp_ns: of the frame that it was related to, or None; motion (4, 4), covariance
    (6, 6): from there to here, where that is known; odom_frame: name of the odometry's frame,
    where messages say it; metric: whether a known length is in metres; keyframe: whether the
    odometry took the frame for a keyframe, None where it takes none or that is not known; k1:
    radial distortion that its landmarks had shown, without which it saw the frame; turn: (3, 3)
    covariance of the pose's rotation, along the axes of the odometry's frame, where it is told.
    """

    stamp_ns: int
    status: Status
    pose: Array
    previous_stamp_ns: int | None = None
    motion: Array = field(default_factory=lambda: np.eye(4))
    covariance: Array = field(default_factory=lambda: UNKNOWN_MOTION)
    scale_known: bool = False
    odom_frame: str = ''
    metric: bool = True
    keyframe: bool | None = None
    k1: float = 0.0
    turn: Array | None = None

    @property
    def tracked(self) -> bool:
        """Whether it is known how the camera came here from the previous frame."""
        return self.status in TRACKED and self.previous_stamp_ns is not None

    def in_frame_of(self, before: Step) -> bool:
        """Whether the odometry's frame is that of a step before: over a gap it stays."""
        return self.status is not Status.FIRST_FRAME and self.stamp_ns >= before.stamp_ns


def scale_of(steps: Iterable[Step]) -> Scale:
    """Tell what all lengths of a trajectory are in: unknown where one of them is."""
    steps = [step for step in steps if step.status is Status.OK]
    if not all(step.scale_known for step in steps):
        return Scale.UNKNOWN
    return Scale.METRIC if all(step.metric for step in steps) else Scale.RELATIVE


def untold_motion(before: Step, step: Step) -> tuple[Array, Array]:
    """
    Motion (4, 4) and covariance (6, 6) from one step to the next that is not told from it.

    At a bad pair or over a gap the odometry's pose may have been turned, by a gyro or by a pair
    whose direction is in doubt; how sure that is its poses say. Of the way nothing is known.
    """
    covariance = UNKNOWN_MOTION.copy()
    if step.turn is not None and before.turn is not None \
            and not step.tracked and step.in_frame_of(before):
        back = before.pose[:3, :3].T
        grown = symmetric(back @ (step.turn - before.turn) @ back.T)
        variances = np.linalg.eigvalsh(grown)
        if variances[0] > _ROUNDING * np.trace(step.turn) and variances[-1] < _TOLD:
            covariance[3:, 3:] = in_a_chain(grown)
    return np.asarray(np.linalg.inv(before.pose) @ step.pose), covariance


def graph_of(steps: Sequence[Step]) -> PoseGraph:
    """
    Give the graph whose vertices are the frames of steps.

    Where nothing is known of a way, an edge of kind 'unknown' from the step before keeps the
    graph in one piece. KeyError where a step's previous frame is not among those before it.
    """
    vertex: dict[int | None, int] = {}
    edges = []
    for i, step in enumerate(steps):
        if step.tracked:
            edges.append(Edge(vertex[step.previous_stamp_ns], i, step.motion, step.covariance,
                              scale_known=step.scale_known))
        elif i:
            edges.append(Edge(i - 1, i, *untold_motion(steps[i - 1], step), 'unknown', False))
        vertex[step.stamp_ns] = i
    return PoseGraph(np.array([step.stamp_ns for step in steps], np.int64),
                     np.array([step.pose for step in steps]).reshape(-1, 4, 4), tuple(edges))
