"""The configuration as flags of a command line."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from typing import Any

from djet_ros.config.flat import flat, parse_value
from djet_ros.config.sections import Config


def add_flags(parser: argparse.ArgumentParser | argparse._ArgumentGroup,
              names: Iterable[str], config: Config | None = None) -> None:
    """
    Add a command-line flag for each flat name: ``--max-gap`` for ``odometry.max_gap``.

    ``flag_values`` takes what was given out of the parsed arguments; config: what holds where
    nothing was given, for the help.
    """
    known = flat(config or Config())
    for name in names:
        item = known[name]
        choices = item.description.choices
        parser.add_argument(
            '--' + name.rpartition('.')[2].replace('_', '-'), dest=name, default=None,
            metavar='|'.join(choices) if choices else item.kind.__name__.upper(),
            help=f'{item.description.text} (default: {item.value!r})'.replace('%', '%%'))


def flag_values(args: argparse.Namespace) -> dict[str, Any]:
    """Give the parameters given as flags, by flat name; DjetError where one can't be read."""
    known = flat(Config())
    return {name: parse_value(known[name], text) for name, text in vars(args).items()
            if name in known and text is not None}
