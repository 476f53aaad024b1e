"""State of the odometry, as diagnostics and logs report it."""

from __future__ import annotations

from enum import StrEnum, unique

from djet_ros.core.types import STARTED, TRACKED
from djet_ros.odometry.result import OdometryResult


@unique
class State(StrEnum):
    """State of the odometry."""

    WAITING_FOR_CAMERA_INFO = 'waiting for camera_info'
    WAITING_FOR_IMAGE = 'waiting for an image'
    STARTED = 'started'
    RESTARTED = 'restarted'
    TRACKING = 'tracking'
    STATIONARY = 'standing still'
    BAD_PAIR = 'bad pair'
    LOST = 'lost'
    REJECTING = 'message rejected'
    PAUSED = 'paused'


LEVELS = {
    State.WAITING_FOR_CAMERA_INFO: 'WARN', State.WAITING_FOR_IMAGE: 'WARN', State.STARTED: 'OK',
    State.RESTARTED: 'WARN', State.TRACKING: 'OK', State.STATIONARY: 'OK', State.BAD_PAIR: 'WARN',
    State.LOST: 'ERROR', State.REJECTING: 'ERROR', State.PAUSED: 'WARN',
}


class StateMachine:
    """
    The state that follows from the newest message, with a detail such as a status or a reason.

    During a pause it is PAUSED; the state without the pause is kept up to date.
    """

    def __init__(self) -> None:
        self.paused = False
        self._bad_pairs = 0
        self._state, self._detail = State.WAITING_FOR_CAMERA_INFO, ''

    @property
    def state(self) -> State:
        """Return the state."""
        return State.PAUSED if self.paused else self._state

    @property
    def detail(self) -> str:
        """Return the detail of the state; empty during a pause."""
        return '' if self.paused else self._detail

    @property
    def key(self) -> tuple[str, str]:
        """Return state and detail to compare; the detail also during a pause."""
        return self.state.value, self._detail

    def reset(self) -> None:
        """Forget the bad pairs in a row."""
        self._bad_pairs = 0

    def enter(self, state: State, detail: str = '') -> None:
        """Set the state."""
        self._state, self._detail = state, detail

    def processed(self, result: OdometryResult, *, first: bool, max_lost: int) -> None:
        """
        Enter the state after a result.

        first: whether it is the first one; max_lost: bad pairs in a row from which on the
        odometry is lost.
        """
        status = result.status
        if status not in TRACKED and status not in STARTED:
            self._bad_pairs += 1
            self.enter(State.LOST if self._bad_pairs >= max_lost else State.BAD_PAIR, status.value)
            return
        self._bad_pairs = 0
        if status in TRACKED:
            self.enter(State.STATIONARY if result.stationary else State.TRACKING)
        elif first:
            self.enter(State.STARTED)
        else:
            self.enter(State.RESTARTED, status.value)
