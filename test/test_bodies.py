"""Several bodies that move: the one that was followed is followed on, whatever the majority."""

from dataclasses import replace

from cards import Cards, K as CARDS_K, pose as card_pose
from djet_ros.core.bodies import (
    are_of_one_motion,
    continuing_motion,
    fits_followed_body,
    is_continued,
    LeftOut,
    of_followed_body,
)
from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.geometry import (
    direction_angle,
    epipolar_lines,
    fundamental,
    line_distances,
    rotation_angle,
    rotation_exp,
    unit,
)
from djet_ros.core.jet import jet_problem, JetProblem, Loss
from djet_ros.core.rivals import pose_distance, PreviousMotion
from djet_ros.core.sketch import refine_all
from djet_ros.core.surfaces import ReprojectionSurface
from djet_ros.core.types import Pose, RelativePose, Status
from djet_ros.lab.scenes.catalogue import make_scene
import numpy as np
import pytest
from two_view import K, project, SIZE

NOISE = 0.1
# Matches of the static world, of the lorry, and false ones.
STATIC, LORRY, FALSE = 400, 600, 60
AHEAD = unit(np.array([0.03, 0.0, 1.0]))


def pair_with_a_lorry(rng: np.random.Generator, left_out: np.ndarray | None = None
                      ) -> RelativePose:
    """
    Return a pair with 800 matches, the first 500 of which, in the left half, fit its motion.

    One of five does not fit there, and one of five of the lorry's, in the right half, does.
    """
    y = rng.uniform((0, 0), np.array(SIZE) * (0.5, 1), (800, 2))
    y[500:, 0] += SIZE[0] / 2
    fits = (np.arange(800) < 500) ^ (np.arange(800) % 5 == 0)
    return RelativePose(
        Status.OK, x=np.add(y, (60, 0)), y=y, inliers=fits, voting=np.ones(800, bool),
        residuals=np.where(fits, rng.normal(0, NOISE, 800), rng.choice([-2, 2], 800)),
        left_out=left_out)


def places_in_each_half(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return places more than 30 pixels from the border between the halves."""
    x = rng.uniform((0, 0), SIZE, (1000, 2))
    x = x[np.abs(x[:, 0] - SIZE[0] / 2) > 30]
    return x, x[:, 0] < SIZE[0] / 2


@pytest.mark.parametrize('seed', range(10))
def test_places_of_another_body_are_found_among_matches_that_fit_by_chance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, left = places_in_each_half(rng)
    followed = of_followed_body(pair_with_a_lorry(rng), x)
    # Of fifteen neighbours eight or more are of the wrong kind with a probability of 0.004.
    assert followed[left].mean() > 0.97
    assert followed[~left].mean() < 0.03


def test_places_that_were_left_out_come_back_once_most_fit_closely() -> None:
    rng = np.random.default_rng(0)
    x, left = places_in_each_half(rng)
    # The lorry is gone, and what it hid fits. Of normal errors, two thirds are within one
    # standard deviation, and of three that are, one that is not is as much evidence.
    pair = pair_with_a_lorry(rng, np.arange(800) >= 500)
    pair.residuals[500:] = rng.normal(0, NOISE / 2, 300)
    assert of_followed_body(pair, x)[~left].mean() > 0.8
    pair.residuals[500:] = rng.normal(0, 2 * NOISE, 300)
    assert of_followed_body(pair, x)[~left].mean() < 0.01
    # If they were not left out before, the same errors are no evidence of another body.
    assert of_followed_body(replace(pair, left_out=None), x)[~left].all()


def test_scattered_outliers_are_no_body() -> None:
    rng = np.random.default_rng(0)
    pair = pair_with_a_lorry(rng)
    pair.residuals[:] = np.where(np.arange(800) % 10 == 0, 3.0, rng.normal(0, NOISE, 800))
    assert of_followed_body(pair, pair.y).all()


@pytest.mark.parametrize(('count', 'left_out'), [(90, False), (130, True)])
def test_a_body_with_less_than_an_eighth_of_the_matches_is_not_left_out(
        count: int, left_out: bool) -> None:
    rng = np.random.default_rng(0)
    pair = pair_with_a_lorry(rng)
    pair.residuals[:] = rng.normal(0, NOISE, 800)
    of_body = np.argsort(np.linalg.norm(pair.y - pair.y[700], axis=1))[:count]
    pair.residuals[of_body] = 3.0
    assert of_followed_body(pair, pair.y[of_body[:20]]).all() != left_out


def test_a_pair_without_inliers_follows_no_body_more_than_another() -> None:
    pair = pair_with_a_lorry(np.random.default_rng(0))
    pair.inliers[:] = False
    assert of_followed_body(pair, pair.y).all()


@pytest.mark.parametrize('count', [1, 5])
def test_a_few_matches_tell_of_a_body_too(count: int) -> None:
    y = np.random.default_rng(0).uniform((0, 0), SIZE, (count, 2))
    pair = RelativePose(Status.OK, x=y, y=y, inliers=np.ones(count, bool),
                        voting=np.ones(count, bool), residuals=np.full(count, NOISE))
    assert of_followed_body(pair, y[:1] + np.arange(20).reshape(10, 2)).all()
    pair = RelativePose(Status.OK, x=y, y=y, inliers=np.arange(count) == 0,
                        voting=np.ones(count, bool), residuals=np.where(np.arange(count), 9, 0.1))
    assert len(of_followed_body(pair, y)) == count


class Overtaking:
    """
    Matches of a static world and of a lorry in the right half, which moves in about its direction.

    The lorry is slower than the camera, and its apparent motion is some degrees aside.
    """

    def __init__(self, seed: int, aside: float = 6.0, lorry: int = LORRY) -> None:
        rng = np.random.default_rng(seed)
        turn = rotation_exp(rng.normal(0, 0.003, 3))
        self.static = Pose(turn, AHEAD)
        angle = np.radians(aside)
        self.lorry = Pose(turn, rotation_exp(np.array([0, angle, 0])) @ AHEAD)
        still = rng.uniform((20, 20), np.array(SIZE) - 20, (STATIC, 2))
        box = rng.uniform((0.55 * SIZE[0], 40), (0.95 * SIZE[0], SIZE[1] - 40), (lorry, 2))
        far = rng.uniform(10, 60, STATIC)
        outside = still[:, 0] < 0.5 * SIZE[0]
        still, far = still[outside], far[outside]
        false = rng.uniform((20, 20), np.array(SIZE) - 20, (FALSE, 2))
        places = [seen_after(still, far, turn, AHEAD),
                  seen_after(box, rng.uniform(8, 12, lorry), turn, 0.5 * self.lorry.t),
                  false + rng.normal(0, 15, false.shape)]
        self.x, self.y = np.concatenate([still, box, false]), np.concatenate(places)
        self.y += rng.normal(0, NOISE, self.y.shape)
        self.of_lorry = (np.arange(len(self.x)) >= len(still)) & (
            np.arange(len(self.x)) < len(still) + lorry)
        self.of_static = np.arange(len(self.x)) < len(still)
        self.prior = Pose(rotation_exp(rng.normal(0, 0.001, 3)) @ turn, unit(
            AHEAD + rng.normal(0, 0.003, 3)))

    @property
    def problem(self) -> JetProblem:
        """Return the problem of the re-projection errors of all matches."""
        return jet_problem(K, self.x, ReprojectionSurface(self.x, self.y).fit_around(self.y))

    def fitted(self, start: Pose) -> Pose:
        """Return the pose of all matches in the basin of a start."""
        return refine_all(self.problem, [start], Loss('geman_mcclure', 3 * NOISE), 20).pose(0)

    def pair(self, pose: Pose, left_out: np.ndarray) -> RelativePose:
        """Return the pair that follows a pose, without some of its matches."""
        residuals = line_distances(epipolar_lines(fundamental(K, pose.R, pose.t), self.x), self.y)
        return RelativePose(
            Status.OK, pose.R, pose.t, x=self.x, y=self.y, residuals=residuals,
            inliers=~left_out & (np.abs(residuals) < 3 * NOISE), voting=~left_out,
            left_out=left_out)


def seen_after(x: np.ndarray, depths: np.ndarray, R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return where points at pixels x (N, 2) and some depths (N,) are seen after a motion."""
    rays = np.column_stack([x, np.ones(len(x))]) @ np.linalg.inv(K).T
    return np.asarray(project(K, rays * depths[:, None] @ R.T + t)[0])


@pytest.mark.parametrize('seed', range(10))
def test_the_motion_that_continues_is_found_behind_that_of_a_majority(seed: int) -> None:
    seen = Overtaking(seed)
    of_majority = seen.fitted(seen.lorry)
    # Far points of the static world draw it a little.
    assert pose_distance(of_majority, seen.lorry) < 0.03 < pose_distance(of_majority, seen.static)
    found = continuing_motion(seen.problem, seen.x, seen.prior, of_majority, NOISE)
    assert found is not None and pose_distance(found.pose, seen.static) < 0.005
    # The rest fits either motion, where their lines are the same.
    assert found.other[seen.of_lorry].mean() > 0.75
    assert found.other[seen.of_static].mean() < 0.05


@pytest.mark.parametrize('seed', range(10))
def test_false_matches_do_not_continue_a_motion(seed: int) -> None:
    """The camera turns off from its previous motion, and nothing else moves."""
    seen = Overtaking(seed, lorry=0)
    turned = Pose(rotation_exp(np.array([0, 0.08, 0])) @ seen.prior.R, seen.prior.t)
    assert continuing_motion(seen.problem, seen.x, turned, seen.static, NOISE) is None


@pytest.mark.parametrize('seed', range(5))
def test_a_few_matches_that_continue_a_motion_are_no_body(seed: int) -> None:
    """As leaves of a forest, when the camera turns off."""
    for matches, enough in ((25, False), (200, True)):
        seen = Overtaking(seed, lorry=matches)
        true = np.flatnonzero(seen.of_static | seen.of_lorry)
        found = continuing_motion(seen.problem.subset(true), seen.x[true], seen.lorry, seen.static,
                                  NOISE)
        assert (found is not None) == enough


@pytest.mark.parametrize('seed', range(5))
def test_a_motion_close_to_the_previous_one_continues_it(seed: int) -> None:
    seen = Overtaking(seed)
    own = seen.fitted(seen.static)
    assert continuing_motion(seen.problem, seen.x, seen.prior, own, NOISE) is None


@pytest.mark.parametrize('seed', range(5))
def test_static_matches_are_readmitted_and_those_of_a_lorry_are_not(seed: int) -> None:
    seen = Overtaking(seed)
    # A third of the static world was left out with the lorry.
    left_out = seen.of_lorry | (seen.of_static & (np.arange(len(seen.x)) % 3 == 0))
    back = LeftOut(seen.pair(seen.static, left_out), K).readmitted()
    assert not (back & ~left_out).any()
    # The others fit the motion of the lorry too, by chance.
    assert back[seen.of_static & left_out].mean() > 0.4
    assert back[seen.of_lorry].mean() < 0.05


@pytest.mark.parametrize('seed', range(5))
def test_depths_tell_that_a_lorry_was_followed_and_the_world_left_out(seed: int) -> None:
    seen = Overtaking(seed)
    of_lorry, of_static = (seen.pair(pose, ~of_it) for pose, of_it in (
        (seen.lorry, seen.of_lorry), (seen.static, seen.of_static)))
    assert LeftOut(of_lorry, K).is_world()
    assert not LeftOut(of_static, K).is_world()
    # Too few to tell.
    few = LeftOut(seen.pair(seen.lorry, np.arange(len(seen.x)) < 10), K)
    assert few.motion is None and not few.is_world()


def test_a_lorry_as_fast_as_the_camera_fits_its_motion() -> None:
    apart, alike = Overtaking(0), Overtaking(0, aside=0.0)
    assert not fits_followed_body(apart.pair(apart.static, apart.of_lorry))
    assert fits_followed_body(alike.pair(alike.static, alike.of_lorry))


def turned_by(degrees: float, claim: float) -> RelativePose:
    """Return a pair that turned to the side, with its standard deviations, both in degrees."""
    return RelativePose(
        Status.OK, rotation_exp(np.radians([0, degrees, 0])), AHEAD,
        own_covariance_5=np.radians(claim)**2 * np.eye(5))


def test_a_pair_goes_on_by_a_previous_motion_to_within_three_degrees() -> None:
    before = Pose(rotation_exp(np.zeros(3)), AHEAD)
    assert is_continued(before, turned_by(2.0, 0.1))
    assert not is_continued(before, turned_by(4.0, 0.1))
    assert not is_continued(Pose(before.R, -AHEAD), turned_by(0.0, 0.1))
    assert not is_continued(None, turned_by(0.0, 0.1))


def test_all_matches_are_of_one_motion_if_their_pose_covers_that_of_the_followed() -> None:
    alone, before = turned_by(0.0, 0.4), PreviousMotion(rotation_exp(np.zeros(3)), -AHEAD)
    assert are_of_one_motion(before, alone, turned_by(0.1, 0.05))
    # Within what the few that are followed determine, but the claim is smaller.
    assert not are_of_one_motion(before, alone, turned_by(0.3, 0.05))
    assert are_of_one_motion(before, alone, turned_by(0.3, 0.1))
    assert not are_of_one_motion(None, alone, turned_by(0.3, 0.05))
    assert not are_of_one_motion(before, alone, RelativePose(Status.TOO_FEW_MATCHES))


def test_a_previous_motion_decides_for_all_matches_but_not_for_the_followed_alone() -> None:
    for degrees, all_go_on in ((0.0, False), (0.3, True)):
        before = PreviousMotion(rotation_exp(np.radians([0, degrees, 0])), AHEAD)
        assert are_of_one_motion(
            before, turned_by(0.0, 0.02), turned_by(0.3, 0.02)) == all_go_on
        # It may be wrong, and lead a few matches.
        assert are_of_one_motion(before, turned_by(0.0, 0.3), turned_by(0.3, 0.3))
    left_open = PreviousMotion(rotation_exp(np.zeros(3)), -AHEAD, undecided=(
        Pose(rotation_exp(np.radians([0, 0.3, 0])), AHEAD),))
    assert are_of_one_motion(left_open, turned_by(0.0, 0.02), turned_by(0.3, 0.02))


@pytest.mark.slow
@pytest.mark.parametrize(('seed', 'first', 'last'), [(1, 24, 31), (24, 20, 31)])
def test_while_a_lorry_is_overtaken_the_camera_keeps_its_own_motion(seed, first, last):
    """
    The lorry moves along the same road, and has up to three quarters of the matches.

    Of the others that are left then, a third is false.
    """
    scene, estimator = make_scene('motorway', seed), TwoViewEstimator()
    poses, before, prior, shares = scene.trajectory(last + 1), None, None, []
    for index in range(first, last + 1):
        view = estimator.view(scene.render(poses[index], index), scene.K)
        if before is not None:
            prior = estimator.estimate(before, view, prior)
            truth = np.linalg.inv(poses[index]) @ poses[index - 1]
            assert prior.status is Status.OK
            assert np.degrees(rotation_angle(prior.R, truth[:3, :3])) < 0.02
            assert np.degrees(direction_angle(prior.t, truth[:3, 3])) < 0.4
            shares.append(prior.inliers.mean())
        before = view
    # Matches on the lorry are kept, as outliers.
    assert min(shares) < 0.4


def test_of_a_body_of_which_only_a_few_matches_are_left_the_others_tell_the_motion() -> None:
    cards, estimator = Cards(), TwoViewEstimator()
    before, previous, current = (cards.gray(card_pose(x)) for x in (0.0, 0.2, 0.4))
    before, previous = (estimator.view(gray, CARDS_K) for gray in (before, previous))
    prior = estimator.estimate(before, previous)
    # The pair before followed the left half; of that, now only a small part is in view.
    left = prior.y[:, 0] < 160
    prior = replace(prior, inliers=left, residuals=np.where(left, prior.residuals, 5.0))
    hidden = np.full_like(current, 128)
    hidden[:, 200:], hidden[90:110, 60:80] = current[:, 200:], current[90:110, 60:80]
    pair = estimator.estimate(previous, estimator.view(hidden, CARDS_K), prior)
    assert 0 < (pair.x[:, 0] < 160).sum() < estimator.config.min_matches
    assert pair.status is Status.OK
    assert direction_angle(pair.t, np.array([-1.0, 0, 0])) < 0.01
