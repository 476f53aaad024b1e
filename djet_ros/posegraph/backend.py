"""The optimisation of a pose graph, by GTSAM."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from djet_ros.core.types import Array
from djet_ros.posegraph.pose_graph import PoseGraph
from djet_ros.posegraph.units import with_one_unit
import gtsam
import numpy as np

# GTSAM has the rotation before the translation.
_ORDER = [3, 4, 5, 0, 1, 2]

# The first pose is held where it is.
_HELD = 1e-6

# Kinds of edges that are believed as their covariances say.
_TRUSTED = ('odometry', 'unknown')


@dataclass(frozen=True)
class OptimisedGraph:
    """
    The graph with optimised poses; trust: (E,) its edges' final weights, 0 to 1.

    factors: (N,) by which lengths in the unit at each vertex are in the graph's; see units.
    """

    graph: PoseGraph
    trust: Array
    factors: Array

    def rejected(self, kind: str) -> int:
        """Count the edges of a kind that the robust kernel trusts by less than a half."""
        return sum(bool(edge.kind == kind and trust < 0.5)
                   for edge, trust in zip(self.graph.edges, self.trust))


def optimise(graph: PoseGraph, first: float = 1.0) -> OptimisedGraph:
    """
    Find the poses that fit the edges best.

    first: by which lengths in the unit at the first vertex are in the graph's.

    Links and loops may be wrong altogether and are under a robust kernel: Geman-McClure by
    graduated non-convexity (Yang et al., RA-L 2020), which does not depend on how far the
    odometry had drifted. DjetError names an edge whose covariance can't be inverted.
    """
    graph.check()
    graph, factors = with_one_unit(graph, first)
    parameters = gtsam.GncLMParams(gtsam.LevenbergMarquardtParams())
    parameters.setLossType(gtsam.GncLossType.GM)
    # The first factor holds the first pose.
    parameters.setKnownInliers([0, *(number for number, edge in enumerate(graph.edges, 1)
                                     if edge.kind in _TRUSTED)])
    # While the kernel is still wide the costs stand still: that is not yet the end.
    parameters.setRelativeCostTol(0.0)
    optimizer = gtsam.GncLMOptimizer(factor_graph(graph), initial_values(graph.poses), parameters)
    poses = poses_of(optimizer.optimize(), len(graph.poses))
    return OptimisedGraph(replace(graph, poses=poses), np.asarray(optimizer.getWeights())[1:],
                          factors)


def factor_graph(graph: PoseGraph) -> gtsam.NonlinearFactorGraph:
    """Factor graph of the edges, in their order, after one that holds the first pose."""
    factors = gtsam.NonlinearFactorGraph()
    factors.add(gtsam.PriorFactorPose3(
        0, gtsam.Pose3(graph.poses[0]), gtsam.noiseModel.Isotropic.Sigma(6, _HELD)))
    for edge in graph.edges:
        information = edge.information()[np.ix_(_ORDER, _ORDER)]
        factors.add(gtsam.BetweenFactorPose3(
            edge.source, edge.target, gtsam.Pose3(edge.motion),
            gtsam.noiseModel.Gaussian.Information(information)))
    return factors


def initial_values(poses: Sequence[Array] | Array) -> gtsam.Values:
    """Give poses (4, 4) the keys 0, 1 and so on."""
    values = gtsam.Values()
    for key, pose in enumerate(poses):
        values.insert(key, gtsam.Pose3(pose))
    return values


def poses_of(values: gtsam.Values, count: int) -> Array:
    """Poses (N, 4, 4) of the keys 0 to N - 1."""
    return np.array([values.atPose3(key).matrix() for key in range(count)])
