"""The rendered scenes are exact, plausible, repeatable, and written as KITTI's are."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from commands import alone
import cv2
from djet_ros.errors import DjetError
from djet_ros.lab.scenes import make_scene, render_pair, render_sequence, Scene, ScenePair, SCENES
from djet_ros.lab.scenes.catalogue import car_camera, suggested_frames
from djet_ros.lab.scenes.panel import tiled, World
from djet_ros.lab.scenes.route import level_pose, Turntable
from djet_ros.lab.scenes.texture import fractal, make_texture, RipMap
from djet_ros.recordings.kitti import KittiSequence
import numpy as np
from numpy.typing import NDArray
import pytest

pytestmark = pytest.mark.slow

SMALL = (620, 188)
TINY = (160, 64)


def clean(scene: Scene) -> Scene:
    """Return the scene without anything that the camera does to the light."""
    return replace(scene, effects=())


def clean_pair(name: str, first: int) -> ScenePair:
    """Two frames that follow one another, without camera effects."""
    scene = clean(make_scene(name, size=SMALL))
    poses = scene.trajectory(first + 2)
    gray = [scene.render(poses[i], i) for i in (first, first + 1)]
    pair = render_pair(name, first, size=SMALL)
    return replace(pair, previous=gray[0], current=gray[1])


def shifts(pair: ScenePair, half: int = 8) -> NDArray[np.float64]:
    """
    Measure by how much (N, 2) the current picture is off where exact geometry puts corners.

    The current picture is laid over the previous one by the true depth and motion; one
    Gauss-Newton step of Lucas and Kanade's then says what shift is left in a window.
    """
    height, width = pair.previous.shape
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).reshape(-1, 2)
    there, seen = pair.project(grid.astype(float))
    maps = there.astype(np.float32).reshape(height, width, 2)
    laid_over = cv2.remap(pair.current.astype(np.float32), maps, None, cv2.INTER_LANCZOS4)
    mean = (pair.previous + laid_over) / 2
    slope_y, slope_x = np.gradient(mean)
    change = pair.previous - laid_over

    def window(values: NDArray[np.float32]) -> NDArray[np.float64]:
        return cv2.boxFilter(values.astype(float), -1, (2 * half + 1,) * 2, normalize=False)

    xx, yy, xy = window(slope_x ** 2), window(slope_y ** 2), window(slope_x * slope_y)
    x, y = window(slope_x * change), window(slope_y * change)
    with np.errstate(invalid='ignore'):
        shift = np.stack([yy * x - xy * y, xx * y - xy * x], -1) / (xx * yy - xy ** 2)[..., None]
    whole = cv2.erode(seen.reshape(height, width).astype(np.uint8),
                      np.ones((2 * half + 3,) * 2, np.uint8), borderValue=0)
    corners = cv2.goodFeaturesToTrack(pair.previous, 2000, 0.01, 5, mask=whole)
    columns, rows = np.rint(corners[:, 0]).astype(int).T
    return np.asarray(shift[rows, columns])


@pytest.mark.parametrize(('name', 'first'), [('road', 40), ('rotation', 5), ('underwater', 10)])
def test_pictures_agree_with_depth_and_motion_far_below_a_pixel(name: str, first: int) -> None:
    shift = shifts(clean_pair(name, first))
    assert len(shift) > 80
    assert np.linalg.norm(shift.mean(0)) < 0.01
    assert np.median(np.linalg.norm(shift, axis=1)) < 0.03


def test_a_picture_is_what_rays_hit_on_a_wall_that_is_known_in_closed_form() -> None:
    x = (np.arange(256) + 0.5) / 256 * 2 * np.pi
    wave = 128 + 50 * np.sin(x)[None] + 50 * np.cos(2 * x)[:, None]
    wall = tiled((-20, -20, 2), (40, 0, 10), (0, 40, 0), make_texture(wave, (4.0, 4.0)))
    scene = Scene('wall', World((wall,)), Turntable((0, 0), 0.0, height=0.0), car_camera(SMALL),
                  SMALL, seed=0)
    pose = level_pose(0.3, 0.5, 0.05, 0.2)
    picture, depth = scene.render(pose).astype(float), scene.depth(pose)

    v, u = np.mgrid[:SMALL[1], :SMALL[0]]
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(scene.K).T @ pose[:3, :3].T
    normal = np.cross(wall.a, wall.b)
    z = normal @ (wall.origin - pose[:3, 3]) / (rays @ normal)
    inside = (z > 0) & (z < 15)
    assert inside.sum() > 10_000
    np.testing.assert_allclose(depth[inside], z[inside], rtol=1e-5)
    hit = pose[:3, 3] + rays * z[..., None] - wall.origin
    along, down = (hit @ side / np.linalg.norm(side) * np.pi / 2 for side in (wall.a, wall.b))
    expected = 128 + 50 * np.sin(along) + 50 * np.cos(2 * down)
    assert np.abs(picture - expected)[inside].max() < 2.0


def test_the_road_lies_as_far_below_the_camera_as_the_car_is_high() -> None:
    scene = make_scene('road', size=SMALL)
    depth = scene.depth(np.eye(4))
    v = np.arange(150, 188)[:, None]
    road = scene.K[1, 1] * 1.65 / (v - scene.K[1, 2])
    assert (np.abs(depth[150:] / road - 1) < 1e-5).mean() > 0.4


def test_points_of_one_frame_are_found_by_orb_where_the_scene_puts_them_in_the_next() -> None:
    pair = render_pair('road', 20, size=SMALL)
    orb = cv2.ORB_create(2000)
    (a, bits_a), (b, bits_b) = (orb.detectAndCompute(gray, None)
                                for gray in (pair.previous, pair.current))
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(bits_a, bits_b)
    x = np.array([a[m.queryIdx].pt for m in matches])
    y = np.array([b[m.trainIdx].pt for m in matches])
    there, seen = pair.project(x)
    close = np.linalg.norm(there - y, axis=1)[seen] < 2
    assert close.sum() > 200
    assert close.mean() > 0.6


@pytest.mark.parametrize('name', SCENES)
def test_every_scene_starts_at_the_identity_and_moves_smoothly(name: str) -> None:
    scene = make_scene(name, size=TINY)
    poses = scene.trajectory(min(suggested_frames(scene), 60))
    np.testing.assert_allclose(poses[0], np.eye(4), atol=1e-12)
    R = poses[:, :3, :3]
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (len(R), 1, 1)),
                               atol=1e-12)
    steps = np.linalg.inv(poses[:-1]) @ poses[1:]
    angles = np.arccos(np.clip((np.trace(steps[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1))
    assert np.degrees(angles).max() < (16 if name == 'whip' else 5)
    fastest = {'motorway': 3.1, 'flight': 4.5}.get(name, 1.4)
    assert np.linalg.norm(steps[:, :3, 3], axis=1).max() < fastest


def test_standing_still_only_the_noise_changes() -> None:
    scene = make_scene('standstill', size=TINY)
    poses = scene.trajectory(2)
    first, second = (scene.render(pose, i).astype(float) for i, pose in enumerate(poses))
    assert 0.5 < (first - second).std() < 3
    quiet = clean(scene)
    np.testing.assert_array_equal(quiet.render(poses[0], 0), quiet.render(poses[1], 1))


@pytest.mark.parametrize('name', ['road', 'handheld'])
def test_a_slower_camera_takes_the_same_path(name: str) -> None:
    usual, slower = make_scene(name), make_scene(name, slower=8)
    poses, more = usual.trajectory(6), slower.trajectory(41)
    assert np.allclose(more[::8], poses)
    assert slower.path.limit == 8 * (usual.path.limit - 1) + 1
    steps = np.linalg.norm(np.diff(more[:, :3, 3], axis=0), axis=1)
    usual_steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert np.abs(np.diff(steps)).max() < 0.3 * usual_steps.max() / 8
    assert steps.sum() == pytest.approx(usual_steps.sum(), rel=0.01)


def test_turning_on_the_spot_there_is_no_translation() -> None:
    poses = make_scene('rotation', size=TINY).trajectory(30)
    np.testing.assert_allclose(poses[:, :3, 3], 0, atol=1e-12)
    assert np.degrees(np.arccos(poses[-1, 0, 0])) == pytest.approx(29)


def test_the_loop_passes_the_same_place_twice() -> None:
    scene = make_scene('loop', size=TINY)
    poses = scene.trajectory(scene.path.limit)
    half = len(poses) // 2
    places = poses[:, :3, 3]
    gaps = np.linalg.norm(places[:half, None] - places[None, half:], axis=2).min(0)
    assert gaps.max() < 0.8
    assert np.linalg.norm(places, axis=1).max() > 40


def test_the_lorry_fills_about_half_of_the_picture() -> None:
    scene = make_scene('moving_object', size=TINY)
    alone = replace(scene, world=replace(scene.world, movers=()))
    poses = scene.trajectory(20)
    shares = [(scene.depth(poses[i], i) < alone.depth(poses[i], i)).mean() for i in (0, 7, 14)]
    assert all(0.3 < share < 0.65 for share in shares)


def test_exposure_jumps_and_focus_is_lost_as_declared() -> None:
    exposure, blur = make_scene('exposure_jump', size=TINY), make_scene('blur', size=SMALL)
    level = [exposure.render(np.eye(4), i).mean() for i in (4, 5)]
    assert level[1] < 0.6 * level[0]
    sharpness = [cv2.Laplacian(blur.render(np.eye(4), i), cv2.CV_64F).std() for i in (2, 3)]
    assert sharpness[0] < 0.5 * sharpness[1]


def test_underwater_images_are_dim_and_particles_drift_through_the_light() -> None:
    scene = make_scene('underwater', size=(240, 136))
    pose = scene.trajectory(1)[0]
    snow = replace(scene, effects=scene.effects[:2])
    first, later = (snow.render(pose, i).astype(float) for i in (0, 1))
    assert scene.render(pose).mean() < 90
    assert (np.abs(later - first) > 3).mean() > 1e-3
    far = scene.depth(pose) > 8
    assert first[far].std() < first[~far].std()


def test_a_sequence_is_read_back_as_it_was_made(tmp_path: Path) -> None:
    reports: list[tuple[int, int]] = []
    folder = render_sequence('road', tmp_path, 3, size=TINY,
                             progress=lambda done, total: reports.append((done, total)))
    scene = make_scene('road', size=TINY)
    sequence = KittiSequence(folder)
    assert folder == tmp_path / 'sequences' / '00'
    assert (len(sequence), sequence.size) == (3, TINY)
    np.testing.assert_allclose(sequence.K, scene.K, rtol=1e-12)
    np.testing.assert_allclose(sequence.poses, scene.trajectory(3), atol=1e-12)
    np.testing.assert_array_equal(np.diff(sequence.stamps_ns), 100_000_000)
    np.testing.assert_array_equal(sequence.image(2), scene.render(scene.trajectory(3)[2], 2))
    assert reports == [(1, 3), (2, 3), (3, 3)]


def test_an_earlier_rendering_is_replaced_only_if_asked(tmp_path: Path) -> None:
    render_sequence('standstill', tmp_path, 3, size=TINY)
    with pytest.raises(DjetError, match='04 exists already.*--overwrite'):
        render_sequence('standstill', tmp_path, 2, size=TINY)
    folder = render_sequence('standstill', tmp_path, 2, size=TINY, overwrite=True)
    assert len(KittiSequence(folder)) == 2


def test_a_folder_that_was_not_rendered_is_never_replaced(tmp_path: Path) -> None:
    real = tmp_path / 'sequences' / '04' / 'image_0' / '000000.png'
    real.parent.mkdir(parents=True)
    real.write_bytes(b'precious')
    with pytest.raises(DjetError, match='was not rendered'):
        render_sequence('standstill', tmp_path, 2, size=TINY, overwrite=True)
    assert real.read_bytes() == b'precious'


@pytest.mark.parametrize(('arguments', 'message'), [
    ({'name': 'raod'}, "no scene 'raod'; choose from road, underwater"),
    ({'name': 'road', 'size': (20000, 376)}, 'size is 20000x376'),
    ({'name': 'road', 'seed': -1}, 'seed is -1'),
    ({'name': 'road', 'slower': 0}, 'slower is 0'),
    ({'name': 'road', 'frames': 0, 'size': TINY}, "--frames is 0; scene 'road' has 1 to "),
    ({'name': 'road', 'frames': 10 ** 9, 'size': TINY}, '--frames is 1000000000'),
])
def test_an_impossible_scene_is_refused_in_one_line(
        arguments: dict, message: str, tmp_path: Path) -> None:
    with pytest.raises(DjetError, match=message) as caught:
        render_sequence(out=tmp_path, **arguments)
    assert '\n' not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_the_command_writes_the_same_bytes_in_another_process(tmp_path: Path) -> None:
    done = alone('lab', 'render', 'repeated_texture', tmp_path / 'a', '--frames', 2, '--size',
                 '160x64')
    folder = render_sequence('repeated_texture', tmp_path / 'b', 2, size=TINY)
    other = tmp_path / 'a' / folder.relative_to(tmp_path / 'b')
    assert done.stdout == f'{other}: 2 frames of 160x64 with ground truth\n'
    for path in (path for path in folder.rglob('*') if path.is_file()):
        assert (other / path.relative_to(folder)).read_bytes() == path.read_bytes()


def test_a_ripmap_keeps_place_and_mean_over_its_levels() -> None:
    rng = np.random.default_rng(3)
    image = 128 + 30 * fractal(rng, (64, 128), 2.0)
    ripmap = RipMap(image)
    u, v = rng.random((2, 500), np.float32)
    fine = ripmap.sample(u, v, np.zeros_like(u), np.zeros_like(u))
    coarse = ripmap.sample(u, v, np.full_like(u, 1.5), np.full_like(u, 0.5))
    beyond = ripmap.sample(u, v, np.full_like(u, 99), np.full_like(u, 99))
    assert np.corrcoef(fine, coarse)[0, 1] > 0.99
    np.testing.assert_allclose(beyond, image.mean(), atol=1)
    np.testing.assert_allclose(ripmap.sample(u + 3, v - 2, np.zeros_like(u), np.zeros_like(u)),
                               fine, atol=1)
    with pytest.raises(ValueError, match='100; it must be a power of two'):
        RipMap(np.zeros((64, 100), np.float32))


def test_another_seed_is_another_place() -> None:
    one, other = (clean(make_scene('repeated_texture', seed, TINY)) for seed in (0, 1))
    assert (one.render(np.eye(4)) != other.render(np.eye(4))).mean() > 0.5
