"""Parallel execution gives the same results as sequential execution."""

from __future__ import annotations

from collections.abc import Iterator
from threading import Barrier, BrokenBarrierError, Event, get_ident

import cv2
from djet_ros.core.parallel import map_parallel, run_both, start_in_background
import pytest


@pytest.fixture(params=[1, 2])
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    before = cv2.getNumThreads()
    cv2.setNumThreads(request.param)
    yield request.param
    cv2.setNumThreads(before)


@pytest.mark.parametrize('count', [0, 1, 2, 7])
def test_results_are_in_the_order_of_the_tasks(threads: int, count: int) -> None:
    assert map_parallel(lambda task: task**2, range(count)) == [task**2 for task in range(count)]


def test_two_functions_run_in_parallel_if_opencv_may_use_two_threads(threads: int) -> None:
    meeting = Barrier(2)

    def meet() -> int:
        meeting.wait(20 if threads == 2 else 0.05)
        return get_ident()

    if threads == 1:
        with pytest.raises(BrokenBarrierError):
            run_both(meet, meet)
    else:
        here, there = run_both(meet, meet)
        assert here == get_ident() != there


@pytest.mark.parametrize('bad', [0, 1])
def test_an_error_in_either_function_is_raised(threads: int, bad: int) -> None:
    with pytest.raises(ZeroDivisionError):
        run_both(lambda: 1 // bad, lambda: 1 // (1 - bad))


def test_nested_tasks_do_not_deadlock(threads: int) -> None:
    def count(depth: int) -> int:
        return 1 if depth == 0 else sum(run_both(lambda: count(depth - 1),
                                                 lambda: count(depth - 1)))

    assert count(6) == 2**6


def test_a_background_task_runs_before_its_result_is_requested(threads: int) -> None:
    done = Event()
    wait_for_it = start_in_background(lambda: done.set() or get_ident())
    assert done.wait(20 if threads == 2 else 0.05) is (threads == 2)
    assert (wait_for_it() == get_ident()) is (threads == 1)


def test_an_error_in_a_background_task_is_raised_on_request(threads: int) -> None:
    later = start_in_background(lambda: 1 // 0)
    with pytest.raises(ZeroDivisionError):
        later()


def test_a_background_task_uses_one_thread_only(threads: int) -> None:
    here, there = start_in_background(lambda: run_both(get_ident, get_ident))()
    assert here == there


def test_more_background_tasks_than_threads_complete(threads: int) -> None:
    later = [start_in_background(lambda number=number: number**2) for number in range(40)]
    assert [one() for one in later] == [number**2 for number in range(40)]
