"""
The odometry on a live stream: image queue, worker thread, services, log and diagnostics.

It is independent of the middleware, which live nodes add.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from threading import Lock, Thread
from time import monotonic, time_ns
from typing import Any, NamedTuple

from djet_ros.config.flat import flat
from djet_ros.config.sections import Config
from djet_ros.live.auxiliary_queue import AuxiliaryQueue
from djet_ros.live.frame_queue import FrameQueue
from djet_ros.live.rate_limit import RateLimit
from djet_ros.live.reporting import Latencies, SILENCE_TIMEOUT, Throttle, Wiring
from djet_ros.live.stopwatch import elapsed, Moment, Stopwatch
from djet_ros.odometry.health import Complaint, REDUCE_LOAD
from djet_ros.odometry.messages import frame_of, stamp_ns
from djet_ros.odometry.state import LEVELS, State
from djet_ros.odometry.tracker import Outgoing, Tracker
import numpy as np

# Seconds after which diagnostics are published even if no image triggers them.
_DIAGNOSTICS_PERIOD = 1.0

# Limit in bytes for the queued images, and for the queued auxiliary inputs: a thousand small
# images are a short delay, and a thousand large ones more memory than a robot has.
MAX_QUEUE_BYTES = 500_000_000

# Approximate size of a message in bytes without its pixels.
_MESSAGE_OVERHEAD = 4_000

# Seconds for which an image waits for its auxiliary inputs, such as gyro rates and mask; these and
# the next two by a Stopwatch.
_AUXILIARY_TIMEOUT = 0.1

# With queue_policy 'every' that wait restarts with each auxiliary input, up to this in total.
_MAX_AUXILIARY_TIMEOUT = 2.0

# Seconds for which an image after a gap waits for the next one, which shows a wrong stamp.
_NEXT_IMAGE_TIMEOUT = 1.0

# States that a user requested, or that are logged with topic names by ``_log_missing_inputs``.
_LOGGED_ELSEWHERE = (State.PAUSED, State.WAITING_FOR_IMAGE, State.WAITING_FOR_CAMERA_INFO)


class _Received(NamedTuple):
    """An image with the newest CameraInfo at its arrival, and the moment of that."""

    image: Any
    info: Any
    at: Moment


class Session:
    """
    Processes images in a worker thread, in the order of arrival.

    topics: resolved names of 'image' and 'camera_info', for log messages. Messages are passed in
    from one thread and never block it: images beyond MAX_QUEUE_BYTES are dropped and counted. All
    other methods may be called from any thread. The messages for one image are published all or
    none, and nothing from before a reset or stop is published after it.
    """

    def __init__(self, tracker: Tracker, wiring: Wiring, topics: Mapping[str, str]) -> None:
        node = tracker.config.ros
        self._tracker = tracker
        tracker.node_values, tracker.node_complaints = self._node_values, self._node_complaints
        self._wiring = wiring
        self._topics = topics
        self._queue: FrameQueue[_Received] = FrameQueue(
            node.queue_policy, node.queue_size, MAX_QUEUE_BYTES)
        self._limit = RateLimit(*_limits(tracker.config))
        # Held while an image is processed and published, and by calls between two images.
        self._lock = Lock()
        self._turnstile = Lock()
        self._newest_info: Any = None
        self._taken_info: Any = None
        self._stopwatch = Stopwatch(wiring.now_ns)
        self._auxiliary = AuxiliaryQueue(self._stopwatch, MAX_QUEUE_BYTES)
        self._counted_drops = self._lost = self._counted_lost = self._skipped = 0
        self._drops_logged = False
        self._latencies = Latencies()
        self._started = self._forgotten = self._last_image = self._last_diagnostics = -np.inf
        self._log = Throttle(wiring)
        self._logged_complaints: set[str] = set()
        self._stopping = False
        self._worker = Thread(target=self._work, name='odometry', daemon=True)

    def start(self) -> None:
        """Start the worker thread."""
        self._started = self._last_image = monotonic()
        self._worker.start()

    def stop(self, timeout: float = 0.5) -> None:
        """
        Stop publishing, and wait up to timeout seconds for the image being processed.

        If its messages are being published already, all of them are.
        """
        self._stopping = True
        self._auxiliary.wake()
        self._queue.close()
        self._queue.clear()
        if self._worker.is_alive():
            self._worker.join(timeout)

    @property
    def failed(self) -> bool:
        """Whether the worker thread ended with an error; Python has printed its traceback."""
        return not (self._worker.is_alive() or self._stopping)

    # Inputs

    @property
    def wants_frames(self) -> bool:
        """Whether a mounting still has to be looked up on tf."""
        return self._tracker.wants_frames

    @property
    def has_room(self) -> bool:
        """Whether the queue accepts an image; with queue_policy 'every' publishers can wait."""
        return self._queue.has_room

    def image(self, message: Any) -> None:
        """Queue an Image or CompressedImage, unless ros.max_rate skips it."""
        at = self._stopwatch.now()
        self._last_image = at.machine
        if not self._limit.takes(stamp_ns(message.header)):
            self._skipped += 1
            return
        self._queue.put(_Received(message, self._newest_info, at), _bytes(message))

    def camera_info(self, message: Any) -> None:
        """Take a CameraInfo for the images that arrive after it."""
        self._newest_info = message

    def speed(self, message: Any) -> None:
        """Take a TwistStamped or an Odometry as the camera's speed."""
        self._take(self._tracker.speed, message)

    def imu(self, message: Any) -> None:
        """Take an Imu."""
        self._take(self._tracker.imu, message)

    def guess(self, message: Any) -> None:
        """Take an Odometry for the initial motion."""
        self._take(self._tracker.guess, message)

    def tf(self, message: Any) -> None:
        """Take a TFMessage of /tf."""
        self._take(self._tracker.tf, message)

    def tf_static(self, message: Any) -> None:
        """Take a TFMessage of /tf_static."""
        self._take(self._tracker.tf_static, message)

    def mask(self, message: Any) -> None:
        """Take the mask of the image that has its stamp."""
        self._take(self._tracker.mask, message)

    def _take(self, by_tracker: Callable[[Any], None], message: Any) -> None:
        self._auxiliary.put(by_tracker, message, _bytes(message))

    def count_lost(self, number: int) -> None:
        """Count images that were sent and did not arrive."""
        self._lost += number

    # Services and parameters, between two images

    def reset(self) -> str:
        """Discard all images, poses, speeds and counts, queued ones included; return a report."""
        with self._between_images():
            processed = self._tracker.counts.processed
            # An image that has left the queue may be waiting for the lock.
            self._forgotten = monotonic()
            self._queue.clear()
            self._auxiliary.clear()
            self._latencies.clear()
            self._log.clear()
            self._counted_drops = self._queue.dropped
            self._lost = self._counted_lost = self._skipped = 0
            self._limit = RateLimit(*_limits(self._tracker.config))
            self._drops_logged = False
            self._tracker.reset()
            self._publish_diagnostics()
        return self._log_and_return(
            f'reset: {processed} images and their poses discarded; '
            f'{self._tracker.config.odometry.odom_frame} starts at the next image')

    def pause(self) -> str:
        """Drop and count all images until ``resume``; return a report."""
        with self._between_images():
            before = self._tracker.state is State.PAUSED
            self._tracker.pause()
            self._publish_diagnostics()
        return self._log_and_return('already paused' if before
                                    else 'paused: images are dropped and counted until ~/resume')

    def resume(self) -> str:
        """Process images again; return a report."""
        with self._between_images():
            before = self._tracker.state is State.PAUSED
            self._tracker.resume()
            self._publish_diagnostics()
        return self._log_and_return('resumed: images are processed again' if before
                                    else 'not paused')

    def configure(self, config: Config) -> None:
        """Change parameters from the next image on; those of the queue cannot change."""
        with self._between_images():
            before = flat(self._tracker.config)
            if _limits(config) != _limits(self._tracker.config):
                self._limit = RateLimit(*_limits(config))
            self._tracker.configure(config)
        changed = [f'{item.name} = {item.value}' for item in flat(config).values()
                   if item.value != before[item.name].value]
        if changed:
            self._log_and_return(f'parameters from the next image on: {", ".join(changed)}')

    def _log_and_return(self, text: str) -> str:
        """Log the result of a request, and return it as the answer."""
        self._wiring.log('info', text)
        return text

    @contextmanager
    def _between_images(self) -> Iterator[None]:
        # A caller waiting for the lock holds the turnstile, so that the worker thread cannot
        # reacquire the lock first.
        with self._turnstile, self._lock:
            yield

    # Once a second

    def tick(self) -> None:
        """
        Log missing inputs, and publish diagnostics while no images arrive.

        To be called about once a second.
        """
        if not self._lock.acquire(blocking=False):
            # An image is being processed, which does all of this.
            return
        try:
            silent = monotonic() - self._last_image > SILENCE_TIMEOUT
            if not len(self._queue):
                self._auxiliary.feed(np.inf)
            if silent:
                # No image is queued that arrived before this CameraInfo.
                self._take_info(self._newest_info)
                self._tracker.images_stopped()
            if self._tracker.state is not State.PAUSED:
                self._log_missing_inputs(silent)
            if monotonic() - self._last_diagnostics > _DIAGNOSTICS_PERIOD:
                self._publish_diagnostics()
        finally:
            self._lock.release()

    def _log_missing_inputs(self, silent: bool) -> None:
        without_info = self._newest_info is None and monotonic() - self._started > SILENCE_TIMEOUT
        for what in ['image'] * silent + ['camera_info'] * without_info:
            self._log.warn_missing(what, self._topics[what])

    # In the worker thread

    def _work(self) -> None:
        try:
            while (received := self._queue.get()) is not None:
                self._wait_for_auxiliary(received)
                self._wait_for_next_if_ahead(received)
                with self._turnstile:
                    pass
                with self._lock:
                    if received.at.machine > self._forgotten:
                        self._process(received)
        finally:
            # Nothing processes what arrives from now on.
            self._queue.close()
            self._auxiliary.close()

    def _process(self, received: _Received) -> None:
        tracker = self._tracker
        self._count_drops()
        self._take_info(received.info)
        self._auxiliary.feed(self._auxiliary_cutoff(received))
        frame = frame_of(received.image.header)
        if not tracker.mounted:
            self._mount(frame)
        self._mount_auxiliary(frame)
        waiting = self._queue.peek()
        following = None if waiting is None else waiting.image
        if following is not None:
            tracker.prepare_ahead(following)
        before = tracker.counts.processed
        self._publish(tracker.image(received.image, following))
        if tracker.counts.processed > before:
            self._latencies.add(received.at.machine)
        self._log_problem()
        for topic, make in (('debug_image', tracker.debug_image),
                            ('landmarks', tracker.landmarks)):
            if self._wiring.wants(topic) and (made := make()):
                self._publish([made])

    def _wait_for_auxiliary(self, received: _Received) -> None:
        """Wait briefly for the auxiliary inputs of an image that have not arrived yet."""
        inputs, stopwatch = self._auxiliary, self._stopwatch
        # With 'every' on a slow machine, auxiliary inputs arrive late, but keep arriving.
        patient = self._tracker.config.ros.queue_policy == 'every'
        start = stopwatch.now()
        while not self._stopping and received.at.machine > self._forgotten:
            inputs.expect()
            with self._lock:
                inputs.feed(self._auxiliary_cutoff(received))
                while (lacking := self._tracker.needs(received.image)) and inputs.feed_next(
                        lambda at: elapsed(received.at, at) <= _MAX_AUXILIARY_TIMEOUT):
                    pass
            newest = inputs.newest
            since = received.at if newest is None or not patient else max(received.at, newest)
            left = min(stopwatch.left(since, _AUXILIARY_TIMEOUT),
                       stopwatch.left(start, _MAX_AUXILIARY_TIMEOUT))
            if not lacking or left <= 0:
                return
            inputs.wait(left)

    def _wait_for_next_if_ahead(self, received: _Received) -> None:
        with self._lock:
            leaps = self._tracker.follows_gap(received.image)
        start = self._stopwatch.now()
        while (leaps and received.at.machine > self._forgotten and not self._stopping
               and (left := self._stopwatch.left(start, _NEXT_IMAGE_TIMEOUT)) > 0
               and self._queue.peek(timeout=left) is None):
            pass

    def _auxiliary_cutoff(self, received: _Received) -> float:
        """Return the arrival time after which auxiliary inputs are for later images."""
        return received.at.machine if len(self._queue) else np.inf

    def _mount_auxiliary(self, image_frame: str) -> None:
        for what, (parent, child) in self._tracker.missing_mountings(image_frame).items():
            if (mounting := self._wiring.transform(parent, child)) is not None:
                self._tracker.mount_sensor(what, mounting)
                self._log_and_return(f'mounting of {child} on {parent} received from tf')

    def _mount(self, image_frame: str) -> None:
        if found := self._tracker.mount(self._wiring.transform, image_frame):
            self._log_and_return(found)

    def _count_drops(self) -> None:
        if lost := self._lost - self._counted_lost:
            self._counted_lost += lost
            self._tracker.count_lost(lost)
        new = self._queue.dropped - self._counted_drops
        if new:
            self._counted_drops += new
            counts = self._tracker.counts
            self._tracker.count_dropped('queue_full', new)
            if not self._drops_logged:
                self._drops_logged = True
                self._wiring.log('warning', f'{counts.dropped["queue_full"]} of {counts.received} '
                                 'images dropped: they arrive faster than they are processed; '
                                 f'{REDUCE_LOAD}; further drops are counted in the diagnostics')

    def _take_info(self, info: Any) -> None:
        if info is not self._taken_info:
            self._taken_info = info
            self._publish(self._tracker.camera_info(info))
            self._log_problem()

    def _node_complaints(self) -> list[Complaint]:
        waiting = self._queue.weight
        # Warn before anything is lost.
        return [] if waiting < MAX_QUEUE_BYTES / 2 else [Complaint('images pile up', 'WARN', (
            f'{waiting * 1e-6:.0f} MB of images are queued; from {MAX_QUEUE_BYTES * 1e-6:.0f} MB '
            f'on images are dropped, unless their publisher can wait; {REDUCE_LOAD}'))]

    def _node_values(self) -> dict[str, str]:
        return {'frames lost on the way': str(self._lost),
                'frames beyond ros.max_rate': str(self._skipped),
                'queue policy': self._tracker.config.ros.queue_policy,
                **self._latencies.values()}

    def _publish(self, outgoing: Sequence[Outgoing]) -> None:
        if self._stopping or not outgoing:
            return
        if any(one.topic == '/diagnostics' for one in outgoing):
            self._last_diagnostics = monotonic()
        self._wiring.publish(outgoing)

    def _publish_diagnostics(self) -> None:
        self._publish([self._tracker.diagnostics(time_ns())])

    def _log_problem(self) -> None:
        """Log what is wrong, throttled, for as long as it is."""
        self._log_complaints()
        tracker = self._tracker
        if tracker.state in _LOGGED_ELSEWHERE or LEVELS[tracker.state] == 'OK':
            return
        text = ': '.join(filter(None, [tracker.state.value, tracker.detail,
                                       str(tracker.problem or tracker.remark)]))
        # A reset of odom to the origin must not be throttled by a gap just before it.
        self._log.warn(f'{tracker.state} {tracker.detail} {tracker.went_back}', text)

    def _log_complaints(self) -> None:
        """Log each complaint once, until it has gone and comes again."""
        complaints = self._tracker.complaints
        for one in complaints:
            if one.name not in self._logged_complaints:
                self._log.warn(one.name, f'{one.name}: {one.text}')
        self._logged_complaints = {one.name for one in complaints}


def _limits(config: Config) -> tuple[float, float, float]:
    """Return the arguments of RateLimit."""
    return config.ros.max_rate, config.odometry.max_backwards, config.odometry.max_gap


def _bytes(message: Any) -> int:
    """Return about how much memory a message takes; only images are large."""
    return _MESSAGE_OVERHEAD + len(getattr(message, 'data', ()))
