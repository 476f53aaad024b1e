"""Tables of results: exact as CSV, and readable as Markdown, LaTeX and HTML."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import csv
from dataclasses import asdict, dataclass, fields, replace
import html
import io
import math
from typing import Any

from djet_ros.lab.methods import TITLES
from djet_ros.lab.pairs import PairRecord
from djet_ros.lab.published import PublishedRow
from djet_ros.lab.summary import DriftRow, TableRow

PUBLISHED = 'the paper'


@dataclass(frozen=True)
class Line:
    """One line of a table; bold: columns to emphasise; foreign: published, not measured here."""

    cells: tuple[str, ...]
    bold: frozenset[int] = frozenset()
    foreign: bool = False


@dataclass(frozen=True)
class Table:
    """
    A readable table.

    sections: number of leading columns that define the section of a line; numeric: index of the
    first column of numbers, which are right-aligned.
    """

    caption: str
    header: tuple[str, ...]
    lines: tuple[Line, ...]
    sections: int
    numeric: int


# Columns of numbers: titles, fields, and decimals.
_FIGURES = (
    ('rot. pairs', 'rotation_told', 0), ('rot. mean', 'rotation_mean_deg', 3),
    ('rot. median', 'rotation_median_deg', 3), ('rot. p95', 'rotation_p95_deg', 3),
    ('tr. pairs', 'translation_told', 0), ('tr. mean', 'translation_mean_deg', 2),
    ('tr. median', 'translation_median_deg', 2), ('tr. p95', 'translation_p95_deg', 2),
    ('Hamming', 'hamming_mean', 2), ('failed', 'failures', 0), ('ms', 'ms_per_pair', 0))
_TITLES = tuple(title for title, _, _ in _FIGURES)
_DRIFT = (
    ('tr., %', 'translation_percent', 3), ('rot., deg per 100 m', 'rotation_deg_per_100m', 3),
    ('segments', 'segments', 0), ('longest, m', 'longest', 0))
# Fields whose minimum in a section is emphasised, and the field that counts the pairs they are
# over: no other method may have more pairs, because giving up hard pairs lowers the mean.
_EMPHASISED: dict[str, str | None] = {
    'hamming_mean': 'rotation_told', **dict.fromkeys(name for _, name, _ in _DRIFT[:2])} | {
    f'{what}_{kind}_deg': f'{what}_told' for what in ('rotation', 'translation')
    for kind in ('mean', 'median', 'p95')}
_DRIFT_CAPTION = (
    'Drift of the trajectories by the metrics of the KITTI benchmark (t_rel, r_rel): mean error '
    'over segments of 100 to 800 m, relative to their length. Step lengths are those of the '
    'ground truth, so that t_rel depends on directions and rotations only. Sequences of at most '
    '100 m have none.')


def results_table(caption: str, rows: Sequence[TableRow],
                  published: dict[str, list[PublishedRow]]) -> Table:
    """
    Return the table of rows by sequence and preset, best values in bold, published ones below.

    Best is the smallest value, if it is over at least as many pairs as all others of its section.
    published: rows of the paper by name of the sequence.
    """
    lines: list[Line] = []
    for sequence in dict.fromkeys(row.sequence for row in rows):
        ours = [row for row in rows if row.sequence == sequence]
        for preset in dict.fromkeys(row.preset for row in ours):
            group = [row for row in ours if row.preset == preset]
            lines += [_line(row, (sequence, preset, TITLES[row.method]), group) for row in group]
        lines += [_printed_line((sequence, PUBLISHED, TITLES[row.method]), row)
                  for row in published.get(sequence, ())]
    return Table(caption, ('sequence', 'preset', 'method', *_TITLES), tuple(lines), 2, 3)


def drift_table(rows: Sequence[DriftRow]) -> Table:
    """Return the table of drifts by sequence and preset, the smallest in bold."""
    lines = [_line(row, (row.sequence, row.preset, TITLES[row.method]),
                   [one for one in rows
                    if (one.sequence, one.preset) == (row.sequence, row.preset)], _DRIFT)
             for row in rows]
    titles = (title for title, _, _ in _DRIFT)
    return Table(_DRIFT_CAPTION, ('sequence', 'preset', 'method', *titles), tuple(lines), 2, 3)


def ablation_table(caption: str, rows: Sequence[TableRow]) -> Table:
    """Return the table of rows by sequence, preset and change; the first row is the base."""
    lines = [_line(row, (row.sequence, row.preset, TITLES[row.method], row.change or '–'), ())
             for row in rows]
    return Table(caption, ('sequence', 'preset', 'method', 'change', *_TITLES), tuple(lines), 2, 4)


def published_table(caption: str, rows: Iterable[PublishedRow]) -> Table:
    """Return the table of the paper's Table 2."""
    header = ('sequence', 'method', 'window', 'rotation', 'translation', 'Hamming')
    lines = [Line(('VAROS', TITLES[row.method], f'{row.window}×{row.window}' if row.window else
                   '–', number(row.rotation_deg, 3), number(row.translation_deg, 3),
                   number(row.hamming, 2)), foreign=True) for row in rows]
    return Table(caption, header, tuple(lines), 1, 3)


def _printed_line(head: tuple[str, ...], row: PublishedRow) -> Line:
    """Return the line of a row of the paper, which has means only."""
    printed = {'rotation_mean_deg': row.rotation_deg, 'translation_mean_deg': row.translation_deg,
               'hamming_mean': row.hamming}
    return Line((*head, *(number(printed[name], digits) if name in printed else ''
                          for _, name, digits in _FIGURES)), foreign=True)


def _line(row: TableRow | DriftRow, head: tuple[str, ...], group: Sequence[TableRow | DriftRow],
          figures: Sequence[tuple[str, str, int]] = _FIGURES) -> Line:
    cells, bold = list(head), set()
    for _, name, digits in figures:
        value = getattr(row, name)
        if name in _EMPHASISED and len(group) > 1 and _is_best(row, group, name):
            bold.add(len(cells))
        cells.append(_share(row) if isinstance(row, TableRow) and name == 'failures'
                     else number(value, digits))
    return Line(tuple(cells), frozenset(bold))


def _share(row: TableRow) -> str:
    return f'{row.failures} ({100 * row.failures / row.pairs:.0f}%)' if row.failures else '0'


def _is_best(row: TableRow | DriftRow, group: Sequence[TableRow | DriftRow], name: str) -> bool:
    """Return whether a row has the smallest value, over as many pairs as any other row."""
    count = _EMPHASISED[name]
    least = min((getattr(one, name) for one in group if math.isfinite(getattr(one, name))),
                default=math.nan)
    return bool(getattr(row, name) == least) and (
        count is None or getattr(row, count) == max(getattr(one, count) for one in group))


def number(value: float, digits: int) -> str:
    """Return a number as text with a number of decimals, or a dash if it is NaN."""
    return f'{value:.{digits}f}' if math.isfinite(value) else '–'


def rows_csv(rows: Sequence[TableRow], *, with_change: bool) -> str:
    """Return rows as CSV, with or without the column ``change``."""
    return _csv([field.name for field in fields(TableRow)], map(asdict, rows), with_change)


def drift_csv(rows: Sequence[DriftRow]) -> str:
    """Return drifts as CSV."""
    return _csv([field.name for field in fields(DriftRow)], map(asdict, rows))


# Key columns of pairs.csv and timings.csv. Times have their own file: only they differ from run to
# run.
_PAIR_KEY = ('sequence', 'pair', 'previous', 'current', 'method', 'preset', 'change')


def pairs_csv(records: Sequence[PairRecord], *, with_change: bool) -> str:
    """Return the records of all pairs as CSV, without their times."""
    vectors = {'rotation': ('rx', 'ry', 'rz'), 'translation': ('tx', 'ty', 'tz')}
    names = [column for field in fields(PairRecord)
             for column in vectors.get(field.name, (field.name,)) if column != 'milliseconds']
    return _csv(names, ({**asdict(record), 'failed': int(record.failed),
                         **dict(zip(('rx', 'ry', 'rz'), record.rotation)),
                         **dict(zip(('tx', 'ty', 'tz'), record.translation))}
                        for record in records), with_change)


def timings_csv(records: Sequence[PairRecord], *, with_change: bool) -> str:
    """Return the times of all pairs as CSV."""
    return _csv((*_PAIR_KEY, 'milliseconds'), map(asdict, records), with_change)


def table_csv(table: Table) -> str:
    """Return a readable table as CSV."""
    return _csv(table.header, (dict(zip(table.header, line.cells)) for line in table.lines))


def _csv(names: Sequence[str], rows: Iterable[dict[str, Any]], with_change: bool = True) -> str:
    names = [name for name in names if with_change or name != 'change']
    text = io.StringIO()
    writer = csv.writer(text, lineterminator='\n')
    writer.writerow(names)
    writer.writerows([_value(row[name]) for name in names] for row in rows)
    return text.getvalue()


def _value(value: Any) -> Any:
    if isinstance(value, float):
        return f'{value:.9g}' if math.isfinite(value) else ''
    return value


def markdown(table: Table) -> str:
    """Return the table in Markdown, its caption as a paragraph before it."""
    rule = ['--:' if column >= table.numeric else '---' for column in range(len(table.header))]
    rows = [table.header, tuple(rule), *(_marked(line, '**', '**', '*', '*')
                                         for line in table.lines)]
    return f'{table.caption}\n\n' + ''.join(f'| {" | ".join(row)} |\n' for row in rows)


def latex(table: Table) -> str:
    """Return the table as a LaTeX table that needs no packages."""
    escaped = replace(table, lines=tuple(
        replace(line, cells=tuple(_latex_text(cell) for cell in line.cells))
        for line in table.lines))
    layout = 'l' * table.numeric + 'r' * (len(table.header) - table.numeric)
    marks = (r'\textbf{', '}', r'\textit{', '}')
    body = ''.join(' & '.join(_marked(line, *marks)) + ' \\\\\n' for line in escaped.lines)
    return (f'\\begin{{table}}\n\\caption{{{_latex_text(table.caption)}}}\n'
            f'\\begin{{tabular}}{{{layout}}}\n\\hline\n'
            f'{" & ".join(map(_latex_text, table.header))} \\\\\n\\hline\n{body}\\hline\n'
            '\\end{tabular}\n\\end{table}\n')


def html_table(table: Table) -> str:
    """Return the table in HTML."""
    kinds = [' class="number"' if column >= table.numeric else ''
             for column in range(len(table.header))]
    head = ''.join(f'<th{kind}>{html.escape(title)}</th>'
                   for kind, title in zip(kinds, table.header))
    body = []
    for line, before in zip(table.lines, (None, *table.lines)):
        begins = before is None or before.cells[:table.sections] != line.cells[:table.sections]
        escaped = replace(line, cells=tuple(html.escape(cell) for cell in line.cells))
        cells = ''.join(f'<td{kind}>{cell}</td>' for kind, cell in
                        zip(kinds, _marked(escaped, '<b>', '</b>', '<i>', '</i>')))
        body.append(f'<tr class="section">{cells}</tr>\n' if begins else f'<tr>{cells}</tr>\n')
    return (f'<table>\n<caption>{html.escape(table.caption)}</caption>\n'
            f'<thead><tr>{head}</tr></thead>\n<tbody>\n{"".join(body)}</tbody>\n</table>\n')


def _marked(line: Line, bold: str, end_bold: str, foreign: str,
            end_foreign: str) -> tuple[str, ...]:
    cells = (f'{bold}{cell}{end_bold}' if column in line.bold else cell
             for column, cell in enumerate(line.cells))
    return tuple(f'{foreign}{cell}{end_foreign}' if line.foreign and cell else cell
                 for cell in cells)


def _latex_text(text: str) -> str:
    special = {'&': r'\&', '%': r'\%', '_': r'\_', '#': r'\#', '$': r'\$', '{': r'\{',
               '}': r'\}', '~': r'\textasciitilde{}', '^': r'\textasciicircum{}',
               '\\': r'\textbackslash{}', '–': '--', '×': r'$\times$'}
    return ''.join(special.get(letter, letter) for letter in text)
