"""The ground under the camera: translation, uncertainty, and when there is no estimate."""

from dataclasses import replace
from itertools import pairwise

from cards import Cards, K as CARDS_K, pose, REST
import cv2
from djet_ros.config.flat import from_flat
from djet_ros.config.sections import OdometryConfig
from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.geometry import rotation_exp, unit
from djet_ros.core.ground import Ground, rotate_tilt
from djet_ros.core.masks import blocked
from djet_ros.core.types import RelativePose, Status, View
from djet_ros.lab.scenes import make_scene
from djet_ros.odometry.frame import Frame
from djet_ros.odometry.scale import CameraHeightScale
from djet_ros.odometry.tracker import Tracker
from djet_ros.odometry.visual_odometry import VisualOdometry
from djet_ros.recordings.decoding import message_type
from djet_ros.recordings.kitti import KittiSequence
import numpy as np
import pytest

K = np.array([[300.0, 0, 199.5], [0, 300.0, 79.5], [0, 0, 1]])
SIZE = (400, 200)
HEIGHT = 1.5


class Floor:
    """A flat floor of one texture without end, seen from HEIGHT metres, and nothing else."""

    def __init__(self, seed=0):
        rng = np.random.default_rng(seed)
        texture = sum(cv2.resize(rng.normal(0, size, (1024 // grain,) * 2), (1024, 1024))
                      for grain, size in ((2, 8.0), (4, 12.0), (16, 20.0)))
        self._texture = np.clip(128 + texture, 0, 255).astype(np.float32)

    def gray(self, pitch=0.0, x=0.0, z=0.0, yaw=0.0, seed=None, height=HEIGHT):
        """Image from a camera at (x, z) that looks down by pitch and to the right by yaw."""
        v, u = np.mgrid[:SIZE[1], :SIZE[0]].astype(float)
        rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T
        rays = rays @ floor_pose(pitch, yaw=yaw)[:3, :3].T
        below, aside, along = self._met(rays, height)
        # 2 cm a pixel
        places = [((at + metres) / 0.02 % 1024).astype(np.float32)
                  for at, metres in ((x, aside), (z, along))]
        image = np.where(below, cv2.remap(self._texture, *places, cv2.INTER_LINEAR,
                                          borderMode=cv2.BORDER_WRAP), 200.0)
        if seed is not None:
            image = image + np.random.default_rng(seed).normal(0, 2, image.shape)
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)

    def _met(self, rays, height):
        """Which rays meet the floor, and how far aside and along it."""
        below = rays[..., 1] > 0.02
        reach = height / np.where(below, rays[..., 1], 1.0)
        return below, reach * rays[..., 0], reach * rays[..., 2]


class Hill(Floor):
    """A floor that is round from front to back: a crest, or a hollow where radius is negative."""

    def __init__(self, radius):
        super().__init__()
        self._radius = radius

    def _met(self, rays, height):
        """Where rays meet a cylinder below; arcs are lengths along it."""
        centre = height + self._radius
        squares, down = (rays[..., 1:]**2).sum(-1), rays[..., 1] * centre
        root = down**2 - squares * (centre**2 - self._radius**2)
        below = (rays[..., 1] > 0.02) & (root > 0)
        reach = (down - np.sign(self._radius) * np.sqrt(np.maximum(root, 0.0))) / squares
        arc = np.arctan(reach * rays[..., 2] / (centre - reach * rays[..., 1]))
        return below, reach * rays[..., 0], self._radius * arc

    def motion(self, metres):
        """Motion of a camera that goes so far along the ground, as that turns it."""
        angle, centre = metres / self._radius, HEIGHT + self._radius
        after = floor_pose(angle, z=centre * np.sin(angle))
        after[1, 3] = centre * (1 - np.cos(angle))
        return moved(floor_pose(0.0), after)


def floor_pose(pitch, x=0.0, z=0.0, yaw=0.0):
    """Camera in the floor's axes: x right, y down, z forward."""
    result = np.eye(4)
    result[:3, :3] = rotation_exp(np.array([0.0, yaw, 0.0])) @ rotation_exp(
        np.array([-pitch, 0.0, 0.0]))
    result[:3, 3] = x, 0.0, z
    return result


def moved(before, after, sigma=1e-3):
    """Return the true motion between two camera poses, as sure as is said."""
    M = np.linalg.inv(after) @ before
    return RelativePose(Status.OK, M[:3, :3], unit(M[:3, 3]), np.eye(5) * sigma**2)


def view(gray):
    return View(gray, K, None, None, None)


@pytest.fixture(scope='module')
def floor():
    return Floor()


# One pair

@pytest.mark.parametrize('metres', [0.15, 0.8, 1.5])
@pytest.mark.parametrize(('pitch', 'turn'), [(0.0, 0.0), (0.3, 0.0), (0.0, 0.05)])
def test_the_translation_is_measured_in_camera_heights(floor, metres, pitch, turn):
    heading = np.array([np.sin(turn / 2), np.cos(turn / 2)]) * metres
    motion = moved(floor_pose(pitch), floor_pose(pitch, *heading, yaw=turn))
    seen = Ground(K, SIZE[::-1], pitch).motion(
        view(floor.gray(pitch, seed=1)),
        view(floor.gray(pitch, *heading, yaw=turn, seed=2)), motion)
    off, sigmas = seen.value - [metres / HEIGHT, pitch, 0.0], np.sqrt(np.diag(seen.covariance))
    assert (np.abs(off) < 3 * sigmas).all()
    assert (sigmas < [0.05 * metres / HEIGHT, np.radians(1), np.radians(1)]).all()


def test_the_ground_is_looked_for_once_in_images_of_a_size_and_anew_in_others(floor):
    scale, gray = CameraHeightScale(HEIGHT, 0.0), floor.gray()
    found = [scale._ground_of(view(image)) for image in (gray, gray.copy(), gray[:150], gray)]
    assert found[0] is found[1]
    assert found[2] is not found[1] and found[3] is not found[2]


def test_the_pitch_may_be_slightly_wrong(floor):
    pitch = np.radians(1.5)
    motion = moved(floor_pose(pitch), floor_pose(pitch, z=0.8))
    seen = Ground(K, SIZE[::-1], 0.0).motion(
        view(floor.gray(pitch)), view(floor.gray(pitch, z=0.8)), motion)
    assert seen.value[0] == pytest.approx(0.8 / HEIGHT, rel=0.02)
    assert seen.value[1] == pytest.approx(pitch, abs=np.radians(0.5))


@pytest.mark.slow
def test_the_covariance_of_one_pair_is_consistent_over_many():
    """Other floors, other noise, and motions that are off by as much as they say."""
    rng, ground, errors = np.random.default_rng(3), Ground(K, SIZE[::-1], 0.0), []
    sigma = 4e-3
    for seed in range(40):
        floor, metres = Floor(seed), rng.uniform(0.4, 1.6)
        motion = moved(floor_pose(0.0), floor_pose(0.0, z=metres), sigma)
        off = rng.normal(0, sigma, 5)
        motion = RelativePose(Status.OK, rotation_exp(off[:3]) @ motion.R,
                              unit(motion.t + np.array([*off[3:], 0.0])), motion.covariance_5)
        seen = ground.motion(view(floor.gray(seed=2 * seed)),
                             view(floor.gray(z=metres, seed=2 * seed + 1)), motion)
        off = seen.value - [metres / HEIGHT, 0.0, 0.0]
        errors.append(off @ np.linalg.solve(seen.covariance, off))
    # three are expected of each; the inflation is for real roads
    assert 0.5 < np.mean(errors) < 4.5
    assert np.max(errors) < 25


def test_less_texture_gives_a_larger_covariance(floor):
    sigmas = []
    for contrast in (1.0, 0.05):
        before, after = (
            np.clip(128 + contrast * (floor.gray(z=z).astype(float) - 128)
                    + np.random.default_rng(int(10 * z)).normal(0, 2, SIZE[::-1]), 0, 255
                    ).astype(np.uint8) for z in (0.0, 0.8))
        seen = Ground(K, SIZE[::-1], 0.0).motion(
            view(before), view(after), moved(floor_pose(0.0), floor_pose(0.0, z=0.8)))
        if seen is not None:
            sigmas.append(np.sqrt(seen.covariance[0, 0]))
    assert len(sigmas) == 1 or sigmas[1] > 2 * sigmas[0]


def test_ground_without_texture_gives_no_estimate():
    plain = [np.random.default_rng(seed).normal(120, 1, SIZE[::-1]).astype(np.uint8)
             for seed in (1, 2)]
    assert Ground(K, SIZE[::-1], 0.0).motion(
        *map(view, plain), moved(floor_pose(0.0), floor_pose(0.0, z=0.8))) is None


@pytest.mark.parametrize('step', [pose(x=0.5), pose(z=1.5), pose(x=0.3, z=-0.8),
                                  pose(x=0.5, yaw=0.03), pose(x=-0.2, z=1.0)])
def test_a_wall_is_not_taken_for_ground(step):
    """One card, twelve metres ahead."""
    wall, estimator = Cards(), TwoViewEstimator()
    del wall._cards[1:]
    views = [estimator.view(wall.gray(at, noise=i), CARDS_K) for i, at in enumerate((REST, step))]
    for motion in (moved(REST, step), estimator.estimate(*views)):
        assert Ground(CARDS_K, (240, 320), 0.0).motion(*views, motion) is None


def test_objects_that_move_with_the_camera_are_not_taken_for_ground(floor):
    """A bonnet, or the shadow of the car itself: the same pixels in both images."""
    before, after = floor.gray(), floor.gray(z=0.8, seed=3)
    after[100:] = before[100:]
    assert Ground(K, SIZE[::-1], 0.0).motion(
        view(before), view(after), moved(floor_pose(0.0), floor_pose(0.0, z=0.8))) is None


def test_masked_pixels_are_ignored_and_the_rest_suffices(floor):
    """The right half of the picture moves with the camera; each image has a mask of its own."""
    before, after = floor.gray(seed=1), floor.gray(z=0.8, seed=2)
    before[:, 200:] = after[:, 200:] = floor.gray(seed=3)[:, 200:]
    mask = np.zeros(SIZE[::-1], bool)
    mask[:, 200:] = True
    motion = moved(floor_pose(0.0), floor_pose(0.0, z=0.8))
    ground = Ground(K, SIZE[::-1], 0.0)
    for masked in ((True, True), (True, False), (False, True)):
        seen = ground.motion(*(replace(view(gray), mask=blocked(mask) if one else None)
                               for gray, one in zip((before, after), masked)), motion)
        if all(masked):
            assert abs(seen.value[0] - 0.8 / HEIGHT) < 3 * np.sqrt(seen.covariance[0, 0])
    assert ground.motion(view(before), view(after), motion) is None


def test_a_camera_that_sees_no_ground_gives_no_estimate(floor):
    upwards = Ground(K, SIZE[::-1], np.radians(-30.0))
    assert not upwards.is_in_view
    assert upwards.motion(view(floor.gray()), view(floor.gray(z=0.8)),
                          moved(floor_pose(0.0), floor_pose(0.0, z=0.8))) is None


@pytest.mark.parametrize('size', [(1, 1), (20, 20), (40, 30)])
def test_an_image_too_small_for_the_ground_gives_no_estimate(size):
    assert not Ground(K, size, 0.0).is_in_view


def test_two_equal_images_of_a_moving_camera_give_no_estimate(floor):
    views = [view(floor.gray())] * 2
    assert Ground(K, SIZE[::-1], 0.0).motion(
        *views, moved(floor_pose(0.0), floor_pose(0.0, z=0.8))) is None


def test_a_pure_rotation_is_zero_translation(floor):
    R = np.linalg.inv(floor_pose(0.0, yaw=0.05)) @ floor_pose(0.0)
    seen = Ground(K, SIZE[::-1], 0.0).motion(
        view(floor.gray(seed=1)), view(floor.gray(yaw=0.05, seed=2)),
        RelativePose(Status.NO_PARALLAX, R[:3, :3]))
    assert seen.value[0] == 0.0
    assert np.sqrt(seen.covariance[0, 0]) < 0.05


def test_an_unknown_motion_is_zero_only_if_the_ground_is_at_the_same_place(floor):
    """A lorry fills the rest of the image, say, and the camera moves ten centimetres."""
    unknown = RelativePose(Status.TOO_FEW_MATCHES)
    ground, before = Ground(K, SIZE[::-1], 0.0), view(floor.gray(seed=1))
    still, moves = (ground.motion(before, view(floor.gray(z=z, seed=2)), unknown)
                    for z in (0.0, 0.1))
    assert still.value[0] == 0.0 and moves is None


@pytest.mark.parametrize('metres', [0.2, 0.8])
@pytest.mark.parametrize('tile', [15, 25, 40])
def test_a_floor_of_equal_tiles_gives_no_estimate(tile, metres):
    """It looks the same after any number of tiles, of 30 to 80 cm."""
    floor = Floor()
    floor._texture = np.tile(floor._texture[:tile], (1024 // tile + 1, 1))[:1024]
    views = [view(floor.gray(z=z, seed=i)) for i, z in enumerate((0.0, metres))]
    assert Ground(K, SIZE[::-1], 0.0).motion(
        *views, moved(floor_pose(0.0), floor_pose(0.0, z=metres))) is None


def test_what_is_beside_the_lane_or_far_ahead_is_not_taken_for_ground(floor):
    """Beyond one and a half heights to either side, or six ahead, anything else may move."""
    ground, motion = Ground(K, SIZE[::-1], 0.0), moved(floor_pose(0.0), floor_pose(0.0, z=0.8))
    v, u = np.mgrid[:SIZE[1], :SIZE[0]] - np.array([79.5, 199.5])[:, None, None]
    lane = (v > 300.0 / 6) & (np.abs(u) < 1.5 * v)
    # Contrast is measured around each pixel, by means of means over 25 of them.
    lane = cv2.dilate(lane.astype(np.uint8), np.ones((65, 65))).astype(bool)
    assert lane.mean() < 0.7
    found = []
    for others in (0, 5, 6):
        before, after = floor.gray(seed=1), floor.gray(z=0.8, seed=2)
        if others:
            before[~lane] = after[~lane] = Floor(others).gray()[~lane]
        found.append(ground.motion(view(before), view(after), motion))
    for one in found[1:]:
        assert np.array_equal(one.value, found[0].value)
        assert np.array_equal(one.covariance, found[0].covariance)


# From pair to pair

def see_pair(scale, floor, i, z, dz, status=Status.OK, gray=None):
    """Show the pair of frames i and i + 1, a tenth of a second apart, and give its length."""
    motion = moved(floor_pose(0.0), floor_pose(0.0, z=dz)) if status is Status.OK \
        else RelativePose(status)
    current = view(floor.gray(z=z + dz, seed=i)) if gray is None else view(gray)
    scale.observe(i * 10**8, (i + 1) * 10**8, view(floor.gray(z=z, seed=i + 1)), current, motion)
    return scale.between(i * 10**8, (i + 1) * 10**8)


def test_lengths_are_metric_with_the_uncertainty_of_height_and_images(floor):
    sigmas = {}
    for share in (0.01, 0.05):
        scale = CameraHeightScale(HEIGHT, 0.0, share)
        assert not scale.between(0, 10**8).known
        for i in range(5):
            length = see_pair(scale, floor, i, 0.8 * i, 0.8)
        assert length.known
        assert length.value == pytest.approx(0.8, rel=0.02)
        sigmas[share] = length.sigma
    assert sigmas[0.05] > 0.05 * 0.8
    assert 0.01 * 0.8 < sigmas[0.01] < sigmas[0.05] / 2


def test_speed_may_change_at_once(floor):
    scale, z = CameraHeightScale(HEIGHT, 0.0), 0.0
    for i, metres in enumerate((0.9, 0.9, 0.3, 0.9, 0.1, 0.9)):
        length = see_pair(scale, floor, i, z, metres)
        assert length.value == pytest.approx(metres, rel=0.04)
        z += metres


def test_without_ground_a_length_is_held_for_half_a_second_and_then_unknown(floor):
    scale = CameraHeightScale(HEIGHT, 0.0)
    for i in range(3):
        seen = see_pair(scale, floor, i, 0.8 * i, 0.8)
    blind = [see_pair(scale, floor, i, 0.8 * i, 0.8, gray=np.full(SIZE[::-1], 90, np.uint8))
             for i in range(3, 10)]
    assert [length.known for length in blind] == [True] * 5 + [False] * 2
    assert all(later.sigma > sooner.sigma for sooner, later in zip([seen, *blind], blind[:6]))
    assert blind[-1].value == pytest.approx(0.8, rel=0.05)
    assert blind[-1].sigma > 100
    again = see_pair(scale, floor, 10, 8.0, 0.8)
    assert again.known
    assert again.value == pytest.approx(0.8, rel=0.03)
    scale.reset()
    assert not scale.between(10**9, 11 * 10**8).known


def test_standing_still_is_a_known_length(floor):
    scale = CameraHeightScale(HEIGHT, 0.0)
    see_pair(scale, floor, 0, 0.0, 0.4)
    for i in range(1, 20):
        length = see_pair(scale, floor, i, 0.4, 0.0, Status.NO_PARALLAX)
        assert length.known
        assert length.value < 0.02
        assert length.sigma < 0.05
    assert see_pair(scale, floor, 20, 0.4, 0.5).value == pytest.approx(0.5, rel=0.04)


def test_ground_that_tilts_suddenly_is_rejected(floor):
    """A ramp behind which something else may be: its way is not taken for a length."""
    scale = CameraHeightScale(HEIGHT, 0.0)
    for i in range(5):
        before = see_pair(scale, floor, i, 0.8 * i, 0.8)
    pitch = np.radians(6.0)
    motion = moved(floor_pose(pitch), floor_pose(pitch, z=0.4))
    scale.observe(5 * 10**8, 6 * 10**8, view(floor.gray(pitch)), view(floor.gray(pitch, z=0.4)),
                  motion)
    after = scale.between(5 * 10**8, 6 * 10**8)
    assert after.value == pytest.approx(before.value)
    assert after.sigma > before.sigma


def test_tilt_is_propagated_through_a_rotation():
    """By pitch alone as far as it nods, by roll as far as it tips; turning makes one the other."""
    nods, tips, turns = (rotation_exp(angle) for angle in 0.1 * np.eye(3)[[0, 2, 1]])
    sure = np.zeros((3, 3))
    np.testing.assert_allclose(rotate_tilt(np.array([0.05, 0.0]), nods, sure)[0], [0.15, 0.0])
    np.testing.assert_allclose(rotate_tilt(np.array([0.0, 0.02]), tips, sure)[0], [0.0, -0.08])
    np.testing.assert_allclose(rotate_tilt(np.array([0.05, 0.0]), turns, sure)[0],
                               [0.05 * np.cos(0.1), 0.05 * np.sin(0.1)], atol=1e-4)


def test_the_covariance_of_tilt_is_propagated_through_a_rotation():
    lean, R = np.array([0.2, -0.1]), rotation_exp(np.array([0.05, -0.2, 0.1]))
    covariance = np.diag([1.0, 2.0, 3.0]) * 1e-4
    after, by_lean, by_turn = rotate_tilt(lean, R, covariance)
    step = 1e-6
    by_lean_found = np.transpose([rotate_tilt(lean + off, R, covariance)[0] - after
                                  for off in step * np.eye(2)]) / step
    J = np.transpose([rotate_tilt(lean, rotation_exp(off) @ R, covariance)[0] - after
                      for off in step * np.eye(3)]) / step
    np.testing.assert_allclose(by_lean, by_lean_found, atol=1e-5)
    np.testing.assert_allclose(by_turn, J @ covariance @ J.T, atol=1e-8)


@pytest.mark.parametrize('pitches', [2 * np.sin(2 * np.pi * 1.5 * 0.1 * np.arange(21)),
                                     np.repeat([0.0, 2.0, 0.0], 7)])
def test_pitching_of_the_vehicle_does_not_bias_lengths(floor, pitches):
    """Thrice in two seconds, as when it bounces, or all of a sudden; pitches in degrees."""
    scale, lengths, metres = CameraHeightScale(HEIGHT, 0.0), [], 0.8
    for i, pair in enumerate(pairwise(np.radians(pitches))):
        views = [view(floor.gray(pitch, z=metres * at, seed=at))
                 for at, pitch in enumerate(pair, i)]
        motion = moved(floor_pose(pair[0]), floor_pose(pair[1], z=metres))
        scale.observe(i * 10**8, (i + 1) * 10**8, *views, motion)
        lengths.append(scale.between(i * 10**8, (i + 1) * 10**8))
    assert all(length.known for length in lengths)
    off = np.array([length.value for length in lengths[3:]]) / metres - 1
    assert np.sqrt(np.mean(off**2)) < 0.015


@pytest.mark.slow
@pytest.mark.parametrize('radius', [400.0, -400.0])
def test_a_vehicle_that_pitches_with_the_road_is_on_a_hill(radius):
    """
    A pair alone takes ground ahead for a plane that goes on below the camera.

    On a crest that is nearer than the ground, on which the vehicle turns without leaning.
    """
    hill, scale, metres = Hill(radius), CameraHeightScale(HEIGHT, 0.0), 0.8
    motion, ground = hill.motion(metres), Ground(K, SIZE[::-1], 0.0)
    true = 2 * (HEIGHT + radius) * np.sin(metres / radius / 2)
    alone, lengths = [], []
    for i in range(25):
        views = [view(hill.gray(z=metres * at, seed=at)) for at in (i, i + 1)]
        scale.observe(i * 10**8, (i + 1) * 10**8, *views, motion)
        lengths.append(scale.between(i * 10**8, (i + 1) * 10**8).value)
        alone.append(HEIGHT * ground.motion(*views, motion).value[0])
    off, off_alone = (np.mean(values) / true - 1 for values in (lengths, alone))
    assert 0.02 < np.sign(radius) * off_alone < 0.05
    assert abs(off) < 0.75 * abs(off_alone)


# In the odometry

@pytest.fixture(scope='module')
def street():
    """Eight frames of a rendered street, a metre apart, and their poses."""
    scene = make_scene('road', size=(620, 188))
    poses = scene.trajectory(8)
    return scene.K, [scene.render(at, i) for i, at in enumerate(poses)], poses


CAR = {'scale': 'camera_height', 'camera_height': 1.65}


def drive(street, **config):
    """Results of all frames but the first."""
    K, images, _ = street
    vo = VisualOdometry(EstimatorConfig(max_features=1000), OdometryConfig(**config))
    return [vo.process(Frame(gray, K, 10**9 + i * 10**8)) for i, gray in enumerate(images)][1:]


def test_the_length_of_a_street_is_measured(street):
    steps = np.linalg.norm(np.diff(np.array(street[2])[:, :3, 3], axis=0), axis=1)
    results = drive(street, **CAR)
    assert all(result.scale_known for result in results)
    for result, metres in zip(results, steps):
        direction = unit(result.motion[:3, 3])
        sigma = np.sqrt(direction @ result.motion_covariance[:3, :3] @ direction)
        assert 0.05 < sigma / result.scale < 0.2
        assert abs(result.scale - metres) < 2 * sigma
    assert sum(result.scale for result in results) == pytest.approx(steps.sum(), rel=0.06)


def test_a_wrong_height_is_a_wrong_length_in_proportion(street):
    right, wrong = (np.array([result.scale for result in drive(
        street, scale='camera_height', camera_height=height)]) for height in (1.65, 3.3))
    # but for how speeds wander, which is in metres
    assert wrong == pytest.approx(2 * right, rel=0.03)


def test_the_scale_source_is_in_the_diagnostics(street):
    for name in ('none', 'camera_height'):
        tracker = Tracker(from_flat({'odometry.scale': name, 'odometry.camera_height': 1.65}),
                          message_type)
        assert tracker.diagnosis().values['scale source'] == name


def test_the_height_may_be_changed_while_running(street):
    config = {'odometry.scale': 'camera_height', 'odometry.camera_height': 1.0}
    tracker = Tracker(from_flat(config), message_type)
    before = tracker._scale
    tracker.configure(from_flat(config))
    assert tracker._scale is before
    tracker.configure(from_flat({**config, 'odometry.camera_height': 1.65}))
    assert tracker._scale is not before


@pytest.mark.parametrize('name', ['00', '03', '06'])
def test_real_roads_are_as_long_as_their_ground_truth_says(kitti, name):
    """
    The cameras of KITTI are 1.65 m above the road; its roads are not quite flat.

    In the first dozen frames of 00 the ground truth knows no speed but one; they are left out.
    """
    sequence = KittiSequence(kitti / 'sequences' / name)
    vo = VisualOdometry(odometry=OdometryConfig(**CAR))
    first = 12
    results = [vo.process(Frame(sequence.image(i), sequence.K, int(sequence.stamps_ns[i])))
               for i in range(first, first + 15)][1:]
    truth = np.array(sequence.poses)[first:first + 15, :3, 3]
    steps = np.linalg.norm(np.diff(truth, axis=0), axis=1)
    ratios = np.array([result.scale for result in results]) / steps
    assert all(result.scale_known for result in results)
    assert np.median(ratios) == pytest.approx(1, abs=0.04)
    surprise = [(result.scale - metres) / np.sqrt(np.trace(result.motion_covariance[:3, :3]))
                for result, metres in zip(results, steps)]
    assert np.sqrt(np.mean(np.square(surprise))) < 2
