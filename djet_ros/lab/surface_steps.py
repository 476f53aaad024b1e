"""One match on its Hamming surface, by iteration of the paper's Algorithm 1."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.geometry import epipolar_lines, fundamental, line_distances
from djet_ros.core.hamming import describable
from djet_ros.core.pair import Round
from djet_ros.core.paraboloid import indefinite
from djet_ros.core.surfaces import DescriptorDistances
from djet_ros.core.types import Array, RelativePose, Status, View
from djet_ros.errors import DjetError
from djet_ros.lab import panels
from djet_ros.lab.style import figure, STYLE
from djet_ros.recordings.outputs import replaced_whole
from matplotlib import rc_context
from matplotlib.animation import PillowWriter
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

# Pixels shown around the first keypoint.
RADIUS = 9

# Maximum number of iterations in one plot; of more, some in between are omitted.
_PANELS = 7

_LINE, _KEYPOINT, _OPTIMUM = '#56B4E9', '#E69F00', '#009E73'


@dataclass(frozen=True)
class Trace:
    """Iterations of Algorithm 1 on two views, and the result."""

    previous: View
    current: View
    config: EstimatorConfig
    rounds: list[Round]
    result: RelativePose

    @property
    def x(self) -> Array:
        """Return the matches' pixels (N, 2) in the previous view."""
        return self.result.x

    @property
    def y(self) -> Array:
        """Return the matches' initial pixels (N, 2) in the current view."""
        return self.result.y


def trace_rounds(previous: View, current: View, x: Array, y: Array, config: EstimatorConfig
                 ) -> Trace:
    """
    Run D-JET on matches x, y (N, 2) in pixels, and record every iteration.

    Raises DjetError if no pose is found.
    """
    rounds: list[Round] = []
    result = TwoViewEstimator(config).estimate_matched(previous, current, x, y,
                                                       observe=rounds.append)
    if not rounds or result.status is Status.TOO_FEW_MATCHES:
        raise DjetError(f'no pose was found from the {len(x)} matches of this pair '
                        f'({result.status.value}); choose another --pair')
    return Trace(previous, current, config, rounds, result)


def illustrative_match(trace: Trace) -> int:
    """
    Return the match that moves farthest, of the inliers with a minimum in every iteration.

    The minima of their paraboloids are inside the window. Raises DjetError if there is none.
    """
    candidates = trace.result.inliers & describable(np.rint(trace.y).astype(np.int64),
                                                    trace.current.smoothed.shape, RADIUS)
    for step in trace.rounds:
        reach = np.abs(step.fits.minima() - step.fits.centres).max(1)
        candidates &= (step.fits.usable & ~indefinite(step.fits)
                       & (reach <= trace.config.window // 2))
    if not candidates.any():
        raise DjetError('no match of this pair has a surface with a minimum in every iteration; '
                        'choose one with --match')
    distance = np.linalg.norm(trace.rounds[-1].optimum - trace.y, axis=1)
    return int(np.argmax(np.where(candidates, distance, -1.0)))


def draw_trace(path: Path, trace: Trace, match: int) -> None:
    """Draw the reference patch and the iterations of a match side by side (PNG)."""
    _require_room(trace, match)
    shown = _some(len(trace.rounds))
    count = len(shown) + 1
    lines = 1 if count <= 4 else 2
    columns = -(-count // lines)
    with figure(path, 3.1 * columns + 1.0, 3.5 * lines + 0.5) as drawing:
        grid = drawing.subplots(lines, columns, squeeze=False).ravel().tolist()
        _draw_reference(grid[0], trace, match)
        for axes, index in zip(grid[1:], shown):
            _draw_round(axes, trace, match, index)
        for axes in grid[count:]:
            axes.set_visible(False)
        _describe(drawing, grid)


def animate_trace(path: Path, trace: Trace, match: int) -> None:
    """Animate the iterations of a match (GIF)."""
    _require_room(trace, match)
    with rc_context(STYLE):
        drawing = Figure(figsize=(7.6, 4.4), layout='constrained')
        grid = drawing.subplots(1, 2).tolist()
        _draw_reference(grid[0], trace, match)
        _draw_round(grid[1], trace, match, 0)
        _describe(drawing, grid)
        writer = PillowWriter(fps=1)
        with replaced_whole(path) as new, writer.saving(drawing, str(new), dpi=100):
            for index in range(len(trace.rounds)):
                grid[1].clear()
                _draw_round(grid[1], trace, match, index)
                writer.grab_frame()


def _some(count: int) -> Sequence[int]:
    """Return the iterations to draw: all, or an even selection with the first and the last."""
    return sorted({round(i) for i in np.linspace(0, count - 1, min(count, _PANELS)).tolist()})


def _draw_reference(axes: Axes, trace: Trace, match: int) -> None:
    x = np.rint(trace.x[match]).astype(np.int64)
    panels.draw_patch(axes, trace.previous.gray, x, RADIUS)
    panels.draw_point(axes, trace.x[match], 'o', _KEYPOINT)
    axes.set_title(f'previous image, x = {trace.x[match][0]:.1f}, {trace.x[match][1]:.1f}')


def _draw_round(axes: Axes, trace: Trace, match: int, index: int) -> None:
    step, y, distances = trace.rounds[index], trace.y[match], DescriptorDistances(trace.config)
    x, centre = trace.x[match], np.rint(y).astype(np.int64)
    if step.warp is None:
        reference = distances.reference(trace.previous.surface_gray, np.rint(x)[None])
    else:
        # The reference of this iteration, shifted to integer pixels.
        ahead = step.keypoints[match] - np.rint(step.keypoints[match])
        reference = distances.reference(
            trace.previous.surface_gray, (x - np.linalg.solve(step.warp[match, :2], ahead))[None],
            warp=step.warp[[match]])
    surface = distances.surfaces(reference, trace.current.surface_gray, centre[None],
                                 RADIUS)[:, :, 0]
    panels.draw_patch(axes, trace.current.gray, centre, RADIUS)
    panels.draw_heat(axes, surface, centre, 0.75)
    if step.fits.usable[match]:
        panels.draw_paraboloid(axes, step.fits, match, trace.config.window)
    line = epipolar_lines(fundamental(trace.current.K, step.pose.R, step.pose.t), trace.x[[match]])
    normal, optimum = line[0, :2], step.optimum[match]
    along = np.array([-normal[1], normal[0]]) / np.linalg.norm(normal)
    ends = optimum + np.outer([-3 * RADIUS, 3 * RADIUS], along)
    axes.plot(ends[:, 0], ends[:, 1], color=_LINE, lw=1.8)
    path = np.array([earlier.keypoints[match] for earlier in trace.rounds[:index + 1]])
    axes.plot(path[:, 0], path[:, 1], color=_KEYPOINT, lw=1.5)
    panels.draw_point(axes, path[-1], 'o', _KEYPOINT)
    panels.draw_point(axes, optimum, '*', _OPTIMUM, 13)
    distance = abs(line_distances(line, y[None])[0])
    loss = panels.paraboloid_values(step.fits, match, optimum[None])[0]
    axes.set_title(f'iteration {index + 1}: Q(v_opt) = {loss:.1f} bits,\n'
                   f'y {distance:.2f} px from the line')
    panels.limit(axes, centre.astype(float), RADIUS)


def _describe(drawing: Figure, grid: Sequence[Axes]) -> None:
    panels.add_scale(drawing, grid)
    drawing.suptitle('Hamming surface around y. Dashed: sampled window with its fit; '
                     '+: minimum of the fit;\nline: epipolar line; dot: keypoint; '
                     'star: y + v_opt')


def _require_room(trace: Trace, match: int) -> None:
    if not 0 <= match < len(trace.y):
        raise DjetError(f'--match is {match}; this pair has matches 0 to {len(trace.y) - 1}')
    at_x, at_y = (np.rint(points[[match]]).astype(np.int64) for points in (trace.x, trace.y))
    if not (describable(at_x, trace.previous.smoothed.shape)[0]
            and describable(at_y, trace.current.smoothed.shape, RADIUS)[0]):
        raise DjetError(f'match {match} at {at_y[0][0]},{at_y[0][1]} is too close to the border; '
                        'choose another --match')
