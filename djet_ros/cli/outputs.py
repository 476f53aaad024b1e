"""What the commands that write one file share."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any


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
