"""
One scale along a track: lengths of steps by the landmarks that frames share, metres by a source.

Landmarks tell how the lengths of steps compare (`djet_ros.core.window`), up to one factor. A
source that measures metres is an observation of that factor. A Kalman filter over its logarithm
brings both together: the factor hardly changes from step to step, so single measurements may be
coarse or missing, and where the source falls silent the last factor goes on, less and less sure.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from djet_ros.core.covariance import lift
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.geometry import sphere_tangents
from djet_ros.core.self_calibration import SelfCalibration
from djet_ros.core.types import Array, Pose, RelativePose, View
from djet_ros.core.window import Addition, Window
from djet_ros.odometry.scale import Common, Length, ScaleSource
import numpy as np
from scipy.special import bdtr

# Standard deviation of the factor's logarithm where a track was torn: the camera may go on faster
# or slower than it did.
_TORN = 0.5

# From here on a factor is no knowledge of metres any more.
_LOST = 0.35

# By how much the factor wanders in a step, as a share of how unsure the step's own length is: from
# 25 to 100 steps on, on rendered streets, its variance is a third of what it were if each step
# were held against the one before alone, since landmarks outlast steps. It is the step's own error
# that stays by that share.
_WANDERING = 0.6

# Single metric lengths differ from one another by this at least (bumps, time stamps).
_LEAST_NOISE = 0.02

# Normalised squared innovation (1 expected) beyond which a length is not believed, and how many
# of them in a row are no accident.
_SURPRISE, _IN_A_ROW = 16.0, 8

# How many times as long as lengths err alike these have to last: what is as long as that (a lawn
# as long as the ground that is in sight) surprises for twice as long.
_AS_LONG = 2.0

# Seconds; chosen: short lengths over which tell together what each does not.
_TOGETHER = 1.0


# Least share of landmarks that agree with a right motion (0.75 was the least that was seen), how
# improbable fewer have to be, and how many landmarks tell nothing.
_RIGHT, _BY_CHANCE, _FEW = 0.75, 1e-3, 8

# Standard errors, the usual three, within which a length by depths is none.
_OUT_OF_NOISE = 3.0


class Step(NamedTuple):
    """
    A step of the track.

    relative: the motion that was estimated, in length; onward: (4, 4) the current camera in the
    one before as the track goes on, where landmarks that outlast pairs tell that.
    """

    relative: RelativePose
    length: Length
    onward: Array | None = None


class OneScale:
    """
    The one scale of a track, from its landmarks and from a source.

    share: standard deviation that all metric lengths have in common, as a share of them.
    """

    def __init__(self) -> None:
        self._estimator: EstimatorConfig | None = None
        self._share, self._carried = 0.0, False
        # What outlasts a track: by what images are straightened.
        self._lens: SelfCalibration | None = None
        self.reset()

    def configure(self, estimator: EstimatorConfig, source: ScaleSource, share: float) -> bool:
        """Take other parameters; tells whether the track has to begin anew for them."""
        if share != self._share:
            self._kept[1] = 0.0
        anew = estimator != self._estimator or (source.carried and not self._carried)
        self._source, self._share, self._carried = source, share, source.carried
        if estimator != self._estimator:
            self._estimator, self._window = estimator, Window(estimator)
        self._short = np.zeros(5)
        return anew

    def reset(self) -> None:
        """Forget the factor; the next step makes a new unit."""
        self._speed: float | None = None
        # Whether it is a guess already how long the next step is.
        self._torn = False
        self._log, self._variance, self._metric = 0.0, 0.0, False
        # How many lengths in a row were not believed, and their metres.
        self._surprises = np.zeros(2)
        # Of short lengths since one told the factor: see _told.
        self._short = np.zeros(5)
        # Whether the track ever was in metres, and what is left of the errors that the last step
        # had in common with others.
        self._was_metric = False
        self._kept: Array = np.ones(2)
        self.forget_lens()

    @property
    def keyframe(self) -> bool | None:
        """Whether the newest frame of the track is a keyframe; None where none are chosen."""
        return self._window.is_keyframe if self._carried else None

    @property
    def lens(self) -> SelfCalibration | None:
        """Tell what distortion landmarks show to be left; None before that is certain."""
        if not self._carried or self._speed is None:
            return None
        lens = self._window.lens
        return lens if lens.certain or lens.undone else None

    @property
    def k1_due(self) -> float | None:
        """Tell without which k1 images are to be seen from now on; None where nothing changes."""
        return self._window.lens.k1 if self._carried and self._window.lens.due else None

    def straighten(self, newest: View) -> None:
        """Go on with images without that k1, of which newest, the last one again, is the first."""
        self._window.straighten(newest)
        self._lens = self._window.lens

    def forget_lens(self) -> None:
        """Forget what is known of the lens, from where the track begins anew."""
        self._lens = None

    @property
    def is_new(self) -> bool:
        """Whether there are no landmarks yet, or none are kept."""
        return not self._carried or self._window.is_new

    def begin(self, view: View) -> None:
        """Begin with a frame that nothing relates to the one before; the scale is a guess then."""
        if not self._carried:
            return
        self._window.start(view, self._lens)
        self._short = np.zeros(5)
        if self._speed is not None and not self._torn:
            self._doubt(_TORN**2)
            self._torn = True

    def of_step(self, span_ns: tuple[int, int], current: View, relative: RelativePose) -> Step:
        """
        Give a step whose motion was estimated, from the newest frame of the track on, its length.

        Its motion is that of the pair, but where it has too little parallax to tell of a
        translation, what landmarks tell that were seen from further away.
        """
        measured = self._source.between(*span_ns)
        if not self._carried:
            return Step(relative, self._in_metres(measured))
        seconds = (span_ns[1] - span_ns[0]) * 1e-9
        guess = 1.0 if self._speed is None else self._speed * seconds
        addition = self._added(current, relative, guess)
        if addition is None:
            return Step(relative, self._in_metres(measured) if measured.known
                        else self.of_rest(span_ns))
        parallax = bool(relative.t.any())
        if not parallax:
            relative, addition = _as_landmarks_tell(relative, addition, guess)
        own = self._wandered(addition, seconds, parallax)
        if measured.known:
            self._hear(measured, addition.length, own, seconds)
            # Until the factor is known, lengths are as sure as they are measured.
            if self._source.exact or not self._metric:
                return self._onward(relative, self._in_metres(measured), addition, True)
        value = addition.length * float(np.exp(self._log))
        # The factor of a relative scale is that of the whole track, and no error of a step.
        common = np.hypot(np.sqrt(self._variance), self._share) if self._metric else 0.0
        length = Length(value, value * float(np.hypot(own, common)), True, self._metric,
                        measured.known, self._common(self._variance, self._metric))
        return self._onward(relative, length, addition)

    def _onward(self, relative: RelativePose, length: Length, addition: Addition,
                as_measured: bool = False) -> Step:
        """
        Give a step that goes on as the window has it.

        as_measured: whether its length is right as it is, and the window's is not asked; nor is it
        where landmarks do not tell any.
        """
        onward = addition.onward.copy()
        if as_measured or not relative.t.any():
            onward[:3, 3] = -addition.length * relative.R.T @ relative.t
        self._window.tell(onward)
        onward[:3, 3] *= length.value / addition.length
        return Step(relative, length, onward)

    def bridge(self, span_ns: tuple[int, int], current: View, relative: RelativePose,
               told: Array) -> None:
        """
        Go on at a frame whose motion is in doubt, from the newest frame of the track on.

        Where the best guess of it gives landmarks their depths, they are seen on: the track does
        not lose its scale, and steps to come make up for what was `told` (4, 4), a turn at most.
        Otherwise it begins anew.
        """
        seconds = (span_ns[1] - span_ns[0]) * 1e-9
        if self._speed is None or not relative.t.any() or not self.agrees(
                Pose(relative.R, relative.t), relative.x, relative.y_opt):
            self.begin(current)
        elif (addition := self._added(current, relative, self._speed * seconds)) is not None:
            self._wandered(addition, seconds, parallax=True)
            self._window.tell(told)

    def of_rest(self, span_ns: tuple[int, int]) -> Length:
        """Length that a step would have had where the camera stands, or the motion is unknown."""
        measured = self._source.between(*span_ns)
        if measured.known or not self._carried or self._speed is None:
            return measured
        usual = self._speed * (span_ns[1] - span_ns[0]) * 1e-9 * float(np.exp(self._log))
        return Length(usual, usual, True, self._metric, False)

    def landmarks(self, settled: bool = False) -> Array:
        """
        Places (M, 3) of landmarks in the camera of the newest step, in its lengths' unit.

        settled: of those that it was the last step to refine, instead of those in the window.
        """
        if self._speed is None or not self._carried:
            return np.empty((0, 3))
        places = self._window.settled if settled else self._window.landmarks()
        return places * float(np.exp(self._log))

    def agrees(self, pose: Pose, x: Array, y: Array) -> bool | None:
        """
        Tell whether a motion from the newest frame of the track gives landmarks their depths.

        x, y: (N, 2) matched pixels. A wrong motion gives others, as it explains two frames alone.
        False where so few landmarks agree as by chance in one of a thousand right motions; None
        where there are too few to tell.
        """
        if not self._carried or self._window.is_new:
            return None
        agree, asked = self._window.agreement(pose, x, y)
        if asked < _FEW:
            return None
        return bool(bdtr(agree, asked, _RIGHT) >= _BY_CHANCE)

    def sees_no_way(self, relative: RelativePose) -> bool:
        """Tell of a pair from the newest frame whether its parallax is noise, by all depths."""
        if not self._carried or self._window.is_new:
            return False
        told = self._window.told_length(relative)
        return told is not None and told[0] < _OUT_OF_NOISE * told[1]

    def _added(self, view: View, relative: RelativePose, guess: float) -> Addition | None:
        """Add a frame to the window; None where no length comes of it, and it begins anew."""
        if not self._window.is_new or relative.t.any():
            try:
                addition = self._window.add(view, relative, guess)
            except np.linalg.LinAlgError:
                # Matches do not hold together, or none of a turn is of a landmark.
                addition = None
            if self._lens is not None:
                self._lens = self._window.lens
            if addition is not None and np.isfinite(addition.sigma) and addition.length > 0:
                return addition
        self.begin(view)
        return None

    def _in_metres(self, measured: Length) -> Length:
        """Take a measured length as it is: no factor errs in it, but all such err alike."""
        return replace(measured, common=self._common(0.0, True)) if measured.known else measured

    def _common(self, variance: float, metric: bool) -> Common:
        """
        Tell what the errors of this step's length have in common with those of others.

        variance: of its factor's logarithm; metric: whether it is in metres.
        """
        self._was_metric = self._was_metric or metric
        share = self._share if self._was_metric else 0.0
        common = Common(np.array([variance, share**2]), self._kept)
        self._kept = np.ones(2)
        return common

    def _wandered(self, addition: Addition, seconds: float, parallax: bool) -> float:
        """
        Take note of what a step was, and give how sure its length is, as a share of it.

        A turn leaves the scale to landmarks that were seen before: it wanders by how unsure the
        camera's place is, over a usual step.
        """
        own, self._torn = min(addition.sigma / addition.length, 1.0), False
        usual = addition.length
        if parallax or self._speed is None:
            self._speed = addition.length / seconds
        else:
            usual = max(usual, self._speed * seconds)
        self._doubt((_WANDERING * min(addition.sigma / usual, 1.0))**2)
        return own

    def _doubt(self, variance: float) -> None:
        """Be less sure of the factor."""
        self._variance += variance
        self._metric = bool(self._metric and self._variance < _LOST**2)

    def _hear(self, measured: Length, length: float, own: float, seconds: float) -> None:
        """Learn the factor from a length in metres, where it tells any."""
        told = self._told(measured, length, own, seconds)
        if told is not None and self._source.exact:
            self._log, self._variance = told[0], 0.0
            self._metric, self._kept[0] = True, 0.0
        elif told is not None:
            self._observe(*told)

    def _told(self, measured: Length, length: float, own: float, seconds: float
              ) -> tuple[float, float, float] | None:
        """
        Give the logarithm of the factor, its variance, and the metres that tell it, if any do.

        What may be noise about zero says that the camera stands. Beyond _SURPRISE it is none, and
        the logarithm is that of a length with an error e of at most a quarter of it: what is
        left out of log(1 + e) = e - e^2 / 2 + ... is less than an eighth of e. The faster frames
        come, the shorter steps are. Those of a second tell together what each does not, where
        their errors are independent: n of them are n times as long, and sqrt(n) times as unsure.
        """
        # What all measurements have in common does not become surer by their number.
        variance = max(measured.sigma**2 - (self._share * measured.value)**2, 0.0)
        step = np.array([measured.value, variance, length, (own * length)**2, seconds])
        # One that tells by itself is not held against others.
        taken = step if _tells(step) else self._short + step
        told = _tells(taken)
        self._short = taken if not told and taken[4] < _TOGETHER else np.zeros(5)
        if not told:
            return None
        metres, variance, length, unsure, _ = taken.tolist()
        noise = max(variance / metres**2, _LEAST_NOISE**2) + unsure / length**2
        return float(np.log(metres / length)), noise, metres

    def _observe(self, observed: float, noise: float, metres: float) -> None:
        """Take an observation of the factor's logarithm over some metres, and its variance."""
        if not self._metric:
            self._log, self._variance, self._metric = observed, noise, True
            self._kept[0] = 0.0
            return
        off, alike = observed - self._log, self._source.alike
        if off**2 > _SURPRISE * (self._variance + noise):
            self._surprises += [1, metres]
            if (self._surprises < [_IN_A_ROW, _AS_LONG * alike]).any():
                return
            self._variance += off**2
        self._surprises = np.zeros(2)
        # Of an error that n of them have in common, they make as sure as one: each by an n-th.
        noise *= max(alike / metres, 1.0)
        gain = self._variance / (self._variance + noise)
        self._log += gain * off
        self._variance *= 1 - gain
        self._kept[0] *= 1 - gain


def _tells(lengths: Array) -> bool:
    """Tell whether a length (metres, variance, ...) is no noise about zero."""
    return bool(lengths[0]**2 > _SURPRISE * lengths[1])


def _as_landmarks_tell(relative: RelativePose, addition: Addition, usual: float
                       ) -> tuple[RelativePose, Addition]:
    """
    Give a pair without parallax the motion of the window, where that is surer than none.

    usual: length of a step, which is how unsure no translation would be. A window that tells less
    has its newest frame anywhere: the pair stays, and may have gone as far as usual. Its status
    stays in any case, which is that of the two images.
    """
    if np.linalg.eigvalsh(addition.covariance[3:, 3:])[-1] > usual**2:
        return relative, replace(addition, length=usual, sigma=usual)
    to_unit = np.diag(np.repeat([1.0, 1 / addition.length], 3))
    to_unit[3:, 3:] -= np.outer(addition.t, addition.t) / addition.length**3
    t, covariance = addition.t / addition.length, to_unit @ addition.covariance @ to_unit
    basis = lift(sphere_tangents(t))
    return replace(relative, R=addition.R, t=t, covariance_5=basis.T @ covariance @ basis,
                   covariance_6=covariance), addition
