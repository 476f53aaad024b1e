"""
Correction of scale drift by loops: the unit of length at each keyframe.

With a relative scale, the unit of length that landmarks propagate drifts. A loop observes points
whose inverse depths are known in the units at both of its ends, which gives their ratio. The
logarithms of the units form a linear graph with one unknown per keyframe: consecutive keyframes
have nearly the same unit, and a loop has a measured difference. This is the scale part of a Sim(3)
pose graph (Strasdat et al., "Scale drift-aware large scale monocular SLAM", RSS 2010), solved
first: all edges are then rescaled to the unit of the first keyframe, and poses are optimised in
SE(3). Where the odometry measures lengths, the unit is the metre: lengths from before the first
measurement, or from after a gap, are brought to metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from djet_ros.core.jet import Loss, robust_scale
from djet_ros.core.types import Array
from djet_ros.posegraph.pose_graph import Edge, PoseGraph
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import spsolve

# Standard deviation of the scale drift along an edge: as a fraction of the relative standard
# deviation of its length; and at least.
_DRIFT_FRACTION, _MIN_DRIFT = 0.5, 1e-4

# Iterations of reweighting, which suppress loops that contradict the others.
_ITERATIONS = 20

# Scale of the robust loss in standard deviations, in the last iteration and in the first.
_LOSS_SCALE, _INITIAL_LOSS_SCALE = 3.0, 100.0


def to_common_unit(graph: PoseGraph, first: float = 1.0) -> tuple[PoseGraph, Array]:
    """
    Rescale all edges of a graph to a common unit.

    It is the metre if there are metric edges, else the unit at the first vertex divided by
    ``first``. Returns (graph, factors (N,)): factors convert lengths in the unit at each vertex.
    """
    factors = np.exp(log_units(len(graph.poses), graph.edges))
    if not any(edge.metric for edge in graph.edges):
        factors *= first
    edges = tuple(rescaled_edge(edge, float(factors[edge.source])) for edge in graph.edges)
    return replace(graph, edges=edges), factors


def log_units(count: int, edges: Sequence[Edge]) -> Array:
    """
    Return the log units (N,) of the vertices; 0 without loops that measure their ratio.

    They are relative to the metre if there are metric edges, else to the unit at the first vertex.
    """
    loops = np.array([edge.log_scale_ratio is not None for edge in edges], bool)
    metric = {end for edge in edges if edge.metric for end in (edge.source, edge.target)}
    free = np.setdiff1d(np.arange(count), [*metric] or [0])
    if not loops.any() or not len(free):
        return np.zeros(count)
    ends = np.array([(edge.source, edge.target) for edge in edges])
    # Links carry no information on units, and edges of unknown length hardly any.
    kept = loops | np.array([edge.kind in ('odometry', 'unknown') for edge in edges])
    difference = np.array([edge.log_scale_ratio[0] if edge.log_scale_ratio else 0.0
                           for edge in edges])
    sigma = np.array([edge.log_scale_ratio[1] if edge.log_scale_ratio
                      else _drift_sigma(edge, measured=edge.target in metric)
                      for edge in edges])
    ends, loops, difference, sigma = (values[kept] for values in (ends, loops, difference, sigma))
    rows = np.repeat(np.arange(len(ends)), 2)
    J = coo_matrix((np.tile([-1.0, 1.0], len(ends)), (rows, ends.ravel())),
                   shape=(len(ends), count)).tocsr()[:, free]
    weights = sigma**-2
    units = np.zeros(count)
    for loss_scale in np.geomspace(_INITIAL_LOSS_SCALE, _LOSS_SCALE, _ITERATIONS):
        robust = J.T.multiply(weights).tocsc()
        units[free] = spsolve(robust @ J, robust @ difference)
        off = (units[ends[:, 1]] - units[ends[:, 0]] - difference) / sigma
        _, trust = Loss('geman_mcclure', loss_scale * max(1.0, robust_scale(off[loops])))(off**2)
        weights = np.where(loops, trust, 1.0) / sigma**2
    return units


def rescaled_edge(edge: Edge, factor: float) -> Edge:
    """Return an edge with its translation and covariance scaled by a factor."""
    if factor == 1.0:
        return edge
    scaling = np.diag([factor] * 3 + [1.0] * 3)
    return replace(edge, motion=rescaled_motion(edge.motion, factor),
                   covariance=scaling @ edge.covariance @ scaling,
                   uncorrelated=factor**2 * edge.uncorrelated)


def rescaled_motion(motion: Array, factor: float) -> Array:
    """Return a motion (4, 4) with its translation scaled by a factor."""
    scaled_motion = motion.copy()
    scaled_motion[:3, 3] *= factor
    return scaled_motion


def _drift_sigma(edge: Edge, *, measured: bool) -> float:
    """
    Return the standard deviation of the change of the log unit along an edge.

    measured: whether the unit at the target is the metre; the first measured length sets it.
    """
    length = float(np.linalg.norm(edge.motion[:3, 3]))
    if (edge.kind != 'odometry' or not edge.scale_known or not length
            or (measured and not edge.metric)):
        return 1.0
    along = edge.motion[:3, 3] / length
    share = np.sqrt(along @ edge.covariance[:3, :3] @ along) / length
    return float(np.clip(_DRIFT_FRACTION * share, _MIN_DRIFT, 1.0))
