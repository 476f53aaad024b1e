"""Text files of numbers, read with a reason for every refusal."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator
from decimal import Decimal, InvalidOperation
import math
from pathlib import Path

from djet_ros.config.safe_files import read_text
from djet_ros.core.types import Array
from djet_ros.errors import DjetError
from djet_ros.odometry.messages import FARTHEST
import numpy as np
from numpy.typing import NDArray

# Stamps are written into messages as int32 seconds.
LATEST_SECOND = 2**31 - 2000


class LineFile:
    """
    A new text file that holds whole lines only.

    Each line is handed to the operating system as it is written, so that a kill loses nothing; of
    one that a disk has no room for nothing stays. Creating, writing and closing raise OSError.
    """

    def __init__(self, path: Path) -> None:
        """Create the file, which must not exist."""
        self._file = path.open('xb', buffering=0)

    def write(self, line: str) -> int:
        """Append a line, with its end."""
        begin = self._file.tell()
        rest = line.encode()
        try:
            while rest:
                rest = rest[self._file.write(rest):]
        except OSError:
            self._file.truncate(begin)
            self._file.seek(begin)
            raise
        return len(line)

    def close(self) -> None:
        """Close the file; writing has already been done line by line."""
        self._file.close()


def lines(path: Path) -> Iterator[tuple[int, str]]:
    """Non-empty lines that are no comment, stripped, with their numbers from 1."""
    for number, line in enumerate(read_text(path).splitlines(), 1):
        if (text := line.strip()) and not text.startswith('#'):
            yield number, text


def numbers(text: str) -> list[float]:
    """Finite numbers separated by spaces or commas; ValueError names the one that is not."""
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
    """Numbers of a text file, (N, columns) float64, one row per line; DjetError names the line."""
    table = array('d')
    for number, text in lines(path):
        try:
            row = numbers(text)
        except ValueError as error:
            raise DjetError(f'{path} line {number}: {error}; mend or replace the file') from error
        if len(row) != columns:
            raise DjetError(f'{path} line {number} has {len(row)} numbers, {columns} belong there')
        table.extend(row)
    return np.array(table, dtype=np.float64).reshape(-1, columns)


def stamped_rows(path: Path, columns: int, stamp: Callable[[str], int]
                 ) -> tuple[NDArray[np.int64], Array]:
    """Stamps (N,) in ns, read exactly from the first column, and the others (N, columns - 1)."""
    rows = number_rows(path, columns)
    stamps = [stamped(path, number, text.replace(',', ' ').split()[0], stamp)
              for number, text in lines(path)]
    return np.array(stamps, dtype=np.int64), rows[:, 1:]


def stamped(path: Path, number: int, text: str, stamp: Callable[[str], int]) -> int:
    """Read one stamp; DjetError names the line."""
    try:
        return stamp(text)
    except ValueError as error:
        raise DjetError(f'{path} line {number}: {error}; mend or replace the file') from error


def check_positions(positions: Array, path: Path) -> None:
    """Raise DjetError that names the file and the first of positions (N, 3) that is nowhere."""
    wrong = np.flatnonzero(~(np.abs(positions) <= FARTHEST).all(axis=1))
    if wrong.size:
        raise DjetError(f'{path}: pose {wrong[0]} is at {positions[wrong[0]].tolist()} m, farther '
                        f'than {FARTHEST:g} m; is it a file of poses?')


def increasing(stamps_ns: NDArray[np.int64], path: Path) -> NDArray[np.int64]:
    """Give the stamps back if each is later than the one before, else DjetError."""
    wrong = np.flatnonzero(np.diff(stamps_ns) <= 0)
    if wrong.size:
        raise DjetError(f'{path}: stamp {wrong[0] + 1} (counted from 0, '
                        f'{stamps_ns[wrong[0] + 1]} ns) is not after the one before it')
    return stamps_ns


def whole_nanoseconds(text: str) -> int:
    """Nanoseconds written as a whole number; ValueError for anything else."""
    if not text.isascii() or not text.isdecimal() or len(text) > 19 \
            or int(text) >= LATEST_SECOND * 10**9:
        raise ValueError(f"'{text[:40]}' is no stamp in nanoseconds")
    return int(text)


def nanoseconds(text: str) -> int:
    """
    Nanoseconds of a decimal number of seconds, rounded half to even, without passing a float.

    Raises ValueError for anything that isn't a number of seconds that a message stamp can hold,
    and for one before zero.
    """
    return _nanoseconds(text, 0)


def signed_nanoseconds(text: str) -> int:
    """Read a stamp as ``nanoseconds`` does, also one before zero."""
    return _nanoseconds(text, -LATEST_SECOND)


def _nanoseconds(text: str, least: int) -> int:
    try:
        seconds = Decimal(text)
    except InvalidOperation:
        raise ValueError(f"'{text[:40]}' is not a number of seconds") from None
    if not seconds.is_finite() or not least <= seconds < LATEST_SECOND:
        raise ValueError(f"'{text[:40]}' is no stamp between {least} and {LATEST_SECOND} s")
    return int(seconds.scaleb(9).to_integral_value())
