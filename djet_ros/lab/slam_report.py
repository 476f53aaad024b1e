"""Output files of the offline SLAM: trajectories, graph, plot and summary."""

from __future__ import annotations

from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
import json
from pathlib import Path
from typing import Any

from djet_ros import __version__
from djet_ros.config.flat import flat
from djet_ros.config.sections import Config, SLAM_OFFLINE
from djet_ros.core.types import Array
from djet_ros.errors import DjetError, one_line
from djet_ros.lab.evo import trajectory_metrics
from djet_ros.lab.integration import StampedTrajectory
from djet_ros.lab.style import COLOURS, figure
from djet_ros.posegraph.graph_files import write_graph
from djet_ros.posegraph.offline import Slam
from djet_ros.recordings.outputs import write_whole
from djet_ros.replay.alignment import aligned, position_rmse
from djet_ros.replay.drift import path_length
import numpy as np

PLOT = 'slam.png'
SUMMARY = 'slam.json'
FILES = (SUMMARY, PLOT, 'pose_graph.g2o', 'pose_graph.csv', 'before_tum.txt', 'after_tum.txt',
         'truth_tum.txt')

_LINES: dict[str, Any] = {'before': {'color': COLOURS['rpe'], 'ls': '--'},
                          'after': {'color': COLOURS['djet']}}


def write_report(folder: Path, slam: Slam, truth: Array, name: str,
                 config: Config) -> dict[str, Any]:
    """
    Write trajectories, graph, plot and summary into a folder, and return the summary.

    truth: (N, 4, 4) of the frames, NaN where unknown; name: of the recording. The files of the
    graph leave out rejected edges, as another backend would not know that they are wrong.
    """
    frames, graph = slam.frames, slam.optimised.graph
    trajectories = {'before': frames.poses, 'after': slam.optimised_poses()}
    for label, poses in trajectories.items():
        StampedTrajectory(frames.stamps_ns, poses).write_tum(folder / f'{label}_tum.txt')
    for kind in ('g2o', 'csv'):
        write_graph(slam.optimised.accepted, folder / f'pose_graph.{kind}', kind)
    values = flat(config)
    parameters = {full.removeprefix('slam.'): values[full].value for full in SLAM_OFFLINE}
    kinds = Counter(edge.kind for edge in graph.edges)
    summary: dict[str, Any] = {
        'source': name, 'scale': config.odometry.scale, 'scale_kind': slam.scale.value,
        'scale_uncertainty': config.odometry.scale_uncertainty if slam.metric else None,
        'frames': len(frames.poses), 'keyframes': len(graph.poses), 'edges': dict(kinds),
        'rejected': {kind: slam.optimised.rejected(kind) for kind in ('link', 'loop')
                     if kinds[kind]},
        'way': path_length(frames.poses[:, :3, 3]), 'parameters': parameters,
        'version': __version__}
    known = np.isfinite(truth).all(axis=(1, 2))
    if known.sum() > 2:
        StampedTrajectory(frames.stamps_ns[known], truth[known]).write_tum(
            folder / 'truth_tum.txt')
        summary['errors'] = {label: _error(poses, truth, slam.metric)
                             for label, poses in trajectories.items()}
        try:
            # in parallel, as it takes seconds to start
            with ThreadPoolExecutor(len(trajectories)) as threads:
                found = list(threads.map(lambda label: _evo(folder, label, slam.metric),
                                         trajectories))
            for label, errors in zip(trajectories, found):
                summary['errors'][label].update(errors)
        except DjetError as error:
            # evo is not installed, or fails on a straight trajectory.
            summary['evo'] = str(error)
    _plot(folder / PLOT, slam, {label: poses[:, :3, 3] for label, poses in trajectories.items()},
          truth if known.sum() > 2 else None, one_line(Path(name).name))
    write_whole(folder / SUMMARY, json.dumps(summary, indent=2) + '\n')
    return summary


def _error(poses: Array, truth: Array, metric: bool) -> dict[str, float]:
    positions = truth[:, :3, 3]
    return {'ape_m': position_rmse(aligned(poses[:, :3, 3], positions, metric), positions)}


def _evo(folder: Path, label: str, metric: bool) -> dict[str, float]:
    """Return the metrics of a trajectory file by evo."""
    metrics = trajectory_metrics(folder / 'truth_tum.txt', folder / f'{label}_tum.txt', metric)
    return {f'evo_{name}': value for name, value in asdict(metrics).items()}


def _plot(path: Path, slam: Slam, trajectories: dict[str, Array], truth: Array | None,
          title: str) -> None:
    """Plot trajectories (N, 3) from above, before and after, and both errors over time."""
    if truth is not None:
        trajectories = {label: aligned(positions, truth[:, :3, 3], slam.metric)
                        for label, positions in trajectories.items()}
    with figure(path, 7 if truth is None else 12, 6) as page:
        axes = page.add_subplot(1, 1 if truth is None else 2, 1)
        # A straight path would make the panel as narrow as itself.
        axes.set_aspect('equal', adjustable='datalim')
        if truth is not None:
            axes.plot(truth[:, 0, 3], truth[:, 2, 3], color='0.6', lw=3, label='ground truth')
        for label, positions in trajectories.items():
            axes.plot(positions[:, 0], positions[:, 2], label=label, **_LINES[label])
        if len(closed := _closed(slam, trajectories['after'])):
            axes.plot(*closed[:, [0, 2]].T, '.', color=COLOURS['pjet'], ms=4, label='loop closed')
        unit = 'm' if slam.metric or truth is not None else 'units'
        axes.set(xlabel=f'x, right ({unit})', ylabel=f'z, forward ({unit})', title=title)
        axes.legend()
        if truth is not None:
            errors = page.add_subplot(1, 2, 2)
            seconds = (slam.frames.stamps_ns - slam.frames.stamps_ns[0]) * 1e-9
            for label, positions in trajectories.items():
                errors.plot(seconds, np.linalg.norm(positions - truth[:, :3, 3], axis=1),
                            label=label, **_LINES[label])
            errors.set(xlabel='time (s)', ylabel='position error after alignment (m)')
            errors.legend()


def _closed(slam: Slam, positions: Array) -> Array:
    """Return the positions (L, 3), among those of all frames (N, 3), of accepted loop edges."""
    _, first = np.unique([offset.keyframe for offset in slam.offsets], return_index=True)
    closing = [edge.source for edge in slam.optimised.accepted.edges if edge.kind == 'loop']
    return np.asarray(positions[first[np.array(closing, np.int64)]])
