"""The steps of an odometry's trajectory, and their pose graph."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from djet_ros.core.correction import AS_CALIBRATED, Correction
from djet_ros.core.types import Array, Status, TRACKED
from djet_ros.odometry.scale import Scale
from djet_ros.odometry.uncertainty import inflated_for_chain, symmetric, UNKNOWN_MOTION
from djet_ros.posegraph.pose_graph import Edge, Motion, PoseGraph
import numpy as np

# Variance in rad² above which a rotation counts as unknown; and growth of the variance of a pose,
# relative to its trace, below which it is rounding.
_MAX_ROTATION_VARIANCE, _ROUNDING = 1.0, 1e-12


@dataclass(frozen=True)
class Step(Motion):
    """
    A frame processed by the odometry, in optical axes.

    stamp_ns, status: of the frame; pose (4, 4): the camera in the odometry's frame;
    previous_stamp_ns: of the reference frame of the motion, or None; motion (4, 4), covariance
    (6, 6): the camera in the reference frame, if estimated; odom_frame: frame id of the odometry,
    if from messages; metric: whether a known length is in metres; keyframe: whether the frame is
    a keyframe of the odometry, None if it has none or this is not known; camera_correction:
    what the odometry had found by its landmarks, and corrected in the frame; rotation_covariance:
    (3, 3) of the pose, in the axes of the odometry's frame, or None.
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
    camera_correction: Correction = AS_CALIBRATED
    rotation_covariance: Array | None = None

    @property
    def tracked(self) -> bool:
        """Whether the motion from a reference frame was estimated."""
        return self.status in TRACKED and self.previous_stamp_ns is not None

    def in_frame_of(self, before: Step) -> bool:
        """Return whether the odometry's frame is that of an earlier step; a gap keeps it."""
        return self.status is not Status.FIRST_FRAME and self.stamp_ns >= before.stamp_ns


def scale_of(steps: Iterable[Step]) -> Scale:
    """Return the kind of scale of a trajectory: unknown if a length is, or if there is none."""
    steps = [step for step in steps if step.status is Status.OK]
    if not steps or not all(step.scale_known for step in steps):
        return Scale.UNKNOWN
    return Scale.METRIC if all(step.metric for step in steps) else Scale.RELATIVE


def unobserved_motion(before: Step, step: Step) -> tuple[Array, Array]:
    """
    Return motion (4, 4) and covariance (6, 6) between consecutive steps without an estimate.

    At a failed pair or over a gap the odometry may still have a rotation, from a gyro or from a
    pair with an ambiguous translation; the growth of its covariance is that of the poses. The
    translation is unknown.
    """
    covariance = UNKNOWN_MOTION.copy()
    if step.rotation_covariance is not None and before.rotation_covariance is not None \
            and not step.tracked and step.in_frame_of(before):
        back = before.pose[:3, :3].T
        grown = symmetric(back @ (step.rotation_covariance - before.rotation_covariance) @ back.T)
        variances = np.linalg.eigvalsh(grown)
        if (variances[0] > _ROUNDING * np.trace(step.rotation_covariance)
                and variances[-1] < _MAX_ROTATION_VARIANCE):
            covariance[3:, 3:] = inflated_for_chain(grown)
    return np.asarray(np.linalg.inv(before.pose) @ step.pose), covariance


def graph_of(steps: Sequence[Step]) -> PoseGraph:
    """
    Return the graph whose vertices are the frames of the steps.

    A step without an estimated motion gets an edge of kind 'unknown' from the step before, which
    keeps the graph connected. Raises KeyError if a reference frame is not among earlier steps.
    """
    vertex: dict[int | None, int] = {}
    edges = []
    for i, step in enumerate(steps):
        if step.tracked:
            edges.append(Edge(vertex[step.previous_stamp_ns], i, step.motion, step.covariance,
                              scale_known=step.scale_known))
        elif i:
            edges.append(Edge(i - 1, i, *unobserved_motion(steps[i - 1], step), 'unknown', False))
        vertex[step.stamp_ns] = i
    return PoseGraph(np.array([step.stamp_ns for step in steps], np.int64),
                     np.array([step.pose for step in steps]).reshape(-1, 4, 4), tuple(edges))
