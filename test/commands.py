"""The ``djet`` command, in the process of the tests or in its own; what it leaves; full disks."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
import os
from pathlib import Path
import resource
import signal
import subprocess
from subprocess import CompletedProcess
import sys
from tempfile import TemporaryFile
from typing import BinaryIO
import warnings

from djet_ros.cli.main import main

DJET = (sys.executable, '-c', 'import sys; from djet_ros.cli.main import main; sys.exit(main())')

# those that Python does not show either
UNSEEN = (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning)


def limit(seconds: float) -> float:
    """Return a limit of time that is longer where more processes run than there are cores."""
    return seconds * max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))


@contextmanager
def redirected(descriptor: int) -> Iterator[BinaryIO]:
    """Yield a file of all that is written to a descriptor, by libraries in C too."""
    kept = os.dup(descriptor)
    with TemporaryFile() as file:
        os.dup2(file.fileno(), descriptor)
        try:
            yield file
        finally:
            os.dup2(kept, descriptor)
            os.close(kept)


@contextmanager
def full_disk(largest: int = 10) -> Iterator[None]:
    """Let this process write no file beyond so many bytes, as on a full disk."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (largest, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def contents(folder: Path) -> dict[Path, bytes]:
    """Return the bytes of all files below a folder."""
    return {path: path.read_bytes() for path in folder.rglob('*') if path.is_file()}


@contextmanager
def usual_signals() -> Iterator[None]:
    """Handle signals as a new process does, and afterwards as before: commands replace that."""
    kept = [(number, signal.signal(number, usual)) for number, usual in (
        (signal.SIGINT, signal.default_int_handler), (signal.SIGTERM, signal.SIG_DFL))]
    try:
        yield
    finally:
        for number, handler in kept:
            signal.signal(number, handler)


def alone(*words: object, **settings: str) -> CompletedProcess[str]:
    """Run a command in a process of its own, with these variables of the environment."""
    return subprocess.run([*DJET, *map(str, words)], capture_output=True, text=True, timeout=300,
                          check=False, env={**os.environ, **settings})


def checked(*words: object, expect: int = 0) -> CompletedProcess[str]:
    """Run a command that has to end with an exit code."""
    done = djet(*words)
    assert done.returncode == expect, done.stderr
    return done


def djet(*words: object, encoding: str = 'utf-8') -> CompletedProcess[str]:
    """
    Run a command to its end, and return what a process with such a stdout would.

    But an exception that the command does not turn into a line is raised. It takes less time than
    to start an interpreter.
    """
    call = [str(word) for word in words]
    sys.stdout.flush()
    sys.stderr.flush()
    with usual_signals(), redirected(1) as out, redirected(2) as err:
        with open(1, 'w', encoding=encoding, closefd=False) as stdout, \
                open(2, 'w', buffering=1, encoding='utf-8', errors='backslashreplace',
                     closefd=False) as stderr, \
                redirect_stdout(stdout), redirect_stderr(stderr), \
                warnings.catch_warnings(record=True) as given:
            warnings.simplefilter('default')
            for category in UNSEEN:
                warnings.simplefilter('ignore', category)
            try:
                code = main(call)
            except SystemExit as end:
                code = int(end.code or 0)
            for one in given:
                print(warnings.formatwarning(one.message, one.category, one.filename,
                                             one.lineno), file=sys.stderr)
        printed = []
        for file in (out, err):
            file.seek(0)
            printed.append(file.read().decode())
    return CompletedProcess(call, code, *printed)
