"""Plots of an evaluation: one column per preset, rotation above translation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from djet_ros.lab.integration import StampedTrajectory
from djet_ros.lab.methods import TITLES
from djet_ros.lab.pairs import GROSS_ROTATION, GROSS_TRANSLATION, PairRecord
from djet_ros.lab.style import COLOURS, DASHES, figure, legend_below
from matplotlib.axes import Axes
import numpy as np

_KINDS = (('rotation_error_deg', 'rotation error, deg', GROSS_ROTATION),
          ('translation_error_deg', 'translation error, deg', GROSS_TRANSLATION))
# Value in degrees at which errors of zero are drawn on logarithmic axes.
_NO_ERROR = 1e-6

# Records of one sequence by preset and method.
Groups = dict[str, dict[str, list[PairRecord]]]


def grouped(records: Sequence[PairRecord]) -> Groups:
    """Group the records of one sequence by preset and method."""
    groups: Groups = {}
    for record in records:
        groups.setdefault(record.preset, {}).setdefault(record.method, []).append(record)
    return groups


def plot_errors_by_frame(path: Path, title: str, groups: Groups) -> None:
    """Plot the error of every pair along the sequence."""
    def draw(axes: Axes, methods: dict[str, list[PairRecord]], kind: str) -> None:
        for method, records in methods.items():
            axes.plot([record.current for record in records], _errors(records, kind),
                      label=TITLES[method], color=COLOURS[method], ls=DASHES[method], lw=1.0)
        axes.set_yscale('log')
        axes.set_xlabel('frame')

    _panels(path, f'{title}: error of each pair', groups, draw, share_y=True)


def plot_cumulative(path: Path, title: str, groups: Groups) -> None:
    """Plot the cumulative distribution of errors over all pairs, also those without a pose."""
    def draw(axes: Axes, methods: dict[str, list[PairRecord]], kind: str) -> None:
        for method, records in methods.items():
            known = np.sort([e for e in _errors(records, kind) if np.isfinite(e)])
            share = np.arange(1, len(known) + 1) / len(records)
            axes.step(known, 100 * share, where='post', label=TITLES[method],
                      color=COLOURS[method], ls=DASHES[method])
        axes.set_xscale('log')
        axes.set_ylim(0, 100)
        axes.set_ylabel('share of pairs, %')
        axes.set_xlabel({name: label for name, label, _ in _KINDS}[kind])

    _panels(path, f'{title}: cumulative distribution of errors', groups, draw, share_x=True)


def plot_boxes(path: Path, title: str, groups: Groups) -> None:
    """Plot the errors of each method as boxes: quartiles, and 5 % and 95 % whiskers."""
    def draw(axes: Axes, methods: dict[str, list[PairRecord]], kind: str) -> None:
        values = [[e for e in _errors(records, kind) if np.isfinite(e)]
                  for records in methods.values()]
        boxes = axes.boxplot(values, whis=(5, 95), widths=0.6, patch_artist=True,
                             flierprops={'marker': '.', 'markersize': 3, 'alpha': 0.5},
                             medianprops={'color': 'black'})
        for box, method in zip(boxes['boxes'], methods):
            box.set(facecolor=COLOURS[method], alpha=0.75)
        axes.set_xticks(range(1, len(values) + 1), [TITLES[m].replace(' ', '\n') for m in methods],
                        fontsize=8)
        axes.set_yscale('log')

    _panels(path, f'{title}: errors by method, quartiles and 5 % to 95 %', groups, draw,
            share_y=True, legend=False)


def plot_trajectories(path: Path, title: str, truth: StampedTrajectory,
                      estimates: dict[str, dict[str, StampedTrajectory]]) -> None:
    """Plot trajectories from above, by preset and method."""
    with figure(path, 5.2 * len(estimates), 5.2) as drawing:
        drawing.suptitle(f'{title}: seen from above, step lengths from ground truth')
        panels = drawing.subplots(1, len(estimates), squeeze=False)[0]
        for axes, (preset, methods) in zip(panels, estimates.items()):
            axes.plot(truth.poses[:, 0, 3], truth.poses[:, 2, 3], color='black', lw=2.5,
                      alpha=0.6, label='ground truth')
            for method, trajectory in methods.items():
                axes.plot(trajectory.poses[:, 0, 3], trajectory.poses[:, 2, 3],
                          label=TITLES[method], color=COLOURS[method], ls=DASHES[method])
            axes.set_title(f'preset {preset}')
            axes.set_xlabel('x (right), m')
            axes.set_aspect('equal', adjustable='datalim')
        panels[0].set_ylabel('z (forward), m')
        legend_below(drawing, panels[-1])


def _panels(path: Path, title: str, groups: Groups,
            draw: Callable[[Axes, dict[str, list[PairRecord]], str], None], *,
            share_x: bool = False, share_y: bool = False, legend: bool = True) -> None:
    with figure(path, 5.2 * len(groups), 6.4) as drawing:
        drawing.suptitle(f'{title} (dashed: threshold of failure)')
        panels = drawing.subplots(2, len(groups), squeeze=False,
                                  sharex='row' if share_x else False,
                                  sharey='row' if share_y else False)
        for axes, preset in zip(panels[0], groups):
            axes.set_title(f'preset {preset}')
        for row, (kind, label, gross) in zip(panels, _KINDS):
            for axes, methods in zip(row, groups.values()):
                draw(axes, methods, kind)
                limit = axes.axhline if share_y else axes.axvline
                limit(gross, color='black', lw=0.8, ls=(0, (6, 4)))
                (axes.yaxis if share_y else axes.xaxis).set_major_formatter('{x:g}')
            if share_y:
                row[0].set_ylabel(label)
        if legend:
            legend_below(drawing, panels[0, -1])


def _errors(records: Sequence[PairRecord], kind: str) -> list[float]:
    # Logarithmic axes have no zero, and errors on rendered frames can be zero.
    return [error or _NO_ERROR for error in (getattr(record, kind) for record in records)]
