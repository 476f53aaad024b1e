"""Fixtures of several tests: the real KITTI frames, and small sequences in KITTI's layout."""

from collections.abc import Callable
import os
from pathlib import Path
import signal

from djet_ros.threads import one_blas_thread
import pytest

ROOT = Path(__file__).resolve().parent.parent


def pytest_configure() -> None:
    """Use one thread a process, set before NumPy is imported, and let SIGINT end commands."""
    one_blas_thread()
    # A shell's background job ignores SIGINT, and so would the commands that tests interrupt.
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    from hypothesis import settings
    # Hypothesis' deadline of 200 ms an example is missed where others use the cores too.
    settings.register_profile('no deadline', deadline=None)
    settings.load_profile('no deadline')


@pytest.fixture(scope='session')
def kitti() -> Path:
    """Folder with sequences/ and poses/ of real frames: in $DJET_DATA or next to the project."""
    for data in (os.environ.get('DJET_DATA'), ROOT.parent / 'shared' / 'data'):
        if data and (Path(data) / 'kitti' / 'sequences').is_dir():
            return Path(data) / 'kitti'
    pytest.skip('no real frames: DJET_DATA is not set to a folder with kitti/sequences, and '
                f'{ROOT.parent / "shared" / "data"} is not there')


@pytest.fixture(scope='session')
def freiburg1_rpy(kitti: Path) -> Path:
    """Folder of real frames of TUM freiburg1_rpy, from a hand that rotates the camera fast."""
    folder = kitti.parent / 'tum' / 'rgbd_dataset_freiburg1_rpy'
    if not folder.is_dir():
        pytest.skip(f'no real frames: {folder} is not there')
    return folder


@pytest.fixture(scope='session')
def corridor(kitti: Path) -> Path:
    """Folder of rendered frames of TartanAir: a corridor with exact truth, hard to track in."""
    folder = kitti.parent / 'tartanair' / 'sequences' / 'indoor'
    if not folder.is_dir():
        pytest.skip(f'no frames of TartanAir: {folder} is not there')
    return folder


@pytest.fixture
def small_kitti(tmp_path: Path) -> Callable[..., Path]:
    """Return a function that writes a sequence of noise images, and returns its folder."""
    return lambda **sizes: write_small_kitti(tmp_path / 'dataset', **sizes)


def write_small_kitti(dataset: Path, frames: int = 6, size: tuple[int, int] = (64, 48),
                      name: str = '07') -> Path:
    """Write a KITTI sequence with ground truth: half a metre ahead and 0.02 rad to a frame."""
    import cv2
    import numpy as np
    folder = dataset / 'sequences' / name
    (folder / 'image_0').mkdir(parents=True)
    (dataset / 'poses').mkdir(exist_ok=True)
    rng = np.random.default_rng(7)
    width, height = size
    for i in range(frames):
        image = rng.integers(0, 256, (height, width), dtype=np.uint8)
        cv2.imwrite(str(folder / 'image_0' / f'{i:06d}.png'), image)
    camera = f'60.5 0 {width / 2} 0 0 60.5 {height / 2} 0 0 0 1 0'
    (folder / 'calib.txt').write_text(f'P0: {camera}\nP1: {camera}\n')
    (folder / 'times.txt').write_text(''.join(f'{i * 0.1036223:.6e}\n' for i in range(frames)))
    angles = 0.02 * np.arange(frames)
    (dataset / 'poses' / f'{name}.txt').write_text(''.join(
        f'{np.cos(a):.12e} 0 {np.sin(a):.12e} 0 0 1 0 0 {-np.sin(a):.12e} 0 {np.cos(a):.12e} '
        f'{0.5 * i:.12e}\n' for i, a in enumerate(angles)))
    return folder
