"""The frame queue, with real threads."""

from threading import Thread
from time import monotonic

from djet_ros.live.frame_queue import FrameQueue
import pytest


def in_thread(function, *args):
    thread = Thread(target=function, args=args, daemon=True)
    thread.start()
    return thread


def drained(queue):
    items = []
    while (item := queue.get(timeout=0)) is not None:
        items.append(item)
    return items


def test_latest_keeps_the_newest_and_counts_drops():
    queue = FrameQueue('latest', 2)
    assert all(queue.put(i) for i in range(5))
    assert queue.dropped == 3
    assert drained(queue) == [3, 4]


def test_peek_does_not_remove():
    queue = FrameQueue('latest', 2)
    assert queue.peek() is None
    queue.put('first')
    queue.put('second')
    assert queue.peek() == queue.peek() == 'first'
    assert [queue.get(), queue.get()] == ['first', 'second']


def test_peek_waits_for_an_item_or_close():
    queue, seen = FrameQueue('latest', 2), []
    one = in_thread(lambda: seen.append(queue.peek(timeout=20)))
    queue.put('first')
    one.join(5)
    assert seen == ['first']
    queue.get()
    one = in_thread(lambda: seen.append(queue.peek(timeout=20)))
    queue.close()
    one.join(5)
    assert seen == ['first', None]
    assert queue.peek(timeout=0.01) is None


def test_every_drops_nothing_below_the_limit():
    queue, got = FrameQueue('every', 3, room=2000), []

    def read():
        while (item := queue.get()) is not None:
            got.append(item)

    reader = in_thread(read)
    for i in range(2000):
        assert queue.put(i, 1)
    queue.close()
    reader.join(5)
    assert got == list(range(2000))
    assert queue.dropped == 0


def test_concurrent_writers_and_readers_account_for_every_item():
    queue, got = FrameQueue('latest', 4), []

    def read():
        while (item := queue.get()) is not None:
            got.append(item)

    readers = [in_thread(read) for _ in range(3)]
    writers = [in_thread(lambda n=n: [queue.put(1000 * n + i) for i in range(1000)])
               for n in range(1, 5)]
    for thread in writers:
        thread.join(10)
    queue.close()
    for thread in readers:
        thread.join(10)
    assert len(got) + queue.dropped == 4000
    assert len(set(got)) == len(got)


@pytest.mark.parametrize('policy, left', [('every', [0, 1, 2, 3]), ('latest', [4, 5, 6, 7])])
def test_queued_weight_exceeds_the_limit_by_at_most_one_item(policy, left):
    queue = FrameQueue(policy, 1000, room=10)
    assert sum(queue.put(i, 3) for i in range(8)) == (4 if policy == 'every' else 8)
    assert queue.dropped == 4
    assert drained(queue) == left
    assert queue.put('again', 3)


@pytest.mark.parametrize('policy', ['latest', 'every'])
def test_item_heavier_than_the_limit_is_accepted_alone(policy):
    queue = FrameQueue(policy, 1000, room=10)
    for item in ('first', 'second'):
        assert queue.put(item, 11)
        assert queue.get() == item


def test_every_reports_a_full_queue():
    queue = FrameQueue('every', 1, room=10)
    for taken in range(5):
        assert queue.has_room
        assert queue.weight == 2 * taken
        queue.put('light', 2)
    assert not queue.has_room
    queue.get()
    assert queue.has_room


def test_latest_always_has_room():
    queue = FrameQueue('latest', 1)
    queue.put('old')
    assert queue.has_room


def test_get_times_out_on_an_empty_queue():
    start = monotonic()
    assert FrameQueue('latest', 1).get(timeout=0.05) is None
    assert monotonic() - start >= 0.05


@pytest.mark.parametrize('policy', ['latest', 'every'])
def test_close_wakes_readers_and_keeps_queued_items(policy):
    queue, answers = FrameQueue(policy, 1), []
    reader = in_thread(lambda: answers.append(queue.get()))
    queue.close()
    reader.join(5)
    assert answers == [None]
    assert not queue.put('late')

    queue = FrameQueue(policy, 2)
    queue.put('first')
    queue.close()
    assert not queue.put('second')
    assert drained(queue) == ['first']


def test_clear_makes_room():
    queue = FrameQueue('every', 2, room=4)
    queue.put(1, 2)
    queue.put(2, 2)
    assert not queue.put(3, 2)
    queue.clear()
    assert (len(queue), queue.weight, queue.dropped) == (0, 0, 1)
    assert queue.put(4, 2)
    assert drained(queue) == [4]


@pytest.mark.parametrize('policy, size', [('newest', 1), ('latest', 0)])
def test_invalid_queue_parameters_are_refused(policy, size):
    with pytest.raises(ValueError, match='queue policy'):
        FrameQueue(policy, size)
