"""
Memory and latency of the odometry over many frames, with faults.

A rendered drive is repeated forwards and backwards; occasionally frames are black, come after a
gap, or have an earlier stamp, so that all paths through the odometry are exercised.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
import gc
from pathlib import Path
import resource
import sys
from time import perf_counter
from typing import Any

from djet_ros.config.sections import OdometryConfig
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.errors import DjetError
from djet_ros.lab.scenes.catalogue import make_scene
from djet_ros.odometry.frame import Frame
from djet_ros.odometry.visual_odometry import VisualOdometry
import numpy as np

SIZE = (416, 128)
FEATURES = 500

# Frames of the drive, rendered once; a short run uses fewer.
_DRIVE, _SHORT = 60, 8
_PERIOD_NS = 100_000_000

# Periods in frames of black images (enough in sequence to lose the keyframe), gaps, and steps back
# in time.
_BLACK, _GAP, _BACK = 97, 211, 487
_BLACK_ONES = 4

# Segments of the run that are compared. The first ones fill caches and pools.
_STRETCHES = 20


def soak(frames: int, most_growth_mb: float,
         progress: Callable[[int], None] = lambda done: None) -> dict[str, Any]:
    """
    Process a number of frames, and return the results.

    Memory is resident memory in MB. ``growth_mb`` is that at the end of the run minus the maximum
    at the segment ends of its first fifth; ``held``: whether it is at most most_growth_mb.
    ``python_blocks`` is the number of blocks allocated by the interpreter, which may grow without
    changing resident memory. Latencies are in ms, from pixels to pose. Raises DjetError if there
    are too few frames, or no /proc to read the memory from.
    """
    if frames < 5 * _STRETCHES:
        raise DjetError(f'--frames is {frames}; it must be at least {5 * _STRETCHES} to measure '
                        'growth')
    odometry = VisualOdometry(EstimatorConfig(max_features=FEATURES), OdometryConfig())
    bounds = np.linspace(0, frames, _STRETCHES + 1).astype(int)[1:].tolist()
    latency = np.empty(frames)
    status: Counter[str] = Counter()
    stretches: list[dict[str, float]] = []
    begin, started = 0, perf_counter()
    for number, frame in enumerate(_drive(frames), 1):
        before = perf_counter()
        result = odometry.process(frame)
        latency[number - 1] = 1e3 * (perf_counter() - before)
        status[result.status.value] += 1
        if number == bounds[len(stretches)]:
            # Also empties the interpreter's free lists, which count as allocated: up to 2000
            # unused tuples of each length, filled over hundreds of frames.
            gc.collect()
            stretches.append({'frames': number, 'memory_mb': resident_mb(),
                              'python_blocks': sys.getallocatedblocks(),
                              **_percentiles(latency[begin:number])})
            begin = number
            progress(number)
    seconds = perf_counter() - started
    early = max(stretch['memory_mb'] for stretch in stretches[:_STRETCHES // 5])
    growth = stretches[-1]['memory_mb'] - early
    return {'frames': frames, 'size': list(SIZE), 'features': FEATURES, 'seconds': seconds,
            'status': dict(sorted(status.items())), 'latency_ms': _percentiles(latency),
            'memory_mb': stretches[-1]['memory_mb'], 'growth_mb': growth,
            'most_growth_mb': most_growth_mb, 'held': bool(growth <= most_growth_mb),
            'stretches': stretches}


def resident_mb() -> float:
    """Return the resident memory of this process in MB; raise DjetError without /proc."""
    try:
        pages = int(Path('/proc/self/statm').read_text('ascii').split()[1])
    except OSError as error:
        raise DjetError(f'resident memory is read from /proc/self/statm: {error.strerror}; run '
                        'this on Linux') from error
    return pages * resource.getpagesize() / 1e6


def _drive(frames: int) -> Iterator[Frame]:
    """Yield frames of a drive forwards and backwards, with occasional faults."""
    scene = make_scene('road', size=SIZE)
    poses = scene.trajectory(_SHORT if frames < 10 * _DRIVE else _DRIVE)
    there = [scene.render(pose, i) for i, pose in enumerate(poses)]
    images = there + there[-2:0:-1]
    black = np.zeros_like(there[0])
    stamp = 1000 * 10**9
    for number in range(1, frames + 1):
        stamp += _PERIOD_NS
        if number % _GAP == 0:
            stamp += 10 * 10**9
        if number % _BACK == 0:
            stamp -= 60 * 10**9
        image = black if number % _BLACK < _BLACK_ONES else images[number % len(images)]
        # A copy, because each frame of a camera has its own memory.
        yield Frame(image.copy(), scene.K, stamp)


def _percentiles(latency: np.ndarray[Any, Any]) -> dict[str, float]:
    p50, p95, p99, largest = np.percentile(latency, (50, 95, 99, 100)).tolist()
    return {'p50_ms': p50, 'p95_ms': p95, 'p99_ms': p99, 'max_ms': largest}
