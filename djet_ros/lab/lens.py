"""Estimation of the residual radial distortion of a calibrated camera, from a recording."""

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
from djet_ros.lab.processed import processed
from djet_ros.lab.style import COLOURS, figure
from djet_ros.odometry.camera import Camera, is_rectified
from djet_ros.odometry.tracker import Tracker
from djet_ros.recordings.decoding import message_type
from djet_ros.recordings.mask_files import static_mask
from djet_ros.recordings.recording import Recording, refuse, Warn
import numpy as np
import yaml

# Fewest informative pairs, to have blocks for the jackknife, and most, beyond which every other
# one is dropped.
LEAST_PAIRS, MOST_PAIRS = 20, 2000

# Standard errors, and pixels at the outermost matches, beyond which a correction is worthwhile.
# With ten blocks the error has a Student distribution of nine degrees of freedom, for which 4.1
# corresponds to 3 sigma of a normal distribution.
_SIGNIFICANT_SIGMAS, _VISIBLE_PX = 4.1, 0.3

# Standard errors by which more and less informative pairs may differ.
_CONSISTENT_SIGMAS = 3.0

# chosen: relative change of the total rotation that a coefficient may cause; 0.07 was seen where
# 0.05 was right, and 0.44 where noise was taken for parallax.
_ROTATION_CHANGE = 0.2

# rad; chosen: accuracy of the rotation between consecutive images.
_ROTATION_ACCURACY = 1e-3

# Number of rings of the radius in the plot.
_RINGS = 8


@dataclass(frozen=True)
class LensReport:
    """
    Estimate of a camera's radial distortion.

    info: its CameraInfo; rectified: whether its images are rectified, so that their only
    distortion model is odometry.residual_k1; pairs: number of tracked pairs; fit: estimate from
    the informative ones.
    """

    camera: Camera
    info: Any
    rectified: bool
    pairs: int
    fit: LensFit

    @property
    def coefficients(self) -> list[float]:
        """Return OpenCV's distortion coefficients, with the estimated k1."""
        return [self.fit.k1, *self.camera.distortion[1][1:].tolist()]

    @property
    def turned_deg(self) -> float:
        """Return the sum of the rotation angles of the informative pairs in degrees."""
        return float(np.degrees(sum(one.pair.angle for one in self.fit.linearised)))

    def moved_pixels(self, k1: float) -> float:
        """Return the largest shift in pixels of the outermost matches by a coefficient."""
        places = outermost([one.pair for one in self.fit.linearised])
        moved = self.camera.pixels(places, k1)[0] - self.camera.pixels(places, self.camera.k1)[0]
        return float(np.linalg.norm(moved, axis=1).max())

    @property
    def worth_correcting(self) -> bool:
        """Return whether the error of the calibration is significant, and visible in pixels."""
        return (abs(self.fit.k1 - self.camera.k1) > _SIGNIFICANT_SIGMAS * self.fit.sigma
                and self.moved_pixels(self.fit.k1) > _VISIBLE_PX)


def examine(recording: Recording, config: Config, advance: Callable[[], None],
            warn: Warn = refuse) -> LensReport:
    """
    Run a recording through the odometry, and estimate the coefficient k1 from its pairs.

    At most 2000 pairs of 300 matches are kept, spread over the recording; warn: see ``processed``.
    Raises DjetError if they do not determine k1.
    """
    informative, pairs, every = list[MatchedPair](), 0, 1
    for seen in _pairs(recording, config, advance, warn):
        pairs += 1
        pair = MatchedPair.of(seen.relative, seen.camera.K)
        if pairs % every == 0 and is_informative(pair, seen.camera):
            informative.append(pair)
        if len(informative) > MOST_PAIRS:
            del informative[::2]
            every *= 2
    if len(informative) < LEAST_PAIRS:
        raise DjetError(_too_few(len(informative), pairs))
    rectified = is_rectified(config.odometry.rectified, recording.image_topic)
    return LensReport(seen.camera, seen.info, rectified, pairs,
                      trusted_fit(informative, seen.camera))


def _too_few(informative: int, pairs: int) -> str:
    """Return the error message: too short, if most pairs are informative, or the wrong motion."""
    text = (f'{informative} of {pairs} pairs are informative about the lens, at least '
            f'{LEAST_PAIRS} are needed')
    if 2 * informative > pairs:
        return f'{text}; record for longer'
    return (f'{text}; record turns or sideways motion in a scene with depth: forward motion does '
            'not determine k1')


def trusted_fit(pairs: Sequence[MatchedPair], camera: Camera) -> LensFit:
    """Estimate k1; raise DjetError if the pairs contradict the model."""
    fit = fit_lens(pairs, camera)
    if fit is None:
        raise DjetError(f'no k1 was found, starting from {camera.k1:.4g}, that fits the pairs '
                        'with an invertible distortion: the camera matrix or other coefficients '
                        'may be wrong; calibrate with a target first')
    before, after = (sum(pair.angle for pair in some)
                     for some in (pairs, [one.pair for one in fit.linearised]))
    if abs(after - before) > _ROTATION_CHANGE * before + _ROTATION_ACCURACY * len(pairs):
        raise DjetError(f'with k1 = {fit.k1:.2g} the total rotation would be '
                        f'{np.degrees(after):.0f} degrees instead of {np.degrees(before):.0f}: '
                        'rotation and sideways translation are confused; record turns in a scene '
                        'with depth, without motion blur')
    if fit.disagreement > _CONSISTENT_SIGMAS:
        raise DjetError('the more informative pairs disagree with the others by '
                        f'{fit.disagreement:.1f} standard errors: no k1 explains that, but a '
                        'rolling shutter, motion blur or a wrong camera matrix may; record slower '
                        'turns')
    return fit


class _Pair(NamedTuple):
    """A tracked pair, its camera and CameraInfo."""

    camera: Camera
    info: Any
    relative: RelativePose


def _tracker(recording: Recording, config: Config) -> Tracker:
    if config.odometry.mask:
        raise DjetError('odometry.mask is true, but this command does not read masks from a '
                        'topic; set it to false, or use odometry.mask_file')
    # The scale is irrelevant here, and its sources are not read.
    config = replace(config, odometry=replace(config.odometry, scale='none', imu=False,
                                              guess=False))
    return Tracker(config, message_type, image_topic=recording.image_topic,
                   static_mask=static_mask(config.odometry.mask_file))


def _pairs(recording: Recording, config: Config, advance: Callable[[], None],
           warn: Warn) -> Iterator[_Pair]:
    """Yield the pairs of a recording; raise DjetError if the camera changes."""
    tracker = _tracker(recording, config)
    camera: Camera | None = None
    infos: list[Any] = []

    def take(topic: str, message: Any) -> None:
        if topic == recording.info_topic and not infos:
            infos.append(message)

    for result in processed(recording, tracker, advance, take, warn):
        camera = camera or tracker.camera
        if camera is None or tracker.camera is not camera:
            raise DjetError('the CameraInfo changes within this recording; split it there')
        if result.status is Status.OK and result.relative is not None:
            yield _Pair(camera, infos[0], result.relative)


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
    """Plot the radial shift of matches in pixels by radius, and that of the estimated k1."""
    fit, camera = report.fit, report.camera
    radii = np.concatenate([np.linalg.norm(one.pair.y, axis=1) for one in fit.linearised])
    edges = np.linspace(0, float(np.quantile(radii, 0.999)), _RINGS + 1)
    middles, fine = (edges[:-1] + edges[1:]) / 2, np.linspace(0, edges[-1], 100)
    k1, sigma = by_radius(fit, edges)
    with figure(path, 6.4, 4.2) as drawing:
        axes = drawing.subplots()
        axes.axhline(0, color='black', lw=0.8, label='calibration')
        axes.plot(_radius(camera, fine), _outwards(camera, fine, fit.k1), color=COLOURS['rpe'],
                  label=f'k1 = {fit.k1:.4f} ± {fit.sigma:.4f}')
        off, width = (np.concatenate([_outwards(camera, at, one)
                                      for at, one in zip(middles[:, None], values)])
                      for values in (k1, camera.k1 + sigma))
        axes.errorbar(_radius(camera, middles), off, np.abs(width), fmt='o', ms=4,
                      color=COLOURS['djet'], label='matches, by ring')
        axes.set_xlabel('distance from the principal point, px')
        axes.set_ylabel('outward shift, px')
        axes.set_title(title)
        axes.legend()


def _radius(camera: Camera, radii: Array) -> Array:
    """Return the image radii (N,) in pixels of points of radii X/Z (N,), as calibrated."""
    return np.asarray(_along(camera, radii, camera.k1) - _along(camera, np.zeros(1), camera.k1))


def _outwards(camera: Camera, radii: Array, k1: float) -> Array:
    """Return the outward shift (N,) in pixels of points of radii X/Z (N,) by a coefficient."""
    return np.asarray(_along(camera, radii, k1) - _along(camera, radii, camera.k1))


def _along(camera: Camera, radii: Array, k1: float) -> Array:
    """Return the image columns (N,) of points of X/Z (N,) and Y/Z = 0."""
    return camera.pixels(np.stack([radii, np.zeros_like(radii)], axis=-1), k1)[0][:, 0]
