"""
Pose graphs: camera poses and the relative poses between them, with what is known about each.

The inside speaks ROS: a motion (4, 4) is the target camera in the source camera, and its
covariance (6, 6) is over (x, y, z, rotation about x, y, z) along the axes of the source.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from djet_ros.core.types import Array
from djet_ros.errors import DjetError
from djet_ros.odometry.uncertainty import in_a_chain, rotated
import numpy as np
from numpy.typing import NDArray

# Where nobody knows it, a motion without a translation is taken to be of this length.
_UNIT = 1.0

# Below this share of its variances a direction of a covariance is rounding, not knowledge.
_SINGULAR = 1e-15


class Motion:
    """
    What steps, edges and offsets have in common: where one camera is in another's frame.

    motion (4, 4), covariance (6, 6): see the module; scale_known: whether the length of the motion
    means anything, in metres or in the one unit of the track.
    """

    motion: Array
    covariance: Array
    scale_known: bool

    def check(self, name: str) -> None:
        """Raise DjetError, by name, unless it is a pose with a covariance that has an inverse."""
        if self.motion.shape != (4, 4) or not np.isfinite(self.motion).all():
            raise DjetError(f'the motion of {name} is no pose of finite numbers; leave it out or '
                            'mend it')
        wrong = _fault(self.covariance)
        if wrong:
            raise DjetError(f'the covariance of {name} {wrong}, so that its inverse says nothing; '
                            'leave it out or mend its covariance')

    def covariance_in_target(self) -> Array:
        """
        Covariance (6, 6) along the axes of the target.

        That is the error that g2o and GTSAM minimise, xi in ``motion exp(xi)``.
        """
        return rotated(self.motion[:3, :3].T, self.covariance)

    def information(self) -> Array:
        """Inverse of ``covariance_in_target``, of its correlations: variances differ widely."""
        covariance = self.covariance_in_target()
        sigmas = np.sqrt(np.diag(covariance))
        information = np.linalg.inv(covariance / np.outer(sigmas, sigmas)) \
            / np.outer(sigmas, sigmas)
        return np.asarray((information + information.T) / 2)

    def own_covariance(self, uncertainty: float, noise: float) -> Array:
        """
        Covariance (6, 6) with its length as sure as it is among those of one odometry.

        uncertainty: standard deviation of each known length as a share of it; noise: what of it is
        each length's own. If all lengths of a graph are too large alike, and with them those of
        the loops, which come from them, then the graph is as consistent as before, only larger:
        such an error, as far as this length has it, must not make lengths look as if they could
        give way one by one. A length that nobody knows is in the odometry's units, which all
        share: were it free, loops of a few keyframes could turn motions round.
        """
        length = float(np.linalg.norm(self.motion[:3, 3]))
        if not self.scale_known:
            covariance = self.covariance.copy()
            covariance[:3, :3] = _clipped(covariance[:3, :3], (length or _UNIT)**2)
            return covariance
        if not length:
            return self.covariance
        along = self.motion[:3, 3] / length
        variance = float(along @ self.covariance[:3, :3] @ along)
        common = min(np.sqrt(variance) / length, uncertainty)**2 - noise**2
        translation = np.pad(self.motion[:3, 3], (0, 3))
        return np.asarray(
            self.covariance - max(common, 0.0) * np.outer(translation, translation))


@dataclass(frozen=True)
class Edge(Motion):
    """
    A relative pose between two vertices of a graph.

    source, target: indices of vertices; kind: 'odometry' (of neighbouring frames), 'link' (over
    more than one keyframe), 'loop' (of a place seen again) or 'unknown' (not estimated, and the
    covariance says so); stretch: of a loop, how much larger the unit of lengths is at the target
    than at the source, as a logarithm and its standard deviation, where that is known.
    """

    source: int
    target: int
    motion: Array
    covariance: Array
    kind: str = 'odometry'
    scale_known: bool = True
    stretch: tuple[float, float] | None = None

    def in_graph(self) -> Edge:
        """Give the edge as sure as a graph should take it, whose edges err independently."""
        if self.kind != 'odometry':
            return self
        return replace(self, covariance=in_a_chain(self.covariance))


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
            edge.check(self.name(edge))


def _clipped(covariance: Array, variance: float) -> Array:
    """Give a covariance with no direction less sure than a variance."""
    values, axes = np.linalg.eigh(covariance)
    return np.asarray(axes * np.minimum(values, variance) @ axes.T)


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
