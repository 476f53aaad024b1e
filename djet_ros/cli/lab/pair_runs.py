"""Arguments, workers, progress and tables of the commands that estimate many pairs."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import groupby
import os
from pathlib import Path
import shutil
from typing import Any

from djet_ros.cli.options import add_frames, add_output, add_workers, check_least
from djet_ros.cli.terminal import console, progress_bar, warn
from djet_ros.config.flags import add_flags, flag_values
from djet_ros.lab.methods import Method
from djet_ros.lab.pairs import evaluate_chunk, PairRecord
from djet_ros.lab.runner import C, chunks_of, dask_workers, local_workers, run
from djet_ros.lab.sequences import Dataset, open_datasets, Selection
from djet_ros.lab.store import FILE_NAME, R, RecordStore
from djet_ros.lab.tables import Table as ReadableTable
from djet_ros.recordings.outputs import check_ours, make_folder
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

# Parameters that apply to all methods, so that the comparison stays fair.
SHARED_PARAMETERS = ('estimator.max_features', 'estimator.corner_contrast',
                     'estimator.fast_threshold', 'estimator.ransac_threshold')


def add_run_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the commands that distribute pairs over workers."""
    parser.add_argument('sources', nargs='+', type=Path, metavar='SOURCE',
                        help='a KITTI sequence or a folder of them, a bag with ground truth, or a '
                        'folder of TUM RGB-D, EuRoC or VAROS')
    add_output(parser, 'folder for the results')
    parser.add_argument('--presets', metavar='LIST', default='best,paper',
                        help='presets of parameters to run with (default: %(default)s)')
    add_frames(parser)
    parser.add_argument('--stride', type=int, default=1, metavar='N',
                        help='frame distance of the two images of a pair (default: %(default)s)')
    workers = parser.add_mutually_exclusive_group()
    add_workers(workers)
    workers.add_argument('--scheduler', metavar='ADDRESS',
                         help='Dask scheduler to distribute the work with instead, such as '
                         'tcp://host:8786')
    add_flags(parser, SHARED_PARAMETERS)


def shared_values(args: argparse.Namespace) -> dict[str, Any]:
    """Return the estimator parameters of the command line, by their names without section."""
    return {name.rpartition('.')[2]: value for name, value in flag_values(args).items()}


def run_and_record(args: argparse.Namespace, kind: Callable[..., R], settings: Mapping[str, Any],
                   results: Collection[str], chunks: Sequence[C], work: Callable[[C], list[R]]
                   ) -> list[R]:
    """Process all chunks on this machine, with a progress bar; results: see ``RecordStore``."""
    check_ours(args.output, results, FILE_NAME)
    make_folder(args.output)
    with (RecordStore(args.output, kind, settings, results, overwrite=args.overwrite) as store,
          local_workers(args.workers) as executor, progress_bar('pairs') as progress):
        return run(executor, chunks, work, store, progress)


@contextmanager
def evaluated(args: argparse.Namespace, competing: Sequence[Method], results: Collection[str]
              ) -> Iterator[tuple[list[Dataset], list[PairRecord]]]:
    """
    Evaluate all pairs with a progress bar; datasets are readable only within the context.

    results: see ``RecordStore``.
    """
    check_least(args, workers=1)
    check_ours(args.output, results, FILE_NAME)
    with datasets_of(args, args.sources, args.stride) as datasets:
        make_folder(args.output)
        settings = {'sequences': [dataset.settings() for dataset in datasets],
                    'methods': [method.settings() for method in competing]}
        workers = (dask_workers(args.scheduler) if args.scheduler
                   else local_workers(args.workers))
        # Workers first: if there are none, earlier records are kept.
        with (workers as executor,
              RecordStore(args.output, PairRecord, settings, results,
                          overwrite=args.overwrite) as store,
              progress_bar('pairs') as progress):
            records = run(executor, chunks_of(datasets),
                          partial(evaluate_chunk, methods=list(competing)), store, progress)
        yield datasets, records


@contextmanager
def datasets_of(args: argparse.Namespace, sources: Sequence[Path], stride: int = 1
                ) -> Iterator[list[Dataset]]:
    """Open all sequences; the extracted frames of bags exist only within the context."""
    # Next to the results, which workers on other machines see too.
    workspace = (args.output / f'.frames-{os.getpid()}').resolve()
    try:
        yield open_datasets(sources, Selection(args.start, args.end, stride), workspace, warn)
    finally:
        shutil.rmtree(workspace, ignore_errors=True)


def show(tables: Sequence[ReadableTable], folder: Path) -> None:
    """Print the tables, and the path of the page."""
    out = console()
    for table in tables:
        _print(out, table)
    out.print(f'page: {folder / "index.html"}', soft_wrap=True)


def _print(out: Console, table: ReadableTable) -> None:
    """Print a table section by section; published figures are dim."""
    for section, lines in groupby(table.lines, lambda line: line.cells[:table.sections]):
        printed = Table(title=', '.join(section), title_justify='left', box=SIMPLE_HEAD,
                        padding=0)
        for column, title in enumerate(table.header[table.sections:], table.sections):
            printed.add_column(title, justify='right' if column >= table.numeric else 'left',
                               no_wrap=column == table.sections)
        for line in lines:
            cells = [Text(cell, 'bold' if column in line.bold else '')
                     for column, cell in enumerate(line.cells)]
            printed.add_row(*cells[table.sections:], style='dim' if line.foreign else '')
        out.print(printed)
    out.print(Text(table.caption, 'italic'))
