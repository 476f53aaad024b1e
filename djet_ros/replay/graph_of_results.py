"""The steps of a replay, and their pose graph, read from its results folder."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Callable, Iterator
import csv
import io
from pathlib import Path
from typing import NamedTuple

from djet_ros.config.safe_files import read_text
from djet_ros.config.sections import Config, NODE_NAME
from djet_ros.config.yaml_files import load_yaml
from djet_ros.core.types import Array, STARTED, Status, TRACKED
from djet_ros.errors import DjetError
from djet_ros.odometry.messages import IS_KEYFRAME, k1_of, OPTICAL_TO_BODY, pose_of
from djet_ros.odometry.scale import Scale
from djet_ros.odometry.uncertainty import rotated
from djet_ros.posegraph.pose_graph import PoseGraph
from djet_ros.posegraph.step_messages import turn_of
from djet_ros.posegraph.steps import graph_of, Step
from djet_ros.recordings.bags import Bag
from djet_ros.recordings.trajectories import read_tum
from djet_ros.replay.results import BAG
import numpy as np


Warn = Callable[[str], None]

# A motion (4, 4) and its covariance (6, 6), along optical axes.
_Told = tuple[Array, Array]


def read_steps(folder: Path, warn: Warn | None = None) -> list[Step]:
    """
    Read the steps of a results folder of ``djet replay``.

    They are those of the frames to or from which a motion was estimated, and of those at which the
    odometry restarted. warn: told where the bag is cut short, as a kill leaves it, and the steps
    end there; without it that is a DjetError, as all else is that can't be read.
    """
    if not (folder / 'frames.csv').is_file():
        raise DjetError(f"{folder} holds no results; give a folder that 'djet replay' wrote")
    rows = _rows(folder / 'frames.csv')
    stamps, poses = read_tum(folder / 'trajectory_tum.txt')
    # A run that was killed may have lost the end of one of the files.
    rows = rows[:len(stamps)]
    if [row.stamp_ns for row in rows] != stamps[:len(rows)].tolist():
        raise DjetError(f'{folder}: frames.csv and trajectory_tum.txt are not of the same run')
    # After a step back in time stamps may come again, and in this order.
    motions: defaultdict[int, deque[_Told]] = defaultdict(deque)
    turns: defaultdict[int, deque[Array | None]] = defaultdict(deque)
    problem = None
    try:
        for stamp, motion, turn in _motions(folder / BAG, load_yaml(folder / 'config.yaml')):
            if motion is None:
                turns[stamp].append(turn)
            else:
                motions[stamp].append(motion)
    except DjetError as error:
        if warn is None or not motions:
            raise
        problem = error
    told = [motions[row.stamp_ns].popleft()
            if row.status in TRACKED and motions[row.stamp_ns] else None for row in rows]
    if problem is not None and warn is not None:
        whole = _whole(rows, told)
        warn(f'{problem}; of {len(rows)} frames the first {len(whole)} are taken')
        rows = whole
    unsure = [turns[row.stamp_ns].popleft() if turns[row.stamp_ns] else None for row in rows]
    steps = list(_steps(rows, poses, told, unsure, folder))
    if len(steps) < 2:
        raise DjetError(f'{folder}: no motion was estimated between any two frames; there is no '
                        'graph')
    return steps


def read_results(folder: Path, warn: Warn | None = None) -> PoseGraph:
    """Read the graph of a results folder; see ``read_steps`` and ``graph_of``."""
    return graph_of(read_steps(folder, warn))


class _Row(NamedTuple):
    """Of a frame, what a step needs."""

    stamp_ns: int
    status: Status
    previous_stamp_ns: int | None
    scale: Scale
    keyframe: bool | None
    k1: float


def _rows(path: Path) -> list[_Row]:
    """Rows of frames.csv that were processed."""
    rows = []
    for number, row in enumerate(csv.DictReader(io.StringIO(read_text(path))), 2):
        try:
            if row['status'] == 'UNUSED':
                continue
            previous = row['previous_stamp_ns']
            rows.append(_Row(int(row['stamp_ns']), Status(row['status']),
                             int(previous) if previous else None,
                             Scale(row['scale_kind'] or Scale.UNKNOWN),
                             IS_KEYFRAME[row.get('keyframe') or ''], k1_of(row.get('k1'))))
        except (KeyError, TypeError, ValueError) as error:
            raise DjetError(f'{path} line {number} is no row of a replay: {error}') from error
    return rows


def _motions(bag: Path, config: Config
             ) -> Iterator[tuple[int, _Told | None, Array | None]]:
    """
    Stamps of frames, each with its motion or how sure the rotation of its pose is.

    The latter of the camera alone: where a base frame is on it the bag does not tell.
    """
    relative, integrated = (f'/{NODE_NAME}/{name}' for name in ('relative_pose_cov', 'odometry'))
    topics = {relative} if config.odometry.base_frame else {relative, integrated}
    turn = np.eye(4)
    if config.odometry.frame_convention == 'body':
        turn[:3, :3] = OPTICAL_TO_BODY.T
    with Bag(bag) as opened:
        for topic, _, message in opened.messages(topics):
            stamp, motion = pose_of(message)
            if topic == integrated:
                yield stamp, None, turn_of(message, turn[:3, :3].T)
                continue
            covariance = np.asarray(message.pose.covariance, np.float64).reshape(6, 6)
            yield stamp, (turn @ motion @ turn.T, rotated(turn[:3, :3], covariance)), None


def _whole(rows: list[_Row], told: list[_Told | None]) -> list[_Row]:
    """Rows up to the first whose motion the bag has lost."""
    lost = (i for i, (row, motion) in enumerate(zip(rows, told))
            if row.status in TRACKED and motion is None)
    return rows[:next(lost, len(rows))]


def _steps(rows: list[_Row], poses: Array, told: list[_Told | None],
           turns: list[Array | None], folder: Path) -> Iterator[Step]:
    references = _references(rows)
    used = {*references}
    for i, (row, pose, motion, turn) in enumerate(zip(rows, poses, told, turns)):
        if row.status in TRACKED:
            if motion is None or references[i] is None:
                raise DjetError(f'{folder}: the motion to the frame of {row.stamp_ns} ns is '
                                'missing from the bag; replay the recording once more')
            yield Step(row.stamp_ns, row.status, pose, row.previous_stamp_ns,
                       *motion, row.scale is not Scale.UNKNOWN,
                       metric=row.scale is Scale.METRIC, keyframe=row.keyframe, k1=row.k1,
                       turn=turn)
        elif row.status in STARTED or i in used:
            yield Step(row.stamp_ns, row.status, pose, row.previous_stamp_ns,
                       keyframe=row.keyframe, k1=row.k1, turn=turn)


def _references(rows: list[_Row]) -> list[int | None]:
    """Give for each row the one, up to itself, from which its motion is told, or None."""
    newest: dict[int | None, int] = {}
    references = []
    for i, row in enumerate(rows):
        newest[row.stamp_ns] = i
        references.append(newest.get(row.previous_stamp_ns) if row.status in TRACKED else None)
    return references
