"""Text files of numbers and stamps; errors name file, line and value."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator
from decimal import Decimal, InvalidOperation
import math
from pathlib import Path
import re

from djet_ros.config.safe_files import read_text
from djet_ros.core.types import Array
from djet_ros.errors import DjetError
from djet_ros.odometry.messages import FARTHEST
import numpy as np
from numpy.typing import NDArray

# Limit of stamps in seconds: messages hold them as int32.
LATEST_SECOND = 2**31 - 2000


class LineFile:
    """
    A new text file that holds only complete lines.

    Each line is flushed to the operating system, so that a kill loses nothing; a line that does
    not fit on the disk is removed again. Creating, writing and closing raise OSError.
    """

    def __init__(self, path: Path) -> None:
        """Create the file, which must not exist."""
        self._file = path.open('xb', buffering=0)

    def write(self, line: str) -> None:
        """Append a line, which includes its line end."""
        begin = self._file.tell()
        rest = line.encode()
        try:
            while rest:
                rest = rest[self._file.write(rest):]
        except OSError:
            self._file.truncate(begin)
            self._file.seek(begin)
            raise

    def fileno(self) -> int:
        """Return its descriptor."""
        return self._file.fileno()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield (number from 1, stripped text) of the lines that are neither empty nor comments."""
    for number, line in enumerate(read_text(path).splitlines(), 1):
        if (text := line.strip()) and not text.startswith('#'):
            yield number, text


def by_numbers(path: Path) -> list[tuple[int, str]]:
    """Return a key by which 10.png comes after 9.png."""
    return [(int(part), '') if part.isdecimal() else (0, part)
            for part in re.split('([0-9]+)', path.name)]


def numbers(text: str) -> list[float]:
    """Return the finite numbers of a text, separated by spaces or commas; raise ValueError."""
    values = []
    for word in text.replace(',', ' ').split():
        try:
            value = float(word)
        except ValueError:
            raise ValueError(f"'{word[:40]}' is not a number") from None
        if not math.isfinite(value):
            raise ValueError(f"'{word[:40]}' is not a finite number")
        values.append(value)
    return values


def number_rows(path: Path, columns: int) -> Array:
    """Return the numbers (N, columns) of a text file, a row per line; raise DjetError."""
    table = array('d')
    for number, text in lines(path):
        table.extend(numbers_of(f'{path} line {number}', text, columns))
    return np.array(table, dtype=np.float64).reshape(-1, columns)


def numbers_of(place: str, text: str, count: int) -> list[float]:
    """Return so many numbers of a text; raise DjetError, beginning with its place, if wrong."""
    try:
        values = numbers(text)
    except ValueError as error:
        raise DjetError(f'{place}: {error}; correct or replace it') from error
    if len(values) != count:
        raise DjetError(f'{place} has {len(values)} numbers; it must have {count}')
    return values


def stamped_rows(path: Path, columns: int, stamp: Callable[[str], int]
                 ) -> tuple[NDArray[np.int64], Array]:
    """Return stamps (N,) in ns, exact, of the first column, and the others (N, columns - 1)."""
    rows = number_rows(path, columns)
    return read_stamps(path, lambda text: stamp(text.replace(',', ' ').split()[0])), rows[:, 1:]


def image_stamps(path: Path, stamp: Callable[[str], int], images: int) -> NDArray[np.int64]:
    """Return the increasing stamps (N,) in ns of a file with a line per image, or DjetError."""
    stamps = read_stamps(path, stamp)
    check_count(path, len(stamps), images)
    return increasing(stamps, path)


def read_stamps(path: Path, stamp: Callable[[str], int]) -> NDArray[np.int64]:
    """Return the stamps (N,) in ns of all lines; raise DjetError for the first that has none."""
    return np.array([stamped(path, number, text, stamp) for number, text in lines(path)], np.int64)


def stamped(path: Path, number: int, text: str, stamp: Callable[[str], int]) -> int:
    """Return one stamp; raise DjetError, with file and line, if it is invalid."""
    try:
        return stamp(text)
    except ValueError as error:
        raise DjetError(f'{path} line {number}: {error}; correct or replace it') from error


def check_positions(positions: Array, path: Path) -> None:
    """Raise DjetError for the first of positions (N, 3) that is not finite or too far away."""
    wrong = np.flatnonzero(~(np.abs(positions) <= FARTHEST).all(axis=1))
    if wrong.size:
        raise DjetError(f'{path}: pose {wrong[0]} is at {positions[wrong[0]].tolist()} m, farther '
                        f'than {FARTHEST:g} m; is it a file of poses?')


def check_count(path: Path, have: int, images: int) -> None:
    """Raise DjetError if a file has not one line per image."""
    if have != images:
        raise DjetError(f'{path} has {have} lines for {images} images; it must have one per '
                        'image')


def increasing(stamps_ns: NDArray[np.int64], path: Path) -> NDArray[np.int64]:
    """Return the stamps; raise DjetError if they do not strictly increase."""
    wrong = np.flatnonzero(np.diff(stamps_ns) <= 0)
    if wrong.size:
        raise DjetError(f'{path}: stamp {wrong[0] + 1} (counted from 0, '
                        f'{stamps_ns[wrong[0] + 1]} ns) is not after the one before it; stamps '
                        'must increase')
    return stamps_ns


def whole_nanoseconds(text: str) -> int:
    """Return nanoseconds written as an integer; raise ValueError for anything else."""
    if not text.isascii() or not text.isdecimal() or len(text) > 19 \
            or int(text) >= LATEST_SECOND * 10**9:
        raise ValueError(f"'{text[:40]}' is not a stamp in nanoseconds")
    return int(text)


def nanoseconds(text: str) -> int:
    """
    Return the nanoseconds of a decimal number of seconds, exact, rounded half to even.

    Raises ValueError if it is not a number, negative, or too large for the stamp of a message.
    """
    return _nanoseconds(text, 0)


def signed_nanoseconds(text: str) -> int:
    """Return the same as ``nanoseconds``, but accept negative stamps."""
    return _nanoseconds(text, -LATEST_SECOND)


def _nanoseconds(text: str, least: int) -> int:
    try:
        seconds = Decimal(text)
    except InvalidOperation:
        raise ValueError(f"'{text[:40]}' is not a number of seconds") from None
    if not seconds.is_finite() or not least <= seconds < LATEST_SECOND:
        raise ValueError(f"'{text[:40]}' is not a stamp between {least} and {LATEST_SECOND} s")
    return int(seconds.scaleb(9).to_integral_value())
