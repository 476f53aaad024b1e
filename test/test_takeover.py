"""Another body that takes over the view is not taken for the world."""

from dataclasses import replace

from djet_ros.core.types import RelativePose, Status, TRACKED
from djet_ros.lab.scenes import make_scene
from djet_ros.odometry.frame import Frame
from djet_ros.odometry.standstill import Standstill
from djet_ros.odometry.takeover import Takeover
from djet_ros.odometry.visual_odometry import VisualOdometry
import numpy as np
import pytest

SECOND_NS = 10**9
AHEAD, ASIDE = np.array([0, 0, -1.0]), np.array([-1.0, 0, 0])
WORLD, LORRY = (np.random.default_rng(seed).uniform(0, 400, (400, 2)) for seed in (0, 1))


def pair(places, t=AHEAD, status=Status.OK):
    """Return a pair of a motion that leaves its points at the same pixels, known to 0.01 rad."""
    return RelativePose(status, t=t, x=places, y=places, y_opt=places,
                        inliers=np.ones(len(places), bool), covariance_5=1e-4 * np.eye(5))


def mixed(share):
    """Return points of which a share is of the world, and the rest of the lorry."""
    known = round(share * len(WORLD))
    return np.concatenate([WORLD[:known], LORRY[known:]])


def moving():
    takeover = Takeover(Standstill())
    takeover.take(pair(WORLD), 0)
    return takeover


@pytest.mark.parametrize(('share', 'status'), [
    (0.0, Status.TWO_MOTIONS), (0.1, Status.TWO_MOTIONS), (0.25, Status.OK), (1.0, Status.OK)])
def test_another_motion_is_doubted_if_hardly_a_point_is_of_the_world_before(share, status):
    judged = moving().judged(pair(WORLD), pair(mixed(share), ASIDE), 0)
    assert judged.status is status


def test_a_motion_that_goes_on_is_believed_whatever_it_sees():
    """After a door, or a bend, all points may be new."""
    sideways = AHEAD + 0.3 * ASIDE
    for t in AHEAD, sideways / np.linalg.norm(sideways):
        assert moving().judged(pair(WORLD), pair(LORRY, t), 0).status is Status.OK


def test_a_direction_that_is_hardly_known_is_no_other_motion():
    """As of a hand that turns fast, whose points leave the view."""
    vague = replace(pair(LORRY, ASIDE), covariance_5=0.5**2 * np.eye(5))
    assert moving().judged(pair(WORLD), vague, 0).status is Status.OK
    # But it does not end the doubt about others.
    takeover = moving()
    assert takeover.judged(pair(WORLD), pair(LORRY, ASIDE), 0).status is Status.TWO_MOTIONS
    assert takeover.judged(pair(LORRY), vague, SECOND_NS).status is Status.OK
    takeover.take(vague, SECOND_NS)
    later = takeover.judged(vague, pair(LORRY, ASIDE), 2 * SECOND_NS)
    assert later.status is Status.TWO_MOTIONS


def test_what_follows_is_doubted_until_the_motion_goes_on_or_for_three_seconds():
    takeover = moving()
    assert takeover.judged(pair(WORLD), pair(LORRY, ASIDE), 0).status is Status.TWO_MOTIONS
    doubted = pair(LORRY, ASIDE, Status.TWO_MOTIONS)
    for status, t in (Status.OK, ASIDE), (Status.NO_PARALLAX, np.zeros(3)):
        judged = takeover.judged(doubted, pair(LORRY, t, status), SECOND_NS)
        assert judged.status is Status.TWO_MOTIONS
    assert takeover.judged(doubted, pair(WORLD), 2 * SECOND_NS).status is Status.OK
    assert takeover.judged(doubted, pair(LORRY, ASIDE), 3 * SECOND_NS).status is Status.OK


def test_a_bad_pair_of_other_points_lets_the_next_be_doubted():
    takeover, bad = moving(), pair(LORRY, AHEAD, Status.AMBIGUOUS)
    assert takeover.judged(pair(WORLD), bad, 0) is bad
    assert takeover.judged(bad, pair(LORRY, ASIDE), 1).status is Status.TWO_MOTIONS


def test_after_a_standstill_only_points_that_stood_still_move_with_the_world():
    for seen, status in (WORLD, Status.OK), (LORRY, Status.TWO_MOTIONS):
        standstill = Standstill()
        takeover = Takeover(standstill)
        standstill.stay(pair(WORLD, np.zeros(3), Status.NO_PARALLAX), 1.0)
        takeover.stay()
        assert takeover.judged(None, pair(seen, ASIDE), 0).status is status


def test_without_a_motion_before_nothing_is_doubted():
    takeover = Takeover(Standstill())
    assert takeover.judged(None, pair(LORRY, ASIDE), 0).status is Status.OK
    assert takeover.judged(pair(WORLD), pair(LORRY, ASIDE), 0).status is Status.OK
    takeover = moving()
    takeover.forget()
    assert takeover.judged(pair(WORLD), pair(LORRY, ASIDE), 0).status is Status.OK


def test_a_lorry_that_fills_the_view_of_a_driving_car_is_not_followed():
    """It passes from right to left, so that the car would seem to move to the right."""
    scene, odometry, results = make_scene('traffic', 22, (620, 188)), VisualOdometry(), []
    start = scene.trajectory(1)[0]
    for index in range(90, 106):
        pose = start.copy()
        pose[:3, 3] += start[:3, :3] @ [0, 0, 0.3 * (index - 90)]
        results.append(odometry.process(
            Frame(scene.render(pose, index), scene.K, 10**9 + index * 10**8)))
    assert Status.TWO_MOTIONS in [result.status for result in results]
    for result in results:
        aside, _, ahead = result.motion[:3, 3]
        if result.status in TRACKED and abs(aside) > 0.1 * ahead:
            # As both fill the view a pair may be vague, and says so.
            assert np.linalg.eigvalsh(result.relative.covariance_5[3:, 3:])[-1] > 0.1**2
