"""Broken pixels and stripes of a sensor: removed where they are, and nothing else."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from pathlib import Path

from djet_ros.core.geometry import direction_angle
from djet_ros.core.types import Status
from djet_ros.lab.scenes.catalogue import make_scene, SCENES
from djet_ros.odometry.camera import Camera
from djet_ros.odometry.frame import Frame
from djet_ros.odometry.sensor_defects import offsets, without_broken_pixels, without_defects
from djet_ros.odometry.visual_odometry import VisualOdometry
from djet_ros.recordings.datasets import open_sequence
import numpy as np
from numpy.typing import NDArray
import pytest

Gray = NDArray[np.uint8]
SIZE = (320, 240)


@cache
def street(seed: int = 0) -> Gray:
    scene = make_scene('road', seed, size=SIZE)
    return scene.render(scene.trajectory(1)[0], 0)


def gray(levels: NDArray[np.float64]) -> Gray:
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)


def rough(each: NDArray[np.float64]) -> NDArray[np.float64]:
    """Leave what differs from the mean of fifteen neighbours, in the middle of an image."""
    return (each - np.convolve(each, np.full(15, 1 / 15), 'same'))[20:-20]


def with_offsets(image: Gray, true: NDArray[np.float64], axis: int) -> Gray:
    return gray(image + (true if axis == 0 else true[:, None]))


@pytest.mark.parametrize('axis', [0, 1])
@pytest.mark.parametrize('name', SCENES)
def test_most_of_offsets_is_found_and_no_more_is_added_than_there_was(name, axis):
    scene = make_scene(name, 1, size=SIZE)
    image = scene.render(scene.trajectory(1)[0], 0)
    for level, left in ((6, 0.5), (1, 1.1)):
        true = np.random.default_rng(1).normal(0, level, image.shape[1 - axis])
        found = offsets(with_offsets(image, true, axis), axis)
        if level > 1 or found is not None:
            assert rough(found - true).std() < left * rough(true).std()


@pytest.mark.parametrize('axis', [0, 1])
def test_offsets_of_columns_are_not_taken_for_those_of_rows_nor_the_reverse(axis):
    true = np.random.default_rng(1).normal(0, 6, street().shape[1 - axis])
    assert offsets(with_offsets(street(), true, axis), axis) is not None
    assert offsets(with_offsets(street(), true, axis), 1 - axis) is None


def test_rows_are_treated_as_columns_of_the_turned_image():
    striped = gray(street() + np.random.default_rng(2).normal(0, 4, street().shape[1]))
    np.testing.assert_array_equal(offsets(striped, 0), offsets(striped.T.copy(), 1))


def test_a_smooth_image_is_freed_of_all_of_its_stripes_that_is_not_smooth_as_well():
    smooth = 60 + 100 * np.arange(SIZE[0]) / SIZE[0] + np.zeros((SIZE[1], 1))
    grain = np.random.default_rng(3).normal(0, 1, smooth.shape)
    striped = gray(smooth + grain + np.random.default_rng(4).normal(0, 6, SIZE[0]))
    left = (without_defects(striped) - smooth).mean(0)
    assert rough(left).std() < 1 and rough((striped - smooth).mean(0)).std() > 5


def test_a_broken_pixel_gets_the_level_between_its_neighbours_and_all_others_stay():
    image = gray(100 + np.random.default_rng(5).normal(0, 1, (90, 120)))
    broken = np.zeros(image.shape, bool)
    broken[5:85:20, 3:120:13] = True
    repaired = without_broken_pixels(np.where(broken, np.uint8(255), image))
    np.testing.assert_array_equal(repaired[~broken], image[~broken])
    np.testing.assert_allclose(repaired[broken], 100, atol=4)


@pytest.mark.parametrize('level', [0, 255])
def test_most_broken_pixels_of_a_street_are_found(level):
    broken = np.random.default_rng(6).random(street().shape) < 0.002
    repaired = without_broken_pixels(np.where(broken, np.uint8(level), street()))
    visible = broken & (np.abs(street().astype(int) - level) > 60)
    assert (repaired != level)[visible].mean() > 0.7
    # Next to broken pixels others may seem to be broken.
    assert (repaired == street())[~broken].mean() > 0.999


def test_the_tip_of_a_needle_and_the_corner_of_a_square_are_no_broken_pixels():
    image = np.full((64, 64), 60, np.uint8)
    image[10:40, 20] = image[45:60, 30:50] = 255
    assert without_broken_pixels(image) is image


def rendered() -> Iterator[Gray]:
    for name in SCENES:
        scene = make_scene(name, 1, size=SIZE)
        yield scene.render(scene.trajectory(1)[0], 0)


def test_no_rendered_scene_has_defects():
    for image in rendered():
        assert without_defects(image) is image


def real(*folders: Path) -> Iterator[Gray]:
    for folder in folders:
        sequence = open_sequence(folder)
        for index in range(0, len(sequence), 20):
            yield sequence.raw(index)


def test_no_real_image_has_defects(kitti, freiburg1_rpy, corridor):
    folders = *sorted((kitti / 'sequences').iterdir()), freiburg1_rpy, corridor
    for image in real(*folders):
        assert without_defects(image) is image


def fence(period: float) -> Gray:
    """Draw pales that lean, as seen from the side, in front of a street."""
    rows, columns = np.mgrid[:SIZE[1], :SIZE[0]]
    pale = (columns + 0.02 * rows) % period < period / 3
    return np.where(pale, np.uint8(220), street())


@pytest.mark.parametrize('period', [12.3, 25.7])
def test_a_fence_is_no_offset_of_columns_unless_it_stands_exactly_upright(period):
    assert offsets(fence(period), 0) is None


@pytest.mark.parametrize('size', [(16, 16), (40, 17)])
def test_small_images_are_left_as_they_are(size):
    noise = np.random.default_rng(6).integers(0, 256, size, dtype=np.uint8)
    assert offsets(noise, 0) is None and offsets(noise, 1) is None


@pytest.mark.slow
@pytest.mark.parametrize('broken', [True, False])
def test_in_a_corridor_of_weak_texture_they_would_be_followed_in_place_of_the_world(
        corridor, broken):
    sequence = open_sequence(corridor)
    height, width = sequence.image(0).shape
    hot = np.random.default_rng(7).random((height, width)) < 0.002
    of_columns = np.random.default_rng(5).normal(0, 6, width)

    def errors(seen: Camera | None) -> list[float]:
        odometry, found = VisualOdometry(), []
        for index in range(100, 112):
            image = sequence.image(index)
            image = np.where(hot, np.uint8(255), image) if broken else gray(image + of_columns)
            result = odometry.process(Frame(image if seen is None else seen.corrected(image),
                                            sequence.K, index * 10**8))
            if result.status in (Status.OK, Status.NO_PARALLAX):
                motion = np.linalg.inv(sequence.poses[index - 1]) @ sequence.poses[index]
                found.append(np.degrees(direction_angle(result.motion[:3, 3], motion[:3, 3]))
                             if result.motion[:3, 3].any() else 90.0)
        return found

    assert np.median(errors(Camera(sequence.K, np.zeros(5), (width, height)))) < 1
    assert np.median(errors(None)) > 10
