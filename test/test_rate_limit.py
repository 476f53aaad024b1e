"""ros.max_rate: which images are taken, by their stamps alone."""

from itertools import pairwise

from djet_ros.live.rate_limit import RateLimit
import numpy as np
import pytest

SECOND = 10**9


def taken(limit, stamps):
    """Return the stamps of the images that are accepted."""
    return [stamp for stamp in stamps if limit.takes(stamp)]


def camera(hertz, seconds=20, jitter=0.0, start=0):
    """Return stamps (ns) of a camera, each off by up to a share of the period."""
    count = int(hertz * seconds)
    off = np.random.default_rng(0).uniform(-jitter, jitter, count)
    return [start + round((i + off[i] + 1) * SECOND / hertz) for i in range(count)]


@pytest.mark.parametrize(('comes', 'most'), [(60, 20), (60, 25), (60, 59), (90, 10), (33, 2)])
@pytest.mark.parametrize('jitter', [0.0, 0.3])
def test_a_fast_camera_gives_as_many_images_as_are_asked_for(comes, most, jitter):
    stamps = taken(RateLimit(most), camera(comes, jitter=jitter))
    # a little less where an uneven camera is hardly faster
    least = 0.9 if jitter else 0.98
    assert least * 20 * most - 2 <= len(stamps) <= 20 * most + 1
    # never two where there should be one
    assert all(after - before > 0.4 * SECOND / most for before, after in pairwise(stamps))


@pytest.mark.parametrize('comes', [5, 29.9, 30])
def test_a_camera_that_is_no_faster_loses_nothing_though_its_stamps_are_not_even(comes):
    stamps = camera(comes, jitter=0.2)
    assert taken(RateLimit(30), stamps) == stamps


def test_as_it_stands_every_image_is_taken():
    stamps = [0, 1, 2, 2, 1, 0, 10**18]
    assert taken(RateLimit(0.0), stamps) == stamps


def test_stamps_that_go_back_start_anew():
    limit = RateLimit(10)
    late, early = camera(60, 2, start=100 * SECOND), camera(60, 2)
    assert taken(RateLimit(10), early) == taken(limit, early)
    taken(limit, late)
    assert taken(limit, early) == taken(RateLimit(10), early)


@pytest.mark.parametrize('behind', [0.02, 0.4])
def test_a_stream_out_of_order_gives_no_more_images_than_one_in_order(behind):
    there, here = camera(30), camera(30, start=round(-behind * SECOND))
    crossed = [stamp for pair in zip(there, here) for stamp in pair]
    assert len(taken(RateLimit(10, max_backwards=0.5), crossed)) <= 20 * 10 + 1


def test_stamps_that_stay_back_a_little_start_anew():
    limit = RateLimit(10, max_backwards=3600.0)
    taken(limit, camera(10, 60))
    assert len(taken(limit, camera(10, 30))) > 280


def test_an_image_that_was_ahead_brings_no_time_twice():
    ahead = [stamp + (3 * SECOND // 5 if i == 30 else 0) for i, stamp in enumerate(camera(30))]
    limit = RateLimit(10, max_backwards=0.5, max_gap=1.0)
    assert len(taken(limit, ahead)) <= 20 * 10 + 1


def test_who_begins_an_image_later_takes_others_for_good():
    """So a pose graph keeps all images: by a limit of its own none may be the odometry's."""
    stamps = camera(60)
    assert set(taken(RateLimit(20), stamps)).isdisjoint(taken(RateLimit(20), stamps[1:]))


def test_after_a_pause_of_hours_no_more_come_than_before():
    limit = RateLimit(10)
    first = len(taken(limit, camera(60, 5)))
    assert len(taken(limit, camera(60, 5, start=3600 * SECOND))) <= first + 1


def test_images_of_one_stamp_share_its_fate():
    limit = RateLimit(10)
    assert [limit.takes(stamp) for stamp in (0, 0, 0, SECOND // 100, SECOND // 100)] == [
        True, True, True, False, False]
