"""Parameters as command-line flags."""

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

    ``flag_values`` reads the values back from the parsed arguments. config: the defaults shown
    in the help.
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
    """Return the parameters given as flags, by flat name; DjetError if one cannot be parsed."""
    known = flat(Config())
    return {name: parse_value(known[name], text) for name, text in vars(args).items()
            if name in known and text is not None}
