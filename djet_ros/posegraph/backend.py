"""Pose graph optimisation with GTSAM."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import compress

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

# Weight in the kernel of an edge at the 99 % bound of chi-squared, which is the kernel's scale.
_REJECTED = 0.25


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
    optimizer = gtsam.GncLMOptimizer(factor_graph(graph), initial_values(graph.poses), parameters)
    poses = poses_of(optimizer.optimize(), len(graph.poses))
    return OptimisedGraph(replace(graph, poses=poses), np.asarray(optimizer.getWeights())[1:],
                          factors)


def factor_graph(graph: PoseGraph) -> gtsam.NonlinearFactorGraph:
    """Return the factor graph: a prior on the first pose, then the edges in their order."""
    factors = gtsam.NonlinearFactorGraph()
    factors.add(gtsam.PriorFactorPose3(
        0, gtsam.Pose3(graph.poses[0]), gtsam.noiseModel.Isotropic.Sigma(6, _PRIOR_SIGMA)))
    for edge in graph.edges:
        information = edge.information()[np.ix_(_ORDER, _ORDER)]
        factors.add(gtsam.BetweenFactorPose3(
            edge.source, edge.target, gtsam.Pose3(edge.motion),
            gtsam.noiseModel.Gaussian.Information(information)))
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
