"""Plots show errors as they are, and the path with what is around it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from djet_ros.core.types import Status
from djet_ros.lab import plots
from djet_ros.lab.pairs import PairRecord
from djet_ros.lab.style import figure, legend_below
from djet_ros.replay.results import plot_trajectory
from matplotlib.figure import Figure
import numpy as np
import pytest


def record(pair: int, error: float) -> PairRecord:
    return PairRecord('road', pair, pair, pair + 1, 'djet', 'best', '', Status.OK.value, 99, 90,
                      False, error, 10 * error, 20.0, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 50.0)


def test_errors_far_below_those_of_a_dataset_are_drawn_where_they_are(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: dict[str, Figure] = {}
    monkeypatch.setattr(plots, 'figure', kept(drawn))
    errors = [2e-5, 0.0, float('nan'), 0.03]
    records = [record(pair, error) for pair, error in enumerate(errors)]
    plots.plot_errors_by_frame(tmp_path / 'errors.png', 'road', plots.grouped(records))
    above, below = (axes.lines[0].get_ydata()
                    for axes in drawn['errors.png'].axes[:2])
    # A logarithmic axis has no zero, and an unknown error no place.
    assert np.allclose(above, [2e-5, 1e-6, np.nan, 0.03], equal_nan=True, rtol=1e-12)
    assert np.allclose(below, [2e-4, 1e-6, np.nan, 0.3], equal_nan=True, rtol=1e-12)


@pytest.mark.parametrize('methods', [1, 9])
def test_a_legend_lies_below_all_axes_and_inside_the_figure(tmp_path: Path, methods: int) -> None:
    """Matplotlib's own place for that, 'outside', came with 3.7; Ubuntu 24.04 has 3.6."""
    with figure(tmp_path / 'plot.png', 9, 4) as drawn:
        panels = drawn.subplots(1, 2)
        for axes in panels:
            axes.set_xlabel('frame')
            for method in range(methods):
                axes.plot([0, 1], label=f'method {method}')
        legend_below(drawn, panels[1])
    legend, = drawn.legends
    place = legend.get_window_extent()
    assert len(legend.get_texts()) == methods
    assert place.y0 >= 0
    assert all(axes.get_tightbbox().y0 >= place.y1 for axes in panels)
    assert all(axes.get_tightbbox().y0 < place.y1 + 10 for axes in panels)


def kept(drawn: dict[str, Figure]) -> Any:
    """Return what draws as ever, and keeps the figures by the names of their files."""
    @contextmanager
    def keeping(path: Path, width: float, height: float) -> Iterator[Figure]:
        with figure(path, width, height) as empty:
            drawn[path.name] = empty
            yield empty
    return keeping


@pytest.mark.parametrize('values', [[1e-6, 1.0], [0.3, 0.9]])
def test_logarithmic_axes_are_labelled_by_numbers(tmp_path: Path, values: list[float]) -> None:
    """Formulas are not parsed, as the name of a folder may have a $."""
    with figure(tmp_path / 'plot.png', 5, 3) as drawn:
        axes = drawn.subplots()
        axes.loglog(values, values)
    labels = [label.get_text() for which in ('major', 'minor')
              for label in axes.get_xticklabels(which=which)]
    shown = [float(label) for label in labels if label]
    assert len(shown) > 1
    assert any(values[0] <= number <= values[1] for number in shown)


@pytest.mark.parametrize(('far', 'right'), [(8.0, 8.0), (50.0, 20.0)])
def test_a_trajectory_is_shown_with_landmarks_up_to_its_own_extent_away(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch, far: float, right: float) -> None:
    drawn: list[Figure] = []

    def keep(one: Figure, file: Path, **_: object) -> None:
        file.touch()
        drawn.append(one)

    monkeypatch.setattr(Figure, 'savefig', keep)
    path = np.linspace([0.0, 0.0, 0.0], [0.0, 0.0, 20.0], 9)
    landmarks = np.tile(np.float32([far, 10.0]), (100, 1))
    # Some of the landmarks are wrong.
    landmarks[:3] = -1e6
    plot_trajectory(tmp_path / 'path.png', path, None, landmarks, 'road', 'm')
    axes, = drawn[0].axes
    left, shown = axes.get_xlim()
    assert right < shown < 1.2 * right + 2 and -6 < left < -1
    bottom, top = axes.get_ylim()
    assert -5 < bottom < -1 and 21 < top < 25
