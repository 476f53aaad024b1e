"""Time that a live node waits, by its clock or by the machine's."""

from __future__ import annotations

from time import sleep

from djet_ros.live.stopwatch import elapsed, Moment, Stopwatch
import pytest


@pytest.mark.parametrize('machine, node, passed', [
    (1.0, 0.25, 0.25),  # a bag that is played slowly
    (1.0, 10.0, 1.0),  # one that is played fast: its messages still have to arrive
    (1.0, -5.0, 1.0),  # a bag that starts again, or a system clock that is set back
])
def test_the_clock_that_has_advanced_less_counts(machine, node, passed):
    start, end = Moment(100.0, 50 * 10**9), Moment(100 + machine, int((50 + node) * 1e9))
    assert elapsed(start, end) == pytest.approx(passed)


def test_a_wait_ends_when_both_clocks_have_passed_it():
    clock = [0]
    stopwatch = Stopwatch(lambda: clock[0])
    start = stopwatch.now()
    assert 0 < stopwatch.left(start, 0.05) <= 0.05
    sleep(0.06)
    assert 0 < stopwatch.left(start, 0.05) < 0.05
    clock[0] = 50_000_000
    assert stopwatch.left(start, 0.05) <= 0


def test_a_clock_that_does_not_advance_holds_nothing_up_for_long():
    stopwatch = Stopwatch(lambda: 0)
    start = stopwatch.now()
    sleep(1)
    assert stopwatch.left(start, 0.05) > 0
    sleep(1.2)
    assert stopwatch.left(start, 0.05) <= 0
    assert stopwatch.left(stopwatch.now(), 0.05) > 0.04
    sleep(0.06)
    assert stopwatch.left(start, 0.05) <= 0
