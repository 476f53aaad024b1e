"""
Export of pose graphs to files of other programs.

* g2o: VERTEX_SE3:QUAT and EDGE_SE3:QUAT. The information matrices are over (translation in the
  unit of the trajectory, rotation vector in rad) in the frame of the edge's target, as GTSAM reads
  them. g2o itself uses the vector part of the quaternion, half the angle.
* tum, kitti: poses only
* csv: one row per edge with its covariance in ROS order, in the axes of the source
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from djet_ros.errors import DjetError
from djet_ros.posegraph.pose_graph import Edge, PoseGraph
from djet_ros.recordings.outputs import check_file, write_whole
from djet_ros.recordings.trajectories import (
    digits,
    KittiWriter,
    position_and_quaternion,
    TrajectoryWriter,
    TumWriter,
)
import numpy as np

_UPPER = np.triu_indices(6)
_AXES = ('x', 'y', 'z', 'rx', 'ry', 'rz')
_COLUMNS = ('source_stamp_ns', 'target_stamp_ns', 'kind', 'scale_known',
            'x', 'y', 'z', 'qx', 'qy', 'qz', 'qw',
            *(f'cov_{_AXES[i]}_{_AXES[j]}' for i, j in zip(*_UPPER)))


def write_graph(graph: PoseGraph, path: Path, kind: str, overwrite: bool = False) -> None:
    """
    Write a graph as 'g2o', 'tum', 'kitti' or 'csv', atomically.

    Raises DjetError, also for an edge whose covariance cannot be inverted.
    """
    check_file(path, overwrite)
    graph.check()
    lines = list(FORMATS[kind](graph))
    try:
        write_whole(path, '\n'.join(lines) + '\n')
    except OSError as error:
        raise DjetError(f'{path} could not be written: {error.strerror}') from error


def _g2o(graph: PoseGraph) -> Iterator[str]:
    for number, pose in enumerate(graph.poses):
        yield f'VERTEX_SE3:QUAT {number} {digits(position_and_quaternion(pose))}'
    yield 'FIX 0'
    for edge in graph.edges:
        information = edge.information()[_UPPER]
        yield (f'EDGE_SE3:QUAT {edge.source} {edge.target} '
               f'{digits((*position_and_quaternion(edge.motion), *information))}')


def _csv(graph: PoseGraph) -> Iterator[str]:
    yield ','.join(_COLUMNS)
    for edge in graph.edges:
        values = digits((*position_and_quaternion(edge.motion), *edge.covariance[_UPPER]))
        yield ','.join((*_stamps(graph, edge), edge.kind, str(int(edge.scale_known)),
                        *values.split()))


def _poses(writer: type[TrajectoryWriter]) -> Callable[[PoseGraph], Iterator[str]]:
    """Return the format of a trajectory file: one line per pose."""
    return lambda graph: (writer.line(stamp, pose)
                          for stamp, pose in zip(graph.stamps_ns.tolist(), graph.poses))


def _stamps(graph: PoseGraph, edge: Edge) -> tuple[str, str]:
    return str(graph.stamps_ns[edge.source]), str(graph.stamps_ns[edge.target])


FORMATS: dict[str, Callable[[PoseGraph], Iterator[str]]] = {
    'g2o': _g2o, 'tum': _poses(TumWriter), 'kitti': _poses(KittiWriter), 'csv': _csv}
