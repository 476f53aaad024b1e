"""
A place for output: what may lie there already, and how it appears there whole or not at all.

Nothing is replaced unless that was asked for, and nothing that this package did not write is ever
removed.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
import os
from pathlib import Path
import shutil
from tempfile import TemporaryDirectory

from djet_ros.errors import DjetError


def check_file(path: Path, overwrite: bool, *suffixes: str) -> None:
    """Raise DjetError where something is in the way, or the name has none of the suffixes."""
    if path.is_dir():
        raise DjetError(f'{path} is a folder; give the name of a file')
    if suffixes and path.suffix.lower() not in suffixes:
        raise DjetError(f"--output is '{path}'; its name must end in {' or '.join(suffixes)}")
    _check_unused(path, overwrite)


def make_room(folder: Path, ours: Collection[str], overwrite: bool,
              marks: Collection[str] = ()) -> None:
    """
    Make a folder for output; of what an earlier run left there, remove only what is ours.

    ours: names of the files and folders that a run writes; marks: files by which a folder that is
    not empty is known to be an earlier run's (without any, others' files may lie beside ours).
    Raises DjetError where the folder is somebody else's, or ours and not to be overwritten, or
    can't be made; OSError where what is there can't be removed.
    """
    for path in check_room(folder, ours, overwrite, marks):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()
    make_folder(folder)


def check_room(folder: Path, ours: Collection[str], overwrite: bool,
               marks: Collection[str] = ()) -> list[Path]:
    """Raise DjetError as ``make_room`` does; give what it would remove, and touch nothing."""
    _check_bars(folder)
    if marks and folder.is_dir() and any(folder.iterdir()) \
            and not all((folder / mark).is_file() for mark in marks):
        raise DjetError(f'{folder} is not empty and holds no earlier results; choose another '
                        '--output')
    present = [folder / name for name in ours if os.path.lexists(folder / name)]
    if present and not overwrite:
        raise DjetError(f'{folder} holds earlier results; choose another --output, or replace '
                        'them with --overwrite')
    return present


def make_folder(folder: Path) -> None:
    """Make a folder and those that it stands in; DjetError where it can't be, and what bars it."""
    _check_bars(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DjetError(f'{folder} could not be made: {error.strerror or error}; choose another '
                        '--output') from error


def _check_bars(folder: Path) -> None:
    for place in (*reversed(folder.parents), folder):
        if place.is_symlink() and not place.exists():
            raise DjetError(f'{place} is a link to {os.readlink(place)}, which does not exist; '
                            'choose another --output')
        if place.exists() and not place.is_dir():
            raise DjetError(f'{place} exists and is no folder; choose another --output')


def write_whole(path: Path, text: str) -> None:
    """Put a text into a file, in the place of what it held: all or nothing. Raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # A file in a folder that nobody else has: its mode is that of any new file, not of a
    # temporary one.
    with TemporaryDirectory(prefix='.djet-', dir=path.parent) as beside:
        new = Path(beside) / 'new'
        new.write_text(text, 'utf-8')
        os.replace(new, path)


@contextmanager
def appearing(out: Path, overwrite: bool, is_ours: Callable[[Path], bool], what: str
              ) -> Iterator[Path]:
    """
    Give a place beside ``out`` to write a folder to; it takes the name on success, else it goes.

    What has the name already stays until then, and must be ours to be replaced; ``what`` it should
    be is for the user. Raises DjetError, and OSError where there is no room.
    """
    _check_unused(out, overwrite)
    if out.exists() and not (out.is_dir() and is_ours(out)):
        raise DjetError(f'{out} exists and is no {what}; it is not overwritten')
    make_folder(out.parent)
    with TemporaryDirectory(prefix=f'.{out.name}.', dir=out.parent) as beside:
        # What lies in the folder may be named after it, so it has the final name already.
        folder = Path(beside) / out.name
        yield folder
        _exchange(folder, out, Path(beside) / 'replaced')


def _check_unused(path: Path, overwrite: bool) -> None:
    if path.exists() and not overwrite:
        raise DjetError(f'{path} exists already; choose another name or pass --overwrite')


def _exchange(new: Path, out: Path, aside: Path) -> None:
    """Give a folder its final name; what has that name goes aside, and comes back on failure."""
    replaced = out.exists()
    if replaced:
        out.rename(aside)
    try:
        new.rename(out)
    except BaseException:
        if replaced:
            aside.rename(out)
        raise
