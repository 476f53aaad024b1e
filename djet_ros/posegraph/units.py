"""
Drift of a relative scale, seen by loops: how large the unit is at each keyframe.

Where lengths are relative, the unit that landmarks carry along wanders. A loop sees points whose
inverse depths are known in the units of both its ends, so it tells how these compare. Logarithms
of units are then a graph of numbers, linear and with one unknown for each keyframe: neighbours
have nearly the same, and a loop a known difference. That is the scale of a Sim(3) pose graph
(Strasdat et al., "Scale drift-aware large scale monocular SLAM", RSS 2010) solved before its
poses: edges are brought to the first keyframe's unit, and poses are optimised as ever.
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

# By how much the unit wanders along an edge, as a share of how unsure its length is; and at least.
_WANDERING, _LEAST = 0.5, 1e-4

# Rounds of reweighting, in which loops that contradict the others lose their say.
_ROUNDS = 20

# Standard deviations at which the robust loss bends, in the last rounds; the first ones are mild.
_BEND, _MILD = 3.0, 100.0


def with_one_unit(graph: PoseGraph, first: float = 1.0) -> tuple[PoseGraph, Array]:
    """
    Bring all edges of a graph to one unit, which is that of its first vertex over ``first``.

    Also gives the factors (N,) that make lengths in the unit of a vertex lengths in that one.
    """
    factors = first * np.exp(log_units(len(graph.poses), graph.edges))
    edges = tuple(scaled(edge, float(factors[edge.source])) for edge in graph.edges)
    return replace(graph, edges=edges), factors


def log_units(count: int, edges: Sequence[Edge]) -> Array:
    """Logarithms (N,) of the units at vertices, the first one's 0; all 0 where no loop tells."""
    told = [edge for edge in edges if edge.stretch is not None]
    if not told:
        return np.zeros(count)
    ends = np.array([(edge.source, edge.target) for edge in edges])
    loops = np.array([edge.stretch is not None for edge in edges])
    # A link says nothing of units; an edge without a length hardly anything.
    kept = loops | np.array([edge.kind in ('odometry', 'unknown') for edge in edges])
    difference = np.array([edge.stretch[0] if edge.stretch else 0.0 for edge in edges])
    sigma = np.array([edge.stretch[1] if edge.stretch else _wandering(edge) for edge in edges])
    ends, loops, difference, sigma = (values[kept] for values in (ends, loops, difference, sigma))
    rows = np.repeat(np.arange(len(ends)), 2)
    J = coo_matrix((np.tile([-1.0, 1.0], len(ends)), (rows, ends.ravel())),
                   shape=(len(ends), count)).tocsr()[:, 1:]
    weights = sigma**-2
    units = np.zeros(count)
    for bend in np.geomspace(_MILD, _BEND, _ROUNDS):
        robust = J.T.multiply(weights).tocsc()
        units[1:] = spsolve(robust @ J, robust @ difference)
        off = (units[ends[:, 1]] - units[ends[:, 0]] - difference) / sigma
        _, trust = Loss('geman_mcclure', bend * max(1.0, robust_scale(off[loops])))(off**2)
        weights = np.where(loops, trust, 1.0) / sigma**2
    return units


def scaled(edge: Edge, factor: float) -> Edge:
    """Give an edge whose length is in another unit."""
    if factor == 1.0:
        return edge
    stretched = np.diag([factor] * 3 + [1.0] * 3)
    return replace(edge, motion=in_unit(edge.motion, factor),
                   covariance=stretched @ edge.covariance @ stretched)


def in_unit(motion: Array, factor: float) -> Array:
    """Give a motion (4, 4) whose length is in another unit."""
    scaled_motion = motion.copy()
    scaled_motion[:3, 3] *= factor
    return scaled_motion


def _wandering(edge: Edge) -> float:
    """Tell by how much the logarithm of the unit wanders along an edge (standard deviation)."""
    length = float(np.linalg.norm(edge.motion[:3, 3]))
    if edge.kind != 'odometry' or not edge.scale_known or not length:
        return 1.0
    along = edge.motion[:3, 3] / length
    share = np.sqrt(along @ edge.covariance[:3, :3] @ along) / length
    return float(np.clip(_WANDERING * share, _LEAST, 1.0))
