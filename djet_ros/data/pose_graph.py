"""
Pose graphs: camera poses and the relative poses between them, with what is known about each.

The inside speaks ROS: a motion (4, 4) is the target camera in the source camera, and its
covariance (6, 6) is over (x, y, z, rotation about x, y, z) along the axes of the source.
"""

from __future__ import annotations

from collections.abc import Iterator
import csv
from dataclasses import dataclass
import io
from pathlib import Path
from typing import NamedTuple

from djet_ros.config import Config, load_yaml, NODE_NAME
from djet_ros.core.types import Array, Status
from djet_ros.data.bags import Bag
from djet_ros.data.results import BAG
from djet_ros.data.sources import pose_of
from djet_ros.data.text import read_text
from djet_ros.data.trajectories import read_tum
from djet_ros.errors import DjetError
from djet_ros.odometry.messages import OPTICAL_TO_BODY
from djet_ros.odometry.uncertainty import rotated, UNKNOWN_MOTION
from djet_ros.odometry.visual_odometry import STARTED, TRACKED
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


class _Row(NamedTuple):
    """Of a frame, what a graph needs."""

    stamp_ns: int
    status: str
    previous_stamp_ns: int | None
    scale_known: bool


def read_results(folder: Path) -> PoseGraph:
    """
    Read the graph of a results folder of ``djet replay``.

    Vertices are the frames that a motion was told to or from. Where the odometry began anew, an
    edge of kind 'unknown' keeps the graph in one piece. Raises DjetError.
    """
    if not (folder / 'frames.csv').is_file():
        raise DjetError(f"{folder} holds no results; give a folder that 'djet replay' wrote")
    rows = _rows(folder / 'frames.csv')
    stamps, poses = read_tum(folder / 'trajectory_tum.txt')
    # A run that was killed may have lost the end of one of the files.
    rows = rows[:len(stamps)]
    if [row.stamp_ns for row in rows] != stamps[:len(rows)].tolist():
        raise DjetError(f'{folder}: frames.csv and trajectory_tum.txt are not of the same run')
    motions = _motions(folder / BAG, load_yaml(folder / 'config.yaml'))
    edges = list(_edges(rows, poses, motions, folder))
    if not edges:
        raise DjetError(f'{folder}: no motion was told between any two frames; there is no graph')
    kept = sorted({end for edge in edges for end in (edge.source, edge.target)})
    return PoseGraph(stamps[kept], poses[kept], tuple(_renumbered(edges, kept)))


def _rows(path: Path) -> list[_Row]:
    """Rows of frames.csv that were processed."""
    rows = []
    for number, row in enumerate(csv.DictReader(io.StringIO(read_text(path))), 2):
        try:
            if row['status'] == 'UNUSED':
                continue
            previous = row['previous_stamp_ns']
            rows.append(_Row(int(row['stamp_ns']), Status(row['status']).value,
                             int(previous) if previous else None, row['scale_known'] == '1'))
        except (KeyError, TypeError, ValueError) as error:
            raise DjetError(f'{path} line {number} is no row of a replay: {error}') from error
    return rows


def _motions(bag: Path, config: Config) -> dict[int, tuple[Array, Array]]:
    """Motion (4, 4) and covariance (6, 6), along optical axes, by the stamp of the frame."""
    topic = f'/{NODE_NAME}/relative_pose_cov'
    turn = np.eye(4)
    if config.odometry.frame_convention == 'body':
        turn[:3, :3] = OPTICAL_TO_BODY.T
    motions = {}
    with Bag(bag) as opened:
        for _, _, message in opened.messages({topic}):
            stamp, motion = pose_of(message)
            covariance = np.asarray(message.pose.covariance, np.float64).reshape(6, 6)
            motions[stamp] = turn @ motion @ turn.T, rotated(turn[:3, :3], covariance)
    return motions


def _edges(rows: list[_Row], poses: Array, motions: dict[int, tuple[Array, Array]],
           folder: Path) -> Iterator[Edge]:
    """Edges between rows: told motions, and unknown ones to where the odometry began anew."""
    references = {row.previous_stamp_ns for row in rows if row.status in TRACKED}
    at: dict[int, int] = {}
    last: int | None = None
    for i, row in enumerate(rows):
        at[row.stamp_ns] = i
        if row.status in TRACKED:
            if row.stamp_ns not in motions or row.previous_stamp_ns not in at:
                raise DjetError(f'{folder}: the motion to the frame of {row.stamp_ns} ns is '
                                'missing from the bag; replay the recording once more')
            motion, covariance = motions[row.stamp_ns]
            yield Edge(at[row.previous_stamp_ns], i, motion, covariance,
                       scale_known=row.scale_known)
        elif row.status in STARTED or row.stamp_ns in references:
            if last is not None:
                yield Edge(last, i, np.linalg.inv(poses[last]) @ poses[i], UNKNOWN_MOTION,
                           'unknown', False)
        else:
            continue
        last = i


def _renumbered(edges: list[Edge], kept: list[int]) -> Iterator[Edge]:
    number = {row: vertex for vertex, row in enumerate(kept)}
    for edge in edges:
        yield Edge(number[edge.source], number[edge.target], edge.motion, edge.covariance,
                   edge.kind, edge.scale_known)
