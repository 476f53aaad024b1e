"""A map of keyframes that grows step by step, live or from results, and closes loops."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, MutableMapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from djet_ros.config.sections import Config, SlamConfig
from djet_ros.core.types import Array
from djet_ros.odometry.frame import Frame
from djet_ros.odometry.uncertainty import compose, rotated
from djet_ros.posegraph.backend import optimise, OptimisedGraph
from djet_ros.posegraph.keyframe_images import KeyframeImage
from djet_ros.posegraph.loops import EdgeFinder
from djet_ros.posegraph.pose_graph import Edge, Motion, PoseGraph
from djet_ros.posegraph.steps import Step, untold_motion
from djet_ros.posegraph.units import in_unit, scaled
import numpy as np
from scipy.spatial.transform import Rotation

# Keyframes that may wait for their loops to be sought; until then frames make no more of them.
_WAITING = 20


@dataclass
class Keyframe:
    """
    A keyframe of the map: its stamp and its pose (4, 4) in the map, as it is known now.

    factor: by which lengths in the odometry's unit there are in the map's, which is that of the
    first keyframe that there was.
    """

    stamp_ns: int
    pose: Array
    factor: float = 1.0


@dataclass(frozen=True)
class KeyframeOffset(Motion):
    """
    Where a frame is in its keyframe.

    keyframe: its number; known: whether it is known how the camera came from there, otherwise the
    motion is a guess.
    """

    keyframe: int
    motion: Array = field(default_factory=lambda: np.eye(4))
    covariance: Array = field(default_factory=lambda: np.zeros((6, 6)))
    scale_known: bool = True
    known: bool = True

    def then(self, motion: Array, covariance: Array, scale_known: bool = False,
             known: bool = True) -> KeyframeOffset:
        """Give the offset of the next frame: its motion (4, 4), with covariance (6, 6)."""
        return KeyframeOffset(self.keyframe, self.motion @ motion,
                              compose(self.motion, self.covariance, motion, covariance),
                              self.scale_known and scale_known, self.known and known)

    def is_far(self, config: SlamConfig) -> bool:
        """Tell whether the frame is so far away that it should be a keyframe itself."""
        turn = np.degrees(Rotation.from_matrix(self.motion[:3, :3]).magnitude())
        length = np.linalg.norm(self.motion[:3, 3])
        return bool(length >= config.keyframe_distance or turn >= config.keyframe_turn)

    def edge(self, target: int) -> Edge:
        """Give the edge to the frame, as the keyframe with a number."""
        return Edge(self.keyframe, target, self.motion, self.covariance,
                    'odometry' if self.known else 'unknown', self.scale_known)


class _Unsought(NamedTuple):
    """
    A keyframe whose loops have not been sought yet, and the edge from its neighbour.

    k1: radial distortion without which the odometry saw it.
    """

    frame: Frame
    before: Edge | None
    k1: float


class KeyframeMap:
    """
    Keyframes, the edges between them, and where the odometry's frame lies among them.

    keyframes: those that are kept; first: the number of the oldest of them, by which edges go;
    newest: the offset of the newest frame; correction (4, 4): the odometry's frame in the map, so
    that ``correction @ pose`` is the optimised pose of a frame; imageless: frames that would have
    been keyframes, had their image been there; distrusted: loops that the last optimisation did
    not believe.

    kept: where images of keyframes are kept, in memory unless said otherwise; max_keyframes: what
    bounds the memory, see ``_forget_oldest``; None for no bound.
    """

    def __init__(self, config: Config, kept: MutableMapping[int, KeyframeImage] | None = None,
                 max_keyframes: int | None = None) -> None:
        self._slam = config.slam
        self._uncertainty = config.odometry.scale_uncertainty
        self._max_keyframes = max_keyframes
        self._finder = EdgeFinder(config.estimator, config.slam, kept)
        self.keyframes: deque[Keyframe] = deque()
        self.first = self.optimisations = self.imageless = self.distrusted = 0
        self.correction = np.eye(4)
        self.newest: KeyframeOffset | None = None
        self._newest_step: Step | None = None
        # Of the frames that may be the next step's previous one, by stamp.
        self._offsets: dict[int | None, KeyframeOffset] = {}
        self._chain: list[Edge] = []
        self._found: list[Edge] = []
        # Whether a frame that should have been a keyframe could not be.
        self._due = False
        self._unsought: deque[_Unsought] = deque()
        self._sought = 0
        # Whether all lengths so far are in metres, so that no unit of them drifts.
        self._metric = True

    @property
    def edges(self) -> list[Edge]:
        """Edges by the numbers in which keyframes came: of neighbours, then links and loops."""
        return [*self._chain, *self._found]

    @property
    def waiting(self) -> int:
        """Count the keyframes whose loops have not been sought yet."""
        return len(self._unsought)

    def count(self, kind: str) -> int:
        """Count the edges of a kind."""
        return sum(edge.kind == kind for edge in self.edges)

    def extend(self, step: Step, image: Callable[[int], Frame | None]) -> None:
        """
        Take the next step, whose frame may become a keyframe.

        image: gives the frame of a stamp, or None where its image has not come. A frame without
        one is no keyframe; the next one may be.
        """
        offset = self._offset(step)
        self._metric = self._metric and (step.metric or not step.scale_known)
        frame = None
        self._due = self._due or self._is_keyframe(step, offset)
        if self._due and len(self._unsought) < _WAITING:
            frame = image(step.stamp_ns)
            self.imageless += frame is None
        if frame is not None:
            self._due = False
            offset = self._add(step, frame, offset)
        if offset is None:
            return
        reference = self._offsets.get(step.previous_stamp_ns)
        self._offsets = {step.stamp_ns: offset}
        if step.tracked and reference is not None:
            # It may be the next step's previous frame again: then the camera was stationary, and
            # this keyframe is as good for both.
            self._offsets[step.previous_stamp_ns] = reference if frame is None else \
                KeyframeOffset(offset.keyframe, np.asarray(np.linalg.inv(step.motion)))
        self.newest, self._newest_step = offset, step

    def _is_keyframe(self, step: Step, offset: KeyframeOffset | None) -> bool:
        """Tell whether a step's frame should be a keyframe."""
        if offset is None or not offset.known:
            return True
        if step.keyframe is None or self._slam.keyframes == 'distance':
            return offset.is_far(self._slam)
        return step.keyframe

    def _offset(self, step: Step) -> KeyframeOffset | None:
        """Offset of a step's frame; if the odometry began anew, its frame moves in the map."""
        if self.newest is None or self._newest_step is None:
            return None
        reference = self._offsets.get(step.previous_stamp_ns)
        if step.tracked and reference is not None:
            covariance = step.own_covariance(self._uncertainty, self._slam.length_noise)
            return reference.then(step.motion, covariance, step.scale_known)
        guess, covariance = untold_motion(self._newest_step, step)
        if not step.in_frame_of(self._newest_step):
            # Where the camera was last is as good a guess as any.
            self.correction = (self.correction @ self._newest_step.pose
                               @ np.linalg.inv(step.pose))
            guess = np.eye(4)
        return self.newest.then(guess, covariance, known=False)

    def _add(self, step: Step, frame: Frame, offset: KeyframeOffset | None) -> KeyframeOffset:
        number = self.first + len(self.keyframes)
        before = None if offset is None else offset.edge(number)
        if before is not None:
            self._chain.append(before)
        factor = self.keyframes[-1].factor if self.keyframes else 1.0
        self.keyframes.append(Keyframe(step.stamp_ns, self.correction @ step.pose, factor))
        self._unsought.append(_Unsought(frame, before, step.k1))
        if self._max_keyframes is not None and len(self.keyframes) > self._max_keyframes:
            self._forget_oldest()
        return KeyframeOffset(number)

    def seek(self) -> bool:
        """Seek the loops of one keyframe that waits; tells whether edges were found."""
        if not self._unsought:
            return False
        number = self._sought
        frame, before, k1 = self._unsought.popleft()
        self._finder.add(frame, before, k1)
        self._sought += 1
        self._finder.forget(min(self.first, self._sought))
        # Without a step before it a loop has no length, nor anything that bears it out: the next
        # keyframe will have one.
        if number < self.first or before is None or before.kind != 'odometry':
            return False
        found = [*self._finder.links(number), *self._finder.loops(number, units=not self._metric)]
        self._found += found
        return bool(found)

    def optimise(self) -> OptimisedGraph:
        """Move the keyframes, at least one, to where the edges want them; see ``optimise``."""
        assert self.newest is not None
        assert self._newest_step is not None
        edges = tuple(replace(
            edge.in_graph(), source=edge.source - self.first, target=edge.target - self.first)
            for edge in self.edges)
        optimised = optimise(PoseGraph(
            np.array([one.stamp_ns for one in self.keyframes]),
            np.array([one.pose for one in self.keyframes]), edges), self.keyframes[0].factor)
        for keyframe, pose, factor in zip(self.keyframes, optimised.graph.poses,
                                          optimised.factors.tolist()):
            keyframe.pose, keyframe.factor = pose, factor
        self.distrusted = optimised.rejected('loop')
        newest = self.newest.keyframe - self.first
        here = self.keyframes[newest].pose @ in_unit(
            self.newest.motion, float(optimised.factors[newest]))
        self.correction = here @ np.linalg.inv(self._newest_step.pose)
        self.optimisations += 1
        return optimised

    def _forget_oldest(self) -> None:
        """
        Hold the oldest keyframe where it is now, relative to the one after it, and forget it.

        That one is then the first, which every optimisation holds. What was known by the
        forgotten one is known by it from now on.
        """
        oldest, heir = self.first, self.first + 1
        self._chain, self._found = (
            [self._left_to_heir(edge) if oldest in (edge.source, edge.target) else edge
             for edge in edges if {edge.source, edge.target} != {oldest, heir}]
            for edges in (self._chain, self._found))
        self.keyframes.popleft()
        self.first = heir

    def _left_to_heir(self, edge: Edge) -> Edge:
        """Hang an edge, which has the unit of its source, on the keyframe after the oldest."""
        oldest, heir = self.keyframes[0], self.keyframes[1]
        change = heir.factor / oldest.factor
        if edge.source == self.first:
            edge = scaled(edge, 1 / change)
        source = self.keyframes[max(edge.source - self.first, 1)]
        between = np.asarray(np.linalg.inv(oldest.pose) @ heir.pose)
        return inherited(edge, self.first, in_unit(between, 1 / source.factor), change)


def inherited(edge: Edge, oldest: int, between: Array, change: float = 1.0) -> Edge:
    """
    Hang an edge of a keyframe on the one after it, ``between`` (4, 4) in the former.

    Wherever the edge's other end is, the edge finds it as likely as before. change: the unit of
    lengths at the one after over that at the keyframe; motions are in that of the edge's source.
    """
    sign = 1 if edge.target == oldest else -1
    if edge.stretch is not None:
        edge = replace(edge, stretch=(edge.stretch[0] + sign * float(np.log(change)),
                                      edge.stretch[1]))
    if edge.target == oldest:
        return replace(edge, target=oldest + 1, motion=edge.motion @ between,
                       covariance=compose(edge.motion, edge.covariance, between,
                                          np.zeros((6, 6))))
    back = np.asarray(np.linalg.inv(between))
    return replace(edge, source=oldest + 1, motion=back @ edge.motion,
                   covariance=rotated(back[:3, :3], edge.covariance))
