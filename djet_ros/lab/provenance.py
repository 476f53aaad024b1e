"""Provenance of results: a digest of the code, and the versions of libraries."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
import hashlib
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import djet_ros


def code_digest(more: Iterable[Path] = ()) -> str:
    """Return a digest of the package's code, and of more files."""
    digest = hashlib.sha256(_package())
    for path in more:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


@cache
def _package() -> bytes:
    """Return a digest of the package at the first call."""
    digest, folder = hashlib.sha256(), Path(djet_ros.__file__).parent
    for path in sorted(path for kind in ('*.py', '*.c', '*.h') for path in folder.rglob(kind)):
        digest.update(path.relative_to(folder).as_posix().encode() + path.read_bytes())
    return digest.digest()


def versions(packages: Iterable[str]) -> dict[str, str]:
    """Return the installed versions of distributions by their names."""
    return {name: _version(name) for name in packages}


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return 'not installed'
