"""The figures of ``djet lab``: their content, and that they can be drawn."""

from __future__ import annotations

from dataclasses import replace
import os
from pathlib import Path
import shutil
import subprocess
import sys

from conftest import write_small_kitti
import cv2
from djet_ros.cli.main import main
from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.estimator_config import EstimatorConfig, preset
from djet_ros.errors import DjetError
from djet_ros.lab.scenes import render_sequence
from djet_ros.lab.similarity import cross_similarity, read_image, self_similarity
from djet_ros.lab.surface_steps import illustrative_match, RADIUS, trace_rounds
from djet_ros.recordings.kitti import KittiSequence
import numpy as np
import pytest

# Used by matplotlib to save images.
PIL = pytest.importorskip('PIL.Image')

CONFIG = EstimatorConfig()


@pytest.fixture(scope='module')
def road(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return three rendered frames of a street."""
    return render_sequence('road', tmp_path_factory.mktemp('road'), 3, size=(480, 160))


@pytest.fixture(scope='module')
def gray() -> np.ndarray:
    """Return an image with structure of several sizes."""
    noise = np.random.default_rng(3).integers(0, 256, (200, 300)).astype(np.float32)
    image = sum(cv2.GaussianBlur(noise, (0, 0), sigma) * sigma for sigma in (1, 2, 4))
    return cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def lab(call: list[str]) -> int:
    """Run a subcommand of djet lab in this process."""
    return main(['lab', *call])


def test_a_point_is_most_similar_to_itself(gray):
    points = np.array([[100.0, 80.0], [150.4, 99.6]])
    found = self_similarity(gray, points, 6, 12, CONFIG)
    assert found.x.tolist() == found.y.tolist() == [[100, 80], [150, 100]]
    assert found.surfaces.shape == (25, 25, 2)
    assert found.surfaces[12, 12].tolist() == [0, 0]
    assert np.abs(found.fits.minima() - found.y).max() < 0.5


def test_points_are_found_again_in_a_shifted_image(gray):
    shifted = np.roll(gray, (2, 5), axis=(0, 1))
    found = cross_similarity(gray, shifted, None, 40, 12, CONFIG)
    assert len(found.x) == 40
    # Keypoints of coarse levels are a pixel off in either image; the surfaces show by how much.
    missing = np.array([5, 2]) - (found.y - found.x)
    right = np.abs(missing).max(1) <= 2
    assert right.mean() > 0.85  # some false matches are unavoidable in noise
    for index in np.flatnonzero(right):
        x, y = missing[index]
        assert found.surfaces[12 + y, 12 + x, index] == 0


def test_matches_of_additional_features_are_taken_too(gray):
    # In an image with more corners than are sought, some features are detected on demand.
    few = replace(CONFIG, max_features=300)
    features = TwoViewEstimator(few).view(gray, np.eye(3)).features
    assert len(features) < len(features.with_additional)
    found = cross_similarity(gray, np.roll(gray, (2, 5), axis=(0, 1)), None, 40, 12, few)
    assert len(found.x) == 40


def test_the_strongest_keypoints_are_taken_and_kept_apart(gray):
    found = self_similarity(gray, None, 5, 12, CONFIG)
    between = np.abs(found.x[:, None] - found.x[None]).max(2) + 100 * np.eye(5)
    assert between.min() > 12


def test_rounds_end_where_the_estimator_ends(road):
    sequence = KittiSequence(road)
    for name in ('paper', 'best'):
        estimator = TwoViewEstimator(preset(name))
        views = [estimator.view(sequence.image(i), sequence.K) for i in (0, 1)]
        x, y = estimator.match(*views)
        trace = trace_rounds(*views, x, y, estimator.config)
        result = estimator.estimate_matched(*views, x, y)
        assert len(trace.rounds) == result.iterations
        assert np.array_equal(trace.rounds[-1].optimum, result.y_opt)
        assert np.array_equal(trace.result.inliers, result.inliers)
        # The chosen match has moved, but stays within the figure.
        match = illustrative_match(trace)
        assert 0 < np.linalg.norm(trace.rounds[-1].optimum[match] - trace.y[match]) < RADIUS


def test_the_size_of_a_figure_follows_its_content(road, tmp_path, capsys):
    images = [str(road / 'image_0' / f'{i:06d}.png') for i in (0, 1)]
    few, many, both = (tmp_path / 'new' / f'{name}.png' for name in ('few', 'many', 'both'))
    assert lab(['similarity', images[0], '--points', '200,80', '--output', str(few)]) == 0
    assert lab(['similarity', images[0], '--count', '4', '--output', str(many)]) == 0
    assert lab(['similarity', *images, '--count', '4', '--output', str(both)]) == 0
    sizes = [PIL.open(path).size for path in (few, many, both)]
    assert sizes[0][0] < sizes[1][0]
    assert sizes[1] == sizes[2]
    assert capsys.readouterr().out.splitlines()[0] == f'figure: {few}'


@pytest.mark.slow
def test_an_animation_has_a_frame_for_each_round(road, tmp_path, capsys):
    moving, still = tmp_path / 'surfaces.gif', tmp_path / 'surfaces.png'
    assert lab(['surfaces', str(road), '--pair', '1', '--output', str(moving)]) == 0
    rounds = int(capsys.readouterr().out.splitlines()[0].split()[-2])
    assert rounds > 1
    assert PIL.open(moving).n_frames == rounds
    assert lab(['surfaces', str(road), '--pair', '1', '--output', str(still)]) == 0
    assert PIL.open(still).size[0] > 500


@pytest.mark.slow
def test_two_images_and_a_camera_give_the_same_as_a_sequence(road, tmp_path, capsys):
    images = [str(road / 'image_0' / f'{i:06d}.png') for i in (1, 2)]
    K = KittiSequence(road).K
    camera = ','.join(repr(float(value)) for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    file = str(tmp_path / 'surfaces.png')
    assert lab(['surfaces', *images, '--camera', camera, '--output', file]) == 0
    one = capsys.readouterr().out
    assert lab(['surfaces', str(road), '--pair', '1', '--output', file, '--overwrite']) == 0
    assert capsys.readouterr().out == one


@pytest.mark.parametrize(('arguments', 'message'), [
    (['similarity', 'nowhere.png'], 'nowhere.png could not be read: No such file or directory'),
    (['similarity', 'text'], 'text is neither a PNG nor a JPEG image'),
    (['similarity', 'image', '--points', '5,5'], 'point 5,5 is too close to the border'),
    (['similarity', 'image', '--points', '5'], "--points is '5'; write it as X,Y"),
    (['similarity', 'image', 'image', '--points', 'nan,5'],
     "--points is 'nan,5'; write it as X,Y"),
    (['similarity', 'image', '--radius', '500'], 'between 2 and 100'),
    (['similarity', 'image', 'image', '--points', '1,1'], 'no keypoint with a match is within'),
    (['similarity', 'flat'], 'no keypoint has 20 pixels of image around it'),
    (['surfaces', 'image', 'image'], 'two images need --camera FX,FY,CX,CY'),
    (['surfaces', 'image', 'image', '--camera', '1,2'],
     "--camera is '1,2'; write it as FX,FY,CX,CY"),
    (['surfaces', 'image', 'image', '--camera', '9,9,inf,9'],
     "--camera is '9,9,inf,9'; write it as FX,FY,CX,CY"),
    (['surfaces', 'image', 'image', '--camera', '0,1,1,1'], 'focal lengths must be positive'),
    (['surfaces', 'flat', 'flat', '--camera', '9,9,9,9'],
     'have 0 matches, at least 20 are needed'),
    (['surfaces', 'road', '--camera', '9,9,9,9'], 'has a calibration of its own; omit the option'),
    (['surfaces', 'road', '--pair', '2'], '--pair is 2'),
    (['surfaces', 'single'], 'has one image; name a recording with two or more'),
    (['surfaces', 'road', '--match', '99999'], '--match is 99999; this pair has matches 0 to'),
    (['surfaces', 'road', '--output', 'a.jpg'], 'its name must end in .png or .gif'),
])
def test_an_invalid_call_is_one_line_and_exit_code_2(
        road, tmp_path, arguments, message, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'text').write_text('no image')
    cv2.imwrite(str(tmp_path / 'flat.png'), np.zeros((200, 200), np.uint8))
    places = {'road': road, 'image': road / 'image_0' / '000000.png', 'flat': 'flat.png',
              'single': write_small_kitti(tmp_path / 'dataset', frames=1)}
    code = lab([str(places.get(word, word)) for word in arguments])
    captured = capsys.readouterr()
    assert code == 2
    assert captured.err.startswith('djet: error: ')
    assert captured.err.count('\n') == 1
    assert message in captured.err


def test_no_figure_replaces_its_image(road, tmp_path, capsys):
    images = shutil.copytree(road / 'image_0', tmp_path / 'images')
    before = {path.name: path.read_bytes() for path in images.iterdir()}
    first, second = str(images / '000000.png'), str(images / '000001.png')
    for call in (['similarity', first, '--output', first],
                 ['similarity', first, second, '--output', second],
                 ['surfaces', first, second, '--camera', '9,9,9,9', '--output', first]):
        assert lab([*call, '--overwrite']) == 2
        assert capsys.readouterr().err == (
            f"djet: error: --output is '{call[-1]}', which belongs to the input; choose another "
            'one\n')
    assert {path.name: path.read_bytes() for path in images.iterdir()} == before


def without_screen():
    """Return an environment with nothing but Python's module path."""
    return {'PATH': '', 'PYTHONPATH': os.pathsep.join(filter(None, sys.path))}


@pytest.mark.slow
def test_drawing_needs_no_screen(road, tmp_path):
    draw = ('import sys; from djet_ros.cli.main import main; '
            f'sys.exit(main(["lab", "similarity", {str(road / "image_0" / "000000.png")!r}]))')
    answer = subprocess.run([sys.executable, '-c', draw], cwd=tmp_path, env=without_screen(),
                            capture_output=True, text=True, timeout=60, check=False)
    assert answer.returncode == 0, answer.stderr
    assert (tmp_path / 'similarity.png').exists()


def test_a_huge_declared_size_is_refused(tmp_path):
    data = bytearray(cv2.imencode('.png', np.zeros((9, 9), np.uint8))[1].tobytes())
    data[16:24] = (10**9).to_bytes(4, 'big') * 2
    (tmp_path / 'huge.png').write_bytes(data)
    with pytest.raises(DjetError, match='1000000000x1000000000 pixels'):
        read_image(tmp_path / 'huge.png')
