"""Pose graph optimisation with GTSAM."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import compress
from typing import Any, NamedTuple

from djet_ros.core.types import Array
from djet_ros.posegraph.pose_graph import PoseGraph
from djet_ros.posegraph.units import to_common_unit
import gtsam
import numpy as np
from numpy.typing import NDArray

# GTSAM's tangent vectors have the rotation before the translation.
_ORDER = [3, 4, 5, 0, 1, 2]

# Standard deviation of the prior on the first pose, which fixes the gauge.
_PRIOR_SIGMA = 1e-6

# Kinds of edges without a robust kernel.
_KNOWN_INLIERS = ('odometry', 'unknown')

# Scale of the kernel: the 99 % bound of chi-squared with six degrees of freedom. And the weight of
# an edge there.
_BOUND, _REJECTED = 16.812, 0.25

# Chi-squared of all odometry edges over their degrees of freedom, beyond which the loops may be
# wrong; chosen: with small images, whose covariances are too small, true loops give up to 1.3, and
# wrong ones between equal houses 2 to 100.
_STRAINED = 3.0


@dataclass(frozen=True)
class OptimisedGraph:
    """
    A graph with optimised poses.

    trust: (E,) final weights of the edges in the robust kernel, 0 to 1; factors: (N,) scale
    factors from the unit of length at each vertex to that of the graph, see ``units``.
    """

    graph: PoseGraph
    trust: Array
    factors: Array

    @property
    def accepted(self) -> PoseGraph:
        """Return the graph without the edges that contradict it, beyond their 99 % bound."""
        return replace(self.graph, edges=tuple(compress(self.graph.edges, self._kept)))

    def rejected(self, kind: str) -> int:
        """Return the number of edges of a kind that are not in the accepted graph."""
        return sum(edge.kind == kind for edge in compress(self.graph.edges, ~self._kept))

    @property
    def _kept(self) -> NDArray[np.bool_]:
        return np.asarray(self.trust >= _REJECTED)


def optimise(graph: PoseGraph, first: float = 1.0) -> OptimisedGraph:
    """
    Optimise the poses of a graph.

    first: scale factor from the unit of length at the first vertex to that of the graph.

    Links and loops may be outliers and have a robust kernel: Geman-McClure by graduated
    non-convexity (Yang et al., RA-L 2020), which does not depend on the drift of the initial
    poses. Raises DjetError, naming the edge, if a covariance cannot be inverted.
    """
    graph.check()
    graph, factors = to_common_unit(graph, first)
    parameters = gtsam.GncLMParams(gtsam.LevenbergMarquardtParams())
    parameters.setLossType(gtsam.GncLossType.GM)
    # Factor 0 is the prior on the first pose.
    parameters.setKnownInliers([0, *(number for number, edge in enumerate(graph.edges, 1)
                                     if edge.kind in _KNOWN_INLIERS)])
    # While the kernel is still wide the cost hardly changes, which is not convergence.
    parameters.setRelativeCostTol(0.0)
    plain = factor_graph(graph)
    optimizer = gtsam.GncLMOptimizer(plain, initial_values(graph.poses), parameters)
    values = optimizer.optimize()
    trust = np.asarray(optimizer.getWeights())[1:]
    # Wrong loops that agree with one another, as between equal houses, all start with their full
    # weight, and then bend the odometry by more than it costs to reject them.
    squares = _Squares.of(graph, plain, values)
    if squares.strain > _STRAINED:
        chain = initial_values(_chained(graph))
        if _Squares.of(graph, plain, chain).cost < squares.cost:
            values = gtsam.LevenbergMarquardtOptimizer(
                factor_graph(graph, robust=True), chain).optimize()
            trust = _Squares.of(graph, plain, values).trust
    return OptimisedGraph(replace(graph, poses=poses_of(values, len(graph.poses))), trust, factors)


class _Squares(NamedTuple):
    """
    Squared residuals of the edges (E,), in standard deviations, for some poses.

    known: (E,) whether an edge has no kernel.
    """

    edges: Array
    known: NDArray[np.bool_]

    @classmethod
    def of(cls, graph: PoseGraph, plain: gtsam.NonlinearFactorGraph, values: gtsam.Values
           ) -> _Squares:
        """Return those of a graph, from its factors without a kernel."""
        return cls(np.array([2 * plain.at(number).error(values)
                             for number in range(1, len(graph.edges) + 1)]),
                   np.array([edge.kind in _KNOWN_INLIERS for edge in graph.edges], bool))

    @property
    def strain(self) -> float:
        """Return chi-squared of the odometry, relative to its degrees of freedom."""
        return float(self.edges[self.known].sum() / max(6 * self.known.sum(), 1))

    @property
    def cost(self) -> float:
        """Return what is minimised."""
        return float(np.where(self.known, self.edges,
                              _BOUND * self.edges / (_BOUND + self.edges)).sum())

    @property
    def trust(self) -> Array:
        """Return the weights (E,) of the edges."""
        return np.where(self.known, 1.0, (_BOUND / (_BOUND + self.edges))**2)


def _chained(graph: PoseGraph) -> Array:
    """Return the poses (N, 4, 4) of a graph by its odometry alone."""
    poses = graph.poses.copy()
    for edge in graph.edges:
        if edge.kind in _KNOWN_INLIERS:
            poses[edge.target] = poses[edge.source] @ edge.motion
    return poses


def factor_graph(graph: PoseGraph, *, robust: bool = False) -> gtsam.NonlinearFactorGraph:
    """
    Return the factor graph: a prior on the first pose, then the edges in their order.

    robust: whether links and loops have the robust kernel.
    """
    kernel = gtsam.noiseModel.mEstimator.GemanMcClure.Create(_BOUND**0.5)
    factors = gtsam.NonlinearFactorGraph()
    factors.add(gtsam.PriorFactorPose3(
        0, gtsam.Pose3(graph.poses[0]), gtsam.noiseModel.Isotropic.Sigma(6, _PRIOR_SIGMA)))
    for edge in graph.edges:
        information = edge.information()[np.ix_(_ORDER, _ORDER)]
        noise: Any = gtsam.noiseModel.Gaussian.Information(information)
        if robust and edge.kind not in _KNOWN_INLIERS:
            noise = gtsam.noiseModel.Robust.Create(kernel, noise)
        factors.add(gtsam.BetweenFactorPose3(
            edge.source, edge.target, gtsam.Pose3(edge.motion), noise))
    return factors


def initial_values(poses: Sequence[Array] | Array) -> gtsam.Values:
    """Return GTSAM values of poses (4, 4), with the keys 0, 1 and so on."""
    values = gtsam.Values()
    for key, pose in enumerate(poses):
        values.insert(key, gtsam.Pose3(pose))
    return values


def poses_of(values: gtsam.Values, count: int) -> Array:
    """Return the poses (N, 4, 4) of the keys 0 to N - 1."""
    return np.array([values.atPose3(key).matrix() for key in range(count)])
