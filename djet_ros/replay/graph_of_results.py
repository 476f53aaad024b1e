"""Reading of a replay's steps, and their pose graph, from its results folder."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Iterator
import csv
from dataclasses import replace
import io
from pathlib import Path
from typing import NamedTuple

from djet_ros.config.safe_files import read_text
from djet_ros.config.sections import NODE_NAME
from djet_ros.config.yaml_files import load_yaml
from djet_ros.core.correction import Correction
from djet_ros.core.types import Array, STARTED, Status, TRACKED
from djet_ros.errors import DjetError
from djet_ros.odometry.messages import correction_of, IS_KEYFRAME, OPTICAL_TO_BODY, pose_of
from djet_ros.odometry.scale import Scale
from djet_ros.odometry.uncertainty import rotated
from djet_ros.posegraph.pose_graph import PoseGraph
from djet_ros.posegraph.step_messages import rotation_covariance_of
from djet_ros.posegraph.steps import graph_of, Step
from djet_ros.recordings.bags import Bag
from djet_ros.recordings.recording import Warn
from djet_ros.recordings.trajectories import read_tum
from djet_ros.replay.results import BAG
import numpy as np


# A motion (4, 4) and its covariance (6, 6), in optical axes.
_Estimate = tuple[Array, Array]


def read_steps(folder: Path, warn: Warn | None = None) -> list[Step]:
    """
    Read the steps of a results folder of ``djet replay``.

    There is a step for each frame to or from which a motion was estimated, and for each frame at
    which the odometry restarted. warn: called if the bag is truncated, as after a kill; the steps
    then end there. Without it, and for everything else that cannot be read, DjetError is raised.
    """
    if not (folder / 'frames.csv').is_file():
        raise DjetError(f'{folder} is not a results folder (no frames.csv); give a folder written '
                        "by 'djet replay'")
    rows = _rows(folder / 'frames.csv')
    stamps, poses = read_tum(folder / 'trajectory_tum.txt')
    # A run that was killed may have lost the end of one of the files.
    rows = rows[:len(stamps)]
    if [row.stamp_ns for row in rows] != stamps[:len(rows)].tolist():
        raise DjetError(f'{folder}: frames.csv and trajectory_tum.txt are not of the same run; '
                        'replay the recording again')
    estimates, covariances, problem = _estimates(folder, rows)
    if problem is not None:
        if warn is None:
            raise problem
        whole = _whole(rows, estimates)
        warn(f'{problem}; only the first {len(whole)} of {len(rows)} frames are used')
        rows = whole
    steps = list(_steps(rows, poses, estimates, covariances, folder))
    if len(steps) < 2:
        raise DjetError(f'{folder}: no motion was estimated between any two frames, so there is '
                        'no pose graph; see the status column of frames.csv for the reasons')
    return steps


def read_results(folder: Path, warn: Warn | None = None) -> PoseGraph:
    """Read the pose graph of a results folder; see ``read_steps`` and ``graph_of``."""
    return graph_of(read_steps(folder, warn))


class _Row(NamedTuple):
    """The columns of frames.csv that a step needs."""

    stamp_ns: int
    status: Status
    previous_stamp_ns: int | None
    scale: Scale
    keyframe: bool | None
    camera_correction: Correction


def _rows(path: Path) -> list[_Row]:
    """Return the rows of frames.csv that were processed."""
    rows, reader = [], csv.DictReader(io.StringIO(read_text(path)))
    try:
        for row in reader:
            if row['status'] == 'UNUSED':
                continue
            previous = row['previous_stamp_ns']
            rows.append(_Row(int(row['stamp_ns']), Status(row['status']),
                             int(previous) if previous else None,
                             Scale(row['scale_kind'] or Scale.UNKNOWN),
                             IS_KEYFRAME[row.get('keyframe') or ''], correction_of(row)))
    except (csv.Error, KeyError, TypeError, ValueError) as error:
        raise DjetError(f'{path} line {reader.line_num} is not a row of a replay: '
                        f'{error}') from error
    return rows


def _estimates(folder: Path, rows: list[_Row]
               ) -> tuple[list[_Estimate | None], list[Array | None], DjetError | None]:
    """
    Return the motion and the rotation covariance of each row, as far as the bag has them.

    The latter only for odometry of the camera: the bag does not contain the mounting of a base
    frame. Also returns why the bag could not be read to its end, or None; raises DjetError if it
    has no motion at all.
    """
    config = load_yaml(folder / 'config.yaml').odometry
    relative, integrated = (f'/{NODE_NAME}/{name}' for name in ('relative_pose_cov', 'odometry'))
    to_optical = np.eye(4)
    if config.frame_convention == 'body':
        to_optical[:3, :3] = OPTICAL_TO_BODY.T
    # After a step back in time stamps may repeat, in this order.
    motions: defaultdict[int, deque[_Estimate]] = defaultdict(deque)
    covariances: defaultdict[int, deque[Array | None]] = defaultdict(deque)
    problem = None
    try:
        with Bag(folder / BAG) as bag:
            for topic, _, message in bag.messages(
                    {relative} if config.base_frame else {relative, integrated}):
                stamp, motion = pose_of(message)
                if topic == integrated:
                    covariances[stamp].append(
                        rotation_covariance_of(message, to_optical[:3, :3].T))
                else:
                    covariance = np.asarray(message.pose.covariance, np.float64).reshape(6, 6)
                    motions[stamp].append((to_optical @ motion @ to_optical.T,
                                           rotated(to_optical[:3, :3], covariance)))
    except DjetError as error:
        if not motions:
            raise
        problem = error
    return ([motions[row.stamp_ns].popleft()
             if row.status in TRACKED and motions[row.stamp_ns] else None for row in rows],
            [covariances[row.stamp_ns].popleft() if covariances[row.stamp_ns] else None
             for row in rows], problem)


def _whole(rows: list[_Row], estimates: list[_Estimate | None]) -> list[_Row]:
    """Return the rows before the first whose motion is missing from the bag."""
    lost = (i for i, (row, motion) in enumerate(zip(rows, estimates))
            if row.status in TRACKED and motion is None)
    return rows[:next(lost, len(rows))]


def _steps(rows: list[_Row], poses: Array, estimates: list[_Estimate | None],
           rotation_covariances: list[Array | None], folder: Path) -> Iterator[Step]:
    references = _references(rows)
    used = {*references}
    for i, (row, pose, motion, covariance) in enumerate(
            zip(rows, poses, estimates, rotation_covariances)):
        step = Step(row.stamp_ns, row.status, pose, row.previous_stamp_ns, keyframe=row.keyframe,
                    camera_correction=row.camera_correction, rotation_covariance=covariance)
        if row.status in TRACKED:
            if motion is None or references[i] is None:
                raise DjetError(f'{folder}: the motion to the frame with stamp {row.stamp_ns} ns '
                                'is missing from the bag; replay the recording again')
            yield replace(step, motion=motion[0], covariance=motion[1],
                          scale_known=row.scale is not Scale.UNKNOWN,
                          metric=row.scale is Scale.METRIC)
        elif row.status in STARTED or i in used:
            yield step


def _references(rows: list[_Row]) -> list[int | None]:
    """Return for each row the index of the reference of its motion, or None."""
    newest: dict[int | None, int] = {}
    references = []
    for i, row in enumerate(rows):
        newest[row.stamp_ns] = i
        references.append(newest.get(row.previous_stamp_ns) if row.status in TRACKED else None)
    return references
