"""From frames to a trajectory: the whole odometry on one screen."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from djet_ros.config.sections import OdometryConfig
from djet_ros.core.covariance import UNKNOWN
from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.fusion import agrees, fused, Turn
from djet_ros.core.self_calibration import SelfCalibration
from djet_ros.core.starts import Known
from djet_ros.core.types import (
    Array,
    of_one_camera,
    Pose,
    RelativePose,
    Status,
    TRACKED,
    UNDECIDED,
    View,
)
from djet_ros.core.verdict import as_turn
from djet_ros.odometry.frame import continuity, Frame
from djet_ros.odometry.guess import as_start, Guess
from djet_ros.odometry.inertial import Gyro
from djet_ros.odometry.scale import Common, Length, Scale, scale_source, ScaleSource
from djet_ros.odometry.standstill import Standstill
from djet_ros.odometry.structure import OneScale, Step
from djet_ros.odometry.uncertainty import (
    motion_covariance,
    PathCovariance,
    standstill_covariance,
    UNKNOWN_MOTION,
)
import numpy as np

# Radians by which a camera that stands still turns from frame to frame.
_STILL_TO_WITHIN = 2e-4

# chosen: share of the image's larger side by which the median match may have moved from a
# reference that waits for parallax; nearly all that it saw is in sight then.
_IN_SIGHT = 0.05

# Nanoseconds; chosen: what creeps for longer before it is seen to move counts as having stood.
_CREEPING_NS = 2_000_000_000

# Nanoseconds; chosen: a lorry that drives past at a walk has left the image by then, and for so
# long a camera that begins to move can do without its gyro feeling it.
_NOT_FELT_NS = 3_000_000_000


@dataclass(frozen=True)
class OdometryResult:
    """
    What became of a frame.

    stamp_ns, frame_id: of the frame; status; previous_stamp_ns: of the reference frame that it
    was related to, None where it restarted; relative: the estimator's answer for that pair;
    motion: (4, 4) the current camera in the reference camera; pose: (4, 4) the current camera in
    the first camera (where the motion could not be estimated the last known one, turned as far
    as a gyro tells, or a pair that is AMBIGUOUS);
    motion_covariance, pose_covariance: (6, 6) in ROS order; scale: length that a unit translation
    was given; scale_known: whether that means anything, in metres if `metric` and otherwise in the
    one unit of the track; measured: whether its source measured it, and not landmarks alone;
    stationary: whether the camera stood still.

    since_ns: stamp of the newest frame that was where the reference frame is, which is later
    where the camera stood still and did not creep: the motion came about after it;
    since_covariance: (6, 6) how sure it is that this frame was there.

    keyframe: whether the frame is a keyframe of the window that carries the scale; None where
    there is no window, or the motion to the frame is not known.

    k1: radial distortion that landmarks had shown by then, without which the images were seen.

    common: of the length, what of its error other steps have too. It is in pose_covariance, from
    the first frame on: also by how much a relative scale may have wandered since.
    """

    stamp_ns: int
    frame_id: str
    status: Status
    previous_stamp_ns: int | None
    relative: RelativePose | None
    motion: Array
    pose: Array
    motion_covariance: Array
    pose_covariance: Array
    scale: float
    scale_known: bool
    stationary: bool = False
    since_ns: int | None = None
    since_covariance: Array = field(default_factory=lambda: np.zeros((6, 6)))
    metric: bool = True
    measured: bool = True
    common: Common | None = None
    keyframe: bool | None = None
    k1: float = 0.0

    @property
    def scale_kind(self) -> Scale:
        """Tell what the length of the translation is in."""
        return Length(self.scale, 0.0, self.scale_known, self.metric).scale


class VisualOdometry:
    """
    Relates each frame to a reference frame and integrates the motions.

    The reference frame is the newest frame that was tracked, by three rules:
    * a bad pair keeps it, so that one bad frame is bridged by the next good one; after max_lost
      bad pairs in a row each newest frame becomes the reference, until one pair is good again.
      The motion in between is missing then, and the pose's covariance says so. A pair that two
      motions explain does not keep it, for its images are good;
    * while the camera stands still it stays, so that noise does not add up; where nothing tells
      the way yet, as neither the pair has parallax nor landmarks are there, it stays as long as
      most of it is in sight, so that a slow way adds up to one that can be told;
    * a gap of more than max_gap, another image size or another camera begin a new reference at
      the last pose; a step back in time restarts everything.
    """

    def __init__(self, estimator: EstimatorConfig | None = None,
                 odometry: OdometryConfig | None = None,
                 scale: ScaleSource | None = None, gyro: Gyro | None = None,
                 guess: Guess | None = None) -> None:
        odometry = odometry or OdometryConfig()
        self._one_scale = OneScale()
        self._last: Frame | None = None
        self._turned: tuple[int, Array, Array] = 0, np.eye(3), np.zeros((3, 3))
        self.configure(estimator or EstimatorConfig(), odometry, scale or scale_source(odometry))
        self.listen_to(gyro, guess)
        self._begin()

    def listen_to(self, gyro: Gyro | None, guess: Guess | None) -> None:
        """Go by what a gyro and another odometry tell, from the next frame on."""
        self._gyro, self._guess = gyro, guess

    def configure(self, estimator: EstimatorConfig, odometry: OdometryConfig,
                  scale: ScaleSource) -> None:
        """Take other parameters from the next frame on; the trajectory goes on."""
        another = self._last is not None and estimator != self._estimator.config
        self._config = odometry
        self._estimator: TwoViewEstimator = TwoViewEstimator(
            estimator, 0.0 if self._last is None else self._estimator.k1)
        if another:  # it sees other features, and by other tests
            self._view = self._reference.view(self._estimator)
        self._scale = scale
        anew = self._one_scale.configure(estimator, scale, odometry.scale_uncertainty)
        if anew and self._last is not None:
            self._one_scale.begin(self._view)

    def landmarks(self, settled: bool = False) -> Array:
        """
        Places (M, 3) of the landmarks that carry the scale, in the newest tracked camera.

        settled: of those that are not refined any more from that frame on, instead.
        """
        return self._one_scale.landmarks(settled)

    @property
    def lens(self) -> SelfCalibration | None:
        """Tell what landmarks have shown of the lens; None before that is certain."""
        return self._one_scale.lens

    def reset(self) -> None:
        """Forget everything, of the scale's source too; the next frame is the first."""
        self._scale.reset()
        self._begin()

    def another_lens(self) -> None:
        """Hear that images will have another distortion left, from the next frame on."""
        if self._last is not None and self._forget_lens():
            self._see_anew()
            self._one_scale.begin(self._view)

    def _forget_lens(self) -> bool:
        """Take images as they come; tells whether they were taken otherwise."""
        self._one_scale.forget_lens()
        straightened = self._estimator.k1 != 0
        if straightened:
            self._estimator = TwoViewEstimator(self._estimator.config)
        return straightened

    def _begin(self) -> None:
        self._last = None
        self._one_scale.reset()
        self._forget_lens()
        self._prior: RelativePose | None = None
        self._bad_pairs = self._since_ns = self._known_ns = 0
        self._standstill = Standstill()
        self._pose, self._path = np.eye(4), PathCovariance()

    @property
    def estimator(self) -> TwoViewEstimator:
        """Give what prepares the views of frames; another one with other parameters."""
        return self._estimator

    def process(self, frame: Frame, view: View | None = None) -> OdometryResult:
        """
        Take the next frame; ValueError where its stamp is that of the last one.

        view: of the frame as `estimator` prepares it, where that was done before.
        """
        # Can this frame be related to the past at all?
        last = self._last
        if last and frame.stamp_ns == last.stamp_ns:
            raise ValueError(f'two frames in a row have the stamp {frame.stamp_ns} ns')
        self._last = frame
        status = (continuity(last, frame, self._config.max_gap) if last else Status.FIRST_FRAME)
        backwards = bool(last and frame.stamp_ns < last.stamp_ns)
        # A gap may hide that it is of another camera.
        another = last is not None and not of_one_camera(last, frame)
        if (backwards or another) and self._forget_lens():
            view = None
        # Features are found once: now for the current frame, next time for the reference.
        if view is None:
            view = frame.view(self._estimator)
        if status is not Status.OK:
            return self._start(frame, view, status, backwards)

        # The pair: the motion before it, and what others know, are some of its starting poses.
        known = self._known(frame)
        relative = self._estimator.estimate(self._view, view, self._prior, known)
        # While the camera stood there was no way, whatever a wheel's noise may add up to.
        span = self._since_ns, frame.stamp_ns
        self._scale.observe(*span, self._view, view, relative)
        if self._stands_still(frame, relative):
            return self._stay(frame, relative, self._one_scale.of_rest(span))
        self._try_gyro(view, relative, known)
        relative = self._weighed(frame, self._by_depths(relative), known.turn)
        relative = self._doubted_at_rest(frame, relative)
        if relative.status not in TRACKED:
            return self._lose(frame, view, relative, self._one_scale.of_rest(span))

        # Its length in the one scale of the track, by what frames share or by what measures it.
        waits = self._waits(relative)
        step = (Step(relative, self._one_scale.of_rest(span)) if waits
                else self._one_scale.of_step(span, view, relative))

        # Integrate the motion and its uncertainty; this frame is the next reference.
        motion = camera_motion(step.relative, step.length.value)
        pose, path = self._integrated(step, motion)
        keyframe = self._one_scale.keyframe
        result = self._result(frame, relative.status, relative, step.length, motion,
                              motion_covariance(step.relative, step.length), pose, path,
                              keyframe=None if keyframe is None else keyframe and not waits)
        if not waits:
            self._pose, self._path = pose, path
            self._refer_to(frame, view)
        self._known_ns = frame.stamp_ns
        self._prior, self._bad_pairs = relative, 0
        self._standstill.moved()
        if (k1 := self._one_scale.k1_due) is not None:
            self._straighten(k1)
        return result

    def _see_anew(self) -> None:
        """See the reference frame as the estimator has images by now."""
        self._view = self._reference.view(self._estimator)
        self._forget_matches()

    def _forget_matches(self) -> None:
        """Keep of the motion before that the camera may go on like this, but not what it saw."""
        if self._prior is not None:
            self._prior = RelativePose(Status.OK, self._prior.R, self._prior.t)

    def _straighten(self, k1: float) -> None:
        """
        See images without a distortion that landmarks have shown, from the newest one on.

        Pairs, and the ground of ``camera_height``, go by the images, and what is left is for the
        window to find.
        """
        self._estimator = TwoViewEstimator(self._estimator.config, k1)
        self._see_anew()
        self._one_scale.straighten(self._view)

    def _integrated(self, step: Step, motion: Array) -> tuple[Array, PathCovariance]:
        """Go on by a step: as landmarks have it that outlast pairs, or by the pair alone."""
        covariance, common = motion_covariance(step.relative, step.length.own), step.length.common
        if step.onward is not None:
            # What neighbouring pairs err alike, landmarks that both of them see put right.
            return self._pose @ step.onward, self._path.moved(
                self._pose, step.onward, covariance, common)
        return self._pose @ motion, self._path.moved_by_pair(
            self._pose, motion, covariance, common)

    def _waits(self, relative: RelativePose) -> bool:
        """Tell whether the reference stays until a pair with it tells the way."""
        if relative.status is not Status.NO_PARALLAX or not self._one_scale.is_new:
            return False
        moved = np.linalg.norm(relative.y - relative.x, axis=1)
        return bool(np.median(moved) < _IN_SIGHT * max(self._view.gray.shape))

    def _by_depths(self, relative: RelativePose) -> RelativePose:
        """Let depths that other frames have told decide between a motion and its rivals."""
        if relative.status not in (Status.OK, Status.AMBIGUOUS):
            return relative
        agrees = self._one_scale.agrees(Pose(relative.R, relative.t), relative.x, relative.y_opt)
        if relative.status is Status.OK:
            if agrees is False:
                return _refuted(relative)
            no_way = self._one_scale.sees_no_way(relative)
            return as_turn(relative, self._view.K) if no_way else relative
        if agrees and all(
                self._one_scale.agrees(rival, relative.x, relative.y) is False
                for rival in relative.rivals):
            return replace(relative, status=Status.OK)
        return relative

    def _known(self, frame: Frame) -> Known:
        """Collect what others than the images tell of the way to a frame."""
        # Where the camera stood still, it came about after that.
        motion = self._guess.motion(self._since_ns, frame.stamp_ns) if self._guess else None
        trusted = self._gyro is not None and self._gyro.fits
        return Known(self._turn(frame) if trusted else None,
                     None if motion is None else as_start(motion))

    def _turn(self, frame: Frame) -> Turn | None:
        return self._gyro.turn(self._since_ns, frame.stamp_ns) if self._gyro else None

    def _weighed(self, frame: Frame, relative: RelativePose, turn: Turn | None) -> RelativePose:
        """Weigh the gyro into a pair, and learn its bias; refuse a pair that turned otherwise."""
        if self._gyro is None or relative.status not in TRACKED:
            return relative
        told = turn or self._turn(frame)
        if told is None:
            return relative
        agreed = agrees(told, relative)
        self._gyro.judge(agreed)
        # What bridges bad pairs may be the motion of what made them bad.
        if agreed and not self._bad_pairs:
            self._learn(self._gyro, frame, relative.R, relative.covariance_6[:3, :3])
        if turn is None:
            return relative
        # What turned otherwise was not the camera, but something that fills the image.
        return fused(relative, turn) if agreed else replace(
            relative, status=Status.DEGENERATE, t=np.zeros(3))

    def _try_gyro(self, view: View, relative: RelativePose, known: Known) -> None:
        """
        Judge a gyro that has never fitted by the images alone, where none were matched by it.

        Rates in degrees, or those of another robot, lead all matches astray.
        """
        if (self._gyro is None or known.turn is None or self._gyro.ever_fitted
                or relative.status in TRACKED):
            return
        alone = self._estimator.estimate(self._view, view, self._prior, replace(known, turn=None))
        if alone.status in TRACKED:
            self._gyro.judge(agrees(known.turn, alone))

    def _learn(self, gyro: Gyro, frame: Frame, R: Array, covariance: Array) -> None:
        """Learn the bias from how a frame has turned, since another of the same reference."""
        stamp_ns, before, unsure = self._turned
        turn = R @ before.T
        gyro.learn(stamp_ns, frame.stamp_ns, turn, covariance + turn @ unsure @ turn.T)
        self._turned = frame.stamp_ns, R, covariance

    def _doubted_at_rest(self, frame: Frame, relative: RelativePose) -> RelativePose:
        """
        Doubt that a camera has begun to move whose gyro feels nothing.

        It stood, and something that fills the image moves. Whatever drives, flies or is held
        turns a little as it starts; on a rail it may not, and is believed in the end.
        """
        if (relative.status is Status.OK and self._gyro is not None
                and frame.stamp_ns - self._known_ns < _NOT_FELT_NS
                and self._standstill.may_stand(relative, self._config.standstill)
                and self._at_rest(frame)):
            return _refuted(relative)
        return relative

    def _stands_still(self, frame: Frame, relative: RelativePose) -> bool:
        return self._standstill.told(relative, self._config.standstill, self._at_rest(frame))

    def _at_rest(self, frame: Frame) -> bool:
        """Whether a gyro felt nothing since it was last known what the camera does."""
        return self._gyro is not None and self._gyro.at_rest(
            max(self._since_ns, self._known_ns), frame.stamp_ns)

    def _start(self, frame: Frame, view: View, status: Status,
               backwards: bool) -> OdometryResult:
        """Begin a new reference: from nothing, or at the last pose with its motion unknown."""
        if backwards:
            self._scale.go_back(frame.stamp_ns)
            self._begin()
            self._last = frame
        elif status is not Status.FIRST_FRAME:
            motion, covariance = self._carried(frame, (np.eye(4), UNKNOWN_MOTION))
            self._path = self._path.moved(self._pose, motion, covariance)
            self._pose = self._pose @ motion
        if backwards or status is Status.FIRST_FRAME:
            self._known_ns = frame.stamp_ns
        self._refer_to(frame, view)
        self._one_scale.begin(view)
        self._prior, self._bad_pairs = None, 0
        return OdometryResult(
            frame.stamp_ns, frame.frame_id, status, None, None, np.eye(4), self._pose,
            UNKNOWN_MOTION, self._path.pose, 0.0, False, keyframe=self._one_scale.keyframe,
            k1=self._estimator.k1)

    def _carried(self, frame: Frame, guess: tuple[Array, Array]) -> tuple[Array, Array]:
        """Motion (4, 4) and covariance (6, 6) by the gyro's turn, or else a guess of both."""
        turn = self._turn(frame)
        if self._gyro is None or turn is None or not self._gyro.bears_alone:
            return guess
        motion, covariance = np.eye(4), UNKNOWN_MOTION.copy()
        motion[:3, :3] = turn.R.T
        # An error of the bias is the same all along: n steps err n times as much as one.
        before = max(self._since_ns - self._known_ns, 0) / (frame.stamp_ns - self._since_ns)
        covariance[3:, 3:] = (1 + 2 * before) * turn.R.T @ turn.covariance @ turn.R
        return motion, covariance

    def _stay(self, frame: Frame, relative: RelativePose, length: Length) -> OdometryResult:
        """Stand still: no motion, and the reference frame stays."""
        self._bad_pairs = 0
        self._standstill.stay(relative, self._config.standstill)
        covariance = standstill_covariance(relative, length)
        # The reference frame may be a keyframe, and serves both.
        keyframe = None if self._one_scale.keyframe is None else False
        result = self._result(frame, Status.NO_PARALLAX, relative, length, np.eye(4), covariance,
                              self._pose, self._path.moved(self._pose, np.eye(4), covariance),
                              stationary=True, keyframe=keyframe)
        # What it has crept by now is part of the motion that will be told one day.
        crept = self._standstill.crept(relative, self._config.standstill)
        if self._gyro is not None and not crept:
            self._learn(self._gyro, frame, np.eye(3), np.eye(3) * _STILL_TO_WITHIN**2)
            self._turned = _not_turned(frame)
        if not crept or frame.stamp_ns - self._since_ns > _CREEPING_NS:
            self._since_ns, self._since_covariance = frame.stamp_ns, result.motion_covariance
        self._known_ns = frame.stamp_ns
        self._forget()
        return result

    def _lose(self, frame: Frame, view: View, relative: RelativePose,
              length: Length) -> OdometryResult:
        """Take a bad pair: hold the pose, and give up the reference after too many of them."""
        self._bad_pairs += 1
        given_up = self._bad_pairs >= self._config.max_lost
        motion, covariance = self._carried(frame, _turn_at_most(relative, length))
        path = self._path.moved(self._pose, motion, covariance)
        result = self._result(frame, relative.status, relative, length, motion, covariance,
                              self._pose @ motion, path)
        if given_up or relative.status in UNDECIDED:
            if given_up:
                self._one_scale.begin(view)
            else:
                self._one_scale.bridge((self._since_ns, frame.stamp_ns), view, relative, motion)
            self._refer_to(frame, view)
            self._pose, self._path = result.pose, path
            # Its matches are with an older image.
            self._forget_matches()
        if given_up:
            self._prior = None
        return result

    def _refer_to(self, frame: Frame, view: View) -> None:
        self._reference, self._view = frame, view
        self._since_ns = frame.stamp_ns
        self._since_covariance = np.zeros((6, 6))
        self._turned = _not_turned(frame)
        self._standstill.refer()
        self._forget()

    def _forget(self) -> None:
        """Let go of what others measured before the newest frame that a pair may begin at."""
        for one in (self._gyro, self._guess):
            if one is not None:
                one.forget_before(self._since_ns)

    def _result(self, frame: Frame, status: Status, relative: RelativePose, length: Length,
                motion: Array, covariance: Array, pose: Array, path: PathCovariance,
                stationary: bool = False, keyframe: bool | None = None) -> OdometryResult:
        return OdometryResult(
            frame.stamp_ns, frame.frame_id, status, self._reference.stamp_ns, relative, motion,
            pose, covariance, path.pose, length.value, length.known, stationary,
            self._since_ns, self._since_covariance, length.metric, length.measured, length.common,
            keyframe, self._estimator.k1)


def _turn_at_most(relative: RelativePose, length: Length) -> tuple[Array, Array]:
    """
    Motion (4, 4) and covariance (6, 6) of a bad pair.

    One whose direction is in doubt tells a turn: its covariance spans those of all motions that it
    may be.
    """
    if relative.status is not Status.AMBIGUOUS:
        return np.eye(4), UNKNOWN_MOTION
    turned = replace(relative, t=np.zeros(3))
    return camera_motion(turned), motion_covariance(turned, length)


def _refuted(relative: RelativePose) -> RelativePose:
    """Give a pair that something else than its images speaks against: nobody knows how sure."""
    return replace(relative, status=Status.AMBIGUOUS, covariance_5=UNKNOWN[0],
                   covariance_6=UNKNOWN[1])


def _not_turned(frame: Frame) -> tuple[int, Array, Array]:
    """Stamp, rotation (3, 3) from the reference and its covariance (3, 3) of one like it."""
    return frame.stamp_ns, np.eye(3), np.zeros((3, 3))


def camera_motion(relative: RelativePose, length: float = 1.0) -> Array:
    """Pose (4, 4) of the current camera in the previous one, (R^T, -s R^T t), s the length."""
    motion = np.eye(4)
    motion[:3, :3] = relative.R.T
    motion[:3, 3] = -length * relative.R.T @ relative.t
    return motion
