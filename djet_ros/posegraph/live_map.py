"""A map that grows while the odometry goes on, and closes loops with itself."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

from djet_ros.config.sections import SlamConfig
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.types import Array
from djet_ros.odometry.frame import Frame
from djet_ros.odometry.uncertainty import compose, rotated
from djet_ros.posegraph.backend import optimise
from djet_ros.posegraph.graph import Edge, PoseGraph
from djet_ros.posegraph.keyframes import Hanging
from djet_ros.posegraph.loops import EdgeFinder
from djet_ros.posegraph.steps import Step
import numpy as np

# Keyframes that may wait for their loops to be sought; until then frames make no more of them.
_WAITING = 20


@dataclass
class Keyframe:
    """A keyframe of the map: its stamp and its pose (4, 4) in the map, as it is known now."""

    stamp_ns: int
    pose: Array


class _Unsought(NamedTuple):
    """A keyframe whose loops have not been sought yet, and the edge from its neighbour."""

    frame: Frame
    before: Edge | None


class LiveMap:
    """
    Keyframes, the edges between them, and where the odometry's frame lies among them.

    keyframes: those that are kept; edges: between them, by the numbers in which they came, the
    oldest kept one being ``first``; correction (4, 4): the odometry's frame in the map, so that
    ``correction @ pose`` is the optimised pose of a frame; trust: by edge, of the last
    optimisation; imageless: frames that would have been keyframes, had their image been there.

    The memory is bounded by ``max_keyframes``: see ``_forget_oldest``.
    """

    def __init__(self, estimator: EstimatorConfig, config: SlamConfig) -> None:
        self._config = config
        self._finder = EdgeFinder(estimator, config)
        self.keyframes: deque[Keyframe] = deque()
        self.edges: list[Edge] = []
        self.first = self.optimisations = self.imageless = self.distrusted = 0
        self.correction = np.eye(4)
        self._unsought: deque[_Unsought] = deque()
        self._sought = 0
        # How the frame that the next motion is told from hangs, and where the odometry saw it.
        self._there: Hanging | None = None
        self._there_in_odom = np.eye(4)
        self._hole = False
        self._stamp_ns = self._optimised_ns = 0
        self._changed = False

    @property
    def waiting(self) -> int:
        """Count the keyframes whose loops have not been sought yet."""
        return len(self._unsought)

    def count(self, kind: str) -> int:
        """Count the edges of a kind."""
        return sum(edge.kind == kind for edge in self.edges)

    def extend(self, step: Step, image: Callable[[int], Frame | None]) -> bool:
        """
        Take the next frame; tells whether it became a keyframe.

        image: gives the frame of a stamp, or None where its image has not come. A frame without
        one is no keyframe; the next one may be.
        """
        self._stamp_ns = step.stamp_ns
        here = Hanging(0)
        if self._there is not None and step.edge is not None:
            here = self._there.then(step.edge.motion, step.edge.covariance,
                                    step.edge.scale_known)
            self._hole |= step.edge.kind == 'unknown'
            if step.anew:
                # Where the camera was last is as good a guess as any.
                self.correction = self.correction @ self._there_in_odom @ np.linalg.inv(step.pose)
        wanted = self._there is None or self._hole or here.is_far(self._config)
        frame = None
        if wanted and len(self._unsought) < _WAITING:
            frame = image(step.stamp_ns)
            self.imageless += frame is None
        if frame is not None:
            here = self._add(step, frame, here)
        elif self._there is None:
            return False
        if frame is not None or not step.standing:
            self._there, self._there_in_odom = here, step.pose
        return frame is not None

    def _add(self, step: Step, frame: Frame, here: Hanging) -> Hanging:
        number = self.first + len(self.keyframes)
        before = None
        if self._there is not None:
            before = Edge(here.keyframe, number, here.offset, here.covariance,
                          'unknown' if self._hole else 'odometry', here.scale_known)
            self.edges.append(before)
        self.keyframes.append(Keyframe(step.stamp_ns, self.correction @ step.pose))
        self._unsought.append(_Unsought(frame, before))
        self._hole = False
        if len(self.keyframes) > self._config.max_keyframes:
            self._forget_oldest()
        return Hanging(number)

    def work(self, *, at_once: bool = False) -> bool:
        """
        Seek the loops of one keyframe that waits, and optimise if it is time for it.

        at_once: also where the last optimisation was not long ago. Tells whether anything was
        optimised. Raises DjetError where an edge can't be used.
        """
        if self._unsought:
            number = self._sought
            frame, before = self._unsought.popleft()
            self._finder.add(frame, before)
            self._sought += 1
            self._finder.forget(min(self.first, self._sought))
            # Without a step before it a loop has no length, nor anything that bears it out: the
            # next keyframe will have one.
            if number >= self.first and before is not None and before.kind == 'odometry':
                found = [*self._finder.links(number), *self._finder.loops(number)]
                self.edges += found
                self._changed |= bool(found)
        period = self._config.optimise_period * 1e9
        due = at_once or self._stamp_ns - self._optimised_ns >= period
        if not self._changed or not due:
            return False
        self._optimise()
        return True

    def _optimise(self) -> None:
        assert self._there is not None
        edges = tuple(replace(edge, source=edge.source - self.first,
                              target=edge.target - self.first) for edge in self.edges)
        solution = optimise(PoseGraph(
            np.array([one.stamp_ns for one in self.keyframes]),
            np.array([one.pose for one in self.keyframes]), edges))
        for keyframe, pose in zip(self.keyframes, solution.graph.poses):
            keyframe.pose = pose
        self.distrusted = sum(bool(edge.kind == 'loop' and trust < 0.5)
                              for edge, trust in zip(edges, solution.trust))
        there = self.keyframes[self._there.keyframe - self.first].pose @ self._there.offset
        self.correction = there @ np.linalg.inv(self._there_in_odom)
        self._optimised_ns, self._changed = self._stamp_ns, False
        self.optimisations += 1

    def _forget_oldest(self) -> None:
        """
        Hold the oldest keyframe where it is now, relative to the one after it, and forget it.

        That one is then the first, which every optimisation holds. What was known by the
        forgotten one is known by it from now on.
        """
        oldest, heir = self.first, self.first + 1
        between = np.linalg.inv(self.keyframes[0].pose) @ self.keyframes[1].pose
        self.keyframes.popleft()
        self.first = heir
        self.edges = [inherited(edge, oldest, between) if oldest in (edge.source, edge.target)
                      else edge for edge in self.edges
                      if {edge.source, edge.target} != {oldest, heir}]


def inherited(edge: Edge, oldest: int, between: Array) -> Edge:
    """
    Hang an edge of a keyframe on the one after it, ``between`` (4, 4) in the former.

    Wherever the edge's other end is, the edge finds it as likely as before.
    """
    if edge.target == oldest:
        return replace(edge, target=oldest + 1, motion=edge.motion @ between,
                       covariance=compose(edge.motion, edge.covariance, between,
                                          np.zeros((6, 6))))
    back = np.asarray(np.linalg.inv(between))
    return replace(edge, source=oldest + 1, motion=back @ edge.motion,
                   covariance=rotated(back[:3, :3], edge.covariance))
