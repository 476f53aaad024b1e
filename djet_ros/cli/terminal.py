"""What commands show in a terminal while they work and in the end."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
import os
import sys

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text


# Columns of tables that go to a file or to another program, where nothing has to be cut.
_FILE_WIDTH = 200


def console() -> Console:
    """
    Give what tables are printed on: as wide as the terminal, or as wide as they are.

    Names come from strangers' folders and bags: what looks like rich's markup is not.
    """
    found = Console(markup=False)
    return (found if found.is_terminal or 'COLUMNS' in os.environ
            else Console(markup=False, width=_FILE_WIDTH))


def warn(line: str) -> None:
    """Say in a line on stderr what did not keep a command from its end."""
    print(f'djet: warning: {line}', file=sys.stderr)


class _Rate(ProgressColumn):
    """Steps per second so far."""

    def render(self, task: Task) -> Text:
        return Text(f'{task.speed or 0:.1f}/s')


@contextmanager
def progress_bar(what: str, total: int | None = None) -> Iterator[Callable[..., None]]:
    """
    Show a bar on stderr, if that is a terminal; give the function that moves it.

    That goes on by one without arguments, else to (done) or (done, of how many).
    """
    console = Console(stderr=True)
    bar = Progress(TextColumn('{task.description}', markup=False), BarColumn(),
                   MofNCompleteColumn(), _Rate(), TimeRemainingColumn(), console=console,
                   transient=True, disable=not console.is_terminal)
    # A bar of rich 13 that is disabled still leaves an empty line behind where it ends.
    with bar if console.is_terminal else nullcontext():
        task = bar.add_task(what, total=total)

        def move(done: int | None = None, total: int | None = None) -> None:
            if done is None:
                bar.advance(task)
            else:
                bar.update(task, completed=done, total=total)

        yield move


def new_table(title: str, *headings: str) -> Table:
    """Give a table with a column of names and others of figures; two without headings."""
    table = Table(title=title, show_header=bool(headings))
    for index, heading in enumerate(headings or ('', '')):
        table.add_column(heading, justify='right' if index else 'left')
    return table


def compact_table(*headings: str, names: int = 1, title: str | None = None) -> Table:
    """Give a table of many columns without lines between; names: columns that hold no figures."""
    table = Table(title=title, title_justify='left', box=SIMPLE_HEAD, padding=0)
    for index, heading in enumerate(headings):
        table.add_column(heading, justify='right' if index >= names else 'left', no_wrap=True)
    return table


def spread(statistics: dict[str, float] | None) -> str:
    """Statistics of errors as ``mean / median / p95 / max``."""
    if statistics is None:
        return 'none'
    return ' / '.join(f'{statistics[name]:.3f}' for name in ('mean', 'median', 'p95', 'max'))
