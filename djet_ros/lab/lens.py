"""What the images of a recording say of their calibration: the distortion that it leaves."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from djet_ros.config.sections import Config
from djet_ros.core.geometry import rays
from djet_ros.core.lens import by_radius, fit_lens, LensFit, MatchedPair, tells
from djet_ros.core.types import Array, RelativePose, Status
from djet_ros.errors import DjetError
from djet_ros.lab.style import COLOURS, figure
from djet_ros.odometry.camera import Camera
from djet_ros.odometry.images import gray_image
from djet_ros.odometry.tracker import Tracker
from djet_ros.recordings.decoding import message_type
from djet_ros.recordings.recording import Recording
import numpy as np
import yaml

# Pairs that have to tell, so that there are groups to compare; of more, every other one is kept.
LEAST_PAIRS, MOST_PAIRS = 20, 2000

# Standard errors, and pixels at the corners, from which on a coefficient is worth changing.
_SURE, _VISIBLE = 3.0, 0.3

# Standard errors by which pairs that tell much and little may differ.
_AGREE = 3.0

# chosen: share by which a coefficient may change how far the camera turns; 0.07 was seen where
# 0.05 was right, and 0.44 where noise was taken for parallax.
_SAME_TURN = 0.2

# rad; chosen: what a turn from one image to the next is good for.
_HARDLY_TURNED = 1e-3

# Parts of the radius that the plot shows.
_RINGS = 8


@dataclass(frozen=True)
class LensReport:
    """
    What a recording tells of its camera's distortion.

    size: (width, height) of its images; pairs: how many were tracked in all; the fit is that of
    those that tell.
    """

    camera: Camera
    size: tuple[int, int]
    pairs: int
    fit: LensFit

    @property
    def coefficients(self) -> list[float]:
        """Give the distortion as OpenCV has it, with the k1 that was found."""
        return [self.fit.k1, *self.camera.distortion[1][1:].tolist()]

    @property
    def turned_deg(self) -> float:
        """By how much the camera turns in the pairs that tell, all in all."""
        return float(np.degrees(sum(one.pair.angle for one in self.fit.told)))

    def corner_pixels(self, k1: float) -> float:
        """By how many pixels a coefficient moves what is seen in the corners, at most."""
        width, height = self.size
        corners = np.array([(x, y) for x in (0, width - 1) for y in (0, height - 1)], float)
        places = rays(self.camera.K, corners)[:, :2]
        moved = self.camera.pixels(places, k1)[0] - self.camera.pixels(places, self.camera.k1)[0]
        return float(np.linalg.norm(moved, axis=1).max())

    @property
    def worth_correcting(self) -> bool:
        """Whether the calibration is wrong for certain, and by what can be seen."""
        return (abs(self.fit.k1 - self.camera.k1) > _SURE * self.fit.sigma
                and self.corner_pixels(self.fit.k1) > _VISIBLE)


def examine(recording: Recording, config: Config, advance: Callable[[], None]) -> LensReport:
    """
    Run a recording through the odometry, and find the coefficient k1 that suits its pairs.

    At most 2000 pairs of 300 matches are held, spread over all of it. DjetError where the camera
    moves in no way that would tell.
    """
    telling, pairs, every = list[MatchedPair](), 0, 1
    for seen in _pairs(recording, config, advance):
        pairs += 1
        pair = MatchedPair.of(seen.relative, seen.camera.K)
        if pairs % every == 0 and tells(pair, seen.camera):
            telling.append(pair)
        if len(telling) > MOST_PAIRS:
            del telling[::2]
            every *= 2
    if len(telling) < LEAST_PAIRS:
        raise DjetError(f'{len(telling)} of {pairs} pairs tell of the lens, and {LEAST_PAIRS} are '
                        'needed; record turns, or ways sideways, past what is near and far: '
                        'straight ahead tells nothing')
    fit = fit_lens(telling, seen.camera)
    _check(fit, telling)
    return LensReport(seen.camera, seen.size, pairs, fit)


def _check(fit: LensFit, pairs: Sequence[MatchedPair]) -> None:
    """Raise DjetError where something else than a k1 seems to be wrong with the pairs."""
    before, after = (sum(pair.angle for pair in some)
                     for some in (pairs, [one.pair for one in fit.told]))
    if abs(after - before) > _SAME_TURN * before + _HARDLY_TURNED * len(pairs):
        raise DjetError(f'with k1 = {fit.k1:.2g} the camera would turn by {np.degrees(after):.0f} '
                        f'degrees, not {np.degrees(before):.0f}: turns pass for ways sideways '
                        'here; record turns past what is near and far, without blur')
    if fit.disagreement > _AGREE:
        raise DjetError('the pairs that tell most of the lens are at odds with the others, by '
                        f'{fit.disagreement:.1f} standard errors: no k1 explains that, but '
                        'rolling rows, blur or a wrong camera matrix may; record slower turns')


class _Pair(NamedTuple):
    """A pair that was tracked in images of a size (width, height)."""

    camera: Camera
    size: tuple[int, int]
    relative: RelativePose


def _pairs(recording: Recording, config: Config, advance: Callable[[], None]) -> Iterator[_Pair]:
    """Yield what the odometry makes of a recording; DjetError where another camera goes on."""
    config = replace(config, odometry=replace(config.odometry, scale='none'))
    tracker = Tracker(config, message_type, image_topic=recording.image_topic)
    camera: Camera | None = None
    for topic, _, message in recording.messages():
        if topic == recording.info_topic:
            tracker.camera_info(message)
            camera = camera or tracker.camera
            if tracker.counts.rejected_infos and tracker.problem is not None:
                raise tracker.problem
            if tracker.camera is not camera:
                raise DjetError('another camera goes on in this recording; cut it there')
        elif topic == recording.image_topic:
            processed, last = tracker.counts.processed, None
            tracker.image(message)
            advance()
            if tracker.counts.processed > processed:
                last = tracker.last
            if camera is not None and last is not None and last.status is Status.OK \
                    and last.relative is not None:
                height, width = gray_image(message).shape
                yield _Pair(camera, (width, height), last.relative)
    if not tracker.counts.processed:
        raise tracker.problem or DjetError(
            f'none of {tracker.counts.received} images came after a CameraInfo on '
            f'{recording.info_topic}; record it too, or choose one with --info-topic')


def calibration(report: LensReport) -> str:
    """Word the camera with the k1 that was found as YAML, as ROS's camera_calibration has it."""
    camera, (width, height) = report.camera, report.size
    projection = np.column_stack([camera.K, np.zeros(3)])
    return str(yaml.safe_dump({
        'image_width': width, 'image_height': height, 'camera_name': 'camera',
        'camera_matrix': _matrix(camera.raw_K),
        'distortion_model': camera.distortion[0],
        'distortion_coefficients': _matrix(np.array([report.coefficients])),
        'rectification_matrix': _matrix(np.eye(3)),
        'projection_matrix': _matrix(projection)}, sort_keys=False, default_flow_style=None))


def _matrix(values: Array) -> dict[str, Any]:
    rows, columns = values.shape
    return {'rows': rows, 'cols': columns, 'data': values.ravel().tolist()}


def plot_lens(path: Path, title: str, report: LensReport) -> None:
    """Draw by how many pixels matches are off along the radius, and what k1 makes of that."""
    fit, camera = report.fit, report.camera
    radii = np.concatenate([np.linalg.norm(one.pair.y, axis=1) for one in fit.told])
    edges = np.linspace(0, float(np.quantile(radii, 0.999)), _RINGS + 1)
    middles, fine = (edges[:-1] + edges[1:]) / 2, np.linspace(0, edges[-1], 100)
    k1, sigma = by_radius(fit, edges)
    with figure(path, 6.4, 4.2) as drawing:
        axes = drawing.subplots()
        axes.axhline(0, color='black', lw=0.8, label='as calibrated')
        axes.plot(_radius(camera, fine), _outwards(camera, fine, fit.k1), color=COLOURS['rpe'],
                  label=f'k1 = {fit.k1:.4f} ± {fit.sigma:.4f}')
        off, width = (np.array([_outwards(camera, at, one) for at, one in zip(middles, values)])
                      for values in (k1, camera.k1 + sigma))
        axes.errorbar(_radius(camera, middles), off, np.abs(width), fmt='o', ms=4,
                      color=COLOURS['djet'], label='what matches in rings say')
        axes.set_xlabel('distance from the principal point, px')
        axes.set_ylabel('seen too far out, px')
        axes.set_title(title)
        axes.legend()


def _radius(camera: Camera, radii: Array) -> Array:
    """Pixels (N,) from the principal point at which points of radii X/Z are seen."""
    return np.asarray(radii * camera.raw_K[0, 0])


def _outwards(camera: Camera, radii: Array, k1: float) -> Array:
    """By how many pixels a coefficient moves points of radii X/Z outwards."""
    radii = np.atleast_1d(radii)
    places = np.stack([radii, np.zeros_like(radii)], axis=-1)
    moved = camera.pixels(places, k1)[0] - camera.pixels(places, camera.k1)[0]
    return np.squeeze(moved[:, 0])
