"""
Incremental store of records, so that an interrupted run can be resumed.

One JSON object per line: first the settings, then one chunk of pairs each, in the order of
completion.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import asdict
import json
import math
import os
from pathlib import Path
from typing import Any, Generic, TypeVar

import cv2
from djet_ros import __version__
from djet_ros.errors import DjetError
from djet_ros.lab.provenance import code_digest, versions
from djet_ros.recordings.closing import Closing
from djet_ros.recordings.outputs import check_room
import numpy as np

FILE_NAME = 'records.jsonl'

# A dataclass of plain values and tuples of them.
R = TypeVar('R')


class RecordStore(Closing, Generic[R]):
    """
    The records of a run in ``folder/records.jsonl``, including those of an interrupted run.

    kind: dataclass of a record; settings: everything that decides the results, except for the code
    of this package and the versions of its libraries, which are added; results: names of what the
    run will write into the folder. Raises DjetError if the file has other settings, code or
    versions, or is absent while a result is there, unless overwrite is set.
    """

    def __init__(self, folder: Path, kind: Callable[..., R], settings: Mapping[str, Any],
                 results: Collection[str] = (), *, overwrite: bool = False) -> None:
        self.path = folder / FILE_NAME
        if not self.path.exists():
            check_room(folder, results, overwrite)
        self.chunks: dict[str, list[R]] = {}
        self._kind = kind
        settings = _with_code(settings)
        if self.path.exists() and not overwrite:
            # Cuts off an incomplete last line of a killed run.
            os.truncate(self.path, self._read(settings))
            self._file = self.path.open('a', encoding='ascii')
        else:
            self._file = self.path.open('w', encoding='ascii')
            self._write(settings)

    def add(self, chunk: str, records: list[R]) -> None:
        """Store the records of a chunk; they are flushed when this returns."""
        self.chunks[chunk] = records
        self._write({'chunk': chunk, 'records': [_plain(record) for record in records]})

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _write(self, line: dict[str, Any]) -> None:
        self._file.write(json.dumps(line, allow_nan=False) + '\n')
        self._file.flush()

    def _read(self, settings: dict[str, Any]) -> int:
        """Read the chunks of an earlier run; return the length of its complete lines in bytes."""
        content = self.path.read_bytes()
        length = content.rfind(b'\n') + 1
        whole = content[:length].decode('ascii', 'replace').splitlines()
        before = _parsed(self.path, 1, whole[0]) if whole else {}
        if before != settings:
            other = [name for name in settings if settings[name] != before.get(name)]
            raise DjetError(f'{self.path.parent} holds results of other settings '
                            f'({", ".join(other)}); choose another --output, or pass --overwrite')
        for number, line in enumerate(whole[1:], 2):
            chunk = _parsed(self.path, number, line)
            self.chunks[chunk['chunk']] = [self._record(values) for values in chunk['records']]
        return length

    def _record(self, values: dict[str, Any]) -> R:
        numbers = {name: float('nan') if value is None else value
                   for name, value in values.items()}
        return self._kind(**{name: tuple(value) if isinstance(value, list) else value
                             for name, value in numbers.items()})


def _with_code(settings: Mapping[str, Any]) -> dict[str, Any]:
    return {'djet_ros': __version__, 'code': code_digest(),
            # OpenCV and NumPy as loaded: several distributions provide OpenCV.
            'libraries': {'opencv': cv2.__version__, 'numpy': np.__version__,
                          **versions(('scipy', 'poselib'))}, **settings}


def _parsed(path: Path, number: int, line: str) -> dict[str, Any]:
    try:
        content = json.loads(line)
    except json.JSONDecodeError:
        content = None
    if not isinstance(content, dict):
        raise DjetError(f'{path} line {number} is damaged; run again with --overwrite')
    return content


def _plain(record: Any) -> dict[str, Any]:
    return {name: None if isinstance(value, float) and math.isnan(value) else value
            for name, value in asdict(record).items()}


def in_order(store: RecordStore[R], chunk_names: Iterable[str]) -> list[R]:
    """Return the records of all chunks, in the order of the names."""
    return [record for name in chunk_names for record in store.chunks[name]]
