"""What all figures share: colours that colour-blind readers can tell apart, and saving."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from matplotlib import rc_context
from matplotlib.figure import Figure

Look = TypeVar('Look')


class ByMethod(dict[str, Look]):
    """How methods are drawn; those that have nothing of their own here are drawn like others."""

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
    # Titles have names of folders, and a $ in these begins no formula.
    'text.parse_math': False,
}


@contextmanager
def figure(path: Path, width: float, height: float) -> Iterator[Figure]:
    """Give an empty figure of some inches, saved as PNG at the end; the folder is made."""
    # A Figure of its own needs no window system and leaves pyplot's state alone.
    with rc_context(STYLE):
        empty = Figure(figsize=(width, height), layout='constrained')
        yield empty
        path.parent.mkdir(parents=True, exist_ok=True)
        empty.savefig(path, dpi=120)
