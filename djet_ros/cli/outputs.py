"""What the commands that write one file share."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from djet_ros.errors import DjetError


def add_overwrite(parser: argparse.ArgumentParser) -> None:
    """Add the flag without which nothing is replaced."""
    parser.add_argument('--overwrite', action='store_true', help='replace what --output holds')


def add_json_output(parser: argparse.ArgumentParser, what: str) -> None:
    """Add --output for a JSON file of `what`, which a plot lies beside, and --overwrite."""
    parser.add_argument('--output', type=Path, required=True, metavar='FILE.json',
                        help=f'where the {what} go; the plot goes to FILE.png')
    add_overwrite(parser)


def write_json(path: Path, values: dict[str, Any]) -> Path:
    """Write values, and give the path of the plot that goes beside them."""
    path.write_text(json.dumps(values, indent=2) + '\n', encoding='utf-8')
    return path.with_suffix('.png')


def check_output(path: Path, overwrite: bool, *suffixes: str) -> None:
    """Raise DjetError where a file is in the way, or its name has none of the suffixes."""
    if suffixes and path.suffix.lower() not in suffixes:
        raise DjetError(f"--output is '{path}'; its name must end in {' or '.join(suffixes)}")
    if path.is_dir():
        raise DjetError(f'{path} is a folder; give the name of a file')
    if path.exists() and not overwrite:
        raise DjetError(f'{path} exists; give another name or --overwrite')
