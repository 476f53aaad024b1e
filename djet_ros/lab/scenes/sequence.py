"""Rendering of a scene to files, in the layout of the KITTI odometry benchmark."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
from djet_ros.config.safe_files import read_text
from djet_ros.core.types import Array
from djet_ros.errors import DjetError
from djet_ros.lab.scenes.catalogue import find, make_scene, suggested_frames
from djet_ros.lab.scenes.imu import feel, FeltMotion, Mems, TO_CAMERA
from djet_ros.lab.scenes.scene import Scene
from djet_ros.recordings.trajectories import KittiWriter
import numpy as np
from numpy.typing import NDArray

FRAME_PERIOD = 0.1
_IMU = 'imu.csv'
_IMU_COLUMNS = ('#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],'
                'a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]')
# File that describes the rendering; folders without it are not overwritten.
_LABEL = 'scene.txt'


def render_sequence(name: str, out: Path, frames: int | None = None, seed: int = 0,
                    size: tuple[int, int] | None = None,
                    progress: Callable[[int, int], None] | None = None, *,
                    overwrite: bool = False, mems: Mems | None = None, slower: int = 1) -> Path:
    """
    Render a named scene into ``out/sequences/NN`` and its ground truth into ``out/poses/NN.txt``.

    frames, size (width, height): by default those of the catalogue; progress is called with
    (frames done, total); mems: errors of the IMU, whose samples are written to imu.csv if there
    are at least three frames; slower: see ``make_scene``. Returns the sequence's folder. Raises
    DjetError if it exists, unless ``overwrite``, or can't be written. Times and poses are written
    last, so that an interrupted rendering is not mistaken for a complete one.
    """
    scene = make_scene(name, seed, size, slower)
    poses = scene.trajectory(frames if frames is not None else suggested_frames(scene))
    label = (f'djet render {name}: seed {seed}, {len(poses)} frames, '
             f'{scene.size[0]}x{scene.size[1]}, 1/{slower} of the usual speed')
    return render_poses(scene, poses, out, find(name).number, label, progress,
                        overwrite=overwrite, mems=mems)


def render_poses(scene: Scene, poses: Array, out: Path, number: int, label: str,
                 progress: Callable[[int, int], None] | None = None, *,
                 overwrite: bool = False, mems: Mems | None = None) -> Path:
    """
    Render a scene from poses (N, 4, 4), camera to first camera, a frame period apart.

    number: of the sequence; label: describes it, 'djet render NAME: ...', where sequences with one
    name are one scene to `djet lab coverage`. All else as for ``render_sequence``.
    """
    folder = out / 'sequences' / f'{number:02d}'
    truth = out / 'poses' / f'{number:02d}.txt'
    try:
        _clear(folder, truth, overwrite)
        (folder / _LABEL).write_text(f'{label}\n', 'utf-8')
        (folder / 'calib.txt').write_text(
            f'P0: {_projection(scene.K)}\nTr_imu_to_cam: {_projection(TO_CAMERA)}\n',
            'utf-8')
        for index, pose in enumerate(poses):
            path = folder / 'image_0' / f'{index:06d}.png'
            path.write_bytes(_png(scene.render(pose, index)))
            if progress is not None:
                progress(index + 1, len(poses))
        if len(poses) > 2:
            _write_imu(folder / _IMU, feel(poses, FRAME_PERIOD, mems or Mems(), scene.seed,
                                           scene.level))
        (folder / 'times.txt').write_text(''.join(f'{i * FRAME_PERIOD:.6e}\n'
                                                  for i in range(len(poses))),
                                          'utf-8')
    except OSError as error:
        raise DjetError(f'{error.filename or out} could not be written: {error.strerror}; '
                        'choose another folder or free disk space') from error
    with KittiWriter(truth) as writer:
        for index, pose in enumerate(poses):
            writer.write(round(index * FRAME_PERIOD * 1e9), pose)
    return folder


def rendered_scene(folder: Path) -> str | None:
    """Return the name of the scene that a folder was rendered from; None for other folders."""
    label = folder / _LABEL
    if not label.is_file():
        return None
    words = read_text(label).partition(':')[0].split()
    return words[-1] if words[:2] == ['djet', 'render'] else None


def _clear(folder: Path, truth: Path, overwrite: bool) -> None:
    """Make the folders, and with ``overwrite`` remove an earlier rendering, but nothing else."""
    present = next((path for path in (folder, truth) if path.exists()), None)
    if present is not None and not overwrite:
        raise DjetError(f'{present} exists already; choose another folder or pass --overwrite')
    if present is not None and not (folder / _LABEL).exists():
        raise DjetError(f'{present} was not rendered by djet ({folder / _LABEL} is missing), so '
                        'it is not overwritten; choose another folder')
    for path in (truth, folder / 'calib.txt', folder / 'times.txt',
                 folder / _IMU, *(folder / 'image_0').glob('[0-9]*.png')):
        path.unlink(missing_ok=True)
    (folder / 'image_0').mkdir(parents=True, exist_ok=True)
    truth.parent.mkdir(parents=True, exist_ok=True)


def _write_imu(path: Path, felt: FeltMotion) -> None:
    """Write samples in the format of EuRoC, with the first and last true biases in a comment."""
    first, last = (' '.join(f'{value:.6e}' for value in felt.rate_biases[i]) for i in (0, -1))
    rows = ''.join(
        f'{stamp},{",".join(f"{value:.9e}" for value in (*rate, *force))}\n'
        for stamp, rate, force in zip(felt.stamps_ns.tolist(), felt.rates.tolist(),
                                      felt.accelerations.tolist(), strict=True))
    path.write_text(f'# true bias of the rates in rad/s: {first} at first, {last} at last\n'
                    f'{_IMU_COLUMNS}\n{rows}', 'utf-8')


def _png(gray: NDArray[np.uint8]) -> bytes:
    _, data = cv2.imencode('.png', gray)
    return data.tobytes()


def _projection(K: Array) -> str:
    """Return a row of a calib.txt: the 3x4 projection of a rectified camera at the origin."""
    return ' '.join(f'{value:.12e}' for value in np.hstack([K, np.zeros((3, 1))]).ravel())
