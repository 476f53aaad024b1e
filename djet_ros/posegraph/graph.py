"""
Pose graphs: camera poses and the relative poses between them, with what is known about each.

The inside speaks ROS: a motion (4, 4) is the target camera in the source camera, and its
covariance (6, 6) is over (x, y, z, rotation about x, y, z) along the axes of the source.
"""

from __future__ import annotations

from dataclasses import dataclass

from djet_ros.core.types import Array
from djet_ros.errors import DjetError
from djet_ros.odometry.uncertainty import rotated
import numpy as np
from numpy.typing import NDArray

# Below this share of its variances a direction of a covariance is rounding, not knowledge.
_SINGULAR = 1e-15


@dataclass(frozen=True)
class Edge:
    """
    A relative pose between two vertices of a graph.

    source, target: indices of vertices; motion (4, 4), covariance (6, 6): see the module;
    kind: 'odometry' (of neighbouring frames), 'link' (over more than one keyframe), 'loop' (of a
    place seen again) or 'unknown' (nothing was told, and the covariance says so); scale_known:
    whether the length of the motion is in metres.
    """

    source: int
    target: int
    motion: Array
    covariance: Array
    kind: str = 'odometry'
    scale_known: bool = True


@dataclass(frozen=True)
class PoseGraph:
    """Stamps (N,) in ns, poses (N, 4, 4) of the camera in its first frame, and edges."""

    stamps_ns: NDArray[np.int64]
    poses: Array
    edges: tuple[Edge, ...]

    def name(self, edge: Edge) -> str:
        """Words by which a user finds an edge."""
        return (f'{edge.kind} edge {edge.source} -> {edge.target} '
                f'({self.stamps_ns[edge.source]} ns -> {self.stamps_ns[edge.target]} ns)')

    def check(self) -> None:
        """Raise DjetError, naming an edge, unless all have motions and covariances to go by."""
        for edge in self.edges:
            self.body_covariance(edge)

    def body_covariance(self, edge: Edge) -> Array:
        """
        Covariance (6, 6) of an edge along the axes of its target.

        That is the error that g2o and GTSAM minimise, xi in ``motion exp(xi)``. DjetError names
        the edge if it is none: not finite, not symmetric, or not positive definite; or if the
        edge's motion is none.
        """
        if edge.motion.shape != (4, 4) or not np.isfinite(edge.motion).all():
            raise DjetError(f'the motion of {self.name(edge)} is no pose of finite numbers; leave '
                            'the edge out or mend it')
        wrong = _fault(edge.covariance)
        if wrong:
            raise DjetError(f'the covariance of {self.name(edge)} {wrong}, so that its inverse '
                            'says nothing; leave the edge out or mend its covariance')
        return rotated(edge.motion[:3, :3].T, edge.covariance)

    def information(self, edge: Edge) -> Array:
        """Inverse of ``body_covariance``, by way of its correlations: variances differ widely."""
        covariance = self.body_covariance(edge)
        sigmas = np.sqrt(np.diag(covariance))
        information = np.linalg.inv(covariance / np.outer(sigmas, sigmas)) \
            / np.outer(sigmas, sigmas)
        return np.asarray((information + information.T) / 2)


def _fault(covariance: Array) -> str:
    """Say what is wrong with a covariance; nothing if it can be inverted."""
    if covariance.shape != (6, 6) or not np.isfinite(covariance).all():
        return 'is not a finite 6x6 matrix'
    variances = np.diag(covariance)
    if variances.min() <= 0:
        return f'has the variance {variances.min():.3g}'
    correlation = covariance / np.sqrt(np.outer(variances, variances))
    if np.abs(correlation - correlation.T).max() > 1e-6:
        return 'is not symmetric'
    least = np.linalg.eigvalsh(correlation)[0]
    if least < -1e-9:
        return f'has a negative eigenvalue (correlations: {least:.3g})'
    return '' if least > _SINGULAR else 'is singular'
