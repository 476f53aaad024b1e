"""
Outcomes of the odometry on difficult images.

doc/bounds.yaml states an outcome for each kind, and doc/robustness.md shows it: the statuses that
may occur and, where a motion is estimated, bounds on its median errors. Each is tried here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

from covariances import check_messages
import cv2
from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.estimator_config import preset
from djet_ros.core.features import detect_orb
from djet_ros.core.geometry import direction_angle, rotation_angle, unit
from djet_ros.core.types import RelativePose, Status
from djet_ros.lab.scenes.catalogue import make_scene
from djet_ros.odometry.camera import Camera
from djet_ros.odometry.frame import Frame
from djet_ros.odometry.visual_odometry import VisualOdometry
import numpy as np
from numpy.typing import NDArray
import pytest
import yaml

pytestmark = pytest.mark.slow

Gray = NDArray[np.uint8]
BOUNDS = Path(__file__).parents[1] / 'doc' / 'bounds.yaml'
K = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
SIZE = (620, 188)
SMALL = (64, 48)
FRAMES = 7
PERIOD_NS = 10**8


class Outcome(NamedTuple):
    """Outcome of a pair; errors in degrees, NaN where there is nothing to compare."""

    status: Status
    rotation: float = np.nan
    direction: float = np.nan


class Stated(NamedTuple):
    """What is stated of a kind of images."""

    statuses: set[Status]
    rotation: float | None
    direction: float | None


def stated() -> dict[str, Stated]:
    """Return what is stated of each kind."""
    return {one['images']: Stated({Status(word) for word in one['statuses']},
                                  one.get('rotation'), one.get('direction'))
            for one in yaml.safe_load(BOUNDS.read_text())['hard_images']}


# Kinds of images


def same(image: Gray) -> Iterator[Outcome]:
    """One image repeatedly, each time with other sensor noise."""
    return outcomes_of([image] * 3)


def outcomes_of(images: Iterable[Gray]) -> Iterator[Outcome]:
    """Outcomes of images without ground truth."""
    odometry = VisualOdometry(preset('best'))
    for i, image in enumerate(images):
        result = odometry.process(Frame(image, K, (i + 1) * PERIOD_NS))
        check_messages(result)
        if i:
            yield Outcome(result.status)


def flat(level: int) -> Gray:
    return np.full((240, 320), level, np.uint8)


def noise(seed: int, size: tuple[int, int] = (320, 240)) -> Gray:
    """Grains of some pixels; what differs from pixel to pixel has no corners."""
    grains = np.random.default_rng(seed).integers(
        0, 256, (max(size[1] // 3, 1), max(size[0] // 3, 1)), np.uint8)
    return np.asarray(cv2.resize(grains, size, interpolation=cv2.INTER_CUBIC), np.uint8)


def one_feature() -> Gray:
    dot = flat(0)
    cv2.rectangle(dot, (150, 110), (156, 116), 255, -1)
    return dot


def large() -> Iterator[Outcome]:
    image = cv2.resize(noise(3, (512, 384)), (4096, 3072), interpolation=cv2.INTER_CUBIC)
    return outcomes_of([image, image])


@cache
def rendered(scene_name: str) -> tuple[NDArray[np.float64], NDArray[np.float64], list[Gray]]:
    """Camera matrix, poses and images of a scene, which several kinds change."""
    scene = make_scene(scene_name, size=SIZE)
    poses = scene.trajectory(FRAMES)
    return scene.K, poses, [scene.render(pose, i) for i, pose in enumerate(poses)]


def drive(scene_name: str, change: Callable[[int, Gray], Gray] = lambda i, gray: gray,
          keep: Callable[[int], bool] = lambda i: True, **estimator: object) -> Iterator[Outcome]:
    """Outcomes of a rendered drive, each pair against the truth between its two frames."""
    K, poses, images = rendered(scene_name)
    odometry, camera = VisualOdometry(preset('best', **estimator)), Camera(K, np.zeros(5), SIZE)
    for i in filter(keep, range(FRAMES)):
        image = camera.corrected(change(i, images[i]))
        result = odometry.process(Frame(image, K, (i + 1) * PERIOD_NS))
        check_messages(result)
        if result.previous_stamp_ns is None:
            continue
        previous = result.previous_stamp_ns // PERIOD_NS - 1
        yield compared(result.relative, np.linalg.inv(poses[i]) @ poses[previous])


def compared(relative: RelativePose, truth: NDArray[np.float64]) -> Outcome:
    R, t = truth[:3, :3], truth[:3, 3]
    moved = relative.t.any() and np.linalg.norm(t) > 1e-6
    return Outcome(relative.status, float(np.degrees(rotation_angle(relative.R, R))),
                   float(np.degrees(direction_angle(relative.t, unit(t)))) if moved else np.nan)


def rolling(i: int, gray: Gray) -> Gray:
    """Brighten and darken bands of rows that wander, as lamps on mains do."""
    rows = np.arange(len(gray))[:, None] / len(gray)
    return np.clip(gray * (1 + 0.4 * np.sin(2 * np.pi * (rows + 0.23 * i))), 0, 255).astype(
        np.uint8)


def bonneted(i: int, gray: Gray) -> Gray:
    """Hide the lower third of the image behind something that moves with the camera."""
    stuck = cv2.GaussianBlur(np.random.default_rng(3).normal(0, 150, gray.shape), (0, 0), 2)
    grain = np.random.default_rng([4, i]).normal(0, 1, gray.shape)
    shown, top = gray.copy(), 2 * len(gray) // 3
    shown[top:] = np.clip(np.rint(90 + stuck + grain), 0, 255)[top:]
    return shown


def grainy(i: int, gray: Gray) -> Gray:
    return np.clip(np.rint(gray + np.random.default_rng(i).normal(0, 12, gray.shape)),
                   0, 255).astype(np.uint8)


def with_broken_pixels(i: int, gray: Gray) -> Gray:
    broken = np.random.default_rng(5).random(gray.shape) < 0.002
    return np.where(broken, np.uint8(255), gray)


def striped(i: int, gray: Gray) -> Gray:
    of_columns = np.random.default_rng(6).normal(0, 6, gray.shape[1])
    return np.clip(np.rint(gray + of_columns), 0, 255).astype(np.uint8)


def compressed(i: int, gray: Gray) -> Gray:
    _, data = cv2.imencode('.jpg', gray, [cv2.IMWRITE_JPEG_QUALITY, 40])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), np.uint8)


def wrong_matches(share: float) -> Iterator[Outcome]:
    """Return the inliers of a pair, with a share of them replaced by matches to anywhere."""
    scene = make_scene('road', size=SIZE)
    poses = scene.trajectory(2)
    estimator = TwoViewEstimator(preset('best'))
    a, b = (estimator.view(scene.render(pose, i), scene.K) for i, pose in enumerate(poses))
    clean = estimator.estimate(a, b)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        x, y = clean.x[clean.inliers], clean.y[clean.inliers].copy()
        wrong = rng.random(len(x)) < share
        y[wrong] = rng.uniform((0, 0), SIZE, (int(wrong.sum()), 2))
        yield compared(estimator.estimate_matched(a, b, x, y), np.linalg.inv(poses[1]) @ poses[0])


KINDS: dict[str, Callable[[], Iterator[Outcome]]] = {
    'black': lambda: same(flat(0)),
    'white': lambda: same(flat(255)),
    'no feature (one gray)': lambda: same(flat(128)),
    'one feature': lambda: same(one_feature()),
    'noise, another one in each frame': lambda: outcomes_of(map(noise, range(5))),
    '64×48 pixels, standing still': lambda: (
        outcome for seed in range(5) for outcome in same(noise(seed, SMALL))),
    '4096×3072 pixels, standing still': large,
    'standstill': partial(drive, 'standstill'),
    'pure rotation': partial(drive, 'rotation'),
    'repeated texture': partial(drive, 'repeated_texture'),
    'exposure that jumps': partial(drive, 'exposure_jump'),
    'brightness that rolls through the rows': partial(drive, 'road', rolling),
    '3 of 8 frames out of focus': partial(drive, 'blur'),
    'every third frame dropped': partial(drive, 'road', keep=lambda i: i % 3 != 1),
    'dim and hazy water, particles': partial(drive, 'underwater'),
    'noise of 12 gray levels': partial(drive, 'indoor', grainy),
    'two pixels of a thousand broken': partial(drive, 'indoor', with_broken_pixels),
    'columns that differ by 6 gray levels': partial(drive, 'indoor', striped),
    'JPEG of quality 40': partial(drive, 'indoor', compressed),
    '1 % of the matches wrong': lambda: wrong_matches(0.01),
    '50 % of the matches wrong': lambda: wrong_matches(0.5),
    'half of the image moves by itself': partial(drive, 'moving_object'),
    'a third of the image moves with the camera': partial(drive, 'road', bonneted),
}


def test_every_kind_has_a_stated_outcome_and_every_outcome_a_kind():
    assert list(stated()) == list(KINDS)
    assert all(outcome.statuses for outcome in stated().values())


@pytest.mark.parametrize('kind', KINDS)
def test_hard_images_have_the_stated_outcome(kind):
    expected = stated()[kind]
    outcomes = list(KINDS[kind]())
    assert outcomes
    assert {outcome.status for outcome in outcomes} <= expected.statuses
    errors = np.array([[outcome.rotation, outcome.direction] for outcome in outcomes])
    if expected.rotation is not None:
        assert np.median(errors[:, 0]) < expected.rotation
    if expected.direction is not None:
        assert np.median(errors[:, 1]) < expected.direction


def test_few_corners_fit_into_a_small_image_and_less_of_it_is_rim_than_orb_leaves_out():
    estimator = TwoViewEstimator()
    for seed in range(5):
        found = estimator.features(noise(seed, SMALL)).points
        assert 0 < len(found) < 3 * estimator.config.min_matches
        assert not len(detect_orb(noise(seed, SMALL), 1000))
        assert min(found.min(), (np.subtract(SMALL, 1) - found).min()) < 16


@pytest.mark.parametrize('size', [(1, 1), (17, 900), (26, 26)])
def test_images_smaller_than_a_descriptor_have_nothing_to_match(size):
    assert {outcome.status for outcome in same(noise(1, size))} == {Status.TOO_FEW_MATCHES}


@pytest.mark.parametrize('seed', [20, 21])
def test_over_a_plane_an_exposure_that_changes_leads_to_no_wrong_motion(seed):
    """Two motions fit the plane, and what decides between them must be no error of the matches."""
    scene, odometry = make_scene('flight', seed), VisualOdometry()
    poses, rng, decided = scene.trajectory(40), np.random.default_rng(1), 0
    for i in range(20, 40):
        exposed = scene.render(poses[i], i) * rng.uniform(0.6, 1.5) + rng.uniform(-20, 20)
        image = np.clip(np.rint(exposed), 0, 255).astype(np.uint8)
        result = odometry.process(Frame(image, scene.K, i * PERIOD_NS))
        if result.status is Status.OK and result.previous_stamp_ns is not None:
            before = poses[result.previous_stamp_ns // PERIOD_NS]
            found = compared(result.relative, np.linalg.inv(poses[i]) @ before)
            assert found.rotation < 0.3 and found.direction < 6
            decided += 1
    assert decided > 10
