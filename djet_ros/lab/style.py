"""Style of all plots: a colour-blind safe palette, dashes, and saving."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from djet_ros.recordings.outputs import replaced_whole
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter, LogFormatterMathtext

Look = TypeVar('Look')


class ByMethod(dict[str, Look]):
    """Styles by method, with a default for other methods."""

    def __init__(self, entries: dict[str, Look], others: Look) -> None:
        super().__init__(entries)
        self._others = others

    def __missing__(self, name: str) -> Look:
        return self._others


# Palette of Okabe and Ito; lines differ by their dashes as well.
COLOURS = ByMethod({
    'djet': '#0072B2', 'rpe': '#D55E00', 'pjet': '#009E73', 'five_point': '#CC79A7',
    'opencv_ransac': '#8C8C8C', 'usac_magsac': '#E69F00', 'poselib': '#56B4E9',
    'sift_poselib': '#000000', 'klt_poselib': '#7F4F24'}, others='#9467BD')
DASHES: ByMethod[Any] = ByMethod({
    'djet': '-', 'rpe': '--', 'pjet': '-.', 'five_point': ':', 'opencv_ransac': (0, (1, 1)),
    'usac_magsac': (0, (5, 1)), 'poselib': (0, (3, 1, 1, 1)),
    'sift_poselib': (0, (5, 1, 1, 1, 1, 1)), 'klt_poselib': (0, (8, 2))}, others=(0, (2, 2)))

STYLE: dict[Any, Any] = {
    'font.size': 10, 'axes.titlesize': 11, 'axes.labelsize': 10, 'legend.fontsize': 9,
    'axes.spines.top': False, 'axes.spines.right': False, 'axes.grid': True,
    'grid.color': '#dddddd', 'grid.linewidth': 0.6, 'lines.linewidth': 1.3,
    'legend.frameon': False, 'axes.axisbelow': True,
    # A $ in the name of a folder starts no formula.
    'text.parse_math': False,
}


@contextmanager
def figure(path: Path, width: float, height: float) -> Iterator[Figure]:
    """Yield an empty figure of a size in inches, and save it as PNG at the end, atomically."""
    # A Figure without pyplot needs no display and has no global state.
    with rc_context(STYLE):
        empty = Figure(figsize=(width, height), layout='constrained')
        yield empty
        _label_logarithms(empty)
        with replaced_whole(path) as new:
            empty.savefig(new, dpi=120)


def legend_below(drawing: Figure, axes: Axes) -> None:
    """Add a legend of what some axes show, below all axes of a figure of `figure`."""
    handles, labels = axes.get_legend_handles_labels()
    # Matplotlib 3.6, which Ubuntu 24.04 has, cannot place it outside the axes by itself.
    legend = drawing.legend(handles, labels, loc='lower center', ncols=min(len(labels), 8))
    share = legend.get_window_extent().y1 / drawing.bbox.height
    drawing.set_layout_engine('constrained', rect=(0, share, 1, 1 - share))


class _Decimal(LogFormatter):
    """Labels the same ticks of a logarithmic axis as usual, but by decimal numbers."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        """Return the label of a tick, empty if it has none."""
        return f'{x:g}' if super().__call__(x, pos) else ''


def _label_logarithms(drawn: Figure) -> None:
    """Label logarithmic axes by numbers, as formulas are not parsed."""
    for axis in (axis for axes in drawn.axes for axis in (axes.xaxis, axes.yaxis)):
        if isinstance(axis.get_major_formatter(), LogFormatterMathtext):
            axis.set_major_formatter(_Decimal())
        if isinstance(axis.get_minor_formatter(), LogFormatterMathtext):
            axis.set_minor_formatter(_Decimal())
