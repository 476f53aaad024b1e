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
def test_fast_camera_is_limited_to_the_rate(comes, most, jitter):
    stamps = taken(RateLimit(most), camera(comes, jitter=jitter))
    # a little less where an uneven camera is hardly faster
    least = 0.9 if jitter else 0.98
    assert least * 20 * most - 2 <= len(stamps) <= 20 * most + 1
    # never two where there should be one
    assert all(after - before > 0.4 * SECOND / most for before, after in pairwise(stamps))


@pytest.mark.parametrize('comes', [5, 29.9, 30])
def test_camera_at_the_limit_loses_no_image_despite_jitter(comes):
    stamps = camera(comes, jitter=0.2)
    assert taken(RateLimit(30), stamps) == stamps


def test_default_accepts_every_image():
    stamps = [0, 1, 2, 2, 1, 0, 10**18]
    assert taken(RateLimit(0.0), stamps) == stamps


def test_stamps_that_go_back_reset_the_limit():
    limit = RateLimit(10)
    late, early = camera(60, 2, start=100 * SECOND), camera(60, 2)
    assert taken(RateLimit(10), early) == taken(limit, early)
    taken(limit, late)
    assert taken(limit, early) == taken(RateLimit(10), early)


@pytest.mark.parametrize('behind', [0.02, 0.4])
def test_out_of_order_stream_gives_no_more_images(behind):
    there, here = camera(30), camera(30, start=round(-behind * SECOND))
    crossed = [stamp for pair in zip(there, here) for stamp in pair]
    assert len(taken(RateLimit(10, max_backwards=0.5), crossed)) <= 20 * 10 + 1


def test_stamps_that_stay_back_reset_the_limit():
    limit = RateLimit(10, max_backwards=3600.0)
    taken(limit, camera(10, 60))
    assert len(taken(limit, camera(10, 30))) > 280


def test_image_stamped_ahead_does_not_add_time_twice():
    ahead = [stamp + (3 * SECOND // 5 if i == 30 else 0) for i, stamp in enumerate(camera(30))]
    limit = RateLimit(10, max_backwards=0.5, max_gap=1.0)
    assert len(taken(limit, ahead)) <= 20 * 10 + 1


def test_selection_depends_on_the_first_image():
    """So a pose graph keeps all images: by a limit of its own none may be the odometry's."""
    stamps = camera(60)
    assert set(taken(RateLimit(20), stamps)).isdisjoint(taken(RateLimit(20), stamps[1:]))


def test_long_pause_does_not_allow_a_burst():
    limit = RateLimit(10)
    first = len(taken(limit, camera(60, 5)))
    assert len(taken(limit, camera(60, 5, start=3600 * SECOND))) <= first + 1


def test_repeated_stamps_are_treated_alike():
    limit = RateLimit(10)
    assert [limit.takes(stamp) for stamp in (0, 0, 0, SECOND // 100, SECOND // 100)] == [
        True, True, True, False, False]
