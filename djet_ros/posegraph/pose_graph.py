"""
Pose graphs: camera poses, and relative poses between them with covariances.

Conventions are those of ROS: a motion (4, 4) is the pose of the target camera in the source
camera, and its covariance (6, 6) is over (x, y, z, rotation about x, y, z) in the axes of the
source.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from djet_ros.core.types import Array
from djet_ros.errors import DjetError
from djet_ros.odometry.uncertainty import inflated_for_chain, rotated
import numpy as np
from numpy.typing import NDArray

# Length that is assumed for a motion of unknown scale and zero translation.
_UNIT = 1.0

# Smallest eigenvalue of a correlation matrix that is not rounding.
_SINGULAR = 1e-15

# Variance along an axis, relative to that along another, which is lost in rounding when the axes
# are rotated. It is 1e-15 for an unknown length with an exact direction.
_LOST = 1e-16


class Motion:
    """
    Base of steps, edges and offsets: the pose of one camera in another.

    motion (4, 4), covariance (6, 6): see the module; scale_known: whether the length of the motion
    is determined, in metres or in the relative unit of the track.
    """

    motion: Array
    covariance: Array
    scale_known: bool

    def check(self, name: str) -> None:
        """Raise DjetError, with a name, unless the pose is finite and the covariance regular."""
        if self.motion.shape != (4, 4) or not np.isfinite(self.motion).all():
            raise DjetError(f'the motion of {name} is not a finite pose; correct or remove it')
        wrong = _fault(self.covariance)
        if wrong:
            raise DjetError(f'the covariance of {name} {wrong} and cannot be inverted to an '
                            'information matrix; correct it, or remove the edge')

    def covariance_in_target(self) -> Array:
        """
        Return the covariance (6, 6) in the axes of the target.

        It is that of the error minimised by g2o and GTSAM, xi in ``motion exp(xi)``.
        """
        return rotated(self.motion[:3, :3].T, self.covariance)

    def information(self) -> Array:
        """Return the inverse of ``covariance_in_target``, whitened first for conditioning."""
        covariance = self.covariance_in_target()
        sigmas = np.sqrt(np.diag(covariance))
        information = np.linalg.inv(covariance / np.outer(sigmas, sigmas)) \
            / np.outer(sigmas, sigmas)
        return np.asarray((information + information.T) / 2)

    def independent_covariance(self, uncertainty: float, noise: float) -> Array:
        """
        Return the covariance (6, 6) without the length error common to all motions of a track.

        uncertainty: relative standard deviation of known lengths; noise: its part that is
        independent between lengths. A common relative error scales the whole graph, loops
        included, and keeps it consistent; treated as independent it would let single lengths give
        way in the optimisation. An unknown length is in the odometry's unit, which all motions
        share, and is limited to itself: were it free, short loops could reverse motions.
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

    def length_noise(self, noise: float) -> Array:
        """
        Return the covariance (3, 3) of the translation by the error of its length alone.

        noise: relative standard deviation of known lengths; a length may be known better.
        """
        squared = float(self.motion[:3, 3] @ self.motion[:3, 3])
        if not self.scale_known or not squared:
            return np.zeros((3, 3))
        outer = np.outer(self.motion[:3, 3], self.motion[:3, 3])
        known = float((outer * self.covariance[:3, :3]).sum()) / squared**2
        return np.asarray(min(noise**2, known) * outer)


@dataclass(frozen=True)
class Edge(Motion):
    """
    A relative pose between two vertices of a graph.

    source, target: indices of vertices; kind: 'odometry' (of consecutive frames), 'link' (over
    more than one keyframe), 'loop' (of a revisited place) or 'unknown' (not estimated, with a
    large covariance); log_scale_ratio: of a loop, the logarithm of the unit of length at the
    target over that at the source, and its standard deviation, or None; uncorrelated: (3, 3) part
    of the translation's covariance that is independent from pair to pair; metric: whether a known
    length of the odometry is in metres.
    """

    source: int
    target: int
    motion: Array
    covariance: Array
    kind: str = 'odometry'
    scale_known: bool = True
    log_scale_ratio: tuple[float, float] | None = None
    uncorrelated: Array = field(default_factory=lambda: np.zeros((3, 3)))
    metric: bool = False

    def inflated(self) -> Edge:
        """Return the edge with the covariance inflated for correlated errors of the odometry."""
        if self.kind != 'odometry':
            return self
        own = np.pad(self.uncorrelated, (0, 3))
        return replace(self, covariance=inflated_for_chain(self.covariance - own) + own)


@dataclass(frozen=True)
class PoseGraph:
    """Stamps (N,) in ns, poses (N, 4, 4) of the camera in the first frame, and edges."""

    stamps_ns: NDArray[np.int64]
    poses: Array
    edges: tuple[Edge, ...]

    def name(self, edge: Edge) -> str:
        """Return a description of an edge for error messages."""
        return (f'{edge.kind} edge {edge.source} -> {edge.target} '
                f'({self.stamps_ns[edge.source]} ns -> {self.stamps_ns[edge.target]} ns)')

    def check(self) -> None:
        """Raise DjetError, naming the edge, for an invalid motion or covariance."""
        for edge in self.edges:
            edge.check(self.name(edge))


def _clipped(covariance: Array, variance: float) -> Array:
    """Return a covariance with its eigenvalues limited to a variance."""
    values, axes = np.linalg.eigh(covariance)
    return np.asarray(axes * np.minimum(values, variance) @ axes.T)


def _fault(covariance: Array) -> str:
    """Return what is wrong with a covariance, or '' if it can be inverted."""
    if covariance.shape != (6, 6) or not np.isfinite(covariance).all():
        return 'is not a finite 6x6 matrix'
    variances = np.diag(covariance)
    if variances.min() <= 0:
        return f'has the variance {variances.min():.3g}'
    sigmas = np.sqrt(variances)
    correlation = covariance / np.outer(sigmas, sigmas)
    if np.abs(correlation - correlation.T).max() > 1e-6:
        return 'is not symmetric'
    least = np.linalg.eigvalsh(correlation)[0]
    if least < -1e-9:
        return f'has a negative eigenvalue (correlations: {least:.3g})'
    halves = variances.reshape(2, 3)
    regular = least > _SINGULAR and (halves.min(1) > _LOST * halves.max(1)).all()
    return '' if regular else 'is singular'
