"""Scenes that somebody carries a camera through are exact too, and as difficult as they say."""

from __future__ import annotations

from dataclasses import replace

from djet_ros.core.geometry import rotation_exp
from djet_ros.lab.scenes import make_scene, Scene, ScenePair, SCENES
from djet_ros.lab.scenes.camera import Shot
from djet_ros.lab.scenes.catalogue import find, suggested_frames
from djet_ros.lab.scenes.corridor import CELL, Plan
from djet_ros.lab.scenes.cuboid import cuboid, frame
from djet_ros.lab.scenes.excursions import centred_camera
from djet_ros.lab.scenes.forest import forest
from djet_ros.lab.scenes.panel import fitted, tiled, World
from djet_ros.lab.scenes.reflection import Gloss
from djet_ros.lab.scenes.route import level_pose, Turntable, winding
from djet_ros.lab.scenes.shutter import Shutter
from djet_ros.lab.scenes.texture import fractal, make_texture
import numpy as np
from numpy.typing import NDArray
import pytest
from scipy.spatial.transform import Rotation
from test_scenes import clean, shifts

pytestmark = pytest.mark.slow

NAMES = ('indoor', 'handheld', 'forest')
SMALL = (480, 360)
TINY = (160, 120)
# Median motion in pixels, beyond what rotation does, from which a camera can be said to move.
_MOVES = 0.5


def pair_of(scene: Scene, first: int) -> ScenePair:
    """Frames first and first + 1 of a scene as it is, with their truth."""
    poses = scene.trajectory(first + 2)[first:]
    motion = np.linalg.inv(poses[1]) @ poses[0]
    (a, b), (near, far) = zip(*((scene.render(pose, first + i), scene.depth(pose, first + i))
                                for i, pose in enumerate(poses)))
    return ScenePair(a, b, near, far, scene.K, motion[:3, :3], motion[:3, 3])


def steps_of(scene: Scene, frames: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotation vectors in degrees (N, 3) and ways in metres (N,) from frame to frame."""
    poses = scene.trajectory(frames)
    steps = np.linalg.inv(poses[:-1]) @ poses[1:]
    turns = np.degrees(Rotation.from_matrix(steps[:, :3, :3]).as_rotvec())
    return turns, np.linalg.norm(steps[:, :3, 3], axis=1)


@pytest.mark.parametrize('name', NAMES)
@pytest.mark.parametrize('first', [4, 31])
def test_pictures_agree_with_depth_and_motion_far_below_a_pixel(name: str, first: int) -> None:
    # Smooth edges and no mirror: what is left is the scene's own geometry.
    scene = replace(clean(make_scene(name, size=SMALL)), samples=2)
    shift = shifts(pair_of(scene, first))
    assert len(shift) > 40
    assert np.linalg.norm(np.median(shift, axis=0)) < 0.02
    # On walls that are nearly white, gray levels are too coarse for more.
    assert np.median(np.linalg.norm(shift, axis=1)) < (0.1 if name == 'indoor' else 0.03)


@pytest.mark.parametrize('name', NAMES)
def test_every_seed_gives_another_scene_and_the_same_seed_the_same_one(name: str) -> None:
    scenes = [make_scene(name, seed, TINY) for seed in (0, 1, 2, 0)]
    first, *others, again = (clean(scene).render(scene.trajectory(9)[8]) for scene in scenes)
    assert all((np.abs(first.astype(int) - other) > 4).mean() > 0.4 for other in others)
    np.testing.assert_array_equal(again, first)
    assert not np.allclose(scenes[0].trajectory(9)[8], scenes[1].trajectory(9)[8], atol=1e-3)


@pytest.mark.parametrize('name', SCENES)
def test_a_scene_has_parallax_if_its_points_move_by_more_than_rotation_does(name: str) -> None:
    scene = make_scene(name, size=TINY)
    frames = min(suggested_frames(scene), 30)
    poses = scene.trajectory(frames)
    moved = []
    for i in range(0, frames - 1, 4):
        metres = np.linalg.norm((np.linalg.inv(poses[i]) @ poses[i + 1])[:3, 3])
        # Motion in pixels of the default size does not depend on the size of the images.
        focal = scene.K[0, 0] * find(name).size[0] / TINY[0]
        moved.append(np.median(focal * metres / scene.depth(poses[i], i)))
    assert (np.median(moved) > _MOVES) == find(name).parallax


# Indoors

def test_indoor_edges_have_stair_steps() -> None:
    """The outline of a tilted white board before black has no pixel between black and white."""
    def picture(samples: int) -> NDArray[np.uint8]:
        board = fitted((-1, -1.2, 4), (2, 0.21, 0), (-0.13, 1.9, 0),
                       make_texture(np.full((4, 4), 200, np.float32), (1.0, 1.0)))
        return Scene('board', World((board,)), Turntable((0, 0), 0.0, height=0.0),
                     centred_camera(TINY, 0.6), TINY, 0, samples=samples).render(np.eye(4))

    assert set(np.unique(picture(make_scene('indoor', size=TINY).samples))) == {0, 200}
    assert ((picture(2) > 20) & (picture(2) < 180)).sum() > 100


def test_indoor_walls_are_nearly_white_and_tiles_repeat() -> None:
    bright = weak = 0
    for seed in range(3):
        scene = make_scene('indoor', seed, SMALL)
        gray = scene.render(scene.trajectory(20)[19], 19).astype(float)
        slope = np.hypot(*np.gradient(gray))
        bright += (gray > 200).mean() / 3
        weak += (slope < 4).mean() / 3
    assert bright > 0.3
    assert weak > 0.75


def test_the_floor_reflects_a_lamp_by_the_law_of_reflection() -> None:
    lamp = fitted((-0.2, -2.5, 4.0), (0.4, 0, 0), (0, 0, 0.4),
                  make_texture(np.full((4, 4), 200, np.float32), (1.0, 1.0)))
    floor = tiled((-20, 0, -5), (40, 0, 0), (0, 0, 60),
                  make_texture(np.full((4, 4), 10, np.float32), (1.0, 1.0)))
    scene = Scene('hall', World((floor, lamp)), Turntable((0, 0), 0.0, height=0.0),
                  centred_camera(SMALL, 0.6), SMALL, 0, effects=(Gloss(World((lamp,)), 0.3),),
                  samples=1)
    seen, on_floor = [], []
    start = level_pose(0, 0, 0, 1.5)
    # Where the light comes off the floor for the first camera: heights 1.5 and 2.5 m.
    glint = np.array([0, 0, 4.2 * 1.5 / (1.5 + 2.5), 1])
    for pose in (start, level_pose(0.4, 0.5, 0.05, 1.7), level_pose(-0.6, 1.0, -0.1, 1.3)):
        pose[:3, :3] = pose[:3, :3] @ rotation_exp(np.array([-0.5, 0, 0]))
        gray = scene.render(pose)
        v, u = np.nonzero((gray > 50) & (np.arange(SMALL[1]) > 10)[:, None])
        expected = scene.K @ (np.linalg.inv(pose) @ (0, 2.5, 4.2, 1))[:3]
        # The middle of its picture is not quite the picture of its middle.
        np.testing.assert_allclose((u.mean(), v.mean()), expected[:2] / expected[2], atol=1.0)
        fixed = scene.K @ (np.linalg.inv(pose) @ glint)[:3]
        seen.append((u.mean(), v.mean()))
        on_floor.append(fixed[:2] / fixed[2])
    # It does not stay where it was on the floor, as paint there would.
    gap = np.linalg.norm(np.array(seen) - on_floor, axis=1)
    assert gap[0] < 1
    assert gap[1:].min() > 15


def test_the_floor_reflects_more_towards_the_horizon_and_nothing_else_reflects() -> None:
    scene = make_scene('indoor', size=SMALL)
    pose = scene.trajectory(1)[0]
    matt, glossy = (replace(scene, effects=effects).render(pose).astype(float)
                    for effects in ((), scene.effects[:1]))
    changed = np.abs(glossy - matt) > 1
    height = -scene.path.pose(0)[1, 3]
    rays = np.stack([*np.meshgrid(np.arange(SMALL[0]), np.arange(SMALL[1])),
                     np.ones(SMALL[::-1])], axis=-1) @ np.linalg.inv(scene.K).T
    down = rays @ scene.path.pose(0)[1, :3]
    floor = np.abs(scene.depth(pose) * down / height - 1) < 0.01
    assert changed[floor].mean() > 0.8
    assert not changed[~floor & (down < 0)].any()


def test_the_path_through_the_corridor_stays_clear_of_its_walls() -> None:
    for seed in range(20):
        plan = Plan.draw(np.random.default_rng(seed))
        points = plan.route().points
        cells = np.array(plan.cells) * CELL
        distance = np.abs(points[:, None] - cells[None]).max(2).min(1)
        assert distance.max() <= CELL / 2 + 1e-9
        for shift in ((0.4, 0), (-0.4, 0), (0, 0.4), (0, -0.4)):
            assert np.abs(points[:, None] + shift - cells[None]).max(2).min(1).max() < CELL / 2
        # It never comes to the same place twice.
        assert len(set(plan.cells)) == len(plan.cells)


# In the hand

@pytest.mark.parametrize('seed', range(5))
def test_a_handheld_camera_rotates_in_jerks_and_at_times_only_rotates(seed: int) -> None:
    scene = make_scene('handheld', seed, TINY)
    turns, lengths = steps_of(scene, 60)
    rates = np.linalg.norm(turns, axis=1)
    assert rates.mean() > 1.5
    assert rates.max() < 5
    # Changes within one frame of the order of the rate itself.
    assert np.linalg.norm(np.diff(turns, axis=0), axis=1).max() > 3
    assert lengths.max() < 0.04
    assert 8 < (lengths < 1e-3).sum() < 40
    assert (lengths > 0.01).sum() > 20


def test_motion_during_the_exposure_blurs_along_it_without_a_shift() -> None:
    K = centred_camera(SMALL, 0.8)
    gray = 128 + 40 * fractal(np.random.default_rng(1), (512, 512), 0.8)[:SMALL[1], :SMALL[0]]
    shot = Shot(gray, np.ones_like(gray), K, np.eye(4), 0, 0)
    turn = np.array([0.0, np.deg2rad(8), 0.0])
    blurred = Shutter(0.125, lambda index: turn)(shot)
    inner = (slice(20, -20), slice(20, -20))
    slope_y, slope_x = (np.abs(np.diff(blurred[inner], axis=axis)).mean() for axis in (0, 1))
    assert slope_x < 0.7 * slope_y
    # One degree is so many pixels in the middle of the picture.
    width = K[0, 0] * np.deg2rad(1)
    middle = gray[:, 240 - 40:240 + 41].astype(float)
    ideal = np.mean([np.roll(middle, k, axis=1) for k in range(-3, 4)], axis=0)
    assert round(width) == 7
    centre = (slice(100, 260), slice(30, 50))
    found = blurred[:, 240 - 40:240 + 41][centre]
    assert np.corrcoef(found.ravel(), ideal[centre].ravel())[0, 1] > 0.98
    still = Shutter(0.125, lambda index: np.zeros(3))(shot)
    np.testing.assert_allclose(still, gray, atol=1e-3)


def test_the_handheld_scene_states_its_rotation() -> None:
    path = make_scene('handheld', 3, TINY).path
    for index in (0, 7, path.limit - 1):
        first, last = max(index - 1, 0), min(index + 1, path.limit - 1)
        whole = path.pose(first)[:3, :3] @ rotation_exp(path.turning(index) * (last - first))
        np.testing.assert_allclose(whole, path.pose(last)[:3, :3], atol=1e-9)


# In the wood

def test_the_forest_has_weak_texture_and_depth() -> None:
    wood, road = (make_scene(name, size=(480, 270)) for name in ('forest', 'road'))
    slopes = []
    for scene in (wood, road):
        gray = scene.render(scene.trajectory(11)[10], 10).astype(float)
        slopes.append(np.percentile(np.hypot(*np.gradient(gray)), 90))
    assert slopes[0] < 0.7 * slopes[1]
    depth = wood.depth(np.eye(4))
    near, far = np.percentile(depth[np.isfinite(depth)], (10, 90))
    assert near < 5
    assert far > 20


def test_trees_of_the_forest_stand_on_its_ground() -> None:
    """Neighbouring triangles of the ground share corners, so that nobody sees through it."""
    panels = forest(winding(8, 0.2, (23,)), np.random.default_rng(2))
    ground = [p for p in panels if p.triangle]
    corners = np.concatenate([[p.origin, p.origin + p.a, p.origin + p.b] for p in ground])
    heights: dict[tuple[float, float], set[float]] = {}
    for x, y, z in corners.round(9).tolist():
        heights.setdefault((x, z), set()).add(y)
    assert max(map(len, heights.values())) == 1
    assert len(heights) < 0.4 * len(corners)
    assert np.ptp(corners[:, 1]) > 0.5


# What they are built of

def test_a_box_is_closed_and_its_frame_leaves_the_opening_free() -> None:
    paint = make_texture(np.full((4, 4), 99, np.float32), (1.0, 1.0))
    faces = cuboid((0, 0, 0), (1, 2, 3), paint)
    area = sum(np.linalg.norm(np.cross(p.a, p.b)) for p in faces)
    assert area == pytest.approx(2 * (1 * 2 + 2 * 3 + 1 * 3))
    # The outward sums of a closed surface vanish.
    middle = np.array([0.5, 1, 1.5])
    normals = np.array([np.cross(p.a, p.b) for p in faces])
    outward = np.array([p.origin + (p.a + p.b) / 2 for p in faces]) - middle
    normals *= np.sign((normals * outward).sum(1, keepdims=True))
    np.testing.assert_allclose(normals.sum(0), 0, atol=1e-12)
    bars = frame((-1, -1, 0), (1, 1, 0.1), 0.2, paint)
    for bar in bars:
        inside = np.abs(bar.origin + (bar.a + bar.b) / 2)[:2]
        assert inside.max() >= 1
