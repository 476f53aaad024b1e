"""One correspondence on its Hamming surface, round by round of the paper's Algorithm 1."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.geometry import epipolar_lines, fundamental, line_distances
from djet_ros.core.hamming import describable
from djet_ros.core.paraboloid import indefinite, Paraboloids
from djet_ros.core.starts import five_point, starting_poses
from djet_ros.core.surfaces import DescriptorDistances, DescriptorSurface, ResidualSurface
from djet_ros.core.tracking import Track, track_jointly
from djet_ros.core.types import Array, View
from djet_ros.errors import DjetError
from djet_ros.lab.panels import (
    add_scale,
    draw_heat,
    draw_paraboloid,
    draw_patch,
    draw_point,
    limit,
    paraboloid_values,
)
from djet_ros.lab.style import figure, STYLE
from matplotlib import rc_context
from matplotlib.animation import PillowWriter
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray

# Pixels shown around the first keypoint.
RADIUS = 9

# Rounds that one picture shows; of more, some in between are left out.
_PANELS = 7

_LINE, _KEYPOINT, _OPTIMUM = '#56B4E9', '#E69F00', '#009E73'


@dataclass(frozen=True)
class Round:
    """
    A round of Algorithm 1 for all N matches.

    keypoints: (N, 2) where the surfaces were sampled around; fits: the paraboloids there;
    warps: (N, 2, 2) through which the reference patches were seen; lines: (N, 3) epipolar lines of
    the pose found on them; optima: (N, 2) places y + v_opt.
    """

    keypoints: Array
    fits: Paraboloids
    warps: Array
    lines: Array
    optima: Array


@dataclass(frozen=True)
class Course:
    """
    Rounds of Algorithm 1 on two views.

    distances: how descriptors were compared; x, y: (N, 2) matches as they went in; inliers: (N,)
    bool at the end.
    """

    previous: View
    current: View
    distances: DescriptorDistances
    x: Array
    y: Array
    rounds: list[Round]
    inliers: NDArray[np.bool_]


class _Observed:
    """A residual surface that keeps what it was asked for and what it gave."""

    def __init__(self, surface: ResidualSurface) -> None:
        self.x = surface.x
        self.seen: list[tuple[Array, Paraboloids, Array]] = []
        self._surface = surface

    def around(self, y: Array, warp: Array | None = None) -> Paraboloids:
        fits = self._surface.around(y, warp)
        unwarped = np.broadcast_to(np.eye(2), (len(y), 2, 2))
        self.seen.append((y.copy(), fits, unwarped if warp is None else warp))
        return fits


def follow(previous: View, current: View, x: Array, y: Array, config: EstimatorConfig) -> Course:
    """
    Run D-JET on matches x, y (N, 2) in pixels, and keep every round.

    Raises DjetError where no pose is found.
    """
    K = current.K
    if config.starts == 'several':
        starts = starting_poses(K, x, y, config.ransac_threshold, None)
    else:
        found = five_point(K, x, y, config.ransac_threshold, robust=False)
        if found is None:
            raise DjetError('the 5-point method finds no pose for this pair; choose another '
                            '--pair')
        starts, x, y = [found[0]], x[found[1]], y[found[1]]
    rounds: list[Round] = []
    inliers = np.zeros(len(x), bool)
    for count in range(1, config.max_iterations + 1):
        # The tracker keeps no history, but is a pure function: it is run to each round anew.
        surface = _Observed(DescriptorSurface(previous, current, x, config))
        track = track_jointly(surface, K, y, starts, replace(config, max_iterations=count))
        if track is None:
            raise DjetError('too few matches of this pair have a usable surface; choose another '
                            '--pair')
        if track.iterations < count:
            break
        rounds.append(_round(track, surface, K))
        inliers = track.inliers()
    return Course(previous, current, DescriptorDistances(config), surface.x, y, rounds, inliers)


def _round(track: Track, surface: _Observed, K: Array) -> Round:
    keypoints, fits, warps = surface.seen[-1]
    lines = epipolar_lines(fundamental(K, track.pose.R, track.pose.t), surface.x)
    return Round(keypoints, fits, warps, lines, track.y_opt)


def telling_match(course: Course, window: int) -> int:
    """
    Choose a match whose surface tells where it belongs, and of these the one that moves farthest.

    Its fits have their minimum in the window, in every round, and it agrees with the pose.
    """
    telling = course.inliers & describable(np.rint(course.y).astype(np.int64),
                                           course.current.smoothed.shape, RADIUS)
    for step in course.rounds:
        reach = np.abs(step.fits.minima() - step.fits.centres).max(1)
        telling &= step.fits.usable & ~indefinite(step.fits) & (reach <= window // 2)
    if not telling.any():
        raise DjetError('no match of this pair has a surface with a minimum in every round; '
                        'choose one with --match')
    way = np.linalg.norm(course.rounds[-1].optima - course.y, axis=1)
    return int(np.argmax(np.where(telling, way, -1.0)))


def draw_course(path: Path, course: Course, match: int, window: int) -> None:
    """Draw the reference patch and the rounds of a match side by side (PNG)."""
    _require_room(course, match)
    shown = _some(len(course.rounds))
    count = len(shown) + 1
    lines = 1 if count <= 4 else 2
    columns = -(-count // lines)
    with figure(path, 3.1 * columns + 1.0, 3.5 * lines + 0.5) as drawing:
        panels = drawing.subplots(lines, columns, squeeze=False).ravel().tolist()
        _draw_reference(panels[0], course, match)
        for axes, index in zip(panels[1:], shown):
            _draw_round(axes, course, match, index, window)
        for axes in panels[count:]:
            axes.set_visible(False)
        _describe(drawing, panels)


def animate_course(path: Path, course: Course, match: int, window: int) -> None:
    """Show the rounds of a match one after another (GIF)."""
    _require_room(course, match)
    with rc_context(STYLE):
        drawing = Figure(figsize=(7.6, 4.4), layout='constrained')
        panels = drawing.subplots(1, 2).tolist()
        _draw_reference(panels[0], course, match)
        _draw_round(panels[1], course, match, 0, window)
        _describe(drawing, panels)
        writer = PillowWriter(fps=1)
        path.parent.mkdir(parents=True, exist_ok=True)
        with writer.saving(drawing, str(path), dpi=100):
            for index in range(len(course.rounds)):
                panels[1].clear()
                _draw_round(panels[1], course, match, index, window)
                writer.grab_frame()


def _some(count: int) -> Sequence[int]:
    """Give all rounds, or some of them with the first and the last."""
    return sorted({round(i) for i in np.linspace(0, count - 1, min(count, _PANELS)).tolist()})


def _draw_reference(axes: Axes, course: Course, match: int) -> None:
    x = np.rint(course.x[match]).astype(np.int64)
    draw_patch(axes, course.previous.gray, x, RADIUS)
    draw_point(axes, course.x[match], 'o', _KEYPOINT)
    axes.set_title(f'previous image, x = {course.x[match][0]:.1f}, {course.x[match][1]:.1f}')


def _draw_round(axes: Axes, course: Course, match: int, index: int, window: int) -> None:
    step = course.rounds[index]
    centre = np.rint(course.y[match]).astype(np.int64)
    pixels = np.rint(course.x[[match]]).astype(np.int64)
    reference = course.distances.reference(course.previous.smoothed, pixels, step.warps[[match]])
    surface = course.distances.surfaces(reference, course.current.smoothed, centre[None],
                                        RADIUS)[:, :, 0]
    draw_patch(axes, course.current.gray, centre, RADIUS)
    draw_heat(axes, surface, centre, 0.75)
    if step.fits.usable[match]:
        draw_paraboloid(axes, step.fits, match, window)
    normal, optimum = step.lines[match, :2], step.optima[match]
    along = np.array([-normal[1], normal[0]]) / np.linalg.norm(normal)
    ends = optimum + np.outer([-3 * RADIUS, 3 * RADIUS], along)
    axes.plot(ends[:, 0], ends[:, 1], color=_LINE, lw=1.8)
    way = np.array([earlier.keypoints[match] for earlier in course.rounds[:index + 1]])
    axes.plot(way[:, 0], way[:, 1], color=_KEYPOINT, lw=1.5)
    draw_point(axes, way[-1], 'o', _KEYPOINT)
    draw_point(axes, optimum, '*', _OPTIMUM, 13)
    distance = abs(line_distances(step.lines[[match]], course.y[[match]])[0])
    loss = paraboloid_values(step.fits, match, optimum[None])[0]
    axes.set_title(f'round {index + 1}: Q(v_opt) = {loss:.1f} bits,\n'
                   f'line {distance:.2f} px off y')
    limit(axes, centre.astype(float), RADIUS)


def _describe(drawing: Figure, panels: Sequence[Axes]) -> None:
    add_scale(drawing, panels)
    drawing.suptitle('Hamming surface around y. Dashed: sampled window with its fit; '
                     '+: minimum of the fit;\nline: epipolar line; dot: keypoint; '
                     'star: y + v_opt')


def _require_room(course: Course, match: int) -> None:
    if not 0 <= match < len(course.y):
        raise DjetError(f'--match is {match}; this pair has matches 0 to {len(course.y) - 1}')
    at_x, at_y = (np.rint(points[[match]]).astype(np.int64) for points in (course.x, course.y))
    if not (describable(at_x, course.previous.smoothed.shape)[0]
            and describable(at_y, course.current.smoothed.shape, RADIUS)[0]):
        raise DjetError(f'match {match} at {at_y[0][0]},{at_y[0][1]} is too close to the border; '
                        'choose another one')
