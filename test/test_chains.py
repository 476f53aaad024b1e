"""Complete pipelines of other libraries: they find exact motion, alone and in ``evaluate``."""

from __future__ import annotations

from collections.abc import Callable
import csv
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
import sys

import cv2
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.geometry import direction_angle, rotation_angle, rotation_exp
from djet_ros.core.types import RelativePose, Status
from djet_ros.errors import DjetError
from djet_ros.lab import methods as field
from djet_ros.lab.chains import CHAINS, corners, mutual_neighbours, root_sift, tracked
from djet_ros.lab.methods import make_methods, Method
from djet_ros.lab.pairs import evaluate_chunk, PairChunk, PairRecord
from djet_ros.lab.peers import ESTIMATORS
from djet_ros.lab.scenes import render_pair, render_sequence, ScenePair
from djet_ros.lab.scenes.texture import fractal
from djet_ros.lab.sequences import open_datasets, Selection
from djet_ros.lab.style import COLOURS, DASHES
from djet_ros.lab.tables import timings_csv
import numpy as np
from numpy.typing import NDArray
import pytest
from two_view import FORWARD, two_views

# A mark: a skip while modules are imported would lose others too, where a plugin imports them.
pytestmark = pytest.mark.skipif(find_spec('poselib') is None,
                                reason="the extra 'peers' is not installed")

NAMES = tuple(CHAINS)
Matcher = Callable[[NDArray[np.uint8], NDArray[np.uint8]],
                   tuple[NDArray[np.float64], NDArray[np.float64]]]


def by_chain(name: str, pair: ScenePair) -> RelativePose:
    """Estimate a rendered pair."""
    chain = CHAINS[name]
    return chain.estimate(*(chain.detect(gray, None) for gray in (pair.previous, pair.current)),
                          pair.K)


def matched(name: str, previous: NDArray[np.uint8], current: NDArray[np.uint8]
            ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Match two images."""
    chain = CHAINS[name]
    return chain.match(chain.detect(previous, None), chain.detect(current, None))


@pytest.fixture(scope='module')
def street() -> ScenePair:
    """Give two frames of the road with exact truth."""
    return render_pair('road', 12, size=(620, 188))


@pytest.mark.slow
@pytest.mark.parametrize('name', NAMES)
@pytest.mark.parametrize('scene', ['road', 'forest', 'handheld'])
def test_a_chain_finds_exact_motion_to_a_fraction_of_a_degree(name: str, scene: str) -> None:
    # The hand moves on by more than a centimetre from frame 5 on.
    pair = render_pair(scene, 5, size=(620, 376))
    found = by_chain(name, pair)
    assert found.status is Status.OK
    assert np.degrees(rotation_angle(pair.R, found.R)) < 0.15
    assert np.degrees(direction_angle(pair.t, found.t)) < 6
    assert found.inliers.sum() > 60


@pytest.mark.parametrize('name', NAMES)
def test_matches_lie_where_exact_geometry_puts_them(name: str, street: ScenePair) -> None:
    x, y = matched(name, street.previous, street.current)
    there, seen = street.project(x)
    off = np.linalg.norm(there - y, axis=1)[seen]
    assert seen.sum() > 80
    assert np.median(off) < 0.5
    assert (off < 1).mean() > 0.8


@pytest.mark.parametrize('name', NAMES)
def test_matches_follow_a_known_warp_to_a_part_of_a_pixel(name: str) -> None:
    rng = np.random.default_rng(5)
    image = np.clip(128 + 45 * fractal(rng, (512, 512), 1.1), 0, 255).astype(np.uint8)
    K = np.array([[500, 0, 255.5], [0, 500, 255.5], [0, 0, 1]])
    H = K @ rotation_exp(np.array([0.01, -0.015, 0.03])) @ np.linalg.inv(K)
    turned = cv2.warpPerspective(image, H, (512, 512), flags=cv2.INTER_CUBIC)
    x, y = matched(name, image, turned)
    inner = (np.abs(x - 255.5) < 200).all(axis=1)
    mapped = np.concatenate([x, np.ones((len(x), 1))], axis=1) @ H.T
    off = np.linalg.norm(mapped[:, :2] / mapped[:, 2:] - y, axis=1)[inner]
    assert len(off) > 200
    assert np.median(off) < 0.1


def test_corners_keep_their_distance_and_number(street: ScenePair) -> None:
    places = corners(street.previous).places
    gaps = np.linalg.norm(places[:, None] - places[None], axis=2) + 99 * np.eye(len(places))
    assert 200 < len(places) <= 2000
    assert gaps.min() >= 8
    noise = np.random.default_rng(0).integers(0, 256, (900, 1200), dtype=np.uint8)
    assert len(corners(noise).places) == 2000


def test_descriptors_are_roots_of_histograms_and_neighbours_mutual(street: ScenePair) -> None:
    previous, current = root_sift(street.previous), root_sift(street.current)
    np.testing.assert_allclose((previous.descriptors ** 2).sum(axis=1), 1, atol=1e-5)
    assert len(previous.places) <= 2001
    x, y = mutual_neighbours(previous, current)
    back_y, back_x = mutual_neighbours(current, previous)
    both = {(*a, *b) for a, b in zip(x.tolist(), y.tolist())} & {
        (*a, *b) for a, b in zip(back_x.tolist(), back_y.tolist())}
    assert len(both) > 0.8 * len(x)


def test_a_corner_that_is_not_tracked_back_is_dropped(street: ScenePair) -> None:
    x, _ = tracked(corners(street.previous), corners(street.previous))
    assert len(x) == len(corners(street.previous).places)
    other = np.ascontiguousarray(np.rot90(street.current, 2))
    lost, _ = tracked(corners(street.previous), corners(other))
    assert len(lost) < 0.3 * len(x)


@pytest.mark.parametrize('name', NAMES)
@pytest.mark.parametrize('gray', [
    np.full((120, 160), 90, np.uint8),
    np.pad(np.full((20, 20), 200, np.uint8), 50),
], ids=['blank', 'one square'])
def test_an_image_without_points_is_a_failure_without_an_exception(
        name: str, gray: NDArray[np.uint8]) -> None:
    chain = CHAINS[name]
    found = chain.estimate(*[chain.detect(gray, None)] * 2, np.diag([100.0, 100, 1]))
    assert found.status is not Status.OK or found.inliers.any()
    blank = chain.estimate(chain.detect(np.zeros_like(gray)), chain.detect(gray), np.eye(3))
    assert blank.status is Status.TOO_FEW_MATCHES
    assert not blank.t.any()


@pytest.mark.parametrize('name', NAMES)
def test_the_same_images_give_the_same_pose_to_the_last_bit(name: str, street: ScenePair) -> None:
    one, other = by_chain(name, street), by_chain(name, street)
    for value, again in zip(asdict(one).values(), asdict(other).values()):
        np.testing.assert_array_equal(value, again)


# Peers on given matches

@pytest.mark.parametrize('name', ['opencv_ransac', 'usac_magsac'])
def test_points_many_baselines_away_distinguish_the_poses_of_opencv(name: str) -> None:
    # As a hand moves a camera by a centimetre, through a room of some metres.
    given = two_views(np.random.default_rng(0), t=FORWARD, near=60.0, far=300.0)
    R, t, _ = ESTIMATORS[name](given.K, given.x, given.y)
    assert rotation_angle(R, given.R) < 1e-3
    assert direction_angle(t, given.t) < 0.1


# In an evaluation

@pytest.fixture(scope='module')
def records(tmp_path_factory: pytest.TempPathFactory) -> list[PairRecord]:
    """Return the records of all peers on three pairs of a street, with both presets."""
    folder = render_sequence('road', tmp_path_factory.mktemp('road'), 4, size=(480, 160))
    dataset, = open_datasets([folder], Selection(), folder)
    competing = make_methods(['djet', 'poselib', *NAMES], ['best', 'paper'], {})
    return evaluate_chunk(PairChunk(dataset, 0, 3), competing)


def test_chains_have_their_own_matches_and_times(records: list[PairRecord]) -> None:
    for pair in range(3):
        matches = {r.method: r.matches for r in records
                   if r.pair == pair and r.preset == 'best'}
        assert len({matches['djet'], *(matches[name] for name in NAMES)}) == 3
    assert all(r.milliseconds > 0 for r in records)
    # Neither waits for ORB, whose features and matches the others are given.
    table = list(csv.DictReader(timings_csv(records, with_change=False).splitlines()))
    assert {row['method'] for row in table} == {'djet', 'poselib', *NAMES}
    assert len({row['milliseconds'] for row in table if row['method'] == 'klt_poselib'}) == 3


def test_a_chain_is_the_same_with_either_preset(records: list[PairRecord]) -> None:
    for name in NAMES:
        best, paper = ([(r.rotation, r.translation, r.matches, r.milliseconds) for r in records
                        if r.method == name and r.preset == preset]
                       for preset in ('best', 'paper'))
        assert best == paper


def test_chains_find_the_pose_and_report_their_descriptors(records: list[PairRecord]) -> None:
    for found in (r for r in records if r.method in NAMES):
        assert not found.failed
        assert found.rotation_error_deg < 0.2
        assert found.translation_error_deg < 5
        assert 5 < found.hamming_mean < 80
        assert 20 < found.inliers <= found.matches


def test_a_chain_alone_detects_no_features_of_djet(
        monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    folder = render_sequence('road', tmp_path, 2, size=(480, 160))
    dataset, = open_datasets([folder], Selection(), tmp_path)

    def unwanted(*_: object) -> None:
        raise AssertionError('features of ours were asked for')

    monkeypatch.setattr('djet_ros.core.estimator.detect_orb', unwanted)
    record, = evaluate_chunk(PairChunk(dataset, 0, 1), [
        Method('klt_poselib', 'best', EstimatorConfig(method='five_point'))])
    assert record.status == Status.OK


def test_every_method_has_a_colour_and_a_dash_of_its_own() -> None:
    assert set(COLOURS) == set(DASHES) == set(field.TITLES)
    assert len(set(COLOURS.values())) == len(set(map(str, DASHES.values()))) == len(COLOURS)


@pytest.mark.parametrize('name', NAMES)
def test_a_missing_poselib_is_one_line_that_names_what_to_install(
        name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    # As Python does for a module that is not there.
    monkeypatch.setitem(sys.modules, 'poselib', None)
    monkeypatch.setattr(field, 'find_spec', lambda module: None if module == 'poselib' else 1)
    with pytest.raises(DjetError, match=rf"method '{name}' needs the module 'poselib'.*"
                                        r"pip install './djet_ros\[peers\]'") as caught:
        make_methods([name], ['best'], {})
    assert '\n' not in str(caught.value)
    assert name not in field.default_methods()
