"""What a calibration leaves of distortion in the images of a recording."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from djet_ros.config.sections import Config
from djet_ros.core.lens import (
    by_radius,
    fit_lens,
    is_informative,
    LensFit,
    MatchedPair,
    outermost,
)
from djet_ros.core.types import Array, RelativePose, Status
from djet_ros.errors import DjetError
from djet_ros.lab.style import COLOURS, figure
from djet_ros.odometry.camera import Camera, means_rectified
from djet_ros.odometry.tracker import Tracker
from djet_ros.recordings.decoding import message_type
from djet_ros.recordings.mask_files import still_mask
from djet_ros.recordings.recording import Recording
import numpy as np
import yaml

# Informative pairs that are needed, so that there are groups to compare; of more, every other one
# is kept.
LEAST_PAIRS, MOST_PAIRS = 20, 2000

# Standard errors, and pixels at the outermost matches, from which on a coefficient is worth
# changing. By ten groups, errors are of a Student distribution of nine degrees of freedom, and 4.1
# is there what three is of a normal one.
_SURE, _VISIBLE = 4.1, 0.3

# Standard errors by which more and less informative pairs may differ.
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
    What was found of a camera's distortion.

    info: its CameraInfo; rectified: whether its images come rectified, so that what distortion
    they have is that of odometry.residual_k1 alone; pairs: how many were tracked in all; the fit
    is that of the informative ones.
    """

    camera: Camera
    info: Any
    rectified: bool
    pairs: int
    fit: LensFit

    @property
    def coefficients(self) -> list[float]:
        """Give the distortion as OpenCV has it, with the k1 that was found."""
        return [self.fit.k1, *self.camera.distortion[1][1:].tolist()]

    @property
    def turned_deg(self) -> float:
        """By how much the camera turns in the informative pairs, all in all."""
        return float(np.degrees(sum(one.pair.angle for one in self.fit.linearised)))

    def moved_pixels(self, k1: float) -> float:
        """By how many pixels a coefficient moves the outermost matches, at most."""
        places = outermost([one.pair for one in self.fit.linearised])
        moved = self.camera.pixels(places, k1)[0] - self.camera.pixels(places, self.camera.k1)[0]
        return float(np.linalg.norm(moved, axis=1).max())

    @property
    def worth_correcting(self) -> bool:
        """Whether the calibration is wrong for certain, and by what can be seen."""
        return (abs(self.fit.k1 - self.camera.k1) > _SURE * self.fit.sigma
                and self.moved_pixels(self.fit.k1) > _VISIBLE)


def examine(recording: Recording, config: Config, advance: Callable[[], None]) -> LensReport:
    """
    Run a recording through the odometry, and find the coefficient k1 that suits its pairs.

    At most 2000 pairs of 300 matches are held, spread over all of it. DjetError where they do not
    determine it.
    """
    informative, pairs, every = list[MatchedPair](), 0, 1
    for seen in _pairs(recording, config, advance):
        pairs += 1
        pair = MatchedPair.of(seen.relative, seen.camera.K)
        if pairs % every == 0 and is_informative(pair, seen.camera):
            informative.append(pair)
        if len(informative) > MOST_PAIRS:
            del informative[::2]
            every *= 2
    if len(informative) < LEAST_PAIRS:
        raise DjetError(_too_few(len(informative), pairs))
    rectified = means_rectified(config.odometry.rectified, recording.image_topic)
    return LensReport(seen.camera, seen.info, rectified, pairs,
                      trusted_fit(informative, seen.camera))


def _too_few(informative: int, pairs: int) -> str:
    """Say what is missing: where most pairs are informative, there are just too few of them."""
    said = (f'{informative} of {pairs} pairs are informative about the lens, and {LEAST_PAIRS} '
            'are needed')
    if 2 * informative > pairs:
        return f'{said}; record for longer'
    return (f'{said}; record turns, or ways sideways, past what is near and far: straight ahead '
            'tells nothing')


def trusted_fit(pairs: Sequence[MatchedPair], camera: Camera) -> LensFit:
    """Find k1, and raise DjetError where something else seems to be wrong with the pairs."""
    fit = fit_lens(pairs, camera)
    if fit is None:
        raise DjetError(f'no k1 was found, from {camera.k1:.4g} on, that suits the pairs and does '
                        'not fold the image: the camera matrix or other coefficients may be '
                        'wrong; calibrate with a target first')
    before, after = (sum(pair.angle for pair in some)
                     for some in (pairs, [one.pair for one in fit.linearised]))
    if abs(after - before) > _SAME_TURN * before + _HARDLY_TURNED * len(pairs):
        raise DjetError(f'with k1 = {fit.k1:.2g} the camera would turn by {np.degrees(after):.0f} '
                        f'degrees, not {np.degrees(before):.0f}: turns pass for ways sideways '
                        'here; record turns past what is near and far, without blur')
    if fit.disagreement > _AGREE:
        raise DjetError('the more informative pairs are at odds with the others, by '
                        f'{fit.disagreement:.1f} standard errors: no k1 explains that, but '
                        'rolling rows, blur or a wrong camera matrix may; record slower turns')
    return fit


class _Pair(NamedTuple):
    """A pair that was tracked, by a camera with a CameraInfo."""

    camera: Camera
    info: Any
    relative: RelativePose


def _tracker(recording: Recording, config: Config) -> Tracker:
    if config.odometry.mask:
        raise DjetError('odometry.mask is true, and masks by stamp are not read here; give '
                        'odometry.mask_file, or none')
    # Lengths are of no use here, and what measures them is not read.
    config = replace(config, odometry=replace(config.odometry, scale='none', imu=False,
                                              guess=False))
    return Tracker(config, message_type, image_topic=recording.image_topic,
                   still_mask=still_mask(config.odometry.mask_file))


def _pairs(recording: Recording, config: Config, advance: Callable[[], None]) -> Iterator[_Pair]:
    """Yield what the odometry makes of a recording; DjetError where another camera goes on."""
    tracker = _tracker(recording, config)
    camera: Camera | None = None
    info: Any = None
    for topic, _, message in recording.messages():
        if topic == recording.info_topic:
            tracker.camera_info(message)
            if camera is None:
                camera, info = tracker.camera, message
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
                yield _Pair(camera, info, last.relative)
    if not tracker.counts.processed:
        raise tracker.problem or DjetError(
            f'none of {tracker.counts.received} images came after a CameraInfo on '
            f'{recording.info_topic}; record it too, or choose one with --info-topic')


def calibration(report: LensReport) -> str:
    """
    Word the CameraInfo as YAML, as camera_info_manager reads it, with the k1 that was found.

    All else stays, as it is of the full resolution and perhaps of a stereo pair. Only of images
    that come raw: the CameraInfo of rectified ones is about those before the rectification.
    """
    info = report.info
    return str(yaml.safe_dump({
        'image_width': int(info.width), 'image_height': int(info.height), 'camera_name': 'camera',
        'camera_matrix': _matrix(info.k, 3),
        'distortion_model': report.camera.distortion[0],
        'distortion_coefficients': _matrix(report.coefficients, 1),
        'rectification_matrix': _matrix(info.r, 3),
        'projection_matrix': _matrix(info.p, 3)}, sort_keys=False, default_flow_style=None))


def _matrix(values: Sequence[float], rows: int) -> dict[str, Any]:
    data = np.asarray(values, float).ravel().tolist()
    return {'rows': rows, 'cols': len(data) // rows, 'data': data}


def plot_lens(path: Path, title: str, report: LensReport) -> None:
    """Draw by how many pixels matches are off along the radius, and what k1 makes of that."""
    fit, camera = report.fit, report.camera
    radii = np.concatenate([np.linalg.norm(one.pair.y, axis=1) for one in fit.linearised])
    edges = np.linspace(0, float(np.quantile(radii, 0.999)), _RINGS + 1)
    middles, fine = (edges[:-1] + edges[1:]) / 2, np.linspace(0, edges[-1], 100)
    k1, sigma = by_radius(fit, edges)
    with figure(path, 6.4, 4.2) as drawing:
        axes = drawing.subplots()
        axes.axhline(0, color='black', lw=0.8, label='so far')
        axes.plot(_radius(camera, fine), _outwards(camera, fine, fit.k1), color=COLOURS['rpe'],
                  label=f'k1 = {fit.k1:.4f} ± {fit.sigma:.4f}')
        off, width = (np.concatenate([_outwards(camera, at, one)
                                      for at, one in zip(middles[:, None], values)])
                      for values in (k1, camera.k1 + sigma))
        axes.errorbar(_radius(camera, middles), off, np.abs(width), fmt='o', ms=4,
                      color=COLOURS['djet'], label='by matches in rings')
        axes.set_xlabel('distance from the principal point, px')
        axes.set_ylabel('seen too far out, px')
        axes.set_title(title)
        axes.legend()


def _radius(camera: Camera, radii: Array) -> Array:
    """Pixels (N,) from the middle at which points of radii X/Z (N,) are seen, as calibrated."""
    return np.asarray(_along(camera, radii, camera.k1) - _along(camera, np.zeros(1), camera.k1))


def _outwards(camera: Camera, radii: Array, k1: float) -> Array:
    """By how many pixels (N,) a coefficient moves points of radii X/Z (N,) outwards."""
    return np.asarray(_along(camera, radii, k1) - _along(camera, radii, camera.k1))


def _along(camera: Camera, radii: Array, k1: float) -> Array:
    """Columns (N,) in which points of X/Z (N,) and Y/Z = 0 are seen."""
    return camera.pixels(np.stack([radii, np.zeros_like(radii)], axis=-1), k1)[0][:, 0]
