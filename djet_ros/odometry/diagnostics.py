"""Content of diagnostics messages, from counts and the last result."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field

from djet_ros.core.types import RelativePose
from djet_ros.odometry.health import Complaint
from djet_ros.odometry.result import OdometryResult
from djet_ros.odometry.state import LEVELS, State
import numpy as np


_RANKING = ('OK', 'WARN', 'ERROR')


@dataclass
class Counts:
    """
    Counts of images: each received one is also processed, dropped or rejected.

    dropped: by reason (equal_stamp, late, ahead, waiting_for_camera_info, queue_full …);
    rejected: unusable images, by reason; rejected_infos: the same for CameraInfo messages; status:
    of the processed frames.
    """

    received: int = 0
    processed: int = 0
    dropped: Counter[str] = field(default_factory=Counter)
    rejected: Counter[str] = field(default_factory=Counter)
    rejected_infos: Counter[str] = field(default_factory=Counter)
    status: Counter[str] = field(default_factory=Counter)


@dataclass(frozen=True)
class Diagnosis:
    """Content of a DiagnosticStatus: level OK, WARN or ERROR, a one-line summary, and values."""

    level: str
    summary: str
    values: dict[str, str]


def diagnose(state: State, detail: str, counts: Counts, last: OdometryResult | None,
             rate: float | None, complaints: Sequence[Complaint] = ()) -> Diagnosis:
    """
    Return the content of a diagnostics message.

    detail: of the state, such as a status or a reason; last: the last result; rate: processed
    frames per second of their stamps; complaints: present problems.
    """
    values = {
        'state': state.value,
        'frames received': str(counts.received),
        'frames processed': str(counts.processed),
        'frames dropped': str(counts.dropped.total()),
        'frames rejected': str(counts.rejected.total()),
    }
    for what, reasons in (('frames dropped', counts.dropped), ('frames rejected', counts.rejected),
                          ('camera_info rejected', counts.rejected_infos),
                          ('status', counts.status)):
        values.update({f'{what}: {reason}': str(n) for reason, n in sorted(reasons.items())})
    if rate is not None:
        values['rate (Hz)'] = f'{rate:.2f}'
    if last is not None:
        values['scale'] = last.scale_kind.value
        if last.relative is not None:
            values.update(_pair(last.relative))
    values.update({f'to mend: {one.name}': one.text for one in complaints})
    summary = '; '.join([f'{state.value}: {detail}' if detail else state.value,
                         *(one.name for one in complaints)])
    level = max([LEVELS[state], *(one.level for one in complaints)], key=_RANKING.index)
    return Diagnosis(level, summary, values)


def _pair(relative: RelativePose) -> dict[str, str]:
    values = {'matches': str(len(relative.x)), 'inliers': str(int(relative.inliers.sum()))}
    residuals = np.abs(relative.residuals[relative.inliers])
    if residuals.size:
        values['median residual (px)'] = f'{np.median(residuals):.3f}'
    values.update({f'time of {stage} (ms)': f'{seconds * 1e3:.1f}'
                   for stage, seconds in relative.timings.items()})
    return values


class StampRate:
    """Frame rate by the stamps of the last few frames."""

    def __init__(self, frames: int = 30) -> None:
        self._stamps: deque[int] = deque(maxlen=frames)

    def add(self, stamp_ns: int) -> None:
        """Take the stamp of a frame; a step back in time discards the ones before."""
        if self._stamps and stamp_ns <= self._stamps[-1]:
            self._stamps.clear()
        self._stamps.append(stamp_ns)

    @property
    def hertz(self) -> float | None:
        """Return frames per second, None before the second frame."""
        if len(self._stamps) < 2:
            return None
        return (len(self._stamps) - 1) * 1e9 / (self._stamps[-1] - self._stamps[0])
