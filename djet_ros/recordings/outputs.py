"""
Output files and folders: what may be overwritten, and atomic writes.

Nothing is replaced without ``overwrite``, and nothing that this package did not write is removed.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
import fcntl
import os
from pathlib import Path
import shutil
from tempfile import mkdtemp, TemporaryDirectory

from djet_ros.errors import DjetError
from djet_ros.interrupts import interrupt_after


def check_file(path: Path, overwrite: bool, *suffixes: str, inputs: Iterable[Path] = ()) -> None:
    """
    Raise DjetError if a file can't be written there, or its name has none of the suffixes.

    inputs: files and folders that are read; the file may be none of them, and in none of them.
    """
    for given in inputs:
        if path.resolve().is_relative_to(given.resolve()):
            raise DjetError(f"--output is '{path}', which belongs to the input; choose another "
                            'one')
    if path.is_dir():
        raise DjetError(f'{path} is a folder; name a file')
    if suffixes and path.suffix.lower() not in suffixes:
        raise DjetError(f"--output is '{path}'; its name must end in {' or '.join(suffixes)}")
    _check_unused(path, overwrite)


def make_room(folder: Path, ours: Collection[str], overwrite: bool) -> None:
    """
    Make a folder for output, and remove what an earlier run wrote there, but no other files.

    Arguments and errors are those of ``check_room``; raises OSError if earlier files can't be
    removed.
    """
    for path in check_room(folder, ours, overwrite):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()
    make_folder(folder)


@contextmanager
def replaced_together(folder: Path, ours: Collection[str], overwrite: bool) -> Iterator[Path]:
    """
    Yield a temporary folder, whose files replace those of an earlier run once all are written.

    On failure the earlier ones are kept. Arguments and errors are those of ``check_room``.
    """
    check_room(folder, ours, overwrite)
    make_folder(folder)
    with TemporaryDirectory(prefix='.djet-', dir=folder) as scratch:
        yield Path(scratch)
        with interrupt_after():
            make_room(folder, ours, overwrite)
            for path in Path(scratch).iterdir():
                path.rename(folder / path.name)


class SetAside:
    """
    What an earlier run wrote into a folder, in a hidden folder there until it is given up.

    Arguments and errors are those of ``check_room``. A run that is killed leaves it hidden.
    """

    def __init__(self, folder: Path, ours: Collection[str], overwrite: bool,
                 marks: Collection[str] = ()) -> None:
        """Move the files of an earlier run; all stay where they were if that fails."""
        self._folder = folder
        self._place: Path | None = None
        present = check_room(folder, ours, overwrite, marks)
        make_folder(folder)
        if not present:
            return
        self._place = Path(mkdtemp(prefix='.earlier-', dir=folder))
        try:
            for path in present:
                path.rename(self._place / path.name)
        except BaseException:
            self.put_back()
            raise

    @property
    def kept(self) -> bool:
        """Whether anything was set aside, and not given up."""
        return self._place is not None

    def give_up(self) -> None:
        """Remove what was set aside, if it is still there. Raises OSError."""
        if self._place is not None:
            shutil.rmtree(self._place)
            self._place = None

    def put_back(self) -> None:
        """Move it back to where it was, unless it was given up. Raises OSError."""
        if self._place is not None:
            for path in self._place.iterdir():
                path.rename(self._folder / path.name)
            self._place.rmdir()
            self._place = None


def lock(descriptor: int) -> None:
    """Mark an open file as that of a running process, until it is closed or the process ends."""
    # Some network file systems have no locks, and need none to be written to.
    with suppress(OSError):
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


def is_locked(path: Path) -> bool:
    """Return whether a running process has locked a file, if there is one."""
    if not path.is_file():
        return False
    with path.open('rb') as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        except OSError:
            return False  # without locks, see above
    return False


def check_room(folder: Path, ours: Collection[str], overwrite: bool,
               marks: Collection[str] = ()) -> list[Path]:
    """
    Return what an earlier run wrote into a folder.

    ours: names of the files and folders that a run writes; marks: files that identify a non-empty
    folder as that of an earlier run (none: foreign files next to ours are accepted). Raises
    DjetError if the folder is a foreign one, ours without ``overwrite``, or can't be one.
    """
    _check_obstacles(folder)
    if marks and folder.is_dir() and any(folder.iterdir()) \
            and not all((folder / mark).is_file() for mark in marks):
        raise _foreign(folder)
    present = [folder / name for name in ours if os.path.lexists(folder / name)]
    if present and not overwrite:
        raise DjetError(f'{folder} holds earlier results; choose another --output, or replace '
                        'them with --overwrite')
    return present


def check_ours(folder: Path, ours: Collection[str], mark: str) -> None:
    """
    Raise DjetError if a folder holds files of others, such as images, but none of an earlier run.

    ours: names that a run writes, of which an interrupted one leaves some; mark: the one of a
    folder in which foreign files are accepted. Hidden files are.
    """
    _check_obstacles(folder)
    if folder.is_dir() and not (folder / mark).is_file() and any(
            path.name not in ours and not path.name.startswith('.')
            for path in folder.iterdir()):
        raise _foreign(folder)


def _foreign(folder: Path) -> DjetError:
    return DjetError(f'{folder} is not empty and holds no earlier results; choose another '
                     '--output')


def make_folder(folder: Path) -> None:
    """Make a folder with its parents; raise DjetError with the reason if it can't be made."""
    _check_obstacles(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DjetError(f'{folder} could not be created: {error.strerror or error}; choose '
                        'another --output') from error


def check_writable(path: Path) -> None:
    """Make the folder of a file; raise DjetError if it, or a file in it, can't be created."""
    make_folder(path.parent)
    try:
        TemporaryDirectory(prefix='.djet-', dir=path.parent).cleanup()
    except OSError as error:
        raise DjetError(f'{path} could not be created: {error.strerror or error}; choose another '
                        '--output') from error


def _check_obstacles(folder: Path) -> None:
    for place in (*reversed(folder.parents), folder):
        if place.is_symlink() and not place.exists():
            raise DjetError(f'{place} is a link to {os.readlink(place)}, which does not exist; '
                            'choose another --output')
        if place.exists() and not place.is_dir():
            raise DjetError(f'{place} exists and is not a folder; choose another --output')


def write_whole(path: Path, text: str) -> None:
    """Write or replace a text file atomically. Raises OSError that names it."""
    with replaced_whole(path) as new:
        new.write_text(text, 'utf-8')


@contextmanager
def replaced_whole(path: Path) -> Iterator[Path]:
    """
    Yield a path in a temporary folder, of a file that is to be ``path``; on failure that is kept.

    The file has the suffix of ``path``. Raises OSError that names ``path``.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # A new file in a temporary folder, not a temporary file: its mode follows the umask.
        with TemporaryDirectory(prefix='.djet-', dir=path.parent) as scratch:
            new = Path(scratch) / f'new{path.suffix}'
            yield new
            os.replace(new, path)
    except OSError as error:
        # The temporary file means nothing to the user, and a full disk names none.
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error


@contextmanager
def created_whole(out: Path, overwrite: bool, is_ours: Callable[[Path], bool], what: str
                  ) -> Iterator[Path]:
    """
    Yield a temporary folder next to ``out``, renamed to ``out`` on success and removed on failure.

    An existing ``out`` is kept until then, and replaced only if ``is_ours`` accepts it; what: its
    description for the error message. Raises DjetError, and OSError if the disk is full.
    """
    _check_unused(out, overwrite)
    if out.exists() and not (out.is_dir() and is_ours(out)):
        raise DjetError(f'{out} exists and is no {what}; it is not overwritten')
    make_folder(out.parent)
    with TemporaryDirectory(prefix=f'.{out.name}.', dir=out.parent) as scratch:
        # Files in the folder may be named after it, so it has its final name from the start.
        folder = Path(scratch) / out.name
        yield folder
        _exchange(folder, out, Path(scratch) / 'replaced')


def _check_unused(path: Path, overwrite: bool) -> None:
    if path.exists() and not overwrite:
        raise DjetError(f'{path} exists already; choose another name or pass --overwrite')


def _exchange(new: Path, out: Path, aside: Path) -> None:
    """Rename a folder to ``out``; an existing one moves to ``aside``, and back on failure."""
    replaced = out.exists()
    if replaced:
        out.rename(aside)
    try:
        new.rename(out)
    except BaseException:
        if replaced:
            aside.rename(out)
        raise
