"""The results folder of an ablation."""

from __future__ import annotations

from collections.abc import Sequence
import math
from pathlib import Path
from typing import Any

from djet_ros.core.estimator_config import PRESETS
from djet_ros.lab.ablation import Ratio, ratios_to_base
from djet_ros.lab.methods import Method, TITLES
from djet_ros.lab.pairs import PairRecord
from djet_ros.lab.published import TABLE_2
from djet_ros.lab.report import CAPTION, Picture, write_page
from djet_ros.lab.sequences import Dataset
from djet_ros.lab.style import COLOURS, figure, legend_below
from djet_ros.lab.summary import table_rows, TableRow
from djet_ros.lab.tables import (
    ablation_table,
    Line,
    markdown,
    pairs_csv,
    published_table,
    rows_csv,
    Table,
    timings_csv,
)
from djet_ros.recordings.outputs import write_whole
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator

_CAPTION = f'D-JET with one change at a time from a preset; – is the preset itself. {CAPTION}'
_GOOD_START = 'All started from the pose of RP-E, preset best, with only its inliers as matches.'
_PUBLISHED = ("The paper's Table 2, as printed there: another sequence (VAROS, all frames), and "
              'errors in what the table calls degrees.')
_RATIOS = ('Ratios of mean and median errors to those of D-JET with the unchanged preset, on the '
           'pairs that both estimated. In brackets is the 95 % interval of a paired bootstrap '
           'over pairs: if it contains 1, the difference is not significant.')
# What an ablation writes into its folder.
FILES = ('index.html', 'ablation.csv', 'ablation.md', 'pairs.csv', 'timings.csv', 'plots')

_MARKERS = {'djet': 'o', 'rpe': 'D', 'five_point': 's'}
_LINE = 0.24


def write_ablation(folder: Path, datasets: Sequence[Dataset], methods: Sequence[Method],
                   records: Sequence[PairRecord]) -> list[Table]:
    """Write everything but the record store into the folder; return the readable tables."""
    rows = table_rows(records)
    caption = f'{_CAPTION} {_GOOD_START}' if methods[0].good_start else _CAPTION
    tables = [ablation_table(caption, rows), ratios_table(records),
              published_table(_PUBLISHED, TABLE_2)]
    write_whole(folder / 'ablation.csv', rows_csv(rows, with_change=True))
    write_whole(folder / 'ablation.md', '\n'.join(markdown(table) for table in tables))
    write_whole(folder / 'pairs.csv', pairs_csv(records, with_change=True))
    write_whole(folder / 'timings.csv', timings_csv(records, with_change=True))
    pictures = {}
    for dataset in datasets:
        path = folder / 'plots' / f'{dataset.name}_ablation.png'
        plot_ablation(path, dataset.name, [row for row in rows if row.sequence == dataset.name])
        pictures[dataset.name] = [Picture(path, 'mean and median error of each variant')]
    write_page(folder, 'D-JET: ablation', tables, pictures, methods,
               ['ablation.csv', 'ablation.md', 'pairs.csv', 'timings.csv'])
    return tables


def ratios_table(records: Sequence[PairRecord]) -> Table:
    """Return the table of error ratios to D-JET's, by sequence and preset."""
    variants: dict[tuple[str, ...], list[PairRecord]] = {}
    for record in records:
        variants.setdefault((record.sequence, record.preset, record.method, record.change),
                            []).append(record)
    lines = []
    for (sequence, preset, method, change), own in variants.items():
        base = variants[sequence, preset, 'djet', '']
        if own is not base:
            by_kind = ratios_to_base(own, base)
            lines.append(Line((sequence, preset, TITLES[method], change or '–', *(
                _in_words(ratio) for what in ('rotation', 'direction')
                for ratio in by_kind[what].values()))))
    return Table(_RATIOS, ('sequence', 'preset', 'method', 'change', 'rot. mean', 'rot. median',
                           'tr. mean', 'tr. median'), tuple(lines), 2, 4)


def _in_words(ratio: Ratio) -> str:
    return (f'{ratio.value:.2f} ({ratio.least:.2f} to {ratio.most:.2f})'
            if math.isfinite(ratio.value) else '–')


def plot_ablation(path: Path, title: str, rows: Sequence[TableRow]) -> None:
    """Plot mean and median errors of one sequence, a line per change, a panel per preset."""
    by_preset = {preset: [row for row in rows if row.preset == preset] for preset in PRESETS}
    by_preset = {preset: found for preset, found in by_preset.items() if found}
    heights = [len(_changes(found)) + 3 for found in by_preset.values()]
    with figure(path, 11, _LINE * sum(heights) + 1.6) as drawing:
        drawing.suptitle(f'{title}: one change at a time (filled: mean, hollow: median)')
        panels = drawing.subplots(len(by_preset), 2, squeeze=False, sharex='col', sharey='row',
                                  height_ratios=heights)
        for line, (preset, found) in zip(panels, by_preset.items()):
            for axes, kind in zip(line, ('rotation', 'translation')):
                _draw(axes, kind, found)
            line[0].set_title(f'preset {preset}', loc='left')
        for axes, kind in zip(panels[-1], ('rotation', 'translation')):
            axes.set_xlabel(f'{kind} error, deg')
        legend_below(drawing, panels[0, 0])


def _changes(rows: Sequence[TableRow]) -> list[str]:
    return list(dict.fromkeys(row.change for row in rows))


def _draw(axes: Axes, kind: str, rows: Sequence[TableRow]) -> None:
    changes = _changes(rows)
    for method in dict.fromkeys(row.method for row in rows):
        own = [row for row in rows if row.method == method]
        places = [changes.index(row.change) for row in own]
        look: dict[str, Any] = {'marker': _MARKERS[method], 'color': COLOURS[method], 'ms': 6,
                                'ls': 'none'}
        means = [getattr(row, f'{kind}_mean_deg') for row in own]
        medians = [getattr(row, f'{kind}_median_deg') for row in own]
        axes.hlines(places, medians, means, color=COLOURS[method], lw=1)
        axes.plot(means, places, label=TITLES[method], **look)
        axes.plot(medians, places, markerfacecolor='white', **look)
        # The unchanged preset, for reference.
        axes.axvline(means[0], color=COLOURS[method], lw=0.8, ls=(0, (4, 4)))
    axes.set_xscale('log')
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter('{x:g}')
    axes.xaxis.set_minor_formatter('')
    axes.set_ylim(len(changes) - 0.4, -0.6)
    axes.set_yticks(range(len(changes)), [change or 'unchanged' for change in changes])
