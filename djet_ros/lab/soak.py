"""
How memory and latency hold over many frames, with everything that may go wrong on the way.

A rendered drive is driven to and fro without end; now and then a frame is black, comes after a
gap, or comes with a stamp of the past, so that every way through the odometry is soaked.
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

# Frames of the drive, which are rendered once; short soaks need fewer.
_DRIVE, _SHORT = 60, 8
_PERIOD_NS = 100_000_000

# Every so many frames: black ones (enough of them to lose the reference), gaps, steps back.
_BLACK, _GAP, _BACK = 97, 211, 487
_BLACK_ONES = 4

# Stretches of the run that are compared with one another. The first fills caches and pools.
_STRETCHES = 20


def soak(frames: int, most_growth_mb: float,
         progress: Callable[[int], None] = lambda done: None) -> dict[str, Any]:
    """
    Process so many frames, and give the figures.

    Memory is resident memory in MB. ``growth_mb`` is that at the end of the run over the highest
    at the ends of its stretches up to a fifth of it; ``held`` tells whether it stayed below
    most_growth_mb. ``python_blocks`` are the interpreter's small pieces of memory, which may grow
    unseen within what is resident. Latencies are in ms, of a whole frame from pixels to pose.
    Raises DjetError where there are too few frames to tell, or no /proc to read memory from.
    """
    if frames < 5 * _STRETCHES:
        raise DjetError(f'{frames} frames are too few to tell growth; give {5 * _STRETCHES}')
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
            # This empties the interpreter's free lists too: up to 2000 tuples of each length
            # that nobody uses any more, but that are counted, and fill up over hundreds of frames.
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
    """Resident memory of this process; DjetError where the system does not tell it."""
    try:
        pages = int(Path('/proc/self/statm').read_text('ascii').split()[1])
    except OSError as error:
        raise DjetError(f'resident memory is read from /proc/self/statm: {error.strerror}; run '
                        'this on Linux') from error
    return pages * resource.getpagesize() / 1e6


def _drive(frames: int) -> Iterator[Frame]:
    """Frames of a drive to and fro, with what goes wrong now and then."""
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
        # A copy, as each frame of a camera has memory of its own.
        yield Frame(image.copy(), scene.K, stamp)


def _percentiles(latency: np.ndarray[Any, Any]) -> dict[str, float]:
    p50, p95, p99, largest = np.percentile(latency, (50, 95, 99, 100)).tolist()
    return {'p50_ms': p50, 'p95_ms': p95, 'p99_ms': p99, 'max_ms': largest}
