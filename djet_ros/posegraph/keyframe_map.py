"""An incremental map of keyframes with loop closure, for live and offline use."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, MutableMapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from djet_ros.config.sections import Config, SlamConfig
from djet_ros.core.correction import Correction
from djet_ros.core.types import Array
from djet_ros.odometry.frame import Frame
from djet_ros.odometry.uncertainty import compose, of_inverse, rotated
from djet_ros.posegraph.backend import optimise, OptimisedGraph
from djet_ros.posegraph.keyframe_images import KeyframeImage
from djet_ros.posegraph.loops import EdgeFinder
from djet_ros.posegraph.pose_graph import Edge, Motion, PoseGraph
from djet_ros.posegraph.steps import Step, unobserved_motion
from djet_ros.posegraph.units import rescaled_edge, rescaled_motion
import numpy as np
from scipy.spatial.transform import Rotation

# Keyframes that may be queued for the loop search; while it is full no keyframes are added.
_MAX_PENDING = 20


@dataclass
class Keyframe:
    """
    A keyframe of the map: its stamp and its current pose (4, 4) in the map.

    factor: scale factor from the odometry's unit of length at this keyframe to that of the map,
    which is the metre if any lengths are metric, else the unit at the very first keyframe.
    """

    stamp_ns: int
    pose: Array
    factor: float = 1.0


@dataclass(frozen=True)
class KeyframeOffset(Motion):
    """
    The pose of a frame in its keyframe, with covariance.

    keyframe: number of the keyframe; known: whether the whole motion from there was estimated,
    otherwise it is a guess; uncorrelated: see ``Edge``; metric: whether all lengths since the
    keyframe are in metres, None at the keyframe itself.
    """

    keyframe: int
    motion: Array = field(default_factory=lambda: np.eye(4))
    covariance: Array = field(default_factory=lambda: np.zeros((6, 6)))
    scale_known: bool = True
    known: bool = True
    uncorrelated: Array = field(default_factory=lambda: np.zeros((3, 3)))
    metric: bool | None = None

    def then(self, step: Step, config: SlamConfig, uncertainty: float) -> KeyframeOffset:
        """
        Return the offset of the next frame, from the step to it.

        uncertainty: relative standard deviation of metric lengths.
        """
        # Lengths in the unit of the track have no error in common, and landmarks carry theirs on.
        noise = config.length_noise if step.metric else 0.0
        covariance = step.independent_covariance(uncertainty if step.metric else 0.0, noise)
        own = replace(step, covariance=covariance).length_noise(noise)
        R, motion = self.motion[:3, :3], self.motion @ step.motion
        covariance = compose(self.motion, self.covariance, step.motion, covariance)
        scale_known = self.scale_known and step.scale_known
        # The first measured length changes the unit, and a sum of both units has no meaning.
        if scale_known and step.metric and self.metric is False:
            translation = np.pad(motion[:3, 3], (0, 3))
            covariance, scale_known = covariance + np.outer(translation, translation), False
        return KeyframeOffset(self.keyframe, motion, covariance, scale_known, self.known,
                              self.uncorrelated + R @ own @ R.T,
                              step.metric and self.metric is not False)

    def before(self, step: Step, config: SlamConfig, uncertainty: float) -> KeyframeOffset:
        """Return the offset of the frame before a keyframe, from the step to it."""
        step_alone = KeyframeOffset(self.keyframe).then(step, config, uncertainty)
        R = step.motion[:3, :3]
        return replace(step_alone, motion=np.asarray(np.linalg.inv(step.motion)),
                       covariance=of_inverse(step.motion, step_alone.covariance),
                       uncorrelated=R.T @ step_alone.uncorrelated @ R)

    def guessed(self, motion: Array, covariance: Array) -> KeyframeOffset:
        """Return the offset of the next frame, from a guess (4, 4) with covariance (6, 6)."""
        return KeyframeOffset(self.keyframe, self.motion @ motion,
                              compose(self.motion, self.covariance, motion, covariance),
                              scale_known=False, known=False)

    def is_far(self, config: SlamConfig) -> bool:
        """Return whether the frame is far enough away to be a keyframe itself."""
        turn = np.degrees(Rotation.from_matrix(self.motion[:3, :3]).magnitude())
        length = np.linalg.norm(self.motion[:3, 3])
        return bool(length >= config.keyframe_distance or turn >= config.keyframe_turn)

    def motion_in_map(self, factor: float) -> Array:
        """
        Return the motion (4, 4) in the map's unit of length; factor: see ``Keyframe``.

        Before the first metric edge that is the unit of the keyframe, but metres stay metres.
        """
        return self.motion if self.metric else rescaled_motion(self.motion, factor)

    def edge(self, target: int) -> Edge:
        """Return the edge to the frame as keyframe number target."""
        return Edge(self.keyframe, target, self.motion, self.covariance,
                    'odometry' if self.known else 'unknown', self.scale_known,
                    uncorrelated=self.uncorrelated,
                    metric=self.scale_known and bool(self.metric))


class _Pending(NamedTuple):
    """
    A keyframe that is queued for the loop search, and the edge from its predecessor.

    camera_correction: what the odometry had corrected in it.
    """

    frame: Frame
    before: Edge | None
    camera_correction: Correction


class KeyframeMap:
    """
    Keyframes, the edges between them, and the pose of the odometry's frame in the map.

    keyframes: the current keyframes; first: number of the oldest of them, as used in edges;
    newest: offset of the newest frame; correction: (4, 4) pose of the odometry's frame in the
    map, so that ``correction @ pose`` is the optimised pose of a frame; without_image: number of
    frames that could not become keyframes for lack of an image; rejected_loops: number of loops
    that the last optimisation rejected.

    kept: storage of the keyframe images, in memory by default; max_keyframes: limit of the number
    of keyframes, see ``_forget_oldest``; None for no limit.
    """

    def __init__(self, config: Config, kept: MutableMapping[int, KeyframeImage] | None = None,
                 max_keyframes: int | None = None) -> None:
        self._slam = config.slam
        self._uncertainty = config.odometry.scale_uncertainty
        self._max_keyframes = max_keyframes
        self._finder = EdgeFinder(config.estimator, config.slam, kept)
        self.keyframes: deque[Keyframe] = deque()
        self.first = self.optimisations = self.without_image = self.rejected_loops = 0
        self.correction = np.eye(4)
        self.newest: KeyframeOffset | None = None
        self._newest_step: Step | None = None
        # Of the frames that may be the reference of the next step, by stamp.
        self._offsets: dict[int | None, KeyframeOffset] = {}
        self._chain: list[Edge] = []
        self._found: list[Edge] = []
        # Whether a keyframe is overdue, as an earlier frame could not become one.
        self._due = False
        self._pending: deque[_Pending] = deque()
        self._searched = 0
        # Whether all lengths so far are in metres, so that there is no scale drift.
        self._metric = True
        # Scale factor from the odometry's unit of length, as it is now, to that of the map.
        self._factor = 1.0

    @property
    def edges(self) -> list[Edge]:
        """Return all edges by keyframe numbers: of consecutive ones, then links and loops."""
        return [*self._chain, *self._found]

    @property
    def waiting(self) -> int:
        """Return the number of keyframes queued for the loop search."""
        return len(self._pending)

    def count(self, kind: str) -> int:
        """Return the number of edges of a kind."""
        return sum(edge.kind == kind for edge in self.edges)

    def extend(self, step: Step, image: Callable[[int], Frame | None]) -> None:
        """
        Add the next step of the odometry; its frame may become a keyframe.

        image: function from a stamp to its frame, or None if its image is missing. Such a frame
        cannot be a keyframe, and the next frame is tried.
        """
        self._carry_on(step)
        offset = self._offset(step)
        self._metric = self._metric and (step.metric or not step.scale_known)
        frame = None
        self._due = self._due or self._is_keyframe(step, offset)
        if self._due and len(self._pending) < _MAX_PENDING:
            frame = image(step.stamp_ns)
            self.without_image += frame is None
        if frame is not None:
            self._due = False
            offset = self._add(step, frame, offset)
        if offset is None:
            return
        reference = self._offsets.get(step.previous_stamp_ns)
        self._offsets = {step.stamp_ns: offset}
        if step.tracked and reference is not None:
            # The reference may remain that of the next step: then the camera was stationary, and
            # this keyframe serves both frames.
            self._offsets[step.previous_stamp_ns] = reference if frame is None else \
                offset.before(step, self._slam, self._uncertainty)
        self.newest, self._newest_step = offset, step

    def _is_keyframe(self, step: Step, offset: KeyframeOffset | None) -> bool:
        """Return whether the frame of a step should become a keyframe."""
        if offset is None or not offset.known:
            return True
        if step.keyframe is None or self._slam.keyframes == 'distance':
            return offset.is_far(self._slam)
        return step.keyframe

    def _carry_on(self, step: Step) -> None:
        """
        Move the odometry's frame in the map, so that the pose of a step continues the last one.

        After a reset of the odometry the best guess is the last pose. In a unit that loops have
        corrected each motion is scaled, which a fixed transform between the frames cannot do.
        """
        before = self._newest_step
        if before is None:
            return
        if step.metric and step.scale_known:
            self._factor = 1.0
        continues, factor = step.in_frame_of(before), self._factor
        if continues and factor == 1.0:
            return
        motion = np.linalg.inv(before.pose) @ step.pose if continues else np.eye(4)
        self.correction = (self.correction @ before.pose @ rescaled_motion(motion, factor)
                           @ np.linalg.inv(step.pose))

    def _offset(self, step: Step) -> KeyframeOffset | None:
        """Return the offset of a step's frame from its keyframe; None if it is the first."""
        if self.newest is None or self._newest_step is None:
            return None
        reference = self._offsets.get(step.previous_stamp_ns)
        if step.tracked and reference is not None:
            return reference.then(step, self._slam, self._uncertainty)
        guess, covariance = unobserved_motion(self._newest_step, step)
        if not step.in_frame_of(self._newest_step):
            guess = np.eye(4)
        return self.newest.guessed(guess, covariance)

    def _add(self, step: Step, frame: Frame, offset: KeyframeOffset | None) -> KeyframeOffset:
        number = self.first + len(self.keyframes)
        before = None if offset is None else offset.edge(number)
        if before is not None:
            self._chain.append(before)
        self.keyframes.append(Keyframe(step.stamp_ns, self.correction @ step.pose, self._factor))
        self._pending.append(_Pending(frame, before, step.camera_correction))
        if self._max_keyframes is not None and len(self.keyframes) > self._max_keyframes:
            self._forget_oldest()
        return KeyframeOffset(number)

    def search_loops(self) -> bool:
        """Search loops and links of one queued keyframe; return whether edges were found."""
        if not self._pending:
            return False
        number = self._searched
        frame, before, correction = self._pending.popleft()
        self._finder.add(frame, before, correction)
        self._searched += 1
        self._finder.forget(min(self.first, self._searched))
        # Without an odometry edge to its predecessor, the length of a loop cannot be determined:
        # the next keyframe will have one.
        if number < self.first or before is None or before.kind != 'odometry':
            return False
        found = [*self._finder.links(number), *self._finder.loops(number, units=not self._metric)]
        self._found += found
        return bool(found)

    def optimise(self) -> OptimisedGraph:
        """Optimise the poses of the keyframes, of which there is at least one."""
        assert self.newest is not None
        assert self._newest_step is not None
        edges = tuple(replace(
            edge.inflated(), source=edge.source - self.first, target=edge.target - self.first)
            for edge in self.edges)
        optimised = optimise(PoseGraph(
            np.array([one.stamp_ns for one in self.keyframes]),
            np.array([one.pose for one in self.keyframes]), edges), self.keyframes[0].factor)
        for keyframe, pose, factor in zip(self.keyframes, optimised.graph.poses,
                                          optimised.factors.tolist()):
            keyframe.pose, keyframe.factor = pose, factor
        self.rejected_loops = optimised.rejected('loop')
        newest = self.keyframes[self.newest.keyframe - self.first]
        self._factor = 1.0 if self.newest.metric else newest.factor
        self.correction = (newest.pose @ self.newest.motion_in_map(newest.factor)
                           @ np.linalg.inv(self._newest_step.pose))
        self.optimisations += 1
        return optimised

    def _forget_oldest(self) -> None:
        """
        Remove the oldest keyframe, and transfer its edges to the next one.

        The relative pose of the two is fixed at its current value. The next keyframe becomes the
        first one, which every optimisation keeps fixed.
        """
        oldest, successor = self.first, self.first + 1
        self._chain, self._found = (
            [self._transfer(edge) if oldest in (edge.source, edge.target) else edge
             for edge in edges if {edge.source, edge.target} != {oldest, successor}]
            for edges in (self._chain, self._found))
        self.keyframes.popleft()
        self.first = successor

    def _transfer(self, edge: Edge) -> Edge:
        """Transfer an edge, which is in the unit of its source, from the oldest keyframe."""
        oldest, successor = self.keyframes[0], self.keyframes[1]
        change = successor.factor / oldest.factor
        if edge.source == self.first:
            edge = rescaled_edge(edge, 1 / change)
        source = self.keyframes[max(edge.source - self.first, 1)]
        between = np.asarray(np.linalg.inv(oldest.pose) @ successor.pose)
        return transferred(edge, self.first, rescaled_motion(between, 1 / source.factor), change)


def transferred(edge: Edge, oldest: int, between: Array, change: float = 1.0) -> Edge:
    """
    Transfer an edge of a keyframe to the next one, whose pose in it is ``between`` (4, 4).

    The likelihood of the pose at the other end does not change. change: unit of length at the
    next keyframe relative to that at the keyframe; motions are in the unit of the edge's source.
    """
    sign = 1 if edge.target == oldest else -1
    if edge.log_scale_ratio is not None:
        ratio, sigma = edge.log_scale_ratio
        edge = replace(edge, log_scale_ratio=(ratio + sign * float(np.log(change)), sigma))
    if edge.target == oldest:
        return replace(edge, target=oldest + 1, motion=edge.motion @ between,
                       covariance=compose(edge.motion, edge.covariance, between,
                                          np.zeros((6, 6))))
    back = np.asarray(np.linalg.inv(between))
    return replace(edge, source=oldest + 1, motion=back @ edge.motion,
                   covariance=rotated(back[:3, :3], edge.covariance))
