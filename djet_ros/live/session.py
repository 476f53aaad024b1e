"""
A tracker at work on a live stream: its queue, its thread, and what happens around the frames.

Every live face shares this and adds the wiring alone: how messages come and go.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from threading import Event, Lock, Thread
from time import monotonic, time_ns
from typing import Any, NamedTuple, Protocol

from djet_ros.config.flat import flat
from djet_ros.config.sections import Config
from djet_ros.core.types import Array
from djet_ros.live.frame_queue import FrameQueue
from djet_ros.live.rate_limit import RateLimit
from djet_ros.odometry.diagnostics import LEVELS, State
from djet_ros.odometry.health import Complaint
from djet_ros.odometry.messages import frame_of, stamp_ns
from djet_ros.odometry.tracker import Outgoing, Tracker
import numpy as np

# Seconds without an image after which a camera counts as gone.
SILENCE = 2.0

# Seconds before the same is said in the log again.
_LOG_PERIOD = 5.0

# Seconds after which diagnostics come also where no image makes the tracker say them.
_DIAGNOSTICS_PERIOD = 1.0

# Messages of what comes beside the images that may wait for them: minutes of an IMU.
_WAITING_BESIDE = 100_000

# Bytes of images that may wait, and of what came beside them. By bytes, as a thousand small images
# are a short delay, and a thousand large ones more memory than a robot has.
ROOM = 500_000_000

# Bytes that a message takes beside its pixels, about.
_MESSAGE = 4_000

# Seconds for which an image waits for what belongs to it: the gyro's rates, its mask.
_PATIENCE = 0.1

# With the queue policy 'every': from the last message beside the images, and this in all.
_LONGEST_PATIENCE = 2.0

# Seconds for which an image after a gap waits for the one after it, which tells a wrong stamp.
_NEXT_PATIENCE = 1.0

_LATENCIES = 100

# States that somebody asked for, or that are logged with the names of topics.
_SAID_ELSEWHERE = (State.PAUSED, State.WAITING_FOR_IMAGE, State.WAITING_FOR_CAMERA_INFO)


class Wiring(Protocol):
    """What a session needs of the graph; all but ``publish`` is asked from any thread."""

    def publish(self, outgoing: Sequence[Outgoing]) -> None:
        """Send messages, from the session's thread or from the one that calls it."""

    def log(self, level: str, text: str) -> None:
        """Say something to people; level is 'info' or 'warning'."""

    def why_silent(self, topic: str) -> str:
        """Say what is seen of a topic over which nothing comes."""

    def wants(self, topic: str) -> bool:
        """Tell whether anybody listens to an output that is made for listeners alone."""

    def transform(self, parent: str, child: str) -> Array | None:
        """Give a frame in another (4, 4), or None where tf does not know it yet."""


class _Received(NamedTuple):
    """An image, the CameraInfo that was the newest when it came, and when (monotonic seconds)."""

    image: Any
    info: Any
    at: float


class _Beside(NamedTuple):
    """A message beside the images, the tracker's method that takes it, and when it came."""

    what: str
    message: Any
    at: float


class Throttle:
    """A log that says the same only now and then; for one thread at a time."""

    def __init__(self, wiring: Wiring) -> None:
        self._wiring = wiring
        self._said: dict[str, float] = {}

    def warn(self, key: str, text: str) -> None:
        """Say something, unless what goes by the same key was said a short while ago."""
        now = monotonic()
        if now - self._said.get(key, -np.inf) >= _LOG_PERIOD:
            self._said[key] = now
            self._wiring.log('warning', text)

    def warn_of_missing(self, what: str, topic: str) -> None:
        """Say that nothing comes over a topic."""
        self.warn(what, f'waiting for {what} on {topic}: {self._wiring.why_silent(topic)}')

    def clear(self) -> None:
        """Forget what was said."""
        self._said.clear()


class Latencies:
    """How long the newest pieces of work took, from receipt to publication."""

    def __init__(self) -> None:
        self._seconds: deque[float] = deque(maxlen=_LATENCIES)

    def add(self, since: float) -> None:
        """Take a piece of work that came in at a moment (monotonic seconds) and is done now."""
        self._seconds.append(monotonic() - since)

    def clear(self) -> None:
        """Forget what was taken."""
        self._seconds.clear()

    def values(self) -> dict[str, str]:
        """Give what diagnostics say of them; nothing where there are none."""
        if not self._seconds:
            return {}
        median, high = np.percentile(self._seconds, (50, 95)) * 1e3
        return {'latency, median (ms)': f'{median:.1f}', 'latency, 95 % (ms)': f'{high:.1f}'}


class Session:
    """
    Works on images in a thread of its own, in the order in which they come.

    topics: resolved names of 'image' and 'camera_info', for people. Messages may come from any
    one thread, and never have to wait: images beyond ROOM are dropped and counted. Everything else
    may be called from any thread. What is published for one image is published as a whole or not
    at all, and nothing of before a reset or a stop after it.
    """

    def __init__(self, tracker: Tracker, wiring: Wiring, topics: Mapping[str, str]) -> None:
        node = tracker.config.ros
        self._tracker = tracker
        self._wiring = wiring
        self._topics = topics
        self._queue: FrameQueue[_Received] = FrameQueue(node.queue_policy, node.queue_size, ROOM)
        self._limit = _limit(tracker.config)
        # Held while an image is worked on and published, and by what happens in between.
        self._lock = Lock()
        self._turnstile = Lock()
        self._newest_info: Any = None
        self._taken_info: Any = None
        self._beside: FrameQueue[_Beside] = FrameQueue('latest', _WAITING_BESIDE, ROOM)
        self._came = Event()
        self._came_at = -np.inf
        self._counted_drops = self._lost = self._counted_lost = self._left_out = 0
        self._said_drops = False
        self._latencies = Latencies()
        self._started = self._forgotten = self._last_image = self._last_diagnostics = -np.inf
        self._log = Throttle(wiring)
        self._complained: set[str] = set()
        self._stopping = False
        self._worker = Thread(target=self._work, name='odometry', daemon=True)

    def start(self) -> None:
        """Begin to work."""
        self._started = self._last_image = monotonic()
        self._worker.start()

    def stop(self, timeout: float = 0.5) -> None:
        """
        Publish nothing more, and wait up to timeout seconds for the image in work.

        An image whose messages are being published at this moment is published as a whole.
        """
        self._stopping = True
        self._came.set()
        self._queue.close()
        self._queue.clear()
        if self._worker.is_alive():
            self._worker.join(timeout)

    @property
    def failed(self) -> bool:
        """Whether the work ended by an error; Python has printed its traceback."""
        return not (self._worker.is_alive() or self._stopping)

    # What comes in

    @property
    def wants_frames(self) -> bool:
        """Whether tf is still to be asked how anything is mounted."""
        return self._tracker.wants_frames

    @property
    def has_room(self) -> bool:
        """Whether an image would be taken; with the policy 'every' it may be better to wait."""
        return self._queue.has_room

    def image(self, message: Any) -> None:
        """Take an Image or a CompressedImage, unless they come faster than is asked for."""
        self._last_image = monotonic()
        if not self._limit.takes(stamp_ns(message.header)):
            self._left_out += 1
            return
        self._queue.put(_Received(message, self._newest_info, self._last_image), _bytes(message))

    def camera_info(self, message: Any) -> None:
        """Take a CameraInfo; it holds for the images that come after it."""
        self._newest_info = message

    def speed(self, message: Any) -> None:
        """Take a TwistStamped or an Odometry as the camera's speed."""
        self._take('speed', message)

    def imu(self, message: Any) -> None:
        """Take an Imu."""
        self._take('imu', message)

    def guess(self, message: Any) -> None:
        """Take an Odometry as a guess of where the camera went."""
        self._take('guess', message)

    def tf(self, message: Any) -> None:
        """Take a TFMessage of /tf."""
        self._take('tf', message)

    def tf_static(self, message: Any) -> None:
        """Take a TFMessage of /tf_static."""
        self._take('tf_static', message)

    def mask(self, message: Any) -> None:
        """Take the mask of the image that has its stamp."""
        self._take('mask', message)

    def _take(self, what: str, message: Any) -> None:
        self._came_at = monotonic()
        self._beside.put(_Beside(what, message, self._came_at), _bytes(message))
        self._came.set()

    def count_lost(self, number: int) -> None:
        """Count images that were sent and never came."""
        self._lost += number

    # What is asked for between two images

    def reset(self) -> str:
        """Forget all images, poses, speeds and counts, those that wait included; says so."""
        with self._between_images():
            processed = self._tracker.counts.processed
            # An image that has left the queue may wait for the lock just now.
            self._forgotten = monotonic()
            self._queue.clear()
            self._beside.clear()
            self._latencies.clear()
            self._log.clear()
            self._counted_drops = self._queue.dropped
            self._lost = self._counted_lost = self._left_out = 0
            self._limit = _limit(self._tracker.config)
            self._said_drops = False
            self._tracker.reset()
            self._say()
        return self._note(f'reset: forgot {processed} images and their poses; '
                          f'{self._tracker.config.odometry.odom_frame} begins at the next image')

    def pause(self) -> str:
        """Drop and count all images until ``resume``; says so."""
        with self._between_images():
            before = self._tracker.state is State.PAUSED
            self._tracker.pause()
            self._say()
        return self._note('was paused already' if before
                          else 'paused: images are dropped and counted until a resume')

    def resume(self) -> str:
        """Work on images again; says so."""
        with self._between_images():
            before = self._tracker.state is State.PAUSED
            self._tracker.resume()
            self._say()
        return self._note('resumed: images are worked on again' if before else 'was not paused')

    def configure(self, config: Config) -> None:
        """Take other parameters from the next image on; the queue stays as it was made."""
        with self._between_images():
            before = flat(self._tracker.config)
            same = all(before[name].value == flat(config)[name].value
                       for name in ('ros.max_rate', 'odometry.max_backwards', 'odometry.max_gap'))
            if not same:
                self._limit = _limit(config)
            self._tracker.configure(config)
        changed = [f'{item.name} = {item.value}' for item in flat(config).values()
                   if item.value != before[item.name].value]
        if changed:
            self._note(f'from the next image on: {", ".join(changed)}')

    def _note(self, text: str) -> str:
        """Log what somebody asked for and got, and give it back."""
        self._wiring.log('info', text)
        return text

    @contextmanager
    def _between_images(self) -> Iterator[None]:
        # Who waits for the lock holds the turnstile meanwhile: the thread, which wants the lock
        # again as soon as it has released it, has to queue up.
        with self._turnstile, self._lock:
            yield

    # Once a second

    def tick(self) -> None:
        """
        Say what no image makes the tracker say; to be called about once a second.

        That is: which topic is still waited for, and diagnostics while no images come.
        """
        if not self._lock.acquire(blocking=False):
            # An image is in work, and says everything by itself.
            return
        try:
            silent = monotonic() - self._last_image > SILENCE
            if not len(self._queue):
                self._hand_on(np.inf)
            if silent:
                # No image waits that came before this CameraInfo.
                self._take_info(self._newest_info)
                self._tracker.no_image_comes()
            if self._tracker.state is not State.PAUSED:
                self._log_what_is_missing(silent)
            if monotonic() - self._last_diagnostics > _DIAGNOSTICS_PERIOD:
                self._say()
        finally:
            self._lock.release()

    def _log_what_is_missing(self, silent: bool) -> None:
        without_info = self._newest_info is None and monotonic() - self._started > SILENCE
        for what in ['image'] * silent + ['camera_info'] * without_info:
            self._log.warn_of_missing(what, self._topics[what])

    # In the thread

    def _work(self) -> None:
        try:
            while (received := self._queue.get()) is not None:
                self._await_what_belongs_to(received)
                self._await_the_next_if_it_leaps(received)
                with self._turnstile:
                    pass
                with self._lock:
                    if received.at > self._forgotten:
                        self._process(received)
        finally:
            # What comes from now on is kept for nobody.
            self._queue.close()
            self._beside.close()

    def _process(self, received: _Received) -> None:
        tracker = self._tracker
        self._count_drops()
        self._tell_of_the_face()
        self._take_info(received.info)
        self._hand_on(self._present(received))
        frame = frame_of(received.image.header)
        if not tracker.mounted:
            self._mount(frame)
        self._mount_beside(frame)
        waiting = self._queue.peek()
        following = None if waiting is None else waiting.image
        if following is not None:
            tracker.expect(following)
        self._publish(tracker.image(received.image, following))
        self._latencies.add(received.at)
        self._log_trouble()
        for topic, make in (('debug_image', tracker.debug_image),
                            ('landmarks', tracker.landmarks)):
            if self._wiring.wants(topic) and (made := make()):
                self._publish([made])

    def _await_what_belongs_to(self, received: _Received) -> None:
        """Wait a moment for what an image is to be worked on with, if it has not come yet."""
        # Where nothing may be lost, on a slow machine what belongs to it comes late, but comes on.
        patient = self._tracker.config.ros.queue_policy == 'every'
        latest = monotonic() + _LONGEST_PATIENCE
        while not self._stopping and received.at > self._forgotten:
            self._came.clear()
            with self._lock:
                self._hand_on(self._present(received))
                while (lacking := self._tracker.lacks(received.image)) and self._hand_on_next(
                        received.at + _LONGEST_PATIENCE):
                    pass
            since = max(received.at, self._came_at) if patient else received.at
            left = min(since + _PATIENCE, latest) - monotonic()
            if not lacking or left <= 0:
                return
            self._came.wait(left)

    def _await_the_next_if_it_leaps(self, received: _Received) -> None:
        with self._lock:
            leaps = self._tracker.leaps(received.image)
        if leaps and received.at > self._forgotten:
            self._queue.peek(timeout=_NEXT_PATIENCE)

    def _present(self, received: _Received) -> float:
        """Tell until when messages count for an image: what came later is for those that wait."""
        return received.at if len(self._queue) else np.inf

    def _hand_on(self, until: float) -> None:
        """Give the tracker what came beside the images until a moment; it keeps but some of it."""
        while self._hand_on_next(until):
            pass

    def _hand_on_next(self, until: float) -> bool:
        waiting = self._beside.peek()
        if waiting is None or waiting.at > until or (one := self._beside.get(timeout=0)) is None:
            return False
        getattr(self._tracker, one.what)(one.message)
        return True

    def _mount_beside(self, image_frame: str) -> None:
        for what, (parent, child) in self._tracker.wanted_mountings(image_frame).items():
            if (mounting := self._wiring.transform(parent, child)) is not None:
                self._tracker.mount_beside(what, mounting)
                self._note(f'{child} is on {parent} as tf says')

    def _mount(self, image_frame: str) -> None:
        if found := self._tracker.mount(self._wiring.transform, image_frame):
            self._note(found)

    def _count_drops(self) -> None:
        if lost := self._lost - self._counted_lost:
            self._counted_lost += lost
            self._tracker.count_lost(lost)
        new = self._queue.dropped - self._counted_drops
        if new:
            self._counted_drops += new
            counts = self._tracker.counts
            self._tracker.count_dropped('queue_full', new)
            if not self._said_drops:
                self._said_drops = True
                self._wiring.log('warning', f'{counts.dropped["queue_full"]} of {counts.received} '
                                 'images dropped: they come faster than they are worked on; the '
                                 'diagnostics count them')

    def _take_info(self, info: Any) -> None:
        if info is not self._taken_info:
            self._taken_info = info
            self._publish(self._tracker.camera_info(info))
            self._log_trouble()

    def _tell_of_the_face(self) -> None:
        self._tracker.face_values = self._face_values()
        waiting = self._queue.weight
        # To be said before anything is lost.
        self._tracker.face_complaints = [] if waiting < ROOM / 2 else [Complaint(
            'images pile up', 'WARN', (
                f'{waiting * 1e-6:.0f} MB of images wait to be worked on; from {ROOM * 1e-6:.0f} '
                'MB on senders wait that can, and what others send is lost; lower their rate '
                '(that of a player, too), their size or estimator.max_features'))]

    def _face_values(self) -> dict[str, str]:
        return {'frames lost on the way': str(self._lost),
                'frames beyond ros.max_rate': str(self._left_out),
                'queue policy': self._tracker.config.ros.queue_policy,
                **self._latencies.values()}

    def _publish(self, outgoing: Sequence[Outgoing]) -> None:
        if self._stopping or not outgoing:
            return
        if any(one.topic == '/diagnostics' for one in outgoing):
            self._last_diagnostics = monotonic()
        self._wiring.publish(outgoing)

    def _say(self) -> None:
        self._tell_of_the_face()
        self._publish([self._tracker.diagnostics(time_ns())])

    def _log_trouble(self) -> None:
        """Put into the log, now and then, what is wrong for as long as it is."""
        self._log_complaints()
        tracker = self._tracker
        if tracker.state in _SAID_ELSEWHERE or LEVELS[tracker.state] == 'OK':
            return
        said = ': '.join(filter(None, [tracker.state.value, tracker.detail,
                                       str(tracker.problem or tracker.remark)]))
        # That odom is at the origin again is no more of what a gap said just before.
        self._log.warn(f'{tracker.state} {tracker.detail} {tracker.went_back}', said)

    def _log_complaints(self) -> None:
        """Put what there is to mend into the log, once for as long as it is."""
        complaints = self._tracker.complaints
        for one in complaints:
            if one.name not in self._complained:
                self._log.warn(one.name, f'{one.name}: {one.text}')
        self._complained = {one.name for one in complaints}


def _limit(config: Config) -> RateLimit:
    odometry = config.odometry
    return RateLimit(config.ros.max_rate, odometry.max_backwards, odometry.max_gap)


def _bytes(message: Any) -> int:
    """Tell about how much memory a message takes; of those that come, images alone are large."""
    return _MESSAGE + len(getattr(message, 'data', ()))
