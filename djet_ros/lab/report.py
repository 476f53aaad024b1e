"""The results folder of an evaluation: tables, records, trajectories, plots, and one page."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, astuple, dataclass
import html
import os
from pathlib import Path
from urllib.parse import quote

from djet_ros import __version__
from djet_ros.lab import plots
from djet_ros.lab.evo import trajectory_metrics
from djet_ros.lab.integration import (
    estimated_trajectory,
    StampedTrajectory,
    true_trajectory,
)
from djet_ros.lab.methods import Method, TITLES
from djet_ros.lab.pairs import FAILURE, PairRecord
from djet_ros.lab.published import TABLE_1
from djet_ros.lab.sequences import Dataset
from djet_ros.lab.summary import drift_row, DriftRow, table_rows
from djet_ros.lab.tables import (
    drift_csv,
    drift_table,
    html_table,
    latex,
    Line,
    markdown,
    number,
    pairs_csv,
    results_table,
    rows_csv,
    Table,
    table_csv,
    timings_csv,
)
from djet_ros.recordings.outputs import write_whole

CAPTION = ('Errors of relative poses against ground truth in degrees, of rotation (rot.) and '
           'translation direction (tr.); Hamming distances in bits; milliseconds per pair. '
           f'Failed: {FAILURE}. Means, medians and p95 are over the pairs that a method '
           'estimated (pairs); the smallest is bold, if no other method estimated more pairs.')
PUBLISHED_NOTE = ' Rows of "the paper" are the published values, for the whole sequence.'

_CSS = """
body { font: 16px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 75rem; padding: 0 1rem;
       color: #1a1a1a; background: #fff; }
h1, h2, h3 { line-height: 1.2; }
table { border-collapse: collapse; font-size: 0.85rem; font-variant-numeric: tabular-nums; }
caption { text-align: left; padding: 0.5rem 0; color: #444; }
th, td { padding: 0.25rem 0.6rem; text-align: left; border-bottom: 1px solid #ddd; }
thead th { border-bottom: 2px solid #888; }
.section td { border-top: 2px solid #bbb; }
.number { text-align: right; white-space: nowrap; }
tr:has(i) { background: #f4f1ea; }
.wide { overflow-x: auto; }
img { max-width: 100%; height: auto; display: block; margin: 1rem 0; }
"""

_PAGE = """\
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>{css}</style>
</head>
<body>
{body}
<p>Written by djet_ros {version}.</p>
</body>
</html>
"""

# What an evaluation writes into its folder.
FILES = ('index.html', 'table1.csv', 'table1.md', 'table1.tex', 'pairs.csv', 'timings.csv',
         'drift.csv', 'evo.csv', 'plots', 'trajectories')

# Trajectories of one sequence by preset and method.
Estimates = dict[str, dict[str, StampedTrajectory]]


@dataclass(frozen=True)
class Picture:
    """A plot of the page: its path and description."""

    path: Path
    text: str


def write_report(folder: Path, datasets: Sequence[Dataset], methods: Sequence[Method],
                 records: Sequence[PairRecord], *, with_evo: bool = False) -> list[Table]:
    """
    Write everything but the record store into the folder; return the readable tables.

    with_evo: whether to add evo's metrics of the trajectories.
    """
    rows = table_rows(records)
    printed = {dataset.name: TABLE_1[dataset.benchmark] for dataset in datasets
               if dataset.benchmark in TABLE_1}
    tables = [results_table(CAPTION + PUBLISHED_NOTE if printed else CAPTION, rows, printed)]
    write_whole(folder / 'table1.csv', rows_csv(rows, with_change=False))
    write_whole(folder / 'table1.md', markdown(tables[0]))
    write_whole(folder / 'table1.tex', latex(tables[0]))
    write_whole(folder / 'pairs.csv', pairs_csv(records, with_change=False))
    write_whole(folder / 'timings.csv', timings_csv(records, with_change=False))
    files = ['table1.csv', 'table1.md', 'table1.tex', 'pairs.csv', 'timings.csv', 'drift.csv']
    groups = {dataset.name: plots.grouped([record for record in records
                                           if record.sequence == dataset.name])
              for dataset in datasets}
    trajectories = {dataset.name: _trajectories(folder, dataset, groups[dataset.name])
                    for dataset in datasets}
    pictures = {name: list(_pictures(folder, name, found, *trajectories[name]))
                for name, found in groups.items()}
    drifts = list(_drifts(trajectories))
    write_whole(folder / 'drift.csv', drift_csv(drifts))
    if drifts:
        tables.append(drift_table(drifts))
    if with_evo:
        tables.append(_evo_table(folder, datasets, methods))
        write_whole(folder / 'evo.csv', table_csv(tables[-1]))
        files.append('evo.csv')
    write_page(folder, 'Relative pose of two frames: evaluation', tables, pictures, methods,
               files)
    return tables


def trajectory_file(folder: Path, sequence: str, preset: str, method: str) -> Path:
    """Return the path of the trajectory of a method."""
    return folder / 'trajectories' / sequence / f'{method}_{preset}.tum'


def truth_file(folder: Path, sequence: str) -> Path:
    """Return the path of the ground truth of the trajectories."""
    return folder / 'trajectories' / sequence / 'ground_truth.tum'


def _pictures(folder: Path, title: str, groups: plots.Groups, truth: StampedTrajectory,
              estimates: Estimates) -> Iterator[Picture]:
    place = folder / 'plots'
    for kind, draw, text in (
            ('errors', plots.plot_errors_by_frame, 'error of each pair along the sequence'),
            ('cumulative', plots.plot_cumulative, 'cumulative distribution of the errors'),
            ('boxes', plots.plot_boxes, 'distribution of the errors by method')):
        path = place / f'{title}_{kind}.png'
        draw(path, title, groups)
        yield Picture(path, text)
    path = place / f'{title}_trajectory.png'
    plots.plot_trajectories(path, title, truth, estimates)
    yield Picture(path, 'trajectories from above')


def _trajectories(folder: Path, dataset: Dataset, groups: plots.Groups
                  ) -> tuple[StampedTrajectory, Estimates]:
    """Integrate the motions of every method, and write trajectories and ground truth."""
    estimates: Estimates = {}
    for preset, methods in groups.items():
        for method, records in methods.items():
            trajectory = estimated_trajectory(dataset, records)
            trajectory.write_tum(trajectory_file(folder, dataset.name, preset, method))
            estimates.setdefault(preset, {})[method] = trajectory
            truth = true_trajectory(dataset, records)
    truth.write_tum(truth_file(folder, dataset.name))
    return truth, estimates


def _drifts(trajectories: dict[str, tuple[StampedTrajectory, Estimates]]) -> Iterator[DriftRow]:
    for sequence, (truth, estimates) in trajectories.items():
        for preset, methods in estimates.items():
            for method, estimate in methods.items():
                row = drift_row(sequence, method, preset, truth, estimate)
                if row is not None:
                    yield row


def _evo_table(folder: Path, datasets: Sequence[Dataset], methods: Sequence[Method]) -> Table:
    """Compare every trajectory with the ground truth by evo, several in parallel."""
    keys = [(dataset.name, method.preset, method.name)
            for dataset in datasets for method in methods]
    with ThreadPoolExecutor(os.cpu_count()) as threads:
        metrics = list(threads.map(lambda key: trajectory_metrics(
            truth_file(folder, key[0]), trajectory_file(folder, *key)), keys))
    lines = [Line((*key[:2], TITLES[key[2]], *(number(value, 3) for value in astuple(found))))
             for key, found in zip(keys, metrics)]
    return Table("evo's metrics of the trajectories (RMSE; step lengths from ground truth): APE "
                 'of positions after alignment, and RPE from frame to frame.',
                 ('sequence', 'preset', 'method', 'APE, m', 'RPE, m', 'RPE, deg'),
                 tuple(lines), 2, 3)


def write_page(folder: Path, title: str, tables: Iterable[Table],
               pictures: dict[str, list[Picture]], methods: Sequence[Method],
               files: Sequence[str]) -> None:
    """Write index.html: tables, plots by section, parameters, and links to the files."""
    parts = [f'<h1>{html.escape(title)}</h1>',
             *(f'<div class="wide">{html_table(table)}</div>' for table in tables),
             f'<p>Files: {", ".join(_link(name) for name in files)}.</p>']
    for section, shown in pictures.items():
        parts.append(f'<h2>{html.escape(section)}</h2>')
        parts += [_image(picture, folder, section) for picture in shown]
    parts.append(_parameters(methods))
    write_whole(folder / 'index.html', _PAGE.format(
        title=html.escape(title), css=_CSS, body='\n'.join(parts), version=__version__))


def _link(name: str) -> str:
    return f'<a href="{html.escape(name)}">{html.escape(name)}</a>'


def _image(picture: Picture, folder: Path, section: str) -> str:
    source = quote(picture.path.relative_to(folder).as_posix())
    text = html.escape(f'{section}: {picture.text}')
    return f'<img src="{source}" alt="{text}" loading="lazy">'


def _parameters(methods: Sequence[Method]) -> str:
    """Return the parameters of each preset and change as collapsed HTML blocks."""
    blocks = {}
    for method in methods:
        head = f'{method.preset}, {method.change}' if method.change else method.preset
        values = ''.join(f'{name}: {value}\n' for name, value in asdict(method.config).items()
                         if name != 'method')
        blocks[head] = (f'<details><summary>{html.escape(head)}</summary>'
                        f'<pre>{html.escape(values)}</pre></details>')
    return '<h2>Parameters</h2>\n' + '\n'.join(blocks.values())
