"""
The pose graph on a live odometry: message queue, worker thread, service, log and diagnostics.

Like the odometry's session it is independent of the middleware, which live nodes add.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from threading import Thread
from time import monotonic, time_ns
from typing import Any, NamedTuple

from djet_ros.live.frame_queue import FrameQueue
from djet_ros.live.reporting import Latencies, SILENCE_TIMEOUT, Throttle, Wiring
from djet_ros.odometry.tracker import Outgoing
from djet_ros.posegraph.live_slam import LiveSlam
import numpy as np

# Messages of the odometry that may be queued while a graph is optimised.
_WAITING = 1000


class _Task(NamedTuple):
    """A task for the worker thread, and the time of its arrival (monotonic seconds)."""

    do: Callable[[], list[Outgoing]]
    since: float


class GraphSession:
    """
    Processes the odometry's messages in a worker thread, and loops while none is queued.

    topics: resolved names of 'odometry', 'relative_pose_cov', 'relative_pose_status', 'image' and
    'camera_info', for log messages. All methods are called from one thread and never block it.
    """

    def __init__(self, slam: LiveSlam, wiring: Wiring, topics: Mapping[str, str]) -> None:
        self._slam = slam
        slam.node_values = self._node_values
        self._wiring = wiring
        self._topics = topics
        self._log = Throttle(wiring)
        self._queue: FrameQueue[_Task] = FrameQueue('latest', _WAITING)
        # The worker thread takes these before each task.
        self._images: deque[Any] = deque(maxlen=slam.slam.image_buffer)
        self._masks: deque[Any] = deque(maxlen=slam.slam.image_buffer)
        self._infos: deque[Any] = deque(maxlen=1)
        self._latencies = Latencies()
        self._lost = self._loops = 0
        self._heard = dict.fromkeys(topics, -np.inf)
        self._stopping = False
        self._worker = Thread(target=self._work, name='pose_graph', daemon=True)

    def start(self) -> None:
        """Start the worker thread."""
        self._heard = dict.fromkeys(self._topics, monotonic())
        self._worker.start()

    def stop(self, timeout: float = 0.5) -> None:
        """Stop publishing, and wait up to timeout seconds for the current task."""
        self._stopping = True
        self._queue.close()
        if self._worker.is_alive():
            self._worker.join(timeout)

    @property
    def failed(self) -> bool:
        """Whether the worker thread ended with an error; Python has printed its traceback."""
        return not (self._worker.is_alive() or self._stopping)

    # Inputs

    @property
    def has_room(self) -> bool:
        """Whether the queue accepts an image: always."""
        return True

    def odometry(self, message: Any) -> None:
        """Take an Odometry."""
        self._take('odometry', lambda: self._slam.odometry(message))

    def relative_pose(self, message: Any) -> None:
        """Take a PoseWithCovarianceStamped."""
        self._take('relative_pose_cov', lambda: self._slam.relative_pose(message))
        # There is none while the odometry is lost: do not report it as missing.
        self._heard['relative_pose_cov'] = np.inf

    def relative_pose_status(self, message: Any) -> None:
        """Take the DiagnosticArray with the status of a frame."""
        self._take('relative_pose_status', lambda: self._slam.relative_pose_status(message))

    def image(self, message: Any) -> None:
        """Take an Image or a CompressedImage."""
        self._heard['image'] = monotonic()
        self._images.append(message)

    def mask(self, message: Any) -> None:
        """Take the mask of the image that has its stamp."""
        self._masks.append(message)

    def camera_info(self, message: Any) -> None:
        """Take a CameraInfo."""
        self._heard['camera_info'] = np.inf
        self._infos.append(message)

    def count_lost(self, number: int) -> None:
        """Count images that were sent and did not arrive."""
        self._lost += number

    def reset(self) -> str:
        """Discard the map and queued messages after the current task; return a report."""
        self._queue.clear()
        self._images.clear()
        self._put(self._forget)
        text = 'reset: map discarded; a new map starts at the next frame'
        self._wiring.log('info', text)
        return text

    @property
    def wants_frames(self) -> bool:
        """Whether the mounting of the camera on base_frame still has to be looked up on tf."""
        return not self._slam.mounted

    def tick(self) -> None:
        """Log missing inputs, and optimise while the odometry is silent; about once a second."""
        silent = monotonic() - self._heard['odometry'] > SILENCE_TIMEOUT
        for what in self._topics:
            if monotonic() - self._heard[what] > SILENCE_TIMEOUT:
                self._log.warn_missing(what, self._topics[what])
        if silent and not len(self._queue):
            self._put(self._settle)

    # In the worker thread

    def _take(self, what: str, do: Callable[[], list[Outgoing]]) -> None:
        self._heard[what] = monotonic()
        self._put(lambda: do() if self._mounted() else [])

    def _mounted(self) -> bool:
        """Return whether the mounting of the camera is known, or not needed."""
        if not self._slam.mounted and (missing := self._slam.mount(self._wiring.transform)):
            self._log.warn('mounting', f'{missing}; until then the odometry is ignored')
        return self._slam.mounted

    def _put(self, do: Callable[[], list[Outgoing]]) -> None:
        self._queue.put(_Task(do, monotonic()))

    def _work(self) -> None:
        while not self._stopping:
            task = self._queue.get(timeout=None if self._slam.idle else 0.0)
            self._take_images()
            if task is None:
                self._publish(self._slam.work())
                self._log_loops()
                continue
            self._publish(task.do())
            self._latencies.add(task.since)
            if self._slam.remark:
                self._wiring.log('warning', self._slam.remark)
                self._slam.remark = ''
            if self._slam.problem is not None:
                self._log.warn(type(self._slam.problem).__name__, str(self._slam.problem))

    def _log_loops(self) -> None:
        loops = self._slam.map.count('loop')
        if loops > self._loops:
            self._wiring.log('info', f'loops closed: {loops - self._loops} new, {loops} in total, '
                             f'with {len(self._slam.map.keyframes)} keyframes')
        self._loops = loops

    def _take_images(self) -> None:
        while self._infos:
            self._slam.camera_info(self._infos.popleft())
        while self._images:
            self._slam.image(self._images.popleft())
        while self._masks:
            self._slam.mask(self._masks.popleft())

    def _forget(self) -> list[Outgoing]:
        self._slam.reset()
        self._latencies.clear()
        return [self._slam.diagnostics(time_ns())]

    def _settle(self) -> list[Outgoing]:
        """Optimise at once, as no messages are waiting."""
        return [*self._slam.work(at_once=True), self._slam.diagnostics(time_ns())]

    def _node_values(self) -> dict[str, str]:
        return {'messages dropped': str(self._queue.dropped),
                'images lost on the way': str(self._lost), **self._latencies.values()}

    def _publish(self, outgoing: Sequence[Outgoing]) -> None:
        if outgoing and not self._stopping:
            self._wiring.publish(outgoing)
