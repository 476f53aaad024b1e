"""Frame-to-frame visual odometry: from frames to a trajectory."""

from __future__ import annotations

from dataclasses import replace

from djet_ros.config.sections import OdometryConfig
from djet_ros.core.correction import AS_CALIBRATED, Correction
from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.geometry import norms
from djet_ros.core.rivals import unsigned_distance
from djet_ros.core.self_calibration import SelfCalibration
from djet_ros.core.starts import KnownMotion
from djet_ros.core.three_views import consistent_motion
from djet_ros.core.types import (
    Array,
    of_same_camera,
    Pose,
    RelativePose,
    Status,
    TRACKED,
    UNDECIDED,
    View,
)
from djet_ros.core.verdict import as_decided, as_undecided
from djet_ros.odometry.displacement import turns
from djet_ros.odometry.frame import continuity, Frame, Reference
from djet_ros.odometry.guess import Guess
from djet_ros.odometry.inertial import Gyro
from djet_ros.odometry.priors import MotionPriors, Span
from djet_ros.odometry.result import camera_motion, OdometryResult
from djet_ros.odometry.scale import Length, scale_source, ScaleSource
from djet_ros.odometry.standstill import Standstill
from djet_ros.odometry.structure import TrackScale
from djet_ros.odometry.takeover import PASSING_NS, Takeover
from djet_ros.odometry.trajectory import Trajectory
from djet_ros.odometry.uncertainty import (
    motion_covariance,
    standstill_covariance,
    UNKNOWN_MOTION,
)
import numpy as np

# chosen: share of the image's larger side. A reference is kept for a longer step up to this median
# displacement of the matches; nearly all of its image is still in view then.
_IN_VIEW = 0.05

# Nanoseconds; chosen: a camera that creeps for longer is taken to have stood still until now.
_LONGEST_CREEP_NS = 2_000_000_000

# Nanoseconds; chosen: for so long a reference is kept for a longer step of a track. A camera that
# stops after a short one would not be seen to stand.
_LONGEST_WAIT_NS = 2_000_000_000


class VisualOdometry:
    """
    Estimates each frame's motion from a reference frame, and integrates the motions.

    estimator, odometry: parameters, the defaults if None. Of the latter, max_gap, max_lost,
    standstill, scale and what that needs have an effect here; the others concern messages
    (`odometry.tracker`). scale: source of lengths in place of the one by the parameters, such as a
    `SpeedScale`, which speeds are added to; gyro, guess: sources of rotations and of motions.

    The reference frame is the newest tracked frame, with four exceptions:
    * A bad pair keeps it, so that the next good pair bridges single bad frames. After max_lost bad
      pairs in a row each frame becomes the reference until a pair is good; the missing motion is
      in the pose's covariance. A pair with two possible motions (UNDECIDED) does not keep it, as
      its images are good.
    * A standstill keeps it, so that noise does not accumulate; so do pairs in which something that
      moves may hide what stood still.
    * While most of its image is in view, slow motion keeps it and accumulates: without parallax,
      if new landmarks are needed, until its direction can be estimated; with two motions that the
      pair before may tell apart, until it does.
    * A gap of more than max_gap, another image size or another camera starts a new reference at
      the last pose. A step back in time resets everything.
    """

    _reference: Reference  # set by the first frame

    def __init__(self, estimator: EstimatorConfig | None = None,
                 odometry: OdometryConfig | None = None,
                 scale: ScaleSource | None = None, gyro: Gyro | None = None,
                 guess: Guess | None = None) -> None:
        odometry = odometry or OdometryConfig()
        self._last: Frame | None = None
        self._scale, self._priors = TrackScale(), MotionPriors()
        self.configure(estimator or EstimatorConfig(), odometry, scale or scale_source(odometry))
        self.set_priors(gyro, guess)
        self._clear()

    def configure(self, estimator: EstimatorConfig, odometry: OdometryConfig,
                  scale: ScaleSource) -> None:
        """Change the parameters from the next frame on; the trajectory continues."""
        started = self._last is not None
        other_features = started and estimator != self._estimator.config
        self._config, self._scale_source = odometry, scale
        self._estimator: TwoViewEstimator = TwoViewEstimator(
            estimator, self._estimator.correction if started else AS_CALIBRATED)
        if other_features:
            self._reference = self._reference.seen_by(self._estimator)
        restart = self._scale.configure(estimator, scale, odometry.scale_uncertainty)
        if restart and started:
            self._scale.begin(self._reference.view)

    def set_priors(self, gyro: Gyro | None, guess: Guess | None) -> None:
        """Use a gyro and another odometry from the next frame on."""
        self._priors.gyro, self._priors.guess = gyro, guess

    def recalibrated(self) -> None:
        """Forget what was wrong with the calibration, as the next images have another one."""
        self._forget_correction()
        if self._last is not None:
            self._renew_reference_view()
            self._scale.begin(self._reference.view)

    def reset(self) -> None:
        """Forget everything, the scale source's measurements too; the next frame is the first."""
        self._scale_source.reset()
        self._clear()

    def _clear(self) -> None:
        self._last = None
        self._scale.reset()
        self._forget_correction()
        self._last_pair: RelativePose | None = None
        self._bad_pairs = self._priors.known_ns = 0
        # Whether the last frame moved, and its reference was kept.
        self._waited = False
        self._standstill, self._trajectory = Standstill(), Trajectory()
        self._takeover = Takeover(self._standstill)

    @property
    def estimator(self) -> TwoViewEstimator:
        """Return the estimator that prepares views; another object after its parameters change."""
        return self._estimator

    @property
    def calibration(self) -> SelfCalibration | None:
        """Return what landmarks have shown to be wrong with it; None until it is significant."""
        return self._scale.calibration

    @property
    def newest_is_reference(self) -> bool:
        """Return whether the newest frame is the reference frame, so that landmarks are new."""
        return self._last is not None and self._reference.frame is self._last

    @property
    def reference_pose(self) -> Array:
        """Return the pose (4, 4) of the reference frame's camera in the first camera."""
        return self._trajectory.pose

    def landmarks(self, settled: bool = False) -> Array:
        """
        Return points (M, 3), the landmarks of the scale in the reference frame's camera.

        settled: instead return those that the newest frame was the last to refine.
        """
        if settled and not self.newest_is_reference:
            return np.empty((0, 3))
        return self._scale.landmarks(settled)

    def process(self, frame: Frame, view: View | None = None) -> OdometryResult:
        """
        Process the next frame; raises ValueError if its stamp is that of the last one.

        view: of the frame, if ``estimator`` has already prepared it.
        """
        # Check whether the frame can be related to the last one.
        last = self._last
        if last and frame.stamp_ns == last.stamp_ns:
            raise ValueError(f'two frames in a row have the stamp {frame.stamp_ns} ns')
        self._last = frame
        status = continuity(last, frame, self._config.max_gap) if last else Status.FIRST_FRAME
        backwards = bool(last and frame.stamp_ns < last.stamp_ns)
        # After a gap it may also be of another camera.
        other_camera = last is not None and not of_same_camera(last, frame)
        if (backwards or other_camera) and self._forget_correction():
            view = None
        # Detect its features, for this pair and for those whose reference it will be.
        if view is None:
            view = frame.view(self._estimator)
        if status is not Status.OK:
            return self._started(frame, view, status, backwards, other_camera)
        # Estimate the relative pose; first as if the camera stood still, if it may have until now.
        reference = self._reference
        span = reference.since_ns, frame.stamp_ns
        priors, at_rest = self._priors.of(span), self._priors.at_rest(span)
        standing = self._standing(view, priors, at_rest)
        if standing is not None and self._stands(standing, at_rest):
            pair, stands = standing, True
        else:
            pair = self._estimated(view, priors)
            stands = self._stands(pair, at_rest)
        # Back at a reference that was kept the camera does not stand: it swings, or has just
        # stopped.
        returned, self._waited = stands and self._waited, False
        if stands and not returned:
            self._scale_source.observe(*span, reference.view, view, pair)
            return self._stationary(frame, pair, span)
        # Verify the pair by the landmarks' depths and the gyro, and fuse the gyro's rotation.
        pair = self._takeover.judged(reference.pair, self._verified(view, pair, priors, span),
                                     frame.stamp_ns)
        may_stand = self._may_stand(standing or pair, span, at_rest)
        if may_stand and pair.status is Status.OK and not self._has_turned(pair, at_rest):
            pair = as_undecided(pair)
        if pair.status not in TRACKED:
            return self._lost(frame, view, pair, span, may_stand and self._standstill.stood)
        # The gyro and the metric source learn from it. What bridges bad pairs may be the motion of
        # what made them bad: it calibrates no gyro.
        if not self._bad_pairs:
            self._priors.learn(frame.stamp_ns)
        self._scale_source.observe(*span, reference.view, view, pair)
        # Estimate the length of its translation, and integrate it.
        self._waited = not returned and self._waits_for_parallax(pair, span)
        return self._tracked(frame, view, pair, span)

    def _standing(self, view: View, priors: KnownMotion, at_rest: bool | None
                  ) -> RelativePose | None:
        """Return the pair of a camera that stands still; None if it moved before or turned."""
        if not self._standstill.may_stand or at_rest is False:
            return None
        return self._estimator.estimate(self._reference.view, view, self._standstill.prior,
                                        replace(priors, stood=True))

    def _estimated(self, view: View, priors: KnownMotion) -> RelativePose:
        """Return the pair; the last motion and the priors are among the initial poses."""
        pair = self._estimator.estimate(self._reference.view, view, self._last_pair, priors)
        # If several motions are possible, the pair before may decide.
        if pair.rivals and pair.status in (Status.OK, Status.AMBIGUOUS):
            return self._decided(view, pair, priors)
        return pair

    def _stands(self, pair: RelativePose, at_rest: bool | None) -> bool:
        return self._standstill.detect(pair, self._reference.view.K, self._config.standstill,
                                       at_rest)

    def _decided(self, view: View, pair: RelativePose, priors: KnownMotion) -> RelativePose:
        """Return the pair with the motion that is consistent with the pair before it, if any."""
        reference = self._reference
        if reference.pair is None:
            return pair
        motion = consistent_motion(reference.pair, pair, view.K)
        if motion is None:
            return pair
        if np.array_equal(motion.R, pair.R) and np.array_equal(motion.t, pair.t):
            return as_decided(pair)
        again = self._estimator.estimate_near(reference.view, view, pair, motion, priors)
        # It may converge to the minimum that was found before.
        refined = Pose(again.R, again.t)
        closer = (unsigned_distance(refined, motion)
                  < unsigned_distance(refined, Pose(pair.R, pair.t)))
        return again if closer else pair

    def _verified(self, view: View, pair: RelativePose, priors: KnownMotion,
                  span: Span) -> RelativePose:
        """Return the pair fused with the gyro's rotation; other evidence may reject it."""
        # A gyro that has never agreed may be why the pair is bad: judge it by images alone.
        if priors.rotation is not None and self._priors.may_mislead(pair):
            alone = self._estimator.estimate(self._reference.view, view, self._last_pair,
                                             replace(priors, rotation=None))
            if alone.status in TRACKED:
                self._priors.judge(priors.rotation, alone)
        pair = self._scale.verified(pair, self._reference.view.K)
        return self._priors.fuse(pair, priors.rotation, span)

    def _may_stand(self, standing: RelativePose, span: Span, at_rest: bool | None) -> bool:
        """
        Return whether the camera may stand still while something that fills the image moves past.

        standing: the pair as of a camera that stands, with all matches that stay in place.
        """
        return (span[1] - self._priors.known_ns < PASSING_NS
                and self._standstill.is_likely(standing, self._reference.view.K,
                                               self._config.standstill, at_rest))

    def _has_turned(self, pair: RelativePose, at_rest: bool | None) -> bool:
        """
        Return whether the camera has turned, and so moved.

        Most cameras turn a little as they start; one on a rail may not, and is trusted after a
        while.
        """
        if at_rest is not None:
            return not at_rest
        return (turns(pair, self._reference.view.K, self._config.standstill)
                and not self._standstill.is_of_others(pair))

    def _started(self, frame: Frame, view: View, status: Status, backwards: bool,
                 other_camera: bool) -> OdometryResult:
        """Begin a new reference: at the origin, or at the last pose after an unknown motion."""
        if backwards:
            self._scale_source.go_back(frame.stamp_ns)
            self._clear()
            self._last = frame
        elif status is not Status.FIRST_FRAME:
            self._trajectory = self._trajectory.moved(*(self._priors.dead_reckoned(
                (self._reference.since_ns, frame.stamp_ns)) or _unknown_motion()))
        if backwards or status is Status.FIRST_FRAME:
            self._priors.known_ns = frame.stamp_ns
        self._refer_to(frame, view, None)
        self._scale.begin(view)
        self._standstill.interrupt(other_camera)
        self._takeover.forget()
        self._last_pair, self._bad_pairs = None, 0
        return OdometryResult.without_pair(
            frame, status, self._trajectory.pose, self._trajectory.path.pose,
            self._scale.keyframe, self._estimator.correction)

    def _stationary(self, frame: Frame, pair: RelativePose, span: Span) -> OdometryResult:
        """Keep the pose and the reference."""
        length = self._scale.expected_length(span)
        covariance = standstill_covariance(
            pair, length, self._scale.length_of_displacement(self._config.standstill))
        result = replace(
            self._result(frame, pair, length, np.eye(4), covariance,
                         self._trajectory.stayed(covariance), keyframe=False),
            status=Status.NO_PARALLAX, stationary=True)
        self._standstill.stay(pair, self._config.standstill)
        self._takeover.stay()
        # What the camera has crept is part of a motion that will be estimated later.
        creeps = self._standstill.creeps(pair, self._config.standstill)
        if not creeps:
            self._priors.learn_at_rest(frame.stamp_ns)
        if not creeps or span[1] - span[0] > _LONGEST_CREEP_NS:
            self._reference = replace(self._reference, since_ns=frame.stamp_ns,
                                      since_covariance=covariance)
        self._bad_pairs, self._priors.known_ns = 0, frame.stamp_ns
        self._priors.forget_before(self._reference.since_ns)
        return result

    def _lost(self, frame: Frame, view: View, pair: RelativePose, span: Span,
              may_stand: bool) -> OdometryResult:
        """
        Hold the pose, and give up the reference after too many bad pairs.

        may_stand: whether something that moves may hide what would stand still.
        """
        waits = may_stand or self._waits_for_decision(pair, span)
        self._bad_pairs += not waits
        given_up = not waits and self._bad_pairs >= self._config.max_lost
        length = self._scale.expected_length(span)
        motion, covariance = self._priors.dead_reckoned(span) or (
            _unknown_motion() if may_stand else _rotation_at_most(pair, length))
        trajectory = self._trajectory.moved(motion, covariance)
        result = self._result(frame, pair, length, motion, covariance, trajectory)
        if given_up or (pair.status in UNDECIDED and not waits):
            if given_up:
                self._scale.begin(view)
            else:
                self._scale.bridge(span, view, pair, motion)
            self._trajectory = trajectory
            self._refer_to(frame, view, pair)
            self._last_pair = None if given_up else _motion_alone(self._last_pair)
        return result

    def _tracked(self, frame: Frame, view: View, pair: RelativePose,
                 span: Span) -> OdometryResult:
        """Integrate the motion; the frame is the next reference unless that waits for parallax."""
        step = (self._scale.preview(span, view, pair) if self._waited
                else self._scale.of_step(span, view, pair))
        trajectory = self._trajectory.moved_by_step(step)
        result = self._result(
            frame, pair, step.length, camera_motion(step.relative, step.length.value),
            motion_covariance(step.relative, step.length), trajectory,
            keyframe=not self._waited and self._scale.keyframe)
        if not self._waited:
            self._trajectory = trajectory
            self._refer_to(frame, view, pair)
        self._last_pair, self._bad_pairs, self._priors.known_ns = pair, 0, frame.stamp_ns
        self._standstill.take(pair, view.K, self._config.standstill)
        self._takeover.take(pair, frame.stamp_ns)
        if (correction := self._scale.correction_due) is not None:
            self._correct(correction)
        return result

    def _waits_for_parallax(self, pair: RelativePose, span: Span) -> bool:
        """Return whether the reference is kept until the direction of motion is determined."""
        if pair.status is not Status.NO_PARALLAX or not self._scale.needs_parallax:
            return False
        return self._is_in_view(pair) and (self._scale.is_new or _is_short(span))

    def _waits_for_decision(self, pair: RelativePose, span: Span) -> bool:
        """
        Return whether the reference is kept until the pair before it decides between motions.

        The longer the step, the clearer the depths of both.
        """
        before = self._reference.pair
        return (pair.status is Status.AMBIGUOUS and before is not None and bool(before.t.any())
                and self._is_in_view(pair) and _is_short(span))

    def _is_in_view(self, pair: RelativePose) -> bool:
        """Return whether most of the reference image is in view."""
        displacements = norms(pair.y - pair.x)
        return bool(np.median(displacements) < _IN_VIEW * max(self._reference.view.gray.shape))

    def _refer_to(self, frame: Frame, view: View, pair: RelativePose | None) -> None:
        """Make a frame the reference; pair: the one that ends with it."""
        self._reference = Reference(frame, view, pair, frame.stamp_ns)
        self._priors.refer(frame.stamp_ns)
        self._priors.forget_before(frame.stamp_ns)
        self._standstill.refer()

    def _correct(self, correction: Correction) -> None:
        """
        Correct what landmarks have shown to be wrong, from the reference frame on.

        Pairs and the ground of ``camera_height`` are then without it; the window estimates what
        remains.
        """
        self._estimator = TwoViewEstimator(self._estimator.config, correction)
        self._renew_reference_view()
        self._scale.correct_images(self._reference.view)

    def _renew_reference_view(self) -> None:
        """Prepare the reference's view by the present estimator; its old matches are void."""
        self._reference = self._reference.seen_by(self._estimator)
        self._last_pair = _motion_alone(self._last_pair)

    def _forget_correction(self) -> bool:
        """Take the camera as calibrated; returns whether that is a change."""
        self._scale.forget_calibration()
        corrected = any(self._estimator.correction)
        if corrected:
            self._estimator = TwoViewEstimator(self._estimator.config)
        return corrected

    def _result(self, frame: Frame, pair: RelativePose, length: Length, motion: Array,
                covariance: Array, trajectory: Trajectory, keyframe: bool | None = None
                ) -> OdometryResult:
        return OdometryResult.of_pair(
            frame, self._reference, pair, length, motion, covariance, trajectory.pose,
            trajectory.path.pose, None if self._scale.keyframe is None else keyframe,
            self._estimator.correction)


def _is_short(span: Span) -> bool:
    """Return whether a camera that has hardly moved in a span may still be moving."""
    return span[1] - span[0] < _LONGEST_WAIT_NS


def _motion_alone(pair: RelativePose | None) -> RelativePose | None:
    """Return a pair without its matches: a motion that may continue."""
    return None if pair is None else RelativePose(
        Status.OK, pair.R, pair.t, rivals=pair.rivals)


def _rotation_at_most(pair: RelativePose, length: Length) -> tuple[Array, Array]:
    """
    Return the motion (4, 4) of a bad pair and its covariance (6, 6).

    For an AMBIGUOUS pair: its rotation, with a covariance that spans its hypotheses.
    """
    if pair.status is not Status.AMBIGUOUS:
        return _unknown_motion()
    rotation = replace(pair, t=np.zeros(3))
    return camera_motion(rotation), motion_covariance(rotation, length)


def _unknown_motion() -> tuple[Array, Array]:
    """Return no motion (4, 4), with the covariance (6, 6) of any."""
    return np.eye(4), UNKNOWN_MOTION
