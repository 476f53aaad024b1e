"""Offline replay: runs the odometry on a recording and writes a results folder."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import cv2
from djet_ros import __version__, compiled
from djet_ros.config.sections import Config
from djet_ros.core.types import Status
from djet_ros.errors import DjetError, one_line
from djet_ros.interrupts import interrupt_after
from djet_ros.odometry.diagnostics import Counts
from djet_ros.odometry.health import ONE_CAMERA_MATRIX
from djet_ros.odometry.messages import (
    frame_of,
    mounted_frame,
    pose_of,
    seconds_text,
    stamp_ns,
)
from djet_ros.odometry.result import OdometryResult
from djet_ros.odometry.scale import scale_source, ScaleSource
from djet_ros.odometry.static_frames import StaticFrames
from djet_ros.odometry.tracker import Outgoing, Tracker
from djet_ros.posegraph.recorded_frames import AUXILIARY_TIMEOUT_NS, MOST_WAITING
from djet_ros.posegraph.steps import Step
from djet_ros.recordings.bags import BagMessage
from djet_ros.recordings.datasets import LONGEST_GAP_NS
from djet_ros.recordings.decoding import message_type
from djet_ros.recordings.mask_files import static_mask
from djet_ros.recordings.recording import Recording
from djet_ros.replay.ground_truth import GroundTruth
from djet_ros.replay.lookahead import with_next_image
from djet_ros.replay.pair_errors import statistics
from djet_ros.replay.results import PLOT, ResultsFolder, UNFINISHED
from djet_ros.replay.step_log import StepLog
import numpy as np


class Outcome(NamedTuple):
    """
    The result of a run.

    summary: as written to summary.json; problem: error message in one line, or None; advice:
    warnings, one line each, on images and auxiliary inputs that could not be used.
    """

    summary: dict[str, Any]
    problem: str | None
    advice: tuple[str, ...] = ()


class Replay:
    """
    One run of the odometry on a recording, with all results written.

    name: path of the recording, for messages. Invalid input is refused in the constructor, before
    a folder is created. An error during the run does not raise: it ends the run, and is in the
    summary and the outcome.
    """

    def __init__(self, recording: Recording, config: Config, name: str,
                 draw: bool = False) -> None:
        """
        Prepare the run; DjetError if a parameter needs what the recording does not have.

        draw: whether to write a drawing of each pair.
        """
        self._recording = recording
        self._config = config
        self._name, self._draw = name, draw
        self._frames = _static_frames(recording) if config.odometry.base_frame else StaticFrames()
        self._tracker = Tracker(config, message_type, _scale(recording, config),
                                recording.image_topic,
                                static_mask=static_mask(config.odometry.mask_file))
        self._names = {topic: what for what, topic in recording.auxiliary.items()}
        # Images waiting for auxiliary inputs, which may be recorded later, and the CameraInfo
        # between them.
        self._waiting: deque[BagMessage] = deque()
        self._following: BagMessage | None = None
        self._truth = GroundTruth()
        # The frame that its newest message is the pose of, '' if it does not say.
        self._frame_of_truth = ''
        # Recording time of the first image and of the first CameraInfo, by topic.
        self._first_ns: dict[str, int] = {}
        self._log = StepLog()
        self._first_problem: str | None = None
        if not self._tracker.mounted and (frame := _frame_of_images(recording)) is not None:
            self._mount(frame)

    def run(self, folder: ResultsFolder, progress: Callable[[], None] = lambda: None) -> Outcome:
        """Run to the end, calling progress after each image; KeyboardInterrupt is passed on."""
        self._folder = folder
        self._progress = progress
        # The summary that a killed run leaves.
        folder.finish({**self._what(), **UNFINISHED})
        started = perf_counter()
        complete, problem = False, 'interrupted'
        try:
            for message, following in with_next_image(self._recording):
                self._following = following
                self._take(message)
            self._work_off(None)
            self._folder.add_landmarks(self._tracker.unsettled())
            complete, problem = True, self._complaint()
        except DjetError as error:
            problem = str(error)
        finally:
            # Also when interrupted.
            summary = {**self._summary(perf_counter() - started),
                       'complete': complete, 'error': problem or None}
            self._folder.finish(summary)
        self._evaluate(summary)
        self._folder.finish(summary)
        return Outcome(summary, problem or None, (
            *self._log.advice(self._tracker.masked), *self._of_late_info(), *self._of_truth(),
            *(f'{one.name}: {one.text}' for one in self._tracker.complaints_of_content)))

    def _take(self, message: BagMessage) -> None:
        """Take one message, and process the images that waited for it."""
        recording, what = self._recording, self._names.get(message.topic)
        if message.topic in (recording.image_topic, recording.info_topic):
            self._first_ns.setdefault(message.topic, message.stamp_ns)
            self._waiting.append(message)
        elif message.topic == recording.ground_truth_topic:
            self._truth.add(*pose_of(message.message))
            self._frame_of_truth = getattr(message.message, 'child_frame_id', '').lstrip('/')
        elif what == 'frames':
            self._frames.add(message.message)
            self._tracker.tf_static(message.message)
        elif what is not None:
            getattr(self._tracker, what)(message.message)
        self._work_off(message.stamp_ns)

    def _work_off(self, now_ns: int | None) -> None:
        """Process the images that have all auxiliary inputs or timed out; None: all images."""
        while self._waiting:
            first = self._waiting[0]
            if first.topic == self._recording.info_topic:
                self._info(self._waiting.popleft())
                continue
            following = self._after_the_first()
            if now_ns is not None and len(self._waiting) < MOST_WAITING and (
                    (following is None and self._tracker.follows_gap(first.message))
                    or (now_ns - first.stamp_ns < AUXILIARY_TIMEOUT_NS
                        and self._tracker.needs(first.message))):
                break
            self._image(self._waiting.popleft(), following)
            self._progress()

    def _after_the_first(self) -> Any:
        """Return the second waiting image, or None."""
        images = [one for one in self._waiting if one.topic == self._recording.image_topic]
        return images[1].message if len(images) > 1 else None

    def _info(self, message: BagMessage) -> None:
        tracker = self._tracker
        rejected = tracker.counts.rejected_infos.total()
        outgoing = tracker.camera_info(message.message)
        with interrupt_after():
            self._publish(outgoing, message.stamp_ns)
        if tracker.counts.rejected_infos.total() > rejected:
            self._first_problem = self._first_problem or str(tracker.problem)

    def _image(self, message: BagMessage, following: Any) -> None:
        tracker = self._tracker
        number, processed = tracker.counts.received, tracker.counts.processed
        rejected = tracker.counts.rejected.total()
        frame = frame_of(message.message.header)
        for what, (parent, child) in tracker.missing_mountings(frame).items():
            if (mounting := self._frames.transform(parent, child)) is not None:
                tracker.mount_sensor(what, mounting)
        if not tracker.mounted:
            self._mount(frame)
        if self._following is not None:
            tracker.prepare_ahead(self._following.message)
        started = perf_counter()
        outgoing = tracker.image(message.message, following)
        seconds = perf_counter() - started
        # A frame is in all results or in none.
        with interrupt_after():
            if tracker.counts.processed > processed and tracker.last is not None:
                self._record(number, tracker.last, seconds)
            else:
                self._folder.add_unused(number, stamp_ns(message.message.header),
                                        tracker.verdict)
            self._publish(outgoing, message.stamp_ns)
        if tracker.counts.rejected.total() > rejected:
            self._first_problem = self._first_problem or f'image {number}: {tracker.problem}'

    def _record(self, number: int, result: OdometryResult, seconds: float) -> None:
        """Keep and write the result of image ``number``."""
        self._log.steps.append(Step(result.stamp_ns, result.status, result.pose,
                                    result.previous_stamp_ns, result.motion,
                                    result.motion_covariance, result.scale_known,
                                    metric=result.metric, keyframe=result.keyframe))
        self._folder.add_frame(number, result, seconds)
        if self._draw and (drawing := self._tracker.drawing()) is not None:
            self._folder.add_drawing(number, drawing)
        self._folder.add_landmarks(self._tracker.settled())

    def _mount(self, image_frame: str) -> None:
        """Look up the camera on base_frame; DjetError if the recording does not have it."""
        if not self._tracker.mount(self._frames.transform, image_frame):
            config = self._config.odometry
            camera, _ = mounted_frame(config, image_frame)
            raise DjetError(
                f"odometry.base_frame is '{config.base_frame}', but {self._name} has no transform "
                f"from it to '{camera}' on /tf_static; record /tf_static, or leave base_frame "
                "empty (--base-frame '') for the poses of the camera")

    def _publish(self, outgoing: list[Outgoing], stamp: int) -> None:
        for one in outgoing:
            self._folder.publish(one, stamp)

    def _complaint(self) -> str:
        """Return what is wrong with a recording that was read to its end, or ''."""
        counts, first_problem = self._tracker.counts, self._first_problem
        if not counts.processed and first_problem:
            return (f'{self._name}: none of {counts.received} images could be used; '
                    f'{first_problem}')
        if not counts.processed:
            recorded = self._time_of_first_info()
            return (f'{self._name}: none of {counts.received} images has an earlier CameraInfo on '
                    f'{self._recording.info_topic}{f" ({recorded})" if recorded else ""}; record '
                    'it before the images, or choose another topic with --info-topic')
        found = []
        if first_problem:
            found.append(f'{_unusable(counts)} could not be used; {first_problem}')
        if changes := counts.status[Status.SIZE_CHANGED.value]:
            found.append(f'the image size or the camera matrix changes {_times(changes)}; the '
                         'motion is unknown there, which leaves a gap in the trajectory; record '
                         f'one size, {ONE_CAMERA_MATRIX}')
        if back := [after for before, after in self._log.jumps() if after < before]:
            found.append(f'the stamps go back {_times(len(back))}; the poses restart at the '
                         f'origin at stamp {", ".join(map(seconds_text, back[:3]))}')
        return f'{self._name}: {"; ".join(found)}' if found else ''

    def _time_of_first_info(self) -> str:
        """Return when the first CameraInfo was recorded, or '' if there is none."""
        image, info = (self._first_ns.get(topic) for topic in (
            self._recording.image_topic, self._recording.info_topic))
        return '' if image is None or info is None else (
            f'the first one was recorded {(info - image) * 1e-9:.3f} s after the first image')

    def _of_late_info(self) -> list[str]:
        """Return a warning if images were recorded before the first CameraInfo."""
        counts = self._tracker.counts
        early = counts.dropped['waiting_for_camera_info']
        # An invalid CameraInfo is reported by _complaint.
        if not early or not counts.processed or counts.rejected_infos:
            return []
        return [f'{early} of {counts.received} images have no earlier CameraInfo on '
                f'{self._recording.info_topic} and were dropped, as in a live node: '
                f'{self._time_of_first_info()}; record it before the images']

    def _of_truth(self) -> list[str]:
        """Return a warning if ground truth is several, at no image, or of another frame."""
        images = self._log.stamps_ns
        if choices := self._recording.ground_truth_choices:
            return [f'no errors were computed: {_several(choices)}']
        if not len(self._truth) or not images.size:
            return []
        if np.isfinite(self._truth.at(images)).any():
            return self._of_frame_of_truth()
        name = self._recording.ground_truth_file or self._recording.ground_truth_topic
        known, _ = self._truth.known()
        if ((known[0] <= images) & (images <= known[-1])).any():
            return [f'no errors were computed: no image lies between two poses of {name} that '
                    f'are at most {LONGEST_GAP_NS * 1e-9:g} s apart; give ground truth with a '
                    'higher rate']
        ends = [seconds_text(stamp) for stamp in (*known[[0, -1]], images.min(), images.max())]
        return [f'no errors were computed: the stamps of {name} are {ends[0]} to {ends[1]}, those '
                f'of the images {ends[2]} to {ends[3]}; give ground truth with the same clock']

    def _of_frame_of_truth(self) -> list[str]:
        """Return a warning if the ground truth is of another frame than the images."""
        of, topic = self._frame_of_truth, self._recording.ground_truth_topic
        frame = self._tracker.last.frame_id if self._tracker.last else ''
        return [] if not of or not frame or of == frame else [
            f"the ground truth on {topic} is of '{of}', the images of '{frame}': errors hold only "
            'if both have the same place and axes (x right, y down, z ahead); give ground truth '
            'of the camera as a file (--poses)']

    def _what(self) -> dict[str, Any]:
        """Return the entries of the summary that describe the input and the method."""
        config = self._config
        return {'source': self._name, 'image_topic': self._recording.image_topic,
                'method': config.estimator.method, 'preset': config.preset,
                'scale': config.odometry.scale}

    def _summary(self, seconds: float) -> dict[str, Any]:
        counts: Counts = self._tracker.counts
        return {
            **self._what(), 'scale_kind': self._log.scale.value,
            'pairs_of_known_scale': sum(step.tracked and step.scale_known
                                        for step in self._log.steps),
            'frames': counts.processed, 'pairs': len(self._log.pairs()),
            'seconds': round(seconds, 3),
            'images': counts.received, 'dropped': dict(counts.dropped),
            'rejected': dict(counts.rejected), 'rejected_infos': dict(counts.rejected_infos),
            'status': dict(counts.status), 'inner_loops': compiled.in_use(),
            'versions': {'djet_ros': __version__, 'numpy': np.__version__,
                         'opencv': cv2.__version__},
        }

    def _evaluate(self, summary: dict[str, Any]) -> None:
        """Add errors against ground truth to the summary, and draw the trajectory."""
        log, config = self._log, self._config
        pairs, truth = log.pairs(), self._truth.at(log.stamps_ns)
        if len(self._truth) and pairs:
            errors = log.errors(truth)
            summary.update(
                compared_pairs=errors.compared, failures=errors.failures,
                translation_failures=errors.translation_failures,
                rotation_error_deg=statistics(errors.rotation_deg),
                translation_error_deg=statistics(errors.translation_deg))
            summary['drift'] = log.drift(truth)
            summary['positions'] = log.positions(truth)
            self._folder.add_errors(pairs, errors)
        if any(step.tracked for step in log.steps):
            log.plot(self._folder.path / PLOT, truth, self._folder.landmarks_from_above,
                     f'{one_line(Path(self._name).name)}: {config.estimator.method}, '
                     f'{config.preset}')


def _unusable(counts: Counts) -> str:
    """Return how many images, and how many CameraInfo, were rejected."""
    images, infos = counts.rejected.total(), counts.rejected_infos.total()
    return ' and '.join([*([f'{images} of {counts.received} images'] if images else []),
                         *([f'{infos} CameraInfo'] if infos else [])])


def _times(count: int) -> str:
    return 'once' if count == 1 else f'{count} times'


def _several(topics: Sequence[str]) -> str:
    return (f'{" and ".join(topics)} may be the ground truth; give that of the camera as a file '
            '(--poses)')


def _static_frames(recording: Recording) -> StaticFrames:
    """Read the static frames, as far as the recording can be read."""
    frames = StaticFrames()
    # Damage of the recording is reported when the images are read.
    with suppress(DjetError):
        for message in recording.static_frames():
            frames.add(message)
    return frames


def _frame_of_images(recording: Recording) -> str | None:
    """Return the frame_id of the first image; None if the recording is damaged before it."""
    with suppress(DjetError):
        for message in recording.messages({recording.image_topic}):
            if message.topic == recording.image_topic:
                return frame_of(message.message.header)
    return None


def _scale(recording: Recording, config: Config) -> ScaleSource:
    """Return the scale source; for ground truth, it is read from the whole recording first."""
    positions = None
    if config.odometry.scale == 'ground_truth' and recording.ground_truth_choices:
        raise DjetError(f"odometry.scale is 'ground_truth', but "
                        f'{_several(recording.ground_truth_choices)}')
    if config.odometry.scale == 'ground_truth' and recording.ground_truth_topic is not None:
        # Damage of the recording is reported when the images are read.
        stamps, poses = GroundTruth.of(recording, lambda damage: None).known()
        positions = stamps, poses[:, :3, 3]
    return scale_source(config.odometry, positions)
