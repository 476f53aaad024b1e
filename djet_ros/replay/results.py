"""
The results folder of a replay; files are written during the run, so that nothing is lost.

* trajectory_tum.txt, trajectory_kitti.txt: one pose per processed frame, camera in the first
  camera, in optical axes; the last known pose if the motion could not be estimated
* frames.csv: one row per image
* landmarks.ply: the landmarks that propagated the scale, in the first camera, if there are any
* debug/: drawings of the pairs, named by their image in frames.csv, if they were asked for
* bag/: the messages that a live node would have published
* config.yaml: the effective parameters
* summary.json: counts, errors, and whether the run completed
* errors.csv (with ground truth) and trajectory.png, at the end
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager, ExitStack, suppress
import csv
import json
from pathlib import Path
import shutil
from typing import Any

import cv2
from djet_ros.config.sections import Config, NODE_NAME
from djet_ros.config.yaml_files import dump_yaml
from djet_ros.core.correction import Correction
from djet_ros.core.types import Array
from djet_ros.errors import DjetError
from djet_ros.interrupts import interrupt_after
from djet_ros.odometry.messages import correction_values, KEYFRAME_WORDS
from djet_ros.odometry.result import OdometryResult
from djet_ros.odometry.tracker import Outgoing
from djet_ros.posegraph.steps import Step
from djet_ros.recordings.bag_writers import ResultBag
from djet_ros.recordings.closing import Closing
from djet_ros.recordings.outputs import is_locked, lock, replaced_whole, SetAside, write_whole
from djet_ros.recordings.point_clouds import PointFile
from djet_ros.recordings.text import LineFile
from djet_ros.recordings.trajectories import KittiWriter, TumWriter
from djet_ros.replay.pair_errors import PairErrors
import numpy as np
from numpy.typing import NDArray

SUMMARY = 'summary.json'
PLOT = 'trajectory.png'
BAG = 'bag'
LANDMARKS = 'landmarks.ply'
DEBUG = 'debug'
# Locked while the run goes on.
_TABLE = 'frames.csv'
_FILES = (SUMMARY, PLOT, LANDMARKS, 'trajectory_tum.txt', 'trajectory_kitti.txt', _TABLE,
          'errors.csv', 'config.yaml')
# Of all that a replay writes into the folder.
NAMES = (*_FILES, BAG, DEBUG)

# The summary until the run has ended.
UNFINISHED = {'complete': False, 'error': 'the run did not complete'}

COLUMNS = ('image', 'stamp_ns', 'status', 'reason', 'previous_stamp_ns', 'matches', 'inliers',
           'culled', 'iterations', 'median_residual_px', 'mean_hamming', 'scale', 'scale_kind',
           'keyframe', *Correction._fields, 'ms')


class ResultsFolder(Closing):
    """
    Writes the results of one replay; a context manager.

    Until ``finish`` the summary marks the run as incomplete. Earlier results are set aside, and
    put back at the end if the new ones have no frame. derived: files elsewhere that were made of
    earlier results; they are removed with them. Raises DjetError if the folder exists
    (unless it is empty, or an earlier results folder and overwrite is set), cannot be written, or
    is that of a replay that still runs.
    """

    def __init__(self, path: Path, config: Config, overwrite: bool = False,
                 derived: Iterable[Path] = ()) -> None:
        """Create the folder and its files, and write the parameters."""
        self.path = path
        self._derived = [*derived]
        present = path.exists()
        with self._beginning():
            if is_locked(path / _TABLE):
                # At its end it would write among the results of this one.
                raise DjetError(f'{path} is written to by another replay, which still runs; end '
                                'it, or choose another --output')
            self._earlier = SetAside(path, NAMES, overwrite, marks=(SUMMARY, 'config.yaml'))
        try:
            with self._beginning():
                self._begin(config)
        except BaseException:
            # Without both of its marks the folder could not be overwritten later.
            self._remove(present)
            self._earlier.put_back()
            raise

    def _begin(self, config: Config) -> None:
        write_whole(self.path / 'config.yaml', dump_yaml(config))
        self._table = LineFile(self.path / _TABLE)
        lock(self._table.fileno())
        self._summarise(UNFINISHED)
        self._rows = csv.writer(self._table, lineterminator='\n')
        self._rows.writerow(COLUMNS)
        self._trajectories = [TumWriter(self.path / 'trajectory_tum.txt'),
                              KittiWriter(self.path / 'trajectory_kitti.txt')]
        self._bag = ResultBag(self.path / BAG)
        self._landmarks: PointFile | None = None
        # From above, for the plot at the end.
        self._map: list[NDArray[np.float32]] = []

    @contextmanager
    def _beginning(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise DjetError(f'{self.path} could not be created: {error.strerror or error}; free '
                            'disk space, or choose another --output') from error

    def _remove(self, keep_folder: bool) -> None:
        """Remove the files of a failed start."""
        for name in _FILES:
            (self.path / name).unlink(missing_ok=True)
        shutil.rmtree(self.path / BAG, ignore_errors=True)
        if not keep_folder:
            # Keep the folder if others have put files there meanwhile.
            with suppress(OSError):
                self.path.rmdir()

    def add_frame(self, image: int, result: OdometryResult, seconds: float) -> None:
        """Write the result of a processed image (number from 0) and its processing time."""
        with _naming_errors(self.path):
            self._earlier.give_up()
            while self._derived:
                self._derived.pop().unlink(missing_ok=True)
        for trajectory in self._trajectories:
            trajectory.write(result.stamp_ns, result.pose)
        self._row((image, result.stamp_ns, result.status.value, '', *_details(result),
                   KEYFRAME_WORDS[result.keyframe],
                   *correction_values(result.camera_correction).values(),
                   f'{1e3 * seconds:.2f}'))

    def add_unused(self, image: int, stamp_ns: int, reason: str) -> None:
        """Write an image that was dropped or rejected, with the reason."""
        self._row((image, stamp_ns, 'UNUSED', reason, *[''] * (len(COLUMNS) - 4)))

    def add_landmarks(self, places: Array) -> None:
        """Write landmarks (M, 3) in the first camera, which are not refined any more."""
        if not len(places):
            return
        with _naming_errors(self.path):
            if self._landmarks is None:
                self._landmarks = PointFile(
                    self.path / LANDMARKS, 'first camera: x right, y down, z ahead; in the '
                    'lengths of trajectory_tum.txt')
            self._landmarks.add(places)
        self._map.append(places[:, [0, 2]].astype(np.float32))

    @property
    def landmarks_from_above(self) -> NDArray[np.float32]:
        """Return x and z (M, 2) of all landmarks so far, in the first camera."""
        return np.concatenate([np.empty((0, 2), np.float32), *self._map])

    def add_drawing(self, image: int, drawing: NDArray[np.uint8]) -> None:
        """Write a drawing (H, W, 3) BGR of the pair that ends with an image (number from 0)."""
        path = self.path / DEBUG / f'{image:06d}.jpg'
        with _naming_errors(path):
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(cv2.imencode('.jpg', drawing)[1].tobytes())

    def publish(self, outgoing: Outgoing, stamp_ns: int) -> None:
        """Write a message under the topic of the live node."""
        topic = outgoing.topic
        self._bag.write(topic if topic.startswith('/') else f'/{NODE_NAME}/{topic}',
                        outgoing.message, stamp_ns)

    def add_errors(self, pairs: list[Step], errors: PairErrors) -> None:
        """Write the errors of all pairs; cells of NaN are empty."""
        with _naming_errors(self.path), \
                (self.path / 'errors.csv').open('w', encoding='utf-8', newline='') as file:
            rows = csv.writer(file, lineterminator='\n')
            rows.writerow(('previous_stamp_ns', 'stamp_ns', 'status', 'rotation_error_deg',
                           'translation_error_deg'))
            rows.writerows(
                (pair.previous_stamp_ns, pair.stamp_ns, pair.status.value, *values)
                for pair, *values in zip(pairs, _cells(errors.rotation_deg),
                                         _cells(errors.translation_deg), strict=True))

    def finish(self, summary: dict[str, Any]) -> None:
        """Replace the summary atomically."""
        with _naming_errors(self.path):
            self._summarise(summary)

    def _summarise(self, summary: dict[str, Any]) -> None:
        write_whole(self.path / SUMMARY, json.dumps(summary, indent=2) + '\n')

    def close(self) -> None:
        """Complete the bag and close the files."""
        with interrupt_after(), ExitStack() as at_end:
            at_end.callback(self._keep_earlier)
            at_end.callback(self._bag.close)
            with _naming_errors(self.path):
                self._table.close()
                for trajectory in self._trajectories:
                    trajectory.close()
                if self._landmarks is not None:
                    self._landmarks.close()

    def _keep_earlier(self) -> None:
        """Put the earlier results back if no image could be used."""
        if self._earlier.kept:
            self._remove(keep_folder=True)
            self._earlier.put_back()

    def _row(self, values: tuple[Any, ...]) -> None:
        with _naming_errors(self.path):
            self._rows.writerow(values)


def _details(result: OdometryResult) -> tuple[Any, ...]:
    relative = result.relative
    if relative is None:
        return ('',) * (COLUMNS.index('keyframe') - COLUMNS.index('previous_stamp_ns'))
    residuals = np.abs(relative.residuals[relative.inliers])
    hamming = relative.hamming[np.isfinite(relative.hamming)]
    return (result.previous_stamp_ns, len(relative.x), int(relative.inliers.sum()),
            relative.culled, relative.iterations,
            f'{np.median(residuals):.4f}' if residuals.size else '',
            f'{hamming.mean():.3f}' if hamming.size else '',
            repr(float(result.scale)), result.scale_kind.value)


def _cells(values: NDArray[np.float64]) -> list[str]:
    return [f'{value:.6f}' if np.isfinite(value) else '' for value in values]


@contextmanager
def _naming_errors(path: Path) -> Iterator[None]:
    """Convert errors to DjetError that names the path."""
    try:
        yield
    except OSError as error:
        raise DjetError(f'{path} could not be written: {error.strerror or error}; the results up '
                        'to here are readable') from error


def _choose_limits(axes: Any, landmarks: NDArray[np.float32]) -> None:
    """
    Show the path and most landmarks (M, 2), those up to the extent of the path away from it.

    A straight path is given a width, so that its deviations are visible.
    """
    limits = np.array([axes.get_xlim(), axes.get_ylim()])
    longest = np.ptp(limits, axis=1).max()
    if len(landmarks):
        lowest, highest = np.quantile(landmarks, (0.05, 0.95), axis=0)
        limits[:, 0] -= np.clip(limits[:, 0] - lowest, 0, longest)
        limits[:, 1] += np.clip(highest - limits[:, 1], 0, longest)
    halves = np.maximum(np.ptp(limits, axis=1), longest / 2) / 2 * 1.1
    (left, bottom), (right, top) = limits.mean(1) - halves, limits.mean(1) + halves
    axes.set(xlim=(left, right), ylim=(bottom, top))


def plot_trajectory(path: Path, estimate: Array, truth: Array | None,
                    landmarks: NDArray[np.float32], title: str, unit: str) -> None:
    """
    Plot a trajectory from above (x right, z forward), from positions (N, 3) in the first camera.

    truth: (M, 3) or None; landmarks: (M, 2), x and z; unit: unit of the axes.
    """
    # Imported here, as it takes half a second and only the end of a replay needs it.
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 7), layout='constrained')
    axes = figure.add_subplot(aspect='equal')
    if truth is not None:
        axes.plot(truth[:, 0], truth[:, 2], color='0.55', linewidth=2.5, label='ground truth')
    axes.plot(estimate[:, 0], estimate[:, 2], color='tab:blue', linewidth=1.2, label='estimate')
    axes.plot(*estimate[0, [0, 2]], 'o', color='black', markersize=5, label='start')
    axes.set(xlabel=f'x, right ({unit})', ylabel=f'z, forward ({unit})')
    # A $ in the name of a folder is not a formula.
    axes.set_title(title, parse_math=False)
    _choose_limits(axes, landmarks)
    axes.plot(*landmarks.T, ',', color='0.6', zorder=0, scalex=False, scaley=False)
    axes.grid(color='0.9')
    axes.legend(loc='best')
    with _naming_errors(path), replaced_whole(path) as new:
        figure.savefig(new, dpi=120)
