"""What the commands that write one file share."""

from __future__ import annotations

import argparse
from pathlib import Path

from djet_ros.errors import DjetError


def add_overwrite(parser: argparse.ArgumentParser) -> None:
    """Add the flag without which nothing is replaced."""
    parser.add_argument('--overwrite', action='store_true', help='replace what --output holds')


def check_output(path: Path, overwrite: bool, *suffixes: str) -> None:
    """Raise DjetError where a file is in the way, or its name has none of the suffixes."""
    if suffixes and path.suffix.lower() not in suffixes:
        raise DjetError(f"--output is '{path}'; its name must end in {' or '.join(suffixes)}")
    if path.is_dir():
        raise DjetError(f'{path} is a folder; give the name of a file')
    if path.exists() and not overwrite:
        raise DjetError(f'{path} exists; give another name or --overwrite')
