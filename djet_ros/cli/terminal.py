"""Terminal output of the commands: progress bars, warnings and tables."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
import os
import sys

from djet_ros.errors import one_line
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

# Width in characters of tables written to a file or a pipe, wide enough to truncate nothing.
_FILE_WIDTH = 200


def console() -> Console:
    """
    Return the console for tables, as wide as the terminal or, for a file, as wide as needed.

    Markup is disabled: brackets in the names of folders and topics are not markup.
    """
    found = Console(markup=False)
    return (found if found.is_terminal or 'COLUMNS' in os.environ
            else Console(markup=False, width=_FILE_WIDTH))


def warn(line: str) -> None:
    """Print a warning of one line on stderr; names that a bag has in it control no terminal."""
    print(f'djet: warning: {one_line(line)}', file=sys.stderr)


class _Rate(ProgressColumn):
    """Steps per second so far."""

    def render(self, task: Task) -> Text:
        return Text(f'{task.speed or 0:.1f}/s')


@contextmanager
def progress_bar(what: str, total: int | None = None) -> Iterator[Callable[..., None]]:
    """
    Show a progress bar on stderr, if that is a terminal; yield the function that updates it.

    Without arguments it advances by one; else it sets (done) or (done, total).
    """
    console = Console(stderr=True)
    bar = Progress(TextColumn('{task.description}', markup=False), BarColumn(),
                   MofNCompleteColumn(), _Rate(), TimeRemainingColumn(), console=console,
                   transient=True, disable=not console.is_terminal)
    # In rich 13 even a disabled bar prints an empty line when it ends.
    with bar if console.is_terminal else nullcontext():
        task = bar.add_task(what, total=total)

        def update(done: int | None = None, total: int | None = None) -> None:
            if done is None:
                bar.advance(task)
            else:
                bar.update(task, completed=done, total=total)

        yield update


def new_table(title: str, *headings: str) -> Table:
    """Return a table of a column of names and columns of numbers; of two without headings."""
    table = Table(title=title, show_header=bool(headings))
    for index, heading in enumerate(headings or ('', '')):
        table.add_column(heading, justify='right' if index else 'left')
    return table


def compact_table(*headings: str, names: int = 1, title: str | None = None) -> Table:
    """Return a narrow table without rules; names: number of leading columns of text."""
    table = Table(title=title, title_justify='left', box=SIMPLE_HEAD, padding=0)
    for index, heading in enumerate(headings):
        table.add_column(heading, justify='right' if index >= names else 'left', no_wrap=True)
    return table


def spread(statistics: dict[str, float] | None) -> str:
    """Return statistics of errors as ``mean / median / p95 / max``."""
    if statistics is None:
        return 'none'
    return ' / '.join(f'{statistics[name]:.3f}' for name in ('mean', 'median', 'p95', 'max'))
