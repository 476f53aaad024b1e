"""
Scale of a track: landmarks carry relative lengths from step to step, a source measures metres.

Landmarks determine the lengths of steps (`djet_ros.core.window`) up to one factor for the track.
A source of metric lengths observes that factor (`djet_ros.odometry.scale_filter`).
"""

from __future__ import annotations

from copy import copy, deepcopy
from dataclasses import replace
from typing import NamedTuple

from djet_ros.core.correction import Correction
from djet_ros.core.covariance import lift
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.geometry import sphere_tangents
from djet_ros.core.self_calibration import SelfCalibration
from djet_ros.core.types import Array, Pose, RelativePose, Status, View
from djet_ros.core.verdict import as_pure_rotation, as_undecided
from djet_ros.core.window import Window, WindowStep
from djet_ros.odometry.scale import Length, ScaleSource, unknown
from djet_ros.odometry.scale_filter import ScaleFilter
import numpy as np
from scipy.special import bdtr

# Seconds; chosen: the usual speed is a mean over so long, as single steps may be far off. Steps of
# less than this relative standard deviation are not: a camera that brakes is soon much slower than
# its mean, and where that predicts landmarks there are none.
_USUAL_OVER, _WELL_KNOWN = 0.5, 0.05

# Standard deviation of the log length of the first step after an interruption of the track, by
# the usual speed before: the camera may continue faster or slower.
_INTERRUPTED = 0.5

# Random walk of the log factor in a step, as a share of the standard deviation of the step's
# length: over 25 to 100 steps of rendered streets its variance is a third of that of a chain of
# steps, as landmarks outlast steps. The error of a single step is not reduced.
_WANDERING = 0.6

# Least share of landmarks that are consistent with a correct motion (the least observed was 0.75),
# the significance at which fewer reject it, and the number of landmarks below which it is not
# tested.
_CONSISTENT, _SIGNIFICANCE, _FEW = 0.75, 1e-3, 8

# Standard errors, the usual three, below which a length by depths is not significant.
_OUT_OF_NOISE = 3.0


class Step(NamedTuple):
    """
    A step of the track.

    relative: the estimated motion; length: of its translation; window_motion: (4, 4) the current
    camera in the previous one by the sliding window, whose landmarks outlast pairs; None without
    it.
    """

    relative: RelativePose
    length: Length
    window_motion: Array | None = None


class TrackScale:
    """Consistent lengths of a track's steps, in metres if the source measured any."""

    def __init__(self) -> None:
        self._estimator: EstimatorConfig | None = None
        self._uses_landmarks, self._filter = False, ScaleFilter()
        # Survives an interruption of the track, as images stay corrected by it.
        self._calibration: SelfCalibration | None = None
        self.reset()

    def configure(self, estimator: EstimatorConfig, source: ScaleSource, share: float) -> bool:
        """
        Change the parameters, return whether ``begin`` has to follow.

        share: standard deviation that all metric lengths have in common, as a share of them.
        """
        self._filter.configure(share)
        restart = estimator != self._estimator or (
            source.uses_landmarks and not self._uses_landmarks)
        self._source, self._uses_landmarks = source, source.uses_landmarks
        if estimator != self._estimator:
            self._estimator, self._window = estimator, Window(estimator)
        return restart

    def reset(self) -> None:
        """Forget everything; the next step defines a new unit."""
        # Units per second of the last steps.
        self._speed: float | None = None
        self._interrupted = False
        self._filter.reset()
        self.forget_calibration()

    @property
    def keyframe(self) -> bool | None:
        """Return whether the newest frame is a keyframe; None without a window."""
        return self._window.is_keyframe if self._uses_landmarks else None

    @property
    def is_new(self) -> bool:
        """Return whether there are no landmarks."""
        return not self._uses_landmarks or self._window.is_new

    @property
    def needs_parallax(self) -> bool:
        """Return whether new landmarks are needed, or none are used."""
        return not self._uses_landmarks or self._window.needs_parallax

    def landmarks(self, settled: bool = False) -> Array:
        """
        Return points (M, 3), the landmarks in the newest camera, in the unit of its length.

        settled: instead return those that it was the last step to refine.
        """
        if self._speed is None or not self._uses_landmarks:
            return np.empty((0, 3))
        places = self._window.final_landmarks if settled else self._window.landmarks()
        return places * self._filter.factor

    # Calibration

    @property
    def calibration(self) -> SelfCalibration | None:
        """Return what landmarks have shown to be wrong; None until it is significant."""
        if not self._uses_landmarks or self._speed is None:
            return None
        found = self._window.calibration
        return found if found.significant or any(found.corrected) else None

    @property
    def correction_due(self) -> Correction | None:
        """Return what images are to be corrected for from now on; None for no change."""
        due = self._uses_landmarks and self._window.calibration.needs_update
        return self._window.calibration.deviation if due else None

    def correct_images(self, newest: View) -> None:
        """Continue with images that are corrected so; newest: the newest frame."""
        ratio = self._window.correct_images(newest)
        if self._speed is not None:
            self._speed *= ratio
        self._filter.unit_changed(ratio)
        self._calibration = self._window.calibration

    def forget_calibration(self) -> None:
        """Forget the estimate when the track next begins."""
        self._calibration = None

    # Lengths

    def begin(self, view: View, turn: Array | None = None) -> None:
        """
        Begin at a frame without a known motion from the one before: its scale is a guess.

        turn: its rotation (3, 3) from the newest frame of the track, if not much is between them.
        """
        if not self._uses_landmarks:
            return
        self._window.start(view, self._calibration, None if self._speed is None else turn)
        self._filter.restart_sum()
        self._interrupted = self._speed is not None

    def expected_length(self, span_ns: tuple[int, int]) -> Length:
        """Return the measured length, or that at the last speed, of a pair without an estimate."""
        measured = self._source.between(*span_ns)
        return measured if measured.known else self._at_last_speed(span_ns) or measured

    def _at_last_speed(self, span_ns: tuple[int, int]) -> Length | None:
        """Return the length of a step at the speed of the track; None if that is unknown."""
        if not self._uses_landmarks or self._speed is None:
            return None
        usual = self._speed * (span_ns[1] - span_ns[0]) * 1e-9 * self._filter.factor
        # An interruption leaves the length of the next step to a guess, which is not metric.
        return Length(usual, usual, True, self._filter.metric and not self._interrupted, False)

    def length_of_displacement(self, pixels: float) -> float:
        """Return the length that displaces landmarks by so much; zero if there are too few."""
        return 0.0 if self.is_new else (
            self._window.length_of_displacement(pixels) * self._filter.factor)

    def of_step(self, span_ns: tuple[int, int], current: View, relative: RelativePose) -> Step:
        """
        Return the step of an estimated motion from the newest frame of the track, with its length.

        A motion without parallax is replaced by that of the window, if landmarks that were seen
        from a larger baseline determine its translation.
        """
        measured = self._source.between(*span_ns)
        # Parallax contradicts a standstill: wheels slip, or their odometry is not running.
        usable = measured.known and not (relative.t.any() and measured.is_zero)
        if not self._uses_landmarks:
            return Step(relative, self._filter.as_measured(measured))
        seconds = (span_ns[1] - span_ns[0]) * 1e-9
        guess = 1.0 if self._speed is None else self._speed * seconds
        addition = self._added(current, relative, guess)
        if addition is None:
            return Step(relative, self._filter.as_measured(measured) if usable
                        else self._at_last_speed(span_ns) or unknown(measured.value))
        parallax = bool(relative.t.any())
        if not parallax:
            relative, addition = _by_window(relative, addition, guess)
        sigma = self._wander(addition, seconds, parallax)
        self._filter.moved(addition.length, seconds, parallax)
        if measured.known:
            self._filter.update(measured, addition.length, sigma, seconds,
                                self._source.correlation_length, self._source.exact)
            # Until the factor is known, a length is as sure as its measurement.
            if usable and (self._source.exact or not self._filter.metric):
                return self._continued(relative, self._filter.as_measured(measured), addition,
                                       as_measured=True)
        length = self._filter.scaled(addition.length, sigma, usable)
        return self._continued(relative, length, addition)

    def preview(self, span_ns: tuple[int, int], current: View, relative: RelativePose) -> Step:
        """Return the step to a frame that does not become part of the track."""
        if self.is_new:
            return Step(relative, self.expected_length(span_ns))
        track = copy(self)
        track._window, track._filter = self._window.copied(), deepcopy(self._filter)
        return track.of_step(span_ns, current, relative)

    def _continued(self, relative: RelativePose, length: Length, addition: WindowStep,
                   as_measured: bool = False) -> Step:
        """
        Return a step that continues the track as the window has it.

        Its translation is that of the pair if its length is as_measured, or if the window does not
        determine it.
        """
        motion = addition.corrected_motion.copy()
        if as_measured or not relative.t.any():
            motion[:3, 3] = -addition.length * relative.R.T @ relative.t
        self._window.record_published(motion)
        motion[:3, 3] *= length.value / addition.length
        return Step(relative, length, motion)

    def bridge(self, span_ns: tuple[int, int], current: View, relative: RelativePose,
               motion: Array) -> None:
        """
        Continue at a frame whose motion is ambiguous, from the newest frame of the track.

        If its best hypothesis is consistent with the landmarks' depths, they are tracked on: the
        scale is kept, and later steps correct the motion (4, 4), a rotation at most, that was
        integrated. Otherwise the track restarts.
        """
        seconds = (span_ns[1] - span_ns[0]) * 1e-9
        if self._speed is None or not relative.t.any() or not self.agrees(
                Pose(relative.R, relative.t), relative.x, relative.y_opt):
            self.begin(current, motion[:3, :3].T)
        elif (addition := self._added(current, relative, self._speed * seconds)) is not None:
            self._wander(addition, seconds, parallax=True)
            self._window.record_published(motion)

    def _added(self, view: View, relative: RelativePose, guess: float) -> WindowStep | None:
        """Add a frame to the window; return None and restart if it has no length."""
        if not self._window.is_new or (relative.t.any() and self._window.has_depths(relative)):
            noise = 0.0
            try:
                if self._interrupted:
                    guess, noise = self._resumed(relative, guess)
                addition = self._window.add(view, relative, guess)
            except np.linalg.LinAlgError:
                # Something is singular, or no match of a rotation is on a landmark.
                addition = None
            if self._calibration is not None:
                self._calibration = self._window.calibration
            if (addition is not None and np.isfinite(addition.sigma) and addition.length > 0
                    and (relative.t.any() or self._window.determines_translation)):
                self._filter.add_noise(noise**2)
                self._interrupted = False
                return addition
        self.begin(view, relative.R)
        return None

    def _resumed(self, relative: RelativePose, usual: float) -> tuple[float, float]:
        """
        Return the length of the first pair after an interruption, and its relative noise.

        By the depths of the scene before, and by the usual length: the mean of their logarithms,
        weighted by their variances.
        """
        by_scene = self._window.first_length(relative)
        if by_scene is None:
            return usual, _INTERRUPTED
        lengths, sigmas = np.array([by_scene, (usual, _INTERRUPTED)]).T
        weights = sigmas**-2 / (sigmas**-2).sum()
        return float(np.exp(weights @ np.log(lengths))), float((sigmas**-2).sum()**-0.5)

    def _wander(self, addition: WindowStep, seconds: float, parallax: bool) -> float:
        """
        Update speed and factor variance, return the length's standard deviation as a share of it.

        A rotation leaves the scale to older landmarks: it wanders by the standard deviation of the
        camera's position, over a usual step.
        """
        own, usual = min(addition.sigma / addition.length, 1.0), addition.length
        if self._speed is None:
            self._speed = addition.length / seconds
        elif parallax:
            share = max(1 - np.exp(-seconds / _USUAL_OVER), 1 / (1 + (own / _WELL_KNOWN)**2))
            self._speed += share * (addition.length / seconds - self._speed)
        else:
            usual = max(usual, self._speed * seconds)
        self._filter.add_noise((_WANDERING * min(addition.sigma / usual, 1.0))**2)
        return own

    # Consistency of pairs with the landmarks' depths

    def verified(self, relative: RelativePose, K: Array) -> RelativePose:
        """
        Return the pair with the status that the depths of landmarks give it; K: (3, 3).

        A motion that they contradict is AMBIGUOUS; an AMBIGUOUS one is OK if they agree with it
        and contradict all its rivals; one without significant parallax is a rotation.
        """
        if relative.status not in (Status.OK, Status.AMBIGUOUS):
            return relative
        agrees = self.agrees(Pose(relative.R, relative.t), relative.x, relative.y_opt)
        if relative.status is Status.OK:
            if agrees is False:
                return as_undecided(relative)
            return as_pure_rotation(relative, K) if self.lacks_parallax(relative) else relative
        if agrees and all(self.agrees(rival.pose, relative.x, relative.y) is False
                          for rival in relative.rivals):
            return replace(relative, status=Status.OK)
        return relative

    def agrees(self, pose: Pose, x: Array, y: Array) -> bool | None:
        """
        Return whether a motion from the newest frame triangulates landmarks at their depths.

        x, y: (N, 2) matched pixels. A wrong motion may explain two frames, but gives other depths.
        False if as few landmarks are consistent as in one of a thousand correct motions; None if
        there are too few of them.
        """
        if self.is_new:
            return None
        consistent, tested = self._window.count_agreeing(pose, x, y)
        if tested < _FEW:
            return None
        return bool(bdtr(consistent, tested, _CONSISTENT) >= _SIGNIFICANCE)

    def lacks_parallax(self, relative: RelativePose) -> bool:
        """Return whether the pair's length, by the depths of landmarks, is not significant."""
        if self.is_new:
            return False
        length = self._window.pair_length(relative)
        return length is not None and length[0] < _OUT_OF_NOISE * length[1]


def _by_window(relative: RelativePose, addition: WindowStep, usual: float
               ) -> tuple[RelativePose, WindowStep]:
    """
    Return a pair without parallax with the motion of the window, if that determines it.

    usual: length of a usual step, the standard deviation of an unknown translation. If that of the
    window is larger, the pair is kept, with a length as uncertain as a usual step. The status
    stays, as it is that of the two images.
    """
    if np.linalg.eigvalsh(addition.covariance[3:, 3:])[-1] > usual**2:
        return relative, replace(addition, length=usual, sigma=usual)
    to_unit = np.diag(np.repeat([1.0, 1 / addition.length], 3))
    to_unit[3:, 3:] -= np.outer(addition.t, addition.t) / addition.length**3
    t, covariance = addition.t / addition.length, to_unit @ addition.covariance @ to_unit
    basis = lift(sphere_tangents(t))
    return replace(relative, R=addition.R, t=t, covariance_5=basis.T @ covariance @ basis,
                   covariance_6=covariance), addition
